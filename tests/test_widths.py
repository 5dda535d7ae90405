"""A wrong last dimension is refused, also a size of 1 that PyTorch would broadcast."""

from __future__ import annotations

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded

from torchrl_etl.envs import SynergyActionWrapper
from torchrl_etl.modules import GMVAE, RunningNorm, SynergyDecoder
from torchrl_etl.objectives import DecoderLoss, GMVAELoss
from torchrl_etl.transforms import LatentAction


def step(action):
    env = SynergyActionWrapper(gymnasium.make("torchrl_etl/Overactuated-v0"), SynergyDecoder(4, 16))
    env.reset(seed=0)
    env.step(action)


def decode(latent):
    module = TensorDictModule(lambda z: 2 * z, ["z"], ["action"])
    LatentAction(module, Bounded(-1, 1, shape=(4,))).decode(latent)


def fine_tune(action):
    data = TensorDict({"synergy": torch.zeros(8, 4), "action": action}, [8])
    DecoderLoss(SynergyDecoder(4, 16))(data)


@pytest.mark.parametrize(
    ("use", "given", "words"),
    [
        (SynergyDecoder(4, 16), torch.zeros(2, 1), r"synergy has shape \[2, 1\].* must be 4"),
        (SynergyDecoder(4, 16, residual=0.5), torch.zeros(2, 1), r"shape \[2, 1\].* must be 20"),
        (step, 0.5, r"action has shape \[\].* must be 4"),
        (decode, torch.zeros(2, 1), r"'latent' has shape \[2, 1\]; it must end with \[4\]"),
        (fine_tune, torch.zeros(8, 1), r"action has shape \[8, 1\].* must be 16"),
        (GMVAELoss(GMVAE(12, 2)), torch.zeros(8, 1), r"action has shape \[8, 1\].* must be 12"),
        (
            RunningNorm(3).update_moments,
            torch.zeros(4, 6),
            r"values has shape \[4, 6\].* must be 3",
        ),
    ],
)
def test_wrong_last_dimension_is_refused(use, given, words):
    if isinstance(use, GMVAELoss):
        given = TensorDict({"action": given}, given.shape[:1])
    with pytest.raises(ValueError, match=words):
        use(given)
