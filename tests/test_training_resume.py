"""A killed or stopped run resumes and ends with the numbers of an uninterrupted one."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import pytest
import torch

from tests.commands import wait_until
from tests.configs import ROOT, TINY, tiny
from tests.runs import has_saved, killed_when_saved, numbers, stopped
from tests.stages import update
from torchrl_etl.collectors import STOP_SIGNALS
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners import SACLearner
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.training import Interrupted, resumed_config
from torchrl_etl.training.checkpoints import Checkpoints, _digests
from torchrl_etl.training.stage import Stage

# Options with running statistics, or with a schedule over frames.
STATEFUL = (
    "learn.sac.normalize_observations=true",
    "learn.sac.return_bound=5",
    "learn.sac.lr_end=0.5",
    "learn.sac.ema_decay=0.9",
    "learn.prefill=true",
)


def command(run: Path, *overrides: str) -> list[str]:
    recipe = [sys.executable, str(ROOT / "recipes" / "etl_sac.py")]
    return [*recipe, *TINY, *STATEFUL, f"run_dir='{run}'", *overrides]


def start(arguments: list[str], log: Path) -> subprocess.Popen:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with log.open("w") as file:
        return subprocess.Popen(
            arguments, stdout=file, stderr=subprocess.STDOUT, cwd=log.parent, env=environment
        )


def collected(monkeypatch, experiment: Experiment) -> int:
    """Run an experiment; returns the frames that this process collected."""
    frames = []
    collect = Stage.collect

    def counting(stage):
        batch = collect(stage)
        frames.append(len(batch))
        return batch

    monkeypatch.setattr(Stage, "collect", counting)
    experiment.run()
    return sum(frames)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run that nothing interrupted."""
    run = tmp_path_factory.mktemp("whole") / "run"
    Experiment(tiny(*STATEFUL, f"run_dir='{run}'")).run()
    return run


@pytest.fixture(scope="module")
def uninterrupted(whole) -> dict[str, str]:
    return numbers(whole)


@pytest.fixture
def copy(whole, tmp_path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "run"))


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["explore", "learn"])
def test_kill_9_in_either_stage_and_resume_gives_the_same_numbers(
    stage, tmp_path, monkeypatch, uninterrupted
):
    run = tmp_path / "a run"  # with a space
    process = start(command(run), tmp_path / "log.txt")
    seal = run / "checkpoints" / stage / "checkpoint-000000000320" / "seal.json"
    wait_until(seal.exists, process)
    time.sleep(random.uniform(0, 0.3))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (run / "summary.json").exists()

    experiment = Experiment(resumed_config(run), resume=run)
    assert collected(monkeypatch, experiment) < 2 * 608 - 300, "it resumed and did not start over"
    assert numbers(run) == uninterrupted


def test_resume_before_the_first_checkpoint_starts_the_stage_over(tmp_path, uninterrupted):
    run = tmp_path / "run"
    experiment = Experiment(tiny(*STATEFUL, f"run_dir='{run}'"))
    experiment.folder.open(resume=False)
    experiment.folder.log({"explore/return": 1.0, "learn/eval/return": 2.0}, 0)
    Experiment(resumed_config(run), resume=run).run()
    assert numbers(run) == uninterrupted


def test_another_seed_gives_other_numbers(tmp_path, uninterrupted):
    run = tmp_path / "run"
    Experiment(tiny(*STATEFUL, f"run_dir='{run}'", "seed=1")).run()
    other = numbers(run)
    assert other.keys() == uninterrupted.keys()
    assert other["csv/scalars/learn/return.csv"] != uninterrupted["csv/scalars/learn/return.csv"]


def test_resume_falls_back_from_a_damaged_newest_checkpoint(copy, uninterrupted):
    newest = max((copy / "checkpoints" / "learn").glob("checkpoint-*"))
    victim = next(path for path in newest.rglob("*.memmap") if path.stat().st_size)
    content = bytearray(victim.read_bytes())
    content[0] ^= 1
    victim.write_bytes(content)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Experiment(resumed_config(copy), resume=copy).run()
    assert any(f"{newest} is damaged" in str(warning.message) for warning in caught)
    assert numbers(copy) == uninterrupted


def test_sac_with_learner_options_resumes_with_the_same_numbers(tmp_path):
    learner = (
        *("method=sac", "actor.body=residual", "learn.critic.bins=11", "learn.noise.kind=held"),
        *("learn.sac.return_bound=5", "learn.replay_ratio=0.5", "frames=608"),
    )
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    Experiment(tiny(f"run_dir='{whole}'", *learner)).run()

    killed_when_saved(broken, 320, *learner)
    summary = Experiment(resumed_config(broken), resume=broken).run()
    assert "synergies" not in summary and summary["learn"]["frames_charged"] == 608
    assert numbers(broken) == numbers(whole)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_stop_signal_saves_a_checkpoint(number, tmp_path):
    stopped(tmp_path / "run", *STATEFUL, number=number)
    (checkpoint,) = (tmp_path / "run" / "checkpoints").glob("*/*")
    assert checkpoint.name == "checkpoint-000000000224" and (checkpoint / "seal.json").exists()


def test_stopped_run_resumes_without_logging_a_frame_twice(tmp_path):
    run = tmp_path / "run"
    experiment = stopped(run, *STATEFUL)
    summary = Experiment(resumed_config(run), resume=run).run()
    assert summary["learn"]["frames"] == 608
    frames, _ = experiment.folder.series("explore/updates")
    assert frames == sorted(set(frames)), "no frame is logged twice"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["process", "async"])
def test_stop_signal_to_the_process_group_saves_a_checkpoint(kind, tmp_path):
    run = tmp_path / "run"
    arguments = [*TINY, f"collector={kind}", "collector.num_workers=1", "explore.frames=1000000"]
    process = subprocess.Popen(
        [sys.executable, ROOT / "recipes" / "etl_sac.py", *arguments, f"run_dir='{run}'"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    wait_until((run / "csv/scalars/explore/updates.csv").exists, process)
    os.killpg(process.pid, signal.SIGTERM)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130, output
    assert has_saved(run, "explore")
    assert "Traceback" not in output


def test_checkpoint_with_a_pickle_is_not_loaded(copy):
    newest = max((copy / "checkpoints" / "learn").glob("checkpoint-*"))
    assert {path.suffix for path in newest.rglob("*") if path.is_file()} == {".json", ".memmap"}
    (newest / "planted.pkl").write_bytes(b"not even read")
    digests = _digests(newest)
    (newest / "seal.json").write_text(json.dumps(digests))
    with pytest.warns(UserWarning, match=r"planted\.pkl is not a kind of file"):
        older = Checkpoints(newest.parent, keep_last=2).newest_whole()
    assert older is not None and older != newest


@pytest.mark.parametrize(
    "slow_part", ["explore.fit.final_updates=100000", "vaf_curve.updates=100000"]
)
def test_run_stopped_in_final_fit_or_pictures_resumes(slow_part, tmp_path, monkeypatch):
    run = tmp_path / "run"
    settings = ("pictures=true", "explore.frames=320", slow_part)
    experiment = Experiment(tiny(*STATEFUL, f"run_dir='{run}'", *settings))
    save = Checkpoints.save

    def save_and_signal(self, checkpoint, *, step, **kwargs):
        folder = save(self, checkpoint, step=step, **kwargs)
        if step == 320:
            threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        return folder

    monkeypatch.setattr(Checkpoints, "save", save_and_signal)
    with pytest.raises(Interrupted):
        experiment.run()
    monkeypatch.undo()
    quick = ["explore.fit.final_updates=20", "vaf_curve.updates=20"]
    summary = Experiment(resumed_config(run, quick), resume=run).run()
    assert summary["learn"]["frames"] == 608
    assert (run / "pictures" / "vaf.png").exists()


def test_run_stopped_in_prefill_updates_resumes(tmp_path, monkeypatch):
    run = tmp_path / "run"
    experiment = Experiment(tiny(f"run_dir='{run}'", "learn.prefill=true"))
    learn, updates = SACLearner.updates, []

    def learn_and_signal(self, inputs):
        if experiment.folder.explored.exists():  # in stage 2
            if len(updates) < 20 <= len(updates) + len(inputs):
                os.kill(os.getpid(), signal.SIGINT)
            updates.extend(inputs)
        return learn(self, inputs)

    monkeypatch.setattr(SACLearner, "updates", learn_and_signal)
    with pytest.raises(Interrupted):
        experiment.run()
    assert len(updates) < 600 // 16
    monkeypatch.undo()
    Experiment(resumed_config(run), resume=run).run()
    own = 608 - 96  # no updates for the batches up to 100 frames
    assert experiment.folder.series("learn/updates")[1][-1] == (own + 600) // 16


def test_run_of_stage_1_resumes_with_stage_2(tmp_path, uninterrupted):
    run = tmp_path / "run"
    experiment = Experiment(tiny(*STATEFUL, f"run_dir='{run}'", "stage=explore"))
    experiment.run()
    file = experiment.folder.explored
    file.rename(f"{file}.away")
    with pytest.raises(OSError, match="is missing, and stage 2 needs"):
        Experiment(resumed_config(run, ["stage=all"]), resume=run).run()
    Path(f"{file}.away").rename(file)
    Experiment(resumed_config(run, ["stage=all"]), resume=run).run()
    assert numbers(run) == uninterrupted


@pytest.mark.parametrize(
    ("name", "compile"),
    [
        ("explore", "false"),
        pytest.param("explore", "true", marks=pytest.mark.slow),
        ("learn", "false"),
    ],
)
def test_learner_state_is_bit_exact_after_a_load(name, compile, tmp_path):
    experiment = Experiment(tiny(f"run_dir='{tmp_path}/run'", f"compile={compile}"))

    def fresh():
        if name == "explore":
            return Explorer(experiment.context).stage
        return experiment.method.learn_stage(SynergyDecoder(2, 16, hidden=(32, 32)))

    stage = fresh()
    stage.restart_collection()
    for _ in range(4):
        stage.collect()
        update(stage)
    stage.checkpoint().save(tmp_path / "saved")
    twin = fresh()
    twin.checkpoint().load(tmp_path / "saved")
    rows = []
    for one in (stage, twin):  # the first is compiled already, the second is not
        torch.manual_seed(0)
        rows.append(torch.stack([update(one) for _ in range(3)]))
    assert (rows[0] == rows[1]).all()
    stage.close()
