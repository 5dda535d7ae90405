"""Networks of one shape and many weights, evaluated side by side.

All weights of a stack of N networks are one tensor [N, P]; a forward pass splits it into views.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

__all__ = ["BatchNormBody", "Mlp", "ResidualBody", "Stack"]


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """x [N, B, i], weight [N, o, i], bias [N, o] to [N, B, o]."""
    return torch.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2))


def layer_norm(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    normal = nn.functional.layer_norm(x, x.shape[-1:])
    return torch.addcmul(bias.unsqueeze(1), normal, weight.unsqueeze(1))


class Mlp:
    """The layers of the synergy decoder: ELUs between linear ones."""

    def __call__(self, x: Tensor, weights: Iterator[Tensor], training: bool) -> Tensor:
        layers = list(zip(weights, weights, strict=True))
        for weight, bias in layers[:-1]:
            x = nn.functional.elu(linear(x, weight, bias))
        return linear(x, *layers[-1])


class ResidualBody:
    """The layers of ``torchrl_etl.modules.make_layers("residual")``."""

    def __init__(self, blocks: int) -> None:
        self.blocks = blocks

    def __call__(self, x: Tensor, weights: Iterator[Tensor], training: bool) -> Tensor:
        w = weights.__next__
        h = linear(x, w(), w())
        for _ in range(self.blocks):
            inner = linear(layer_norm(h, w(), w()), w(), w()).relu()
            h = h + linear(inner, w(), w())
        return linear(layer_norm(h, w(), w()), w(), w())


class BatchNormBody:
    """FlashSAC's layers: batch normalization of the input and before every rectifier.

    Attributes:
        running (list of Tensor): means and variances [N, i] that follow those of batches.
    """

    momentum = 0.01

    def __init__(self, blocks: int, running: list[Tensor]) -> None:
        self.blocks, self.running = blocks, running

    @classmethod
    def like(
        cls, networks: Sequence[Sequence[Tensor]], blocks: int, device: torch.device
    ) -> BatchNormBody:
        """A body with untrained statistics for networks of :meth:`initial`."""
        first = networks[0]
        scales = [first[0], *(first[i] for i in range(6, 6 + 8 * blocks, 4))]
        running = []
        for scale in scales:
            shape = (len(networks), scale.numel())
            running += [torch.zeros(shape, device=device), torch.ones(shape, device=device)]
        return cls(blocks, running)

    @staticmethod
    def initial(inputs: int, width: int, blocks: int, outputs: int) -> list[Tensor]:
        """Weights of one network."""

        def norm(size: int) -> list[Tensor]:
            return [torch.ones(size), torch.zeros(size)]

        def line(i: int, o: int) -> list[Tensor]:
            return [nn.functional.normalize(torch.randn(o, i), dim=-1), torch.zeros(o)]

        weights = [*norm(inputs), *line(inputs, width)]
        for _ in range(blocks):
            weights += [*line(width, 4 * width), *norm(4 * width)]
            weights += [*line(4 * width, width), *norm(width)]
        return weights + line(width, outputs)

    def __call__(self, x: Tensor, weights: Iterator[Tensor], training: bool) -> Tensor:
        w = weights.__next__
        running = iter(self.running)

        def norm(x: Tensor) -> Tensor:
            return self._norm(x, w(), w(), next(running), next(running), training)

        h = norm(x)
        h = linear(h, w(), w())
        for _ in range(self.blocks):
            inner = norm(linear(h, w(), w())).relu()
            h = h + norm(linear(inner, w(), w())).relu()
        h = nn.functional.rms_norm(h, h.shape[-1:])
        return linear(h, w(), w())

    def _norm(
        self, x: Tensor, weight: Tensor, bias: Tensor, mean: Tensor, var: Tensor, training: bool
    ) -> Tensor:
        if training:
            now_var, now_mean = torch.var_mean(x, 1, correction=0)
            with torch.no_grad():
                mean.lerp_(now_mean, self.momentum)
                var.lerp_(now_var, self.momentum)
        else:  # as they are now: an update may change them before a gradient is computed
            now_mean, now_var = mean.clone(), var.clone()
        scale = weight * torch.rsqrt(now_var + 1e-5)
        return torch.addcmul((bias - now_mean * scale).unsqueeze(1), x, scale.unsqueeze(1))


class Stack:
    """N networks: a body, and the weights [N, P] with the shapes into which they split.

    Args:
        body: called with an input [N, B, i], an iterator of weights [N, *shape], and whether to
            train its statistics.
        networks (sequence): for each network its weights in the order that the body takes them.
    """

    def __init__(self, body, networks: Sequence[Sequence[Tensor]], device: torch.device) -> None:
        self.body = body
        self.shapes = [tuple(w.shape) for w in networks[0]]
        flat = torch.stack([torch.cat([w.detach().reshape(-1) for w in one]) for one in networks])
        self.weights = flat.to(device).requires_grad_()

    def split(self, weights: Tensor) -> list[Tensor]:
        sizes = [torch.Size(shape).numel() for shape in self.shapes]
        parts = weights.split(sizes, 1)
        return [part.view(-1, *shape) for part, shape in zip(parts, self.shapes, strict=True)]

    def __call__(
        self, x: Tensor, weights: Tensor | None = None, *, training: bool = False
    ) -> Tensor:
        weights = self.weights if weights is None else weights
        return self.body(x, iter(self.split(weights)), training)

    @torch.no_grad()
    def normalize_rows(self) -> None:
        """Rows of linear layers to length one."""
        for part in self.split(self.weights):
            if part.ndim == 3:
                part.div_(part.norm(dim=-1, keepdim=True).clamp_min(1e-8))
