"""read_sweep turns the rows of results.csv into runs, and names a bad cell, column or file."""

from __future__ import annotations

import pytest

from tests.sweep_rows import row, run, sweep, write
from torchrl_etl.analysis.sweep_results import COLUMNS, read_sweep


def test_newest_attempt_replaces_all_rows_of_the_older_one(tmp_path):
    results = sweep(tmp_path, run([0, 1, 2, 3]), run([10, 11, 12]))
    assert [one.mean_return for one in results.runs[0].rows] == [10, 11, 12]
    assert results.replaced == 4 and results.row_count == 7


def test_status_of_a_run_is_that_of_its_newest_row(tmp_path):
    broken = run([0, 1], seed=1, status="diverged")
    broken[-1]["return"] = "nan"
    going = run([0, 1], seed=2, status="running")
    going[-1]["status"] = "finished"
    results = sweep(tmp_path, run([0, 1]), broken, going)
    assert [one.seed for one in results.finished] == [0, 2]
    assert [str(one) for one in results.unfinished] == ["myoHandKeyTurn (fixed), sac, seed 1"]


def test_row_before_the_first_evaluation_gives_way_to_evaluations(tmp_path):
    waiting = row(status="waiting", **{"return": ""})
    (first,) = read_sweep(write(tmp_path / "first", [waiting])).runs
    assert first.status == "waiting" and not first.evaluated
    results = read_sweep(write(tmp_path / "later", [waiting, row(frames=320)]))
    (later,) = results.runs
    assert later.finished and [each.frames for each in later.rows] == [320]
    assert results.row_count == 1 and results.replaced == 0


def test_settings_come_in_the_papers_order_and_unknown_tasks_last(tmp_path):
    tasks = ("aFarTask", "dog-run", "myoHandKeyTurn")
    results = sweep(tmp_path, *(run([0, 1], task=task, goal="") for task in tasks))
    assert [task for task, _ in results.settings] == ["myoHandKeyTurn", "dog-run", "aFarTask"]
    assert {goal for _, goal in results.settings} == {"fixed"}


def test_empty_goal_is_that_of_the_id(tmp_path):
    tasks = ("myoHandKeyTurn", "myoHandKeyTurnRandom-v0")
    results = sweep(tmp_path, *(run([0, 1], task=task, goal="") for task in tasks))
    assert results.settings == (("myoHandKeyTurn", "fixed"), ("myoHandKeyTurnRandom-v0", "random"))


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"return": "12,5"}, "line 3: return is '12,5'; it must be a number"),
        ({"return": ""}, "line 3: .* is finished but this evaluation has no finite return"),
        ({"frames": "1.5"}, "line 3: frames is '1.5'; it must be a whole number"),
        ({"seed": ""}, "line 3: seed is ''"),
        ({"solved": "80"}, "line 3: solved is 80; it must be a share"),
        ({"method": " "}, "line 3: method is empty"),
        ({"versions": "{torch"}, "line 3: versions is not valid JSON"),
        ({"versions": "[1]"}, "line 3: versions must be a JSON object"),
    ],
)
def test_a_bad_cell_is_named_with_its_line(tmp_path, cells, words):
    folder = write(tmp_path, [row(), row(frames=1) | cells])
    with pytest.raises(ValueError, match=words):
        read_sweep(folder)


def test_missing_folder_file_columns_and_rows_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="There is no folder"):
        read_sweep(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"has no results\.csv"):
        read_sweep(tmp_path)
    with pytest.raises(ValueError, match="lacks the columns seed, solved_time;"):
        read_sweep(
            write(tmp_path, [row()], [c for c in COLUMNS if c not in ("seed", "solved_time")])
        )
    with pytest.raises(ValueError, match="no rows"):
        read_sweep(write(tmp_path, []))
    (tmp_path / "results.csv").write_text("")
    with pytest.raises(ValueError, match="no rows"):
        read_sweep(tmp_path)
    folder = write(tmp_path, [row()])
    with (folder / "results.csv").open("a") as file:
        file.write("myoHandKeyTurn,fixed,sac,0,1000")
    with pytest.raises(ValueError, match="line 3: the line does not have as many cells"):
        read_sweep(folder)
