"""Collector workers on a local Ray cluster of two nodes: newest weights, faults, seeds."""

from __future__ import annotations

import os
import signal
import sys
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
from torchrl_etl.collectors.ray import RayWorkers

ray = pytest.importorskip("ray")
pytestmark = [pytest.mark.ray, pytest.mark.slow]


@pytest.fixture(scope="module")
def address() -> str:
    """A cluster of two nodes with one CPU each."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    yield cluster.address
    cluster.shutdown()


@pytest.fixture
def start(address):
    """A function that starts workers on the cluster, which end with the test."""
    started = []

    def build(**kwargs) -> tuple[RayWorkers, torch.nn.Module]:
        policy = synergy_policy()
        kwargs = {"num_workers": 2, "frames_per_batch": 16, "address": address, **kwargs}
        started.append(RayWorkers(kwargs.pop("env", make_batched_env), policy, **kwargs))
        return started[-1], policy

    yield build
    for collector in started:
        collector.shutdown()


def call_in_worker(collector: RayWorkers, worker: int, what) -> object:
    """The result of a function of the worker's collector, called in the worker."""
    return ray.get(collector.remote_collectors[worker].__ray_call__.remote(what), timeout=30)


def pid(collector: RayWorkers, worker: int) -> int:
    return call_in_worker(collector, worker, lambda _: os.getpid())


def test_next_synchronous_batch_uses_the_pushed_weights(start):
    collector, policy = start(sync=True, collector_class=VectorCollector)
    nodes = [
        call_in_worker(collector, i, lambda _: ray.get_runtime_context().node_id) for i in range(2)
    ]
    assert len(set(nodes)) == 2

    batches = iter(collector)
    batch = next(batches)
    assert batch.shape == (2, 2, 4)  # workers, environments, time
    assert was_decoded_by(batch, policy)
    assert batch["collector", "worker"][:, 0, 0].tolist() == [0, 1]
    assert_workers_differ(batch)
    observation = batch["observation"]
    assert_each_push_is_in_the_next_batch(collector, policy, batches)

    collector.shutdown()
    again, _ = start(sync=True, collector_class=VectorCollector, num_workers=1, frames_per_batch=8)
    assert (next(iter(again))["observation"][0] == observation[0]).all()


def test_only_asynchronous_batches_under_way_have_older_weights(start):
    collector, policy = start(sync=False)
    batches = iter(collector)
    next(batches)
    action = decode_to(policy, 0.5)
    collector.update_policy_weights_()
    versions = {0: [], 1: []}
    while min(map(len, versions.values())) < 3:
        batch = next(batches)
        version = origin(batch, "policy_version")
        versions[origin(batch, "worker")].append(version)
        assert (version == 1) == torch.allclose(batch["action"], action.expand_as(batch["action"]))
    for of_worker in versions.values():
        assert of_worker[0] in (0, 1)
        assert set(of_worker[1:]) == {1}


def test_another_iteration_goes_on_with_pending_requests(start):
    collector, _ = start(sync=False)
    versions = []
    for _ in range(3):
        batch = next(iter(collector))
        versions.append(origin(batch, "policy_version"))
        collector.update_policy_weights_()
    assert len(collector._pending) == 2  # one for each worker
    assert versions[:1] == [0]


@pytest.mark.parametrize("sync", [True, False])
def test_replacement_of_a_killed_worker_has_the_newest_weights(start, sync):
    collector, policy = start(sync=sync, replacements=1)
    batches = iter(collector)
    seen = [next(batches)]
    decode_to(policy, 0.5)
    collector.update_policy_weights_()
    killed = pid(collector, 0)
    os.kill(killed, signal.SIGKILL)
    while collector.started == 2:  # until the loss is noticed
        seen.append(next(batches))
    while not sync and origin(seen[-1], "worker") != 0:  # the other worker goes on in the meantime
        seen.append(next(batches))
        time.sleep(0.1)
    assert was_decoded_by(seen[-1], policy)
    assert pid(collector, 0) != killed
    frames = sum(batch.numel() for batch in seen)
    assert collector.collected_frames == frames == distinct_frames(seen)

    os.kill(pid(collector, 1), signal.SIGKILL)
    with pytest.raises(
        RuntimeError, match=r"worker 1 was lost.*1 were already replaced.*your last checkpoint"
    ):
        for _ in range(1000):
            next(batches)
    assert not collector.remote_collectors


def test_unresponsive_worker_counts_as_lost(start):
    collector, _ = start(sync=True, replacements=0)
    batches = iter(collector)
    next(batches)
    collector.timeout = 3.0
    os.kill(pid(collector, 1), signal.SIGSTOP)
    began = time.monotonic()
    with pytest.raises(RuntimeError, match="worker 1 sent no batch within 3 s"):
        next(batches)
    assert time.monotonic() - began < 15


def test_an_exception_in_a_worker_is_raised_and_names_it(start):
    collector, _ = start()
    call_in_worker(collector, 1, lambda worker: setattr(worker.env, "step_and_maybe_reset", None))
    with pytest.raises(RuntimeError, match="worker 1 failed"):
        for _ in range(10):
            next(iter(collector))


def test_workers_that_cannot_start_are_reported_in_time(start):
    def broken():
        raise OSError("no such model")

    with pytest.raises(RuntimeError, match=r"could not be started(.|\n)*no such model"):
        start(env=broken)
    with pytest.raises(RuntimeError, match=r"of 3 workers did not start in 8 s.*num_cpus"):
        start(num_workers=3, timeout=8.0)


def test_without_an_address_a_local_ray_is_started_and_shut_down():
    collector = RayWorkers(make_batched_env, synergy_policy(), num_workers=1, frames_per_batch=8)
    worker = pid(collector, 0)
    assert next(iter(collector)).shape == (2, 4)
    began = time.monotonic()
    collector.shutdown()
    collector.shutdown()
    assert time.monotonic() - began < 20
    assert not ray.is_initialized()
    deadline = time.monotonic() + 10
    while os.path.exists(f"/proc/{worker}") and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not os.path.exists(f"/proc/{worker}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_workers": 0}, "num_workers is 0; it must be a whole number, 1"),
        ({"frames_per_batch": -8}, "frames_per_batch is -8; it must be a whole number, 1"),
        ({"frames_per_batch": 15, "sync": True}, "a multiple of num_workers=2, such as 16"),
        ({"timeout": 0}, "timeout is 0; it must be a number above 0"),
        ({"replacements": -1}, "replacements is -1; it must be a whole number, 0"),
        ({"collector_class": "async"}, "must be torchrl.collectors.Collector or a subclass"),
        ({"collector_kwargs": {"policy": None}}, "collector_kwargs has policy"),
        ({"policy": torch.nn.Linear(6, 16)}, "policy is a Linear"),
        ({"create_env_fn": make_batched_env()}, "pass a function"),
    ],
)
def test_bad_arguments_are_named_before_anything_is_started(change, message):
    arguments = {"create_env_fn": make_batched_env, "policy": synergy_policy(), "num_workers": 2}
    with pytest.raises((TypeError, ValueError), match=message):
        RayWorkers(**{**arguments, "frames_per_batch": 16, **change})
    assert not ray.is_initialized()


def test_without_ray_the_message_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl_etl\[ray"):
        RayWorkers(make_batched_env, synergy_policy(), num_workers=1, frames_per_batch=8)
