"""Trained policies and synergy bundles, loaded in two lines.

>>> from torchrl_etl import zoo
>>> policy, env = zoo.load("overactuated")
>>> env.rollout(3, policy)["action"].shape
torch.Size([3, 16])
"""

from torchrl_etl.zoo.card import Card, ZooError
from torchrl_etl.zoo.entry import (
    ENTRIES,
    bundle_path,
    find,
    load,
    names,
    read_card,
    save_entry,
    synergies,
    synergies_alone,
    trust,
    untrained,
)
from torchrl_etl.zoo.policy import describe_decoder, make_policy

__all__ = [
    "ENTRIES",
    "Card",
    "ZooError",
    "bundle_path",
    "describe_decoder",
    "find",
    "load",
    "make_policy",
    "names",
    "read_card",
    "save_entry",
    "synergies",
    "synergies_alone",
    "trust",
    "untrained",
]
