"""A bench's report says what its rows say: no fake interval, no lost run, no borrowed number."""

from __future__ import annotations

import csv
import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rliable import metrics
from scipy.stats import trim_mean

from torchrl_etl.analysis.bench_pictures import (
    _PUBLISHED,
    looks,
    overall_picture,
    task_picture,
)
from torchrl_etl.analysis.bench_results import COLUMNS, read_bench
from torchrl_etl.analysis.bench_statistics import (
    Scale,
    common_budget,
    compare,
    iqm,
    mean_band,
    normalize,
    overall,
    probability_of_improvement,
)
from torchrl_etl.analysis.published import (
    best_published,
    caveats,
    environment_id,
    published_curves,
)
from torchrl_etl.envs import list_tasks

FEW = 50


def row(**cells):
    return {
        "task": "myoHandPose",
        "goal": "fixed",
        "method": "sac",
        "seed": 0,
        "frames": 0,
        "return": 0.0,
        "solved": "",
        "solved_time": "",
        "episodes": 10,
        "wall_seconds": 3600,
        "commit": "abc1234",
        "versions": '{"torch": "2.13.0"}',
        "machine": "Linux x86_64, 2 cores",
        "status": "finished",
    } | cells


def run(returns, frames=None, **cells):
    frames = frames or [50_000 * i for i in range(len(returns))]
    pairs = zip(frames, returns, strict=True)
    return [row(frames=f, **{"return": value}, **cells) for f, value in pairs]


def write(folder: Path, rows, columns=COLUMNS) -> Path:
    folder.mkdir(exist_ok=True)
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return folder


def bench(folder, *runs):
    return read_bench(write(folder, [one for rows in runs for one in rows]))


def report(*arguments):
    path = Path(__file__).parent.parent / "recipes" / "report.py"
    spec = importlib.util.spec_from_file_location("report", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main([*arguments, f"repetitions={FEW}"])


# Estimators


def test_iqm_is_the_mean_of_the_middle_half():
    values = [9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0]
    assert iqm([values], repetitions=0).mean == (3 + 4 + 5 + 6) / 4 == trim_mean(values, 0.25)
    # Over tasks the runs are pooled, whatever their numbers.
    assert iqm([values[:5], values[5:]], repetitions=0).mean == 4.5


def test_iqm_interval_is_repeatable_leaves_numpy_alone_and_covers():
    rng = np.random.default_rng(0)
    np.random.seed(5)
    expected = np.random.random()
    np.random.seed(5)
    hits = 0
    for _ in range(25):
        groups = [rng.normal(3.0, 1.0, 12), rng.normal(3.0, 1.0, 9)]
        mean, low, high = iqm(groups, repetitions=100)
        assert low < mean < high
        hits += low <= 3.0 <= high
    assert 19 <= hits <= 25  # 95 % of 25 is 24; twenty runs cost a little
    assert iqm(groups, repetitions=FEW) == iqm(groups, repetitions=FEW)
    assert np.random.random() == expected


def test_iqm_resamples_within_tasks_only():
    """Two tasks far apart, no spread within: resampling across them would make one up."""
    assert iqm([[0.0, 0.0], [100.0, 100.0]], repetitions=FEW) == (50.0, 50.0, 50.0)


def test_one_seed_gets_no_interval():
    for groups in ([[4.0]], [[1.0, 7.0], [4.0]]):
        mean, low, high = iqm(groups, repetitions=FEW)
        assert mean == 4.0 and math.isnan(low) and math.isnan(high)
    assert math.isnan(probability_of_improvement([([1.0, 2.0], [0.0])], repetitions=FEW).low)


def test_probability_of_improvement():
    low, high = [1.0, 2.0, 3.0], [4.0, 5.0]
    assert probability_of_improvement([(high, low)], repetitions=FEW) == (1.0, 1.0, 1.0)
    assert probability_of_improvement([(low, low)], repetitions=0).mean == 0.5
    # By hand: 2 beats one of {1, 3} and 3 beats one and ties with one, of 4 pairs; and 0 of 2.
    tied = ([2.0, 3.0], [1.0, 3.0])
    assert probability_of_improvement([tied], repetitions=0).mean == (1 + 1.5) / 4
    both = probability_of_improvement([tied, (low[:1], high)], repetitions=0).mean
    assert both == (2.5 / 4 + 0) / 2


def test_probability_of_improvement_is_rliables():
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 5, (6, 3)).astype(float), rng.integers(0, 5, (4, 3)).astype(float)
    ours = probability_of_improvement(list(zip(x.T, y.T, strict=True)), repetitions=0).mean
    assert ours == pytest.approx(metrics.probability_of_improvement(x, y))


def test_band_is_an_interval_of_the_mean_from_three_seeds_up():
    values = np.array([[0.0, 5.0], [1.0, 5.0], [5.0, 5.0]])
    low, high = mean_band(values, repetitions=200)
    assert 0.0 <= low[0] < 2.0 < high[0] < 5.0 + 1e-9
    assert low[1] == high[1] == 5.0
    low, high = mean_band(values[[0, 2]])
    assert (low[0], high[0]) == (0.0, 5.0)


# Reading


def test_newest_row_wins_and_takes_the_older_attempts_tail_along(tmp_path):
    results = bench(tmp_path, run([0, 1, 2, 3]), run([10, 11, 12]))
    assert [one.mean_return for one in results.runs[0].rows] == [10, 11, 12]
    assert results.replaced == 4 and results.row_count == 7


def test_a_run_is_as_finished_as_its_newest_row(tmp_path):
    broken = run([0, 1], seed=1, status="diverged")
    broken[-1]["return"] = "nan"
    going = run([0, 1], seed=2, status="running")
    going[-1]["status"] = "finished"
    results = bench(tmp_path, run([0, 1]), broken, going)
    assert [one.seed for one in results.finished] == [0, 2]
    assert [str(one) for one in results.unfinished] == ["myoHandPose (fixed), sac, seed 1"]


def test_settings_come_in_the_papers_order_and_unknown_tasks_last(tmp_path):
    tasks = ("aFarTask", "dog-run", "myoHandPose")
    results = bench(tmp_path, *(run([0, 1], task=task, goal="") for task in tasks))
    assert [task for task, _ in results.settings] == ["myoHandPose", "dog-run", "aFarTask"]
    assert {goal for _, goal in results.settings} == {"fixed"}


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"return": "12,5"}, "line 3: return is '12,5', which is not a number"),
        ({"return": ""}, "line 3: .* is finished but this evaluation has no finite return"),
        ({"frames": "1.5"}, "line 3: frames is '1.5'; it must be a whole number"),
        ({"seed": ""}, "line 3: seed is ''"),
        ({"solved": "80"}, "line 3: solved is 80; it must be a share"),
        ({"method": " "}, "line 3: method is empty"),
        ({"versions": "{torch"}, "line 3: versions is not a JSON text"),
        ({"versions": "[1]"}, "line 3: versions must be a JSON object"),
    ],
)
def test_a_bad_cell_is_named_with_its_line(tmp_path, cells, words):
    folder = write(tmp_path, [row(), row(frames=1) | cells])
    with pytest.raises(ValueError, match=words):
        read_bench(folder)


def test_missing_things_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="There is no folder"):
        read_bench(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"has no results\.csv"):
        read_bench(tmp_path)
    with pytest.raises(ValueError, match="lacks the columns seed, solved_time;"):
        read_bench(
            write(tmp_path, [row()], [c for c in COLUMNS if c not in ("seed", "solved_time")])
        )
    with pytest.raises(ValueError, match="no rows"):
        read_bench(write(tmp_path, []))
    (tmp_path / "results.csv").write_text("")
    with pytest.raises(ValueError, match="no rows"):
        read_bench(tmp_path)
    folder = write(tmp_path, [row()])
    with (folder / "results.csv").open("a") as file:
        file.write("myoHandPose,fixed,sac,0,1000")
    with pytest.raises(ValueError, match="line 3: the number of cells"):
        read_bench(folder)


# Comparing


def test_budget_is_the_most_that_all_runs_share(tmp_path):
    sac = run([0, 1, 2], [0, 50_000, 100_000])
    etl = run([0, 3, 5, 6], [0, 49_900, 99_000, 150_000], method="etl")
    runs = bench(tmp_path, sac, etl).runs
    assert common_budget(runs) == 100_000
    comparison = compare(runs, ["sac", "etl"], "sac", repetitions=FEW)
    assert comparison.result("etl").returns.tolist() == [5.0]
    assert comparison.result("etl").improvement == 1.0
    assert comparison.result("sac").improvement is None and not comparison.stale
    # A grid that never meets the other's: the last evaluation counts, and is named.
    runs = bench(tmp_path, sac, run([0, 4, 8], [0, 30_000, 80_000], method="etl")).runs
    comparison = compare(runs, ["sac", "etl"], "sac", repetitions=FEW)
    assert comparison.budget == 80_000 and comparison.result("sac").returns.tolist() == [1.0]
    assert [one.method for one in comparison.stale] == ["sac"]


def test_a_batch_more_or_less_at_the_end_changes_nothing(tmp_path):
    sac = run([0, 1, 2], [0, 45_056, 50_048])
    sar = run([0, 3, 4], [0, 45_064, 50_056], method="sar")
    late = run([0, 5, 6], [0, 49_000, 50_600], method="etl")
    runs = bench(tmp_path, sac, sar, late).runs
    for frames in (50_000, None):
        comparison = compare(runs, ["sac", "sar", "etl"], "sac", frames=frames, repetitions=FEW)
        assert comparison.budget == (frames or 50_048)
        assert comparison.result("sac").returns.tolist() == [2.0]
        assert comparison.result("sar").returns.tolist() == [4.0]
        assert not comparison.short and not comparison.stale
    assert compare(runs, ["etl"], "sac", frames=50_000).result("etl").returns.tolist() == [5.0]


def test_runs_that_end_before_an_asked_budget_are_left_out(tmp_path):
    runs = bench(tmp_path, run([0, 1, 2, 3]), run([0, 5], method="etl")).runs
    comparison = compare(runs, ["sac", "etl"], "sac", frames=150_000, repetitions=FEW)
    assert comparison.result("etl") is None
    assert [one.method for one in comparison.short] == ["etl"]


def test_unequal_seeds_and_missing_tasks(tmp_path):
    """By hand. Hand Pose at 100,000: zero −100, one 683.46 (FlashSAC). Leg Walk: one is SAC's."""
    pose = [run([-100, 0, 683.46], method="sac", seed=s) for s in (0, 1, 2)]
    better = [run([-100, 0, 683.46 + 783.46], method="etl", seed=s) for s in (0, 1)]
    walk = [run([-50, 0, 50], task="myoLegWalk", seed=s) for s in (0, 1)]
    results = bench(tmp_path, *pose, *better, *walk)
    comparisons = [
        compare(
            [one for one in results.runs if one.setting == setting],
            ["sac", "etl"],
            "sac",
            repetitions=FEW,
        )
        for setting in results.settings
    ]
    scales = [normalize(comparison, "sac") for comparison in comparisons]
    assert scales[0] == Scale(-100.0, 683.46, "FlashSAC, published")
    assert scales[1] == Scale(-50.0, 50.0, "sac, mean here")
    sac, etl = overall(comparisons, scales, ["sac", "etl"], "sac", repetitions=FEW)
    assert sac.iqm == pytest.approx((1.0, 1.0, 1.0)) and not sac.missing
    assert etl.iqm == pytest.approx((2.0, 2.0, 2.0))
    assert etl.missing == (("myoLegWalk", "fixed"),)
    assert etl.control_iqm == pytest.approx(1.0) and etl.improvement == (1.0, 1.0, 1.0)


def test_a_task_without_a_sound_scale_says_why(tmp_path):
    other = run([0, 1, 2], task="myoLegWalk", method="etl")
    worse = run([0, -1, -2], task="myoRelocate")
    for rows, words in ((other, "sac lacks the task"), (worse, "is not above the untrained")):
        comparison = compare(bench(tmp_path, rows).runs, ["sac", "etl"], "sac", repetitions=FEW)
        assert words in normalize(comparison, "sac")


# Published curves


def test_published_rows_belong_to_tasks_of_ours():
    published = {
        environment_id(task.name, goal)
        for task in list_tasks()
        for goal in task.goals
        if published_curves(environment_id(task.name, goal))
    }
    hands = ("Pose", "KeyTurn", "PenTwirl")
    assert published == {
        *(f"myoHand{name}{goal}-v0" for name in hands for goal in ("Fixed", "Random")),
        *(f"humanoid-{name}" for name in ("stand", "walk", "run")),
        *("dog-walk", "dog-run"),
    }
    path = Path(__file__).parent.parent / "torchrl_etl" / "analysis" / "published_curves.csv"
    with path.open() as file:
        assert {line["env"] for line in csv.DictReader(file)} == published


def test_published_best_and_caveats():
    assert best_published("dog-run", 100_000) == (118.33, "XQC")
    # Between the published points, linearly: XQC has 310.14 and 449.96.
    value, algorithm = best_published("dog-run", 400_000)
    assert (value, algorithm) == (pytest.approx((310.14 + 449.96) / 2), "XQC")
    assert best_published("dog-run", 50_000) is best_published("myoLegWalk-v0", 100_000) is None
    assert "SimbaV2 cuts Key Turn at 100 steps" in caveats("myoHandKeyTurnFixed-v0")
    assert "each action for two" in caveats("myoHandPoseFixed-v0")
    elsewhere = caveats("dog-run")
    assert "SimbaV2" not in elsewhere and "TD-MPC2 ignores termination" in elsewhere
    success = {curve.algorithm for curve in published_curves("myoHandPoseFixed-v0", "success")}
    assert {"TD-MPC2", "XQC"} < success


# Pictures and the whole report


def test_looks_are_distinct_and_never_the_published_grey():
    styles = looks([f"method {i}" for i in range(21)])
    assert len({(s["color"], s["linestyle"]) for s in styles.values()}) == 21
    assert "#666666" not in {style["color"] for style in styles.values()}


def test_every_published_algorithm_has_a_look():
    shown = [published_curves("dog-run"), published_curves("myoHandPoseFixed-v0", "success")]
    assert {curve.algorithm for curves in shown for curve in curves} == set(_PUBLISHED)


def test_a_published_failure_does_not_flatten_the_curves(tmp_path, monkeypatch):
    """FlashSAC's Pen Twirl is published at −4,833 after 100,000 frames."""
    figures = []
    monkeypatch.setattr(
        "torchrl_etl.analysis.bench_pictures.write", lambda figure, path: figures.append(figure)
    )
    runs = bench(tmp_path, run([0.0, 100.0, 200.0], task="myoHandPenTwirl")).runs
    task_picture(runs, looks(["sac"]), tmp_path / "x.png")
    assert figures[0].axes[0].get_ylim()[0] > -1000
    caption = " ".join(figures[0].get_supxlabel().split())
    assert "Below the axis: FlashSAC at 100,000 frames (-4,833)" in caption
    assert caveats("myoHandPenTwirlFixed-v0") in caption


def test_pictures_refuse_nothing_to_draw(tmp_path):
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
    rows += run([1, 5, 21], seed=1, task="dog-run")  # a repeat
    folder, out = write(tmp_path / "a bench", rows), tmp_path / "new" / "report"
    report(f"results={folder}", f"out={out}")
    assert "written to" in capsys.readouterr().out
    text = (out / "report.md").read_text()
    for words in (
        "At 100,000 environment frames, exploration included.",
        "| etl | 3 | 601.0 | 600.0 to 602.0 | 601.0 |",
        "| dep | 1 | 44.0 | - | 44.0 | one seed: no interval | 1.00 |",
        "| sac | 3 | 501.0 | 500.0 to 502.0 | 501.0 |",
        "50 % | 25 % | 1.00 |",
        "3 evaluations belong to runs that were repeated later",
        "No run finished of eme.",
        "etl lacks dog-run (fixed)",
        "dep lacks myoHandPose (fixed)",
        "Without a finished run that reached the budget: etl.",
        "unequal numbers of seeds",
        "- myoHandPose (fixed), etl, seed 9: killed: out of memory, last evaluated at 100,000",
        "- dog-walk (fixed), eme, seed 0: diverged, last evaluated at 50,000 frames",
        "| fff0000 | 3 |",
        "| other \\| class | 1 |",
        "| torch | 2.13.0 | 10 |",
        "FlashSAC, published",
        "TD-MPC2 ignores termination",
        f"'results={folder}'",
    ):
        assert words in text, words
    assert "7,777" not in text
    for name in ("overall", "myoHandPose-fixed", "dog-run-fixed"):
        assert f"({name}.png)" in text
        with Image.open(out / f"{name}.png") as image:
            assert len(image.convert("RGB").getcolors(image.width * image.height)) > 20


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["results={}", "control=sca"], 2, "control=sca has no finished run; did you mean sac?"),
        (["results={}", "control=zzz"], 2, "there are sac."),
        (["results={}", "frames=-5"], 2, "frames is '-5'; it must be a whole number from 1 up"),
        (["results={}/nowhere"], 2, "There is no folder"),
        ([], 2, "no results are named"),
        (["result={}"], "did you mean results?", ""),
        (["{}"], "not of the form key=value", ""),
    ],
)
def test_a_wrong_command_gets_one_sentence(tmp_path, capsys, arguments, code, words):
    folder = write(tmp_path / "bench", run([0, 1]))
    with pytest.raises(SystemExit) as exit_:
        report(*(argument.format(folder) for argument in arguments))
    if isinstance(code, int):
        message = capsys.readouterr().err
        assert exit_.value.code == code and words in message and message.count("\n") == 1
    else:
        assert code in exit_.value.code


def test_nothing_finished_is_said(tmp_path, capsys):
    folder = write(tmp_path / "bench", run([0, 1], status="running"))
    with pytest.raises(SystemExit):
        report(f"results={folder}")
    assert "None of the 1 runs finished" in capsys.readouterr().err
