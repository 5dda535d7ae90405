"""Mean return of runs between two frame counts, from evaluations at different frames."""

from __future__ import annotations

import sys

import pytest

from studies import mean_of_curve
from tests.sweep_rows import run, write


def test_runs_evaluated_at_other_frames_are_compared_on_the_same_stretch(
    tmp_path, monkeypatch, capsys
):
    # The same line, 1 per frame, but evaluated 30 frames apart from others.
    rows = run([0, 100, 200], [0, 100, 200]) + run([30, 130, 200], [30, 130, 200], method="etl")
    rows += run([0, 150], [0, 150], seed=1) + run([0, 200], [0, 200], seed=2, status="killed")
    folder = str(write(tmp_path / "sweep", rows))
    monkeypatch.setattr(sys, "argv", ["mean_of_curve.py", folder, "100", "200"])
    mean_of_curve.main()
    assert capsys.readouterr().out.splitlines() == [
        "myoHandKeyTurn (fixed), etl: 150 (0: 150)",
        "myoHandKeyTurn (fixed), sac: 150 (0: 150)",
    ]


@pytest.mark.parametrize(("frames", "words"), [(["2", "1"], "must be below"), (["0", "1"], "no")])
def test_what_cannot_be_read_ends_in_one_line(tmp_path, monkeypatch, capsys, frames, words):
    monkeypatch.setattr(sys, "argv", ["mean_of_curve.py", str(tmp_path / "none"), *frames])
    with pytest.raises(SystemExit):
        mean_of_curve.main()
    assert words in capsys.readouterr().err
