"""What each muscle can do to each joint of a MyoSuite task, in newton metres.

    python benchmarks/muscle_torques.py myoHandPose --joints mcp3 pm3 md3 --out torques.csv

The torque on a joint of one muscle at full activation, all others off, at rest in the goal posture
of a pose task, or in the initial posture of another.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import mujoco
import numpy as np

from torchrl_etl.command_line import one_sentence
from torchrl_etl.envs import make_env
from torchrl_etl.envs.simulator import simulator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", nargs="?", default="myoHandPose")
    parser.add_argument("--joints", nargs="*", default=["mcp3", "pm3", "md3"], help="name parts")
    parser.add_argument("--out", type=Path, help="CSV file to write; default: the terminal")
    arguments = parser.parse_args()
    with one_sentence(ValueError, OSError):
        env = make_env(arguments.task, seed=0)
        env.reset()
        rows = list(torques(simulator(env), arguments.joints))
    with arguments.out.open("w", newline="") if arguments.out else sys.stdout as file:
        writer = csv.DictWriter(file, ["joint", "muscle", "torque"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def torques(simulation, parts):
    """Rows for the joints whose names contain one of these parts, the strongest muscle first."""
    model, data = simulation.model, mujoco.MjData(simulation.model)
    joints = [j for j in range(model.njnt) if any(part in model.joint(j).name for part in parts)]
    if not joints:
        names = ", ".join(model.joint(j).name for j in range(model.njnt))
        raise ValueError(f"No joint's name contains any of {parts}; there are {names}.")
    data.qpos[:] = getattr(simulation, "target_jnt_value", simulation.data.qpos)
    forces = np.empty((model.na + 1, model.nv))
    for muscle in range(-1, model.na):  # -1: all are off, which leaves passive forces
        data.act[:] = 0.0
        data.act[max(muscle, 0)] = float(muscle >= 0)
        mujoco.mj_forward(model, data)
        forces[muscle] = data.qfrc_actuator
    active = forces[:-1] - forces[-1]
    for joint in joints:
        torque = active[:, model.jnt_dofadr[joint]]
        for muscle in np.argsort(-np.abs(torque)):
            if abs(torque[muscle]) > 1e-3:
                yield {
                    "joint": model.joint(joint).name,
                    "muscle": model.actuator(int(muscle)).name,
                    "torque": round(float(torque[muscle]), 4),
                }


if __name__ == "__main__":
    main()
