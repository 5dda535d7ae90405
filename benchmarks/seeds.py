"""Milliseconds per update of one seed: several seeds in one pass, compared with sequential ones.

    python benchmarks/seeds.py
    python benchmarks/seeds.py --seeds 8 --compile
    python benchmarks/seeds.py --seeds 16 --compile --device cuda --stages learn --products high

Measures CPU time on one thread, or with ``--device cuda`` the time until the GPU is done; both
cases alternate in blocks of updates. ``explore`` and ``learn`` are the recipe's stages. They make
the 64 updates of a batch of frames through the training code, including sampling and each seed's
random numbers and generator state. Ratios are to the same seeds in sequence; multiplied by the
number of seeds, to a single seed. ``--products high`` allows TF32 on a GPU.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before importing torch

import time
from collections.abc import Sequence

import torch
from harness import line, recipe, train, training
from update import transitions

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.training import Stage
from torchrl_etl.training.interleaved import run_interleaved
from torchrl_etl.training.work import Work

STAGES = ("explore", "learn")
AT_ONCE = 64  # a batch of frames with one update for each


def filled(seed: int, name: str, *overrides: str) -> Stage:
    """A stage as built by the recipe, with a filled buffer."""
    experiment = Experiment(recipe(*overrides, f"seed={seed}", "threads=1", "run_dir=unused"))
    stage = Explorer(experiment.context).stage if name == "explore" else experiment.method.stage()
    spec, d = experiment.context.spec, experiment.config.num_synergies
    stage.prefill(transitions(spec.observation_dim, spec.action_dim, d))
    stage.progress.owed = 0.0
    return stage


def seconds() -> float:
    """CPU time, or wall time after synchronization if a GPU is in use."""
    if not torch.cuda.is_initialized():
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def measured(stages: Sequence[Stage], repeats: int, block: int) -> dict[str, list[float]]:
    """Milliseconds per update of one seed for each block, after an unrecorded first block.

    All blocks share one call of ``run_interleaved``, which holds the compiled code. The work of the
    first seed therefore takes the times, and also runs the sequential updates of all seeds.
    """
    taken: dict[str, list[float]] = {"one_by_one": [], "together": []}

    def first() -> Work[None]:
        for _ in range(repeats + 1):
            start = seconds()
            for stage in stages:
                train(stage, block, at_once=AT_ONCE)
            middle = seconds()
            yield from training(stages[0], block, at_once=AT_ONCE)
            taken["one_by_one"].append(middle - start)
            taken["together"].append(seconds() - middle)

    others = [training(stage, (repeats + 1) * block, at_once=AT_ONCE) for stage in stages[1:]]
    for result in run_interleaved([first(), *others]):
        if isinstance(result, BaseException):
            raise result
    updates = block * len(stages)
    return {name: [1e3 * each / updates for each in values[1:]] for name, values in taken.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandKeyTurn")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--block", type=int, default=1, help=f"how often {AT_ONCE} updates are measured at a time"
    )
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES)
    parser.add_argument("--products", choices=("highest", "high"), default="highest")
    arguments = parser.parse_args()
    quiet_torchrl()
    torch.set_num_threads(1)

    torch.set_float32_matmul_precision(arguments.products)
    more = {name: getattr(arguments, name) for name in ("seeds", "compile", "device", "products")}
    overrides = [f"env={arguments.env}", f"device={arguments.device}"]
    overrides += [f"compile={str(arguments.compile).lower()}"]
    for name in arguments.stages:
        stages = [filled(seed, name, *overrides) for seed in range(arguments.seeds)]
        values = measured(stages, arguments.repeats, AT_ONCE * arguments.block)
        other = values["one_by_one"]
        line("seeds", f"one_by_one/{name}", "ms", other, **more)
        peers = {f"one_by_one/{name}": other}
        line("seeds", f"together/{name}", "ms", values["together"], peers=peers, **more)


if __name__ == "__main__":
    main()
