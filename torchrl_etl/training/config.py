"""Checks of a configuration as a whole, and rules for resuming with changes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torchrl.record.loggers import Logger

from torchrl_etl.checks import (
    check_choice,
    check_flag,
    check_integer,
    check_real,
    check_sizes,
    renaming,
)
from torchrl_etl.collectors import COLLECTORS
from torchrl_etl.envs import resolve_task
from torchrl_etl.extras import extra
from torchrl_etl.user_code import find_class

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = [
    "MAY_CHANGE",
    "OPEN_SECTIONS",
    "PRESETS",
    "REMOVED",
    "RENAMED",
    "bfloat16_warning",
    "check_device",
    "quoted",
    "resume_setting",
    "split_seeds",
    "validate",
]

_LOGGERS = ("csv", "tensorboard", "wandb", "mlflow", "trackio")

RENAMED = {
    "explore.updates_per_frame": "explore.replay_ratio",
    "explore.redraw": "exploration.relabel",
    "explore.representation": "exploration",
    "explore.encoder": "exploration.encoder",
    "explore.encoder_lr": "exploration.lr",
    "explore.encoder_tau": "exploration.tau",
    "explore.direction": "exploration.direction",
    "explore.bonus": "exploration.bonus",
    "explore.metric": "exploration.metric",
    "explore.metra": "exploration.metra",
    "explore.gmvae": "synergies",
    "explore.fit.lr": "synergies.lr",
    "explore.fit.kl_weight": "synergies.kl_weight",
    "explore.fit.component_kl_weight": "synergies.component_kl_weight",
    "method.learner": "method.kind",
    "learn.updates_per_frame": "learn.replay_ratio",
    "learn.fine_tuning": "learn.decoder.fine_tuning",
    "learn.decoder_lr": "learn.decoder.lr",
    "learn.anchor": "learn.decoder.distillation_weight",
    "learn.residual": "learn.decoder.residual",
    "learn.reuse_exploration": "learn.prefill",
    "learn.sac.actor_average": "learn.sac.ema_decay",
    "learn.sac.n_steps": "learn.n_steps",
    "learn.sac.noise": "learn.noise.kind",
    "learn.sac.hold": "learn.noise",
}
"""Former names of settings, with their current names."""

REMOVED = {"explore.fit.best_share": 1.0, "learn.sac.unit_rows": False}
"""Former settings, each with its default: runs that had it go on without the setting."""

OPEN_SECTIONS = ("env_kwargs", "logger_kwargs", "ray", "distributed")
"""Sections whose keys are passed on to another library."""

PRESETS = {
    "learner": ("null", "residual"),
    "experiment": ("null", "laptop"),
    "faithful": ("null", "default"),
}
"""Groups of presets, with the values that select none: the current and the former one."""

_PLAIN = re.compile(r"[\w.-]*/[\w./-]*", re.ASCII)  # the slash rules out numbers, true and null

_OF_A_STAGE = (
    *("frames", "batch_size", "replay_ratio", "learning_starts"),
    *("buffer_size", "buffer_storage"),
)

MAY_CHANGE = (
    *("frames", "stage", "restart_seed", "device", "threads", "compile"),
    *("log", "logger_kwargs", "log_every", "progress", "pictures", "vaf_curve"),
    *("evaluation", "checkpoint", "ray", "distributed"),
    *(f"collector.{key}" for key in ("kind", "ahead", "timeout", "num_workers")),
    *(f"{stage}.{key}" for stage in ("explore", "learn") for key in _OF_A_STAGE),
    *("learn.sac.lr", "learn.sac.lr_end", "learn.decoder.lr", "explore.sac.lr"),
    "explore.fit.final_updates",
)
"""Settings and sections that may be changed when a run is resumed."""


def validate(config: DictConfig) -> None:
    """Check settings that concern the run as a whole.

    Constructors check the settings of their own components, before the first frame.

    Raises:
        ValueError: for the first invalid setting, with its key, its value and what is expected.
    """
    for name in ("env", "run_dir", "device"):
        if not isinstance(config[name], str) or not config[name]:
            raise ValueError(f"{name} is {config[name]!r}; it must be a string.")
    for name in ("env_kwargs", "logger_kwargs"):
        if not isinstance(config[name], Mapping):
            raise ValueError(
                f"{name} is {config[name]!r}; it must map names to values, such as "
                f"{name}={{NAME: VALUE}}."
            )
    for name, value in {"compile": config.compile, "learn.prefill": config.learn.prefill}.items():
        if value not in (None, True, False):
            raise ValueError(f"{name} is {value!r}; it must be true, false or null.")
    key = config.success_key
    if key is not None and (not isinstance(key, str) or not key):
        raise ValueError(f"success_key is {key!r}; it must name an entry of info, or be null.")
    _check_names(config)
    _check_values(config)
    check_choice("stage", config.stage, ("explore", "learn", "all"))
    check_choice("collector.kind", config.collector.kind, COLLECTORS)
    resolve_task(config.env, config.goal)
    _check_collector(config.collector)
    _check_loggers(config.log)
    check_device(config.device)


def _check_names(config: DictConfig) -> None:
    """Refuse former settings, which a YAML file of the user's own may still have."""
    with extra("recipes"):
        from omegaconf import OmegaConf
    for old in (*RENAMED, *REMOVED):
        section, _, name = old.rpartition(".")
        if name in (OmegaConf.select(config, section) or {}):
            now = f"is called {RENAMED[old]} now" if old in RENAMED else "was removed"
            raise ValueError(f"{old} {now}; change the file that sets it.")


def _check_values(config: DictConfig) -> None:
    with extra("recipes"):
        from omegaconf import OmegaConf

    def of(*keys: str) -> dict[str, Any]:
        return {key: OmegaConf.select(config, key) for key in keys}

    check_flag(**of("progress", "pictures", "collector.ahead"))
    for optional in ("frames", "threads", "num_synergies"):
        if config[optional] is not None:
            check_integer(1, **of(optional))
    check_integer(0, **of("seed", "restart_seed", "evaluation.every", "explore.fit.final_updates"))
    if config.seed >= 2**31:
        raise ValueError(f"seed is {config.seed}; it must be below 2147483648.")
    check_integer(1, **of("log_every", "evaluation.episodes", "checkpoint.every"))
    check_integer(1, **of("vaf_curve.updates"))
    check_integer(2, **of("checkpoint.keep"))
    check_sizes(**of("vaf_curve.dims"))
    workers = of("collector.num_envs", "collector.num_workers", "collector.frames_per_batch")
    check_integer(1, **workers)
    check_real("(0, inf)", **of("collector.timeout"))


def split_seeds(config: DictConfig) -> list[DictConfig]:
    """One configuration per entry of ``seeds``; the given configuration if ``seeds`` is null.

    Each run has the folder that it would have alone, or a subfolder ``seedN`` if ``run_dir`` does
    not depend on the seed. Only the first shows its progress.

    Raises:
        ValueError: if ``seeds`` is not a list of distinct integers.
    """
    if config.seeds is None:
        return [config]
    seeds = list(config.seeds) if isinstance(config.seeds, Sequence) else []
    if not seeds or len(set(seeds)) < len(seeds) or any(type(seed) is not int for seed in seeds):
        raise ValueError(
            f"seeds is {config.seeds}; it must be a list of different whole numbers, such as "
            "seeds=[0,1,2]."
        )
    configs = []
    for seed in seeds:
        own = config.copy()
        own.seeds, own.seed = None, seed
        own.progress = config.progress and seed == seeds[0]
        own.run_dir = own.run_dir  # resolves ${now}, which would change later
        configs.append(own)
    if len({own.run_dir for own in configs}) < len(configs):
        for own in configs:
            own.run_dir = f"{own.run_dir}/seed{own.seed}"
    return configs


def quoted(value: str) -> str:
    """Quote a value so that Hydra reads it literally, also in a list.

    Examples:
        >>> from torchrl_etl.training.resumed import parse_override
        >>> parse_override(f"run_dir={quoted('runs/a, (new)')}").value()
        'runs/a, (new)'
    """
    with extra("recipes"):
        from hydra.core.override_parser.types import Quote, QuotedString
    return QuotedString(value, Quote.single).with_quotes()


def resume_setting(folders: Sequence[Path]) -> str:
    """The ``resume=`` setting that resumes the runs in these folders.

    Hydra needs quotation marks around names with special characters. For a single folder, recipes
    add them (:func:`~torchrl_etl.command_line.quote_paths`).

    Examples:
        >>> resume_setting([Path("runs/a"), Path("my runs/b")])
        "resume=[runs/a,'my runs/b']"
    """
    names = [str(folder) for folder in folders]
    if len(names) == 1:
        return f"resume={names[0]}"
    return (
        f"resume=[{','.join(name if _PLAIN.fullmatch(name) else quoted(name) for name in names)}]"
    )


def bfloat16_warning(config: DictConfig) -> str | None:
    """A warning if bodies use bfloat16 on a CPU without instructions for it, where PyTorch emulates
    its products; ``None`` otherwise.
    """
    sections = (config.explore, config.learn)
    bodies = {of.body for section in sections for of in (section.actor, section.critic)}
    if "residual_bfloat16" not in bodies or torch.device(config.device).type != "cpu":
        return None
    has = torch.cpu.get_capabilities()
    if any(has.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16")):
        return None
    return (
        "this processor has no bfloat16 instructions, so body=residual_bfloat16 is slower than "
        "body=residual, the same in float32."
    )


def _check_collector(collector: DictConfig) -> None:
    # All workers contribute to a batch with "process"; else a batch comes from one worker.
    workers = collector.num_workers if collector.kind == "process" else 1
    if collector.frames_per_batch % (workers * collector.num_envs):
        raise ValueError(
            f"collector.frames_per_batch is {collector.frames_per_batch}, but a batch comes from "
            f"{workers} x {collector.num_envs} environments (workers x collector.num_envs); it "
            "must be a multiple of their number, as each gives the same number of frames."
        )
    if collector.kind == "ray" and find_spec("ray") is None:
        raise ValueError(
            "collector.kind is 'ray', which is not installed; pip install 'torchrl_etl[ray]'."
        )


def _check_loggers(names: object) -> None:
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise ValueError(f"log is {names!r}; it must be a list, such as [tensorboard].")
    for name in names:
        if ":" in str(name):
            with renaming(kind="log"):
                find_class(name, {}, Logger)
            continue
        check_choice("log", name, _LOGGERS)
        if name != "csv" and find_spec(name) is None:
            raise ValueError(f"log names {name}, which is not installed; pip install {name}.")


def check_device(name: str) -> None:
    """Raise a ``ValueError`` unless this device is valid and available."""
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {name!r}; use cpu, cuda or cuda:0.")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device is {name!r} but no CUDA device is available; use device=cpu.")
