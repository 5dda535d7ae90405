"""joint_torques on a body with known moment arms, and on MyoSuite's bodies."""

from __future__ import annotations

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from torchrl.envs import GymWrapper

from torchrl_etl.analysis import joint_effects
from torchrl_etl.envs import excitation, joint_torques, make_env, mujoco_state
from torchrl_etl.envs.muscles import sends_sigmoid
from torchrl_etl.envs.wrappers import NamedObservation

# A hinge with a flexor and an extensor of moment arms 0.02 and 0.03 m, and a slide, coupled to the
# hinge, with a third muscle of arm 1. Tendons are fixed, so arms are the same in all postures.
BODY = """
<mujoco>
  <worldbody>
    <body>
      <joint name="knee" type="hinge" axis="0 1 0" limited="true" range="-0.5 0.5"/>
      <geom size="0.1" mass="1"/>
      <body>
        <joint name="cap" type="slide" axis="1 0 0" limited="true" range="-1 1"/>
        <geom size="0.1" mass="1"/>
      </body>
    </body>
    <body pos="5 0 0">
      <joint name="loose" type="hinge" axis="0 1 0"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="flexor"><joint joint="knee" coef="-0.02"/></fixed>
    <fixed name="extensor"><joint joint="knee" coef="0.03"/></fixed>
    <fixed name="slider"><joint joint="cap" coef="-1"/></fixed>
  </tendon>
  <equality><joint joint1="cap" joint2="knee" polycoef="0 0.1 0 0 0"/></equality>
  <actuator>
    <muscle name="flexor" tendon="flexor" force="100" lengthrange="-1 1"/>
    <muscle name="extensor" tendon="extensor" force="100" lengthrange="-1 1"/>
    <muscle name="slider" tendon="slider" force="100" lengthrange="-3 3"/>
  </actuator>
</mujoco>
"""


class Body(gym.Env):
    observation_space = action_space = gym.spaces.Box(0.0, 1.0, (3,), np.float32)

    def __init__(self, text: str = BODY):
        self.model = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.model)


@pytest.fixture
def body():
    return Body()


def test_torques_are_moment_arms_times_forces_summed_over_coupled_joints(body):
    torques = joint_torques(body, num_postures=1)
    assert torques.joints == ("knee",)  # the slide is coupled to it, and no muscle turns the third
    flexor, extensor, slider = torques.matrix[0]
    # With the same peak force F of all three muscles: F·0.02, -F·0.03 and 0.1·F·1.
    assert flexor > 0
    assert extensor / flexor == pytest.approx(-1.5, rel=1e-6)
    assert slider / flexor == pytest.approx(5.0, rel=1e-6)


def test_joint_torques_keep_the_state_of_the_simulator(body):
    body.data.qpos[0], body.data.act[:] = 0.1, 0.3
    joint_torques(body, num_postures=3)
    assert body.data.qpos[0] == 0.1
    assert (body.data.act == 0.3).all()


def test_postures_depend_on_seed_and_spread(body):
    one, again, other = (joint_torques(body, num_postures=5, seed=s).matrix for s in (0, 0, 1))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
    still = joint_torques(body, num_postures=5, spread=0.0).matrix
    assert still == pytest.approx(joint_torques(body, num_postures=1).matrix)


def test_bodies_with_other_actuators_than_muscles_are_refused():
    motors = BODY.replace(
        '<muscle name="slider" tendon="slider" force="100" lengthrange="-3 3"/>',
        '<motor name="slider" tendon="slider"/>',
    )
    with pytest.raises(
        ValueError, match="has 3 actuators, 2 of them muscles, and actions with 3 entries"
    ):
        joint_torques(Body(motors))
    with pytest.raises(ValueError, match="MuJoCo"):
        joint_torques(make_env("overactuated"))


def test_legs_turn_seven_joints_each_and_the_sides_mirror():
    env = make_env("myoLegWalk", seed=0)
    env.reset()
    joints, matrix = joint_torques(env, num_postures=2)
    assert len(joints) == 14
    assert matrix.shape == (14, 80)
    right, left = joints[:7], joints[7:]
    assert [name.removesuffix("_r") for name in right] == [name.removesuffix("_l") for name in left]
    # No muscle turns joints of both sides.
    assert not ((np.abs(matrix[:7]).max(0) > 1e-6) & (np.abs(matrix[7:]).max(0) > 1e-6)).any()


def test_uniform_noise_on_a_hand_has_chance_share():
    env = make_env("myoHandPenTwirl", seed=0)
    env.reset()
    torques = joint_torques(env, num_postures=2)
    noise = np.random.default_rng(0).uniform(size=(20_000, 39))
    effects = joint_effects(noise, torques.matrix)
    assert effects.chance == pytest.approx(23 / 39)
    assert effects.share == pytest.approx(effects.chance, abs=0.01)


@pytest.mark.parametrize("task", ["myoHandPenTwirl", "myoLegWalk"])
def test_excitation_equals_the_simulators_controls(task):
    env = make_env(task, seed=0)
    action = env.reset()
    action["action"] = env.action_spec.rand()
    env.step(action)
    driven = torch.from_numpy(mujoco_state(env)[1].ctrl.copy()).float()
    assert torch.allclose(excitation(env, action["action"]), driven, atol=1e-6)


@pytest.mark.parametrize(("low", "flag", "sigmoid"), [(0.0, None, False), (-1.0, True, True)])
def test_bounds_and_flag_of_a_custom_body_define_its_excitation(body, low, flag, sigmoid):
    body.action_space, body.normalize_act = gym.spaces.Box(low, 1.0, (3,)), flag
    assert sends_sigmoid(body, body.action_space.low, body.action_space.high) is sigmoid
    parts = NamedObservation(body, activations=True, muscle_lengths=True).observation_space
    assert parts["activation"].shape == parts["muscle_length"].shape == (3,)


@pytest.mark.parametrize("flag", [None, False])
def test_custom_body_with_undefined_excitation_is_refused(body, flag):
    body.action_space, body.normalize_act = gym.spaces.Box(-1.0, 1.0, (3,)), flag
    env = GymWrapper(body)
    for asked in (
        lambda: excitation(env, torch.zeros(3)),
        lambda: NamedObservation(body, activations=True),
    ):
        with pytest.raises(ValueError, match="Body has actions below 0 and does not define how"):
            asked()
