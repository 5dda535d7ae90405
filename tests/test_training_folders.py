"""Run folders are self-contained; lost or damaged files are named when a run is resumed."""

from __future__ import annotations

import shutil
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from tests.configs import tiny
from tests.runs import killed_when_saved, numbers, stopped
from torchrl_etl.envs import SimulationError
from torchrl_etl.envs.analytic import AnalyticOveractuated
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import save_bundle
from torchrl_etl.training import resumed_config, run_folder
from torchrl_etl.training.run_folder import RunFolder, facts

FULL = Path("/dev/full")
ONLY_AT_THE_END = "checkpoint.every=100000"


def rows(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (run / "csv").rglob("*.csv")}


def resume(run: Path, *overrides: str) -> dict:
    return Experiment(resumed_config(run, overrides), resume=run).run()


@pytest.fixture
def bundle(tmp_path) -> Path:
    decoder, names = SynergyDecoder(2, 16, hidden=(32, 32)), [f"muscle_{i}" for i in range(16)]
    return save_bundle(decoder, tmp_path / "other", task="overactuated", actuators=names)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("finished") / "run"
    Experiment(tiny(f"run_dir='{run}'", "learn.prefill=true")).run()
    return run


@pytest.fixture
def copy(finished, tmp_path) -> Path:
    """A copy of a finished run in another folder."""
    return Path(shutil.copytree(finished, tmp_path / "copy"))


# Checkpoints ---------------------------------------------------------------------------------


def test_every_simulator_of_a_run_is_closed(tmp_path, monkeypatch):
    count = {"open": 0}
    build, close = AnalyticOveractuated.__init__, AnalyticOveractuated.close

    def counted_build(env, *arguments, **options):
        count["open"] += 1
        build(env, *arguments, **options)

    def counted_close(env):
        count["open"] -= 1
        close(env)

    monkeypatch.setattr(AnalyticOveractuated, "__init__", counted_build)
    monkeypatch.setattr(AnalyticOveractuated, "close", counted_close)
    Experiment(tiny(f"run_dir='{tmp_path}/run'", "method=sac")).run()
    assert count["open"] == 0


def test_tensorboard_hides_points_of_a_run_killed_before_its_first_checkpoint(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = tmp_path / "run"
    experiment = Experiment(tiny(f"run_dir='{run}'", "method=sac", "log=[tensorboard]"))
    experiment.folder.open(resume=False)
    experiment.folder.log({"learn/return": 1.0}, 250)
    experiment.folder._loggers[1].experiment.close()
    experiment.folder.close()
    resume(run)
    events = accumulator.EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    frames, _ = experiment.folder.series("learn/return")
    assert [point.step for point in events.Scalars("learn/return")] == frames


def test_resume_of_a_finished_run_leaves_no_files_of_its_buffer(tmp_path):
    run = tmp_path / "run"
    Experiment(tiny(f"run_dir='{run}'", "method=sac", "learn.buffer_storage=memmap")).run()
    resume(run)
    assert not list((run / "buffer").rglob("*.memmap"))


def test_resume_with_damaged_checkpoints_is_refused_and_keeps_rows(copy):
    before = rows(copy)
    for checkpoint in (copy / "checkpoints" / "learn").iterdir():
        next(checkpoint.rglob("*.memmap")).unlink()
    with (
        pytest.warns(UserWarning, match="is damaged") as caught,
        pytest.raises(
            OSError, match=r"All checkpoints in .*learn are damaged; copy .* or start a new run"
        ),
    ):
        resume(copy)
    assert sum("is damaged" in str(warning.message) for warning in caught) == 2
    assert rows(copy) == before


def test_resume_of_a_finished_run_without_checkpoints_is_refused(copy):
    before = rows(copy)
    shutil.rmtree(copy / "checkpoints")
    with pytest.raises(OSError, match="608 of stage 'learn' but has no checkpoint of it; copy"):
        resume(copy)
    assert rows(copy) == before


@pytest.mark.parametrize(("method", "stage"), [("etl", "explore"), ("sac", "learn")])
def test_resume_without_the_only_checkpoint_is_refused(method, stage, tmp_path):
    run = tmp_path / "run"
    killed_when_saved(run, 608, f"method={method}", ONLY_AT_THE_END)
    before = rows(run)
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(OSError, match=f"at frame 608 of stage '{stage}' but has no checkpoint"):
        resume(run)
    assert before and rows(run) == before


def test_resume_of_a_stopped_run_without_checkpoints_is_refused(tmp_path):
    run = tmp_path / "run"
    stopped(run, ONLY_AT_THE_END)
    before = rows(run)
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(OSError, match="at frame 224 of stage 'explore' but has no checkpoint"):
        resume(run)
    assert before and rows(run) == before


def test_stage_2_resumes_without_checkpoints_of_stage_1(copy):
    shutil.rmtree(copy / "checkpoints" / "explore")
    assert resume(copy, "learn.frames=640")["learn"]["frames"] == 640


# Other files ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["versions.json", "saved.json", "csv/scalars/learn/updates.csv"])
@pytest.mark.parametrize("content", [b"\xff\x00\n", b"{\n", b'"text"\n'])
def test_resume_names_a_damaged_file_and_works_without_it(name, content, copy):
    file = copy / name
    file.write_bytes(content)
    # saved.json is read only if there are no checkpoints.
    away = copy / "checkpoints" / "learn"
    if name == "saved.json":
        away.rename(copy / "away")
    with pytest.raises(OSError, match=rf"{file.name} (is|holds) .*; move it away"):
        resume(copy)
    if name == "saved.json":
        (copy / "away").rename(away)
    file.unlink()
    assert resume(copy)["learn"]["frames"] == 608


@pytest.mark.skipif(not FULL.exists(), reason="Linux has a disk that is always full")
def test_full_disk_error_names_the_run(tmp_path):
    folder = RunFolder(run := tmp_path / "my run", OmegaConf.create({"log": []}))
    file = run / "csv" / "scalars" / "learn" / "return.csv"
    file.parent.mkdir(parents=True)
    file.symlink_to(FULL)
    words = rf"The log of {run} cannot be written \(No space left.*'resume={run}'\."
    with pytest.raises(OSError, match=words):
        folder.log({"learn/return": 1.0}, 5)


def test_resume_drops_a_truncated_row(copy):
    file = copy / "csv/scalars/learn/updates.csv"
    whole = file.read_text()
    file.write_text(f"{whole}2000,1e")
    resume(copy)
    assert file.read_text() == whole


def test_resume_with_damaged_transitions_of_stage_1_is_refused(copy):
    shutil.rmtree(copy / "checkpoints" / "learn")
    (copy / "saved.json").unlink()
    (copy / "explored.safetensors").write_bytes(b"no tensors")
    with pytest.raises(OSError, match=r"explored\.safetensors is damaged .*; start a new run"):
        resume(copy)


# Synergies from elsewhere --------------------------------------------------------------------


def test_moved_run_resumes_without_its_original_bundle(bundle, tmp_path):
    whole, run, moved = (tmp_path / name for name in ("whole", "run", "moved"))
    Experiment(tiny(f"run_dir='{whole}'", f"synergies='{bundle}'")).run()
    killed_when_saved(run, 320, f"synergies='{bundle}'")
    shutil.rmtree(bundle)
    run.rename(moved)

    experiment = Experiment(resumed_config(moved), resume=moved)
    assert experiment.evaluator(experiment.learned())().summary()["return"]["mean"] < 0
    resume(moved)
    assert numbers(moved) == numbers(whole)


def test_resume_without_any_synergies_names_their_folder(bundle, tmp_path):
    run = tmp_path / "run"
    killed_when_saved(run, 320, f"synergies='{bundle}'")
    kept = tmp_path / "kept"
    (run / "synergies").rename(kept)
    shutil.rmtree(bundle)
    with pytest.raises(
        FileNotFoundError, match=f"which no longer exists; copy that bundle to {run}/synergies"
    ):
        resumed = resumed_config(run)
        Experiment(resumed, resume=run)
    kept.rename(run / "synergies")
    assert resume(run)["learn"]["frames"] == 608


# Budgets and simulators ----------------------------------------------------------------------


@pytest.mark.parametrize("begun_with", ["frames", "learn.frames"])
@pytest.mark.parametrize("longer", ["frames", "learn.frames"])
def test_budget_given_on_resume_replaces_either_budget_setting(begun_with, longer, tmp_path):
    run = tmp_path / "run"
    Experiment(tiny(f"run_dir='{run}'", "method=sac", f"{begun_with}=320")).run()
    assert resume(run, f"{longer}=640")["learn"]["frames"] == 640
    assert resume(run)["learn"]["frames"] == 640, "the budget given on resume is kept"


def test_restart_seed_resumes_past_a_diverging_simulation(tmp_path, monkeypatch):
    seeds, deadly = [], set()
    reset, step = AnalyticOveractuated.reset, AnalyticOveractuated.step

    def noted(env, *, seed=None, options=None):
        if seed is not None:
            seeds.extend([seed] if seed >= 2**30 else [])  # not those of evaluations
            env.diverges = seed in deadly
        return reset(env, seed=seed, options=options)

    def diverging(env, action):
        observation, *rest = step(env, action)
        return (observation * np.nan if env.diverges else observation), *rest

    monkeypatch.setattr(AnalyticOveractuated, "reset", noted)
    monkeypatch.setattr(AnalyticOveractuated, "step", diverging)
    control = ("method=sac", "frames=608")
    Experiment(tiny(f"run_dir='{tmp_path}/whole'", *control)).run()
    deadly.add(seeds[-1])  # of episodes begun after the checkpoint at frame 320

    run = tmp_path / "run"
    with pytest.raises(SimulationError, match="continue with resume=RUN restart_seed=1"):
        Experiment(tiny(f"run_dir='{run}'", *control)).run()
    with pytest.raises(SimulationError):
        resume(run)
    up_to_320 = numbers(tmp_path / "whole")["csv/scalars/learn/updates.csv"].split("416")[0]
    assert resume(run, "restart_seed=1")["learn"]["frames"] == 608
    assert numbers(run)["csv/scalars/learn/updates.csv"].startswith(up_to_320)
    assert numbers(run) != numbers(tmp_path / "whole")


def test_facts_of_a_package_that_is_not_installed(monkeypatch):
    def missing(name: str) -> str:
        if name == "torchrl_etl":
            raise PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(run_folder, "version", missing)
    found = facts()
    assert "torchrl_etl" not in found and found["torch"] == version("torch")
