"""Evaluate a run or an entry of the zoo on fixed seeds: return and solved, with intervals.

    python recipes/evaluate.py run=runs/NAME episodes=50 video=true
    python recipes/evaluate.py zoo=NAME

These are all settings, with their defaults:
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import hydra
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_etl.gl_backend import draw_without_display

if "video=true" in sys.argv[1:]:
    draw_without_display()
from torchrl_etl import zoo
from torchrl_etl.checks import check_integer
from torchrl_etl.command_line import (
    check_overrides,
    one_sentence,
    quiet_torchrl,
    quote_paths,
)
from torchrl_etl.envs import resolve_task
from torchrl_etl.experiment import Experiment
from torchrl_etl.io import as_json, write_atomically
from torchrl_etl.training import (
    Evaluation,
    check_video_size,
    evaluate_task,
    record_episodes,
    resumed_config,
)

CONF = Path(__file__).parent / "conf"


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    quiet_torchrl()
    with one_sentence(ValueError, OSError, ImportError):
        size = check_video_size(config.video_size)
        check_integer(1, episodes=config.episodes)
        if (config.run is None) == (config.zoo is None):
            named = "no run is named" if config.run is None else "a run and an entry are named"
            raise ValueError(
                f"{named}; pass run=PATH, the folder that etl_sac.py printed, or zoo=NAME."
            )
        trained = of_a_run(config) if config.zoo is None else of_the_zoo(config)
        task = resolve_task(trained.task["name"], trained.task["goal"])
        evaluation = evaluate_task(
            trained.policy, trained.env, trained.task, episodes=config.episodes
        )
        result = {"env": trained.task["name"], "goal": task.goal, **evaluation.summary()}
        trained.folder.mkdir(parents=True, exist_ok=True)
        path = trained.folder / "evaluation.json"
        write_atomically(path, as_json(result))
    print(
        f"{trained.task['name']}{task.goal_in_words}, deterministic policy, "
        f"{config.episodes} episodes"
    )
    for key in ("return", "solved", "solved_time"):
        if key in result:
            mean, low, high = result[key].values()
            print(f"  {key:<12} {mean:.3f}  (95% interval {low:.3f} to {high:.3f})")
    if trained.card is not None:
        print(f"  {beside(trained.card, evaluation)}")
    print(f"  written to {path}")
    if config.video:
        with one_sentence(RuntimeError, ValueError):
            videos = record_episodes(
                trained.env,
                trained.policy,
                trained.folder / "videos",
                episodes=config.video_episodes,
                size=size,
                camera=config.video_camera,
            )
        print("  videos  " + ", ".join(str(video) for video in videos))


class Trained(NamedTuple):
    """A policy, where it acts, and where results go; of an entry of the zoo also its card."""

    policy: TensorDictModuleBase
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
    return Trained(policy, context.make_env(), context.task, experiment.folder.path)


def of_the_zoo(config: DictConfig) -> Trained:
    card = zoo.read_card(config.zoo)
    policy, env = zoo.load(config.zoo, device=config.device)
    return Trained(policy, env, card.task, Path(f"runs/zoo-{Path(config.zoo).name}"), card)


def beside(card: zoo.Card, evaluation: Evaluation) -> str:
    """Whether an entry does what its card says, episode by episode."""
    told = card.evaluation["episodes"]["returns"][: len(evaluation.returns)]
    pairs = list(zip(told, evaluation.returns, strict=False))
    same = sum(math.isclose(one, other, rel_tol=1e-4, abs_tol=1e-4) for one, other in pairs)
    if same == len(pairs):
        return f"as its card says, in each of {same} episodes"
    mean, low, high = card.evaluation["return"].values()
    return (
        f"{len(pairs) - same} of {len(pairs)} episodes are not those of its card, whose return is "
        f"{mean:.3f} ({low:.3f} to {high:.3f}); another machine or simulator rounds otherwise"
    )


if __name__ == "__main__":
    sys.argv[1:] = quote_paths(sys.argv[1:], "run", "zoo")
    check_overrides(CONF / "evaluate.yaml", sys.argv[1:], __doc__)
    main()
