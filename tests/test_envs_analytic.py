"""The analytic system, which only actions in a known subspace move."""

import numpy as np
import pytest

from torchrl_etl.envs import AnalyticOveractuated, make_env


def play(env, policy, seed, steps=25):
    observation, _ = env.reset(seed=seed)
    solved = False
    for _ in range(steps):
        observation, _, _, _, info = env.step(policy(observation))
        solved |= info["solved"]
    return observation, solved


def test_one_step_by_hand():
    env = AnalyticOveractuated(4, 2, effort=0.5)
    start, _ = env.reset(seed=0)
    action = np.array([1.0, -0.5, 0.25, 0.0])
    observation, reward, *_ = env.step(action)
    velocity = 0.125 * env.muscle_matrix @ action
    position = start[:2] + velocity
    goal = start[4:] + start[:2]
    np.testing.assert_allclose(observation, [*position, *velocity, *(goal - position)], atol=1e-6)
    effort = 0.5 * (1 + 0.25 + 0.0625) / 4
    np.testing.assert_allclose(reward, -np.linalg.norm(goal - position) - effort, atol=1e-6)


def test_synergy_basis_is_orthonormal_and_spans_the_row_space():
    env = AnalyticOveractuated(12, 3, matrix_seed=4)
    basis, matrix = env.synergy_basis, env.muscle_matrix
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(matrix @ basis.T @ basis, matrix, atol=1e-12)
    np.testing.assert_allclose(np.abs(matrix).sum(axis=1), 1)


def test_actions_outside_the_subspace_move_nothing():
    env = AnalyticOveractuated()
    basis = env.synergy_basis
    rng = np.random.default_rng(0)

    def idle(_):
        action = 0.2 * rng.standard_normal(16)
        return action - basis.T @ (basis @ action)

    start, _ = env.reset(seed=1)
    end, _ = play(env, idle, seed=1)
    np.testing.assert_allclose(end[:2], start[:2], atol=1e-6)


def test_actions_in_the_subspace_solve_the_task_and_noise_does_not():
    env = AnalyticOveractuated(goal="random")
    matrix = env.muscle_matrix
    rng = np.random.default_rng(0)

    def synergies(observation):
        velocity, error = observation[2:4], observation[4:]
        drive = np.clip(8 * (0.5 * error - 0.5 * velocity), -1, 1)
        return np.clip(np.linalg.pinv(matrix) @ drive, -1, 1)

    def noise(_):
        return rng.uniform(-1, 1, 16)

    seeds = range(50)
    assert np.mean([play(env, synergies, seed)[1] for seed in seeds]) == 1
    assert np.mean([play(env, noise, seed)[1] for seed in seeds]) < 0.1


def test_muscle_matrix_depends_on_matrix_seed_only():
    first, again = AnalyticOveractuated(matrix_seed=1), AnalyticOveractuated(matrix_seed=1)
    other = AnalyticOveractuated(matrix_seed=2)
    first.reset(seed=3)
    np.testing.assert_array_equal(first.muscle_matrix, again.muscle_matrix)
    assert not np.allclose(first.muscle_matrix, other.muscle_matrix)


def test_fixed_goal_is_constant_and_random_goal_varies():
    fixed, moving = (
        make_env("overactuated", seed=0),
        make_env("overactuated", goal="random", seed=0),
    )

    def goals(env):
        starts = (env.reset()["observation"] for _ in range(4))
        return {tuple((o[:2] + o[4:]).numpy().round(4)) for o in starts}

    assert len(goals(fixed)) == 1
    assert len(goals(moving)) == 4


def test_episodes_are_truncated_after_25_steps():
    rollout = make_env("overactuated", num_envs=2, seed=0).rollout(30)
    assert rollout.shape == (2, 25)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["next", "terminated"].any()


def test_factory_passes_constructor_arguments():
    env = make_env("overactuated", env_kwargs={"num_muscles": 40, "num_joints": 3})
    assert env.action_spec.shape == (40,)


def test_more_joints_than_muscles_are_refused():
    with pytest.raises(ValueError, match=r"num_joints is 3; .*num_muscles=2"):
        AnalyticOveractuated(2, 3)
