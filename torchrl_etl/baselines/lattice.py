"""Lattice: exploration noise that passes through the actor's last layer (Chiappa 2023)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch import distributions as D
from torchrl.data.tensor_specs import TensorSpec
from torchrl.modules import ProbabilisticActor
from torchrl.modules.distributions.continuous import SafeTanhTransform

from torchrl_etl.checks import check_flag, check_real
from torchrl_etl.draws import standard_normal
from torchrl_etl.modules.actor_critic import Body, actor_with, make_layers
from torchrl_etl.modules.clamp import Clamp

__all__ = [
    "LatticeNetwork",
    "LatticeNormal",
    "StateDependentSpread",
    "lattice_scale_tril",
    "make_lattice_actor",
]


# Bounds of log σ and of log S in the public code.
_PLAIN_BOUNDS = (-20.0, 2.0)
_STATE_DEPENDENT_BOUNDS = (math.log(1e-3), math.log(10.0))


class LatticeNormal(D.TransformedDistribution):
    """A Gaussian with full covariance, squashed by tanh and scaled to bounds.

    Args:
        loc (Tensor): mean [*, n] before the tanh.
        scale_tril (Tensor): lower Cholesky factor [*, n, n] of the covariance before the tanh.

    Keyword Args:
        low, high (float or Tensor): bounds, low below high, one number or [n]. Default: ±1.

    Examples:
        >>> import torch
        >>> normal = LatticeNormal(torch.zeros(3, 2), torch.eye(2).expand(3, 2, 2), low=0.0)
        >>> normal.deterministic_sample[0]
        tensor([0.5000, 0.5000])
        >>> action, log_prob = normal.rsample_and_log_prob()
        >>> torch.allclose(log_prob, normal.log_prob(action), atol=1e-3)
        True
    """

    def __init__(
        self,
        loc: Tensor,
        scale_tril: Tensor,
        *,
        low: float | Tensor = -1.0,
        high: float | Tensor = 1.0,
    ) -> None:
        low, high = (torch.as_tensor(x, dtype=loc.dtype, device=loc.device) for x in (low, high))
        gaussian = D.MultivariateNormal(loc, scale_tril=scale_tril, validate_args=False)
        # TorchRL's tanh stays inside ±1, so its inverse is finite.
        squash = [SafeTanhTransform(), D.AffineTransform((high + low) / 2, (high - low) / 2)]
        super().__init__(gaussian, squash, validate_args=False)

    def rsample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Samples [S, *, n] with their log-probabilities [S, *], exact at the bounds too.

        No linear system is solved: a sample loc + L ε has Mahalanobis distance ‖ε‖ from the mean.
        """
        gaussian = self.base_dist
        loc, scale_tril = gaussian.loc, gaussian.scale_tril
        noise = standard_normal(loc.expand(*sample_shape, *loc.shape))
        value = loc + (scale_tril @ noise.unsqueeze(-1)).squeeze(-1)
        log_scale = scale_tril.diagonal(dim1=-2, dim2=-1).log()
        log_prob = -(noise.square() / 2 + math.log(2 * math.pi) / 2 + log_scale).sum(-1)
        for transform in self.transforms:
            before, value = value, transform(value)
            log_prob = log_prob - transform.log_abs_det_jacobian(before, value).sum(-1)
        return value, log_prob

    @property
    def deterministic_sample(self) -> Tensor:
        """The squashed mean [*, n]."""
        value = self.base_dist.loc
        for transform in self.transforms:
            value = transform(value)
        return value


def lattice_scale_tril(weight: Tensor, latent_variance: Tensor, action_variance: Tensor) -> Tensor:
    """Cholesky factor of W diag(v_x) Wᵀ + diag(v_a).

    Deviates: the diagonal is enlarged by 10 n machine epsilons (0.005 % at n = 39 in single
    precision). Rounding errors of that size can make a covariance indefinite if correlations are
    near one, as they are where a wide W drives many actuators with few features.

    Args:
        weight (Tensor): W [n, H].
        latent_variance (Tensor): v_x [*, H].
        action_variance (Tensor): v_a [*, n], positive.

    Returns:
        Tensor: L [*, n, n], lower triangular, with L Lᵀ the covariance.

    Examples:
        >>> import torch
        >>> weight = torch.tensor([[1.0, 0.0], [1.0, 2.0]])
        >>> lower = lattice_scale_tril(weight, torch.tensor([4.0, 1.0]), torch.tensor([5.0, 1.0]))
        >>> lower @ lower.mT
        tensor([[9.0000, 4.0000],
                [4.0000, 9.0000]])
    """
    n = weight.shape[0]
    # One matrix product: the covariance is linear in v_x, with products of weights as coefficients.
    # A product for each sample would write [*, n, H] to memory first.
    products = (weight.unsqueeze(1) * weight.unsqueeze(0)).flatten(0, 1)
    covariance = nn.functional.linear(latent_variance, products).unflatten(-1, (n, n))
    variance = covariance.diagonal(dim1=-2, dim2=-1) + action_variance
    extra = action_variance + 10 * n * torch.finfo(weight.dtype).eps * variance
    return torch.linalg.cholesky(covariance + torch.diag_embed(extra))


class _Spread(nn.Module):
    """σ of Lattice: one linear head on the features x gives log σ_x [*, H] and log σ_a [*, n]."""

    def __init__(
        self, features: int, action_dim: int, init: float, bounds: tuple[float, float]
    ) -> None:
        super().__init__()
        self.bounds, self.sizes = bounds, (features, action_dim)
        self.head = nn.Linear(features, features + action_dim)
        # Every state starts with nearly the same spread, so that differences are learned.
        with torch.no_grad():
            self.head.weight.mul_(0.01)
            self.head.bias.fill_(init)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Variances v_x [*, H] and v_a [*, n]."""
        variances = (2 * Clamp.apply(self.head(features), *self.bounds)).exp()
        return variances.split(self.sizes, -1)


class StateDependentSpread(nn.Module):
    """S of Lattice with state-dependent exploration: a parameter log S [H, H + n].

    Equation: v_x = α² x² S_x², v_a = x² S_a² + std_reg², with S = expln(clip(log S) − ½ log H) and
    expln(y) = exp(y) for y ≤ 0, 1 + log(1 + y) above. At the start log S is ``init``; it is clipped
    to ``bounds``. ``std_reg`` keeps the covariance positive where all features are zero.

    Examples:
        >>> import torch
        >>> spread = StateDependentSpread(
        ...     4, 2, init=0.0, bounds=(-6.9, 0.0), alpha=1.0, std_reg=0.0
        ... )
        >>> spread(torch.ones(4))
        (tensor([1., 1., 1., 1.], ...), tensor([1., 1.], ...))
    """

    def __init__(
        self,
        features: int,
        action_dim: int,
        *,
        init: float,
        bounds: tuple[float, float],
        alpha: float,
        std_reg: float,
    ) -> None:
        super().__init__()
        self.bounds, self.sizes, self.init = bounds, (features, action_dim), init
        self.alpha, self.std_reg = alpha, std_reg
        self.log_std = nn.Parameter(torch.empty(features, features + action_dim))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        nn.init.constant_(self.log_std, self.init)

    def scales(self) -> tuple[Tensor, Tensor]:
        """S_x [H, H] and S_a [H, n]; rows are the features that cause noise."""
        log_std = Clamp.apply(self.log_std, *self.bounds) - math.log(self.sizes[0]) / 2
        scale = torch.where(log_std <= 0, log_std.exp(), 1 + log_std.clamp_min(0).log1p())
        return scale.split(self.sizes, -1)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Variances v_x [*, H] and v_a [*, n]."""
        squares = features.square()
        latent, action = (squares @ scale.square() for scale in self.scales())
        return self.alpha**2 * latent, action + self.std_reg**2


class LatticeNetwork(nn.Module):
    """Network of a Lattice actor: outputs the mean and the covariance's Cholesky factor [*, n, n].

    Args:
        layers (nn.Sequential): ends with the linear layer W, b.
        spread (nn.Module): features [*, H] → variances of features [*, H] and of actions [*, n].
    """

    def __init__(self, layers: nn.Sequential, spread: nn.Module) -> None:
        super().__init__()
        self.features, self.mean, self.spread = layers[:-1], layers[-1], spread

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        features = self.features(*inputs)
        scale_tril = lattice_scale_tril(self.mean.weight, *self.spread(features))
        return self.mean(features), scale_tril


def make_lattice_actor(
    inputs: Mapping[NestedKey, int],
    action_spec: TensorSpec,
    *,
    out_key: NestedKey = "action",
    body: Body = "mlp",
    hidden: Sequence[int] = (256, 256),
    layer_norm: bool = True,
    state_dependent: bool = False,
    log_std_init: float = 0.0,
    log_std_bounds: Sequence[float] | None = None,
    alpha: float = 1.0,
    std_reg: float = 1e-3,
) -> ProbabilisticActor:
    """Actor with noise on its last hidden features, which correlates the actuators.

    The last layer maps features x [H] to actions by W [n, H] and b [n]. Actuators with similar rows
    of W get correlated noise. W in the covariance and x in its variances get gradients too.

    Equation: a ~ tanh N(Wx + b, Σ), Σ = W diag(σ_x²) Wᵀ + diag(σ_a²) with log (σ_x, σ_a) linear in
    x; with ``state_dependent`` Σ = α² W diag(x² S_x²) Wᵀ + diag(x² S_a² + std_reg²), the
    distribution of what :class:`~torchrl_etl.baselines.lattice_noise.LatticeNoise` does.

    Deviates: at a bound of log σ, gradients that lead back inside still pass (the original's stop
    there for good). Means are not clipped to ±2. std_reg is 0.001, not 0, since features can all be
    zero. W keeps PyTorch's initialization, unlike :func:`~torchrl_etl.modules.make_actor`, since it
    also shapes the noise. See :func:`lattice_scale_tril` for the diagonal.

    Args:
        inputs (mapping of NestedKey to int): keys that the actor reads, with their sizes.
        action_spec (TensorSpec): one unbatched bounded leaf.

    Keyword Args:
        out_key (NestedKey): where the sample goes. Default: ``"action"``.
        body, hidden, layer_norm: as in :func:`~torchrl_etl.modules.make_actor`.
        state_dependent (bool): the second Σ. Default: ``False``.
        log_std_init (float): initial log σ (or log S). Default: 0.
        log_std_bounds (pair of float, optional): its bounds. Default: the public code's, [-20, 2]
            for log σ, and the logarithms of (1e-3, 10) for log S (of (1e-3, 1) in its Humanoid and
            Ant).
        alpha, std_reg (float): α ≥ 0 and std_reg ≥ 0, for the second Σ.

    Keys:
        reads ``inputs``; writes ``loc`` [*, n], ``scale_tril`` [*, n, n] (before the tanh) and
        ``out_key`` [*, n] within the bounds.

    Raises:
        ValueError: if ``state_dependent`` is neither true nor false, there is no hidden layer, the
            bounds of log σ are not an ordered pair that contains ``log_std_init``, the action's are
            not finite and in order, or alpha or std_reg is negative.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> actor = make_lattice_actor({"observation": 7}, Bounded(0, 1, shape=(5,)), hidden=(16,))
        >>> written = actor(TensorDict({"observation": torch.randn(3, 7)}, [3]))
        >>> written["scale_tril"].shape, bool((written["action"] >= 0).all())
        (torch.Size([3, 5, 5]), True)
    """
    check_flag(state_dependent=state_dependent)
    if log_std_bounds is None:
        log_std_bounds = _STATE_DEPENDENT_BOUNDS if state_dependent else _PLAIN_BOUNDS
    if isinstance(log_std_bounds, (str, float, int)) or len(log_std_bounds) != 2:
        raise ValueError(f"log_std_bounds is {log_std_bounds!r}; pass a pair, such as [-20, 2].")
    low, high = log_std_bounds
    if not low < high or not low <= log_std_init <= high:
        raise ValueError(
            f"log_std_bounds are {low:g} and {high:g} and log_std_init is {log_std_init:g}; they "
            "must satisfy low < high and low <= log_std_init <= high."
        )
    if not hidden:
        raise ValueError(
            "hidden is empty; Lattice perturbs the last hidden layer, so pass at least one size."
        )
    check_real("[0, inf)", alpha=alpha, std_reg=std_reg)
    n = action_spec.shape[-1]
    layers = make_layers(sum(inputs.values()), n, body, hidden, layer_norm)
    if state_dependent:
        spread = StateDependentSpread(
            hidden[-1], n, init=log_std_init, bounds=(low, high), alpha=alpha, std_reg=std_reg
        )
    else:
        spread = _Spread(hidden[-1], n, log_std_init, (low, high))
    network = LatticeNetwork(layers, spread)
    return actor_with(LatticeNormal, network, inputs, ["loc", "scale_tril"], action_spec, out_key)
