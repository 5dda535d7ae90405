"""DynSyn: recording muscle lengths, and clustering muscles into groups."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sklearn.metrics import adjusted_rand_score
from torch import Tensor
from torchrl.envs import GymWrapper

from torchrl_etl.baselines.muscle_groups import group_muscles, record_muscle_lengths
from torchrl_etl.envs import body_joints, make_env, mujoco_state

GROUPS = [0, 1, 0, 2, 1, 0]


def planted(frames: int = 600, noise: float = 0.01, seed: int = 0) -> Tensor:
    """Noisy lengths of six muscles on three joints, in GROUPS, each in its own units."""
    generator = torch.Generator().manual_seed(seed)
    walk = torch.randn(frames, 3, generator=generator).cumsum(0)
    lengths = walk[:, GROUPS] * torch.tensor([1.0, 1.0, 0.1, 3.0, 7.0, 2.0]) + torch.arange(6.0)
    return lengths + noise * lengths.std(0) * torch.randn(frames, 6, generator=generator)


@pytest.mark.parametrize("seed", range(5))
def test_planted_groups_are_found_and_numbered_by_their_first_members(seed: int) -> None:
    assert group_muscles(planted(seed=seed), 3, seed=seed).tolist() == GROUPS


def test_groups_depend_on_neither_units_nor_order() -> None:
    lengths, order = planted(), torch.randperm(6)
    shuffled = group_muscles((1e-3 * lengths)[:, order], 3)
    expected = [GROUPS[i] for i in order]
    assert adjusted_rand_score(shuffled, expected) == 1
    assert list(dict.fromkeys(shuffled.tolist())) == [0, 1, 2]


def test_similarity_is_the_cosine_of_scaled_lengths_averaged_over_chunks() -> None:
    # Three muscles, already within [0, 1], two chunks of two frames: p (0, .1 | 1, 0),
    # q (.1, 0 | 1, 0), r (0, 1 | 1, 1). Mean cosines over chunks: pq (0 + 1) / 2, pr (1 + .71) / 2,
    # qr .35. Over one chunk of four the large values decide: pq .99, pr .63, qr .57.
    lengths = torch.tensor([[0.0, 0.1, 0.0], [0.1, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    assert group_muscles(lengths, 2, chunk=2).tolist() == [0, 1, 0]
    assert group_muscles(lengths, 2, chunk=4).tolist() == [0, 0, 1]
    for other in (lengths * 7 - 3, lengths.roll(2, 0)):
        assert group_muscles(other, 2, chunk=2).tolist() == [0, 1, 0]


def test_one_group_and_as_many_groups_as_muscles() -> None:
    assert group_muscles(planted(), 6).tolist() == [0, 1, 2, 3, 4, 5]
    assert group_muscles(planted(), 1).tolist() == [0] * 6
    assert group_muscles(planted(), 2).dtype == torch.long


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[:50], "at least 100 frames"),
        (lambda x: x[:, 0], r"need \[frames, muscles\]"),
        (lambda x: x[:, :2], "and 3 muscles"),
        (lambda x: x * torch.tensor([1, 0, 1, 1, 0, 1]), "length of muscle 1, 4 never changes"),
    ],
)
def test_lengths_that_cannot_be_grouped_are_refused(change: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        group_muscles(change(planted()), 3)


# Recording

BODY = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body name="one"><joint name="one" type="hinge" axis="0 0 1" damping="0.01"/>
      <geom size="0.1" mass="1"/></body>
    <body name="two" pos="1 0 0"><joint name="two" type="hinge" axis="0 0 1" damping="0.01"/>
      <geom size="0.1" mass="1"/></body>
    <body name="ball" pos="0 0 2"><freejoint/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator>
    <motor joint="one" gear="2"/><motor joint="two"/><motor joint="one"/><motor joint="two"/>
  </actuator>
</mujoco>
"""


class TwoHinges(gym.Env):
    """Two joints with two actuators each, and a ball that floats; 7 steps an episode."""

    def __init__(self, body: str = BODY) -> None:
        self.model = mujoco.MjModel.from_xml_string(body)
        self.data = mujoco.MjData(self.model)
        size = (self.model.nu,), (self.model.nq,)
        self.action_space = spaces.Box(-1, 1, size[0], np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, size[1], np.float32)
        self.actions: list[np.ndarray] = []
        self.velocities: list[np.ndarray] = []  # as a step begins
        self.after: list[np.ndarray] = []
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.steps = 0
        return self.data.qpos.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.actions.append(action)
        self.velocities.append(self.data.qvel.copy())
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=5)
        self.after.append(self.data.qvel.copy())
        self.steps += 1
        return self.data.qpos.astype(np.float32), 0.0, False, self.steps == 7, {}


def test_recording_draws_joint_velocities_and_holds_free_bodies() -> None:
    inner = TwoHinges()
    lengths = record_muscle_lengths(GymWrapper(inner), 40, amplitude=5.0, every=10, seed=1)
    velocities = np.stack(inner.velocities)
    assert lengths.shape == (40, 4) and not np.any(inner.actions)
    assert not velocities[:, 2:].any()  # the ball's six
    drawn = velocities[::10, :2]
    assert np.abs(drawn).max() <= 5 and np.abs(drawn).max() > 2.5 and len(np.unique(drawn)) == 8
    # Actuator lengths are joint angles times gear; an episode of 7 steps begins at zero again.
    torch.testing.assert_close(lengths[:, 0], 2 * lengths[:, 2])
    torch.testing.assert_close(lengths[:, 1], lengths[:, 3])
    assert not lengths[7::7].any() and lengths[3:7].all()


OBJECT = """
<mujoco>
  <worldbody>
    <body name="arm"><joint name="arm" type="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05" mass="1"/></body>
    <body name="slider" pos="0.2 0 0.09">{joints}<geom size="0.05" mass="0.1"/>
      <body name="knob" pos="0 0 0.06"><joint type="ball"/><geom size="0.01" mass="0.01"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="arm"/></actuator>
</mujoco>
"""
SLIDES = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))


@pytest.mark.parametrize("joints", ["<freejoint/>", SLIDES, '<joint type="hinge" axis="0 1 0"/>'])
def test_recording_keeps_objects_in_place_on_any_joint_type(joints: str) -> None:
    inner = TwoHinges(OBJECT.format(joints=joints))
    colliding = inner.model.geom_contype.copy(), inner.model.geom_conaffinity.copy()
    record_muscle_lengths(GymWrapper(inner), 30, amplitude=50.0, every=3)
    arm, objects = np.abs(inner.data.qvel[:1]), np.abs(np.stack(inner.after)[:, 1:])
    assert arm > 0.2 and not np.abs(np.stack(inner.velocities)[:, 1:]).any()
    assert objects.max() < 0.3  # gravity during one step, and no collision with the arm
    assert (colliding[0] == inner.model.geom_contype).all()
    assert (colliding[1] == inner.model.geom_conaffinity).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", ["myoHandKeyTurn", "myoHandPenTwirl", "myoBaoding", "myoDieReorient", "myoRelocate"]
)
def test_recording_moves_the_hand_and_not_the_object_of_a_task(task: str, monkeypatch: Any) -> None:
    env = make_env(task)
    env.reset()
    model, state = mujoco_state(env)
    objects = np.repeat(~body_joints(model, state), np.diff(model.jnt_dofadr, append=model.nv))
    after: list[np.ndarray] = []
    step = env.step
    monkeypatch.setattr(
        env, "step", lambda data: (step(data), after.append(state.qvel.copy()))[0], raising=False
    )
    record_muscle_lengths(env, 60, amplitude=100.0)
    velocities = np.abs(np.stack(after))
    assert objects.any() and velocities[:, objects].max() < 0.5
    assert velocities[:, ~objects].max() > 5
    env.close()


def test_recording_depends_on_the_seed_alone() -> None:
    env = GymWrapper(TwoHinges())
    one, two, other = (record_muscle_lengths(env, 25, amplitude=5.0, seed=s) for s in (3, 3, 4))
    assert torch.equal(one, two) and not torch.equal(one, other)


def test_muscles_of_one_joint_are_a_group() -> None:
    lengths = record_muscle_lengths(GymWrapper(TwoHinges()), 500, amplitude=5.0)
    assert group_muscles(lengths, 2).tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 0, "amplitude": 1.0}, "frames is 0"),
        ({"frames": 5, "amplitude": 0.0}, "amplitude is 0"),
        ({"frames": 5, "amplitude": 1.0, "every": 0}, "every is 0"),
    ],
)
def test_bad_recordings_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        record_muscle_lengths(GymWrapper(TwoHinges()), **options)


def test_several_simulators_are_refused() -> None:
    with pytest.raises(ValueError, match="num_envs=1"):
        record_muscle_lengths(make_env("overactuated", num_envs=2), 5, amplitude=1.0)


@pytest.mark.slow
def test_two_recordings_of_a_hand_give_mostly_the_same_groups() -> None:
    env = make_env("myoHandPose")
    groups = [
        group_muscles(record_muscle_lengths(env, 1000, amplitude=100.0, seed=seed), 25)
        for seed in (0, 1)
    ]
    env.close()
    assert groups[0].shape == (39,) and int(groups[0].max()) == 24
    assert adjusted_rand_score(*groups) > 0.7
