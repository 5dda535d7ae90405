"""Runs, bundles and entries of the zoo opened to be looked at: what in them can move a body."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

from omegaconf import DictConfig
from torchrl.checkpoint import Checkpoint

from torchrl_etl import zoo
from torchrl_etl.analysis.viewer import Subject
from torchrl_etl.envs import EnvironmentSpec, make_env, resolve_task
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies import check_compatible, load_bundle
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.evaluation import EVALUATION_SEED, longest_episode
from torchrl_etl.training.resumed import resumed_config

__all__ = ["open_bundle", "open_run", "open_zoo"]


def open_run(run: Path, *, defaults: DictConfig | None = None) -> Subject:
    """The policies and the synergies of a run; episode 0 is the first that it is evaluated on.

    Args:
        run (path): the run folder.

    Keyword Args:
        defaults (DictConfig, optional): see :func:`~torchrl_etl.training.resumed_config`.

    Raises:
        ValueError: if the folder holds no run, or nothing yet that would move a body.
    """
    experiment = Experiment(resumed_config(run, ["device=cpu"], defaults=defaults), resume=run)
    context = experiment.context
    subject = Subject(
        str(run),
        experiment.task,
        lambda goal: context.make_env(goal=goal),
        context.spec.actuators,
        episode_steps=math.ceil(longest_episode(context.task) / context.config.action_repeat),
        first_seed=EVALUATION_SEED,
    )
    subject = _with_explorer(_with_policy(subject, experiment), experiment)
    if not subject.drivers:
        raise ValueError(
            f"{run} holds neither a policy (no whole checkpoint of a stage) nor synergies; view a "
            "run that has saved its first checkpoint."
        )
    return subject


def open_bundle(bundle: Path, env: str | None = None, *, goal: str | None = None) -> Subject:
    """The synergies of a bundle on a body.

    Args:
        bundle (path): the bundle's folder, or a run folder.
        env (str, optional): a task of the body. Default: the one that the bundle was explored on.

    Keyword Args:
        goal (str, optional): see :func:`~torchrl_etl.envs.resolve_task`.

    Raises:
        BundleError: if there is no bundle, or it is of another body.
        ValueError: if there is no such task.
    """
    decoder, info = load_bundle(bundle, residual=0.0)
    task = resolve_task(env or info.task, goal)
    make = partial(make_env, env or info.task)
    spec = EnvironmentSpec.of(make(goal=goal))
    check_compatible(info, spec.actuators, spec.low, spec.high)
    return Subject(
        str(bundle),
        task,
        lambda goal: make(goal=goal),
        spec.actuators,
        decoder=decoder,
        episode_steps=task.episode_steps,
        first_seed=EVALUATION_SEED,
    )


def open_zoo(name: str) -> Subject:
    """The policy of an entry of the zoo, and its synergies where it acts through some.

    An entry of synergies alone is shown on the task that they were explored on.

    Args:
        name (str): an entry, see :func:`torchrl_etl.zoo.find`.

    Raises:
        ZooError: if there is no such entry, or it is damaged.

    Examples:
        >>> from torchrl_etl.opened import open_zoo
        >>> open_zoo("overactuated").drivers[0]
        'policy'
    """
    if name in zoo.names() and name not in zoo.names(trained=True):
        return open_bundle(zoo.synergies(name))
    card = zoo.read_card(name)
    policy, env = zoo.load(name)
    env.close()
    of_task = dict(card.task)
    built, goal = of_task.pop("name"), of_task.pop("goal", None)
    return Subject(
        f"zoo={name}",
        resolve_task(built, goal),
        lambda goal: make_env(built, goal=goal, **of_task),
        card.actuators,
        decoder=next((part for part in policy.modules() if isinstance(part, SynergyMap)), None),
        policy=policy,
        episode_steps=math.ceil(longest_episode(card.task) / of_task.get("action_repeat", 1)),
        first_seed=EVALUATION_SEED,
    )


def _with_policy(subject: Subject, experiment: Experiment) -> Subject:
    """With the policy that learned the task, and the decoder that it acts through."""
    if _newest(experiment, "learn") is not None:
        learner = experiment.learned().learner
        return replace(subject, policy=learner.policy, decoder=learner.decoder)
    return replace(subject, decoder=experiment.method.decoder())


def _with_explorer(subject: Subject, experiment: Experiment) -> Subject:
    """With stage 1's policy, if the run explored."""
    folder = _newest(experiment, "explore")
    explorer = None if folder is None else experiment.method.explorer()
    if explorer is None:
        return subject
    policy = explorer.stage.learner.policy
    Checkpoint(policy=policy).load(folder)
    size = explorer.exploration.inputs.get("direction", 0)
    return replace(subject, explorer=policy, direction_dim=size)


def _newest(experiment: Experiment, stage: str) -> Path | None:
    return Checkpoints(experiment.folder.checkpoints(stage), keep_last=2).newest_whole()
