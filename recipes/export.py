"""Export a run as an entry of the zoo: weights, card and synergy bundle in a small folder.

    python recipes/export.py run=runs/NAME
    python recipes/evaluate.py zoo=zoo/myoHandPenTwirl

In Python, zoo.load("zoo/myoHandPenTwirl") returns the policy and its environment. All settings
with their defaults:
"""

from __future__ import annotations

import shlex
import sys
from functools import partial
from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrl_etl.checks import check_choice, check_integer, check_path
from torchrl_etl.command_line import (
    OPENING_ERRORS,
    check_overrides,
    exit_on_error,
    print_intervals,
    quiet_torchrl,
    quote_paths,
)
from torchrl_etl.envs import resolve_task
from torchrl_etl.export import export_run
from torchrl_etl.synergies.bundle import copy_bundle
from torchrl_etl.training import resumed_config

CONF = Path(__file__).parent / "conf"


@hydra.main(version_base="1.3", config_path="conf", config_name="export")
def main(config: DictConfig) -> None:
    quiet_torchrl()
    compose = partial(hydra.compose, "config")
    with exit_on_error(*OPENING_ERRORS):
        if config.run is None:
            raise ValueError("no run is given; pass run=PATH, the folder that etl_sac.py printed.")
        check_path(run=config.run, out=config.out)
        check_choice("part", config.part, ("all", "synergies"))
        check_integer(1, episodes=config.episodes)
        if "/" in str(config.name) or str(config.name) in (".", ".."):
            raise ValueError(f"name is {config.name!r}; it must not be a path; use out= for one.")
        run = Path(config.run)
        trained = resumed_config(run, defaults=compose())
        task = resolve_task(trained.env, trained.goal)
        name = config.name or task.name.rpartition("/")[2] + "-random" * (task.goal == "random")
        target = Path(config.out or f"zoo/{name}").expanduser()
        if config.part == "synergies":
            setting = shlex.quote(f"synergies=zoo:{copy_bundle(run, target)}")
            print(f"Synergies of {trained.env}; to use them: {setting}")
            return
        card = export_run(run, target, compose, CONF, episodes=config.episodes)
    size = sum(path.stat().st_size for path in target.iterdir())
    print(f"{trained.env}{task.goal_in_words}, {card.training['frames']:,} frames")
    print_intervals(card.evaluation)
    print(f"  {size / 1e6:.2f} MB in {target}; to load it: zoo.load({str(target)!r})")


if __name__ == "__main__":
    sys.argv[1:] = quote_paths(sys.argv[1:], "run", "out")
    check_overrides(CONF / "export.yaml", sys.argv[1:], __doc__)
    main()
