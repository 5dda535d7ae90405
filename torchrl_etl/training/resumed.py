"""The configuration of a resumed run: its stored settings plus new overrides."""

from __future__ import annotations

import warnings
from collections.abc import Container, Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from torchrl_etl.extras import extra
from torchrl_etl.io import surviving_folder
from torchrl_etl.training.config import MAY_CHANGE, OPEN_SECTIONS, PRESETS, REMOVED, RENAMED

with extra("recipes"):
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import Override
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

__all__ = ["check_prefix", "parse_override", "resumed_config"]

# Every release has these sections, and the file ends with the last: a truncated file lacks it.
_SECTIONS = ("explore", "learn", "checkpoint", "collector", "method")
# Sections whose options depend on their ``kind``.
_OF_A_KIND = ("exploration", "synergies")


def resumed_config(
    folder: Path, overrides: Sequence[str] = (), *, defaults: DictConfig | None = None
) -> DictConfig:
    """The configuration of an earlier run with new overrides.

    Args:
        folder (path): the run folder.
        overrides (sequence of str): overrides in Hydra's syntax.

    Keyword Args:
        defaults (DictConfig, optional): values of settings that the run's release did not have; a
            warning names them.

    Raises:
        ValueError: if the folder holds no run, its configuration is damaged, or an override is
            unknown, not allowed in a resume, or for stage 1 after its end.
    """
    config = _stored(Path(folder) / "config.yaml")
    newer = {} if defaults is None else dict(_missing(config, defaults))
    for key, value in newer.items():
        OmegaConf.update(config, key, value, force_add=True)
    given = [override for override in overrides if not override.startswith("resume=")]
    parsed = [parse_override(override) for override in given]
    for override in parsed:
        _override(config, override, newer)
    keys = {override.key_or_group for override in parsed}
    over = surviving_folder(Path(folder) / "synergies").exists()
    if over and (late := sorted(key for key in keys if key.startswith("explore."))):
        raise ValueError(f"{folder} already has its synergies; leave {late[0]} out.")
    if {"frames", "learn.frames"} <= keys:
        raise ValueError("frames and learn.frames both set the budget; pass only one of them.")
    if "learn.frames" in keys:  # the setting given now takes precedence
        config.frames = None
    if taken := [f"{key}={value}" for key, value in newer.items() if key not in keys]:
        warnings.warn(
            f"{folder} is of a release without {', '.join(taken)}; these defaults are used.",
            stacklevel=2,
        )
    OmegaConf.set_struct(config, True)
    return config


def parse_override(override: str) -> Override:
    """Parse an argument as Hydra does.

    Raises:
        ValueError: if the argument is invalid, with a one-sentence message.
    """
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException as error:
        reason = f"{error}".splitlines()[0]
        raise ValueError(f"{override!r} is not of the form key=value ({reason}).") from error


def check_prefix(override: Override, known: bool) -> None:
    """Check the prefix of an override.

    Raises:
        ValueError: if the override deletes a setting, or adds one that exists.
    """
    key = override.key_or_group
    if override.is_delete():
        raise ValueError(f"~{key} would remove a setting that a run needs; give it a value.")
    if known and override.is_add() and not override.is_force_add():
        raise ValueError(f"+{key} is a setting that already exists; leave out the plus.")


def _stored(path: Path) -> DictConfig:
    if not path.is_file():
        raise ValueError(
            f"{path.parent} holds no run (there is no {path.name}); pass the folder that the first "
            "run printed."
        )
    try:
        config = OmegaConf.load(path)
        fault = _lacks(config)
    except (OSError, ValueError, YAMLError, OmegaConfBaseException) as error:
        fault = " ".join(str(error).split())
    if fault is not None:
        raise ValueError(
            f"{path} is damaged ({fault}); copy it from a backup of the run, or start a new run."
        )
    if "learner" in config.method:  # only the name has changed
        config.method.kind = config.method.pop("learner")
    if old := [key for key in RENAMED if OmegaConf.select(config, key) is not None]:
        raise ValueError(
            f"{path} is of a release in which settings had other names ({old[0]}, now "
            f"{RENAMED[old[0]]}); continue with that release, or start a new run."
        )
    for key, default in REMOVED.items():
        section, _, name = key.rpartition(".")
        value = (OmegaConf.select(config, section) or {}).pop(name, default)
        if value != default:
            raise ValueError(
                f"{path} has {key}={value}, which was removed; continue with the release that made "
                "it, or start a new run."
            )
    return config


def _lacks(config: Any) -> str | None:
    """The required settings that this configuration lacks, as text, or ``None``."""
    if not isinstance(config, DictConfig):
        return "it holds no settings"
    plain = OmegaConf.to_container(config)
    lost = [key for key in ("env", "seed") if key not in plain]
    lost += [key for key in _SECTIONS if not isinstance(plain.get(key), dict)]
    return f"it lacks {', '.join(lost)}" if lost else None


def _missing(config: DictConfig, defaults: DictConfig) -> Iterator[tuple[str, Any]]:
    """Settings that only ``defaults`` has, with their values; a missing section is one entry."""

    def walk(have: Any, want: Any, prefix: str) -> Iterator[tuple[str, Any]]:
        for key, value in want.items():
            if key not in have:
                yield f"{prefix}{key}", value
            elif prefix + key in _OF_A_KIND and have[key].get("kind") != value.get("kind"):
                continue  # options of another kind do not apply
            elif isinstance(value, dict) and isinstance(have[key], dict):
                yield from walk(have[key], value, f"{prefix}{key}.")

    return walk(OmegaConf.to_container(config), OmegaConf.to_container(defaults), "")


def _override(config: DictConfig, override: Override, newer: Container[str]) -> None:
    """Apply an override if it is valid and allowed in a resume."""
    key = override.key_or_group
    section, _, name = key.rpartition(".")
    parent = OmegaConf.select(config, section) if section else config
    known = isinstance(parent, DictConfig) and name in parent
    check_prefix(override, known)
    if (
        not known
        and key not in PRESETS
        and (not override.is_add() or key.split(".")[0] not in OPEN_SECTIONS)
    ):
        near = get_close_matches(key, [f"{section}.{k}".lstrip(".") for k in parent or ()], n=1)
        hint = f"did you mean {near[0]}?" if near else "see its config.yaml."
        raise ValueError(f"The run has no setting {key!r}; {hint}")
    if key not in newer and not any(f"{key}.".startswith(f"{may}.") for may in MAY_CHANGE):
        raise ValueError(
            f"{key} cannot be changed when a run is resumed, since its checkpoints were made "
            f"with another; start a new run for that. What may change: {', '.join(MAY_CHANGE)}."
        )
    OmegaConf.update(config, key, override.value(), force_add=True)
