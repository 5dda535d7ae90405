"""Options of the SAC learner, in stage 2 of ETL and in the baselines."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.data.postprocs import MultiStep
from torchrl.envs import ExplorationType, set_exploration_type

from tests.stages import (
    changed,
    explorer,
    fill,
    learn_stage,
    method_stage,
    sample,
    snapshot,
    update,
)
from torchrl_etl.training import run_alone


def test_sac_scales_rewards_by_running_returns():
    stage = method_stage("sac", "learn.sac.return_bound=2", "learn.reward_scale=1")
    fill(stage)
    seen = {}
    stage.learner.objective.sac.register_forward_pre_hook(
        lambda _, args: seen.update(reward=args[0]["next", "reward"])
    )
    torch.manual_seed(0)
    kept = sample(stage)["next", "reward"]
    torch.manual_seed(0)
    before = snapshot(stage.learner.behavior)
    update(stage)
    scale = stage.learner.objective.return_scale.scale.float()
    assert scale != 1 and torch.allclose(seen["reward"], kept / scale)
    assert changed(stage.learner.behavior, before)
    assert stage.learner.behavior.out_keys[-1] == "action"
    stage.close()


@pytest.mark.parametrize(
    "make",
    [
        lambda: method_stage("sac", "learn.sac.tau=0.3"),
        lambda: explorer("explore.sac.tau=0.3", "exploration.tau=0.3").stage,
    ],
)
def test_update_moves_the_temperature_and_every_target_network(make):
    stage = make()
    fill(stage)
    stage.close()
    learner, batch = stage.learner, sample(stage)
    log_alpha = learner.objective.sac.log_alpha
    at = next(i for i, each in enumerate(learner.parameters) if each is log_alpha)
    inputs = learner.inputs(batch.unsqueeze(0))
    slope, temperature = learner.gradients(inputs[0])[0][at], log_alpha.item()
    updaters = [target for target in learner.targets if target.target_tensors]
    assert len(updaters) == 1 + len([t for t in learner.objective.terms if t.target is not None])
    before = [[each.clone() for each in target.target_tensors] for target in updaters]
    learner.updates(inputs)
    assert (log_alpha - temperature).sign() == -slope.sign() != 0
    for target, starts in zip(updaters, before, strict=True):
        targets, sources = target.target_tensors, target.source_tensors
        pairs = list(zip(starts, sources, strict=True))
        torch.testing.assert_close(targets, [start.lerp(source, 0.3) for start, source in pairs])
        assert any(not torch.equal(now, start) for now, start in zip(targets, starts, strict=True))


@pytest.mark.parametrize("layout", [(16,), (2, 8), (2, 2, 4)])
def test_running_returns_are_summed_along_time_in_any_batch_layout(layout):
    """[time] of one simulator, [simulators, time], [workers, simulators, time]."""
    stage = method_stage("sac", "learn.sac.return_bound=2", "learn.reward_scale=1")
    batch = stage.batches.next().reshape(-1)[:16].reshape(layout)
    batch["next", "reward"] = torch.arange(16.0).reshape(*layout, 1)
    batch["next", "done"] = torch.zeros(*layout, 1, dtype=torch.bool)
    stage.batches.next = lambda: batch
    stage.collect()
    returns = []
    for rewards in torch.arange(16.0).reshape(-1, layout[-1]).tolist():
        earned = 0.0
        for reward in rewards:
            returns.append(earned := reward + stage.learner.objective.return_scale.gamma * earned)
    assert stage.learner.objective.return_scale.largest.item() == pytest.approx(max(returns))
    assert stage.learner.objective.return_scale.mean.item() == pytest.approx(sum(returns) / 16)
    stage.close()


@pytest.mark.parametrize(
    "method", ["sac", "etl", "lattice", "lattice_plain", "dynsyn", "eme", "sar"]
)
def test_actor_and_critics_read_normalized_observations(method, tmp_path):
    settings = ("learn.sac.normalize_observations=true", f"run_dir={tmp_path}")
    stage = method_stage(method, *settings)
    fill(stage)
    seen = {}
    stage.learner.objective.sac.register_forward_pre_hook(
        lambda _, args: seen.update(args[0].flatten_keys("."))
    )
    statistics = snapshot(stage.learner.objective.normalizer)
    update(stage)
    assert not changed(stage.learner.objective.normalizer, statistics), (
        "sampling a batch is not seeing new observations"
    )
    raw = stage.buffer.storage[:]["observation"].double()
    mean, std = raw.mean(0), raw.std(0, correction=0)
    for prefix in ("", "next."):
        expected = ((seen[f"{prefix}observation"] - mean) / std).clamp(-10, 10).float()
        torch.testing.assert_close(seen[f"{prefix}normalized_observation"], expected)
    # Policies of training and evaluation read raw observations and normalize them alike.
    observation = {"observation": raw[:5].float()}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = stage.learner.policy(TensorDict(observation, [5]))
    torch.testing.assert_close(
        acted["normalized_observation"], stage.learner.objective.normalizer(raw[:5].float())
    )
    assert "observation" not in stage.learner.actor.in_keys
    stage.close()


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "oldest"), [("single", 1), ("process", 1), ("distributed", 2)])
def test_observation_statistics_reach_the_workers_with_the_weights(engine, oldest, tmp_path):
    # A worker on another machine collects its next batch before the last one is learned from.
    settings = (f"collector={engine}", "collector.ahead=false")
    settings += () if engine == "single" else ("collector.num_workers=1",)
    settings += ("learn.sac.normalize_observations=true", f"run_dir={tmp_path}")
    stage = method_stage("sac", *settings)
    try:
        known = []
        for _ in range(6):
            stage.collect()
            known.append(copy.deepcopy(stage.learner.objective.normalizer))
        batch = stage.batches.next()
        acted = batch["normalized_observation"]
        assert any(torch.allclose(acted, norm(batch["observation"])) for norm in known[-oldest:])
    finally:
        stage.close()


@pytest.mark.parametrize("number", [1, 3])
def test_num_critics_sets_the_number_of_critics(number):
    stage = learn_stage(None, f"learn.sac.num_critics={number}")
    fill(stage)
    weights = stage.learner.objective.sac.qvalue_network_params.flatten_keys().values()
    assert {len(weight) for weight in weights} == {number}
    assert update(stage)["loss_qvalue"].isfinite()
    stage.close()


def test_ema_of_the_actor_is_evaluated_and_the_actor_collects():
    stage = learn_stage(None, "learn.sac.ema_decay=0.25")
    fill(stage)
    averaged = list(stage.learner.ema.module.parameters())
    expected = None
    for kept in (0, 2 / 11, 3 / 12, 0.25, 0.25):  # (1 + n) / (10 + n), then ema_decay
        update(stage)
        actor = [weight.detach().clone() for weight in stage.learner.actor.parameters()]
        expected = expected or actor
        expected = [torch.lerp(new, old, kept) for old, new in zip(expected, actor, strict=True)]
        torch.testing.assert_close(averaged, expected)
    evaluated, collecting = (
        set(map(id, policy.parameters()))
        for policy in (stage.learner.policy, stage.learner.behavior)
    )
    ema, followed = set(map(id, averaged)), set(map(id, stage.learner.actor.parameters()))
    assert evaluated >= ema and evaluated.isdisjoint(followed)
    assert collecting >= followed and collecting.isdisjoint(ema)
    stage.close()


def test_ema_with_decay_zero_equals_the_actor():
    stage = learn_stage(None, "learn.sac.ema_decay=0")
    fill(stage)
    update(stage)
    update(stage)
    for averaged, weight in zip(
        stage.learner.ema.module.parameters(), stage.learner.actor.parameters(), strict=True
    ):
        assert torch.equal(averaged, weight)
    stage.close()


def six_steps(ends_after, begins=0):
    """Observations 0 to 5 (from ``begins``) with rewards 1 to 6; an episode ends after one step."""
    end = (torch.arange(1, 7) == ends_after).view(1, 6, 1)
    observation = begins + torch.arange(7.0).view(1, 7, 1)
    following = {"reward": observation[:, 1:], "observation": observation[:, 1:]}
    following |= {"done": end, "terminated": end, "truncated": torch.zeros_like(end)}
    return TensorDict({"observation": observation[:, :-1], "next": following}, [1, 6])


def spans(rows):
    """(observation, reward, next observation, number of steps) of each transition."""
    parts = (rows["observation"], rows["next", "reward"], rows["next", "observation"])
    return list(
        zip(*(part.flatten().tolist() for part in (*parts, rows["steps_to_next_obs"])), strict=True)
    )


def test_n_step_transition_stops_at_the_end_of_an_episode():
    stage = learn_stage(None, "learn.n_steps=3", "learn.sac.gamma=0.5")
    batch = six_steps(ends_after=3)
    spanned = stage.multi_step(batch)
    # By hand: 1 + 2/2 + 3/4, 2 + 3/2, 3 | 4 + 5/2 + 6/4; the last two steps are held back.
    assert spans(spanned) == [(0, 2.75, 3, 3), (1, 3.5, 3, 2), (2, 3.0, 3, 1), (3, 8.0, 6, 3)]
    for end in ("terminated", "done"):
        assert spanned["next", end].flatten().tolist() == [True, True, True, False]
    assert batch["next", "reward"].flatten().tolist() == [1, 2, 3, 4, 5, 6], "logs read the batch"
    # The target: rewards and, unless the episode ended, γ^k times the next value, here 8.
    target = stage.learner.objective.sac._bootstrap(spanned, torch.full((4,), 8.0))
    assert target.tolist() == [2.75, 3.5, 3.0, 9.0]
    stage.close()


def test_n_step_transition_spans_consecutive_batches():
    for size in (1, 2, 6):  # of batches of the same 18 steps
        stage = learn_stage(None, "learn.n_steps=3", "learn.sac.gamma=0.5")
        steps = torch.cat([six_steps(ends_after=3, begins=k) for k in (0, 6, 12)], 1)
        rows = torch.cat([stage.multi_step(part) for part in steps.split(size, 1)])
        whole = MultiStep.forward(stage.multi_step, steps)
        assert spans(rows) == spans(whole)[:16]
        # Episodes begin anew, as after a checkpoint: steps held back are dropped.
        stage.restart_collection()
        assert spans(stage.multi_step(six_steps(ends_after=3)))[0] == (0, 2.75, 3, 3)
        # Another worker's batch: steps held back become shorter transitions.
        other = spans(stage.multi_step(six_steps(ends_after=0, begins=50)))
        assert other[:3] == [(4, 8.0, 6, 2), (5, 6.0, 6, 1), (50, 51 + 52 / 2 + 53 / 4, 53, 3)]
        stage.close()


def test_buffer_stores_step_counts_only_for_n_step_returns():
    stage = learn_stage(None)
    fill(stage)
    assert "steps_to_next_obs" not in stage.buffer.storage[:].keys()
    stage.close()
    stage = learn_stage(None, "learn.n_steps=3")
    fill(stage)
    rows = stage.buffer.storage[:].clone()
    assert set(rows["steps_to_next_obs"].flatten().tolist()) == {1, 2, 3}
    assert update(stage)["loss_qvalue"].isfinite()
    # Transitions of stage 1 span single steps.
    stage.prefill(rows.select("observation", "synergy", "action", "next"))
    assert set(stage.newest(len(rows))["steps_to_next_obs"].flatten().tolist()) == {1}
    assert update(stage)["loss_qvalue"].isfinite()
    stage.close()


def test_learning_rates_decay_linearly_with_frames():
    stage = learn_stage(None, "learn.sac.lr_end=0.5", "learn.frames=640")
    initial = [group["lr"] for group in stage.learner.optimizer.param_groups]
    while not stage.finished:
        stage.collect()
        run_alone(stage.learn())
        share = 1 - 0.5 * stage.frames / 640
        rates = [group["lr"] for group in stage.learner.optimizer.param_groups]
        assert rates == pytest.approx([share * lr for lr in initial])
    assert share == pytest.approx(0.5)
    stage.close()
