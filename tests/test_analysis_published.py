"""Published curves belong to known tasks and come with caveats about what differs."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from torchrl_etl.analysis.published import best_published, caveats, environment_id, published_curves
from torchrl_etl.envs import list_tasks, resolve_task


def test_published_rows_belong_to_known_tasks():
    published = {
        environment_id(task.name, goal)
        for task in (*list_tasks(), resolve_task("myo2HandPose"))
        for goal in task.goals
        if published_curves(environment_id(task.name, goal))
    }
    hands = ("Pose", "KeyTurn", "PenTwirl")
    assert published == {
        *(f"myoHand{name}{goal}-v0" for name in hands for goal in ("Fixed", "Random")),
        *(f"humanoid-{name}" for name in ("stand", "walk", "run")),
        *("dog-walk", "dog-run"),
    }
    path = Path(__file__).parent.parent / "torchrl_etl" / "analysis" / "published_curves.csv"
    with path.open() as file:
        assert {line["env"] for line in csv.DictReader(file)} == published


def test_published_best_and_caveats():
    assert best_published("dog-run", 100_000) == (118.33, "XQC")
    # Interpolated between the published points of XQC, 310.14 and 449.96.
    value, algorithm = best_published("dog-run", 400_000)
    assert (value, algorithm) == (pytest.approx((310.14 + 449.96) / 2), "XQC")
    assert best_published("dog-run", 50_000) is best_published("myoLegWalk-v0", 100_000) is None
    assert "SimbaV2 cuts Key Turn at 100 steps" in caveats("myoHandKeyTurnFixed-v0")
    assert "each action for two" in caveats("myoHandPoseFixed-v0")
    elsewhere = caveats("dog-run")
    assert "SimbaV2" not in elsewhere and "TD-MPC2 ignores termination" in elsewhere
    success = {curve.algorithm for curve in published_curves("myoHandPoseFixed-v0", "success")}
    assert {"TD-MPC2", "XQC"} < success
