"""The two stages: transitions kept, networks in use, and parameters that each update trains."""

from __future__ import annotations

import copy
import gc
import math

import pytest
import torch
from tensordict import TensorDict

from tests.configs import RESIDUAL, tiny
from tests.stages import changed, explorer, fill, learn_stage, prepared, sample, snapshot, update
from torchrl_etl.collectors import Batches, CollectionError
from torchrl_etl.draws import given_draws
from torchrl_etl.envs import AnalyticOveractuated
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.synergies import fit_gmvae
from torchrl_etl.training import run_alone


def test_prefill_copies_transitions_of_stage_1_and_adds_their_updates(tmp_path):
    settings = ("learn.prefill=true", "learn.decoder.residual=0.5", "learn.reward_scale=3")
    experiment = Experiment(tiny(f"run_dir='{tmp_path}/run'", *settings))
    experiment.run()
    stage, decoder = experiment.method.stage(), experiment.method.decoder()
    stage.checkpoint().load(max((tmp_path / "run" / "checkpoints" / "learn").glob("checkpoint-*")))
    rows = stage.buffer.storage[:]
    assert len(rows) == 600 + 608
    own = 608 - 96  # no updates for the batches up to 100 frames
    assert stage.progress.updates == (own + 600) // 16
    first = rows[:600]
    explored = Explorer(experiment.context).stage
    explored.checkpoint().load(
        max((tmp_path / "run" / "checkpoints" / "explore").glob("checkpoint-*"))
    )
    kept = explored.newest(600)
    torch.testing.assert_close(first["action"], kept["action"])
    # explore.reward_scale is 0.1
    torch.testing.assert_close(first["next", "reward"], 30 * kept["next", "reward"])
    assert (first["synergy"][:, decoder.num_synergies :] == 0).all()
    assert first["synergy"][:, : decoder.num_synergies].abs().max() <= 1


def test_collection_restarts_after_a_failed_start(monkeypatch):
    stage = learn_stage()
    stage.close()

    def never_there(**_):
        def fail():
            raise RuntimeError("no simulator")

        return Batches(fail)

    with monkeypatch.context() as patch:
        patch.setattr(stage, "_make_batches", never_there)
        with pytest.raises(CollectionError, match="did not start: no simulator"):
            stage.restart_collection()
    stage.restart_collection()
    assert len(stage.collect()) > 0
    stage.close()


def test_learning_rate_of_null_is_that_of_the_learner():
    for stage in (
        explorer("exploration.lr=null", "synergies.lr=0.25", "explore.sac.lr=0.5").stage,
        learn_stage(None, "learn.decoder.lr=null", "learn.sac.lr=0.5"),
    ):
        rates = {group["lr"] for group in stage.learner.optimizer.param_groups}
        assert rates - {0.25} == {0.5}
        stage.close()


def test_prefill_owes_updates_for_every_frame_of_stage_1():
    found = explorer("action_repeat=2")
    found.stage.collect()
    second = learn_stage(SynergyDecoder.from_gmvae(found.model.model), "action_repeat=2")
    second.prefill(found.transitions(second.learner.decoder))
    assert second.progress.owed == 2 * 32 * second.replay_ratio
    found.stage.close(), second.close()


def test_encoded_actions_decode_to_nearly_the_same_actions():
    coefficients = 2 * torch.rand(512, 2) - 1
    actions = torch.tanh(coefficients @ torch.randn(2, 16))
    gmvae = fit_gmvae(GMVAE(16, 2, num_components=1), actions, updates=1500)
    decoder = SynergyDecoder.from_gmvae(gmvae, actions)
    found = decoder.encode(actions)
    again = decoder(TensorDict({"synergy": found}, [512]))["action"]
    assert found.abs().max() <= 1
    assert (again - actions).square().mean() < 0.1 * actions.var(0).mean()


def test_one_update_of_stage_1_moves_policy_encoder_and_gmvae():
    found = explorer()
    stage = found.stage
    fill(stage)
    before = [
        snapshot(part)
        for part in (stage.learner.behavior, found.exploration.encoder, found.model.model)
    ]
    update(stage)
    assert changed(stage.learner.behavior, before[0])
    assert changed(found.exploration.encoder, before[1])
    assert changed(found.model.model, before[2])
    stage.close()


def test_sampled_bonus_uses_the_current_encoder():
    found = explorer("exploration.bonus.normalize=false", "exploration.bonus.extrinsic_weight=0")
    stage = found.stage
    fill(stage)

    def bonus_and_expected():
        torch.manual_seed(0)
        batch = prepared(stage)
        with torch.no_grad():
            phi, phi_next = (
                found.exploration.encoder.module(batch.get(key))
                for key in ("observation", ("next", "observation"))
            )
        expected = ((phi_next - phi) * batch["direction"]).sum(-1, keepdim=True)
        return batch["next", "intrinsic_reward"], expected

    first, expected = bonus_and_expected()
    torch.testing.assert_close(first, expected)
    with torch.no_grad():
        for parameter in found.exploration.encoder.parameters():
            parameter.mul_(1.5)
    second, expected = bonus_and_expected()
    torch.testing.assert_close(second, expected)
    assert not torch.allclose(first, second)
    stage.close()


def test_directions_are_unit_vectors_kept_through_the_episode():
    found = explorer()
    stage = found.stage
    batch = stage.collect()
    torch.testing.assert_close(batch["direction"].norm(dim=-1), torch.ones(len(batch)))
    inside = ~batch["next", "done"].squeeze(-1)
    assert torch.equal(batch["direction"][inside], batch["next", "direction"][inside])
    stage.close()


@pytest.mark.parametrize("actions", ["policy", "mean", "sampled"])
def test_gmvae_is_fitted_to_the_configured_actions(actions):
    found = explorer(f"explore.fit.actions={actions}", "exploration.relabel=0")
    stage = found.stage
    batch = stage.collect()
    with torch.no_grad():  # in place of learning
        for parameter in stage.learner.behavior.parameters():
            parameter.mul_(1.5)
        now = stage.learner.behavior(batch.select("observation", "direction"))["loc"]
    expected = {"policy": now.tanh(), "mean": batch["loc"].tanh(), "sampled": batch["action"]}
    torch.testing.assert_close(found.actions(), expected[actions], atol=1e-5, rtol=1e-5)
    stage.close()


def test_synergies_are_fitted_to_actions_on_normalized_observations():
    found = explorer("explore.sac.normalize_observations=true", "exploration.relabel=0")
    fill(found.stage)
    rows = found.stage.buffer.storage[:]
    with torch.no_grad():
        expected = found.stage.learner.behavior(rows)["loc"].tanh()
    torch.testing.assert_close(found.actions(), expected, atol=1e-5, rtol=1e-5)
    assert run_alone(found.condense()).num_synergies == 2
    found.stage.close()


def test_final_updates_are_adam_steps_of_the_synergy_model_alone():
    found, twin = explorer(), explorer()  # with the same seed
    fill(found.stage)
    learner = found.stage.learner
    others = learner.objective.sac, learner.ema, found.exploration.encoder
    before = [snapshot(part) for part in others]
    inputs = found.fitter.inputs(found.stage.samples(3))
    found.fitter.updates(inputs)
    adam = torch.optim.Adam(twin.model.model.parameters(), lr=found.model.lr)
    for each in inputs.unbind(0):
        adam.zero_grad()
        with given_draws(each["draws"][name] for name in sorted(each["draws"].keys())):
            twin.fitter.objective.terms[0](each["batch"])[0].backward()
        adam.step()
    for name, weight in twin.model.model.state_dict().items():
        torch.testing.assert_close(found.model.model.state_dict()[name], weight)
    assert not any(changed(part, was) for part, was in zip(others, before, strict=True))
    assert {int(step) for step in learner.optimizer.steps} == {0, 3} and learner.num_updates == 0
    found.stage.close(), twin.stage.close()


def test_relabel_draws_directions_that_were_not_followed():
    found = explorer()
    stage = found.stage
    fill(stage)
    followed = {tuple(row) for row in stage.buffer.storage[:]["direction"].tolist()}
    drawn = {tuple(row) for row in sample(stage)["direction"].tolist()}
    assert not followed & drawn
    stage.close()
    found = explorer("exploration.relabel=0")
    stage = found.stage
    fill(stage)
    followed = {tuple(row) for row in stage.buffer.storage[:]["direction"].tolist()}
    assert {tuple(row) for row in sample(stage)["direction"].tolist()} <= followed
    stage.close()


def test_buffer_keeps_executed_pairs_while_the_decoder_changes():
    stage = learn_stage()
    expected = []
    for _ in range(3):
        batch = stage.collect()
        with torch.no_grad():
            expected.append(stage.learner.decoder.module(batch["synergy"]))
            for parameter in stage.learner.decoder.parameters():
                parameter.add_(0.05)  # the next batch must be decoded with these
    kept = stage.buffer.storage[:]
    torch.testing.assert_close(kept["action"], torch.cat(expected))
    assert not torch.allclose(
        kept["action"], stage.learner.decoder.module(kept["synergy"]), atol=1e-3
    )
    stage.close()


@pytest.mark.parametrize(
    ("fine_tuning", "learns"), [("critic", True), ("reconstruction", True), ("frozen", False)]
)
def test_decoder_is_trained_unless_frozen(fine_tuning, learns):
    stage = learn_stage(None, f"learn.decoder.fine_tuning={fine_tuning}", "learn.decoder.lr=1e-2")
    fill(stage)
    if fine_tuning == "reconstruction":  # on fresh pairs Eq. 10 has no gradient at all
        with torch.no_grad():
            stage.learner.decoder.module.decoder.mlp[-1].bias.add_(0.1)
    before, policy = snapshot(stage.learner.decoder), snapshot(stage.learner.behavior)
    update(stage)
    assert changed(stage.learner.decoder, before) is learns
    assert changed(stage.learner.behavior, policy)
    stage.close()


def test_entropy_excludes_a_residual_with_fixed_noise():
    log = math.log(2 * math.pi * math.e) / 2  # of a standard Gaussian
    fixed = "learn.decoder.residual_std=0.05"
    for std, wanted in (("0.4", 2 * (log + math.log(0.4))), ("null", -2.0)):
        decoder = SynergyDecoder(2, 16, hidden=(32, 32), residual=1.0)
        stage = learn_stage(decoder, fixed, f"learn.sac.action_std={std}")
        sac = stage.learner.objective.sac
        assert sac.target_entropy.item() == pytest.approx(wanted, rel=1e-5)
    assert sac.entropy_dims == 2
    batch = stage.collect()
    assert (batch["scale"][:, 2:] == 0.05).all() and (batch["scale"][:, :2] != 0.05).all()


def test_eq_10_is_self_distillation_on_fresh_pairs():
    stage = learn_stage(None, "learn.decoder.fine_tuning=reconstruction", "learn.decoder.lr=1e-2")
    fill(stage)
    before = snapshot(stage.learner.decoder)
    assert update(stage)["loss_decoder"] < 1e-10
    after = stage.learner.decoder.state_dict()
    assert all(torch.allclose(after[key], before[key], atol=1e-4) for key in before)
    stage.close()


def test_gmvae_and_state_encoder_are_bit_identical_through_stage_2():
    found = explorer()
    first = found.stage
    fill(first)
    for _ in range(3):
        update(first)
    decoder = run_alone(found.condense())
    before = copy.deepcopy([snapshot(found.exploration.encoder), snapshot(found.model.model)])
    second = learn_stage(decoder, "learn.decoder.lr=1e-2")
    fill(second)
    tuned = snapshot(second.learner.decoder)
    for _ in range(5):
        update(second)
    assert not changed(found.exploration.encoder, before[0])
    assert not changed(found.model.model, before[1])
    assert changed(second.learner.decoder, tuned)
    first.close(), second.close()


def test_updates_follow_the_replay_ratio():
    found = explorer("explore.replay_ratio=0.1", "explore.learning_starts=0")
    stage = found.stage
    for _ in range(5):
        stage.collect()
        run_alone(stage.learn())
    assert stage.progress.frames == 160
    assert stage.progress.updates == 16
    stage.close()


def test_frames_count_simulator_steps_under_action_repeat(tmp_path):
    run = Experiment(
        tiny(
            f"run_dir={tmp_path}/run",
            "action_repeat=2",
            "explore.frames=256",
            "explore.replay_ratio=0.25",
            "explore.learning_starts=0",
            "learn.frames=128",
        )
    )
    stage = Explorer(run.context).stage
    stage.restart_collection()
    stage.collect(), run_alone(stage.learn())  # 32 actions
    assert stage.frames == 64 and len(stage.buffer) == 32 and stage.progress.updates == 16
    stage.close()
    summary = run.run()
    assert summary["synergies"]["frames"] == 256 and summary["learn"]["frames_charged"] == 384
    # Episodes of 25 steps: 12 actions twice, and one once.
    evaluation = run.evaluator(run.learned())()
    assert set(evaluation.lengths) == {25}


def test_gaussian_divergence_trains_its_latent_dynamics():
    found = explorer("exploration.metric.divergence=gaussian")
    stage = found.stage
    fill(stage)
    assert "loss_dynamics" in update(stage).keys()
    stage.close()


def test_restarting_collection_frees_the_old_simulators():
    found = explorer()
    stage = found.stage

    def simulators():
        return sum(type(thing) is AnalyticOveractuated for thing in gc.get_objects())

    gc.collect()
    before = simulators()
    for _ in range(3):
        stage.restart_collection()
        stage.collect()
    assert simulators() == before
    stage.close()
    assert simulators() == before - 4


def test_newest_rows_are_returned_after_the_buffer_wraps():
    found = explorer("explore.buffer_size=100")
    stage = found.stage
    for _ in range(5):
        batch = stage.collect()
    assert torch.equal(stage.newest(32)["action"], batch["action"])
    stage.close()


@pytest.mark.slow
def test_compiled_update_equals_the_eager_update():
    settings = (*RESIDUAL, "actor.hidden=[16,16]", "critic.hidden=[16,16]")
    stages = [learn_stage(None, f"compile={compile}", *settings) for compile in ("false", "true")]
    fill(stages[0])
    batch = sample(stages[0])
    stages[1].learner.objective.load_state_dict(stages[0].learner.objective.state_dict())
    outs = []
    for stage in stages:
        torch.manual_seed(0)
        outs.append(stage.learner._gradients(stage.learner.inputs(batch.unsqueeze(0))[0]))
        stage.close()
    (eager, logged, _), (compiled, logged_too, _) = outs
    for one, two in zip(eager, compiled, strict=True):
        torch.testing.assert_close(two, one, rtol=1e-3, atol=1e-5)
    for key, value in logged.items():
        torch.testing.assert_close(logged_too[key], value, rtol=1e-3, atol=1e-5)


@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize(
    "make", [lambda *args: explorer(*args).stage, lambda *args: learn_stage(None, *args)]
)
def test_updates_learn_from_a_cuda_graph(make):
    stage = make("compile=true", "device=cuda")
    fill(stage)
    before = snapshot(stage.learner.behavior)
    for _ in range(20):  # warm-up, capture, replay
        assert all(value.isfinite() for value in update(stage).values())
    assert changed(stage.learner.behavior, before)
    stage.close()
