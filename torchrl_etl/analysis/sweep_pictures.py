"""Plots of a sweep: learning curves per task with published ones, and methods over all tasks.

Every function writes a PNG to ``path`` and returns the path. A method has the same colour, marker
and line style in all plots drawn with the same :func:`looks`.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_etl.analysis.bootstrap import mean_band
from torchrl_etl.analysis.canvas import MARKERS, SERIES, count_frames, new_figure, tidy, write
from torchrl_etl.analysis.published import PublishedCurve, caveats, environment_id, published_curves
from torchrl_etl.analysis.sweep_results import SweepRun
from torchrl_etl.analysis.sweep_statistics import OverallResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["looks", "overall_picture", "task_picture"]

# Column, metric of the published curves, axis label, factor to the unit of the axis.
_PANELS = (
    ("mean_return", "return", "return per episode", 1.0),
    ("solved", "success", "solved episodes [%]", 100.0),
)

# Grey, the last colour of the series, is reserved for published curves. Black replaces it as the
# seventh colour.
_COLORS = (*SERIES[:-1], "#000000")
_LINES = ("-", "-.", (0, (5, 1.5, 1, 1.5, 1, 1.5)))
_GREYS = ("0.35", "0.55", "0.7")
# Fixed order, so that an algorithm looks the same on every task and panel.
_PUBLISHED = ("FlashSAC", "SimbaV2", "XQC", "TD-MPC2", "MR.Q", "PPO")


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, marker and line style for each method, distinct for up to 21 methods.

    Examples:
        >>> styles = looks(["sac", "etl"])
        >>> styles["sac"]["color"], styles["etl"]["marker"]
        ('#0072B2', 's')
    """
    return {
        method: {
            "color": _COLORS[index % len(_COLORS)],
            "marker": MARKERS[index % len(MARKERS)],
            "linestyle": _LINES[index // len(_COLORS) % len(_LINES)],
            "markersize": 5,
            "linewidth": 1.8,
        }
        for index, method in enumerate(methods)
    }


def task_picture(
    runs: Sequence[SweepRun],
    styles: Mapping[str, Mapping[str, Any]],
    path: str | os.PathLike[str],
    *,
    budget: int | None = None,
    repetitions: int = 2000,
) -> Path:
    """Plot return, and success if known, against environment frames.

    Lines are means over the seeds of a method, on the frames that all of them reached. Bands are
    95 % bootstrap intervals for three or more seeds, and the range for two. Published curves are
    grey and dashed, up to the frames that the runs reached. ``budget`` marks the frames at which
    methods are compared; ``repetitions`` is the number of bootstrap resamples.

    Raises:
        ValueError: if there are no runs.
    """
    if not runs:
        raise ValueError("There are no finished runs to draw; finish at least one.")
    env_id = environment_id(*runs[0].setting)
    panels = [panel for panel in _PANELS if any(run.curve(panel[0]).size for run in runs)]
    figure = new_figure(5.0 * len(panels) + 2.0, 4.2)
    end = max(run.last_frames for run in runs)
    notes = []
    entries: dict[str, Any] = {}
    for axes, (column, metric, label, unit) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        tidy(axes)
        if budget:
            axes.axvline(
                budget,
                color="0.45",
                linestyle=":",
                linewidth=1.2,
                zorder=0.5,
                label="compared here",
            )
        for method, style in styles.items():
            own = [run for run in runs if run.method == method]
            _draw_method(axes, own, column, unit, style, repetitions)
        axes.set_xlim(0, _reach(end))
        notes += _draw_published(axes, published_curves(env_id, metric), end, unit)
        if column == "solved":
            axes.set_ylim(-3, 103)
        axes.set_xlabel("environment frames, exploration included")
        axes.set_ylabel(label)
        count_frames(axes)
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    figure.legend(
        entries.values(), entries.keys(), loc="outside right upper", frameon=False, fontsize=9
    )
    figure.suptitle("{} ({} goal)".format(*runs[0].setting))
    caption = _caption(env_id, notes, end)
    lines = textwrap.fill(caption, int(16 * figure.get_figwidth()), break_on_hyphens=False)
    # The layout makes room for supxlabel, but not for free text.
    figure.supxlabel(lines, x=0.01, ha="left", fontsize=8, color="0.35", linespacing=1.3)
    return write(figure, path)


def _caption(env_id: str, notes: Sequence[str], end: int) -> str:
    """Explanation of lines and bands, with caveats if published curves are shown."""
    caption = "Line: mean over seeds (n). Band: 95 % bootstrap interval; of two seeds, their range."
    known = (*published_curves(env_id), *published_curves(env_id, "success"))
    begin = min((curve.frames[0] for curve in known), default=None)
    if begin is None:
        return caption
    if begin > _reach(end):
        return f"{caption} Published curves begin at {begin:,} frames."
    return " ".join((caption, caveats(env_id), *notes))


def overall_picture(
    results: Sequence[OverallResult],
    styles: Mapping[str, Mapping[str, Any]],
    path: str | os.PathLike[str],
) -> Path:
    """Plot each method's interquartile mean of normalized returns with its interval.

    Raises:
        ValueError: if there are no results.
    """
    if not results:
        raise ValueError("No method has a normalized return to draw; see why in the report.")
    figure = new_figure(6.4, 1.5 + 0.38 * len(results))
    axes = figure.subplots()
    tidy(axes)
    axes.grid(visible=False, axis="y")
    rows = range(len(results) - 1, -1, -1)
    for row, result in zip(rows, results, strict=True):
        style = styles[result.method]
        mean, low, high = result.iqm
        if np.isfinite((low, high)).all():
            axes.plot(
                (low, high),
                (row, row),
                color=style["color"],
                linewidth=6,
                alpha=0.35,
                solid_capstyle="butt",
            )
        axes.plot(mean, row, marker=style["marker"], color=style["color"], markersize=7)
    axes.axvline(0, color="0.8", linewidth=1.2, zorder=0.5)
    axes.axvline(1, color="0.8", linewidth=1.2, zorder=0.5)
    counts = {len(result.settings) for result in results}
    axes.set_yticks(
        rows,
        [
            result.method
            + (f" ({len(result.settings)} of {max(counts)} tasks)" if len(counts) > 1 else "")
            for result in results
        ],
    )
    axes.set_ylim(-0.6, len(results) - 0.4)
    axes.set_xlabel("normalized return: 0 untrained, 1 reference\n(interquartile mean, 95 %)")
    return write(figure, path)


def _draw_method(
    axes: Axes,
    runs: Sequence[SweepRun],
    column: str,
    unit: float,
    style: Mapping[str, Any],
    repetitions: int,
) -> None:
    lines = [curve for run in runs if (curve := run.curve(column)).size]
    if not lines:
        return
    frames = np.unique(np.concatenate([line[0] for line in lines]))
    # No extrapolation beyond any seed's frames.
    start, stop = max(line[0, 0] for line in lines), min(line[0, -1] for line in lines)
    frames = frames[(frames >= start) & (frames <= stop)]
    label = f"{runs[0].method} ({len(runs)})"
    if not frames.size:
        for line in lines:
            axes.plot(line[0], unit * line[1], **style, label=label)
        return
    values = unit * np.stack([np.interp(frames, *line) for line in lines])
    every = max(1, len(frames) // 10)
    axes.plot(frames, values.mean(axis=0), **style, label=label, markevery=every)
    if len(lines) > 1:
        low, high = mean_band(values, repetitions=repetitions)
        axes.fill_between(frames, low, high, color=style["color"], alpha=0.18, linewidth=0)


def _draw_published(
    axes: Axes, curves: Sequence[PublishedCurve], end: float, unit: float
) -> list[str]:
    """Plot published curves up to ``end``; returns a note on points below the axis."""
    # A failed published run, far below all others, must not flatten the plot.
    low, high = axes.get_ylim()
    floor = low - 0.75 * (high - low)
    below = []
    for curve in curves:
        points = np.array([(f, unit * v) for f, v in zip(curve.frames, curve.values, strict=True)])
        near = points[points[:, 0] <= _reach(end)]
        if not near.size:
            continue
        low, high = min([low, *near[near[:, 1] >= floor, 1]]), max(high, near[:, 1].max())
        hidden = near[near[:, 1] < floor]
        below += [f"{curve.algorithm} at {f:,.0f} frames ({v:,.0f})" for f, v in hidden]
        index = _PUBLISHED.index(curve.algorithm)
        # Points beyond the end are needed for the slope; the axis clips the line.
        axes.plot(
            *points.T,
            color=_GREYS[index % len(_GREYS)],
            marker=MARKERS[index % len(MARKERS)],
            markersize=4,
            markerfacecolor="white",
            linestyle="--",
            linewidth=1.2,
            zorder=1.5,
            label=f"{curve.algorithm} ({curve.seeds}), published",
        )
    margin = 0.03 * (high - low)
    axes.set_ylim(low - margin, high + margin)
    return [f"Below the axis: {', '.join(below)}."] if below else []


def _reach(end: float) -> float:
    """Upper limit of the frames axis, with room for the markers of the last evaluation."""
    return max(1.0, 1.04 * end)
