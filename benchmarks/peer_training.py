"""Training with SAC of Stable-Baselines3 or SBX: the peers of end_to_end.py.

Runs in the peers' virtual environment and first prints its versions. Each input line has three
numbers: seconds, frames per update, and updates at a time. It trains for these seconds and prints
the frames per second.
"""

from __future__ import annotations

import argparse
import sys
import time
from importlib import import_module

from peer_update import PACKAGES, versions
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

LEARNING_STARTS = 500


class Until(BaseCallback):
    """Stops training at the first rollout that begins after the deadline."""

    def __init__(self, end: float) -> None:
        super().__init__()
        self.end, self.over = end, False

    def _on_rollout_start(self) -> None:
        self.over = time.perf_counter() >= self.end

    def _on_step(self) -> bool:
        return not self.over


def make_agent(library: str, env: str, envs: int) -> OffPolicyAlgorithm:
    """SAC with ReLU networks without layer norm, after its initial random frames."""
    agent = import_module(library).SAC(
        "MlpPolicy",
        make_vec_env(
            f"myosuite:{env}",  # the module that registers it
            envs,
            seed=0,
            vec_env_cls=SubprocVecEnv if envs > 1 else DummyVecEnv,
        ),
        policy_kwargs={"net_arch": [256, 256]},
        batch_size=256,
        buffer_size=100_000,
        learning_starts=LEARNING_STARTS,
        device="cpu",
        seed=0,
    )
    agent.learn(LEARNING_STARTS)
    return agent


def frames_per_second(
    agent: OffPolicyAlgorithm, seconds: float, frames_per_update: int, updates_at_once: int
) -> float:
    steps = frames_per_update * updates_at_once // agent.n_envs
    agent.train_freq = TrainFreq(steps, TrainFrequencyUnit.STEP)
    agent.gradient_steps = updates_at_once
    begun, before = time.perf_counter(), agent.num_timesteps
    agent.learn(10**9, callback=Until(begun + seconds), reset_num_timesteps=False)
    return (agent.num_timesteps - before) / (time.perf_counter() - begun)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--library", required=True, choices=PACKAGES)
    parser.add_argument("--env", required=True)
    parser.add_argument("--envs", type=int, default=1, help="in processes, if several")
    arguments = parser.parse_args()
    print(versions(arguments.library), flush=True)
    agent = make_agent(arguments.library, arguments.env, arguments.envs)
    print("ready", flush=True)
    for line in sys.stdin:
        seconds, *counts = line.split()
        print(frames_per_second(agent, float(seconds), *map(int, counts)), flush=True)
    agent.get_env().close()


if __name__ == "__main__":
    main()
