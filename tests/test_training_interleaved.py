"""Several seeds in one process give the runs that each seed gives alone."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.configs import tiny
from tests.runs import numbers
from torchrl_etl.envs import SimulationError
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners import StackedLearners
from torchrl_etl.training import Interrupted, resumed_config, run_alone, run_interleaved
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.run_folder import RunFolder
from torchrl_etl.training.simulators import stage_seed
from torchrl_etl.training.stage import Stage

SHORT = ("frames=416", "explore.frames=224", "evaluation.episodes=1")


def work(run: Path, seed: int, *settings: str, stop: StopOnSignal | None = None):
    config = tiny(f"run_dir='{run}'", f"seed={seed}", *SHORT, *settings)
    return Experiment(config).work(stop or StopOnSignal())


def one_after_another(group: StackedLearners, inputs) -> list:
    """The same updates one learner at a time, with the rounding of single runs."""
    return [each.updates(own) for each, own in zip(group.learners, inputs, strict=True)]


def test_seeds_together_give_the_numbers_of_single_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(StackedLearners, "updates", one_after_another)
    summaries = run_interleaved([work(tmp_path / f"{seed}", seed) for seed in (0, 1)])
    for seed, summary in enumerate(summaries):
        assert summary["seed"] == seed and summary["learn"]["frames_charged"] >= 416
        run_alone(work(tmp_path / f"alone{seed}", seed))
        assert numbers(tmp_path / f"{seed}") == numbers(tmp_path / f"alone{seed}")


def test_vmapped_updates_give_nearly_the_losses_of_a_single_run(tmp_path):
    ends = run_interleaved([work(tmp_path / f"{seed}", seed, "method=sac") for seed in (0, 1)])
    assert ends[0]["learn"]["return"] != ends[1]["learn"]["return"]
    for run in (tmp_path / "0", tmp_path / "1"):
        stage = Experiment(resumed_config(run), resume=run).learned()
        assert all(value.isfinite().all() for value in stage.learner.policy.parameters())
    run_alone(work(tmp_path / "alone", 0, "method=sac"))
    folders = (RunFolder(tmp_path / name, OmegaConf.create()) for name in ("0", "alone"))
    (frames, losses), (same, expected) = (each.series("learn/loss_qvalue") for each in folders)
    assert frames == same and losses == pytest.approx(expected, rel=1e-3)


def test_all_seeds_request_a_batch_before_any_waits():
    told = []

    def waits(name, batches):
        for _ in range(batches):
            told.append(f"{name} asks")
            yield
            told.append(f"{name} has")
        return name

    assert run_interleaved([waits("a", 2), waits("b", 1)]) == ["a", "b"]
    assert told == ["a asks", "b asks", "a has", "a asks", "b has", "a has"]
    assert run_alone(waits("c", 1)) == "c" and told[-2:] == ["c asks", "c has"]


def test_workers_of_all_seeds_start_before_any_waits(tmp_path, monkeypatch):
    told = []
    for name in ("start_collection", "restart_collection"):
        method = getattr(Stage, name)
        tell = lambda stage, name=name, method=method: told.append(name) or method(stage)  # noqa: E731
        monkeypatch.setattr(Stage, name, tell)
    run_interleaved([work(tmp_path / f"{seed}", seed, "method=sac") for seed in (0, 1)])
    assert told[:3] == ["start_collection"] * 2 + ["restart_collection"]


def test_failed_seed_does_not_stop_the_others(tmp_path, monkeypatch):
    collect = Stage.collect

    def diverge(stage):
        if stage.seed == stage_seed(1, "learn") and stage.frames > 200:
            raise SimulationError("it diverged")
        return collect(stage)

    monkeypatch.setattr(Stage, "collect", diverge)
    ends = run_interleaved([work(tmp_path / f"{seed}", seed, "method=sac") for seed in (0, 1)])
    assert ends[0]["learn"]["frames"] == 416
    assert isinstance(ends[1], SimulationError)
    assert not (tmp_path / "1" / "summary.json").exists()


def test_failed_update_ends_only_the_seeds_it_updates(tmp_path, monkeypatch):
    def full(group, inputs):
        raise RuntimeError("the GPU is full")

    monkeypatch.setattr(StackedLearners, "updates", full)
    works = [work(tmp_path / f"{i}", i, "method=sac") for i in (0, 1)]
    works.append(work(tmp_path / "2", 2, "method=sac", "learn.batch_size=16"))
    ends = run_interleaved(works)
    assert [str(end) for end in ends[:2]] == ["the GPU is full"] * 2
    assert ends[2]["learn"]["frames"] == 416


def test_all_seeds_stop_at_a_signal_and_resume_together(tmp_path, monkeypatch):
    collect = Stage.collect

    def collect_and_signal(stage):
        batch = collect(stage)
        if stage.seed == stage_seed(1, "learn") and stage.frames == 96:
            os.kill(os.getpid(), signal.SIGTERM)
        return batch

    runs = [tmp_path / f"{seed}" for seed in (0, 1)]
    with monkeypatch.context() as patch, StopOnSignal() as stop:
        patch.setattr(Stage, "collect", collect_and_signal)
        works = [work(run, seed, "method=sac", stop=stop) for seed, run in enumerate(runs)]
        ends = run_interleaved(works)
    assert [type(end) for end in ends] == [Interrupted, Interrupted]
    goes_on = [Experiment(resumed_config(run), resume=run).work(StopOnSignal()) for run in runs]
    passes, updates = [], StackedLearners.updates
    count = lambda group, inputs: passes.append(len(inputs)) or updates(group, inputs)  # noqa: E731
    monkeypatch.setattr(StackedLearners, "updates", count)
    assert [end["learn"]["frames"] for end in run_interleaved(goes_on)] == [416, 416]
    assert len(passes) > 5 and {*passes} == {2}  # although they had stopped one batch apart


def test_runs_with_other_settings_are_updated_separately(tmp_path, monkeypatch):
    """Several runs that are resumed together may differ in networks and in weights of losses."""
    passes = set()

    def remember(group, inputs):
        stage = 1 if group.learners[0].decoder is None else 2
        passes.add((stage, len(group.learners)))
        return one_after_another(group, inputs)

    monkeypatch.setattr(StackedLearners, "updates", remember)
    settings = [(), (), ("learn.decoder.distillation_weight=0.5",), ("actor.hidden=[16]",)]
    works = [work(tmp_path / f"{i}", i, *each) for i, each in enumerate(settings)]
    assert [end["learn"]["frames_charged"] for end in run_interleaved(works)] == [416] * 4
    assert passes == {(1, 3), (2, 2)}
