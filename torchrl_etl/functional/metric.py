"""Latent exploration (Eqs. 1-6): bonus, behavioral metric, its regularizer and diagnostics."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from torchrl_etl.checks import check_choice, check_real

__all__ = [
    "direction_bonus",
    "discriminability",
    "effective_rank",
    "expected_distance",
    "gaussian_w2",
    "l2_distance",
    "metric_loss",
    "metric_target",
    "mico_distance",
]

# Added inside square roots: too small to show in float32 distances, large enough that the gradient
# of the root at zero is zero instead of NaN.
EPS = 1e-12
ANGLE_WEIGHT = 0.1  # MICo's beta, for an angle in radians


def direction_bonus(embedding: Tensor, next_embedding: Tensor, direction: Tensor) -> Tensor:
    r"""Exploration bonus: how far a transition moved along the direction in embedding space.

    .. math:: r^b(s, s', z) = \langle \phi(s') - \phi(s), z \rangle

    Args:
        embedding (Tensor): :math:`\phi(s)`, ``[*, k]``.
        next_embedding (Tensor): :math:`\phi(s')`, ``[*, k]``.
        direction (Tensor): unit vector :math:`z_{sp}`, ``[*, k]``.

    Returns:
        Tensor: the bonus, ``[*, 1]`` like every reward in TorchRL.

    Equation: 1

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import direction_bonus
        >>> direction_bonus(
        ...     torch.tensor([1.0, 2.0]), torch.tensor([4.0, 1.0]), torch.tensor([0.6, 0.8])
        ... )
        tensor([1.])
    """
    return ((next_embedding - embedding) * direction).sum(-1, keepdim=True)


def l2_distance(x: Tensor, y: Tensor) -> Tensor:
    r"""Euclidean distance :math:`d` between embeddings, differentiable where they coincide.

    Args:
        x, y (Tensor): embeddings, ``[*, k]``.

    Returns:
        Tensor: distances, ``[*]``; 1e-6 with a gradient of zero where ``x == y``.

    Equation: 2 (the metric ``d``)

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import l2_distance
        >>> l2_distance(torch.tensor([0.0, 0.0]), torch.tensor([3.0, 4.0]))
        tensor(5.)
    """
    return ((x - y).square().sum(-1) + EPS).sqrt()


def mico_distance(x: Tensor, y: Tensor) -> Tensor:
    r"""MICo's diffuse distance: mean squared norm plus a weighted angle.

    .. math:: U(x, y) = \tfrac12 (\|x\|^2 + \|y\|^2) + 0.1\,\angle(x, y)

    This is a *diffuse* metric: a state's distance to itself is :math:`\|x\|^2`, not zero. It suits
    a divergence estimated from independent samples, which is not zero for a state and itself
    either. The origin has no angle to others: there, only the norms count.

    Args:
        x, y (Tensor): embeddings, ``[*, k]``.

    Returns:
        Tensor: distances, ``[*]``.

    Equation: 2 (the metric ``d``, MICo's reading)

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import mico_distance
        >>> mico_distance(torch.tensor([2.0, 0.0]), torch.tensor([0.0, 4.0]))  # 10 + 0.1 * pi / 2
        tensor(10.1571)
    """
    x_square, y_square = x.square().sum(-1), y.square().sum(-1)
    x_unit = x / (x_square + EPS).sqrt().unsqueeze(-1)
    y_unit = y / (y_square + EPS).sqrt().unsqueeze(-1)
    # Half-angle form: accurate and with finite gradients at 0 and pi, where arccos is neither.
    angle = 2 * torch.atan2(l2_distance(x_unit, y_unit), l2_distance(x_unit, -y_unit))
    angle = torch.where((x_square > 0) & (y_square > 0), angle, 0.0)
    return 0.5 * (x_square + y_square) + ANGLE_WEIGHT * angle


def gaussian_w2(mean_i: Tensor, std_i: Tensor, mean_j: Tensor, std_j: Tensor) -> Tensor:
    r"""2-Wasserstein distance between two diagonal Gaussians, the divergence of DBC.

    .. math:: W_2 = \sqrt{\|\mu_i - \mu_j\|^2 + \|\sigma_i - \sigma_j\|^2}

    Args:
        mean_i, std_i (Tensor): mean and standard deviation of the first, ``[*, k]``.
        mean_j, std_j (Tensor): mean and standard deviation of the second, ``[*, k]``.

    Returns:
        Tensor: distances, ``[*]``.

    Equation: 2 (the divergence ``D``, DBC's reading)

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import gaussian_w2
        >>> gaussian_w2(
        ...     torch.tensor([0.0]), torch.tensor([1.0]), torch.tensor([3.0]), torch.tensor([5.0])
        ... )
        tensor(5.)
    """
    return ((mean_i - mean_j).square().sum(-1) + (std_i - std_j).square().sum(-1) + EPS).sqrt()


def metric_target(reward_i: Tensor, reward_j: Tensor, divergence: Tensor, gamma: float) -> Tensor:
    r"""The behavioral-metric operator applied to one pair of states.

    .. math:: \mathcal F^\pi(d)(s_i, s_j) = |r_i - r_j| + \gamma\,\mathcal D(d; P_i, P_j)

    Args:
        reward_i, reward_j (Tensor): rewards of the first and of the second states, ``[*]``.
        divergence (Tensor): divergence of the next states, ``[*]``. A loss passes it detached.
        gamma (float): discount factor.

    Returns:
        Tensor: target distances, ``[*]``.

    Equation: 2

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import metric_target
        >>> metric_target(torch.tensor(1.0), torch.tensor(3.0), torch.tensor(10.0), 0.9)
        tensor(11.)
    """
    return (reward_i - reward_j).abs() + gamma * divergence


def metric_loss(distance: Tensor, target: Tensor) -> Tensor:
    r"""Half squared error between the latent distance and its target, not reduced.

    Args:
        distance (Tensor): :math:`d_\phi(s_i, s_j)`, ``[*]``.
        target (Tensor): :func:`metric_target`, ``[*]``.

    Returns:
        Tensor: losses, ``[*]``.

    Equation: 3 (its expectation is taken by the caller)

    Deviates: as printed the difference is squared outside the expectation; the square belongs
        inside, as Eq. 6 has it.

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import metric_loss
        >>> metric_loss(torch.tensor(5.0), torch.tensor(2.0))
        tensor(4.5000)
    """
    return 0.5 * (distance - target).square()


def expected_distance(mean_abs_reward_difference: Tensor | float, gamma: float) -> Tensor | float:
    r"""Mean distance that Theorem 1 predicts for a converged behavioral metric.

    .. math:: \mathbb E[d] = \mathbb E|r_i - r_j| / (1 - \gamma)

    It holds for deterministic transitions when a pair and its successor pair have the same
    distribution. A mean reward difference near zero therefore means a collapsed embedding.

    Args:
        mean_abs_reward_difference (Tensor or float): :math:`\mathbb E|r_i - r_j|`.
        gamma (float): discount factor in ``[0, 1)``.

    Returns:
        Tensor or float: the predicted mean distance.

    Raises:
        ValueError: if ``gamma`` is outside ``[0, 1)``.

    Equation: 4

    Examples:
        >>> from torchrl_etl.functional import expected_distance
        >>> round(expected_distance(0.5, 0.9), 6)
        5.0
    """
    check_real("[0, 1)", gamma=gamma)  # for the series to converge
    return mean_abs_reward_difference / (1.0 - gamma)


def discriminability(
    reward_i: Tensor,
    reward_j: Tensor,
    embedding_i: Tensor,
    embedding_j: Tensor,
    epsilon: float,
    margin: float = 1.0,
    form: Literal["hinge", "literal"] = "hinge",
) -> Tensor:
    r"""Behavioral discriminability regularization of a pair of states.

    - ``"hinge"``: :math:`1[|r_i-r_j|<\epsilon]\;\max(0,\, m-\|\phi_i-\phi_j\|)^2`
    - ``"literal"``: :math:`1[|r_i-r_j|<\epsilon]\;\|\phi_i-\phi_j\|^2`

    Args:
        reward_i, reward_j (Tensor): rewards of the first and of the second states, ``[*]``.
        embedding_i, embedding_j (Tensor): their embeddings, ``[*, k]``.
        epsilon (float): pairs whose rewards differ by less than this are regularized.
        margin (float, optional): distance from which the hinge is zero; not used by
            ``"literal"``. Defaults to ``1.0``.
        form (str, optional): ``"hinge"`` or ``"literal"``. Defaults to ``"hinge"``.

    Returns:
        Tensor: penalties to *minimize*, ``[*]``.

    Raises:
        ValueError: if ``form`` is unknown.

    Equation: 5

    Deviates: the printed term (``"literal"``) is added to a minimized loss, so it *contracts* the
        very pairs it is said to keep apart: with equal rewards and a fixed next-state distance
        ``d'`` the minimum of Eq. 6 is at :math:`d = \gamma d' / (1 + 2\lambda)`, below the metric's
        own :math:`\gamma d'`, and its fixed point is collapse. The hinge pushes such pairs apart
        until they are ``margin`` away from each other and then leaves them to the metric.

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import discriminability
        >>> pair = torch.tensor([0.0, 0.0]), torch.tensor([0.6, 0.8])
        >>> same = torch.tensor(0.0), torch.tensor(0.01)
        >>> discriminability(*same, *pair, epsilon=0.05, margin=3.0)
        tensor(4.)
        >>> discriminability(*same, *pair, epsilon=0.05, form="literal")
        tensor(1.)
        >>> discriminability(*same, *pair, epsilon=0.005)
        tensor(0.)
    """
    check_choice("form", form, ("hinge", "literal"))
    if form == "hinge":
        penalty = (margin - l2_distance(embedding_i, embedding_j)).clamp_min(0.0).square()
    else:
        penalty = (embedding_i - embedding_j).square().sum(-1)
    alike = (reward_i - reward_j).abs() < epsilon
    return torch.where(alike, penalty, torch.zeros_like(penalty))


def effective_rank(embedding: Tensor) -> Tensor:
    r"""Effective number of embedding dimensions: participation ratio of the variances.

    .. math:: (\operatorname{tr} C)^2 / \operatorname{tr} C^2, \qquad C \text{ the covariance}

    Not in the paper. It shows a collapsed encoder before the return does. It does not depend on
    scale, so read it with the mean distance. It needs no matrix decomposition, so it is cheap at
    every update and can be part of a CUDA graph.

    Args:
        embedding (Tensor): embeddings, ``[*, k]``; all leading dimensions count as samples.

    Returns:
        Tensor: a scalar in ``[1, k]``, or ``0`` where the embedding is constant.

    Examples:
        >>> import torch
        >>> from torchrl_etl.functional import effective_rank
        >>> cross = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1, 0]])
        >>> round(effective_rank(cross).item(), 4)  # two of three dimensions
        2.0
        >>> effective_rank(torch.ones(4, 3))
        tensor(0.)
    """
    flat = embedding.reshape(-1, embedding.shape[-1])
    centered = flat - flat.mean(0)
    covariance = centered.T @ centered
    total = covariance.trace()
    ratio = total.square() / covariance.square().sum().clamp_min(EPS**2)
    return torch.where(total > EPS, ratio, torch.zeros_like(total))
