"""Models that extract synergies from muscle actions, one per file."""

from torchrl_etl.synergies.action_selector import ActionSelector
from torchrl_etl.synergies.affine import AffineSynergies
from torchrl_etl.synergies.bundle import copy_bundle, load_bundle, save_bundle
from torchrl_etl.synergies.bundle_info import BundleError, BundleInfo, check_compatible
from torchrl_etl.synergies.fit import SYNERGY_MODELS, fit_synergies
from torchrl_etl.synergies.gmvae import GMVAESynergies, fit_gmvae
from torchrl_etl.synergies.model import SynergyModel
from torchrl_etl.synergies.nmf import NMFSynergies
from torchrl_etl.synergies.pca import PCASynergies
from torchrl_etl.synergies.recordings import Recording, read_recording
from torchrl_etl.synergies.sar import SARSynergies
from torchrl_etl.synergies.vae import VAESynergies

__all__ = [
    "SYNERGY_MODELS",
    "ActionSelector",
    "AffineSynergies",
    "BundleError",
    "BundleInfo",
    "GMVAESynergies",
    "NMFSynergies",
    "PCASynergies",
    "Recording",
    "SARSynergies",
    "SynergyModel",
    "VAESynergies",
    "check_compatible",
    "copy_bundle",
    "fit_gmvae",
    "fit_synergies",
    "load_bundle",
    "read_recording",
    "save_bundle",
]
