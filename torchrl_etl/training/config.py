"""What a configuration must satisfy before anything is built."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf

from torchrl_etl.collectors import COLLECTORS
from torchrl_etl.envs import resolve_task
from torchrl_etl.modules.actor_critic import Body
from torchrl_etl.modules.checks import check_choice
from torchrl_etl.training.methods import METHODS

__all__ = ["resumed_config", "validate"]

_CHOICES = {
    "collector.kind": COLLECTORS,
    "method.learner": ("etl", *METHODS),
    "stage": ("explore", "learn", "all"),
    "explore.fit.actions": ("policy", "mean", "sampled", "activation"),
    "explore.representation": ("metric", "metra"),
    "explore.buffer_storage": ("memory", "memmap"),
    "learn.buffer_storage": ("memory", "memmap"),
    "learn.fine_tuning": ("critic", "reconstruction", "frozen"),
    "learn.sac.noise": ("independent", "held"),
    **{
        f"{section}{network}.body": get_args(Body)
        for section in ("", "explore.", "learn.")
        for network in ("actor", "critic")
    },
}
_LOGGERS = ("csv", "tensorboard", "wandb", "mlflow", "trackio")


def _both(*keys: str) -> tuple[str, ...]:
    return tuple(f"{stage}.{key}" for stage in ("explore", "learn") for key in keys)


def _integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _real(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _widths(value: Any) -> bool:
    return (
        isinstance(value, ListConfig) and bool(value) and all(_integer(w) and w > 0 for w in value)
    )


# What is expected, in words; whether a value is that; the keys that must be.
_Rule = tuple[str, Callable[[Any], bool], tuple[str, ...]]
_RULES: tuple[_Rule, ...] = (
    ("a text", lambda v: isinstance(v, str) and v != "", ("env", "run_dir", "device")),
    (
        "true or false",
        lambda v: isinstance(v, bool),
        (
            "progress",
            "pictures",
            "collector.ahead",
            "learn.reuse_exploration",
            "learn.sac.normalize_observations",
            "learn.sac.unit_rows",
            "explore.bonus.normalize",
            "explore.metric.delay_encoder",
            "actor.layer_norm",
            "critic.layer_norm",
            *_both("actor.layer_norm", "critic.layer_norm"),
        ),
    ),
    ("true, false or null", lambda v: v is None or isinstance(v, bool), ("compile",)),
    (
        "a whole number above 0",
        lambda v: _integer(v) and v > 0,
        (
            "action_repeat",
            "collector.num_envs",
            "collector.num_workers",
            "collector.frames_per_batch",
            "log_every",
            "evaluation.episodes",
            "checkpoint.every",
            "vaf_curve.updates",
            "learn.critic.bins",
            "learn.sac.hold.longest",
            "learn.sac.n_steps",
            "learn.sac.num_critics",
            *_both("frames"),
        ),
    ),
    (
        "a whole number above 1",
        lambda v: _integer(v) and v > 1,
        ("checkpoint.keep", *_both("batch_size", "buffer_size")),
    ),
    (
        "a whole number from 0 to 2147483647",
        lambda v: _integer(v) and 0 <= v < 2**31,
        (
            "seed",
            "evaluation.every",
            "explore.fit.final_updates",
            "learn.init_random_frames",
            *_both("learning_starts"),
        ),
    ),
    (
        "a whole number above 0 or null",
        lambda v: v is None or (_integer(v) and v > 0),
        (
            "num_synergies",
            "frames",
            "threads",
            "explore.encoder.embedding_dim",  # num_synergies, unless it is set
            "explore.gmvae.num_components",
            "explore.direction.num_directions",
        ),
    ),
    (
        "a number above 0",
        lambda v: _real(v) and 0 < v < 1e9,
        (
            "collector.timeout",
            "explore.encoder_lr",
            "explore.metra.epsilon",
            "explore.metra.lambda_init",
            "explore.fit.lr",
            "learn.decoder_lr",
            "learn.sac.hold.exponent",
            "explore.metric.epsilon",
            "explore.metric.margin",
            *_both("updates_per_frame", "reward_scale"),
            *_both("sac.lr", "sac.alpha_init"),
        ),
    ),
    (
        "a number above 0 or null",
        lambda v: v is None or (_real(v) and v > 0),
        (*_both("sac.action_std"), "learn.sac.return_bound"),
    ),
    (
        "a number 0 or more",
        lambda v: _real(v) and v >= 0,
        (
            "learn.anchor",
            "explore.metric.weight",
            "explore.bonus.extrinsic_weight",
            "explore.fit.kl_weight",
            "explore.fit.component_kl_weight",
        ),
    ),
    (
        "a share in (0, 1]",
        lambda v: _real(v) and 0 < v <= 1,
        ("explore.fit.best_share", "explore.encoder_tau", *_both("sac.tau")),
    ),
    (
        "a share in [0, 1]",
        lambda v: _real(v) and 0 <= v <= 1,
        ("explore.redraw", "learn.residual", "learn.sac.lr_end"),
    ),
    (
        "a share in [0, 1)",
        lambda v: _real(v) and 0 <= v < 1,
        (
            "explore.bonus.decay",
            "explore.metric.gamma",
            "learn.sac.actor_average",
            *_both("sac.gamma"),
        ),
    ),
    (
        "a list of whole numbers above 0",
        _widths,
        (
            "actor.hidden",
            "critic.hidden",
            "explore.encoder.hidden",
            "explore.gmvae.hidden",
            "vaf_curve.dims",
            *_both("actor.hidden", "critic.hidden"),
        ),
    ),
)


def validate(config: DictConfig) -> None:
    """Check a configuration; the first fault raises one sentence that says how to mend it.

    Raises:
        ValueError: naming the key, what came and what is expected.
    """
    for words, holds, keys in _RULES:
        for key in keys:
            value = OmegaConf.select(config, key)
            if not holds(value):
                raise ValueError(f"{key} is {value!r}; it must be {words}.")
    for key, choices in _CHOICES.items():
        check_choice(key, OmegaConf.select(config, key), choices)
    resolve_task(config.env, config.goal)
    _check_collector(config.collector)
    if config.method.learner != "etl" and (config.stage != "all" or config.synergies is not None):
        raise ValueError(
            f"method={config.method.name} has one stage and no synergies; leave stage and "
            "synergies out."
        )
    if config.learn.critic.bins > 1 and config.learn.sac.return_bound is None:
        raise ValueError(
            f"learn.critic.bins is {config.learn.critic.bins}, which needs a bound on returns; "
            "give learn.sac.return_bound=5 or the like."
        )
    fit = config.explore.fit
    if fit.best_share < 1 and fit.actions == "policy":
        raise ValueError(
            f"explore.fit.best_share is {fit.best_share}, a share by reward, but the actions of "
            "explore.fit.actions=policy are such as nobody took; use explore.fit.actions=mean."
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
    _check_loggers(config.log)
    _check_device(config.device)


def resumed_config(folder: Path, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of an earlier run, with the overrides given now on top.

    Raises:
        ValueError: if the folder holds no run, or an override would make it another run.
    """
    path = Path(folder) / "config.yaml"
    if not path.is_file():
        raise ValueError(
            f"{folder} holds no run (there is no {path.name}); pass the folder that the first run "
            "printed."
        )
    given = [override for override in overrides if not override.startswith("resume=")]
    for override in given:
        key = override.partition("=")[0].lstrip("+~")
        if key in _FIXED or any(part in key.split(".") for part in _FIXED_SECTIONS):
            raise ValueError(
                f"{key} cannot be changed when a run is resumed, since its checkpoints were made "
                "with another; start a new run for that."
            )
    config = OmegaConf.load(path)
    OmegaConf.set_struct(config, True)
    return OmegaConf.merge(config, OmegaConf.from_dotlist(given))


# What the shapes of networks, or the meaning of their weights, depend on.
_FIXED = ("env", "goal", "action_repeat", "seed", "num_synergies", "synergies", "run_dir")
_FIXED += ("learn.sac.num_critics", "learn.residual", "learner", "experiment", "faithful")
_FIXED += ("learn.reuse_exploration", "collector")  # the group; collector.kind may change
_FIXED_SECTIONS = (
    "method",
    "actor",
    "critic",
    "encoder",
    "gmvae",
    "direction",
    "metric",
    "metra",
    "representation",
)


def _check_collector(collector: DictConfig) -> None:
    # A batch comes from all workers, or from one of them.
    workers = collector.num_workers if collector.kind == "process" else 1
    if collector.frames_per_batch % (workers * collector.num_envs):
        raise ValueError(
            f"collector.frames_per_batch is {collector.frames_per_batch} and a batch comes from "
            f"{workers} x {collector.num_envs} environments (workers x collector.num_envs); it "
            "must be a multiple of their number, since every environment gives as many frames."
        )
    if collector.kind == "ray" and find_spec("ray") is None:
        raise ValueError(
            "collector.kind is 'ray', which is not installed; pip install 'ray>=2.50'."
        )


def _check_loggers(names: object) -> None:
    if not isinstance(names, ListConfig):
        raise ValueError(f"log is {names!r}; it must be a list, such as [tensorboard].")
    for name in names:
        check_choice("log", name, _LOGGERS)
        if name != "csv" and find_spec(name) is None:
            raise ValueError(f"log names {name}, which is not installed; pip install {name}.")


def _check_device(name: str) -> None:
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {name!r}; use cpu, cuda or cuda:0.")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device is {name!r} but no CUDA device is available; use device=cpu.")
