"""A buffer comes back row for row, also into one of another size."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_etl.training.buffer_adapter import BufferAdapter


def buffer(capacity: int) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=4)


def rows(start: int, stop: int) -> TensorDict:
    values = torch.arange(start, stop).unsqueeze(-1).float()
    return TensorDict({"a": values, "next": {"b": values * 2}}, [stop - start])


def copied(source: TensorDictReplayBuffer, capacity: int, path) -> TensorDictReplayBuffer:
    target = buffer(capacity)
    target.extend(rows(90, 93))  # whatever was there goes
    for one, action in ((source, "save"), (target, "load")):
        checkpoint = Checkpoint().register("buffer", one, adapter=BufferAdapter())
        getattr(checkpoint, action)(path)
    return target


@pytest.mark.parametrize("filled", [3, 8, 13])  # partly, exactly, and over the brim
def test_rows_order_and_next_position_survive(filled, tmp_path):
    source = buffer(8)
    for start in range(filled):
        source.extend(rows(start, start + 1))
    twin = copied(source, 8, tmp_path / "saved")
    for one in (source, twin):
        one.extend(rows(50, 52))
    assert torch.equal(source.storage[:]["a"], twin.storage[:]["a"])
    assert torch.equal(source.storage[:]["next", "b"], twin.storage[:]["next", "b"])


def test_a_larger_buffer_takes_the_rows_and_has_room_for_more(tmp_path):
    source = buffer(4)
    source.extend(rows(0, 4))
    twin = copied(source, 6, tmp_path / "saved")
    twin.extend(rows(4, 6))
    assert twin.storage[:]["a"].flatten().tolist() == [0, 1, 2, 3, 4, 5]


def test_only_the_filled_part_is_written(tmp_path):
    source = buffer(100_000)
    source.extend(rows(0, 4))
    copied(source, 4, tmp_path / "saved")
    size = sum(path.stat().st_size for path in (tmp_path / "saved").rglob("*.memmap"))
    assert size < 100  # two floats and an index a row


def test_an_empty_buffer_can_be_saved(tmp_path):
    assert len(copied(buffer(4), 4, tmp_path / "saved")) == 0
