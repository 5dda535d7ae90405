"""Run every method on every task with every seed: a resumable queue, with one table of results.

    python recipes/sweep.py tasks=[myoHandPose] methods=[sac,etl] seeds=[0,1] frames=50000
    python recipes/report.py results=sweep

If killed, start it again: finished runs are kept, and others resume from their checkpoints. Every
evaluation is a row of results.csv. All settings with their defaults:
"""

from __future__ import annotations

import shlex
import signal
import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig
from rich.live import Live
from rich.table import Table

from torchrl_etl.checks import check_choice, check_flag, check_integer
from torchrl_etl.collectors import STOP_SIGNALS
from torchrl_etl.command_line import check_overrides, exit_on_error, quote_paths, translate
from torchrl_etl.layout import available_cores
from torchrl_etl.training import Run, Sweep, validate
from torchrl_etl.user_conf import group_files

HERE = Path(__file__).parent
CONF = HERE / "conf"
# Settings that identify runs and their rows, and the sweep's setting for each.
SAID_BY = {
    "env": "tasks",
    "goal": "tasks, as in TASK:random,",
    "method": "methods",
    "seed": "seeds",
    "seeds": "seeds",
    "frames": "frames",
    "run_dir": "out",
    "resume": "out",
}


@hydra.main(version_base="1.3", config_path="conf", config_name="sweep")
def main(config: DictConfig) -> None:
    with exit_on_error(ValueError, OSError, RuntimeError, ImportError, HydraException):
        runs = queue(config)
        jobs = config.jobs or (1 if config.seeds_at_once else available_cores())
        options = {"attempts": config.attempts, "seeds_at_once": config.seeds_at_once}
        sweep = Sweep(runs, Path(config.out), jobs=jobs, **options)
    display = Display(sweep)
    for number in STOP_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, signal.default_int_handler)
    with exit_on_error(OSError):
        try:
            with Live(display.table(), refresh_per_second=1) as live:
                for _ in sweep:
                    live.update(display.table())
        except KeyboardInterrupt:
            print("Stopped; all runs are saved. Start it again to continue.")
            sys.exit(130)
    failed = [run for run in runs if sweep.status(run) == "failed"]
    for run in failed:
        lines = run.log.read_text(encoding="utf-8").splitlines()
        last = next((line for line in reversed(lines) if line.strip()), "no message")
        print(f"Failed: {run.name}, {last} (full log: {run.log})", file=sys.stderr)
    print(f"Evaluations: {sweep.folder / 'results.csv'}")
    sys.exit(1 if failed else 0)


def queue(config: DictConfig) -> list[Run]:
    """The configured runs, ordered by seed, so that early results compare all methods."""
    methods = sorted(group_files(CONF, "method"))
    for name in ("tasks", "methods", "seeds"):
        value = config[name]
        if not isinstance(value, ListConfig) or not value:
            raise ValueError(f"{name} is {value!r}; it must be a list, such as {name}=[a,b].")
        if len(set(value)) < len(value):
            raise ValueError(f"{name} is {value}; it must not have duplicates.")
    for name in ("settings", "out"):
        if not isinstance(config[name], str):
            raise ValueError(f"{name} is {config[name]!r}; it must be a string.")
    settings = shlex.split(config.settings)
    for setting in translate(settings, CONF):
        if (said_by := SAID_BY.get(setting.lstrip("+~").partition("=")[0])) is not None:
            raise ValueError(f"settings has {setting}; set it with {said_by} instead.")
    for method in config.methods:
        check_choice("methods", method, methods)
    check_integer(1, frames=config.frames, attempts=config.attempts)
    if config.jobs is not None:
        check_integer(1, jobs=config.jobs)
    check_flag(seeds_at_once=config.seeds_at_once)
    folder = Path(config.out).resolve()
    runs = []
    for seed, task, method in product(config.seeds, config.tasks, config.methods):
        name, goal = split_goal(str(task))
        overrides = [f"env={name}", f"method={method}", f"seed={seed}"]
        overrides += [f"goal={goal}"] if goal else []
        overrides += ["threads=1", "progress=false", "pictures=false", "log=[]", *settings]
        path = folder / "-".join(
            filter(None, (name.replace(":", "-"), goal, method, f"seed{seed}"))
        )
        command = [str(HERE / "etl_sac.py"), *overrides]
        runs.append(Run(name, goal or None, method, seed, path, command, config.frames))
        # All runs are validated before the first begins.
        validate(compose([*overrides, f"frames={config.frames}"]))
    return runs


def split_goal(task: str) -> tuple[str, str]:
    """Task and goal of ``TASK:random``; a user's ``module:id`` is a task without a goal."""
    name, _, goal = task.rpartition(":")
    return (name, goal) if goal in ("fixed", "random") else (task, "")


def compose(overrides: Sequence[str]) -> DictConfig:
    """The configuration that ``etl_sac.py`` composes from these overrides."""
    hydra.core.global_hydra.GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        translated = quote_paths(translate(overrides, CONF), "synergies.bundle")
        return hydra.compose("config", [*translated, "run_dir=unused"])


class Display:
    """A live table of each run's progress, results and remaining time."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self.begun: dict[str, tuple[int, float]] = {}

    def table(self) -> Table:
        table = Table("run", "status", "frames", "return", "solved", "time left")
        table.columns[0].overflow = "fold"
        for run in self.sweep.runs:
            status, folder = self.sweep.status(run), run.folder
            cells = [run.name, status]
            if folder is None:
                table.add_row(*cells)
                continue
            stages = ("explore", "play", "learn")
            frames = max(folder.series(f"{stage}/updates")[0][-1:] for stage in stages)
            done, returns = (frames or [0])[0], folder.series("learn/eval/return")[1]
            solved = folder.series("learn/eval/solved")[1]
            cells += [f"{done:,}", f"{returns[-1]:.1f}" if returns else ""]
            cells += [f"{solved[-1]:.0%}" if solved else ""]
            cells += [self.time_left(run, done) if status == "running" else ""]
            table.add_row(*cells)
        return table

    def time_left(self, run: Run, done: int) -> str:
        first, since = self.begun.setdefault(run.name, (done, time.monotonic()))
        if done <= first:
            return "?"
        minutes = (run.frames - done) * (time.monotonic() - since) / (done - first) / 60
        return f"{minutes:.0f} min" if minutes >= 1 else "< 1 min"


if __name__ == "__main__":
    sys.argv[1:] = quote_paths(sys.argv[1:], "out", "settings")
    check_overrides(CONF / "sweep.yaml", sys.argv[1:], __doc__)
    main()
