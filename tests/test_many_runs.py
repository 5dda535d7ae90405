"""Many runs in one update: each is updated as it would be by itself."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from studies.many_runs.group import EXPLORED, Group
from studies.many_runs.learner import Learner
from studies.many_runs.returns import ReturnScales
from studies.many_runs.settings import Settings, Shape
from tests.configs import RESIDUAL, ROOT, tiny
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners import entropy_target
from torchrl_etl.modules import ReturnScale, RunningNorm, SynergyDecoder, make_actor, make_critic
from torchrl_etl.objectives import DecoderLoss, LeanSACLoss, SynergySACLoss
from torchrl_etl.training.evaluation import evaluate

CPU = torch.device("cpu")
SHAPE = Shape(actor=8, critic=16, batch_size=5, bins=11, most_steps=3, normalize_observations=False)
SETTINGS = [Settings(gamma=0.9), Settings(n_steps=3, alpha_init=0.1)]


def stacked(shape=SHAPE, decoders=None):
    learner = Learner(shape, SETTINGS, [3, 4], [7, 4], 6, decoders, 40, CPU)
    torch.manual_seed(0)
    for step in range(20):
        learner.act()
        learner.told.normal_()
        learner.told[1, 8:11], learner.told[1, -3:] = 0.0, 0.0  # the second task shows less
        learner.told[:, 1], learner.told[:, 2] = step % 5 == 4, step % 5 == 4
        learner.told[:, 3] = 2.0
        learner.store()
    return learner


@pytest.mark.parametrize("synergies", [False, True])
def test_losses_and_gradients_are_those_of_the_package(monkeypatch, synergies):
    def zeros(shape, dtype, device):
        return torch.zeros(shape, dtype=dtype, device=device)

    monkeypatch.setattr("torch.distributions.normal._standard_normal", zeros)
    decoders = None
    if synergies:
        decoders = [SynergyDecoder(2, 6, residual=0.5, hidden=(8, 8)) for _ in SETTINGS]
    learner = stacked(decoders=decoders)
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)
    batch = learner.sample()
    batch["action"] = batch["action"] / 2  # so that the decoder has something to be anchored to
    losses, _ = learner.losses(batch)
    gradients = torch.autograd.grad(losses.sum(), learner.trained)

    for i, (own, seed) in enumerate([(7, 3), (4, 4)]):
        torch.manual_seed(seed)
        spec = Bounded(-1.0, 1.0, shape=(learner.emitted,))
        sizes = {"body": "residual", "layer_norm": True}
        out_key = "synergy" if synergies else "action"
        actor = make_actor({"observation": own}, spec, hidden=[8, 8], out_key=out_key, **sizes)
        value = make_critic({"observation": own, "action": 6}, hidden=[16, 16], bins=11, **sizes)
        kwargs = {
            "action_spec": spec,
            "num_qvalue_nets": 2,
            "support": torch.linspace(-5, 5, 11),
            "alpha_init": SETTINGS[i].alpha_init,
            "target_entropy": entropy_target(spec, 0.15),
        }
        if synergies:
            loss = SynergySACLoss(actor, value, decoders[i], **kwargs)
        else:
            loss = LeanSACLoss(actor, value, **kwargs)
        loss.make_value_estimator(gamma=SETTINGS[i].gamma)
        cut = {name: batch[name][i] for name in ("observation", "following")}
        flat = TensorDict(
            {
                "observation": cut["observation"][:, :own],
                "action": batch["action"][i],
                "synergy": batch["emitted"][i],
                "next": {
                    "observation": cut["following"][:, :own],
                    "reward": batch["reward"][i, :, None],
                    "terminated": batch["discount"][i, :, None] == 0,
                    "done": batch["discount"][i, :, None] == 0,
                },
            },
            [5],
        )
        # Over several steps the discount is of that many.
        steps = (batch["discount"][i].log() / torch.tensor(SETTINGS[i].gamma).log()).round()
        flat["steps_to_next_obs"] = steps.clamp(max=9).long().unsqueeze(-1)
        out = loss(flat)
        expected = out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]
        if synergies:
            expected = expected + 0.1 * DecoderLoss(decoders[i])(flat)["loss_decoder"]
        torch.testing.assert_close(losses[i], expected, rtol=1e-5, atol=1e-5)
        weights = loss._weights("actor_network")
        found = learner.actor.split(gradients[0])
        names = [name for name, _ in actor.named_parameters()]
        wanted = torch.autograd.grad(expected, [weights[name] for name in names], retain_graph=True)
        for mine, theirs in zip(found, wanted, strict=True):
            mine = mine[i][..., :own] if mine.ndim == 3 and mine.shape[-1] == 7 else mine[i]
            torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


def test_rewards_are_scaled_as_in_the_package():
    reward, done = torch.randn(2, 30, dtype=torch.float64), torch.rand(2, 30) < 0.2
    many = ReturnScales(np.array([0.5, 0.9]), bound=1.0)
    for t in range(30):
        many.step(reward[:, t].numpy(), done[:, t].numpy())
    for i, gamma in enumerate([0.5, 0.9]):
        one = ReturnScale(gamma, bound=1.0)
        one.update(reward[i : i + 1], done[i : i + 1])
        assert many.scale[i] == pytest.approx(one.scale.item())


def test_observations_are_normalized_as_in_the_package():
    learner = stacked(Shape(**{**vars(SHAPE), "normalize_observations": True}))
    for i, own in enumerate((7, 4)):
        norm = RunningNorm(own)
        norm.see(learner.buffer["observation"][i, :20, :own])
        seen = learner.told[i : i + 1, None, -7:]
        torch.testing.assert_close(
            learner._normal(seen.expand(2, 1, 7))[i, 0, :own], norm(seen[0, 0, :own])
        )
    assert (learner.sample()["observation"][1, :, 4:] == 0).all()


def test_targets_of_three_steps_by_hand():
    learner = stacked()
    # Rewards 0, 1, 2, ...; an episode ends with every fifth step.
    learner.buffer["reward"][:, :20, 0] = torch.arange(20.0)
    learner.buffer["following"][:, :20, 0] = torch.arange(20.0)
    learner.buffer["observation"][:, :20, 0] = torch.arange(20.0)
    learner.told[:, 3] = 1.0
    batch = learner.sample()
    for i in range(5):
        first, last = int(batch["observation"][1, i, 0]), int(batch["following"][1, i, 0])
        assert last == min(first + 2, first - first % 5 + 4)
        rewards = [0.95**k * (first + k) for k in range(last - first + 1)]
        assert batch["reward"][1, i].item() == pytest.approx(sum(rewards), rel=1e-5)
        ends = last % 5 == 4
        assert batch["discount"][1, i].item() == pytest.approx(0.0 if ends else 0.95**3)
        assert batch["following"][0, i, 0] == batch["observation"][0, i, 0]


def test_what_was_explored_is_given_as_in_the_recipe(tmp_path):
    options = ("learn.prefill=true", "learn.reward_scale=1", "frames=601")
    experiment = Experiment(tiny(*options, f"run_dir='{tmp_path}/run'"))
    experiment.run()
    run = {"seed": 0, "synergies": tmp_path / "run" / "synergies"}
    shape = {"actor": 8, "critic": 8, "batch_size": 5}
    muscles = experiment.context.spec.action_dim
    sees = experiment.context.spec.observation_dim
    described = {"reuse": True, "shape": shape, "runs": [run]}
    group = Group(described, slice(0, 1), [sees], muscles, 40, CPU)
    stage = experiment.method.stage()
    stage.checkpoint().load(max((tmp_path / "run" / "checkpoints" / "learn").glob("checkpoint-*")))
    rows = stage.buffer.storage[:600].flatten_keys(".")
    for name, key in EXPLORED.items():
        torch.testing.assert_close(group.learner.buffer[name][0, :600], rows[key].float())
    assert group.owed == group.learner.size == 600
    seen = torch.rand(1, sees)
    norm = RunningNorm(sees)
    norm.see(rows["observation"])  # as Stage.prefill does with normalized observations
    torch.testing.assert_close(group.learner.norm(seen), norm(seen))
    group.update()
    assert group.owed == 0 and group.learner.updates == 601
    raw = Group(described | {"raw": True}, slice(0, 1), [sees], muscles, 40, CPU).learner
    torch.testing.assert_close(raw.buffer["emitted"], raw.buffer["action"])
    torch.testing.assert_close(raw.buffer["action"][0, :600], rows["action"])


@pytest.mark.parametrize("body", ["residual", "batch_norm"])
@pytest.mark.parametrize("unit_rows", [False, True])
def test_updates_change_every_part(body, unit_rows):
    shape = Shape(**{**vars(SHAPE), "body": body, "unit_rows": unit_rows})
    decoders = [SynergyDecoder(2, 6, residual=0.5, hidden=(8, 8)) for _ in SETTINGS]
    learner = stacked(shape, decoders)
    names = ("target", "average", "log_alpha")
    before = [getattr(learner, name).detach().clone() for name in names]
    parts = [p.detach().clone() for p in learner.trained]
    for _ in range(3):
        learner.update()
    after = [getattr(learner, name) for name in names] + learner.trained
    for old, new in zip(before + parts, after, strict=True):
        assert new.isfinite().all() and not torch.equal(old, new)


def test_a_run_begins_where_the_recipe_begins_and_ends_in_a_table(tmp_path):
    runs = [
        {"task": "overactuated", "goal": goal, "seed": 3, "method": "sac"}
        for goal in ("fixed", "random")
    ]
    shape = {"learning_starts": 4, "batch_size": 8}
    described = {"frames": 6, "groups": [{"shape": shape, "runs": [run]} for run in runs]}
    runs[1]["charged"] = 1
    (tmp_path / "runs.json").write_text(json.dumps(described))
    command = [sys.executable, "-m", "studies.many_runs", str(tmp_path / "runs.json")]
    out = tmp_path / "results.csv"
    command += ["--out", str(out), "--every", "4", "--workers", "2", "--commit", "abc"]
    subprocess.run(command, check=True, cwd=ROOT, timeout=120)
    table = pd.read_csv(out)
    assert table["frames"].tolist() == [0, 1, 4, 5, 5, 6, 6]
    assert set(table["status"]) == {"finished"} and set(table["commit"]) == {"abc"}
    assert table["return"].notna().all()
    for goal, row in zip(("fixed", "random"), table.itertuples(), strict=False):
        options = ("method=sac", "seed=3", f"goal={goal}", "run_dir=unused", *RESIDUAL)
        experiment = Experiment(tiny(*options, "actor.hidden=[64,64]", "critic.hidden=[96,96]"))
        policy = experiment.method.stage().learner.policy
        env = experiment.context.make_env()
        expected = evaluate(policy, env, episodes=row.episodes, max_steps=25)
        assert row[6] == pytest.approx(expected.mean_return.mean, rel=1e-4)
