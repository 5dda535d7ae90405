"""Evaluate a run or an entry of the zoo on fixed seeds: return and success, with intervals.

    python recipes/evaluate.py run=runs/NAME episodes=50 video=true
    python recipes/evaluate.py zoo=NAME

All settings with their defaults:
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from omegaconf import DictConfig

from torchrl_etl.gl_backend import draw_without_display

if "video=true" in map(str.lower, sys.argv[1:]):
    draw_without_display()
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_etl import zoo
from torchrl_etl.analysis.animation import write_animation
from torchrl_etl.checks import check_flag, check_integer, check_path, check_real
from torchrl_etl.command_line import (
    OPENING_ERRORS,
    check_overrides,
    exit_on_error,
    print_intervals,
    quiet_torchrl,
    quote_paths,
)
from torchrl_etl.envs import SimulationError, resolve_task
from torchrl_etl.experiment import Experiment
from torchrl_etl.io import as_json, write_atomically
from torchrl_etl.training import (
    EpisodeRecorder,
    Evaluation,
    check_device,
    check_video_size,
    evaluate_task,
    resumed_config,
)

CONF = Path(__file__).parent / "conf"


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    quiet_torchrl()
    with exit_on_error(*OPENING_ERRORS):
        check_path(run=config.run, zoo=config.zoo)
        check_integer(1, episodes=config.episodes)
        check_flag(video=config.video, video_before=config.video_before)
        check_real("(0, inf)", video_seconds=config.video_seconds)
        size = check_video_size(
            config.video_size, episodes=config.video_episodes, sides=1 + config.video_before
        )
        if (config.run is None) == (config.zoo is None):
            named = "no run is given" if config.run is None else "both run and zoo are given"
            raise ValueError(
                f"{named}; pass run=PATH, the folder that etl_sac.py printed, or zoo=NAME."
            )
        if config.env is not None and config.zoo is None:
            raise ValueError(
                "env is only for an entry of the zoo; a run has its own task, so leave it out."
            )
        trained = of_a_run(config) if config.zoo is None else of_the_zoo(config)
        recorder = open_recorder(config, trained.env, size) if config.video else None
        task = resolve_task(trained.task["name"], trained.task.get("goal"))
        evaluation = evaluate_task(
            trained.policy, trained.env, trained.task, episodes=config.episodes
        )
        result = {"env": trained.task["name"], "goal": task.goal, **evaluation.summary()}
    episodes = f"{config.episodes} episode{'s' * (config.episodes > 1)}"
    print(f"{trained.task['name']}{task.goal_in_words}, deterministic policy, {episodes}")
    print_intervals(result)
    if trained.card is not None and trained.card.evaluation:
        print(f"  {beside(trained.card, evaluation)}")
    path = trained.folder / "evaluation.json"
    with exit_on_error(OSError):  # now that the numbers are told
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, as_json(result))
    print(f"  written to {path}")
    if recorder is not None:
        with exit_on_error(OSError, SimulationError), recorder:
            videos = draw_episodes(config, trained, recorder)
        print("  videos  " + ", ".join(str(video) for video in videos))


class Trained(NamedTuple):
    """A policy, its untrained version, its environment and the folder for results.

    An entry of the zoo also has a card.
    """

    policy: TensorDictModuleBase
    untrained: Callable[[], TensorDictModuleBase]
    env: EnvBase
    task: dict[str, Any]
    folder: Path
    card: zoo.Card | None = None


def of_a_run(config: DictConfig) -> Trained:
    run = Path(config.run)
    device = [f"device={config.device}"]
    experiment = Experiment(
        resumed_config(run, device, defaults=hydra.compose("config")), resume=run
    )
    policy, context = experiment.learned().learner.policy, experiment.context
    return Trained(
        policy, experiment.untrained, context.make_env(), context.task, experiment.folder.path
    )


def of_the_zoo(config: DictConfig) -> Trained:
    check_device(config.device)
    if config.env is not None:
        zoo.trust(config.zoo, config.env)
    card = zoo.read_card(config.zoo)
    policy, env = zoo.load(config.zoo, device=config.device)
    before = partial(zoo.untrained, config.zoo, device=config.device)
    return Trained(policy, before, env, card.task, Path(f"runs/zoo-{Path(config.zoo).name}"), card)


def open_recorder(config: DictConfig, env: EnvBase, size: tuple[int, int]) -> EpisodeRecorder:
    """Called before the evaluation, so that missing requirements are reported at once."""
    with exit_on_error(RuntimeError):
        return EpisodeRecorder(
            env, size=size, camera=config.video_camera, seconds=config.video_seconds
        )


def draw_episodes(config: DictConfig, trained: Trained, recorder: EpisodeRecorder) -> list[Path]:
    policies = {"after training": trained.policy}
    if config.video_before:
        policies = {"before training": trained.untrained(), **policies}
    sides = {
        caption: recorder.record(policy, config.video_episodes)
        for caption, policy in policies.items()
    }
    return write_animation(trained.folder / "videos", sides)


def beside(card: zoo.Card, evaluation: Evaluation) -> str:
    """Comparison of the returns with those of the card, episode by episode."""
    told = card.evaluation["episodes"]["returns"][: len(evaluation.returns)]
    pairs = list(zip(told, evaluation.returns, strict=False))
    same = sum(math.isclose(one, other, rel_tol=1e-4, abs_tol=1e-4) for one, other in pairs)
    if same == len(pairs):
        return f"same return as on its card in each of {same} episodes"
    mean, low, high = card.evaluation["return"].values()
    interval = "" if low is None else f" ({low:.3f} to {high:.3f})"  # none for a single episode
    return (
        f"{len(pairs) - same} of {len(pairs)} episodes differ from its card, which has the return "
        f"{mean:.3f}{interval}; other machines and simulators round differently"
    )


if __name__ == "__main__":
    sys.argv[1:] = quote_paths(sys.argv[1:], "run", "zoo")
    check_overrides(CONF / "evaluate.yaml", sys.argv[1:], __doc__)
    main()
