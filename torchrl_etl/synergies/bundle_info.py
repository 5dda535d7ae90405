"""The description of a synergy bundle, and its compatibility with an environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_etl.io import read_json

__all__ = [
    "COPY_AGAIN",
    "DESCRIPTION",
    "FORMAT_VERSION",
    "BundleError",
    "BundleInfo",
    "check_compatible",
    "default_kind",
    "read_description",
    "some",
]

DESCRIPTION = "synergies.json"
COPY_AGAIN = "copy the bundle again, with both its files"
FORMAT_VERSION = 2  # version 1 had neither kind nor encoder


class BundleError(ValueError):
    """A synergy bundle cannot be written, read or used; the message says why and how to fix it."""


@dataclass(frozen=True)
class BundleInfo:
    """Contents of ``synergies.json``.

    Args:
        task (str): the task in which the synergies were explored.
        actuators (tuple of str): names of the n actuators, in action order.
        low, high (tuple of float): action bounds [n].
        num_synergies (int): number d of synergies.
        residual (float): residual share of the decoder.
        config (dict): constructor arguments of the decoder; its ``kind`` unless a SynergyDecoder.
        sha256 (str): digest of the tensors file.
        facts (dict): frames, seed, commit, versions, variance accounted for, and so on.
        kind (str): kind of synergies, such as ``"gmvae"`` or ``"nmf"``.
        encoder (dict, optional): constructor arguments of the encoder, if there is one.
        format_version (int): version of the format.
    """

    task: str
    actuators: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    num_synergies: int
    residual: float
    config: dict[str, Any]
    sha256: str
    facts: dict[str, Any] = field(default_factory=dict)
    kind: str = "gmvae"
    encoder: dict[str, Any] | None = None
    format_version: int = FORMAT_VERSION


def read_description(folder: Path) -> BundleInfo:
    """Read ``synergies.json`` in a bundle's folder.

    Raises:
        BundleError: if it cannot be read, is damaged, or has another format version.
    """
    path = folder / DESCRIPTION
    content = read_json(path, dict, BundleError, COPY_AGAIN)
    version = content.get("format_version")
    if version is None:
        raise BundleError(f"{path} has no format_version: it does not describe a synergy bundle.")
    if version not in (1, FORMAT_VERSION):
        raise BundleError(
            f"{path} has format version {version!r} and this torchrl_etl reads 1 and "
            f"{FORMAT_VERSION}; load it with the version that wrote it, or explore again."
        )
    content.pop("num_components", None)  # redundant entry of earlier bundles
    known = {item.name for item in fields(BundleInfo)}
    if version == 1:
        content = {"kind": "", "encoder": None, **content}
    if set(content) != known:
        missing, extra = sorted(known - set(content)), sorted(set(content) - known)
        raise BundleError(
            f"{path} lacks {missing} and has unknown {extra}; it was edited, so copy the bundle "
            "again."
        )
    kinds = {"actuators": list, "low": list, "high": list, "config": dict, "facts": dict}
    for key, kind in {"task": str, **kinds}.items():
        if not isinstance(content[key], kind):
            named = {list: "array", dict: "object", str: "string"}[kind]
            raise BundleError(
                f"{key} in {path} is {content[key]!r}; it must be a JSON {named}, so copy the "
                "bundle again."
            )
    if not all(isinstance(name, str) for name in content["actuators"]):
        raise BundleError(f"{path} has actuators that are not strings; copy the bundle again.")
    if content["residual"] != (own := content["config"].get("residual", content["residual"])):
        raise BundleError(
            f"{path} states a residual of {content['residual']!r} for a decoder with {own!r}; it "
            "was edited, so copy the bundle again."
        )
    if version == 1:
        content["kind"] = default_kind(content["config"])
    if not isinstance(content["kind"], str) or not isinstance(content["encoder"], dict | None):
        raise BundleError(
            f"{path} has kind {content['kind']!r}, which must be a string, and encoder "
            f"{content['encoder']!r}, which must be an object or null; copy the bundle again."
        )
    content |= {key: tuple(content[key]) for key in ("actuators", "low", "high")}
    return BundleInfo(**content)


def check_compatible(
    info: BundleInfo,
    actuators: Sequence[str],
    low: float | Sequence[float] | Tensor,
    high: float | Sequence[float] | Tensor,
) -> None:
    """Raise if a bundle's actuators or bounds differ from the environment's.

    Args:
        info (BundleInfo): description returned by :func:`load_bundle`.
        actuators (sequence of str): the environment's actuator names, in action order.
        low, high (float, sequence of float or Tensor): its action bounds, scalar or [n].

    Raises:
        BundleError: with both values and the most likely explanation.

    Examples:
        >>> from torchrl_etl.synergies import BundleInfo
        >>> info = BundleInfo("toy", ("a", "b"), (0.0, 0.0), (1.0, 1.0), 1, 0.0, {}, "")
        >>> check_compatible(info, ["a", "b"], 0.0, 1.0)
        >>> check_compatible(info, ["b", "a"], 0.0, 1.0)
        Traceback (most recent call last):
        ...
        torchrl_etl.synergies.bundle_info.BundleError: The bundle of 'toy' and the environment
        have the same 2 actuators in different order (number 0 is 'a' in the bundle, 'b' in the
        environment); ...
    """
    actuators = tuple(actuators)
    if actuators != info.actuators:
        raise BundleError(_explain_names(info, actuators))
    for side, own, other in (("lower", info.low, low), ("upper", info.high, high)):
        ours = torch.tensor(own, dtype=torch.float64)
        theirs = torch.as_tensor(other).detach().cpu().double().expand(len(ours))
        differ = ~torch.isclose(ours, theirs, rtol=1e-5, atol=1e-6)
        if differ.any():
            first = int(differ.nonzero()[0])
            raise BundleError(
                f"The bundle of {info.task!r} has other {side} action bounds than the environment "
                f"for {int(differ.sum())} of {len(ours)} actuators ({actuators[first]!r}: "
                f"{ours[first]:g} in the bundle, {theirs[first]:g} in the environment); actions "
                "are scaled differently, as between versions of a simulator or action wrappers, so "
                "use the same ones or explore again."
            )


def default_kind(config: Mapping[str, Any]) -> str:
    """The kind of synergies for which none is recorded, by the map's arguments."""
    return config.get("kind") or ("gmvae" if config.get("hidden", True) else "affine")


def _explain_names(info: BundleInfo, actuators: tuple[str, ...]) -> str:
    missing = [name for name in info.actuators if name not in actuators]
    extra = [name for name in actuators if name not in info.actuators]
    ours, theirs = len(info.actuators), len(actuators)
    start = f"The bundle of {info.task!r}"
    if not missing and not extra:
        where = next(i for i in range(ours) if info.actuators[i] != actuators[i])
        return (
            f"{start} and the environment have the same {ours} actuators in different order "
            f"(number {where} is {info.actuators[where]!r} in the bundle, {actuators[where]!r} in "
            "the environment); bring the environment's actions into the bundle's order."
        )
    counts = f"{start} moves {ours} actuators and the environment has {theirs}"
    if len(missing) == ours:
        return f"{counts}, with no name in common: it is for another body, so explore on this one."
    if not missing:
        return (
            f"{counts}, among them all of the bundle's (it lacks {some(extra)}): it was made on a "
            "part of this body, so explore on the whole."
        )
    if not extra:
        return (
            f"{counts}, all of them in the bundle (which also moves {some(missing)}): it was made "
            "on a larger body, so explore on this one."
        )
    near = {name: get_close_matches(name, extra, n=1, cutoff=0.8) for name in missing}
    renamed = [f"{name!r} for {match[0]!r}" for name, match in near.items() if match]
    hint = f"; perhaps renamed: {', '.join(renamed[:3])}" if renamed else ""
    return (
        f"{counts}; only the bundle has {some(missing)}, only the environment has {some(extra)}"
        f"{hint}; use a bundle made on this body."
    )


def some(names: Sequence[str]) -> str:
    """The first three names, and the number of others."""
    rest = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(map(repr, names[:3])) + rest
