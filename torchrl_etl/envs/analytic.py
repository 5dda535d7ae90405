"""A small overactuated system whose synergies are known in closed form."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from torchrl_etl.checks import check_choice

__all__ = ["AnalyticOveractuated"]


class AnalyticOveractuated(gym.Env):
    """Many muscles drive few joints towards a goal, through a fixed linear map.

    This is the paper's setting reduced to its core. Only the projection of the action on a known
    ``num_joints``-dimensional subspace moves joints, so the task is easy within this subspace.
    Uniform random actions on 16 muscles drive a joint at a sixth (root mean square) of the drive
    that coordinated actions reach, and their effects average out.

    Registered as ``torchrl_etl/Overactuated-v0`` and, with random goals,
    ``torchrl_etl/OveractuatedRandom-v0``, both with episodes of 25 steps.
    ``make_env("overactuated", goal=...)`` builds them.

    Args:
        num_muscles (int): n, number of actuators. Defaults to 16.
        num_joints (int): j, number of joints. Defaults to 2.

    Keyword Args:
        goal (str): ``"fixed"`` draws one goal along with the map, ``"random"`` draws one at each
            reset. Defaults to ``"fixed"``.
        matrix_seed (int): seed of the map and the fixed goal. Defaults to 0.
        effort (float): weight of the mean squared action in the reward. Defaults to 0.01.
        tolerance (float): distance below which the goal is met. Defaults to 0.1.

    Equation:
        With orthonormal rows :math:`B \\in R^{j \\times n}` (``synergy_basis``), the map
        (``muscle_matrix``) is :math:`M_{im} = B_{im} / \\sum_l |B_{il}|`, so that each joint's
        drive :math:`(Ma)_i` spans [-1, 1] over the actions. One step with velocity
        :math:`v`, position :math:`q`, goal :math:`g` and action :math:`a \\in [-1, 1]^n` is

        .. math::
            v' = \\tfrac{1}{2} v + \\tfrac{1}{8} M a, \\quad
            q' = \\mathrm{clip}(q + v', -1, 1), \\quad
            r = -|q' - g| - c \\, |a|^2 / n .

        At reset :math:`v = 0` and :math:`q` is uniform in [-0.05, 0.05].
        Goals lie at a distance of 0.5 to 0.9 from the origin.

    Keys:
        The observation is [q, v, g - q], of size 3j; ``info["solved"]`` is
        :math:`|q' - g| <` ``tolerance``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_etl.envs import AnalyticOveractuated
        >>> env = AnalyticOveractuated(num_muscles=16, num_joints=2)
        >>> env.synergy_basis.shape
        (2, 16)
        >>> bool(np.allclose(env.synergy_basis @ env.synergy_basis.T, np.eye(2)))
        True
    """

    def __init__(
        self,
        num_muscles: int = 16,
        num_joints: int = 2,
        *,
        goal: Literal["fixed", "random"] = "fixed",
        matrix_seed: int = 0,
        effort: float = 0.01,
        tolerance: float = 0.1,
    ):
        if not 1 <= num_joints <= num_muscles:
            raise ValueError(
                f"num_joints is {num_joints}; it must be from 1 to num_muscles={num_muscles}."
            )
        check_choice("goal", goal, ("fixed", "random"))
        rng = np.random.default_rng(matrix_seed)
        self._basis = np.linalg.qr(rng.standard_normal((num_muscles, num_joints)))[0].T
        self._matrix = self._basis / np.abs(self._basis).sum(axis=1, keepdims=True)
        self._fixed_goal = _draw_goal(rng, num_joints) if goal == "fixed" else None
        self._effort = effort
        self._tolerance = tolerance
        self.observation_space = spaces.Box(-np.inf, np.inf, (3 * num_joints,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (num_muscles,), np.float32)

    @property
    def muscle_matrix(self) -> np.ndarray:
        """The map from actions to joint drives, [j, n]."""
        return self._matrix.copy()

    @property
    def synergy_basis(self) -> np.ndarray:
        """An orthonormal basis of the map's row space, [j, n], which synergies should span."""
        return self._basis.copy()

    @property
    def actuator_names(self) -> list[str]:
        """``muscle_0``, ``muscle_1``, ..."""
        return [f"muscle_{i}" for i in range(self._matrix.shape[1])]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        joints = self._matrix.shape[0]
        self._position = self.np_random.uniform(-0.05, 0.05, joints)
        self._velocity = np.zeros(joints)
        self._goal = self._fixed_goal
        if self._goal is None:
            self._goal = _draw_goal(self.np_random, joints)
        return self._observe(), {"solved": False}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        self._velocity = 0.5 * self._velocity + 0.125 * self._matrix @ action
        self._position = np.clip(self._position + self._velocity, -1.0, 1.0)
        distance = float(np.linalg.norm(self._goal - self._position))
        reward = -distance - self._effort * float(np.mean(action**2))
        return self._observe(), reward, False, False, {"solved": distance < self._tolerance}

    def _observe(self) -> np.ndarray:
        parts = (self._position, self._velocity, self._goal - self._position)
        return np.concatenate(parts).astype(np.float32)


def _draw_goal(rng: np.random.Generator, joints: int) -> np.ndarray:
    direction = rng.standard_normal(joints)
    return rng.uniform(0.5, 0.9) * direction / np.linalg.norm(direction)
