"""The report of a sweep: its tables, its pictures and its messages."""

from __future__ import annotations

import pytest
from PIL import Image

from tests.commands import recipe_module
from tests.sweep_rows import FEW, run, sweep, write
from torchrl_etl.analysis.published import caveats, published_curves
from torchrl_etl.analysis.sweep_pictures import _PUBLISHED, looks, overall_picture, task_picture


def report(*arguments):
    recipe_module("report").main([*arguments, f"repetitions={FEW}"])


def test_line_styles_are_distinct_and_never_the_grey_of_published_curves():
    styles = looks([f"method {i}" for i in range(21)])
    assert len({(s["color"], s["linestyle"]) for s in styles.values()}) == 21
    assert "#666666" not in {style["color"] for style in styles.values()}


def test_every_published_algorithm_has_a_line_style():
    shown = [published_curves("dog-run"), published_curves("myoHandKeyTurnFixed-v0", "success")]
    assert {curve.algorithm for curves in shown for curve in curves} == set(_PUBLISHED)


def test_published_outlier_is_in_the_caption_and_not_on_the_axis(tmp_path, monkeypatch):
    """FlashSAC's Pen Twirl is published at −4,833 after 100,000 frames."""
    figures = []
    monkeypatch.setattr(
        "torchrl_etl.analysis.sweep_pictures.write", lambda figure, path: figures.append(figure)
    )
    runs = sweep(tmp_path, run([0.0, 100.0, 200.0], task="myoHandPenTwirl")).runs
    task_picture(runs, looks(["sac"]), tmp_path / "x.png")
    assert figures[0].axes[0].get_ylim()[0] > -1000
    caption = " ".join(figures[0].get_supxlabel().split())
    assert "Below the axis: FlashSAC at 100,000 frames (-4,833)" in caption
    assert caveats("myoHandPenTwirlFixed-v0") in caption


def test_pictures_without_runs_or_methods_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no finished runs"):
        task_picture([], {}, tmp_path / "x.png")
    with pytest.raises(ValueError, match="No method"):
        overall_picture([], {}, tmp_path / "x.png")
    assert not list(tmp_path.iterdir())


def test_report_from_end_to_end(tmp_path, capsys):
    rows = []
    for seed in range(3):
        rows += run([-300, 100 + seed, 500 + seed], seed=seed, solved=0.5, solved_time=0.25)
        rows += run([-300, 200 + seed, 600 + seed], seed=seed, method="etl", commit="fff0000")
        rows += run([1, 5, 20 + seed], seed=seed, task="dog-run")
    rows += run([-300, 0, 7777], seed=9, method="etl", status="killed: out of memory")
    rows += run([1, 5, 44], seed=0, task="dog-run", method="dep", machine="other | class")
    rows += run([1, 2], seed=0, task="dog-walk", method="eme", status="diverged")
    rows += run([""], seed=1, task="dog-walk", method="eme", status="failed")  # no evaluation
    rows += run([1, 5, 21], seed=1, task="dog-run")  # a repeat
    folder, out = write(tmp_path / "a sweep", rows), tmp_path / "new" / "report"
    report(f"results={folder}", f"out={out}")
    assert "written to" in capsys.readouterr().out
    text = (out / "report.md").read_text()
    for words in (
        "At 100,000 environment frames, exploration included.",
        "| etl | 3 | 601.0 | 600.0 to 602.0 | 601.0 |",
        "| dep | 1 | 44.0 | - | 44.0 | one seed: no interval | 1.00 |",
        "| sac | 3 | 501.0 | 500.0 to 502.0 | 501.0 |",
        "50 % | 25 % | 1.00 |",
        " 3 evaluations are left out, since their runs were repeated later.",
        "No run of eme finished.",
        "etl lacks dog-run (fixed)",
        "dep lacks myoHandKeyTurn (fixed)",
        "No finished run to compare at the budget: etl.",
        "unequal numbers of seeds",
        "- myoHandKeyTurn (fixed), etl, seed 9: killed: out of memory, last evaluated at 100,000",
        "- dog-walk (fixed), eme, seed 0: diverged, last evaluated at 50,000 frames",
        "- dog-walk (fixed), eme, seed 1: failed, no evaluation",
        f"{len(rows) - 1} evaluations of {13} runs",
        "| fff0000 | 3 |",
        "| other \\| class | 1 |",
        "| torch | 2.13.0 | 10 |",
        "| `learn.n_steps=3` | 10 |",
        "FlashSAC, published",
        "TD-MPC2 ignores termination",
        f"'results={folder}'",
    ):
        assert words in text, words
    assert "7,777" not in text
    for name in ("overall", "myoHandKeyTurn-fixed", "dog-run-fixed"):
        assert f"({name}.png)" in text
        with Image.open(out / f"{name}.png") as image:
            assert len(image.convert("RGB").getcolors(image.width * image.height)) > 20


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["results={}", "control=sca"], 2, "control is 'sca'; choose one of"),
        (["results={}", "control=zzz"], 2, "choose one of sac."),
        (["results={}", "frames=-5"], 2, "frames is '-5'; it must be a whole number, 1 or more"),
        (["results={}", "frames=60000"], 2, "no finished run has an evaluation; the longest run"),
        (["results={}/nowhere"], 2, "There is no folder"),
        ([], 2, "no results are given"),
        (["result={}"], "did you mean results?", ""),
        (["{}"], "not of the form key=value", ""),
    ],
)
def test_wrong_arguments_end_in_one_line_of_error(tmp_path, capsys, arguments, code, words):
    folder = write(tmp_path / "sweep", run([0, 1]))
    with pytest.raises(SystemExit) as exit_:
        report(*(argument.format(folder) for argument in arguments))
    if isinstance(code, int):
        message = capsys.readouterr().err
        assert exit_.value.code == code and words in message and message.count("\n") == 1
        assert not (folder / "report.md").exists()
    else:
        assert code in exit_.value.code


def test_report_without_finished_runs_says_so(tmp_path, capsys):
    folder = write(tmp_path / "sweep", run([0, 1], status="running"))
    with pytest.raises(SystemExit):
        report(f"results={folder}")
    assert "None of the 1 runs finished" in capsys.readouterr().err
