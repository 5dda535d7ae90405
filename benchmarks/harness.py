"""What the benchmarks share: cases that take turns, and one JSON line for each."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from statistics import median, quantiles
from typing import Any

from torchrl_etl.training.run_folder import facts

__all__ = ["interleave", "line", "spread"]


def interleave(cases: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Measure every case in turn, ``repeats`` times over; one unrecorded round comes first.

    What else the machine does then falls on all cases alike, and a ratio within a round holds
    where the figures themselves drift.
    """
    values: dict[str, list[float]] = {name: [] for name in cases}
    for round_ in range(repeats + 1):
        for name, measure in cases.items():
            value = measure()
            if round_:
                values[name].append(value)
    return values


def spread(values: list[float]) -> float:
    """Half the interquartile range."""
    if len(values) < 2:
        return 0.0
    low, _, high = quantiles(values, n=4, method="inclusive")
    return (high - low) / 2


def line(
    benchmark: str,
    case: str,
    unit: str,
    values: list[float],
    *,
    peer: str | None = None,
    peer_values: list[float] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Print and return one case: median, spread, and the median ratio to a peer round by round."""
    row = {
        "benchmark": benchmark,
        "case": case,
        "unit": unit,
        "median": round(median(values), 4),
        "spread": round(spread(values), 4),
        "repeats": len(values),
        **more,
    }
    if peer_values is not None:
        ratios = [mine / other for mine, other in zip(values, peer_values, strict=True)]
        row |= {"peer": peer, "ratio": round(median(ratios), 3), "ratio_spread": spread(ratios)}
        row["ratio_spread"] = round(row["ratio_spread"], 3)
    print(json.dumps({**row, **facts()}), flush=True)
    return row
