"""joint_effects against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_etl.analysis import joint_effects

# Two joints and four muscles: a pair of antagonists at each joint.
TORQUES = np.array([[3.0, -3.0, 0.0, 0.0], [0.0, 0.0, 0.5, -0.5]])


def test_opposed_changes_turn_joints_and_co_contraction_does_not():
    opposed = np.array([[0.2, 0.0, 0.3, 0.1], [0.0, 0.2, 0.1, 0.3]])
    common = np.array([[0.2, 0.2, 0.0, 0.0], [0.0, 0.0, 0.3, 0.3]])
    assert joint_effects(opposed, TORQUES).share == pytest.approx(1.0)
    assert joint_effects(common, TORQUES).share == pytest.approx(0.0)
    assert joint_effects(common, TORQUES).gain == pytest.approx(0.0)


def test_single_muscle_has_share_one_half_and_gain_one():
    alone = np.array([[0.0, 0.4, 0.4, 0.4], [1.0, 0.4, 0.4, 0.4]])
    effects = joint_effects(alone, TORQUES)
    # The squared projection of (1, 0, 0, 0) on the joint's row (1, -1, 0, 0) / √2 is 1/2. Each of
    # the four muscles has one entry of ±1/√2, so one muscle has the torque variance of chance.
    assert effects.share == pytest.approx(0.5)
    assert effects.gain == pytest.approx(1.0)


def test_independent_muscles_have_chance_share_and_gain_one():
    noise = np.random.default_rng(0).uniform(size=(200_000, 4))
    effects = joint_effects(noise, TORQUES)
    assert effects.chance == 0.5
    assert effects.share == pytest.approx(0.5, abs=0.005)
    assert effects.gain == pytest.approx(1.0, abs=0.01)


def test_duplicate_joint_does_not_raise_chance():
    doubled = np.concatenate([TORQUES, 2 * TORQUES[:1]])
    assert joint_effects(np.eye(4), doubled).chance == 0.5


@pytest.mark.parametrize(
    ("activations", "torques", "words"),
    [
        (np.eye(3), TORQUES, "activations has 3 muscles and torques has 4"),
        (np.eye(4), np.zeros((1, 4)), "No muscle turns joint 0"),
        (np.ones((5, 4)), TORQUES, "do not vary"),
    ],
)
def test_unusable_activations_and_torques_are_refused(activations, torques, words):
    with pytest.raises(ValueError, match=words):
        joint_effects(activations, torques)
