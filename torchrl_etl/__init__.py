"""Explore to Learn (ETL) as TorchRL components: synergies for overactuated control.

The most used names can be imported from here, as in ``from torchrl_etl import SynergyAction``.
They are loaded lazily, since importing TorchRL takes seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchrl_etl.gl_backend import ignore_unusable_backend

if TYPE_CHECKING:
    from torchrl_etl.envs import make_env
    from torchrl_etl.modules import GMVAE, SynergyDecoder
    from torchrl_etl.objectives import LeanSACLoss, SynergySACLoss
    from torchrl_etl.synergies import fit_gmvae, fit_synergies, load_bundle, save_bundle
    from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward, LatentAction, SynergyAction

__version__ = "0.1.0"

ignore_unusable_backend()  # before TorchRL imports MuJoCo

_HOMES = {
    "envs": ("make_env",),
    "modules": ("GMVAE", "SynergyDecoder"),
    "objectives": ("LeanSACLoss", "SynergySACLoss"),
    "synergies": ("fit_gmvae", "fit_synergies", "load_bundle", "save_bundle"),
    "transforms": ("DirectionPrimer", "IntrinsicReward", "LatentAction", "SynergyAction"),
}

__all__ = [
    "GMVAE",
    "DirectionPrimer",
    "IntrinsicReward",
    "LatentAction",
    "LeanSACLoss",
    "SynergyAction",
    "SynergyDecoder",
    "SynergySACLoss",
    "fit_gmvae",
    "fit_synergies",
    "load_bundle",
    "make_env",
    "save_bundle",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
