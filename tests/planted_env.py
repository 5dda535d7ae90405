"""A Gymnasium task with planted success and faults."""

import gymnasium as gym
import numpy as np


class Planted(gym.Env):
    """Observes the step count, succeeds from step 2 on, and has its fault in step 3."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float64)

    def __init__(self, fault="none", key="is_success"):
        self.fault, self.key = fault, key

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(3), {}

    def step(self, action):
        self.count += 1
        broken = self.count == 3
        observation = np.full(3, float(self.count))
        if broken and self.fault == "observation":
            observation[1] = np.nan
        if broken and self.fault == "overflow":
            observation[2] = 1e300
        reward = float("inf") if broken and self.fault == "reward" else 1.0
        info = {self.key: self.count >= 2} if self.key else {}
        return observation, reward, self.count == 5, False, info


gym.register("torchrl_etl_test/Planted-v0", entry_point=Planted, max_episode_steps=4)
PLANTED = "torchrl_etl_test/Planted-v0"
