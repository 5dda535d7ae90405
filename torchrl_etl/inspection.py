"""Opens runs, bundles and zoo entries for the viewer: their policies and synergies."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig
from torchrl.checkpoint import Checkpoint

from torchrl_etl import zoo
from torchrl_etl.analysis.viewer import Subject
from torchrl_etl.envs import EnvironmentSpec, make_env, resolve_task
from torchrl_etl.envs.tasks import Goal
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies import BundleError, check_compatible, load_bundle
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.evaluation import EVALUATION_SEED, longest_episode
from torchrl_etl.training.resumed import resumed_config
from torchrl_etl.user_code import check_imported

__all__ = ["open_bundle", "open_run", "open_zoo"]


def open_run(run: Path, *, defaults: DictConfig | None = None) -> Subject:
    """The policies and synergies of a run. Episode 0 is its first evaluation episode.

    Args:
        run (path): the run folder.

    Keyword Args:
        defaults (DictConfig, optional): see :func:`~torchrl_etl.training.resumed_config`.

    Raises:
        ValueError: if the folder holds no run, or the run has neither policy nor synergies yet.
    """
    experiment = Experiment(resumed_config(run, ["device=cpu"], defaults=defaults), resume=run)
    context, task = experiment.context, experiment.task
    subject = Subject(
        str(run),
        task,
        lambda goal: context.make_env(name=task.name, goal=goal),  # an id would fix the goal
        context.spec.actuators,
        episode_steps=math.ceil(longest_episode(context.task) / context.config.action_repeat),
        first_seed=EVALUATION_SEED,
        action_repeat=context.config.action_repeat,
    )
    subject = _with_explorer(_with_policy(subject, experiment), experiment)
    if not subject.drivers:
        raise ValueError(
            f"{run} has neither a policy (no complete checkpoint of a stage) nor synergies; view "
            "a run that has saved its first checkpoint."
        )
    return subject


def open_bundle(bundle: Path, env: str | None = None, *, goal: Goal | None = None) -> Subject:
    """The synergies of a bundle on a body.

    Opening a bundle imports no user module. Pass a task of your own as ``env``.

    Args:
        bundle (path): the bundle's folder, or a run folder.
        env (str, optional): a task with the same body. Default: the task of its exploration.

    Keyword Args:
        goal (str, optional): see :func:`~torchrl_etl.envs.resolve_task`.

    Raises:
        BundleError: if there is no bundle, it is for another body, or its task is from a module
            that has not been imported.
        ValueError: if there is no such task.
    """
    decoder, info = load_bundle(bundle)
    if env is None:
        remedy = f"pass env={info.task} yourself if you trust it"
        check_imported(info.task, f"The task of {bundle}", BundleError, remedy)
        env = info.task
        try:
            resolve_task(env)
        except ValueError as error:  # of a recording, say
            raise BundleError(
                f"The bundle {bundle} is of {info.task!r}, which is not a known task; pass "
                "env=TASK, a task of the same body."
            ) from error
    task = resolve_task(env, goal)
    with closing(make_env(env, goal=goal)) as simulator:
        spec = EnvironmentSpec.of(simulator)
    check_compatible(info, spec.actuators, spec.low, spec.high)
    return Subject(
        str(bundle),
        task,
        lambda goal: make_env(task.name, goal=goal),
        spec.actuators,
        decoder=decoder,
        episode_steps=task.episode_steps,
        first_seed=EVALUATION_SEED,
    )


def open_zoo(name: str, env: str | None = None) -> Subject:
    """The policy of a zoo entry, and its synergies if it has any.

    Synergies without a policy are shown on the task of their exploration.

    Args:
        name (str): an entry, see :func:`torchrl_etl.zoo.find`.
        env (str, optional): the entry's task; required if it is from a module of your own.

    Raises:
        ZooError: if there is no such entry, or its policy is damaged.
        BundleError: if its synergies are damaged, see :func:`open_bundle`.

    Examples:
        >>> from torchrl_etl.inspection import open_zoo
        >>> open_zoo("overactuated").drivers[0]
        'policy'
    """
    if zoo.synergies_alone(name):
        return replace(open_bundle(zoo.synergies(name), env), name=f"zoo={name}")
    if env is not None:
        zoo.trust(name, env)
    card = zoo.read_card(name)
    policy, simulator = zoo.load(name)
    simulator.close()
    of_task = dict(card.task)
    task = resolve_task(of_task.pop("name"), of_task.pop("goal", None))
    action_repeat = of_task.get("action_repeat", 1)
    return Subject(
        f"zoo={name}",
        task,
        lambda goal: make_env(task.name, goal=goal, **of_task),
        card.actuators,
        decoder=next((part for part in policy.modules() if isinstance(part, SynergyMap)), None),
        policy=policy,
        episode_steps=math.ceil(longest_episode(card.task) / action_repeat),
        first_seed=EVALUATION_SEED,
        action_repeat=action_repeat,
    )


def _with_policy(subject: Subject, experiment: Experiment) -> Subject:
    """Adds the learned policy and its decoder."""
    folder = _newest(experiment, "learn")
    if folder is None:
        return replace(subject, decoder=experiment.method.decoder())
    learner = experiment.method.stage().learner
    Checkpoint(policy=learner.policy).load(folder)
    return replace(subject, policy=learner.policy, decoder=learner.decoder)


def _with_explorer(subject: Subject, experiment: Experiment) -> Subject:
    """Adds the policy of stage 1, if the run explored."""
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
