"""The policies of several runs of one task side by side.

    python studies/policies_side_by_side.py docs/results/first RUN [RUN ...]

writes TASK.webp, the first evaluation episode of each run under its method and seed. For a video of
one run, also before its training: ``python recipes/evaluate.py run=RUN video=true``.
"""

# ruff: noqa: E402  (MuJoCo chooses how it draws when it is first imported)

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from torchrl_etl.gl_backend import draw_without_display

draw_without_display()
from torchrl_etl.analysis.animation import animated_picture, side_by_side
from torchrl_etl.command_line import exit_on_error, quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.io import write_atomically
from torchrl_etl.training import EpisodeRecorder, resumed_config

SIZE = (192, 208)  # pixels of an episode
SECONDS = 5.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where the animation is written")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    arguments = parser.parse_args()
    quiet_torchrl()
    with exit_on_error(ValueError, OSError, RuntimeError):
        opened = [
            Experiment(resumed_config(run, ["device=cpu"]), resume=run) for run in arguments.runs
        ]
        task, *others = dict.fromkeys(experiment.context.config.env for experiment in opened)
        if others:
            raise ValueError(f"the runs are of {task} and {others[0]}; pass runs of one task.")
        captions = [caption(experiment) for experiment in opened]
        for name in captions:
            if captions.count(name) > 1:
                raise ValueError(f"several runs are of {name}; pass one of each method and seed.")
        sides = dict(zip(captions, map(episode, opened), strict=True))
        path = arguments.folder / f"{task}.webp"
        write_atomically(path, animated_picture(side_by_side(sides)))
    print(path)


def caption(experiment: Experiment) -> str:
    config = experiment.context.config
    return f"{config.method.name}, seed {config.seed}"


def episode(experiment: Experiment) -> list[np.ndarray]:
    env, policy = experiment.context.make_env(), experiment.learned().learner.policy
    with EpisodeRecorder(env, size=SIZE, seconds=SECONDS) as recorder:
        return recorder.record(policy, 1)


if __name__ == "__main__":
    main()
