"""The queue of a sweep: finished runs are kept, others resumed, and no row is written twice."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException

from tests.commands import begun, command, process, recipe_module, wait_until
from tests.configs import CONF, ROOT, TINY
from tests.runs import has_saved
from torchrl_etl.analysis.sweep_results import COLUMNS
from torchrl_etl.training import Run, Sweep

SETTINGS = [o for o in TINY if not o.startswith(("env=", "progress=", "pictures=", "threads="))]
SMALL = [*SETTINGS, "explore.frames=320", "evaluation.every=200", "checkpoint.every=160"]


def results(out: Path) -> list[dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def results_of_a_killed_sweep(arguments, out: Path, *runs: str) -> list[dict[str, str]]:
    """Kill the sweep as soon as these runs have a checkpoint, and start it again."""
    running = begun("sweep.py", *arguments, cwd=out.parent)
    wait_until(lambda: all(has_saved(out / run, "learn") for run in runs), running)
    running.kill()
    running.wait()
    ended = process("sweep.py", *arguments, cwd=out.parent)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return results(out)


def script(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "script.py"
    path.write_text(text)
    return [str(path)]


def small_run(tmp_path: Path, text: str) -> Run:
    path = tmp_path / "out" / "one"
    return Run("task", None, "method", 0, path, [*script(tmp_path, text), "lr=1"], frames=9)


@pytest.mark.slow
def test_killed_sweep_resumes_and_finishes_every_run(tmp_path):
    out = tmp_path / "a sweep"
    what = ["tasks=[overactuated]", "methods=[sac,etl]", "seeds=[0]", "frames=900", "jobs=2"]
    arguments = [*what, f"settings={' '.join(SMALL)}", f"out={out}"]
    rows = results_of_a_killed_sweep(arguments, out, "overactuated-sac-seed0")
    assert {row["method"] for row in rows} == {"sac", "etl"}
    assert {row["status"] for row in rows} == {"finished"}
    frames = {m: [int(row["frames"]) for row in rows if row["method"] == m] for m in ("sac", "etl")}
    for method, charged in (("sac", 0), ("etl", 320)):
        assert frames[method][0] == charged and frames[method][-1] >= 900
        assert len(set(frames[method])) == len(frames[method])
    assert all(float(row["wall_seconds"]) >= 0 and row["commit"] for row in rows)
    assert all(set(SMALL) < set(shlex.split(row["settings"])) for row in rows)

    before = {path: path.stat().st_mtime_ns for path in out.glob("*/summary.json")}
    assert command("sweep.py", *arguments) == 0 and len(before) == 2
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/summary.json")} == before


@pytest.mark.slow
def test_killed_sweep_of_seeds_in_one_process_resumes(tmp_path):
    out = tmp_path / "a sweep, (new)=1"
    what = ["tasks=[overactuated]", "methods=[sac]", "seeds=[0,1]", "frames=900", "jobs=1"]
    what += ["seeds_at_once=true", f"settings={' '.join(SMALL)}", f"out={out}"]
    runs = [f"overactuated-sac-seed{seed}" for seed in (0, 1)]
    rows = results_of_a_killed_sweep(what, out, *runs)
    assert {(row["seed"], row["status"]) for row in rows} == {("0", "finished"), ("1", "finished")}
    assert [row["return"] for row in rows if row["seed"] == "0"] != [
        row["return"] for row in rows if row["seed"] == "1"
    ]
    assert [(out / run / "log.txt").exists() for run in runs] == [True, False]


def test_failing_run_is_retried_and_then_given_up(tmp_path):
    run = small_run(tmp_path, "print('it broke'); raise SystemExit(3)")
    sweep = Sweep([run], tmp_path / "out", jobs=1, attempts=2)
    for _ in sweep:
        pass
    assert sweep.status(run) == "failed" and run.starts == 2
    assert (run.path / "log.txt").read_text().count("it broke") == 2
    (row,) = results(tmp_path / "out")  # nobody takes it for one that was not asked for
    assert (row["seed"], row["return"], row["status"]) == ("0", "", "failed")
    Sweep([run], tmp_path / "out", jobs=1).stop()
    assert len(results(tmp_path / "out")) == 1


@pytest.mark.parametrize("summary", ["{}", '{"learn": {"frames_charged": 9}}'])
def test_finished_run_is_not_started(tmp_path, summary):
    run = small_run(tmp_path, "raise SystemExit('it must not start')")
    run.path.mkdir(parents=True)
    (run.path / "summary.json").write_text(summary)
    sweep = Sweep([run], tmp_path / "out", jobs=1)
    for _ in sweep:
        pass
    assert sweep.status(run) == "finished" and run.starts == 0


def test_run_with_fewer_frames_is_resumed(tmp_path):
    run = small_run(tmp_path, "import sys; print(sys.argv[1:])")
    run.path.mkdir(parents=True)
    (run.path / "config.yaml").write_text("frames: 8")
    (run.path / "summary.json").write_text('{"learn": {"frames_charged": 8}}')
    sweep = Sweep([run], tmp_path / "out", jobs=1, attempts=1)
    for _ in sweep:
        pass
    assert (run.path / "log.txt").read_text() == f"['resume={run.path}', 'frames=9']\n"


def test_run_begun_with_other_settings_is_refused(tmp_path):
    run = small_run(tmp_path, "")
    for _ in Sweep([run], tmp_path / "out", jobs=1, attempts=1):
        pass
    other = replace(run, command=[run.command[0], "lr=2"])
    Sweep([other], tmp_path / "out", jobs=1).stop()  # the run failed before it began
    (run.path / "config.yaml").write_text("frames: 9")
    words = r"started with other settings \(lr=1, lr=2\); pass another out=FOLDER"
    with pytest.raises(ValueError, match=words):
        Sweep([other], tmp_path / "out", jobs=1)


def test_run_finished_in_results_csv_is_not_started(tmp_path):
    run = small_run(tmp_path, "raise SystemExit('it must not start')")
    (tmp_path / "out").mkdir()
    row = dict.fromkeys(COLUMNS, "0") | {"task": "task", "method": "method", "frames": "9"}
    row |= {"goal": "", "settings": "lr=1"}
    other = row | {"seed": "7", "status": "unfinished"}
    lines = [COLUMNS, (row | {"status": "finished"}).values(), other.values()]
    text = "".join(",".join(line) + "\n" for line in lines)
    (tmp_path / "out" / "results.csv").write_text(text)
    sweep = Sweep([run], tmp_path / "out", jobs=1)
    for _ in sweep:
        pass
    assert run.starts == 0
    assert (tmp_path / "out" / "results.csv").read_text() == text
    other = replace(run, command=[run.command[0], "env=task", "lr=2"])
    with pytest.raises(ValueError, match=r"one was started with other settings \(lr=1, lr=2\)"):
        Sweep([other], tmp_path / "out", jobs=1)


@pytest.mark.parametrize("frames", [9, 18])
def test_rows_of_a_finished_run_stay_until_its_folder_has_as_many_frames(frames, tmp_path):
    """A run was killed here and finished on another machine, whose table was copied."""
    run = replace(small_run(tmp_path, ""), frames=frames)
    log = run.path / "csv" / "scalars" / "learn" / "eval" / "return.csv"
    log.parent.mkdir(parents=True)
    log.write_text("0,1.0\n")
    (run.path / "config.yaml").write_text("evaluation: {episodes: 1}")
    (run.path / "versions.json").write_text('[{"commit": "a", "machine": "m"}]')
    row = dict.fromkeys(COLUMNS, "0") | {"task": "task", "goal": "", "method": "method"}
    row |= {"frames": "9", "settings": "lr=1", "status": "finished"}
    text = ",".join(COLUMNS) + "\n" + ",".join(row.values()) + "\n"
    (tmp_path / "out" / "results.csv").write_text(text)
    sweep = Sweep([run], tmp_path / "out", jobs=1)
    sweep.write()
    assert (tmp_path / "out" / "results.csv").read_text() == text
    log.write_text("0,1.0\n12,2.0\n")
    sweep.stop()
    assert [row["frames"] for row in results(tmp_path / "out")] == ["0", "12"]


@pytest.mark.parametrize("columns", [(*COLUMNS, "note"), COLUMNS[1:]])
def test_table_with_other_columns_is_refused(columns, tmp_path):
    run = small_run(tmp_path, "raise SystemExit('it must not start')")
    (tmp_path / "out").mkdir()
    text = "".join(",".join(line) + "\n" for line in (columns, "0" * len(columns)))
    (tmp_path / "out" / "results.csv").write_text(text)
    with pytest.raises(ValueError, match=r"has the columns .* it must have task, goal"):
        Sweep([run], tmp_path / "out", jobs=1)


def test_table_without_settings_keeps_its_rows(tmp_path):
    run = small_run(tmp_path, "raise SystemExit('it must not start')")
    (tmp_path / "out").mkdir()
    columns = [name for name in COLUMNS if name != "settings"]
    row = dict.fromkeys(columns, "0") | {"task": "task", "goal": "", "method": "method"}
    row |= {"frames": "9", "status": "finished"}
    text = ",".join(columns) + "\n" + ",".join(row.values()) + "\n"
    (tmp_path / "out" / "results.csv").write_text(text)
    Sweep([run], tmp_path / "out", jobs=1).stop()
    assert run.starts == 0 and results(tmp_path / "out") == [row | {"settings": ""}]


def test_row_has_the_commit_of_the_start_that_logged_it(tmp_path):
    run = small_run(tmp_path, "")
    log = run.path / "csv" / "scalars" / "learn" / "eval" / "return.csv"
    log.parent.mkdir(parents=True)
    log.write_text("320,1.0\n520,2.0\n720,3.0\n")
    (run.path / "config.yaml").write_text("evaluation: {episodes: 2}")
    saved = [{}, {"explore": 320}, {"explore": 320, "learn": 200}]
    starts = [{"commit": name, "machine": "m"} for name in "abc"]
    starts = [one | {"saved": each} for one, each in zip(starts, saved, strict=True)]
    (run.path / "versions.json").write_text(json.dumps(starts))
    assert [row["commit"] for row in run.rows("finished")] == ["b", "b", "c"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has a disk that is always full")
def test_full_disk_ends_the_queue_and_names_the_file(tmp_path):
    run = tmp_path / "overactuated-sac-seed0"
    run.mkdir()
    (run / "summary.json").write_text("{}")
    (tmp_path / ".results.csv.tmp").symlink_to("/dev/full")
    what = ["tasks=[overactuated]", "methods=[sac]", "seeds=[0]", f"out={tmp_path}"]
    ended = process("sweep.py", *what, cwd=tmp_path)
    assert ended.returncode == 2 and "Traceback" not in ended.stderr
    assert f"No space left on device: '{tmp_path}/.results.csv.tmp'" in ended.stderr


def test_ctrl_c_says_that_all_runs_are_saved(tmp_path, monkeypatch, capsys):
    def interrupt(sweep):
        raise KeyboardInterrupt

    monkeypatch.setattr(Sweep, "__iter__", interrupt)
    monkeypatch.setattr(signal, "signal", lambda *given: None)
    what = ["tasks=[overactuated]", "methods=[sac]", "seeds=[0]", f"out={tmp_path}"]
    assert command("sweep.py", *what) == 130
    assert "all runs are saved. Start it again to continue." in capsys.readouterr().out


def test_closing_the_sweep_ends_its_runs(tmp_path):
    run = small_run(tmp_path, "import time; time.sleep(600)")
    sweep = Sweep([run], tmp_path / "out", jobs=1)
    next(iterator := iter(sweep))
    assert sweep.status(run) == "running"
    iterator.close()
    assert run.process.poll() is not None


def test_second_sweep_in_the_same_folder_is_refused(tmp_path):
    sweep = Sweep([], tmp_path / "out", jobs=1)
    other = f"from torchrl_etl.training import Sweep; Sweep([], {str(tmp_path / 'out')!r}, jobs=1)"
    environ = os.environ | {"PYTHONPATH": str(ROOT)}
    ended = subprocess.run([sys.executable, "-c", other], capture_output=True, env=environ)
    assert b"Another queue uses" in ended.stderr
    sweep.stop()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("methods=[sca]", "methods is 'sca'; choose one of"),
        ("tasks=[myoHandPoze]", "myoHandPose"),
        ("seeds=[-1]", "seed is -1"),
        ("frames=0", "frames is 0"),
        ("tasks=myoHandPose", "must be a list"),
        ("settings='learn.sac.rl=1'", r"learn.sac.rl"),
        ("seeds=[0,0]", r"seeds is \[0, 0\]; it must not have duplicates"),
        ("tasks=[overactuated,overactuated]", "tasks is .*; it must not have duplicates"),
        ("methods=[sac,sac]", "methods is .*; it must not have duplicates"),
        ("settings='learn.n_steps=3 seed=5'", "settings has seed=5; set it with seeds instead"),
        ("settings='++method=dep'", r"settings has \+\+method=dep; set it with methods"),
        ("settings='method.kind=dep'", "settings has method=dep; set it with methods instead"),
        ("settings='goal=random'", "set it with tasks, as in TASK:random, instead"),
        ("settings='run_dir=here'", "set it with out instead"),
        ("settings=null", "settings is None; it must be a string"),
        ("out=[a]", r"out is \['a'\]; it must be a string"),
        ("jobs=-1", "jobs is -1"),
        ("jobs=0", "jobs is 0"),
        ("jobs=two", "jobs is 'two'"),
    ],
)
def test_invalid_sweep_setting_is_refused(override, words, recipe):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("sweep", [override])
    with pytest.raises((ValueError, HydraException), match=words):
        recipe.queue(config)


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        ("myoHandPose", ("myoHandPose", "")),
        ("myoHandPose:random", ("myoHandPose", "random")),
        ("my_module:MyTask-v0", ("my_module:MyTask-v0", "")),
        ("my_package.tasks:My/Task-v0", ("my_package.tasks:My/Task-v0", "")),
        ("my_module:MyTask-v0:random", ("my_module:MyTask-v0", "random")),
        ("my_module:MyTask-v0:fixed", ("my_module:MyTask-v0", "fixed")),
    ],
)
def test_split_goal_recognizes_only_fixed_and_random(task, expected, recipe):
    assert recipe.split_goal(task) == expected


def test_sweep_takes_a_custom_task_with_a_random_goal(recipe, tmp_path, monkeypatch):
    (tmp_path / "queue_tasks.py").write_text(
        "import gymnasium as gym\n"
        "entry = 'torchrl_etl.envs.analytic:AnalyticOveractuated'\n"
        "for env_id in ('QueueReach-v0', 'QueueReachRandom-v0'):\n"
        "    gym.register(env_id, entry_point=entry, max_episode_steps=25)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    tasks = "queue_tasks:QueueReach-v0,queue_tasks:QueueReachRandom-v0:random"
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("sweep", [f"tasks=[{tasks}]", "methods=[sac]", "seeds=[0]"])
    fixed, random = recipe.queue(config)
    assert (fixed.task, fixed.goal) == ("queue_tasks:QueueReach-v0", None)
    assert (random.task, random.goal) == ("queue_tasks:QueueReachRandom-v0", "random")
    assert "env=queue_tasks:QueueReachRandom-v0" in random.command
    assert "goal=random" in random.command
    assert random.path.name == "queue_tasks-QueueReachRandom-v0-random-sac-seed0"


def test_settings_take_the_path_of_a_bundle_as_etl_sac_does(recipe):
    overrides = ["env=overactuated", "synergies=/my (new) runs/a"]
    assert recipe.compose(overrides).synergies.bundle == "/my (new) runs/a"


@pytest.fixture(scope="module")
def recipe():
    return recipe_module("sweep")
