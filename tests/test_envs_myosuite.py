"""Hand Pose with the hand of MyoSuite 2, against numbers recorded in MyoSuite 2."""

import numpy as np
import pytest
import torch

from torchrl_etl.envs import make_env, mujoco_state


def recorded_rollout(name, steps=50):
    """Rewards of uniform actions, contacts by step, and the last observation."""
    env = make_env(name)
    env.set_seed(0)
    td, rewards, contacts = env.reset(), [], []
    generator = np.random.default_rng(0)
    data = mujoco_state(env)[1]
    for _ in range(steps):
        action = torch.as_tensor(generator.uniform(-1, 1, 39), dtype=torch.float32)
        after = env.step(td.set("action", action))["next"]
        rewards.append(after["reward"].item())
        contacts.append(data.ncon)
        td = after.exclude("reward")
    return np.array(rewards), np.array(contacts), td["observation"].numpy()


def test_myo2_hand_pose_matches_myosuite_2():
    # Return, contacts and joint angles of the same steps, recorded in myosuite 2.5.0 and 2.12.2
    # with the mujoco of requirements.lock. The two agree to the compared digits.
    rewards, contacts, observation = recorded_rollout("myo2HandPose")
    assert rewards.sum() == pytest.approx(-152.04584, rel=1e-6)
    assert contacts.sum() == 482
    recorded = [0.84379, 0.44273, 0.80945, -0.54541, 0.71967]
    assert observation[:5] == pytest.approx(recorded, abs=1e-4)


def test_hand_pose_of_myosuite_3_differs():
    # If this fails, MyoSuite's Hand Pose has contacts again and may be the old task.
    rewards, contacts, _ = recorded_rollout("myoHandPose")
    assert contacts.sum() == 0
    assert rewards.sum() == pytest.approx(-174.51, abs=0.1)


def test_goals_equal_those_of_myosuite_3():
    for goal in ("fixed", "random"):
        old, new = (make_env(name, goal=goal, seed=0) for name in ("myo2HandPose", "myoHandPose"))
        angles = []
        for env in (old, new):
            env.reset()
            model, simulation = mujoco_state(env)[0], env._env.unwrapped
            names = [model.joint(i).name.removesuffix("_r") for i in range(model.njnt)]
            lowest = simulation.target_jnt_value
            if goal == "random":
                lowest = simulation._target_jnt_range[:, 0]
            angles.append(dict(zip(names, np.round(lowest, 9).tolist(), strict=True)))
        assert list(angles[0]) != list(angles[1])
        assert angles[0] == angles[1]
