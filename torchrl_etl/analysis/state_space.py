"""A plot of the learned state embedding and the exploration directions."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from torchrl_etl.analysis.arrays import as_matrix
from torchrl_etl.analysis.canvas import direction_colors, new_figure, tidy, write
from torchrl_etl.synergies.factors import principal_components

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["embedding"]

_MAX_POINTS = 8_000
_GREY = np.array([0.72, 0.72, 0.72])


def embedding(
    embeddings: Tensor | ArrayLike,
    directions: Tensor | ArrayLike,
    path: str | os.PathLike[str],
) -> Path:
    """Plot visited states in embedding space, coloured by the direction of their episode.

    If the directions steer behavior, states of one colour lie together, along their direction.
    Embeddings and directions of more than two dimensions are projected onto the embeddings' first
    two principal components. Directions mostly orthogonal to this plane are greyish. In one
    dimension, the plot is a histogram for each of the two directions.

    Args:
        embeddings (Tensor or array): φ(s) of visited states [*, k].
        directions (Tensor or array): the direction of each state's episode [*, k].
        path (path-like): path of the PNG.

    Raises:
        ValueError: if the shapes differ, or there are fewer than three states.

    Examples:
        >>> import torch
        >>> from tempfile import TemporaryDirectory
        >>> directions = torch.nn.functional.normalize(torch.randn(200, 4), dim=-1)
        >>> with TemporaryDirectory() as folder:
        ...     embedding(3 * directions, directions, f"{folder}/embedding.png").name
        'embedding.png'
    """
    points = as_matrix(embeddings, "embeddings")
    arrows = as_matrix(directions, "directions")
    if points.shape != arrows.shape or len(points) < 3:
        raise ValueError(
            f"embeddings flatten to {points.shape} and directions to {arrows.shape}; pass one "
            "direction per state, of the same size, for at least three states."
        )
    # Shuffled, since the last episodes would otherwise cover the first.
    order = np.random.default_rng(0).permutation(len(points))[:_MAX_POINTS]
    points, arrows = points[order], arrows[order]
    figure = new_figure(6.4, 4.6)
    if points.shape[1] == 1:
        axes = figure.subplots()
        _histogram(axes, points[:, 0], arrows[:, 0] > 0)
    else:
        axes, corner = figure.subplots(1, 2, width_ratios=(1.0, 0.18))
        _scatter(axes, points, arrows)
        _wheel(corner, disc=points.shape[1] > 2)
    tidy(axes)
    axes.set_title("Visited states in embedding space")
    return write(figure, path)


def _histogram(axes: Axes, points: np.ndarray, positive: np.ndarray) -> None:
    edges, colors = np.histogram_bin_edges(points, bins=40), direction_colors()
    for chosen, name, where, hatch in ((~positive, "−1", 0.5, "//"), (positive, "+1", 0.0, None)):
        axes.hist(
            points[chosen],
            edges,
            label=name,
            facecolor=(*colors(where)[:3], 0.55),
            edgecolor=colors(where),
            histtype="stepfilled",
            hatch=hatch,
        )
    axes.set_xlabel("embedding")
    axes.set_ylabel("states")
    axes.legend(title="direction", frameon=False)


def _scatter(axes: Axes, points: np.ndarray, arrows: np.ndarray) -> None:
    labels = ["embedding dimension 1", "embedding dimension 2"]
    if points.shape[1] > 2:
        model = principal_components(points, 2, svd_solver="covariance_eigh")
        points, arrows = model.transform(points), arrows @ model.components_.T
        labels = [
            f"principal component {i + 1} ({share:.0%} of variance)"
            # A collapsed encoder has no variance, of which each share is NaN.
            for i, share in enumerate(np.nan_to_num(model.explained_variance_ratio_))
        ]
    axes.scatter(*points.T, s=9, c=_colors(*arrows.T), linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])


def _colors(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Hue from the angle, blended to grey as the in-plane part of the unit vector shrinks."""
    length = np.hypot(x, y).clip(max=1.0)[..., None]
    hues = direction_colors()(np.arctan2(y, x) / (2 * np.pi) % 1.0)[..., :3]
    return length * hues + (1 - length) * _GREY


def _wheel(axes: Axes, *, disc: bool) -> None:
    """The legend: a disc, or only its rim if every direction lies in the plane."""
    x, y = np.meshgrid(*[np.linspace(-1, 1, 201)] * 2)
    radius = np.hypot(x, y)
    shown = (radius <= 1) & (disc | (radius >= 0.6))
    scale = 1.0 if disc else 1 / radius.clip(min=1e-9)
    axes.imshow(
        np.concatenate([_colors(scale * x, scale * y), shown[..., None]], -1),
        extent=(-1, 1, -1, 1),
        origin="lower",
    )
    axes.set_axis_off()
    axes.set_title("direction of\nthe episode", fontsize=9)
    if disc:
        axes.text(0, -1.15, "grey: out of\nthis plane", fontsize=8, ha="center", va="top")
