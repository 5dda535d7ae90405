"""Stable-Baselines3's SAC, training in steps as told: the peer of ``end_to_end.py``.

Runs in its own virtual environment. Reads a number of frames a line, trains for so many, and
answers with the seconds that this took.
"""

from __future__ import annotations

import argparse
import sys
import time

import gymnasium
import myosuite  # noqa: F401  (registers its environments)
from stable_baselines3 import SAC


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", required=True)
    parser.add_argument("--frames-per-update", type=int, required=True)
    arguments = parser.parse_args()
    model = SAC(
        "MlpPolicy",
        gymnasium.make(arguments.env),
        policy_kwargs={"net_arch": [256, 256]},
        batch_size=256,
        buffer_size=100_000,
        learning_starts=500,
        train_freq=arguments.frames_per_update,
        gradient_steps=1,
        device="cpu",
        seed=0,
    )
    model.learn(1000)
    print("ready", flush=True)
    for line in sys.stdin:
        begun = time.perf_counter()
        model.learn(int(line), reset_num_timesteps=False)
        print(time.perf_counter() - begun, flush=True)


if __name__ == "__main__":
    main()
