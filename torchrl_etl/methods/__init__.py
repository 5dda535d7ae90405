"""ETL, plain SAC and the baselines, one per file."""

from collections.abc import Mapping

from torchrl_etl.methods.dep import DEP
from torchrl_etl.methods.dynsyn import DynSyn
from torchrl_etl.methods.eme import EME
from torchrl_etl.methods.etl import ETL
from torchrl_etl.methods.lattice import Lattice
from torchrl_etl.methods.method import Method
from torchrl_etl.methods.sac import SAC
from torchrl_etl.methods.sar import SAR

__all__ = ["DEP", "EME", "ETL", "METHODS", "SAC", "SAR", "DynSyn", "Lattice", "Method"]

METHODS: Mapping[str, type[Method]] = {
    "etl": ETL,
    "sac": SAC,
    "lattice": Lattice,
    "dep": DEP,
    "dynsyn": DynSyn,
    "eme": EME,
    "sar": SAR,
}
"""Methods by name; ``"my_module:MyMethod"`` names a user's own."""
