"""Stable-Baselines3's SAC update, for benchmarks/update.py, in an environment of its own.

Reads a line for each block of updates and answers with a line of JSON; the peer's versions come
first.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial

import gymnasium
import numpy as np
import stable_baselines3
import torch
from gymnasium.spaces import Box
from stable_baselines3 import SAC
from stable_baselines3.common import policies as common_policies
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.sac import policies as sac_policies


class Sizes(gymnasium.Env):
    """Not a task: sizes for an agent."""

    def __init__(self, observation_dim: int, action_dim: int) -> None:
        self.observation_space = Box(-np.inf, np.inf, (observation_dim,), np.float32)
        self.action_space = Box(-1.0, 1.0, (action_dim,), np.float32)

    def reset(self, **kwargs: object) -> tuple[np.ndarray, dict]:
        return self.observation_space.sample(), {}


def main() -> None:
    case = json.loads(sys.argv[1])
    torch.set_num_threads(1)
    normalized = partial(create_mlp, post_linear_modules=[torch.nn.LayerNorm])
    if case["layer_norm"]:  # it has no setting for that
        common_policies.create_mlp = sac_policies.create_mlp = normalized
    env = Sizes(case["observation_dim"], case["action_dim"])
    agent = SAC(
        "MlpPolicy",
        env,
        buffer_size=case["transitions"],
        batch_size=case["batch_size"],
        policy_kwargs={"net_arch": case["hidden"]},
        device="cpu",
    )
    agent.set_logger(configure(format_strings=[]))
    norms = sum(isinstance(module, torch.nn.LayerNorm) for module in agent.policy.modules())
    assert norms == (5 * len(case["hidden"]) if case["layer_norm"] else 0)
    for _ in range(case["transitions"]):
        agent.replay_buffer.add(
            env.observation_space.sample()[None],
            env.observation_space.sample()[None],
            env.action_space.sample()[None],
            np.zeros(1),
            np.zeros(1),
            [{}],
        )
    versions = {"stable_baselines3": stable_baselines3.__version__, "torch": torch.__version__}
    print(json.dumps(versions), flush=True)
    for line in sys.stdin:
        start = time.process_time()
        agent.train(gradient_steps=int(line), batch_size=case["batch_size"])
        print(json.dumps({"ms": 1e3 * (time.process_time() - start) / int(line)}), flush=True)


if __name__ == "__main__":
    main()
