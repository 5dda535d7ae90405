"""Plots of a run: learning curves, the muscles of each synergy, and VAF by number of synergies.

Every function writes a PNG to ``path``, creating folders as needed, and returns the path. None
touches matplotlib's global state, so they may be called anywhere in a training run.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_etl.analysis.canvas import MARKERS, SERIES, count_frames, new_figure, tidy, write
from torchrl_etl.analysis.diagnostics import synergy_effects
from torchrl_etl.analysis.state_space import embedding
from torchrl_etl.analysis.statistics import interval
from torchrl_etl.modules import SynergyMap

__all__ = ["embedding", "learning_curves", "synergy_heatmap", "vaf_curve"]

Rows = Sequence[Mapping[str, Any]]

# Column of the rows, axis label, factor to the unit of the axis.
_PANELS = (("return", "return per episode", 1.0), ("solved", "solved episodes [%]", 100.0))


_MUSCLES_PER_LINE = 45


def learning_curves(
    runs: Rows | str | os.PathLike[str] | Mapping[str, Rows | str | os.PathLike[str]],
    path: str | os.PathLike[str],
    *,
    explore_frames: int | None = None,
    title: str | None = None,
) -> Path:
    """Plot return, and success if known, against environment frames.

    Rows with different ``seed`` form one series. Its line is the mean over seeds, on the frames
    that all seeds reached; its band is the 95 % confidence interval of the mean.

    Args:
        runs: rows with ``frames`` and ``return`` or ``solved`` (a share in [0, 1]), optionally
            ``seed``; or the path of a CSV file with such columns; or a mapping of names to either.
            Frames include the explore stage, so that methods are compared at equal cost. Missing
            values may be absent, empty or NaN.
        path (path-like): where the PNG goes.

    Keyword Args:
        explore_frames (int, optional): shade the frames before this one as the explore stage.
        title (str, optional): title of the figure, such as the task.

    Raises:
        ValueError: if no row has frames and a return or success, or if two seeds of a series have
            no frames in common.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> rows = [{"frames": 1000 * i, "return": float(i), "solved": i / 10} for i in range(10)]
        >>> with TemporaryDirectory() as folder:
        ...     learning_curves({"ETL": rows}, f"{folder}/curves.png").name
        'curves.png'
    """
    named = runs if isinstance(runs, Mapping) else {"": runs}
    rows = {name: _read(source) for name, source in named.items()}
    curves = {
        column: {name: curve for name in rows if (curve := _curve(rows[name], column, unit))}
        for column, _, unit in _PANELS
    }
    panels = [panel for panel in _PANELS if curves[panel[0]]]
    if not panels:
        raise ValueError(
            f"No row of {list(rows)} has numbers for 'frames' and for 'return' or 'solved'; pass "
            "the rows of an evaluation log."
        )
    figure = new_figure(5.2 * len(panels), 3.6)
    for axes, (column, label, _) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        tidy(axes)
        for index, name in enumerate(rows):
            if name in curves[column]:
                frames, mean, low, high = curves[column][name]
                look = _look(index) | {"markevery": max(1, len(frames) // 12)}
                axes.plot(frames, mean, label=name or None, **look)
                axes.fill_between(frames, low, high, color=look["color"], alpha=0.2, linewidth=0)
        if explore_frames:
            axes.axvspan(0, explore_frames, color="0.93", zorder=0, label="explore stage")
        axes.set_xlim(left=0)
        if column == "solved":
            axes.set_ylim(-3, 103)
        axes.set_xlabel("environment frames, explore stage included")
        axes.set_ylabel(label)
        count_frames(axes)
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
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
    title: str | None = None,
) -> Path:
    """Plot the variance accounted for against the number of synergies, one line per method.

    Args:
        dims (sequence of int): numbers of synergies.
        series (mapping of str to sequence of float): for each method, one fraction per entry of
            ``dims``; NaN where it was not measured.
        path (path-like): where the PNG goes.

    Keyword Args:
        chosen_d (int, optional): the number of the run, marked by a line.
        title (str, optional): title of the figure, such as the task.

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
    if title:
        axes.set_title(title)
    return write(figure, path)


def _look(index: int) -> dict[str, Any]:
    index %= len(SERIES)
    return {"color": SERIES[index], "marker": MARKERS[index], "markersize": 5, "linewidth": 1.8}


def _read(source: Rows | str | os.PathLike[str]) -> Rows:
    if isinstance(source, (str, os.PathLike)):
        with open(source, newline="") as file:
            return list(csv.DictReader(file))
    return source


def _number(value: Any) -> float:
    return math.nan if value is None or value == "" else float(value)


def _curve(rows: Rows, column: str, unit: float) -> tuple[np.ndarray, ...] | None:
    """Frames, mean and interval bounds over seeds; None if the column has no numbers."""
    seeds: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        point = _number(row.get("frames")), unit * _number(row.get(column))
        if all(map(math.isfinite, point)):
            seeds.setdefault(str(row.get("seed", "")), []).append(point)
    if not seeds:
        return None
    lines = [np.array(sorted(points)).T for points in seeds.values()]
    frames = np.unique(np.concatenate([line[0] for line in lines]))
    # Episodes of varying length put evaluations at slightly different frames: interpolate on a
    # common grid, without extrapolation.
    start, stop = max(line[0, 0] for line in lines), min(line[0, -1] for line in lines)
    if start > stop:
        raise ValueError(
            f"The seeds {', '.join(seeds)} have no frames in common: one ends at {stop:g} before "
            f"another starts at {start:g}; pass them as separate runs."
        )
    frames = frames[(frames >= start) & (frames <= stop)]
    values = np.stack([np.interp(frames, *line) for line in lines])
    return frames, *np.array([interval(at) for at in values.T]).T
