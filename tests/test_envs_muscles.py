"""Activations, lengths and names of muscles against the simulators'."""

import pytest
import torch
from torchrl.envs import check_env_specs

from tests.planted_env import PLANTED
from torchrl_etl.envs import actuator_names, make_env


@pytest.mark.parametrize("num_envs", [1, 2])
def test_hand_activation_settles_at_a_constant_action(num_envs):
    env = make_env("myoHandPose", num_envs=num_envs, seed=0, activations=True)
    td = env.reset()
    assert torch.equal(td["activation"], -torch.ones_like(td["activation"]))
    action = torch.linspace(-0.8, 0.8, 39).expand(*env.batch_size, 39)
    for _ in range(60):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    torch.testing.assert_close(td["activation"], action, atol=2e-3, rtol=0)


def test_leg_activation_equals_the_simulators():
    env = make_env("myoLegWalk", seed=0, activations=True)
    td = env.rand_step(env.reset())
    truth = torch.as_tensor(env._env.unwrapped.data.act, dtype=torch.float32)
    torch.testing.assert_close(td["next", "activation"], truth)
    assert not td["activation"].any() and td["next", "activation"].max() > 0


def test_activation_needs_muscles():
    with pytest.raises(ValueError, match=r"fit\.actions=activation\) .*has none"):
        make_env("overactuated", activations=True)


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("name", ["myoHandPose", "myoLegWalk"])
def test_muscle_length_equals_the_simulators(name, num_envs):
    env = make_env(name, num_envs=num_envs, seed=0, muscle_lengths=True)
    simulators = [env._env] if num_envs == 1 else env._env.envs

    def check(td):
        lengths = td["muscle_length"].view(num_envs, -1)
        for entry, simulator in zip(lengths, simulators, strict=True):
            model, data = simulator.unwrapped.model, simulator.unwrapped.data
            truth = [data.actuator(model.actuator(i).name).length[0] for i in range(model.nu)]
            assert entry.dtype == torch.float32
            torch.testing.assert_close(entry, torch.tensor(truth, dtype=torch.float32))

    td = env.reset()
    check(td)
    check(env.rand_step(td)["next"])


def test_exciting_a_muscle_shortens_it():
    env = make_env("myoHandPose", seed=0, muscle_lengths=True)

    def lengths_after(action):
        env.set_seed(0)
        td = env.reset()
        for _ in range(20):
            td = env.step(td.set("action", action))["next"].exclude("reward")
        return td["muscle_length"]

    relaxed = torch.full((39,), -1.0)
    before = lengths_after(relaxed)
    for muscle in (0, 12, 38):
        action = relaxed.clone()
        action[muscle] = 1.0
        assert lengths_after(action)[muscle] < before[muscle] - 1e-3, muscle


def test_env_specs_are_valid_with_lengths_and_activations():
    env = make_env("myoHandPose", num_envs=2, seed=0, activations=True, muscle_lengths=True)
    check_env_specs(env)
    assert env.observation_spec["muscle_length"].shape == (2, 39)


@pytest.mark.parametrize("name", ["overactuated", "humanoid-stand"])
def test_muscle_lengths_need_muscles(name):
    with pytest.raises(ValueError, match=r"muscle_lengths=True \(for method=dep\) needs"):
        make_env(name, muscle_lengths=True)


def test_hand_tasks_have_the_same_muscles_in_the_same_order():
    pose, pen = actuator_names("myoHandPose"), actuator_names("myoHandPenTwirl")
    assert pose == pen and pose[0] == "ECRL" and len(pose) == 39
    assert actuator_names("myoRelocate")[-39:] == pose


def test_leg_muscle_names_end_with_their_side():
    names = actuator_names("myoLegWalk")
    assert {name[-2:] for name in names} == {"_r", "_l"}
    assert names == actuator_names("myoLegStairTerrainWalk")


def test_actuator_names_of_an_environment():
    for num_envs in (1, 2):
        assert actuator_names(make_env("humanoid-stand", num_envs=num_envs))[0] == "abdomen_y"
    without_a_model = make_env(PLANTED)
    count = without_a_model.action_spec.shape[-1]
    assert actuator_names(without_a_model) == [f"actuator_{i}" for i in range(count)]
