"""Frames per second of the bare simulator, TorchRL's collectors and ours, on all cores.

    python benchmarks/collection.py
    python benchmarks/collection.py --tasks myoHandPenTwirl --repeats 9

The bare simulators (``gymnasium.make``, or ``dm_control.suite.load`` with Shimmy) replay actions of
our policy, since the cost of the physics depends on them. TorchRL's baseline is a
``MultiSyncCollector`` with one ``GymWrapper`` per worker. Both stages run with all their transforms
and a policy of the recipes' size. Every case has one process per core, with one thread each.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection

import numpy as np
import torch
from harness import interleave, line, synergy_policy
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import RewardSum, TransformedEnv

from torchrl_etl.collectors import Batches, VectorCollector, make_batches
from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.envs import make_env
from torchrl_etl.envs.factory import _simulator
from torchrl_etl.envs.tasks import resolve_task
from torchrl_etl.modules import SynergyDecoder, make_actor
from torchrl_etl.transforms import DirectionPrimer, SynergyAction

TASKS = ("myoHandPenTwirl", "myoLegWalk", "dog-run")
DIM = 4


def recipe_env(task: str, num_envs: int) -> TransformedEnv:
    return TransformedEnv(make_env(task, num_envs=num_envs, device="cpu"), RewardSum())


def stage_env(task: str, stage: str, decoder: SynergyDecoder, num_envs: int) -> TransformedEnv:
    env = recipe_env(task, num_envs)
    if stage == "explore":
        return env.append_transform(DirectionPrimer(DIM))
    return env.append_transform(SynergyAction(decoder))


def explore_policy(task: str) -> TensorDictModuleBase:
    env = make_env(task)
    spec = env.full_action_spec_unbatched["action"]
    inputs = {"observation": env.observation_spec["observation"].shape[-1], "direction": DIM}
    env.close()
    return make_actor(inputs, spec)


def bare_simulator(task: str, actions: np.ndarray, pipe: Connection) -> None:
    """Steps one simulator for the number of steps received from the pipe."""
    env, _ = _simulator(resolve_task(task), {})
    env.reset(seed=0)
    step = 0
    while (count := pipe.recv()) is not None:
        for _ in range(count):
            _, _, terminated, truncated, _ = env.step(actions[step % len(actions)])
            step += 1
            if terminated or truncated:
                env.reset()
        pipe.send("done")


class BareSimulators:
    def __init__(self, task: str, actions: np.ndarray, workers: int, frames: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.frames, self.pipes = frames, []
        for _ in range(workers):
            ours, theirs = context.Pipe()
            process = context.Process(
                target=bare_simulator, args=(task, actions, theirs), daemon=True
            )
            process.start()
            self.pipes.append(ours)

    def __call__(self) -> float:
        begun = time.perf_counter()
        for pipe in self.pipes:
            pipe.send(self.frames // len(self.pipes))
        for pipe in self.pipes:
            pipe.recv()
        return self.frames / (time.perf_counter() - begun)

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.send(None)


def frames_per_second(next_batch: Callable[[], object], frames: int, per_batch: int) -> float:
    next_batch()  # may have been collected ahead of time; the next one begins now
    begun = time.perf_counter()
    for _ in range(max(1, frames // per_batch)):
        next_batch()
    return max(1, frames // per_batch) * per_batch / (time.perf_counter() - begun)


def compare(task: str, stage: str, arguments: argparse.Namespace) -> None:
    synergetic = synergy_policy(task, DIM)
    actor, decoder = synergetic[0], synergetic[1]
    policy = explore_policy(task) if stage == "explore" else actor
    workers, num_envs = arguments.workers, arguments.num_envs
    env = partial(stage_env, task, stage, decoder)
    example = VectorCollector(partial(env, 2), policy, frames_per_batch=400, total_frames=-1)
    batch = next(iter(example))
    executed = "action" if stage == "explore" else ("next", "executed_action")
    actions = batch[executed][0].numpy().copy()
    example.shutdown()

    if stage == "explore":
        acting, make = policy, partial(env, num_envs)
    else:  # as in the recipes, where the decoder is part of the policy
        acting, make = synergetic, partial(recipe_env, task, num_envs)
    per_batch = workers * num_envs * arguments.steps
    batches: Batches = make_batches(
        "process",
        make,
        acting,
        num_workers=workers,
        frames_per_batch=per_batch,
        ahead=True,
        timeout=300.0,
    )
    batches.restart(seed=0)
    stock = MultiSyncCollector(
        [partial(env, 1)] * workers,
        policy,
        frames_per_batch=per_batch,
        total_frames=-1,
        num_threads=1,
    )
    stock.set_seed(0)
    bare = BareSimulators(task, actions, workers, arguments.frames)
    cases = {
        "simulator": bare,
        "torchrl": partial(
            frames_per_second, partial(next, iter(stock)), arguments.frames, per_batch
        ),
        "torchrl_etl": partial(frames_per_second, batches.next, arguments.frames, per_batch),
    }
    values = interleave(cases, arguments.repeats)
    for name in cases:
        line(
            "collection",
            f"{task}/{stage}/{name}",
            "frames/s",
            values[name],
            peers={"simulator": values["simulator"]},
            workers=workers,
            num_envs=1 if name == "torchrl" else num_envs,
        )
    batches.close()
    stock.shutdown()
    bare.close()
    for scheme in stock._weight_sync_schemes.values():  # otherwise __del__ hangs at exit
        scheme.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--stages", nargs="+", default=("explore", "learn"))
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--num-envs", type=int, default=16, help="simulators of a worker")
    parser.add_argument("--steps", type=int, default=16, help="of each simulator in a batch")
    parser.add_argument("--frames", type=int, default=2048, help="of one measurement")
    parser.add_argument("--repeats", type=int, default=4)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quiet_torchrl()
    for task in arguments.tasks:
        for stage in arguments.stages:
            compare(task, stage, arguments)


if __name__ == "__main__":
    main()
