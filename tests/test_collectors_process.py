"""Workers in processes: newest weights, the same frames, faults that end in a message."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import gymnasium
import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.envs import RewardSum, TransformedEnv

from tests.point_env import PointTask
from tests.synergy_policy import decode_to, synergy_policy
from torchrl_etl.collectors import Batches, CollectionError, VectorCollector, make_batches
from torchrl_etl.envs import make_env
from torchrl_etl.modules import make_actor
from torchrl_etl.modules.return_scale import episode_numbers

FRAMES = 48


def make_overactuated() -> TransformedEnv:
    return TransformedEnv(make_env("overactuated", num_envs=4), RewardSum())


@pytest.fixture
def policy() -> TensorDictSequential:
    return synergy_policy()


def decodes_to(policy: TensorDictSequential, value: float) -> None:
    """Makes the decoder return this action for any synergy."""
    decode_to(policy, math.atanh(value))


@pytest.fixture
def start(policy):
    """A function that starts batches of a kind, which are closed with the test."""
    started = []

    def start(kind: str, make=make_overactuated, **kwargs):
        kwargs = {"frames_per_batch": FRAMES, "timeout": 60.0, **kwargs}
        batches = make_batches(kind, make, policy, **kwargs)
        started.append(batches)
        return batches

    yield start
    for batches in started:
        batches.close()
        batches.close()  # a second close does nothing


def observations(batches, count: int = 3) -> torch.Tensor:
    return torch.stack([batches.next().reshape(-1)["next", "observation"] for _ in range(count)])


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [False, True])
def test_worker_process_collects_the_same_frames_as_this_process(start, ahead):
    here, there = start("single"), start("process", ahead=ahead)
    for batches in (here, there):
        batches.restart(seed=5)
    first = observations(here)
    assert torch.equal(first, observations(there))
    for batches in (here, there):  # a batch under way is dropped
        batches.restart(seed=5)
    assert torch.equal(first, observations(here))
    assert torch.equal(first, observations(there))


@pytest.mark.slow
def test_next_requested_batch_uses_the_newest_decoder(start, policy):
    in_turns, ahead = start("process"), start("process", ahead=True)
    for batches in (in_turns, ahead):
        batches.restart(seed=0)
        batches.next()
    decodes_to(policy, 0.5)
    assert in_turns.next()["action"].allclose(torch.tensor(0.5))
    under_way, next_one = ahead.next(), ahead.next()
    assert under_way["action"].std() > 0  # requested before the change
    assert next_one["action"].allclose(torch.tensor(0.5))


@pytest.mark.slow
def test_batch_uses_the_weights_of_its_request(start, policy):
    batches = start("process")
    batches.restart(seed=0)
    batches.request()
    decodes_to(policy, 0.5)
    batches.request()  # a second request does nothing
    assert batches.next()["action"].std() > 0
    assert batches.next()["action"].allclose(torch.tensor(0.5))


@pytest.mark.slow
def test_weight_changes_do_not_reach_a_batch_under_way(start, policy):
    batches = start("process", ahead=True)
    batches.restart(seed=1)
    observations(batches, 1)
    decodes_to(policy, -0.5)  # while a batch is under way
    changed = batches.next()["action"].eq(-0.5)
    assert not changed.any()


@pytest.mark.slow
def test_async_workers_take_new_weights(start, policy):
    batches = start("async", num_workers=2)
    batches.next()
    decodes_to(policy, 0.25)
    for _ in range(
        6
    ):  # each worker has at most one finished and one begun batch with older weights
        batch = batches.next()
    assert batch["action"].allclose(torch.tensor(0.25))
    assert batch.shape == (4, FRAMES // 4)


@pytest.mark.slow
def test_episode_numbers_identify_returns_across_workers(start):
    batches = start(
        "async", num_workers=2, frames_per_batch=4 * 7
    )  # so that episodes end within batches
    returns: dict[int, float] = {}
    for _ in range(12):
        batch = batches.next()
        rewards, sums = batch["next", "reward"], batch["next", "episode_reward"]
        rows = zip(episode_numbers(batch), rewards, sums, strict=True)
        for simulator in rows:
            for number, reward, so_far in zip(*simulator, strict=True):
                before = returns.get(int(number), 0.0)
                returns[int(number)] = before + float(reward)
                assert returns[int(number)] == pytest.approx(float(so_far), abs=1e-4)
    assert len(returns) > 8  # simulators


@pytest.mark.slow
def test_workers_collect_different_data(start):
    batches = start("process", num_workers=2, frames_per_batch=2 * FRAMES)
    batches.restart(seed=2)
    first, second = batches.next()
    assert not torch.equal(first["synergy"], second["synergy"])
    assert not torch.equal(first["observation"], second["observation"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["process", "async"])
def test_killed_worker_ends_collection_with_a_message(start, kind):
    batches = start(kind, num_workers=2, frames_per_batch=2 * FRAMES)
    batches.next()
    os.kill(batches._collector.procs[1].pid, signal.SIGKILL)
    begun = time.monotonic()
    with pytest.raises(CollectionError, match=r"worker 1 .*\(?exit code -9\).*resume=FOLDER"):
        for _ in range(4):
            batches.next()
    batches.close()
    assert time.monotonic() - begun < 30


class Stuck(PointTask):
    def step(self, action):
        if self.episode > 1 and self.age == 2:  # not while the environment is built
            time.sleep(3600)
        return super().step(action)


def make_stuck() -> TransformedEnv:
    gymnasium.register("torchrl_etl_tests/Stuck-v0", entry_point=Stuck)
    return TransformedEnv(make_env("torchrl_etl_tests/Stuck-v0", num_envs=4), RewardSum())


@pytest.mark.slow
def test_hanging_worker_times_out():
    actor = make_actor({"observation": 3}, PointTaskSpec, hidden=(8,))
    batches = make_batches("process", make_stuck, actor, frames_per_batch=8)
    batches.await_start()
    batches._timeout = 3.0
    with pytest.raises(CollectionError, match=r"did not return a batch within 3 s.*timeout"):
        for _ in range(4):
            batches.next()
    processes = batches._collector.procs
    batches.close()
    for process in processes:
        process.join(10)
        assert not process.is_alive()


PointTaskSpec = make_env("overactuated").full_action_spec_unbatched["action"][..., :5]

LEARNER = """
import threading
import time
from tests.test_collectors_process import *
if __name__ == "__main__":
    policy = synergy_policy()
    batches = make_batches("process", make_overactuated, policy, frames_per_batch=48, ahead=True)
    batches.next()
    print(batches._collector.procs[0].pid, flush=True)
    time.sleep(3600)
"""


@pytest.mark.slow
def test_workers_of_a_killed_learner_end_too(tmp_path):
    script = tmp_path / "learner.py"
    script.write_text(LEARNER)
    learner = subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.getcwd()},
    )
    worker = int(learner.stdout.readline())
    learner.kill()
    learner.wait()
    for _ in range(200):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        with open(f"/proc/{worker}/stat") as stat:
            if stat.read().rsplit(")", 1)[1].split()[0] == "Z":
                return
        time.sleep(0.1)
    pytest.fail("the worker lives on")


class StartTogether:
    """Workers whose start waits until all of them start."""

    def __init__(self, there: threading.Barrier) -> None:
        there.wait(20)

    def __iter__(self):
        return iter(())

    def shutdown(self) -> None:
        pass


def test_collectors_start_their_workers_in_parallel():
    there = threading.Barrier(2)
    several = [Batches(partial(StartTogether, there)) for _ in range(2)]
    for batches in several:
        batches.await_start()
    for batches in several:
        batches.close()


def fails_to_start():
    raise RuntimeError("no simulator")


def test_failed_start_raises_in_await_start_and_can_be_closed():
    batches = Batches(fails_to_start)
    with pytest.raises(CollectionError, match="did not start: no simulator"):
        batches.await_start()
    batches.close()
    Batches(fails_to_start).close()


def test_a_timeout_within_the_collector_is_reported_at_once():
    def waits():
        raise TimeoutError("no licence server")

    batches = Batches(waits, timeout=120.0)
    with pytest.raises(CollectionError, match=r"did not start: no licence server Continue from"):
        batches.await_start()
    batches.close()


def test_single_cannot_run_ahead():
    with pytest.raises(ValueError, match="needs another process"):
        Batches(partial(VectorCollector, make_overactuated), in_process=True, ahead=True)


def test_learner_keeps_its_thread_count_and_workers_start_with_one(monkeypatch):
    calls, set_num_threads = [], torch.set_num_threads
    monkeypatch.setattr(
        torch, "set_num_threads", lambda count: calls.append(count) or set_num_threads(count)
    )

    class Workers(list):
        def __init__(self):
            self.threads = torch.get_num_threads()
            torch.set_num_threads(5)  # as TorchRL's collectors do

        shutdown = __init__

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        batches = Batches(Workers)
        batches.await_start()
        assert batches._collector.threads == 1 and calls[-1] == 3
        batches.close()
        assert torch.get_num_threads() == 3 and calls[-1] == 3
    finally:
        torch.set_num_threads(before)


def test_an_unknown_kind_is_named(policy):
    with pytest.raises(ValueError, match="kind is 'proces'; choose one of single, process"):
        make_batches("proces", make_overactuated, policy, frames_per_batch=FRAMES)
