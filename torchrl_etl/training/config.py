"""What a configuration must satisfy before anything is built."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_etl.envs import resolve_task

__all__ = ["resumed_config", "validate"]

_CHOICES = {
    "stage": ("explore", "learn", "all"),
    "explore.fit.actions": ("mean", "sampled", "activation"),
    "learn.fine_tuning": ("critic", "reconstruction", "frozen"),
}
_POSITIVE = (
    "num_synergies",
    "collector.num_envs",
    "collector.frames_per_batch",
    "evaluation.episodes",
    "checkpoint.every",
    "log_every",
    *(
        f"{stage}.{key}"
        for stage in ("explore", "learn")
        for key in ("frames", "batch_size", "buffer_size", "updates_per_frame")
    ),
)
_NOT_NEGATIVE = ("seed", "evaluation.every", "explore.learning_starts", "learn.learning_starts")


def validate(config: DictConfig) -> None:
    """Check a configuration; the first fault raises one sentence that says how to mend it.

    Raises:
        ValueError: naming the key, what came and what is expected.
    """
    resolve_task(config.env, config.goal)
    for key, choices in _CHOICES.items():
        check_choice(key, _get(config, key), choices)
    for key in _POSITIVE:
        _check_number(key, _get(config, key), least="above 0", fine=lambda value: value > 0)
    for key in _NOT_NEGATIVE:
        _check_number(key, _get(config, key), least="0 or more", fine=lambda value: value >= 0)
    if config.checkpoint.keep < 2:
        raise ValueError(
            f"checkpoint.keep is {config.checkpoint.keep}; keep at least 2, so that one is whole "
            "while the other is being written."
        )
    if not 0 < config.explore.fit.best_share <= 1:
        raise ValueError(
            f"explore.fit.best_share is {config.explore.fit.best_share}; it is a share of the "
            "batch and must lie in (0, 1]."
        )
    if config.collector.frames_per_batch % config.collector.num_envs:
        raise ValueError(
            f"collector.frames_per_batch is {config.collector.frames_per_batch} and "
            f"collector.num_envs is {config.collector.num_envs}; the first must be a multiple of "
            "the second, since every environment gives as many frames."
        )
    if config.stage == "learn" and config.synergies is None:
        raise ValueError(
            "stage=learn needs synergies=PATH, the run folder or bundle of an earlier exploration; "
            "use stage=all to explore first."
        )
    if config.stage == "explore" and config.synergies is not None:
        raise ValueError(
            f"stage=explore finds synergies, but synergies={config.synergies} was given; leave it "
            "out or use stage=learn."
        )
    for name in config.log:
        check_choice("log", name, ("csv", "tensorboard", "wandb", "mlflow", "trackio"))
    _check_device(config.device)


def resumed_config(folder: Path, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of an earlier run, with the overrides given now on top.

    Raises:
        ValueError: if the folder holds no run, or an override swaps a whole group.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise ValueError(
            f"resume={folder} holds no run (there is no {path.name}); pass the folder that the "
            "first run printed."
        )
    given = [override for override in overrides if not override.startswith("resume=")]
    for group in ("experiment", "faithful"):
        if any(override.startswith(f"{group}=") for override in given):
            raise ValueError(
                f"{group}= cannot be changed when a run is resumed; override single values instead."
            )
    config = OmegaConf.load(path)
    OmegaConf.set_struct(config, True)
    return OmegaConf.merge(config, OmegaConf.from_dotlist(given))


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Raise a ``ValueError`` that names the nearest choice.

    Examples:
        >>> check_choice("stage", "lern", ("explore", "learn", "all"))
        Traceback (most recent call last):
        ...
        ValueError: stage is 'lern'; choose one of explore, learn, all (nearest: learn).
    """
    if value not in choices:
        near = difflib.get_close_matches(str(value), choices, n=1)
        hint = f" (nearest: {near[0]})" if near else ""
        raise ValueError(f"{name} is {value!r}; choose one of {', '.join(choices)}{hint}.")


def _get(config: DictConfig, key: str) -> object:
    for part in key.split("."):
        config = config[part]
    return config


def _check_number(name: str, value: object, *, least: str, fine: object) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not fine(value):
        raise ValueError(f"{name} is {value!r}; it must be a number {least}.")


def _check_device(name: str) -> None:
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"device is {name!r}; use cpu, cuda or cuda:0.") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device is {name!r} but no CUDA device is available; use device=cpu.")
