"""collector=auto: the layouts that it tries, and the settings that it chooses."""

from __future__ import annotations

from collections import defaultdict
from unittest.mock import Mock

import pytest
import torch

import torchrl_etl.layout as layout
from tests.configs import tiny
from torchrl_etl.experiment import Experiment
from torchrl_etl.layout import Layout, choose_layout, layouts


def auto(*overrides):
    return tiny("method=sac", "collector=auto", "threads=null", "run_dir=unused", *overrides)


@pytest.fixture
def speeds(monkeypatch):
    """Frames per second by layout on two cores; the test fills the table in."""
    table = defaultdict(float)
    monkeypatch.setattr(layout, "available_cores", lambda: 2)
    monkeypatch.setattr(layout, "frames_per_second", lambda stage, each, seconds: table[each])
    return table


def test_layouts_of_many_cores_share_a_batch_evenly():
    found = layouts(6, most_workers=12)
    assert [each.num_workers for each in found] == [0, 1, 1, 2, 2, 4, 4, 4]
    assert [each.threads for each in found] == [6, 5, 6, 4, 6, 2, 6, 6]
    assert [each.ahead for each in found] == 7 * [True] + [False]
    assert max(each.num_workers for each in layouts(6, most_workers=6)) == 2


def test_last_layout_has_at_most_one_worker_per_core():
    assert [layouts(cores, most_workers=8)[-1].num_workers for cores in (2, 4, 6, 32)] == [
        2,
        4,
        4,
        8,
    ]


def test_layouts_of_one_core_have_no_worker():
    assert layouts(1, most_workers=8) == [Layout(0, 1)]


@pytest.mark.parametrize(
    "fastest, kind, ahead",
    [
        (Layout(1, 2), "process", True),
        (Layout(0, 2), "single", False),
        (Layout(2, 2, ahead=False), "process", False),
    ],
)
def test_choose_layout_takes_and_names_the_fastest(speeds, fastest, kind, ahead):
    speeds |= {Layout(0, 2): 70.0, Layout(1, 1): 60.0, Layout(1, 2): 65.0, fastest: 90.0}
    said = []
    chosen = choose_layout(auto(), say=said.append)
    assert chosen.collector.kind == kind
    assert chosen.collector.num_workers == max(1, fastest.num_workers)
    assert (chosen.collector.ahead, chosen.threads) == (ahead, fastest.threads)
    before, line = said
    assert before.startswith("collector=auto tries 4 ways to share the cores")
    assert line.startswith(f"collector=auto chose {kind}, ") and "90" in line


def test_choose_layout_stays_in_one_process_if_the_gain_is_small(speeds):
    speeds |= {Layout(0, 2): 70.0, Layout(1, 1): 71.0, Layout(1, 2): 72.0}
    assert choose_layout(auto()).collector.kind == "single"


def test_layout_is_ranked_by_the_speed_that_it_sustains(monkeypatch):
    periods = iter([700.0, 400.0, 700.0, 400.0, 700.0])
    monkeypatch.setattr(layout, "train_on", lambda stage: None)
    monkeypatch.setattr(layout, "training_speed", lambda stage, seconds: next(periods))
    clock = iter(range(10))
    monkeypatch.setattr(layout.time, "perf_counter", lambda: next(clock))
    single = Layout(0, torch.get_num_threads())
    assert layout.frames_per_second(Mock(), single, seconds=5.0) == 400


def test_choose_layout_keeps_threads_that_are_given(speeds):
    speeds |= {Layout(0, 1): 70.0, Layout(1, 1): 90.0}
    assert choose_layout(auto("threads=1")).threads == 1


def test_choose_layout_refuses_several_seeds():
    with pytest.raises(ValueError, match="collector=process"):
        choose_layout(auto("seeds=[0,1]"))


def test_run_after_choose_layout_equals_the_run_with_those_settings(monkeypatch, tmp_path):
    monkeypatch.setattr(layout, "available_cores", lambda: 2)
    monkeypatch.setattr(
        layout, "CLEARLY_FASTER", 1e9
    )  # all layouts are tried and the first is taken
    chosen = choose_layout(auto("threads=1", f"run_dir={tmp_path}/auto"), seconds=0.01)
    single = tiny("method=sac", f"run_dir={tmp_path}/single")
    tried, asked = (Experiment(config).run()["learn"] for config in (chosen, single))
    assert tried == asked
