"""Published learning curves, for comparison with a sweep.

``published_curves.csv`` holds means over seeds at 100k to 1M environment frames, taken from the
public results of FlashSAC and of the baselines that it ships: SimbaV2, XQC, TD-MPC2, MR.Q and PPO.
None of them was measured here, and no spread over seeds was published.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np

from torchrl_etl.envs import list_tasks

__all__ = ["PublishedCurve", "best_published", "caveats", "environment_id", "published_curves"]

_NAMES = {"simbaV2": "SimbaV2", "xqc": "XQC", "tdmpc2": "TD-MPC2", "mrq": "MR.Q"}

# Names of MyoSuite 3's task, the first of which stands for all.
_NEW_HAND_POSE = ("myoHandPose", "myoHandPoseFixed-v0", "myoHandPoseRandom-v0")

# Episodes of varying length put evaluations slightly off round numbers of frames.
_TOLERANCE = 0.05


@dataclass(frozen=True)
class PublishedCurve:
    """Mean over ``seeds`` seeds of ``values`` at environment ``frames``, as published."""

    algorithm: str
    frames: tuple[int, ...]
    values: tuple[float, ...]
    seeds: int

    def at(self, frames: float) -> float | None:
        """The value at ``frames``, interpolated linearly; None outside the published range.

        Examples:
            >>> curve = PublishedCurve("SAC", (100_000, 200_000), (10.0, 30.0), 5)
            >>> curve.at(150_000), curve.at(99_000), curve.at(20_000)
            (20.0, 10.0, None)
        """
        first, last = self.frames[0] * (1 - _TOLERANCE), self.frames[-1] * (1 + _TOLERANCE)
        if not first <= frames <= last:
            return None
        return float(np.interp(frames, self.frames, self.values))


def environment_id(task: str, goal: str = "fixed") -> str:
    """The environment id under which results of a task were published.

    Unlike :func:`~torchrl_etl.envs.resolve_task`, it builds and imports nothing and returns unknown
    names unchanged, since results may outlive their environments. Hand Pose was published with the
    hand of MyoSuite 2, and not with that of MyoSuite 3.

    Examples:
        >>> environment_id("myoHandKeyTurn", "random"), environment_id("dog-run")
        ('myoHandKeyTurnRandom-v0', 'dog-run')
        >>> environment_id("myo2HandPose"), environment_id("torchrl_etl/Myo2HandPoseFixed-v0")
        ('myoHandPoseFixed-v0', 'myoHandPoseFixed-v0')
        >>> environment_id("myoHandPose"), environment_id("myoHandPoseFixed-v0")
        ('myoHandPose', 'myoHandPose')
    """
    if task in _NEW_HAND_POSE:
        return _NEW_HAND_POSE[0]
    name = re.sub(r"^(torchrl_etl/M|m)yo2", "myo", task)
    for known in list_tasks():
        if known.name == name:
            return replace(known, goal=goal).env_id
    return name


def published_curves(env_id: str, metric: str = "return") -> tuple[PublishedCurve, ...]:
    """Published curves of an environment, see :func:`environment_id`, sorted by algorithm. The
    metric is ``"return"`` or ``"success"``, the share of solved episodes.

    Examples:
        >>> [curve.algorithm for curve in published_curves("myoHandPoseFixed-v0")]
        ['FlashSAC', 'PPO', 'SimbaV2']
        >>> published_curves("myoLegWalk-v0")
        ()
    """
    return _table().get((env_id, metric), ())


def best_published(env_id: str, frames: float) -> tuple[float, str] | None:
    """The highest published return at this number of frames, and its algorithm.

    Examples:
        >>> best_published("myoHandPoseFixed-v0", 100_000)
        (683.46, 'FlashSAC')
        >>> best_published("myoHandPoseFixed-v0", 10_000) is None
        True
    """
    found = [
        (value, curve.algorithm)
        for curve in published_curves(env_id)
        if (value := curve.at(frames)) is not None
    ]
    return max(found, default=None)


def caveats(env_id: str) -> str:
    """Caveats to print with the published curves of an environment.

    Examples:
        >>> print(caveats("dog-run"))
        Published: means over seeds from the public results of FlashSAC and of the baselines that \
it ships, not measured here; no spread was published; their wrappers differ from those here \
(TD-MPC2 ignores termination).
    """
    differences = ["TD-MPC2 ignores termination"]
    if env_id.startswith("myo"):
        differences.insert(0, "SimbaV2 takes each action for two steps")
    if "KeyTurn" in env_id:
        differences.insert(0, "SimbaV2 cuts Key Turn at 100 steps")
    return (
        "Published: means over seeds from the public results of FlashSAC and of the baselines that "
        "it ships, not measured here; no spread was published; their wrappers differ from "
        f"those here ({'; '.join(differences)})."
    )


@cache
def _table() -> dict[tuple[str, str], tuple[PublishedCurve, ...]]:
    points: dict[tuple[str, str, str, int], list[tuple[int, float]]] = {}
    source = files("torchrl_etl.analysis") / "published_curves.csv"
    with source.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            name = _NAMES.get(row["algorithm"], row["algorithm"])
            key = row["env"], row["metric"], name, int(row["seeds"])
            points.setdefault(key, []).append((int(row["env_frames"]), float(row["mean"])))
    table: dict[tuple[str, str], tuple[PublishedCurve, ...]] = {}
    for (env, metric, name, seeds), pairs in sorted(points.items()):
        frames, values = zip(*sorted(pairs), strict=True)
        curve = PublishedCurve(name, frames, values, seeds)
        table[env, metric] = (*table.get((env, metric), ()), curve)
    return table
