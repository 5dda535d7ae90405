"""Share of the variance of muscle activations that turns joints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_etl.analysis.arrays import as_matrix

__all__ = ["JointEffects", "joint_effects"]


class JointEffects(NamedTuple):
    """Result of :func:`joint_effects`."""

    share: float
    chance: float
    gain: float


def joint_effects(activations: Tensor | ArrayLike, torques: Tensor | ArrayLike) -> JointEffects:
    """Share of the variance of muscle activations that turns joints, and the resulting torques.

    A change of activations orthogonal to the row space of the torques moves no joint: the torques
    of the muscles cancel out.

    Equation: with Σ the covariance of the activations, M the torques with rows of unit length and
    P the projector on their row space, share = tr(PΣ) / tr(Σ) and
    gain = (tr(MΣMᵀ) / tr(Σ)) / (tr(MMᵀ) / n).

    Args:
        activations (Tensor or array): [*, n].
        torques (Tensor or array): torque of each fully active muscle on each of J joints [J, n],
            from :func:`~torchrl_etl.envs.joint_torques`.

    Returns:
        JointEffects: ``share``, the part of the variance that turns joints, in [0, 1]; ``chance``,
        this share for independent muscles of equal variance, rank(M) / n; ``gain``, the torque
        variance per unit of activation variance, relative to such independent muscles.

    Raises:
        ValueError: if the numbers of muscles differ, a joint has no torque, or activations do not
            vary.

    Examples:
        >>> import numpy as np
        >>> flexor_and_extensor = np.array([[1.0, -1.0]])  # of one joint
        >>> effects = joint_effects([[0.0, 1.0], [1.0, 0.0]], flexor_and_extensor)  # in turn
        >>> round(effects.share, 6), effects.chance, round(effects.gain, 6)
        (1.0, 0.5, 2.0)
        >>> joint_effects([[0.0, 0.0], [1.0, 1.0]], flexor_and_extensor).share  # both at once
        0.0
    """
    activations, torques = as_matrix(activations, "activations"), as_matrix(torques, "torques")
    if activations.shape[1] != torques.shape[1]:
        raise ValueError(
            f"activations has {activations.shape[1]} muscles and torques has {torques.shape[1]}; "
            "pass those of the same body."
        )
    sizes = np.linalg.norm(torques, axis=1, keepdims=True)
    if not sizes.all():
        raise ValueError(
            f"No muscle turns joint {int(np.flatnonzero(sizes == 0)[0])}; leave its row out."
        )
    changes = activations - activations.mean(0)
    total = np.square(changes).sum()
    if total <= 1e-24 * np.square(activations).sum():
        raise ValueError("The activations do not vary; pass those of several coefficients.")
    unit = torques / sizes
    _, values, rows = np.linalg.svd(unit, full_matrices=False)
    rows = rows[values > 1e-6 * values[0]]
    muscles = unit.shape[1]
    share = np.square(changes @ rows.T).sum() / total
    gain = np.square(changes @ unit.T).sum() / total * muscles / np.square(unit).sum()
    return JointEffects(float(share), len(rows) / muscles, float(gain))
