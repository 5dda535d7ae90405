"""The loop that the Ray and torch.distributed collectors share, with workers in this process."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from tests.synergy_policy import make_batched_env, synergy_policy
from torchrl_etl.collectors.distributed import DistributedWorkers
from torchrl_etl.collectors.remote import RemoteWorkers


class Loopback(RemoteWorkers):
    """Two workers whose batches hold their index."""

    num_workers = 2

    def __init__(self, sync: bool, postproc=None) -> None:
        self.postproc, self.asked = postproc, []
        self._prepare(synergy_policy(), sync, 16, 1.0)

    def _request(self, worker: int) -> None:
        self._needs_weights(worker)
        self.asked.append(worker)

    def _requested(self) -> list[int]:
        return self.asked

    def _receive(self) -> tuple[int, TensorDict]:
        worker = self.asked.pop(0)
        batch = TensorDict({"reward": torch.full((4,), float(worker))}, [4])
        return worker, self._with_origin(batch, worker)


@pytest.mark.parametrize("sync", [True, False])
def test_batches_are_post_processed_after_their_frames_are_counted(sync):
    workers = Loopback(sync, postproc=lambda batch: batch[..., :1])
    sizes = [batch.numel() for batch in workers.iterator()]
    assert sizes == ([2, 2] if sync else [1, 1, 1, 1])
    assert workers.collected_frames == 16


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("split_trajs", True),
        ("replay_buffer", object()),
        ("update_after_each_batch", True),
        ("max_weight_update_interval", 2),
        ("update_interval", 1),
    ],
)
def test_arguments_that_the_loop_does_not_read_are_refused(name, value):
    with pytest.raises(ValueError, match=f"The workers take no {name}; leave it out"):
        DistributedWorkers(
            make_batched_env, synergy_policy(), num_workers=1, frames_per_batch=8, **{name: value}
        )
