"""Both stages learn the analytic task: stage 1 its subspace, stage 2 its goal."""

from __future__ import annotations

import pytest
import torch

from tests.configs import tiny
from torchrl_etl.envs import AnalyticOveractuated
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.synergies import fit_gmvae
from torchrl_etl.training import run_alone


@pytest.fixture
def basis() -> torch.Tensor:
    """Rows span the only subspace of actions that moves the joints [2, 16]."""
    return torch.as_tensor(AnalyticOveractuated().synergy_basis, dtype=torch.float32)


@pytest.mark.slow
def test_stage_1_finds_actions_in_the_subspace_that_moves_the_joints(basis):
    experiment = Experiment(
        tiny(
            "run_dir=unused",
            "goal=random",
            "exploration.bonus.extrinsic_weight=1",  # at 4: none (docs/results/log.md, 69)
            "explore.frames=3000",
            "explore.replay_ratio=0.5",
            "explore.batch_size=128",
        )
    )
    explorer = Explorer(experiment.context)
    stage = explorer.stage
    stage.restart_collection()
    while not stage.finished:
        stage.collect()
        run_alone(stage.learn())
    stage.close()
    actions = explorer.actions(1500)
    deviation = actions - actions.mean(0)
    share = (deviation @ basis.T).square().sum() / deviation.square().sum()
    assert share > 4 * 2 / 16  # actions without direction have 2/16 of their variance there


@pytest.mark.slow
def test_stage_2_solves_the_task_in_the_known_synergies(basis):
    coefficients = 2 * torch.rand(4096, 2) - 1
    actions = coefficients @ (basis / basis.abs().amax(1, keepdim=True))
    actions = actions.clamp(-1, 1)
    gmvae = fit_gmvae(GMVAE(16, 2, hidden=(32, 32)), actions, updates=800)
    experiment = Experiment(
        tiny(
            "run_dir=unused",
            "goal=random",
            "evaluation.episodes=10",
            "learn.frames=3500",
            "learn.batch_size=128",
            "learn.replay_ratio=0.5",
            "learn.reward_scale=1.0",
            "learn.sac.gamma=0.9",
            "learn.sac.lr=1e-3",
            "learn.sac.tau=0.01",
        )
    )
    stage = experiment.method.learn_stage(SynergyDecoder.from_gmvae(gmvae, actions))
    evaluate = experiment.evaluator(stage)
    assert evaluate().solved.mean < 0.3
    stage.restart_collection()
    while not stage.finished:
        stage.collect()
        run_alone(stage.learn())
    stage.close()
    assert evaluate().solved.mean >= 0.8
