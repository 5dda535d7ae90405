"""Stage 1 with RND: which loss trains which network, the fading bonus, and resume."""

from __future__ import annotations

import pytest
import torch

from tests.stages import (
    changed,
    explorer,
    fill,
    goes_on_after_a_load,
    prepared,
    sample,
    snapshot,
    update,
)
from torchrl_etl.envs import EnvironmentSpec, make_env
from torchrl_etl.exploration import RNDExploration
from torchrl_etl.learners import StackedLearners

SMALL = ("exploration=rnd", "exploration.hidden=[16]", "exploration.features=8")


@pytest.fixture(scope="module")
def found():
    found = explorer(*SMALL)
    fill(found.stage)
    yield found
    found.stage.close()


def test_policy_is_rewarded_by_the_bonus_and_has_no_direction(found):
    assert found.exploration.reward == "intrinsic_reward"
    assert found.stage.learner.objective.sac.tensor_keys.reward == "intrinsic_reward"
    batch = prepared(found.stage)
    assert "direction" not in batch.keys() and batch["next", "intrinsic_reward"].shape == (32, 1)
    assert found.exploration.embed(batch) is None


def test_one_update_moves_policy_predictor_and_gmvae_but_not_the_random_network(found):
    loss, stage = found.exploration.loss, found.stage
    moving = (stage.learner.behavior, loss.predictor_network, found.model.model)
    before = [snapshot(part) for part in moving]
    fixed = snapshot(loss.target_network)
    update(stage)
    assert all(changed(part, was) for part, was in zip(moving, before, strict=True))
    assert not changed(loss.target_network, fixed)


def test_predictor_gets_gradients_from_its_loss_and_not_from_sac(found):
    loss, objective = found.exploration.loss, found.stage.learner.objective
    batch = prepared(found.stage)
    parameters = list(loss.predictor_network.parameters())
    own = torch.autograd.grad(loss(batch)["loss_predictor"], parameters)
    assert all(gradient.abs().sum() > 0 for gradient in own)
    sac = objective.sac(batch)
    total = sac["loss_actor"] + sac["loss_qvalue"]
    assert torch.autograd.grad(total, parameters, allow_unused=True) == (None,) * len(parameters)


def test_bonus_fades_as_the_predictor_learns():
    spec = EnvironmentSpec.of(make_env("overactuated"))
    scale = {"normalize": False}
    rnd = RNDExploration(spec, features=8, hidden=[16], lr=1e-2, bonus=scale)
    (bonus,), (term,) = rnd.batch_transforms(), rnd.terms()
    rows = make_env("overactuated").rollout(50, break_when_any_done=False)
    first = bonus(rows)["next", "intrinsic_reward"].mean()
    optimizer = torch.optim.Adam(rnd.loss.predictor_network.parameters(), lr=term.lr)
    for _ in range(100):
        optimizer.zero_grad()
        term(rows)[0].backward()
        optimizer.step()
    assert bonus(rows)["next", "intrinsic_reward"].mean() < 0.2 * first


def test_seeds_side_by_side_learn_what_each_learns_alone():
    twins = [[explorer(*SMALL, f"seed={seed}") for seed in (0, 1)] for _ in range(2)]
    for found in (found for pair in twins for found in pair):
        found.stage.restart_collection()
        found.stage.collect()
        found.stage.close()
    batches = []
    for found in twins[0]:
        torch.manual_seed(0)
        batches.append(sample(found.stage))
    group = StackedLearners([found.stage.learner for found in twins[0]])
    inputs = []
    for learner, batch in zip(group.learners, batches, strict=True):
        torch.manual_seed(1)
        inputs.append(learner.inputs(batch.unsqueeze(0)))
    together = [scalars[0] for scalars in group.updates(inputs)]
    for found, batch, scalars in zip(twins[1], batches, together, strict=True):
        torch.manual_seed(0)
        assert (sample(found.stage) == batch).all()
        torch.manual_seed(1)
        alone = found.stage.learner.update(batch)
        for key in ("loss_predictor", "loss_actor", "loss_qvalue"):
            torch.testing.assert_close(scalars[key], alone[key])
    for one, other in zip(*twins, strict=True):
        ours, theirs = (found.stage.learner.statistics for found in (one, other))
        assert ours["transforms.0.deviation.weight"] > 0 and ours["terms.0.loss.obs_rms.count"] > 1
        for name, value in theirs.items():
            torch.testing.assert_close(ours[name], value)


def test_resumed_stage_equals_an_uninterrupted_one(tmp_path):
    assert goes_on_after_a_load(lambda: explorer(*SMALL).stage, tmp_path)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("features=0", "exploration.features is 0"),
        ("hidden=[]", "exploration.hidden is"),
        ("lr=0", "exploration.lr is 0"),
        ("bonus.decay=1", "exploration.bonus.decay is 1"),
    ],
)
def test_settings_that_cannot_be_used_are_refused_by_name(setting, words):
    with pytest.raises(ValueError, match=words):
        explorer("exploration=rnd", f"exploration.{setting}")
