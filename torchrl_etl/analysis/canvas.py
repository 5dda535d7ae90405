"""Shared parts of all plots: figure, palette and writing to disk."""

from __future__ import annotations

import os
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_etl.extras import extra
from torchrl_etl.io import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

__all__ = ["MARKERS", "SERIES", "count_frames", "direction_colors", "new_figure", "tidy", "write"]

# Okabe and Ito's colours, distinct under common colour vision deficiencies. Black is reserved for
# text; yellow is hard to read. Markers distinguish series in greyscale.
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#666666")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

# A cyclic colormap that also varies in lightness and from yellow to blue, so that opposite
# directions differ for red-green colour-blind readers.
_CIRCLE = ("#D98200", "#A8324A", "#50206B", "#2A55C8", "#2FA3DD", "#7FD1AE", "#C9C443", "#D98200")


@cache
def direction_colors() -> Colormap:
    """Colormap for directions in the plane, by their angle in turns."""
    with extra("pictures"):
        from matplotlib.colors import LinearSegmentedColormap
    return LinearSegmentedColormap.from_list("directions", _CIRCLE)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of the given size in inches, outside pyplot's global state.

    Examples:
        >>> new_figure(6.0, 4.0).get_size_inches().tolist()
        [6.0, 4.0]
    """
    with extra("pictures"):
        from matplotlib.figure import Figure
    return Figure(figsize=(width, height), dpi=160, layout="constrained")


def tidy(axes: Axes) -> None:
    """Remove the top and right spines and put a faint grid behind the data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)


def count_frames(axes: Axes) -> None:
    """Label the x axis with frames as 50k or 2M."""
    with extra("pictures"):
        from matplotlib.ticker import EngFormatter
    axes.xaxis.set_major_formatter(EngFormatter(sep="", places=None))


def write(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Save as PNG, atomically."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(content := BytesIO(), format="png")
    write_atomically(path, content.getvalue())
    return path
