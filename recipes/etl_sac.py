"""Explore to Learn with SAC: find synergies, then learn the task in them.

    python recipes/etl_sac.py env=myoHandPenTwirl experiment=quick
    python recipes/etl_sac.py env=myoHandKeyTurn stage=learn synergies=runs/NAME
    python recipes/etl_sac.py env=myoHandPenTwirl seeds=[0,1,2] 'run_dir=runs/pen-${seed}'
    python recipes/etl_sac.py resume=runs/NAME

Settings are given as key=value, nested ones with a dot: learn.sac.lr=1e-3. A run leaves its
configuration, metrics, checkpoints, synergies and pictures in run_dir. These are all settings,
with their defaults:
"""

from __future__ import annotations

import shlex
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from torchrl_etl.collectors import CollectionError
from torchrl_etl.command_line import (
    check_overrides,
    one_sentence,
    quiet_torchrl,
    quote_paths,
    translate,
)
from torchrl_etl.envs import SimulationError
from torchrl_etl.experiment import Experiment
from torchrl_etl.training import Interrupted, resumed_config

CONF = Path(__file__).parent / "conf"
SYNERGIES = (
    ("vaf", "variance accounted for"),
    ("pca_vaf", "PCA"),
    ("nmf_vaf", "NMF"),
    ("control_authority", "control authority"),
    ("direction_alignment", "alignment with directions"),
)


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(config: DictConfig) -> None:
    quiet_torchrl()
    with one_sentence(ValueError, OSError, ImportError, gymnasium.error.Error):
        given = list(HydraConfig.get().overrides.task)
        resume = None
        if config.resume is not None:
            resume = Path(config.resume)
            config = resumed_config(resume, given, defaults=hydra.compose("config"))
        # Two runs that begin in the same second have the same name by default.
        named = any(override.lstrip("+").startswith("run_dir=") for override in given)
        experiment = Experiment(config, resume=resume, unique=not named, say=print)
    try:
        with one_sentence(OSError, SimulationError, CollectionError):
            summary = experiment.run()
    except Interrupted:
        command = shlex.join(["python", sys.argv[0], f"resume={experiment.folder.path}"])
        with suppress(OSError):  # the terminal may be gone
            print(f"Stopped and saved. To go on: {command}", flush=True)
        sys.exit(130)
    print(report(summary, experiment.folder.path))


def report(summary: dict[str, Any], folder: Path) -> str:
    """What a person wants to know at the end of a run."""
    synergies, learned = summary.get("synergies", {}), summary.get("learn", {})
    goal = f" ({summary['goal']} goal)" if summary["goal"] else ""
    lines = ["", f"{summary['env']}{goal}, seed {summary['seed']}"]
    # A bundle from elsewhere holds what whoever saved it chose to.
    known = [f"{words} {synergies[key]:.2f}" for key, words in SYNERGIES if key in synergies]
    if known:
        lines.append(f"  {'synergies':<12}{', '.join(known)}")
    for key in ("return", "solved", "solved_time"):
        if key in learned:
            value = learned[key]
            lines.append(
                f"  {key:<12}{value['before']:.2f} before, {value['after']:.2f} after "
                f"(95% interval {value['low']:.2f} to {value['high']:.2f}, "
                f"{learned['frames_charged']:,} frames)"
            )
    if (folder / "pictures").exists():
        lines.append(f"  pictures    {folder / 'pictures'}")
    return "\n".join([*lines, f"  all of it   {folder}"])


if __name__ == "__main__":
    with one_sentence(ValueError):
        sys.argv[1:] = translate(sys.argv[1:], CONF)
    sys.argv[1:] = quote_paths(sys.argv[1:], "run_dir", "resume", "synergies.bundle")
    check_overrides(CONF / "config.yaml", sys.argv[1:], __doc__)
    main()
