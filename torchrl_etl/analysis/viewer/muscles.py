"""Muscle data for the viewer: strengths, activations, paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchrl_etl.analysis.diagnostics import synergy_effects
from torchrl_etl.extras import extra
from torchrl_etl.modules import SynergyMap

with extra("viewer"):
    import mujoco

__all__ = ["Path", "activations", "colors", "driven_muscles", "paths", "pulled_tendons"]

_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_WRAPPED_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)

_LEAST = 0.01  # smallest strength that is listed
# Colours of rest, half and full activation, and of half and full negative activation.
_REST, _HALF, _FULL = np.array([[60, 72, 102], [226, 74, 60], [216, 0, 32]], float)
_HALF_BACK, _FULL_BACK = np.array([[67, 147, 195], [0, 92, 190]], float)


def driven_muscles(decoder: SynergyMap, names: Sequence[str]) -> list[list[tuple[str, float]]]:
    """Names and strengths of the muscles that each synergy drives, the strongest first.

    Strengths are from :func:`~torchrl_etl.analysis.synergy_effects`, in [-1, 1].

    Examples:
        >>> import torch
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> directions = torch.tensor([[0.0, 0.5, -1.0]])
        >>> decoder = SynergyDecoder.from_directions(torch.zeros(3), directions)
        >>> [(name, round(strength, 2)) for name, strength in driven_muscles(decoder, "abc")[0]]
        [('c', -0.76), ('b', 0.46)]
    """
    driven = []
    for effects in synergy_effects(decoder).cpu().numpy():
        order = np.argsort(-np.abs(effects), kind="stable")
        driven.append([(names[i], float(effects[i])) for i in order if abs(effects[i]) >= _LEAST])
    return driven


def activations(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Activation [nu]: in [0, 1] for muscles, relative control in [-1, 1] for motors."""
    stateful = (model.actuator_actnum == 1) & (
        model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_MUSCLE)
    )
    reach = np.abs(model.actuator_ctrlrange).max(1)
    active = data.ctrl / np.where(reach > 0, reach, 1.0)
    active[stateful] = data.act[model.actuator_actadr[stateful]]
    return np.clip(active, -1.0, 1.0)


def colors(active: np.ndarray) -> np.ndarray:
    """Colours [*, 3], uint8, of activations in [-1, 1]: slate at 0, red above and blue below."""
    size = np.abs(active)[..., None]
    half = np.where(active[..., None] < 0, _HALF_BACK, _HALF)
    full = np.where(active[..., None] < 0, _FULL_BACK, _FULL)
    low, high = np.minimum(2 * size, 1.0), np.clip(2 * size - 1.0, 0.0, 1.0)
    return np.rint(_REST + low * (half - _REST) + high * (full - half)).astype(np.uint8)


class Path(NamedTuple):
    """Line segments for drawing actuators.

    ``start`` and ``end`` [P, 3] are world coordinates. ``actuator`` [P] is the index of the
    actuator, -1 for a tendon without one. A segment of zero length is a joint turned by a motor.
    """

    start: np.ndarray
    end: np.ndarray
    actuator: np.ndarray


def paths(model: mujoco.MjModel, data: mujoco.MjData) -> Path:
    """Current tendon paths with their wrapping, and the joints of actuators without a path."""
    start, end, owner = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0, int)]
    points, objects = data.wrap_xpos.reshape(-1, 3), data.wrap_obj.reshape(-1)
    pulled = pulled_tendons(model)
    for tendon in range(model.ntendon):
        first, count = int(data.ten_wrapadr[tendon]), int(data.ten_wrapnum[tendon])
        here = np.arange(first, first + count - 1)
        here = here[(objects[here] != -2) & (objects[here + 1] != -2)]  # -2: a pulley
        start.append(points[here])
        end.append(points[here + 1])
        owner.append(np.full(len(here), pulled.get(tendon, -1)))
    joints, motors = turned_joints(model)
    start.append(data.xanchor[joints])
    end.append(data.xanchor[joints])
    owner.append(motors)
    return Path(np.concatenate(start), np.concatenate(end), np.concatenate(owner))


def pulled_tendons(model: mujoco.MjModel) -> dict[int, int]:
    """Tendons to the actuators that pull them."""
    return {
        int(model.actuator_trnid[i, 0]): i
        for i in range(model.nu)
        if model.actuator_trntype[i] == _TENDON
    }


def turned_joints(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Joints turned by actuators without a spatial path, and these actuators, [J] each."""
    pairs = []
    for actuator in range(model.nu):
        kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
        if kind in _JOINTS:
            pairs.append((target, actuator))
        elif kind == _TENDON:
            first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
            for wrap in range(first, first + count):
                if int(model.wrap_type[wrap]) == _WRAPPED_JOINT:
                    pairs.append((int(model.wrap_objid[wrap]), actuator))
    joints, actuators = np.array(pairs, int).reshape(-1, 2).T
    return joints, actuators
