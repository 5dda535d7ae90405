"""HTML texts of the page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from torchrl_etl.analysis.viewer.muscles import colors
from torchrl_etl.analysis.viewer.session import Session

__all__ = ["activation_grid", "driven_list", "status"]

_MOST_MUSCLES = 6
_BOX = '<div style="font-size:0.85em;line-height:1.4;padding:0 1em 0.5em">{}</div>'


def status(session: Session) -> str:
    """Current task, step, return and success."""
    task, subject = session.subject.task, session.subject
    limit = subject.episode_steps
    goal = f" ({escape(str(session.goal))} goal)" if session.goal else ""
    lines = [
        f"<b>{escape(task.name)}</b>{goal}",
        f"step <b>{session.steps}</b>{f' of {limit}' if limit else ''}"
        f"{', over' if session.over else ''}",
        f"return <b>{session.total_reward:.1f}</b>",
    ]
    if session.solved is not None:
        now = "yes" if session.solved else "no"
        needed = f" of {task.solved_steps} needed" if task.solved_steps else ""
        counts = ": <b>solved</b>" if session.success else ""
        lines.append(f"solved now: <b>{now}</b>; {session.solved_steps} steps{needed}{counts}")
    return _BOX.format("<br/>".join(lines))


def driven_list(muscles: Sequence[tuple[str, float]]) -> str:
    """The strongest muscles of a synergy with bars; a click shows the others.

    Examples:
        >>> "ECRL" in driven_list([("ECRL", 0.5), ("FDS", -0.2)])
        True
    """
    if not muscles:
        return _BOX.format("It moves no muscle.")
    rows = [_bar(name, strength) for name, strength in muscles]
    first, others = rows[:_MOST_MUSCLES], rows[_MOST_MUSCLES:]
    more = f"<details><summary>{len(others)} more</summary>{''.join(others)}</details>"
    return _BOX.format("".join(first) + (more if others else ""))


def _bar(name: str, strength: float) -> str:
    color = "rgb({},{},{})".format(*colors(np.array(np.sign(strength) * 0.8)))
    return (
        '<div style="display:flex;align-items:center;gap:0.5em">'
        f'<span style="width:7em;overflow:hidden;white-space:nowrap">{escape(name)}</span>'
        f'<span style="flex:1"><span style="display:block;height:0.5em;background:{color};'
        f'width:{100 * min(1.0, abs(strength)):.0f}%"></span></span>'
        f'<span style="width:3.5em;text-align:right">{100 * strength:+.0f} %</span></div>'
    )


def activation_grid(names: Sequence[str], active: np.ndarray) -> str:
    """One cell per actuator, in the colour of its tendon."""
    cells = []
    for name, value, color in zip(names, active, colors(active), strict=True):
        shade = "rgb({},{},{})".format(*color)
        cells.append(
            f'<span title="{escape(name)}: {100 * value:.0f} %" style="background:{shade};'
            'color:white;padding:0 0.3em;border-radius:0.2em;white-space:nowrap">'
            f"{escape(name)}</span>"
        )
    grid = '<span style="display:flex;flex-wrap:wrap;gap:0.2em;font-size:0.85em">{}</span>'
    return _BOX.format(grid.format("".join(cells)))
