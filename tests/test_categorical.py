"""Categorical critics: the projection by hand, the target against a loop over rows and atoms."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import softmax
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate

from tests import test_objectives_sac as plain
from tests.loss_checks import SEED
from torchrl_etl.functional import categorical_mean, project_categorical
from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.objectives import make_sac_loss

SUPPORT = torch.linspace(-2.0, 2.0, 5)


def test_projection_splits_atoms_between_neighbors_and_clamps_at_the_ends():
    probabilities = torch.tensor([0.4, 0.3, 0.2, 0.1])
    atoms = torch.tensor([0.25, -7.0, 2.0, 1.0])
    by_hand = torch.tensor([0.3, 0.0, 0.4 * 0.75, 0.4 * 0.25 + 0.1, 0.2])
    torch.testing.assert_close(project_categorical(probabilities, atoms, SUPPORT), by_hand)


def test_projection_preserves_mass_and_mean_within_the_support():
    probabilities = softmax(torch.randn(3, 4, 7), -1)
    atoms = 4 * torch.rand(3, 4, 7) - 2
    projected = project_categorical(probabilities, atoms, SUPPORT)
    torch.testing.assert_close(projected.sum(-1), torch.ones(3, 4))
    torch.testing.assert_close(projected @ SUPPORT, (probabilities * atoms).sum(-1))


make_loss = partial(plain.make_loss, bins=len(SUPPORT), support=SUPPORT)


class TestCategoricalSACLoss(plain.TestLeanSACLoss):
    make_loss = staticmethod(make_loss)


def batch(size: int = 6) -> TensorDict:
    return TensorDict(
        {
            "observation": torch.randn(size, 3),
            "action": torch.rand(size, 5),
            "next": {
                "observation": torch.randn(size, 3),
                "reward": torch.randn(size, 1),
                "done": torch.arange(size)[:, None] == 1,
                "terminated": torch.arange(size)[:, None] == 1,
            },
        },
        [size],
    )


def test_target_is_the_projected_distribution_of_the_smaller_critic():
    torch.manual_seed(SEED)
    loss, data = make_loss(alpha_init=0.3), batch()
    SoftUpdate(loss, tau=0.5)
    torch.manual_seed(1)
    target = loss._compute_target_v2(data)
    torch.manual_seed(1)
    action, log_prob = loss._sample(data["next"])
    outputs = loss._outputs(loss._at(data["next"], action), loss._weights("target_qvalue_network"))
    for row in range(len(data)):
        logits = min(outputs[:, row], key=lambda one: categorical_mean(one, SUPPORT).item())
        expected = torch.zeros(len(SUPPORT))
        for atom, mass in zip(SUPPORT, softmax(logits, -1), strict=True):
            end = data["next", "terminated"][row].item()
            moved = data["next", "reward"][row, 0] + plain.GAMMA * (not end) * (
                atom - 0.3 * log_prob[row]
            )
            place = (moved.clamp(-2, 2) + 2).item()  # the support has steps of one
            low = min(math.floor(place), len(SUPPORT) - 2)
            expected[low] += mass * (1 - (place - low))
            expected[low + 1] += mass * (place - low)
        torch.testing.assert_close(target[row], expected)
    assert target.requires_grad is False


def test_critics_learn_the_target_and_the_actor_the_smaller_mean():
    torch.manual_seed(SEED)
    loss, data = make_loss(fixed_alpha=True, alpha_init=1e-6), batch(64)
    SoftUpdate(loss, tau=0.5)
    target = loss._compute_target_v2(data) @ SUPPORT
    optimizer = torch.optim.Adam(loss.qvalue_network_params.parameters(), 1e-2)
    first = loss(data)["loss_qvalue"].item()
    for _ in range(300):
        torch.manual_seed(1)
        value = loss(data)["loss_qvalue"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    assert value.item() < first
    values = loss._mean(loss._outputs(data, loss._weights("qvalue_network")))
    assert (values - target).abs().mean() < (target - target.mean()).abs().mean()
    torch.manual_seed(1)
    out = loss.actor_loss(data)[0]
    torch.manual_seed(1)
    action, _ = loss._sample(data)
    means = loss._mean(loss._outputs(loss._at(data, action), loss._weights("qvalue_network")))
    assert abs(out.item() + means.amin(0).mean().item()) < 1e-3


def test_support_of_whole_numbers_is_that_of_the_same_floats():
    whole = SUPPORT.long()
    assert (whole == SUPPORT).all()
    loss = make_loss(support=whole)
    assert torch.equal(loss.support, SUPPORT) and loss(batch())["loss_qvalue"].isfinite()


@pytest.mark.parametrize("support", [torch.zeros(3), torch.tensor([0.0, 1.0, 3.0]), torch.eye(2)])
def test_uneven_or_unordered_support_is_refused(support):
    with pytest.raises(ValueError, match="evenly spaced, ascending"):
        make_loss(support=support)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_loss_of_networks_on_cuda_has_its_support_there():
    spec = Bounded(0.0, 1.0, shape=(5,))
    actor = make_actor({"observation": 3}, spec).cuda()
    critic = make_critic({"observation": 3, "action": 5}, bins=5).cuda()
    loss = make_sac_loss(actor, critic, action_spec=spec, bins=5, return_bound=2.0)
    assert loss.support.is_cuda and loss(batch().cuda())["loss_qvalue"].isfinite()
