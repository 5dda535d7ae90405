"""collector=auto: what it measures, reckons and leaves in the configuration."""

from __future__ import annotations

import pytest

import torchrl_etl.layout as layout
from tests.configs import tiny
from torchrl_etl.experiment import Experiment
from torchrl_etl.layout import choose_layout, layouts

UPDATE = {1: 0.012, 2: 0.008, 4: 0.005}


def fake(monkeypatch, frame, update, cores):
    monkeypatch.setattr(layout, "available_cores", lambda: cores)
    monkeypatch.setattr(layout, "seconds_a_frame", lambda *_: frame)
    monkeypatch.setattr(layout, "seconds_an_update", lambda *_: update)


def auto(*overrides):
    return tiny("method=sac", "collector=auto", "threads=null", "run_dir=unused", *overrides)


def test_layouts_take_turns_in_one_process_and_overlap_in_several():
    one, two = layouts(0.004, UPDATE, {0: 2, 1: 1}, replay_ratio=0.5)
    assert one.frames_per_second == pytest.approx(1 / (0.004 + 0.5 * 0.008))
    assert two.frames_per_second == pytest.approx(1 / (0.5 * 0.012))  # learning is the slower


def test_choose_layout_with_cheap_updates_lets_a_worker_collect(monkeypatch):
    fake(monkeypatch, 0.001, UPDATE, cores=2)
    said = []
    chosen = choose_layout(auto("learn.replay_ratio=0.0625"), say=said.append)
    assert (chosen.collector.kind, chosen.collector.num_workers) == ("process", 1)
    assert chosen.collector.ahead and chosen.threads == 1
    assert "process" in said[0] and "1000 frames/s" in said[0]


def test_choose_layout_with_dear_updates_gives_all_cores_to_the_learner(monkeypatch):
    fake(monkeypatch, 0.001, UPDATE, cores=2)
    chosen = choose_layout(auto("learn.replay_ratio=1.0"))
    assert (chosen.collector.kind, chosen.threads) == ("single", 2)
    assert not chosen.collector.ahead


def test_choose_layout_on_four_cores_gives_each_worker_whole_simulators(monkeypatch):
    fake(monkeypatch, 0.008, dict.fromkeys((2, 3, 4), 0.01), cores=4)
    chosen = choose_layout(auto("learn.replay_ratio=0.0625"))
    # Two workers with 4 simulators each share a batch of 32; one core more has none to share it.
    assert (chosen.collector.num_workers, chosen.threads) == (2, 2)


def test_choose_layout_keeps_threads_that_are_given(monkeypatch):
    fake(monkeypatch, 0.001, {1: 0.012}, cores=8)
    assert choose_layout(auto("threads=1")).threads == 1


def test_choose_layout_refuses_several_seeds():
    with pytest.raises(ValueError, match="collector=process"):
        choose_layout(auto("seeds=[0,1]"))


def test_a_run_with_a_measured_layout_is_the_run_with_that_layout(monkeypatch, tmp_path):
    monkeypatch.setattr(layout, "available_cores", lambda: 1)
    chosen = choose_layout(auto("threads=1", f"run_dir={tmp_path}/auto"), seconds=0.01)
    single = tiny("method=sac", f"run_dir={tmp_path}/single")
    measured, given = (Experiment(config).run()["learn"] for config in (chosen, single))
    assert measured == given
