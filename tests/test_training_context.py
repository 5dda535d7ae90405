"""Context: what it builds from the configuration, and what it refuses."""

from __future__ import annotations

import math

import pytest
from omegaconf import OmegaConf
from torchrl.envs import InitTracker

from tests.configs import tiny
from torchrl_etl.experiment import Experiment


def context_of(folder, *overrides):
    return Experiment(tiny("method=sac", f"run_dir='{folder}/run'", *overrides)).context


@pytest.mark.parametrize("ratio", [-1.0, math.nan, 1e9])
def test_invalid_replay_ratio_is_refused(ratio, tmp_path):
    context = context_of(tmp_path)
    with pytest.raises(ValueError, match=r"learn\.replay_ratio is .*; it must be a number in"):
        context.stage(context.learner(), replay_ratio=ratio)


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("learn.batchsize", "unexpected keyword argument 'batchsize'"),
        ("learn.sac.unit_rows", r"learn\.sac\.unit_rows was removed"),
        ("learn.anchor", r"learn\.anchor is called learn\.decoder\.distillation_weight now"),
    ],
)
def test_unknown_settings_of_a_file_are_refused(key, words, tmp_path):
    config = tiny("method=sac", f"run_dir='{tmp_path}/run'")
    OmegaConf.update(config, key, 8, force_add=True)
    with pytest.raises((TypeError, ValueError), match=words):
        Experiment(config).method.stage()


def test_transforms_of_one_simulator_need_no_array_form(tmp_path):
    context = context_of(tmp_path, "collector.num_envs=1")
    stage = context.stage(context.learner(), env_transforms=[InitTracker("start")])
    stage.restart_collection()
    assert "start" in stage.collect().keys()
    stage.close()


def test_options_override_the_configured_ones_but_gamma_and_bound(tmp_path):
    context = context_of(tmp_path)
    actor = context.actor(hidden=[5])
    assert 5 in {len(each) for each in actor.parameters()}
    with pytest.raises(ValueError, match=r"gamma cannot be set here.*learn\.sac\.gamma"):
        context.loss(actor, gamma=0.5)


def test_critics_must_read_what_the_actor_reads(tmp_path):
    context = context_of(tmp_path)
    actor = context.actor(inputs={"direction": 4})
    with pytest.raises(
        ValueError, match=r"reads \['direction', 'observation'\].*\['observation'\]"
    ):
        context.learner(actor)
