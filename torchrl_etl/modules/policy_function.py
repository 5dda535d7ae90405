"""Calls a policy without TensorDict or TorchRL."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import ExplorationType, set_exploration_type

__all__ = ["policy_function"]


def policy_function(
    policy: TensorDictModuleBase,
    *,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
) -> Callable[[ArrayLike], np.ndarray]:
    """Wrap a policy as a deterministic function from NumPy observations to NumPy actions.

    The policy is held by reference: the function follows its training.

    Args:
        policy (TensorDictModuleBase): reads one key and writes the action, perhaps among others.

    Keyword Args:
        observation_key, action_key (NestedKey): the policy's input, and the output to return.
            ``"synergy"`` returns the coefficients of a policy that acts through a decoder.

    Returns:
        callable: maps an observation [*, O] to an action [*, n] in single precision.

    Raises:
        ValueError: if the policy reads any other key, or does not write ``action_key``.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import make_actor
        >>> act = policy_function(make_actor({"observation": 3}, Bounded(-1, 1, shape=(2,))))
        >>> act(np.zeros(3)).shape, act(np.zeros((5, 3))).shape
        ((2,), (5, 2))
    """
    if list(policy.in_keys) != [observation_key] or action_key not in policy.out_keys:
        raise ValueError(
            f"The policy reads {list(policy.in_keys)} and writes {list(policy.out_keys)}; it must "
            f"read only {observation_key!r} and write {action_key!r}; otherwise pass other keys."
        )

    @torch.no_grad()
    def act(observation: ArrayLike) -> np.ndarray:
        weight = next(policy.parameters(), torch.empty(0))
        seen = torch.as_tensor(np.asarray(observation)).to(weight)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = policy(TensorDict({observation_key: seen}, seen.shape[:-1]))
        action = written[action_key]
        return (action.float() if action.is_floating_point() else action).cpu().numpy()

    return act
