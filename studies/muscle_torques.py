"""Torque of each muscle on each joint of a MyoSuite task, in newton metres.

    python studies/muscle_torques.py myoHandPose --joints mcp3 pm3 md3 --out torques.csv

Each torque is for one fully active muscle, all others off, at zero velocity. The posture is the
goal of a pose task, or the initial posture of another task.
"""

from __future__ import annotations

import argparse
import csv
import sys
from contextlib import nullcontext
from pathlib import Path

import mujoco
import numpy as np

from torchrl_etl.command_line import exit_on_error
from torchrl_etl.envs import make_env
from torchrl_etl.envs.joint_torques import active_torques
from torchrl_etl.envs.simulator import mujoco_state, simulator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", nargs="?", default="myoHandPose")
    parser.add_argument("--joints", nargs="*", default=["mcp3", "pm3", "md3"], help="name parts")
    parser.add_argument("--out", type=Path, help="CSV file to write; default: the terminal")
    arguments = parser.parse_args()
    with exit_on_error(ValueError, OSError):
        env = make_env(arguments.task, seed=0)
        env.reset()
        rows = list(torques(env, arguments.joints))
    out = arguments.out
    with out.open("w", newline="", encoding="utf-8") if out else nullcontext(sys.stdout) as file:
        writer = csv.DictWriter(file, ["joint", "muscle", "torque"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def torques(env, parts):
    """Rows for the joints whose names contain one of these parts, the strongest muscle first."""
    model, now = mujoco_state(env)
    joints = [j for j in range(model.njnt) if any(part in model.joint(j).name for part in parts)]
    if not joints:
        names = ", ".join(model.joint(j).name for j in range(model.njnt))
        raise ValueError(f"No joint's name contains any of {parts}; there are {names}.")
    data = mujoco.MjData(model)
    data.qpos[:] = getattr(simulator(env), "target_jnt_value", now.qpos)
    for joint, torque in zip(joints, active_torques(model, data, joints), strict=True):
        for muscle in np.argsort(-np.abs(torque)):
            if abs(torque[muscle]) > 1e-3:
                yield {
                    "joint": model.joint(joint).name,
                    "muscle": model.actuator(int(muscle)).name,
                    "torque": round(float(torque[muscle]), 4),
                }


if __name__ == "__main__":
    main()
