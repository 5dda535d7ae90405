"""The description of a zoo entry: ``card.json``."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from torchrl_etl.io import as_json, read_json

__all__ = ["CARD", "WEIGHTS", "Card", "ZooError"]

FORMAT_VERSION = 1
CARD = "card.json"
WEIGHTS = "policy.safetensors"


class ZooError(ValueError):
    """An entry of the zoo cannot be written, read or used; the message gives reason and remedy."""


@dataclass(frozen=True)
class Card:
    """The content of ``card.json``.

    Args:
        task (dict): arguments of :func:`~torchrl_etl.envs.make_env`: ``name``, ``goal`` and so on.
        actuators (list of str): names of the n actuators, in action order.
        policy (dict): arguments of :func:`~torchrl_etl.zoo.make_policy`.
        training (dict): ``method``, ``frames`` (total, with those before learning), ``seed``,
            ``commit``, ``versions`` and the ``command``.
        evaluation (dict): ``return``, ``solved`` and ``solved_time`` with 95 % intervals, if the
            task defines them, and the values of each episode, from
            :meth:`Evaluation.summary <torchrl_etl.training.Evaluation.summary>`.
        sha256 (str): digest of the weights.
        format_version (int): version of this format.
    """

    task: dict[str, Any]
    actuators: list[str]
    policy: dict[str, Any]
    training: dict[str, Any]
    evaluation: dict[str, Any]
    sha256: str = ""
    format_version: int = field(default=FORMAT_VERSION)

    @property
    def json(self) -> str:
        """The file's text, with each innermost list on one line."""
        lists = re.compile(r"\[[^][{}]*\]")
        return lists.sub(lambda found: re.sub(r"\s*\n\s*", " ", found[0]), as_json(asdict(self)))

    @classmethod
    def read(cls, folder: Path) -> Card:
        """The card in a folder.

        Raises:
            ZooError: if there is no card, or this release cannot read it.
        """
        path = folder / CARD
        content = read_json(path, dict, ZooError, "copy the entry again")
        version = content.get("format_version")
        if version != FORMAT_VERSION:
            raise ZooError(
                f"{path} has format_version {version!r}, but this torchrl_etl reads "
                f"{FORMAT_VERSION}; load it with the release that wrote it."
            )
        known = {item.name: item.type for item in fields(cls)}
        odd = sorted(known.keys() ^ content.keys()) or [
            name
            for name, value in content.items()
            if type(value).__name__ != known[name].partition("[")[0]
        ]
        if odd:
            raise ZooError(
                f"{odd[0]!r} in {path} is missing, unknown or invalid; copy the entry again."
            )
        return cls(**content)
