"""Explore to Learn with SAC: find synergies, then learn the task in them.

    python recipes/etl_sac.py env=myoHandPenTwirl experiment=quick
    python recipes/etl_sac.py env=myoHandKeyTurn stage=learn synergies=runs/NAME
    python recipes/etl_sac.py env=myoHandPenTwirl seeds=[0,1,2] 'run_dir=runs/pen-${seed}'
    python recipes/etl_sac.py resume=runs/NAME

Settings are given as key=value, nested ones with dots: learn.sac.lr=1e-3. A run writes its
configuration, metrics, checkpoints, synergies and plots to run_dir. All settings with their
defaults:
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig

from torchrl_etl.collectors import CollectionError
from torchrl_etl.command_line import (
    OPENING_ERRORS,
    check_overrides,
    exit_on_error,
    interval_in_words,
    quiet_torchrl,
    quote_paths,
    translate,
)
from torchrl_etl.envs import SimulationError
from torchrl_etl.experiment import Experiment
from torchrl_etl.in_processes import in_processes
from torchrl_etl.layout import choose_layout
from torchrl_etl.training import Interrupted, resumed_config, run_interleaved
from torchrl_etl.training.config import resume_setting, split_seeds
from torchrl_etl.training.loop import StopOnSignal

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
    with exit_on_error(*OPENING_ERRORS, CollectionError):
        runs = list(configured_runs(config, list(HydraConfig.get().overrides.task)))
        apart = len(runs) > 1 and runs[0]["config"].device == "cpu"
        if len(runs) > 1 and not apart and runs[0]["config"].collector.kind == "distributed":
            raise ValueError(
                "collector.kind is 'distributed', which a process can have only once; on a GPU, "
                "several seeds share a process, so use process or ray."
            )
        # All are built, and so checked, before the first begins. In processes, only those print.
        experiments = [
            Experiment(run["config"], resume=run["resume"]) if apart else Experiment(**run)
            for run in runs
        ]
    if apart:
        ends = in_processes(runs)
    else:
        with StopOnSignal() as stop:
            found = run_interleaved([experiment.work(stop) for experiment in experiments])
        ends = [(each.folder.path, end) for each, end in zip(experiments, found, strict=True)]
    for folder, end in ends:
        if isinstance(end, dict):
            print(report(end, folder))
    failures = [end for _, end in ends if isinstance(end, Exception)]
    for failure in failures:
        with suppress(SystemExit), exit_on_error(OSError, SimulationError, CollectionError):
            raise failure
    stopped = [folder for folder, end in ends if isinstance(end, Interrupted)]
    if stopped:
        command = shlex.join(["python", sys.argv[0], resume_setting(stopped)])
        with suppress(OSError):  # the terminal may be gone
            print(f"Stopped and saved. To continue: {command}", flush=True)
    if failures or stopped:
        sys.exit(130 if stopped else 2)


def configured_runs(config: DictConfig, given: list[str]) -> Iterator[dict[str, Any]]:
    """Arguments of ``Experiment`` for each configured run; there are several with ``seeds`` or a
    list of folders in ``resume``."""
    if config.resume is not None:
        folders = config.resume if isinstance(config.resume, ListConfig) else [config.resume]
        if not folders:
            raise ValueError("resume is []; pass folders of runs, such as resume=runs/NAME.")
        defaults = hydra.compose("config")
        for folder in map(Path, folders):
            stored = resolve_collector(resumed_config(folder, given, defaults=defaults))
            yield {"config": stored, "resume": folder, "say": print}
        return
    # By default, runs that begin in the same second have the same name.
    named = any(override.lstrip("+").startswith("run_dir=") for override in given)
    for own in split_seeds(resolve_collector(config)):
        say = print if config.seeds is None else partial(print, f"seed {own.seed}:")
        yield {"config": own, "resume": None, "unique": not named, "say": say}


def resolve_collector(config: DictConfig) -> DictConfig:
    """The configuration with ``collector.kind=auto`` resolved."""
    return choose_layout(config, say=print) if config.collector.kind == "auto" else config


def report(summary: dict[str, Any], folder: Path) -> str:
    """Summary of a run for the user."""
    synergies, learned = summary.get("synergies", {}), summary.get("learn", {})
    goal = f" ({summary['goal']} goal)" if summary["goal"] else ""
    lines = ["", f"{summary['env']}{goal}, seed {summary['seed']}"]
    # Bundles from elsewhere may hold only some of these.
    known = [f"{words} {synergies[key]:.2f}" for key, words in SYNERGIES if key in synergies]
    if known:
        lines.append(f"  {'synergies':<12}{', '.join(known)}")
    for key in ("return", "solved", "solved_time"):
        if key in learned:
            value = learned[key]
            interval = interval_in_words(value["low"], value["high"], digits=2)
            known = filter(None, (interval, f"{learned['frames_charged']:,} frames"))
            lines.append(
                f"  {key:<12}{value['before']:.2f} before, {value['after']:.2f} after "
                f"({', '.join(known)})"
            )
    if (folder / "pictures").exists():
        lines.append(f"  pictures    {folder / 'pictures'}")
    return "\n".join([*lines, f"  all files   {folder}"])


if __name__ == "__main__":
    with exit_on_error(ValueError):
        sys.argv[1:] = translate(sys.argv[1:], CONF)
    sys.argv[1:] = quote_paths(sys.argv[1:], "run_dir", "resume", "synergies.bundle")
    check_overrides(CONF / "config.yaml", sys.argv[1:], __doc__)
    main()
