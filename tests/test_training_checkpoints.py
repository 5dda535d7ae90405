"""Checkpoints: restored buffers, full disks, and damaged files."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_etl.training.buffer import BufferAdapter, make_storage
from torchrl_etl.training.checkpoints import Checkpoints, _size


def buffer(capacity: int) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=4)


def rows(start: int, stop: int) -> TensorDict:
    values = torch.arange(start, stop).unsqueeze(-1).float()
    return TensorDict({"a": values, "next": {"b": values * 2}}, [stop - start])


def save_and_load(source: TensorDictReplayBuffer, capacity: int, path) -> TensorDictReplayBuffer:
    target = buffer(capacity)
    target.extend(rows(90, 93))  # replaced by the load
    for one, action in ((source, "save"), (target, "load")):
        checkpoint = Checkpoint().register("buffer", one, adapter=BufferAdapter())
        getattr(checkpoint, action)(path)
    return target


@pytest.mark.parametrize("filled", [3, 8, 13])  # partly full, full, and wrapped around
def test_rows_order_and_next_position_survive(filled, tmp_path):
    source = buffer(8)
    for start in range(filled):
        source.extend(rows(start, start + 1))
    twin = save_and_load(source, 8, tmp_path / "saved")
    for one in (source, twin):
        one.extend(rows(50, 52))
    assert torch.equal(source.storage[:]["a"], twin.storage[:]["a"])
    assert torch.equal(source.storage[:]["next", "b"], twin.storage[:]["next", "b"])


def test_buffer_of_another_size_loads_the_newest_rows_in_order(tmp_path):
    source = buffer(4)
    for start in range(6):  # wrapped around: 4 and 5 come before 2 and 3
        source.extend(rows(start, start + 1))
    larger = save_and_load(source, 6, tmp_path / "larger")
    larger.extend(rows(6, 9))
    assert larger.storage[:]["a"].flatten().tolist() == [8, 3, 4, 5, 6, 7]
    smaller = save_and_load(source, 3, tmp_path / "smaller")
    assert smaller.storage[:]["a"].flatten().tolist() == [3, 4, 5]


def test_only_the_filled_part_is_written(tmp_path):
    source = buffer(100_000)
    source.extend(rows(0, 4))
    save_and_load(source, 4, tmp_path / "saved")
    size = sum(path.stat().st_size for path in (tmp_path / "saved").rglob("*.memmap"))
    assert size < 100  # two floats and an index a row


def test_an_empty_buffer_can_be_saved(tmp_path):
    assert len(save_and_load(buffer(4), 4, tmp_path / "saved")) == 0


@pytest.fixture
def full_disk(monkeypatch):
    """A disk on which sparse files can be created, but no space can be reserved."""

    def no_space(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", no_space)


def test_buffer_larger_than_the_disk_is_refused_at_its_first_row(tmp_path, full_disk):
    storage = make_storage(100_000, torch.device("cpu"), tmp_path / "buffer")
    with pytest.raises(OSError, match="There is no room for"):
        TensorDictReplayBuffer(storage=storage, batch_size=4).extend(rows(0, 3))


def test_checkpoint_larger_than_the_disk_is_refused_and_removed(tmp_path, full_disk):
    checkpoints = Checkpoints(tmp_path, keep_last=2)
    with pytest.raises(OSError, match="There is no room for"):
        checkpoints.save(Checkpoint(module=torch.nn.Linear(9, 9)), step=1)
    assert not list(tmp_path.iterdir())


def test_checkpoint_size_counts_every_tensor():
    module = torch.nn.Linear(3, 2)  # 8 floats
    optimizer = torch.optim.Adam(module.parameters())
    module(torch.ones(3)).sum().backward()
    optimizer.step()  # two moments of every float, and a step count of both tensors
    assert _size({"module": module}) == 4 * 8
    assert _size([optimizer]) == 4 * (2 * 8 + 2)
    filled = buffer(10)
    filled.extend(rows(0, 3))
    assert _size(filled) >= 4 * 3 * 2


def module(value: float) -> torch.nn.Linear:
    linear = torch.nn.Linear(3, 2)
    torch.nn.init.constant_(linear.weight, value)
    return linear


def flip_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def tensors(folder: Path) -> Path:
    return next(path for path in sorted(folder.rglob("*.memmap")) if path.stat().st_size)


def description(folder: Path) -> Path:
    return next(path for path in sorted(folder.rglob("*.json")) if path.name != "seal.json")


def replace_by_file(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.write_text("a file")


DAMAGE = {
    "flipped bit in a tensor": lambda folder: flip_bit(tensors(folder)),
    "flipped bit in a description": lambda folder: flip_bit(description(folder)),
    "truncated tensor": lambda folder: os.truncate(tensors(folder), 1),
    "empty tensor": lambda folder: os.truncate(tensors(folder), 0),
    "missing tensor": lambda folder: tensors(folder).unlink(),
    "missing description": lambda folder: description(folder).unlink(),
    "empty folder": lambda folder: [shutil.rmtree(folder), folder.mkdir()],
    "extra file": lambda folder: (folder / "more.json").write_text("{}"),
    "file in place of the folder": replace_by_file,
    "missing seal": lambda folder: (folder / "seal.json").unlink(),
    "empty seal": lambda folder: (folder / "seal.json").write_text(""),
    "seal without entries": lambda folder: (folder / "seal.json").write_text("{}"),
    "seal that is a list": lambda folder: (folder / "seal.json").write_text("[1]"),
    "seal that is not UTF-8": lambda folder: (folder / "seal.json").write_bytes(b"\xff\xfe\x00"),
}


@pytest.fixture
def saved(tmp_path) -> Checkpoints:
    """Two checkpoints of a layer, whose weights were 1 and then 2."""
    checkpoints = Checkpoints(tmp_path / "saved", keep_last=2)
    for step in (1, 2):
        checkpoints.save(Checkpoint(module=module(step)), step=step)
    return checkpoints


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_newest_checkpoint_falls_back_to_the_one_before(kind, saved):
    second = saved.checkpoints()[-1]
    DAMAGE[kind](second)
    layer = module(0)
    with pytest.warns(UserWarning, match=f"{second} is damaged .*; using the one before"):
        assert saved.load_newest_whole(Checkpoint(module=layer))
    assert (layer.weight == 1).all()


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_checkpoints_are_refused_and_kept(kind, saved):
    for folder in saved.checkpoints():
        DAMAGE[kind](folder)
    layer = module(0)
    with (
        pytest.warns(UserWarning, match="is damaged"),
        pytest.raises(OSError, match=r"All checkpoints in .* are damaged") as caught,
    ):
        saved.load_newest_whole(Checkpoint(module=layer))
    assert "\n" not in str(caught.value)
    assert (layer.weight == 0).all() and len(saved.checkpoints()) == 2


def test_undamaged_newest_checkpoint_loads_without_warning(saved, recwarn):
    layer = module(0)
    assert saved.load_newest_whole(Checkpoint(module=layer))
    assert (layer.weight == 2).all()
    assert not [warning for warning in recwarn if "damaged" in str(warning.message)]
