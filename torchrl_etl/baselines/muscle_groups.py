"""Muscle groups, from how muscle lengths vary together (DynSyn, He 2024)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, step_mdp

from torchrl_etl.checks import check_integer, check_real
from torchrl_etl.envs import HeldJoints, body_joints, mujoco_state, root_joints
from torchrl_etl.extras import extra

if TYPE_CHECKING:
    import mujoco

__all__ = ["group_muscles", "record_muscle_lengths"]

_STARTS = 20


def record_muscle_lengths(
    env: EnvBase,
    frames: int,
    *,
    amplitude: float,
    every: int = 10,
    seed: int = 0,
    on_step: Callable[[], None] = lambda: None,
) -> Tensor:
    """Record actuator lengths while a body's joints move at random velocities.

    Every few steps the velocity of each joint is drawn from U(-1, 1)·amplitude; the action is zero
    throughout. Objects, whatever their joints, and a free root begin every step where the episode
    began, and nothing collides with objects: their motion says nothing about muscles.

    Deviates: the original raises legs at 0.1 m/s, moves objects a metre away, and goes on where an
    episode ends, for 500 frames. Here the environment ends episodes, so objects stay in place. The
    original records 500,000 frames.

    Args:
        env (EnvBase): from :func:`~torchrl_etl.envs.make_env`, on MuJoCo, with one simulator. It is
            seeded and reset.
        frames (int): number of steps.

    Keyword Args:
        amplitude (float): largest velocity, in rad/s. The original uses 10 for legs and 100 for
            hands.
        every (int): steps between draws. Default: 10.
        seed (int): seed of the environment and the velocities. Default: 0.
        on_step (callable): called before every step; may raise to stop.

    Returns:
        Tensor: [frames, n], in the simulator's units (metres, for muscles).

    Raises:
        ValueError: for several simulators, one that is not MuJoCo, or sizes that are not positive.

    Examples:
        >>> from torchrl_etl.envs import make_env
        >>> env = make_env("cartpole-balance")
        >>> record_muscle_lengths(env, 20, amplitude=1.0).shape
        torch.Size([20, 1])
    """
    check_integer(1, frames=frames, every=every)
    check_real("(0, inf)", amplitude=amplitude)
    if env.batch_size:
        raise ValueError(
            f"The environment has batch size {list(env.batch_size)}; muscle lengths are recorded "
            "from one simulator, so build it with num_envs=1."
        )
    env.set_seed(seed)
    rng = np.random.default_rng(seed)
    data: TensorDictBase = env.reset()
    rest = env.full_action_spec[env.action_key].zero()
    model, state = mujoco_state(env)
    lengths = np.empty((frames, model.nu), dtype=np.float32)
    held = _Held(model, state)
    for frame in range(frames):
        on_step()
        if frame % every == 0:
            state.qvel[:] = amplitude * rng.uniform(-1, 1, model.nv)
        with held:
            data = env.step(data.set(env.action_key, rest.clone()))
        lengths[frame] = state.actuator_length
        if data["next", "done"].any():
            data = env.reset()
            held.remember()
        else:
            data = step_mdp(data)
    return torch.from_numpy(lengths)


def group_muscles(lengths: Tensor, num_groups: int, *, chunk: int = 100, seed: int = 0) -> Tensor:
    """Group muscles whose lengths vary alike.

    Each muscle's length is scaled to [0, 1] over the recording, which is split into chunks. The
    distance of two muscles is one minus the cosine of their uncentered lengths, averaged over
    chunks, at least zero. k-medoids on these distances gives the groups, from 20 random starts.

    Deviates: the start with the lowest loss is used; the original uses the loss that most
    starts reach. Frames after the last full chunk are left out.

    Args:
        lengths (Tensor): [frames, n], from :func:`record_muscle_lengths`.
        num_groups (int): k ≤ n. The original uses 40 for 80 leg muscles, 25 for 39 of a hand.

    Keyword Args:
        chunk (int): frames in a chunk. Default: 100.
        seed (int): seed of the first start, increased by one for each further one. Default: 0.

    Returns:
        Tensor: group number of each muscle [n], int64; groups are numbered from 0 in the order of
        their first members.

    Raises:
        ValueError: if lengths has another shape, fewer frames than a chunk, fewer muscles than
            groups, or a muscle whose length never changes.

    Examples:
        >>> import torch
        >>> time = torch.linspace(0, 20, 400)
        >>> fast, slow = (3 * time).sin(), time.cos()
        >>> group_muscles(torch.stack([slow, fast, 2 * slow, 5 + fast], -1), 2)
        tensor([0, 1, 0, 1])
    """
    check_integer(1, num_groups=num_groups, chunk=chunk)
    if lengths.ndim != 2 or len(lengths) < chunk or num_groups > lengths.shape[1]:
        raise ValueError(
            f"lengths has shape {tuple(lengths.shape)}; {num_groups} groups from chunks of {chunk} "
            f"frames need [frames, muscles] with at least {chunk} frames and {num_groups} muscles."
        )
    lengths = lengths.double().cpu()
    low, high = lengths.amin(0), lengths.amax(0)
    still = (high == low).nonzero().flatten().tolist()
    if still:
        raise ValueError(
            f"The length of muscle {', '.join(map(str, still))} never changes; record more frames "
            "or a larger amplitude."
        )
    chunks = ((lengths - low) / (high - low)).unfold(0, chunk, chunk)  # [chunks, n, frames]
    chunks = torch.nn.functional.normalize(chunks, dim=-1)
    similarity = (chunks @ chunks.mT).mean(0)
    distance = (1 - similarity).clamp_min(0).numpy()
    with extra("rivals"):
        import kmedoids
    runs = (
        kmedoids.fasterpam(distance, num_groups, init="random", random_state=seed + i, n_cpu=1)
        for i in range(_STARTS)
    )
    return _numbered(min(runs, key=lambda run: run.loss).labels)


def _numbered(labels: np.ndarray) -> Tensor:
    """The same groups, numbered in the order of their first members."""
    _, first, label = np.unique(labels, return_index=True, return_inverse=True)
    return torch.from_numpy(first.argsort().argsort()[label]).long()


class _Held(HeldJoints):
    """Puts objects and a free root back to where the episode began, before every step.

    During a step nothing collides with objects, which fingers would hit again and again. Collision
    masks are restored after each step, since a reset may depend on them.
    """

    def __init__(self, model: mujoco.MjModel, state: mujoco.MjData) -> None:
        own = body_joints(model, state)
        super().__init__(model, state, ~own | root_joints(model, state))
        # Every geom of an object, by its kinematic tree.
        objects = np.unique(model.dof_treeid[model.jnt_dofadr[~own]])
        self._geoms = np.isin(model.body_treeid[model.geom_bodyid], objects)
        self._collide = (model.geom_contype, model.geom_conaffinity)

    def __enter__(self) -> None:
        self.restore()
        self._masks = [mask[self._geoms].copy() for mask in self._collide]
        for mask in self._collide:
            mask[self._geoms] = 0

    def __exit__(self, *error: object) -> None:
        for mask, before in zip(self._collide, self._masks, strict=True):
            mask[self._geoms] = before
