"""Milliseconds an update of one seed: several seeds in one pass beside one after another.

    python benchmarks/seeds.py
    python benchmarks/seeds.py --seeds 8 --compile

One thread and CPU time; both take turns in blocks of updates. ``explore`` and ``learn`` are the
whole updates of the recipe's stages, sampling included, random numbers of each seed included. A
ratio is to the same seeds one after another.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is there

import time
from collections.abc import Callable

import torch
from harness import interleave, line, recipe
from update import transitions

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners import SideBySide
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.training import Stage


def filled(seed: int, name: str, compile: bool, env: str) -> Stage:
    """A stage as the recipe builds it, its buffer filled."""
    overrides = (f"env={env}", f"seed={seed}", f"compile={str(compile).lower()}", "threads=1")
    experiment = Experiment(recipe(*overrides, "run_dir=unused"))
    stage = Explorer(experiment.context).stage if name == "explore" else experiment.method.stage()
    spec, d = experiment.context.spec, experiment.config.num_synergies
    stage.buffer.extend(transitions(spec.observation_dim, spec.action_dim, d))
    return stage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandKeyTurn")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--block", type=int, default=10, help="updates measured at a time")
    parser.add_argument("--compile", action="store_true")
    arguments = parser.parse_args()
    quiet_torchrl()
    torch.set_num_threads(1)

    def timed(update: Callable[[], object]) -> Callable[[], float]:
        def block() -> float:
            start = time.process_time()
            for _ in range(arguments.block):
                update()
            seconds = time.process_time() - start
            return 1e3 * seconds / (arguments.block * arguments.seeds)

        return block

    cases: dict[str, Callable[[], float]] = {}
    for name in ("explore", "learn"):
        stages = [
            filled(seed, name, arguments.compile, arguments.env) for seed in range(arguments.seeds)
        ]
        group = SideBySide([stage.learner for stage in stages])

        def together(stages: list[Stage] = stages, group: SideBySide = group) -> None:
            batches = [stage.sample() for stage in stages]
            group.update(batches, [group.draw(batch) for batch in batches])

        def one_by_one(stages: list[Stage] = stages) -> None:
            for stage in stages:
                stage.update()

        cases[f"together/{name}"] = timed(together)
        cases[f"one_by_one/{name}"] = timed(one_by_one)
    values = interleave(cases, arguments.repeats)
    for name in ("explore", "learn"):
        other = f"one_by_one/{name}"
        more = {"seeds": arguments.seeds, "compile": arguments.compile}
        line("seeds", other, "ms", values[other], **more)
        mine = f"together/{name}"
        line("seeds", mine, "ms", values[mine], peers={other: values[other]}, **more)


if __name__ == "__main__":
    main()
