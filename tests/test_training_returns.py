"""The study that averages the returns of training episodes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from tests.commands import script
from tests.configs import ROOT


def test_returns_are_averaged_over_complete_stretches(tmp_path: Path):
    run = tmp_path / "run"
    log = run / "csv" / "scalars" / "learn" / "return.csv"
    log.parent.mkdir(parents=True)
    log.write_text("5,1.0\n10,3.0\n15,4.0\n20,6.0\n45,9.0\n")
    (run / "config.yaml").write_text("env: task\nmethod: {name: sac}\nseed: 3\n")
    (run / "versions.json").write_text(json.dumps([{"commit": "c", "machine": "m"}]))
    out = tmp_path / "out.csv"
    study = ROOT / "studies" / "training_returns.py"
    assert script(study, str(run), "--stretch", "10", "--out", str(out)) == 0
    with out.open(encoding="utf-8") as file:
        rows = [list(row.values()) for row in csv.DictReader(file)]
    assert rows == [
        ["task", "sac", "3", "10", "2.0", "c", "m"],
        ["task", "sac", "3", "20", "5.0", "c", "m"],  # no complete stretch after it
    ]
    (log.parent / "loss.csv").write_text("10,3.0\n")
    before = out.read_text()
    assert script(study, str(run), "--stretch", "10", "--out", str(out), "--series", "loss") == 2
    assert out.read_text() == before, "its header names another series"
