"""Networks as TensorDict modules."""

from torchrl_etl.modules.actor_critic import make_actor, make_critic
from torchrl_etl.modules.gmvae import GMVAE, ActionDecoder, Posterior
from torchrl_etl.modules.held_noise import HeldNoise
from torchrl_etl.modules.maps import MAPS, describe_map, make_map
from torchrl_etl.modules.policy_function import policy_function
from torchrl_etl.modules.return_scale import ReturnScale
from torchrl_etl.modules.running_norm import RunningNorm
from torchrl_etl.modules.sar_decoder import SARDecoder
from torchrl_etl.modules.scheduled import Scheduled
from torchrl_etl.modules.state_encoder import GaussianDynamics, StateEncoder
from torchrl_etl.modules.synergy_decoder import SynergyDecoder
from torchrl_etl.modules.synergy_map import SynergyMap
from torchrl_etl.modules.uniform_warmup import UniformWarmup

__all__ = [
    "GMVAE",
    "MAPS",
    "ActionDecoder",
    "GaussianDynamics",
    "HeldNoise",
    "Posterior",
    "ReturnScale",
    "RunningNorm",
    "SARDecoder",
    "Scheduled",
    "StateEncoder",
    "SynergyDecoder",
    "SynergyMap",
    "UniformWarmup",
    "describe_map",
    "make_actor",
    "make_critic",
    "make_map",
    "policy_function",
]
