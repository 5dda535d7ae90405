"""A learner's optimizer and EMA against PyTorch's, and its updates on several batches."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch.optim import Adam
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import Bounded
from torchrl.envs.transforms import Transform

from tests.stages import fill, learn_stage, sample
from torchrl_etl.learners import SACLearner, Term, WarmedUpEMA
from torchrl_etl.learners.adam import GradientAdam
from torchrl_etl.modules import StateEncoder, SynergyDecoder, make_actor, make_critic
from torchrl_etl.objectives import BehavioralMetricLoss, LeanSACLoss, make_sac_loss

RATES = (0.1, 0.03)


def parameters():
    torch.manual_seed(0)
    return [torch.nn.Parameter(torch.randn(3)) for _ in range(3)]


def groups(weights):
    return [
        {"params": weights[:2], "lr": RATES[0], "weight_decay": 0.1},
        {"params": weights[2:], "lr": RATES[1], "betas": (0.5, 0.9)},
    ]


@pytest.mark.parametrize(
    "unused", [lambda step: None, lambda step: 1, lambda step: step % 3], ids=["none", "1", "turns"]
)
def test_step_along_equals_adam(unused):
    ours, theirs = parameters(), parameters()
    optimizer = GradientAdam(groups(ours), fused=True)
    reference = Adam(groups(theirs), fused=True)
    for step in range(6):
        gradients = [None if i == unused(step) else torch.randn(3) for i in range(3)]
        if step == 3:  # the learning rate changes and a checkpoint is loaded
            optimizer.param_groups[0]["lr"] = reference.param_groups[0]["lr"] = 0.02
            optimizer.load_state_dict(deepcopy(optimizer.state_dict()))
        optimizer.step_along(gradients)
        for parameter, gradient in zip(theirs, gradients, strict=True):
            parameter.grad = gradient
        reference.step()
        assert all((a == b).all() for a, b in zip(ours, theirs, strict=True))
    assert unused(0) != 1 or (ours[1] == parameters()[1]).all()


def test_strides_of_gradients_and_loaded_moments_do_not_matter():
    turned = torch.nn.Parameter(torch.arange(6.0).view(3, 2).t())
    plain = torch.nn.Parameter(turned.detach().contiguous())
    optimizers = [GradientAdam([weight], lr=0.1, fused=True) for weight in (turned, plain)]
    for step, gradient in enumerate(torch.randn(6, 2, 3)):
        if step == 3:  # load a checkpoint, which does not keep strides
            saved = [deepcopy(optimizer.state_dict()) for optimizer in optimizers]
            for moment in ("exp_avg", "exp_avg_sq"):
                saved[0]["state"][0][moment] = saved[0]["state"][0][moment].contiguous()
            for optimizer, state in zip(optimizers, saved, strict=True):
                optimizer.load_state_dict(state)
        for optimizer in optimizers:
            optimizer.step_along([gradient if step % 2 else gradient.t().contiguous().t()])
    torch.testing.assert_close(turned, plain)


def test_loading_keeps_the_learning_rate_tensor_of_a_cuda_graph():
    rate = torch.tensor(0.5)
    optimizer = GradientAdam([torch.nn.Parameter(torch.ones(2))], lr=rate, capturable=True)
    of_a_cpu = GradientAdam([torch.nn.Parameter(torch.ones(2))], lr=0.5, fused=True)
    of_a_cpu.scale_rates(0.5)
    optimizer.load_state_dict(of_a_cpu.state_dict())
    (group,) = optimizer.param_groups
    assert group["lr"] is rate and rate == 0.25 and group["capturable"]


def test_state_dict_round_trip_keeps_scaled_rates():
    saved, loaded = (
        GradientAdam([torch.nn.Parameter(torch.ones(2))], lr=0.2, fused=True) for _ in range(2)
    )
    saved.scale_rates(0.5)
    loaded.load_state_dict(saved.state_dict())
    assert loaded.rates == [group["lr"] for group in loaded.param_groups] == [0.1]


def test_learning_rate_changed_on_resume_is_in_effect_from_the_first_update():
    saved, loaded = (
        GradientAdam([torch.nn.Parameter(torch.ones(2))], lr=lr, fused=True) for lr in (0.2, 0.4)
    )
    saved.scale_rates(0.5)
    loaded.load_state_dict(saved.state_dict())
    assert loaded.rates == [group["lr"] for group in loaded.param_groups] == [0.2]


def test_ema_after_warm_up_equals_pytorchs_and_copies_buffers():
    model = torch.nn.BatchNorm1d(2)
    ours = WarmedUpEMA(model, decay=0.3)
    theirs = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(0.3))
    for step in range(9):
        torch.nn.init.normal_(model.weight), model.running_mean.fill_(step)
        ours.update()
        if step < 3:  # (1 + n) / (10 + n) passes 0.3 at n = 3
            theirs.load_state_dict(ours.state_dict())
        else:
            theirs.update_parameters(model)
    assert ours.n_averaged == 9 and (ours.module.weight == theirs.module.weight).all()
    assert (ours.module.weight != model.weight).all() and (ours.module.running_mean == 8).all()


def test_batches_may_have_any_size():
    stage = learn_stage()
    fill(stage)
    stage.close()
    for size in (1, 16, 8):
        draws = stage.learner.inputs(sample(stage)[:size].unsqueeze(0))["draws"]
        assert all(each.shape[:2] == (1, size) for each in draws.values())
        stage.learner.update(sample(stage)[:size])


def test_updates_on_several_batches_equal_updates_in_turn():
    at_once, in_turn = learn_stage(), learn_stage()
    fill(at_once)
    batches = at_once.samples(3)
    assert batches.shape == (3, at_once.batch_size)
    in_turn.learner.objective.load_state_dict(at_once.learner.objective.state_dict())
    inputs = at_once.learner.inputs(batches)
    together = at_once.learner.updates(inputs)
    alone = torch.cat([in_turn.learner.updates(each) for each in inputs.split(1)])
    assert (together == alone).all() and together.shape == (3,)
    ours, theirs = (stage.learner.objective.state_dict() for stage in (at_once, in_turn))
    assert all((value == theirs[key]).all() for key, value in ours.items())
    at_once.close(), in_turn.close()


def transitions():
    """A batch of transitions of three observations and two actions."""
    end = torch.zeros(32, 1, dtype=torch.bool)
    following = {"observation": torch.randn(32, 3), "reward": torch.randn(32, 1)}
    following |= {"done": end, "terminated": end}
    entries = {"observation": torch.randn(32, 3), "action": torch.zeros(32, 2)}
    return TensorDict({**entries, "next": following}, [32])


class Measures(Transform):
    """A reward computed with an encoder whose loss has a target network."""

    def __init__(self, loss):
        super().__init__()
        self.networks = (loss,)

    def forward(self, batch):
        paid = self.networks[0].encoder_params["module", "0", "weight"].sum()
        return batch.set(("next", "reward"), paid.expand(*batch.shape, 1))


def test_target_network_is_updated_when_a_transform_reads_the_loss():
    spec = Bounded(-1, 1, shape=(2,))
    loss = BehavioralMetricLoss(StateEncoder(3, 2, hidden=(8,)))
    actor = make_actor({"observation": 3}, spec)
    critic = make_critic({"observation": 3, "action": 2})
    learner = SACLearner(
        actor,
        make_sac_loss(actor, critic, action_spec=spec),
        terms=[Term(loss, tau=0.5)],
        transforms=[Measures(loss)],
    )
    assert not any("target" in name for name in learner.statistics)
    before = loss.target_encoder_params.clone()
    learner.update(transitions())
    assert (loss.target_encoder_params != before).any()


class Doubled(LeanSACLoss):
    """SAC with twice the actor loss."""

    def actor_loss(self, tensordict):
        loss, logged = super().actor_loss(tensordict)
        return 2 * loss, logged


def test_learner_minimizes_the_sac_loss_that_it_is_handed():
    spec, batch, logs = Bounded(-1, 1, shape=(2,)), transitions(), []
    for kind in (LeanSACLoss, Doubled):
        torch.manual_seed(0)
        actor = make_actor({"observation": 3}, spec)
        critic = make_critic({"observation": 3, "action": 2})
        logs.append(SACLearner(actor, kind(actor, critic, action_spec=spec)).update(batch))
    plain, doubled = logs
    assert doubled["loss_actor"] == 2 * plain["loss_actor"] != 0
    assert doubled["loss_qvalue"] == plain["loss_qvalue"]


def test_loss_of_another_actor_or_decoder_is_refused():
    decoders = [SynergyDecoder(2, 4), SynergyDecoder(2, 4)]
    spec = decoders[0].synergy_spec
    actor, other = (make_actor({"observation": 3}, spec, out_key="synergy") for _ in range(2))
    critic = make_critic({"observation": 3, "action": 4})
    sac = make_sac_loss(actor, critic, decoders[0], action_spec=spec)
    SACLearner(actor, sac, decoder=decoders[0])
    with pytest.raises(ValueError, match="loss of another actor"):
        SACLearner(other, sac, decoder=decoders[0])
    for decoder in (None, decoders[1]):
        with pytest.raises(ValueError, match="not a loss through this decoder"):
            SACLearner(actor, sac, decoder=decoder)
