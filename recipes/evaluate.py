"""Evaluate a run of etl_sac.py on fixed seeds: return and solved, with intervals.

    python recipes/evaluate.py run=runs/NAME episodes=50 video=true

These are all settings, with their defaults:
"""

from __future__ import annotations

import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrl_etl.gl_backend import draw_without_display

if "video=true" in sys.argv[1:]:
    draw_without_display()
from torchrl_etl.command_line import (
    check_overrides,
    one_sentence,
    quiet_torchrl,
    quote_paths,
)
from torchrl_etl.experiment import Experiment
from torchrl_etl.training import check_video_size, record_episodes, resumed_config

CONF = Path(__file__).parent / "conf"


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    quiet_torchrl()
    with one_sentence(ValueError, OSError, ImportError):
        size = check_video_size(config.video_size)
        if config.run is None:
            raise ValueError("no run is named; pass run=PATH, the folder that etl_sac.py printed.")
        run = Path(config.run)
        trained = resumed_config(
            run,
            [f"device={config.device}", f"evaluation.episodes={config.episodes}"],
            defaults=hydra.compose("config"),
        )
        experiment = Experiment(trained, resume=run)
        stage = experiment.learned()
    evaluation = experiment.evaluator(stage)()
    result = {"env": trained.env, "goal": experiment.task.goal, **evaluation.summary()}
    path = experiment.folder.write_json("evaluation.json", result)
    print(
        f"{trained.env}{experiment.task.goal_in_words}, deterministic policy, "
        f"{config.episodes} episodes"
    )
    for key in ("return", "solved", "solved_time"):
        if key in result:
            mean, low, high = result[key].values()
            print(f"  {key:<12} {mean:.3f}  (95% interval {low:.3f} to {high:.3f})")
    print(f"  written to {path}")
    if config.video:
        with one_sentence(RuntimeError, ValueError):
            videos = record_episodes(
                experiment.context.make_env(),
                stage.learner.policy,
                experiment.folder.path / "videos",
                episodes=config.video_episodes,
                size=size,
                camera=config.video_camera,
            )
        print("  videos  " + ", ".join(str(video) for video in videos))


if __name__ == "__main__":
    sys.argv[1:] = quote_paths(sys.argv[1:], "run")
    check_overrides(CONF / "evaluate.yaml", sys.argv[1:], __doc__)
    main()
