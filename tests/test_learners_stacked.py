"""Learners updated side by side against learners updated alone."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs.transforms import Transform

from tests.configs import RESIDUAL
from tests.stages import explorer, fill, learn_stage, method_stage, sample, snapshot
from torchrl_etl.baselines import make_dynsyn_actor
from torchrl_etl.draws import standard_normal
from torchrl_etl.learners import SACLearner, StackedLearners
from torchrl_etl.learners.adam import GradientAdam
from torchrl_etl.learners.compiled import compiled
from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.objectives import make_sac_loss

SEEDS = (0, 1)
MAKERS = {
    **{
        name: lambda *settings, name=name: method_stage(name, *settings)
        for name in ("sac", "lattice", "dynsyn", "eme")
    },
    "stage 2": lambda *settings: learn_stage(None, *settings),
    "stage 2, categorical": lambda *settings: learn_stage(
        None, *RESIDUAL, "actor.hidden=[16,16]", "critic.hidden=[16,16]", *settings
    ),
    "stage 1": lambda *settings: explorer(*settings).stage,
    "stage 1, no target encoder": lambda *settings: (
        explorer(
            "exploration.metric.delay_encoder=false",
            "exploration.metric.divergence=gaussian",
            *settings,
        ).stage
    ),
    "stage 1, RND": lambda *settings: explorer("exploration=rnd", *settings).stage,
    "stage 1, synergies alone": lambda *settings: explorer("exploration=noise", *settings).stage,
    "stage 1, METRA": lambda *settings: explorer("exploration=metra", *settings).stage,
}


def inputs(learners, batches):
    """The inputs of one update of each learner, drawn after seeding with the learner's seed."""
    drawn = []
    for seed, learner, batch in zip(SEEDS, learners, batches, strict=True):
        torch.manual_seed(seed)
        drawn.append(learner.inputs(batch.unsqueeze(0)))
    return drawn


def with_stacked_weights(learners):
    """The learners side by side, with their weights stacked."""
    group = StackedLearners(learners)
    group._load()
    return group


def assert_gradients_are_those_of_each(learners, batches):
    read = inputs(learners, batches)
    alone = [learner.gradients(own[0]) for learner, own in zip(learners, read, strict=True)]
    together, scalars, statistics = with_stacked_weights(learners).gradients(torch.cat(read))
    for seed, (expected, logged, changed) in enumerate(alone):
        log = scalars[seed]
        for one, stack in zip(expected, together, strict=True):
            other = None if stack is None else stack[seed]
            assert (one is None or not one.any()) if other is None else True
            if one is not None and other is not None:
                torch.testing.assert_close(other, one, rtol=1e-3, atol=1e-4)
        for key, value in logged.items():
            torch.testing.assert_close(log[key], value, rtol=1e-3, atol=1e-5)
        for one, stack in zip(changed, statistics, strict=True):
            torch.testing.assert_close(stack[seed], one, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_stacked_gradients_equal_those_of_each_learner(make):
    stages = [make(f"seed={seed}") for seed in SEEDS]
    for stage in stages:
        fill(stage)
        stage.close()
    batches = [sample(stage) for stage in stages]
    assert_gradients_are_those_of_each([stage.updated for stage in stages], batches)


def test_stacked_dynsyn_learners_keep_their_muscle_groups():
    spec = Bounded(torch.tensor([-1.0, 0.0, -3.0, 0.1]), torch.tensor([1.0, 1.0, 5.0, 0.7]))
    learners, batches = [], []
    for groups in ([0, 1, 0, 1], [0, 0, 1, 1]):
        actor = make_dynsyn_actor({"observation": 3}, spec, groups, hidden=(8,), slope=1.0, start=0)
        actor[0].module.advance(1)
        critic = make_critic({"observation": 3, "action": 4}, hidden=(8,))
        learners.append(SACLearner(actor, make_sac_loss(actor, critic, action_spec=spec)))
        end = torch.zeros(32, 1, dtype=torch.bool)
        following = {"reward": torch.randn(32, 1), "done": end, "terminated": end}
        following["observation"] = torch.randn(32, 3)
        entries = {"observation": torch.randn(32, 3), "action": spec.rand((32,))}
        batches.append(TensorDict({**entries, "next": following}, [32]))
    assert_gradients_are_those_of_each(learners, batches)


def test_stacked_updates_equal_updates_of_each_learner():
    ours = [learn_stage(None, f"seed={seed}") for seed in SEEDS]
    theirs = [learn_stage(None, f"seed={seed}") for seed in SEEDS]
    for one, other in zip(ours, theirs, strict=True):
        fill(one)
        other.learner.objective.load_state_dict(one.learner.objective.state_dict())
        other.learner.ema.load_state_dict(one.learner.ema.state_dict())
    for stage in (*ours, *theirs):  # with a small eps Adam's first steps would amplify rounding
        stage.learner.optimizer = GradientAdam(
            stage.learner.parameters, lr=1e-2, eps=1.0, fused=True
        )
    starts = [snapshot(stage.learner.ema) for stage in theirs]
    group = StackedLearners([stage.learner for stage in ours])
    for _ in range(2):
        read = [stage.learner.inputs(stage.samples(3)) for stage in ours]
        group.updates(read)
        for stage, own in zip(theirs, read, strict=True):
            stage.learner.updates(own)
    for one, other, start in zip(ours, theirs, starts, strict=True):
        moved = apart = 0.0
        for key, value in other.learner.ema.state_dict().items():
            moved += (value - start[key]).abs().sum().item()
            apart += (value - one.learner.ema.state_dict()[key]).abs().sum().item()
        assert moved > 0 and apart < 1e-3 * moved
        one.close(), other.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_traced_gradients_of_stacked_learners_equal_eager_ones(name, traced_only):
    normalized = ("learn.sac.normalize_observations=true", "actor.hidden=[16,16]")
    stages = [MAKERS[name](f"seed={seed}", *normalized) for seed in SEEDS]
    for stage in stages:
        fill(stage)
        stage.close()
    batches = [sample(stage) for stage in stages]
    learners = [stage.updated for stage in stages]
    read = torch.cat(inputs(learners, batches))
    with torch.no_grad():  # so that learners differ in more than networks
        if (sac := stages[1].updated.objective.sac) is not None:
            sac.log_alpha += 1
        if (normalizer := stages[1].updated.objective.normalizer) is not None:
            normalizer.mean += 1
    group = with_stacked_weights(learners)
    expected, _, changed = group.gradients(read)
    found, _, also = compiled(group.gradients)(read)
    for one, other in zip((*expected, *changed), (*found, *also), strict=True):
        torch.testing.assert_close(other, one)


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKERS)
def test_compiled_update_reads_weights_loaded_after_tracing(name, traced_only):
    stage = MAKERS[name]("actor.hidden=[16,16]")
    fill(stage)
    learner = stage.updated
    read = learner.inputs(stage.samples(1))[0]
    stage.close()
    gradients = compiled(learner.gradients)
    for factor in (1.0, 1.1):
        state = learner.objective.state_dict()
        changed = {key: factor * value for key, value in state.items() if value.is_floating_point()}
        learner.objective.load_state_dict(state | changed)
        outs = [call(read) for call in (gradients, learner.gradients)]
        for found, expected in zip(*((*out[0], *out[2]) for out in outs), strict=True):
            torch.testing.assert_close(found, expected)


def test_first_call_of_inputs_consumes_no_extra_random_numbers():
    stage = learn_stage()
    fill(stage)
    batch, learner = sample(stage), stage.learner
    torch.manual_seed(0)
    first = learner.inputs(batch.unsqueeze(0))
    torch.manual_seed(0)
    second = learner.inputs(batch.unsqueeze(0))
    assert len(first["draws"].keys()) and (first == second).all()
    stage.close()


class Pays(Transform):
    """A reward from a network plus noise; counts its calls."""

    def __init__(self, network, noise=1.0):
        super().__init__()
        self.pay, self.noise = network.forward, noise  # no submodule
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, batch):
        paid = self.pay(batch["observation"])
        self.calls.add_(1 + 0 * paid.sum())
        return batch.set(("next", "reward"), paid + self.noise * standard_normal(paid))


def paid_learners(make_transform):
    """Two learners with a transform each, and their inputs."""
    learners, spec = [], Bounded(-1, 1, shape=(2,))
    for _ in SEEDS:
        actor = make_actor({"observation": 3}, spec)
        critic = make_critic({"observation": 3, "action": 2})
        transforms = [make_transform()]
        sac = make_sac_loss(actor, critic, action_spec=spec)
        learners.append(SACLearner(actor, sac, transforms=transforms))
    end = torch.zeros(2, 32, 1, dtype=torch.bool)
    following = {"observation": torch.randn(2, 32, 3), "done": end, "terminated": end}
    entries = {"observation": torch.randn(2, 32, 3), "action": torch.zeros(2, 32, 2)}
    batches = TensorDict({**entries, "next": following}, [2, 32])
    return learners, [learner.inputs(batches) for learner in learners]


def pays_by(network, **options):
    transform = Pays(network, **options)
    transform.networks = (network,)
    return transform


def test_transforms_of_stacked_learners_share_no_state():
    learners, inputs = paid_learners(lambda: pays_by(torch.nn.Linear(3, 1)))
    alone = [
        learner.loss(own[0]["batch"], own[0]["draws"])[1]["loss_qvalue"]
        for learner, own in zip(learners, inputs, strict=True)
    ]
    together = StackedLearners(learners).updates(inputs)
    for learner, scalars, expected in zip(learners, together, alone, strict=True):
        torch.testing.assert_close(scalars["loss_qvalue"][0], expected.detach())
        (calls,) = learner.statistics.values()
        assert calls == 2 and not calls.requires_grad


def test_transform_with_an_undeclared_network_is_refused():
    learners, inputs = paid_learners(lambda: Pays(torch.nn.Linear(3, 1)))
    with pytest.raises(ValueError, match="Pays gives a different reward with several"):
        StackedLearners(learners).updates(inputs)


def test_constant_reward_is_accepted():
    def make():
        network = torch.nn.Linear(3, 1)
        torch.nn.init.zeros_(network.weight)
        return pays_by(network, noise=0.0)

    learners, inputs = paid_learners(make)
    StackedLearners(learners).updates(inputs)


def test_synergy_models_with_different_update_counts_are_refused():
    """Resumed runs may differ so: the optimizer's state has the number of updates."""
    fitters = []
    for seed, updates in zip(SEEDS, (1, 2), strict=True):
        found = explorer("exploration=noise", f"seed={seed}")
        fill(found.stage)
        found.fitter.updates(found.fitter.inputs(found.stage.samples(updates)))
        again = explorer("exploration=noise", f"seed={seed}")
        again.stage.learner.optimizer.load_state_dict(found.stage.learner.optimizer.state_dict())
        fitters.append((again.fitter, again.fitter.inputs(found.stage.samples(1))))
        found.stage.close(), again.stage.close()
    learners, inputs = zip(*fitters, strict=True)
    assert [learner.num_updates for learner in learners] == [1, 2]
    with pytest.raises(ValueError, match="updates and rates differ"):
        StackedLearners(learners).updates(inputs)


def different(*settings):
    """The learner of stage 2 with these settings."""
    stage = learn_stage(None, *settings)
    stage.close()
    return stage.learner


@pytest.mark.parametrize(
    "settings",
    [
        ("actor.hidden=[16]",),
        ("critic.hidden=[16]",),
        ("learn.decoder.distillation_weight=0.5",),
        ("learn.decoder.fine_tuning=frozen",),
        ("learn.sac.normalize_observations=true",),
    ],
    ids=str,
)
def test_learners_of_other_settings_are_refused(settings):
    with pytest.raises(ValueError, match="differ in more than parameters and buffers"):
        StackedLearners([different(), different(*settings)])


def test_learners_with_other_bounds_are_refused():
    # The bounds of an actor's distribution are constants, not buffers.
    def learner(high):
        spec = Bounded(-1, high, shape=(2,))
        actor = make_actor({"observation": 3}, spec)
        critic = make_critic({"observation": 3, "action": 2})
        return SACLearner(actor, make_sac_loss(actor, critic, action_spec=spec))

    with pytest.raises(ValueError, match="differ in more than parameters and buffers"):
        StackedLearners([learner(1.0), learner(2.0)])


def test_no_learners_are_refused():
    with pytest.raises(ValueError, match="learners is empty"):
        StackedLearners([])


@pytest.mark.parametrize("setting", ["learn.sac.lr=1e-2", "learn.sac.tau=0.5"])
def test_learners_with_different_rates_are_refused(setting):
    stages = [learn_stage(), learn_stage(None, setting)]
    for stage in stages:
        fill(stage)
        stage.close()
    inputs = [stage.learner.inputs(stage.samples(1)) for stage in stages]
    with pytest.raises(ValueError, match="updates and rates differ"):
        StackedLearners([stage.updated for stage in stages]).updates(inputs)
