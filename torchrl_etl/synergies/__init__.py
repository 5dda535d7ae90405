"""What condenses muscle actions into synergies, one kind a file."""

from collections.abc import Callable, Mapping

from torchrl_etl.synergies.gmvae import GMVAESynergies, fit_gmvae
from torchrl_etl.synergies.model import SynergyModel
from torchrl_etl.synergies.shown import ShownActions

__all__ = ["SYNERGY_MODELS", "GMVAESynergies", "ShownActions", "SynergyModel", "fit_gmvae"]

SYNERGY_MODELS: Mapping[str, Callable[..., SynergyModel]] = {"gmvae": GMVAESynergies}
