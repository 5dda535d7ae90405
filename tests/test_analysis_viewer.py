"""What the controls of the viewer do, without a browser."""

from __future__ import annotations

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential

from torchrl_etl import zoo
from torchrl_etl.analysis.viewer import Session, Subject
from torchrl_etl.analysis.viewer.framing import SHOWN_GROUPS, seen
from torchrl_etl.analysis.viewer.html import activation_grid, driven_list, status
from torchrl_etl.analysis.viewer.muscles import activations, colors, driven_muscles, paths
from torchrl_etl.envs import actuator_names, make_env, mujoco_state, resolve_task
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.training.evaluation import evaluate


def make_decoder(residual: float = 0.0) -> SynergyDecoder:
    return SynergyDecoder.from_directions(
        torch.zeros(16), torch.randn(2, 16) / 4, residual=residual
    )


def constant_policy(value: float, decoder: SynergyDecoder) -> TensorDictSequential:
    """A policy whose coefficients all have one value, followed by the decoder."""

    def emit(observation: torch.Tensor) -> torch.Tensor:
        return observation.new_full((*observation.shape[:-1], decoder.synergy_dim), value)

    return TensorDictSequential(TensorDictModule(emit, ["observation"], ["synergy"]), decoder)


def open_session(**parts) -> Session:
    subject = Subject(
        "an example",
        resolve_task("overactuated"),
        lambda goal: make_env("overactuated", goal=goal),
        actuator_names("overactuated"),
        episode_steps=25,
        first_seed=7,
    )
    parts = parts or {"decoder": make_decoder()}
    return Session(replace(subject, **parts))


def test_paused_session_takes_no_steps():
    session = open_session()
    assert session.advance(10.0) == 0 and session.steps == 0


def test_moving_a_slider_steps_a_paused_session_for_600_ms():
    session = open_session()
    session.move(1, 0.5)
    assert session.advance(0.1, patience=10.0) == 5  # 20 ms a step
    expected = session.subject.decoder(torch.tensor([0.0, 0.5])).detach()
    assert torch.equal(session.action, expected)
    assert sum(session.advance(0.1, patience=10.0) for _ in range(20)) == 25  # 0.6 seconds in all
    assert not session.playing


def test_playing_steps_at_the_set_speed():
    session = open_session()
    session.playing, session.speed = True, 0.5
    assert session.advance(0.4, patience=10.0) == 10
    assert session.steps == 10


def test_slow_simulator_does_not_catch_up_on_missed_time():
    session = open_session()
    session.playing = True
    assert session.advance(3600.0, patience=0.01) < 1000
    assert session.advance(0.02, patience=10.0) == 1


def test_sliders_continue_past_the_end_and_the_policy_starts_an_episode():
    decoder = make_decoder()
    session = open_session(decoder=decoder, policy=constant_policy(0.3, decoder))
    assert session.driver == "policy"
    for _ in range(25):
        session.step()
    assert session.over
    session.move(0, 0.1)
    session.step()
    assert (session.episode, session.steps) == (0, 26)
    session.drive("policy")
    session.step()
    assert (session.episode, session.steps) == (1, 1)


@pytest.mark.parametrize("repeat", [1, 3])
def test_episode_equals_that_of_evaluate(repeat):
    policy, env = zoo.load("overactuated", env=make_env("overactuated", action_repeat=repeat))
    parts = {
        "make_env": lambda goal: env,
        "episode_steps": -(-25 // repeat),
        "action_repeat": repeat,
    }
    session = open_session(policy=policy, **parts)
    session.reset(1)
    while not session.over:
        session.step()
    options = {"max_steps": 25, "action_repeat": repeat, "solved_steps": 6, "seed": 7}
    found = evaluate(policy, env, episodes=2, **options)
    assert session.total_reward == pytest.approx(found.returns[1])
    assert session.solved_steps == found.solved_steps[1] > 6
    assert session.success == found.successes[1]


def test_sliders_show_the_policys_coefficients():
    decoder = make_decoder()
    session = open_session(decoder=decoder, policy=constant_policy(0.25, decoder))
    session.step()
    assert session.coefficients.tolist() == [0.25, 0.25]


def test_a_policy_without_synergies_needs_no_decoder():
    policy = TensorDictModule(lambda x: x.new_full((16,), 0.5), ["observation"], ["action"])
    session = open_session(policy=policy)
    assert session.subject.drivers == ["policy"] and not session.has_residual
    session.step()
    assert session.action.tolist() == [0.5] * 16
    with pytest.raises(ValueError, match="driver is 'sliders'; choose one of policy"):
        session.drive("sliders")


def test_policy_with_the_residual_off_acts_through_synergies_only():
    decoder = make_decoder(residual=0.5)
    session = open_session(decoder=decoder, policy=constant_policy(0.25, decoder))
    assert session.has_residual
    session.step()
    whole = session.action
    session.residual = False
    session.step()
    alone = decoder(torch.cat([torch.full((2,), 0.25), torch.zeros(16)])).detach()
    assert torch.equal(session.action, alone) and not torch.equal(whole, alone)


def test_stage_1_policy_follows_the_chosen_direction():
    seen = []

    def act(observation: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        seen.append(direction.clone())
        return observation.new_zeros(16)

    explorer = TensorDictModule(act, ["observation", "direction"], ["action"])
    session = open_session(explorer=explorer, direction_dim=3)
    session.step()
    session.follow(torch.tensor([0.0, -2.0, 0.0]))
    session.step()
    assert [direction.tolist() for direction in seen] == [[1, 0, 0], [0, -1, 0]]
    with pytest.raises(ValueError, match="3 numbers, not all zero"):
        session.follow(torch.zeros(3))


def test_choosing_a_goal_starts_an_episode_in_a_new_simulator():
    session = open_session()
    first = session.env
    session.step()
    session.choose_goal("random")
    assert session.env is not first and session.goal == "random" and session.steps == 0
    with pytest.raises(ValueError, match="goal is 'near'; choose one of fixed, random"):
        session.choose_goal("near")


def test_goal_that_cannot_be_built_keeps_the_old_simulator():
    session = open_session()

    def make(goal):
        if goal == "random":
            raise ValueError("no such simulator")
        return make_env("overactuated", goal=goal)

    session = Session(replace(session.subject, make_env=make))
    session.step()
    with pytest.raises(ValueError, match="no such simulator"):
        session.choose_goal("random")
    session.step()
    assert session.goal == "fixed" and session.steps == 2 and not session.env.is_closed


def test_subject_without_policy_and_synergies_is_refused():
    with pytest.raises(ValueError, match="neither a policy nor synergies"):
        open_session(decoder=None)


def test_coefficient_outside_the_box_is_refused():
    with pytest.raises(ValueError, match=re.escape("in [-1, 1]")):
        open_session().move(0, 1.5)


def test_sliders_move_joints_while_the_root_is_held():
    names = actuator_names("humanoid-stand")
    directions = torch.zeros(1, len(names))
    directions[0, names.index("right_elbow")] = 0.9
    decoder = SynergyDecoder.from_directions(torch.zeros(len(names)), directions)
    make = lambda goal: make_env("humanoid-stand")  # noqa: E731
    with Session(Subject("", resolve_task("humanoid-stand"), make, names, decoder)) as session:
        place, elbow = session.data.qpos[:7].copy(), session.data.joint("right_elbow")
        before = elbow.qpos.item()
        session.move(0, 1.0)
        for _ in range(5):
            session.step()
        np.testing.assert_array_equal(session.data.qpos[:7], place)
        assert elbow.qpos.item() > before + 0.1
        session.hold = False
        session.step()
        assert session.data.qpos[2] != place[2]


# A small body: a motor on a hinge, and a muscle whose tendon runs straight up.
BODY = """
<mujoco>
  <worldbody>
    <site name="low" pos="0 0 0"/>
    <body name="box" pos="0 0 1">
      <joint name="hinge" axis="0 1 0"/>
      <geom size=".1"/>
      <site name="high" pos="0 0 0"/>
    </body>
  </worldbody>
  <tendon><spatial name="cord"><site site="low"/><site site="high"/></spatial></tendon>
  <actuator>
    <motor joint="hinge" ctrlrange="-2 2"/>
    <muscle tendon="cord" ctrllimited="true" ctrlrange="0 1" lengthrange=".5 1.5"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def body() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(BODY)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_paths_follow_tendon_sites_and_motors_sit_at_their_joints(body):
    path = paths(*body)
    np.testing.assert_allclose(path.start, [[0, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(path.end, [[0, 0, 1], [0, 0, 1]], atol=1e-12)
    assert path.actuator.tolist() == [1, 0]


def test_activation_is_a_muscles_state_and_a_motors_control(body):
    model, data = body
    data.ctrl[:], data.act[:] = [-1.0, 0.9], [0.25]
    assert activations(model, data).tolist() == [-0.5, 0.25]


def test_rest_pull_and_push_have_distinct_colors():
    rest, pull, push = colors(np.array([0.0, 1.0, -1.0])).astype(int)
    assert pull[0] > rest[0] > push[0] and push[2] > rest[2] > pull[2]


def test_driven_muscles_are_sorted_by_effect_without_weak_ones():
    directions = torch.tensor([[0.0, 0.5, -1.0], [0.001, 0.0, 0.0]])
    decoder = SynergyDecoder.from_directions(torch.zeros(3), directions)
    first, second = driven_muscles(decoder, ["a", "b", "c"])
    assert [name for name, _ in first] == ["c", "b"] and second == []
    # (tanh 1 - tanh -1) / 2, of a range of 2.
    assert first[0][1] == pytest.approx(-np.tanh(1.0))


def test_model_names_are_escaped_in_html():
    assert "<b>" not in driven_list([("<b>", 0.5)])
    assert "<b>" not in activation_grid(["<b>"], np.zeros(1))


def test_status_shows_the_return_and_whether_the_episode_is_solved():
    session = open_session()
    assert "return <b>0.0</b>" in status(session) and "0 steps of 6 needed" in status(session)
    session.solved, session.solved_steps = True, 6
    assert session.success and "<b>solved</b>" in status(session)


@pytest.mark.parametrize(
    ("task", "under_a_skin"), [("dog-walk", 144), ("myoElbowPose1D6MRandom-v0", 0)]
)
def test_bones_under_a_skin_are_shown(task, under_a_skin):
    env = make_env(task)
    model, _ = mujoco_state(env)
    usual = model.geom_group < SHOWN_GROUPS
    assert (seen(model) & ~usual).sum() == under_a_skin
    assert (seen(model) | ~usual).all()
    env.close()
