"""SAC of Stable-Baselines3, or of SBX, training as told: the peers of end_to_end.py.

Runs in their environment. Reads a number of seconds a line, trains for so long, and answers with
the frames a second.
"""

from __future__ import annotations

import argparse
import sys
import time
from importlib import import_module

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

LEARNING_STARTS = 500


class Until(BaseCallback):
    """Stops training with the first rollout that begins when the time is up."""

    def __init__(self, end: float) -> None:
        super().__init__()
        self.end, self.over = end, False

    def _on_rollout_start(self) -> None:
        self.over = time.perf_counter() >= self.end

    def _on_step(self) -> bool:
        return not self.over


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--library", required=True, choices=("stable_baselines3", "sbx"))
    parser.add_argument("--env", required=True)
    parser.add_argument("--frames-per-update", type=int, required=True)
    parser.add_argument("--envs", type=int, default=1, help="in processes, if several")
    parser.add_argument("--updates-at-once", type=int, default=1)
    arguments = parser.parse_args()
    rollout = arguments.frames_per_update * arguments.updates_at_once
    agent = import_module(arguments.library).SAC(
        "MlpPolicy",
        make_vec_env(
            f"myosuite:{arguments.env}",  # the module that registers it
            arguments.envs,
            seed=0,
            vec_env_cls=SubprocVecEnv if arguments.envs > 1 else DummyVecEnv,
        ),
        policy_kwargs={"net_arch": [256, 256]},
        batch_size=256,
        buffer_size=100_000,
        learning_starts=LEARNING_STARTS,
        train_freq=rollout // arguments.envs,
        gradient_steps=arguments.updates_at_once,
        device="cpu",
        seed=0,
    )
    agent.learn(LEARNING_STARTS + 2 * rollout + 1)
    print("ready", flush=True)
    for line in sys.stdin:
        begun, before = time.perf_counter(), agent.num_timesteps
        agent.learn(10**9, callback=Until(begun + float(line)), reset_num_timesteps=False)
        frames = agent.num_timesteps - before
        print(frames / (time.perf_counter() - begun), flush=True)
    agent.get_env().close()


if __name__ == "__main__":
    main()
