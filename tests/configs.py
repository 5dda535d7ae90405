"""Small configurations for tests of the training loop."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf

from torchrl_etl.command_line import translate
from torchrl_etl.training.resumed import parse_override
from torchrl_etl.user_conf import group_files

ROOT = Path(__file__).parent.parent
CONF = ROOT / "recipes" / "conf"

# Small networks on the analytic environment: a stage takes a second or two.
TINY = (
    "env=overactuated",
    "experiment=smoke",
    "learner=plain",
    "num_synergies=2",
    "collector.num_envs=4",
    "collector.frames_per_batch=32",
    "actor.hidden=[32,32]",
    "actor.layer_norm=true",
    "exploration.encoder.hidden=[32,32]",
    "synergies.hidden=[32,32]",
    "explore.batch_size=32",
    "explore.replay_ratio=0.0625",  # two updates a batch
    "learn.batch_size=32",
    "learn.replay_ratio=0.0625",
    "learn.reward_scale=0.1",
    "learn.sac.gamma=0.97",
    "learn.sac.alpha_init=0.1",
    "explore.fit.final_updates=20",
    "progress=false",
    "pictures=false",
    "threads=1",
)

ELBOW = "env=myoElbowPose1D6MFixed-v0"
# A short preparation, and small extra networks, of each method.
BRIEFLY = {
    "dep": ["method.options.dep_frames=64", "method.options.tau=4"],
    "dynsyn": ["method.options.frames=200"],
    "sar": [
        "method.options.frames=48",
        "method.options.rollout_frames=400",
        "method.options.num_synergies=3",
    ],
    "eme": ["method.options.hidden=[16]"],
}

# The options that learner=plain turns off.
RESIDUAL = (
    "actor.body=residual",
    "critic.body=residual",
    "learn.critic.bins=101",
    "learn.sac.return_bound=5",
    "learn.sac.normalize_observations=true",
    "learn.noise.kind=held",
)


def tiny(*overrides: str, name: str = "config") -> DictConfig:
    """The tiny configuration with overrides; settings that the chosen kinds lack are left out."""
    small = [setting for setting in TINY if _is_there(setting, overrides)]
    given = [parse_override(override) for override in translate(overrides, CONF)]
    kinds = [override for override in given if not _is_value(override)]
    config = deepcopy(_composed(name, *small, *(kind.input_line for kind in kinds)))
    for override in given:
        if override not in kinds:
            OmegaConf.update(config, override.key_or_group, override.value())
    return config


def composed(overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration that a recipe composes from Hydra's overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=list(overrides))


def rival(method: str, run: Path, *overrides: str) -> DictConfig:
    """A tiny configuration of a method on the elbow, with a short preparation, in folder `run`."""
    brief = BRIEFLY.get(method, [])
    return tiny(ELBOW, f"method={method}", "frames=608", f"run_dir='{run}'", *brief, *overrides)


def _is_value(override: Override) -> bool:
    """Whether an override changes the value of a setting, rather than choosing a file."""
    plain = override.type is OverrideType.CHANGE
    return plain and not (CONF / override.key_or_group).is_dir()


@cache  # composing takes a quarter of a second
def _composed(name: str, *overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(name, overrides=[*translate(overrides, CONF)])


def _is_there(setting: str, overrides: Sequence[str]) -> bool:
    section, _, key = setting.partition("=")[0].partition(".")
    given = {name: value for name, _, value in (o.partition("=") for o in overrides)}
    kind = given.get(section)
    if kind is None and (method := given.get("method")):  # a method may choose a kind
        for default in OmegaConf.load(group_files(CONF, "method")[method]).get("defaults", ()):
            kind = default.get(f"override /{section}", kind)
    if not key or (file := group_files(CONF, section).get(kind)) is None:
        return True
    return OmegaConf.select(OmegaConf.load(file), key) is not None
