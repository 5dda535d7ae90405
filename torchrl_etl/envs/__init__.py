"""Environments: named tasks, a factory for them, and a small analytic system."""

import gymnasium

from torchrl_etl.envs.analytic import AnalyticOveractuated
from torchrl_etl.envs.body import HeldJoints, body_joints, has_free_root, root_joints
from torchrl_etl.envs.body_synergies import body_decoder, body_synergies, muscle_changes
from torchrl_etl.envs.factory import actuator_names, make_env
from torchrl_etl.envs.joint_torques import JointTorques, excitation, joint_torques
from torchrl_etl.envs.simulator import mujoco_state
from torchrl_etl.envs.spec import EnvironmentSpec
from torchrl_etl.envs.synergy_action_wrapper import SynergyActionWrapper
from torchrl_etl.envs.tasks import Task, episode_length, list_tasks, resolve_task
from torchrl_etl.envs.wrappers import SimulationError

__all__ = [
    "AnalyticOveractuated",
    "EnvironmentSpec",
    "HeldJoints",
    "JointTorques",
    "SimulationError",
    "SynergyActionWrapper",
    "Task",
    "actuator_names",
    "body_decoder",
    "body_joints",
    "body_synergies",
    "episode_length",
    "excitation",
    "has_free_root",
    "joint_torques",
    "list_tasks",
    "make_env",
    "mujoco_state",
    "muscle_changes",
    "resolve_task",
    "root_joints",
]

for _id, _goal in (("Overactuated-v0", "fixed"), ("OveractuatedRandom-v0", "random")):
    gymnasium.register(
        f"torchrl_etl/{_id}",
        entry_point="torchrl_etl.envs.analytic:AnalyticOveractuated",
        max_episode_steps=25,
        kwargs={"goal": _goal},
    )
