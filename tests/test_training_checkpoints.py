"""A buffer comes back row for row, also into one of another size."""

from __future__ import annotations

import errno
import os

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_etl.training.buffer_adapter import BufferAdapter
from torchrl_etl.training.checkpoints import Checkpoints, _size
from torchrl_etl.training.stage import make_storage


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


@pytest.fixture
def full_disk(monkeypatch):
    """A disk that takes sparse files of any size, and no byte more."""

    def no_space(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", no_space)


def test_a_buffer_in_files_that_do_not_fit_on_the_disk_says_so_at_its_first_row(
    tmp_path, full_disk
):
    storage = make_storage(100_000, torch.device("cpu"), tmp_path / "buffer")
    with pytest.raises(OSError, match="There is no room for"):
        TensorDictReplayBuffer(storage=storage, batch_size=4).extend(rows(0, 3))


def test_a_checkpoint_that_does_not_fit_on_the_disk_says_so_and_leaves_the_last_one(
    tmp_path, full_disk
):
    checkpoints = Checkpoints(tmp_path, keep_last=2)
    with pytest.raises(OSError, match="There is no room for"):
        checkpoints.save(Checkpoint(module=torch.nn.Linear(9, 9)), step=1)
    assert not list(tmp_path.iterdir())


def test_the_size_of_a_checkpoint_counts_every_tensor():
    module = torch.nn.Linear(3, 2)  # 8 floats
    optimizer = torch.optim.Adam(module.parameters())
    module(torch.ones(3)).sum().backward()
    optimizer.step()  # two moments of each, and a count of steps for two tensors
    assert _size({"module": module}) == 4 * 8
    assert _size([optimizer]) == 4 * (2 * 8 + 2)
    filled = buffer(10)
    filled.extend(rows(0, 3))
    assert _size(filled) >= 4 * 3 * 2
