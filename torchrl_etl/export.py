"""Exports a run as an entry of the zoo."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from torchrl_etl.experiment import Experiment
from torchrl_etl.extras import extra
from torchrl_etl.io import surviving_folder
from torchrl_etl.learners import SACLearner
from torchrl_etl.training import evaluate_task, resumed_config
from torchrl_etl.training.config import quoted
from torchrl_etl.training.resumed import parse_override
from torchrl_etl.user_conf import group_files
from torchrl_etl.zoo import Card, describe_decoder, make_policy, save_entry

with extra("recipes"):
    from omegaconf import DictConfig, OmegaConf

__all__ = ["command_of", "describe_policy", "export_run", "rebuilt"]

Compose = Callable[[Sequence[str]], DictConfig]

_GROUPS = {
    "method": "method.name",
    "exploration": "exploration.kind",
    "synergies": "synergies.kind",
    "collector": "collector.kind",
}
"""Groups of the configuration, and the setting that identifies the chosen file."""

# Settings left out of the command: location, display, resources, and the path of a bundle.
_OF_THE_PLACE = (
    *("run_dir", "resume", "log", "logger_kwargs", "log_every", "progress", "pictures"),
    *("seeds", "threads", "vaf_curve", "synergies.bundle", "ray", "distributed"),
)


def export_run(
    run: Path, target: Path, compose: Compose, groups: Path, *, episodes: int = 50
) -> Card:
    """Evaluate the policy of a run and write it as an entry of the zoo; returns its card.

    The evaluated policy is rebuilt from the card.

    Args:
        run (path): the run folder.
        target (path): the entry's folder, whose name becomes the entry's.
        compose (callable): composes a configuration from Hydra's overrides.
        groups (path): the folder of the configuration's groups.

    Keyword Args:
        episodes (int): number of evaluation episodes.

    Raises:
        FileNotFoundError: if the run has no checkpoint of the learning stage.
        ValueError: if there is no run, it is from a release with other setting names, or an entry
            cannot hold its policy.
    """
    trained = resumed_config(run, defaults=compose([]))
    device, trained.device = trained.device, "cpu"  # where the entry is evaluated
    experiment = Experiment(trained, resume=run)
    stage = experiment.learned()
    learner, context = stage.learner, experiment.context
    described = describe_policy(experiment, learner)
    policy = rebuilt(learner.policy, described)
    with closing(context.make_env()) as env:
        result = evaluate_task(policy, env, context.task, episodes=episodes)
    start = (experiment.folder.versions or [{}])[-1]
    start.pop("saved", None)
    experiment.config.device = device  # for the command
    card = Card(
        task={**context.task, "goal": experiment.task.goal},
        actuators=list(context.spec.actuators),
        policy=described,
        training={
            "method": experiment.config.method.name,
            "frames": experiment.method.frames_before() + stage.frames,
            "seed": experiment.config.seed,
            "commit": start.pop("commit", None),
            "versions": start,
            "command": command_of(experiment.config, compose, groups, target.name),
        },
        evaluation=result.summary(),
    )
    has_bundle = surviving_folder(experiment.folder.synergies).exists()
    save_entry(target, policy, card, bundle=experiment.folder.synergies if has_bundle else None)
    return card


def describe_policy(experiment: Experiment, learner: SACLearner) -> dict[str, Any]:
    """Arguments of :func:`~torchrl_etl.zoo.make_policy` for the policy of a run's learner.

    Raises:
        ValueError: if an entry cannot hold its decoder.
    """
    spec, options = experiment.context.spec, experiment.context.options("learn")["actor"]
    return {
        "observation_dim": spec.observation_dim,
        "low": spec.low.tolist(),
        "high": spec.high.tolist(),
        "actor": {**experiment.method.actor(), **options},
        "decoder": describe_decoder(learner.decoder),
        "normalize_observations": learner.objective.normalizer is not None,
    }


def rebuilt(policy: TensorDictModuleBase, described: dict[str, Any]) -> TensorDictModuleBase:
    """A policy built from the description, with the weights of ``policy``.

    Raises:
        ValueError: if the description does not match ``policy``.
    """
    again = make_policy(**described)
    try:
        again.load_state_dict(policy.state_dict())
    except RuntimeError as error:
        raise ValueError(
            "The zoo cannot rebuild the policy of this run "
            f"({' '.join(str(error).split())[:200]}); its method must describe its actor."
        ) from error
    return again.to(torch.device("cpu"))


def command_of(config: DictConfig, compose: Compose, groups: Path, name: str) -> str:
    """The command that gives this configuration, without settings of location and display. If the
    run was given synergies, the command uses those of the entry ``name``.
    """
    chosen: list[str] = []
    unread = set()
    for group, key in _GROUPS.items():
        kind = OmegaConf.select(config, key)
        if kind is None:  # nothing was explored, or fitted
            unread.add(group)
        if kind is None or OmegaConf.select(compose(chosen), key) == kind:
            continue
        files = group_files(groups, group).items()
        chosen += [f"{group}={choice}" for choice, file in files if _says(file, key) == kind][:1]
    base, mine = (OmegaConf.to_container(of) for of in (compose(chosen), config))
    words = [f"env={config.env}", *chosen]
    if config.synergies.bundle is not None:
        words.append(f"synergies=zoo:{name}")
    shared = "learn.frames" if config.frames is not None else None  # follows from frames
    for key, value in _differences(base, mine):
        if key not in ("env", shared) and key.partition(".")[0] not in unread:
            words.append(f"{key}={value}")
    return shlex.join(["python", "recipes/etl_sac.py", *words])


def _says(file: Path, key: str) -> Any:
    """The value of a setting in a group's file, under its full or its short key."""
    with suppress(Exception):  # files that are not chosen may hold anything
        content = OmegaConf.load(file)
        return OmegaConf.select(content, key, default=content.get(key.rpartition(".")[2]))
    return None


def _differences(base: dict, mine: dict, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Settings of ``mine`` that differ from ``base``, as Hydra's overrides."""
    for key, value in mine.items():
        path = f"{prefix}{key}"
        if path in _OF_THE_PLACE:
            continue
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            yield from _differences(base[key], value, f"{path}.")
        elif key not in base:
            yield f"+{path}", _in_words(value)
        elif base[key] != value:
            yield path, _in_words(value)


def _in_words(value: Any) -> str:
    """A value in Hydra's grammar."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, list):
        return f"[{','.join(map(_in_words, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_in_words(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str) and not _reads_as_itself(value):
        return quoted(value)
    return str(value)


def _reads_as_itself(text: str) -> bool:
    """Whether Hydra parses the unquoted text as this string, not as a number or a list."""
    with suppress(ValueError):
        return parse_override(f"word={text}").value() == text
    return False
