"""The synergy bundle: a learned decoder on disk, in two files without code.

``synergies.safetensors`` holds the state dict of the decoder and, with the prefix ``encoder.``, of
its encoder if it has one. ``synergies.json`` holds everything else: constructor arguments, actuator
names and bounds, facts about the training, and the SHA-256 of the tensors.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from tensordict.utils import NestedKey

from torchrl_etl.checks import not_finite
from torchrl_etl.io import read_bytes, replace_folder, replaceable_folder, surviving_folder
from torchrl_etl.modules import GMVAE, SynergyMap, describe_map, make_map
from torchrl_etl.synergies.bundle_info import (
    COPY_AGAIN,
    DESCRIPTION,
    BundleError,
    BundleInfo,
    default_kind,
    read_description,
)
from torchrl_etl.user_code import check_imported

__all__ = ["BUNDLE_FILES", "bundle_files", "copy_bundle", "load_bundle", "save_bundle"]

_DEFAULT_MAP = "synergies"  # its descriptions have no kind, as there once was no other
_ENCODER = "encoder."
_TENSORS = "synergies.safetensors"
_IMPORT_FIRST = (
    "if you trust it, import it first in Python, or, to learn with it, give etl_sac.py both "
    "synergies=NAME, your model, and synergies.bundle=FOLDER"
)
BUNDLE_FILES = (_TENSORS, DESCRIPTION)
"""File names of a bundle."""


def save_bundle(
    decoder: SynergyMap,
    path: str | os.PathLike[str],
    *,
    task: str,
    actuators: Sequence[str],
    facts: Mapping[str, Any] | None = None,
    kind: str | None = None,
) -> Path:
    """Write a decoder and its description to the folder ``path``, atomically.

    The decoder's encoder, if any, is saved too, so that a loaded decoder can relabel recorded
    actions.

    An existing bundle is replaced. After a crash, :func:`load_bundle` finds either the old bundle
    or the new one. Only one process at a time may save to a path.

    Args:
        decoder (SynergyMap): the decoder.
        path (path-like): the bundle's folder; parents are created.

    Keyword Args:
        task (str): the task in which the synergies were explored.
        actuators (sequence of str): names of the n actuators, in action order.
        facts (mapping, optional): JSON-serializable values; paths and torch or numpy scalars are
            converted, non-finite numbers become null.
        kind (str, optional): kind of synergies. Default: ``"gmvae"`` for a SynergyDecoder,
            ``"affine"`` for one without hidden layers, else the kind of the map.

    Raises:
        ValueError: if the decoder is not a :class:`~torchrl_etl.modules.SynergyMap`.
        BundleError: if task or kind is not a string, the names do not fit the decoder, a weight is
            not finite, a fact is not JSON-serializable, or ``path`` holds other files.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> decoder = SynergyDecoder(2, 3, low=0.0)
        >>> with TemporaryDirectory() as run:
        ...     folder = save_bundle(
        ...         decoder, f"{run}/synergies", task="toy", actuators=["a", "b", "c"]
        ...     )
        ...     copy, info = load_bundle(run)
        >>> info.task, info.actuators, copy.num_synergies
        ('toy', ('a', 'b', 'c'), 2)
    """
    config = _plain(describe_map(decoder), "config")
    if config["kind"] == _DEFAULT_MAP:
        del config["kind"]
    kind = default_kind(config) if kind is None else kind
    for name, value in {"task": task, "kind": kind}.items():
        if not isinstance(value, str):
            raise BundleError(f"{name} is {value!r}; it must be a string.")
    actuators = tuple(map(str, actuators))
    if len(actuators) != decoder.action_dim or len(set(actuators)) != len(actuators):
        raise BundleError(
            f"There are {len(actuators)} actuator names ({len(set(actuators))} different) for a "
            f"decoder of {decoder.action_dim} actuators; pass one name for each, in order."
        )
    state, encoder = decoder.state_dict(), decoder.encoder
    if encoder is not None:
        state |= {f"{_ENCODER}{key}": value for key, value in encoder.state_dict().items()}
    if (bad := not_finite(state)) is not None:
        raise BundleError(
            f"{bad} of the decoder is not finite, so it has no synergies to save; its training "
            "diverged: lower the learning rate or look for NaN in the actions it was fitted to."
        )
    tensors = safetensors.torch.save(
        {key: value.detach().cpu().clone() for key, value in state.items()}
    )
    info = BundleInfo(
        task=task,
        actuators=actuators,
        low=tuple(decoder.low.tolist()),
        high=tuple(decoder.high.tolist()),
        num_synergies=int(decoder.num_synergies),
        residual=float(decoder.residual),
        config=config,
        sha256=hashlib.sha256(tensors).hexdigest(),
        facts=_plain(dict(facts or {}), "facts"),
        kind=kind,
        encoder=None if encoder is None else _plain(encoder.config, "encoder"),
    )
    description = json.dumps(asdict(info), indent=2, allow_nan=False).encode() + b"\n"
    folder = replaceable_folder(path, BUNDLE_FILES, "a bundle", BundleError)
    replace_folder(folder, {_TENSORS: tensors, DESCRIPTION: description})
    return folder


def load_bundle(
    path: str | os.PathLike[str],
    *,
    residual: float | None = None,
    in_keys: Sequence[NestedKey] | None = None,
    out_keys: Sequence[NestedKey] | None = None,
) -> tuple[SynergyMap, BundleInfo]:
    """Read a bundle from its folder, or from a run folder with a subfolder ``synergies/``.

    No code in a bundle is executed: tensors are read as safetensors only. The digest detects
    damage, not tampering.

    Args:
        path (path-like): the bundle's folder, or a run folder.

    Keyword Args:
        residual (float, optional): replaces the bundle's residual share; it has no weights.
        in_keys, out_keys (sequence of NestedKey, optional): replace those of the map, if its
            constructor takes them. Default: its own.

    Returns:
        tuple of SynergyMap and BundleInfo: the decoder on the CPU, and its description.

    Raises:
        BundleError: if there is no bundle, it is damaged, it has another format version, or the
            module of its map has not been imported.

    Examples:
        >>> load_bundle("nowhere")
        Traceback (most recent call last):
        ...
        torchrl_etl.synergies.bundle_info.BundleError: There is no synergy bundle at 'nowhere'; ...
    """
    folder = _find_folder(Path(path))
    info = read_description(folder)
    content = read_bytes(folder / _TENSORS, BundleError, COPY_AGAIN)
    if hashlib.sha256(content).hexdigest() != info.sha256:
        raise BundleError(
            f"{_TENSORS} in {str(folder)!r} is damaged or belongs to another bundle: its SHA-256 "
            f"is not the one in {DESCRIPTION}; copy both files again."
        )
    try:
        state = safetensors.torch.load(content)
    except SafetensorError as error:
        raise BundleError(
            f"{_TENSORS} in {str(folder)!r} is not a safetensors file ({error}); write bundles "
            "with save_bundle."
        ) from error
    if (bad := not_finite(state)) is not None:
        raise BundleError(
            f"{bad} of the decoder in {str(folder)!r} is not finite: its training diverged before "
            "it was saved; explore again, or take another bundle."
        )
    described = {"kind": _DEFAULT_MAP, **info.config}
    source = f"The decoder in {str(folder)!r}"
    check_imported(described["kind"], source, BundleError, _IMPORT_FIRST)
    keys = {"in_keys": in_keys, "out_keys": out_keys}
    given = {name: value for name, value in keys.items() if value is not None}
    try:
        # Initial weights are overwritten at once, so drawing them must not advance the global RNG.
        with torch.random.fork_rng(devices=[]):
            decoder = make_map(described, residual=residual, **given)
            encoder = None if info.encoder is None else GMVAE(**info.encoder)
        if encoder is not None:
            inner = {key for key in state if key.startswith(_ENCODER)}
            encoder.load_state_dict({key.removeprefix(_ENCODER): state.pop(key) for key in inner})
        decoder.load_state_dict(state)
    except (TypeError, ValueError, RuntimeError) as error:
        raise BundleError(
            f"The config and the tensors in {str(folder)!r} do not make a decoder: {error}"
        ) from error
    decoder.set_encoder(encoder)
    bounds = tuple(decoder.low.tolist()), tuple(decoder.high.tolist())
    sizes = decoder.num_synergies, decoder.action_dim
    if bounds != (info.low, info.high) or sizes != (info.num_synergies, len(info.actuators)):
        raise BundleError(
            f"{DESCRIPTION} in {str(folder)!r} states {info.num_synergies} synergies of "
            f"{len(info.actuators)} actuators, but its decoder has {sizes[0]} of {sizes[1]}, or "
            "other bounds; it was edited, so copy the bundle again."
        )
    return decoder, info


def copy_bundle(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> Path:
    """Copy a bundle unchanged to the folder ``target``, atomically.

    Args:
        source (path-like): the bundle's folder, or a run folder.
        target (path-like): a folder; an existing bundle is replaced.

    Raises:
        BundleError: if there is no bundle at ``source``, it is damaged, or ``target`` holds other
            files.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> with TemporaryDirectory() as root:
        ...     decoder = SynergyDecoder(1, 2)
        ...     run = save_bundle(decoder, f"{root}/a", task="toy", actuators=["x", "y"])
        ...     _, info = load_bundle(copy_bundle(run, f"{root}/b"))
        >>> info.task
        'toy'
    """
    files, target = bundle_files(source), Path(target).expanduser().resolve()
    if _find_folder(Path(source)) != target:
        replace_folder(replaceable_folder(target, BUNDLE_FILES, "a bundle", BundleError), files)
    return target


def bundle_files(path: str | os.PathLike[str]) -> dict[str, bytes]:
    """The contents of an undamaged bundle's files, by name.

    Raises:
        BundleError: if there is no bundle, or it is damaged.
    """
    load_bundle(path)
    folder = _find_folder(Path(path))
    return {name: (folder / name).read_bytes() for name in BUNDLE_FILES}


def _plain(value: Any, where: str) -> Any:
    """Convert ``value`` to JSON-serializable types."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):  # scalars and arrays of torch and numpy
        return _plain(value.tolist(), where)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    raise BundleError(
        f"{where} is a {type(value).__name__}, which JSON cannot hold; pass numbers, strings, "
        "lists or dicts."
    )


def _find_folder(path: Path) -> Path:
    for candidate in (path, path / "synergies"):
        folder = surviving_folder(candidate.expanduser().resolve())
        if (folder / DESCRIPTION).exists() or (folder / _TENSORS).exists():
            return folder
    raise BundleError(
        f"There is no synergy bundle at {str(path)!r}; pass the folder that holds {DESCRIPTION} "
        f"and {_TENSORS}, or a run folder with such a folder named synergies."
    )
