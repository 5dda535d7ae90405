"""Plots of a run: learning curves, the muscles of each synergy, and VAF by number of synergies.

Every function writes a PNG to ``path``, creating folders as needed, and returns the path. None
touches matplotlib's global state, so they may be called anywhere in a training run.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_etl.analysis.canvas import MARKERS, SERIES, count_frames, new_figure, tidy, write
from torchrl_etl.analysis.diagnostics import synergy_effects
from torchrl_etl.analysis.state_space import embedding
from torchrl_etl.modules import SynergyMap

__all__ = ["embedding", "learning_curves", "synergy_heatmap", "vaf_curve"]

_MUSCLES_PER_LINE = 45


def learning_curves(
    returns: tuple[Sequence[int], Sequence[float]],
    path: str | os.PathLike[str],
    *,
    solved: tuple[Sequence[int], Sequence[float]] | None = None,
    explore_frames: int | None = None,
    title: str | None = None,
) -> Path:
    """Plot a run's return, and success if known, against environment frames.

    Args:
        returns (pair of sequences): frames of the evaluations, explore stage included, and the
            return at each.
        path (path-like): where the PNG goes.

    Keyword Args:
        solved (pair of sequences, optional): frames, and the share in [0, 1] of solved episodes.
        explore_frames (int, optional): shade the frames before this one as the explore stage.
        title (str, optional): title of the figure, such as the task.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     learning_curves(([0, 1000], [0.5, 2.0]), f"{folder}/curves.png").name
        'curves.png'
    """
    panels = [("return per episode", returns[0], np.asarray(returns[1]))]
    if solved is not None:
        panels.append(("solved episodes [%]", solved[0], 100 * np.asarray(solved[1])))
    figure = new_figure(5.2 * len(panels), 3.6)
    for axes, (label, frames, values) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        tidy(axes)
        axes.plot(frames, values, **_look(0), markevery=max(1, len(frames) // 12))
        if explore_frames:
            axes.axvspan(0, explore_frames, color="0.93", zorder=0, label="explore stage")
        axes.set_xlim(left=0)
        axes.set_xlabel("environment frames, explore stage included")
        axes.set_ylabel(label)
        count_frames(axes)
    if solved is not None:
        axes.set_ylim(-3, 103)
    if explore_frames:
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", frameon=False)
    if title:
        figure.suptitle(title)
    return write(figure, path)


def synergy_heatmap(
    decoder: SynergyMap,
    names: Sequence[str],
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
) -> Path:
    """Heat map of the signed effect of each synergy on each actuator.

    Each cell is the change of the action, in percent of the actuator's range, when one coefficient
    goes from -1 to +1 and the others are 0. See
    :func:`~torchrl_etl.analysis.diagnostics.synergy_effects`.

    Args:
        decoder (SynergyMap): the decoder.
        names (sequence of str): names of the n actuators, in action order.
        path (path-like): where the PNG goes.

    Keyword Args:
        title (str, optional): title of the figure, such as the task.

    Raises:
        ValueError: if there is not one name per actuator.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> with TemporaryDirectory() as folder:
        ...     synergy_heatmap(SynergyDecoder(2, 3), ["a", "b", "c"], f"{folder}/map.png").name
        'map.png'
    """
    effects = 100 * synergy_effects(decoder).cpu().numpy()
    count, muscles = effects.shape
    if len(names) != muscles:
        raise ValueError(
            f"There are {len(names)} names for {muscles} actuators; pass one for each, in order."
        )
    # A minimum keeps the rounding noise of a constant decoder from filling the colour scale.
    limit = max(1.0, float(np.abs(effects).max()))
    # Many muscles are split into several rows, so that names stay legible on a page.
    lines = np.array_split(np.arange(muscles), -(-muscles // _MUSCLES_PER_LINE))
    longest = max(map(len, names))
    upright = muscles > 12 or longest > 6
    height = max(1.0, 0.26 * count)
    figure = new_figure(
        max(5.2, 1.8 + 0.2 * len(lines[0])),
        0.5 + len(lines) * (0.3 + 0.08 * longest * upright + height),
    )
    panels = figure.subplots(len(lines), 1, squeeze=False)[:, 0]
    for axes, line in zip(panels, lines, strict=True):
        image = axes.imshow(effects[:, line], cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
        axes.set_xticks(
            range(len(line)), [names[i] for i in line], rotation=90 * upright, fontsize=8
        )
        axes.set_yticks(range(count), range(1, count + 1))
        axes.set_xticks(np.arange(len(line)) - 0.5, minor=True)
        axes.set_yticks(np.arange(count) - 0.5, minor=True)
        axes.grid(which="minor", color="white", linewidth=0.8)
        axes.tick_params(which="both", length=0)
        axes.spines[:].set_visible(False)
        axes.set_ylabel("synergy")
    panels[0].set_title(title or "Actuators that each synergy moves")
    bar = figure.colorbar(image, ax=panels, pad=0.015, aspect=max(10.0, 5.0 * len(lines) * height))
    bar.set_label("change of action\nfor −1 → +1\n[% of range]", fontsize=9)
    bar.outline.set_visible(False)
    return write(figure, path)


def vaf_curve(
    dims: Sequence[int],
    series: Mapping[str, Sequence[float]],
    path: str | os.PathLike[str],
    *,
    chosen_d: int | None = None,
) -> Path:
    """Plot the variance accounted for against the number of synergies, one line per method.

    Args:
        dims (sequence of int): numbers of synergies.
        series (mapping of str to sequence of float): for each method, one fraction per entry of
            ``dims``; NaN where it was not measured.
        path (path-like): where the PNG goes.

    Keyword Args:
        chosen_d (int, optional): the number of the run, marked by a line.

    Raises:
        ValueError: if a method does not have one fraction per number of synergies.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     vaf_curve([1, 2], {"PCA": [0.4, 0.7]}, f"{folder}/vaf.png", chosen_d=2).name
        'vaf.png'
    """
    for name, values in series.items():
        if len(values) != len(dims):
            raise ValueError(
                f"{name!r} has {len(values)} values for {len(dims)} numbers of synergies; pass one "
                "for each, NaN where it was not measured."
            )
    figure = new_figure(5.2, 3.6)
    axes = figure.subplots()
    tidy(axes)
    for index, (name, values) in enumerate(series.items()):
        axes.plot(dims, 100 * np.asarray(values, float), label=name, **_look(index))
    if chosen_d is not None:
        axes.axvline(
            chosen_d,
            color="0.35",
            linestyle="--",
            linewidth=1.2,
            zorder=1,
            label=f"used here: {chosen_d}",
        )
    lowest = min((np.nanmin(values) for values in series.values()), default=0.0)
    axes.set_ylim(min(-3.0, 100 * lowest - 3), 103)
    axes.set_xticks(dims)
    axes.set_xlabel("number of synergies")
    axes.set_ylabel("variance accounted for [%]")
    axes.legend(frameon=False, loc="lower right")
    return write(figure, path)


def _look(index: int) -> dict[str, Any]:
    index %= len(SERIES)
    return {"color": SERIES[index], "marker": MARKERS[index], "markersize": 5, "linewidth": 1.8}
