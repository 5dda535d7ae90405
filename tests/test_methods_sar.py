"""SAR: the play stage, its best episodes, and the bundle made of them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.configs import rival
from torchrl_etl.analysis import synergy_effects
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.sar import SAR, episode_returns, rollouts
from torchrl_etl.synergies import load_bundle
from torchrl_etl.training import run_alone
from torchrl_etl.training.loop import StopOnSignal


def rollout_batch(episodes: list[int], so_far: list[float], done: list[bool]) -> TensorDict:
    following = {
        "done": torch.tensor(done),
        "episode_reward": torch.tensor(so_far),
        "activation": torch.eye(len(done)),
    }
    return TensorDict({"episode": torch.tensor(episodes), "next": following}, [len(done)])


def test_returns_of_finished_episodes_are_found():
    far = 5 + (2 << 32)  # an episode number of another machine
    rows = rollout_batch(
        [3, 3, far, 7, 7], [1.0, 4.0, 9.0, 2.0, 6.0], [False, True, False, False, True]
    )
    episode, returns = episode_returns(rows)
    assert episode.tolist() == [0, 0, 2, 1, 1]
    assert torch.equal(returns.nan_to_num(-1), torch.tensor([4.0, 6.0, -1.0]))


def test_sar_keeps_later_episodes_above_the_percentile_of_the_preview(tmp_path):
    sar = Experiment(rival("sar", tmp_path / "run", "method.options.preview_episodes=2")).method
    # Every episode has one step. 10 and 0 are the preview, whose 80th percentile is 8: of the
    # later returns 9, 7 and 11, those of 9 and 11 are kept; the last episode has no end.
    rows = rollout_batch(
        [0, 1, 2, 3, 4, 5], [10.0, 0.0, 9.0, 7.0, 11.0, 12.0], [True] * 5 + [False]
    )
    assert torch.equal(sar.best(rows), torch.eye(6)[[2, 4]])
    # The preview is half of the episodes at most: one of two, none of one.
    assert torch.equal(sar.best(rows[:2]), torch.eye(6)[[1]])
    assert torch.equal(sar.best(rows[:1]), torch.eye(6)[[0]])


def test_play_rollouts_are_new_whole_episodes_without_updates(tmp_path):
    sar = Experiment(rival("sar", tmp_path / "run", "learn.sac.normalize_observations=true")).method
    play = sar.play_stage()
    play.restart_collection()
    seen = play.collect()["next", "episode_reward"].clone()
    before = {key: value.clone() for key, value in play.learner.actor.state_dict().items()}
    norm, frames, kept = (
        play.learner.objective.normalizer.count.clone(),
        play.frames,
        len(play.buffer),
    )
    checks = []
    rows = run_alone(rollouts(play, 400, lambda: checks.append(None)))
    assert 400 <= len(rows) < 400 + 32 and len(checks) == 13
    assert rows["next", "done"].sum() == 4  # an episode of 100 steps from each simulator
    assert not torch.equal(rows["next", "episode_reward"][: len(seen)], seen)
    assert (play.frames, len(play.buffer), play.learner.objective.normalizer.count) == (
        frames,
        kept,
        norm,
    )
    assert all(
        torch.equal(value, before[key]) for key, value in play.learner.actor.state_dict().items()
    )


def test_sar_saves_a_bundle_that_its_run_does_not_read(tmp_path, monkeypatch):
    def prepared(run):
        sar = Experiment(rival("sar", run)).method
        run_alone(sar.prepare(StopOnSignal()))
        return sar, sar.stage()

    sar, stage = prepared(tmp_path / "a")
    bundle, info = load_bundle(tmp_path / "a")
    assert (info.kind, info.task, info.num_synergies) == ("sar", sar.played, 3)
    assert info.facts["frames"] == 448 and info.facts["vaf"] > 0.5
    ours, published = synergy_effects(bundle), synergy_effects(sar.decoder())
    cosine = torch.nn.functional.cosine_similarity(ours, published, dim=-1)
    assert (cosine.abs() > 0.9).all()

    monkeypatch.setattr(SAR, "_save_bundle", lambda self, model, actions: None)
    _, without = prepared(tmp_path / "b")
    for name, value in without.learner.objective.state_dict().items():
        assert torch.equal(value, stage.learner.objective.state_dict()[name])


@pytest.mark.slow
def test_sar_plays_on_another_task_of_the_same_body(tmp_path):
    run = tmp_path / "run"
    other_task = "method.options.play_task=myoElbowPose1D6MRandom-v0"
    experiment = Experiment(rival("sar", run, other_task))
    play = experiment.method.play_stage()
    play.restart_collection()
    goals = play.collect()["observation"]
    play.close()
    other = Experiment(rival("sar", run)).method.play_stage()
    other.restart_collection()
    assert not torch.equal(other.collect()["observation"], goals)
    other.close()
    assert experiment.run()["learn"]["frames_charged"] >= 608


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("rollout_frames=300", r"need 400 for two whole episodes of 100 steps"),
        ("play_task=myoFingerPoseFixed-v0", r"but its actuators are not those of myoElbow"),
    ],
)
def test_sar_refuses_invalid_play_options(option, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Experiment(rival("sar", tmp_path / "run", f"method.options.{option}"))


def test_sar_plans_with_the_simulators_of_all_workers(tmp_path):
    workers = "collector.num_workers=2", "collector.num_envs=4", "collector.kind=process"
    with pytest.raises(ValueError, match="8 simulators need 800 for two whole episodes"):
        Experiment(rival("sar", tmp_path / "run", *workers, "frames=2000"))
    frames = "frames=2000", "method.options.rollout_frames=800"
    assert Experiment(rival("sar", tmp_path / "run", *workers, *frames)).method.rollout_frames


@pytest.mark.parametrize(("steps", "needed"), [(50, 200), (200, 800)])
def test_sar_plans_with_the_configured_length_of_an_episode(steps, needed, tmp_path):
    def sar(rollout_frames):
        length = f"+env_kwargs.max_episode_steps={steps}"
        frames = f"method.options.rollout_frames={rollout_frames}"
        return Experiment(rival("sar", tmp_path / "run", "frames=2000", length, frames)).method

    assert sar(needed).rollout_frames == needed
    with pytest.raises(ValueError, match=f"need {needed} for two whole episodes of {steps} steps"):
        sar(needed - 1)


def test_sar_plays_with_the_configured_arguments_of_the_environment(tmp_path):
    other_task = "method.options.play_task=myoElbowPose1D6MRandom-v0"
    few = rival("sar", tmp_path / "run", other_task, "+env_kwargs.obs_keys=[qpos]")
    play = Experiment(few).method.play_stage()
    play.restart_collection()
    play.collect()  # with networks of the size of these observations
    play.close()
