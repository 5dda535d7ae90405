"""SAC updates of Stable-Baselines3 or SBX for update.py, in their own virtual environment.

First prints the versions. Each input line is a number of updates, and is answered with a line of
JSON. Uses as many threads as it may use cores.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib import import_module
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

PACKAGES = {
    "stable_baselines3": ("stable_baselines3", "torch"),
    "sbx": ("sbx-rl", "jax", "jaxlib", "flax", "optax"),
}


def versions(library: str) -> str:
    """Versions of the library and its backend, as a line of JSON."""
    return json.dumps({name: version(name) for name in PACKAGES[library]})


class Sizes(gymnasium.Env):
    """A dummy environment with the sizes for an agent."""

    def __init__(self, observation_dim: int, action_dim: int) -> None:
        self.observation_space = Box(-np.inf, np.inf, (observation_dim,), np.float32)
        self.action_space = Box(-1.0, 1.0, (action_dim,), np.float32)

    def reset(self, **kwargs: object) -> tuple[np.ndarray, dict]:
        return self.observation_space.sample(), {}


def make_agent(case: dict[str, Any]) -> OffPolicyAlgorithm:
    """SAC with ReLU networks without layer norm, and a buffer full of random transitions."""
    env = Sizes(case["observation_dim"], case["action_dim"])
    agent = import_module(case["library"]).SAC(
        "MlpPolicy",
        env,
        buffer_size=case["transitions"],
        batch_size=case["batch_size"],
        policy_kwargs={"net_arch": case["hidden"]},
        device="cpu",
        seed=0,
    )
    agent.set_logger(configure(format_strings=[]))
    for _ in range(case["transitions"]):
        agent.replay_buffer.add(
            env.observation_space.sample()[None],
            env.observation_space.sample()[None],
            env.action_space.sample()[None],
            0.1 * np.random.randn(1),
            np.zeros(1),
            [{}],
        )
    return agent


def finish(agent: OffPolicyAlgorithm) -> None:
    """Wait for JAX's asynchronous computations."""
    if "jax" in sys.modules:
        states = agent.policy.actor_state, agent.policy.qf_state, agent.ent_coef_state
        import_module("jax").block_until_ready(states)


def main() -> None:
    case = json.loads(sys.argv[1])
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    agent, at_once = make_agent(case), case["updates_at_once"]
    print(versions(case["library"]), flush=True)
    for line in sys.stdin:
        calls = max(1, int(line) // at_once)
        start = time.process_time()
        for _ in range(calls):  # one call of SBX is one scan
            agent.train(gradient_steps=at_once, batch_size=case["batch_size"])
        finish(agent)
        milliseconds = 1e3 * (time.process_time() - start) / (calls * at_once)
        print(json.dumps({"ms": milliseconds}), flush=True)


if __name__ == "__main__":
    main()
