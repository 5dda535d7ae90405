"""Collector workers in a torch.distributed group: newest weights, faults, seeds."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest
import torch

from tests.synergy_policy import (
    assert_each_push_is_in_the_next_batch,
    assert_workers_differ,
    decode_to,
    distinct_frames,
    make_batched_env,
    origin,
    synergy_policy,
    was_decoded_by,
)
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.collectors.distributed import DistributedWorkers

pytestmark = [pytest.mark.slow]


@pytest.fixture
def start():
    """A function that starts workers, which end with the test."""
    started = []

    def build(env=make_batched_env, **kwargs) -> tuple[DistributedWorkers, torch.nn.Module]:
        policy = synergy_policy()
        kwargs = {"num_workers": 2, "frames_per_batch": 16, "timeout": 60.0, **kwargs}
        started.append(DistributedWorkers(env, policy, **kwargs))
        return started[-1], policy

    yield build
    for collector in started:
        collector.shutdown()
    assert not multiprocessing.active_children()


def test_next_synchronous_batch_uses_the_pushed_weights(start):
    collector, policy = start(sync=True, collector_class=VectorCollector)
    batches = iter(collector)
    batch = next(batches)
    assert batch.shape == (2, 2, 4)  # workers, environments, time
    assert was_decoded_by(batch, policy)
    assert_workers_differ(batch)
    assert_each_push_is_in_the_next_batch(collector, policy, batches)


def test_only_asynchronous_batches_under_way_have_older_weights(start):
    collector, policy = start(sync=False)
    batches = iter(collector)
    seen = [next(batches)]
    action = decode_to(policy, 0.5)
    collector.update_policy_weights_()
    versions = {0: [], 1: []}
    for _ in range(40):
        seen.append(batch := next(batches))
        version = origin(batch, "policy_version")
        versions[origin(batch, "worker")].append(version)
        assert (version == 1) == torch.allclose(batch["action"], action.expand_as(batch["action"]))
    for of_worker in versions.values():
        assert len(of_worker) > 10
        assert set(of_worker[1:]) == {1}
    frames = sum(batch.numel() for batch in seen)
    assert collector.collected_frames == frames == distinct_frames(seen)


@pytest.mark.parametrize("sync", [True, False])
def test_another_iteration_goes_on_with_pending_requests(start, sync):
    collector, _ = start(sync=sync, total_frames=96)
    seen = []
    for _ in range(2):
        seen.append(next(iter(collector)))
        collector.update_policy_weights_()
    assert origin(seen[0].flatten(), "policy_version") == 0
    seen += collector
    assert distinct_frames(seen) == collector.collected_frames == 96
    assert list(collector) == []


def test_weights_of_another_policy_are_refused(start):
    collector, policy = start()
    other = torch.nn.ModuleDict({"weight": torch.nn.Linear(2, 2)})
    with pytest.raises(ValueError, match=r"shape of the weights .* is .*, and .* in the policy"):
        collector.update_policy_weights_(other)
    collector.update_policy_weights_(policy)


@pytest.mark.parametrize("sync", [True, False])
def test_killed_worker_ends_the_run_and_is_named(start, sync):
    collector, _ = start(sync=sync)
    batches = iter(collector)
    next(batches)
    os.kill(collector.jobs[1].pid, signal.SIGKILL)
    began = time.monotonic()
    with pytest.raises(RuntimeError, match=r"worker 1 .*continue from your last checkpoint"):
        for _ in range(10_000):
            next(batches)
    assert time.monotonic() - began < 20
    began = time.monotonic()
    collector.shutdown()
    assert time.monotonic() - began < 1


def test_unresponsive_worker_ends_the_run(start):
    collector, _ = start(sync=False)
    batches = iter(collector)
    next(batches)
    collector.timeout = 3.0
    os.kill(collector.jobs[0].pid, signal.SIGSTOP)
    with pytest.raises(RuntimeError, match="worker 0 sent no batch within 3 s"):
        for _ in range(10_000):
            next(batches)


def test_worker_that_stops_before_taking_weights_ends_the_run(start):
    collector, _ = start(sync=True, timeout=30.0)
    batches = iter(collector)
    next(batches)
    collector.update_policy_weights_()
    os.kill(collector.jobs[0].pid, signal.SIGSTOP)
    began = time.monotonic()
    with pytest.raises(RuntimeError, match="worker 0 did not receive weights"):
        next(batches)
    assert time.monotonic() - began < 45


def test_a_worker_that_cannot_start_is_reported_in_time(start):
    learner = os.getpid()

    def broken_elsewhere():
        if os.getpid() != learner:
            os._exit(1)
        return make_batched_env()

    began = time.monotonic()
    with pytest.raises(RuntimeError, match=r"ended while it started|did not start"):
        start(broken_elsewhere, timeout=10.0)
    assert time.monotonic() - began < 40


def test_shutdown_ends_workers_and_the_process_group(start):
    collector, _ = start(total_frames=48)
    assert sum(batch.numel() for batch in collector) == collector.collected_frames == 48
    began = time.monotonic()
    collector.shutdown()
    collector.shutdown()
    assert time.monotonic() - began < 10
    assert not torch.distributed.is_initialized()
    with pytest.raises(RuntimeError, match="pass seed=3 to the constructor"):
        collector.set_seed(3)


def test_bad_arguments_are_named_before_anything_is_started():
    policy = synergy_policy()
    with pytest.raises(ValueError, match="launcher is 'slurm'; choose one of mp, submitit"):
        DistributedWorkers(
            make_batched_env, policy, num_workers=1, frames_per_batch=8, launcher="slurm"
        )
    with pytest.raises(ValueError, match="num_workers is 0; it must be a whole number, 1"):
        DistributedWorkers(make_batched_env, policy, num_workers=0, frames_per_batch=8)
    with pytest.raises(OSError, match="no such model"):  # the error itself, not a worker's timeout

        def broken():
            raise OSError("no such model")

        DistributedWorkers(broken, policy, num_workers=1, frames_per_batch=8)
    assert not multiprocessing.active_children()
