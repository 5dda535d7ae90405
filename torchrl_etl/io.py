"""Read and replace files, with one-sentence errors.

A crash during a replacement leaves either the old files or the new ones.
"""

from __future__ import annotations

import glob
import json
import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

__all__ = [
    "as_json",
    "check_disk_space",
    "flush_folder",
    "read_bytes",
    "read_json",
    "replace_folder",
    "replaceable_folder",
    "reserve",
    "surviving_folder",
    "write_atomically",
]

Content = TypeVar("Content", dict[str, Any], list[Any])


def read_bytes(path: Path, error: type[Exception], cure: str) -> bytes:
    """The content of a file. If it cannot be read, raises ``error`` with ``cure`` as advice.

    Examples:
        >>> read_bytes(Path("card.json"), ValueError, "copy it again")
        Traceback (most recent call last):
        ...
        ValueError: card.json cannot be read (No such file or directory); copy it again.
    """
    try:
        return path.read_bytes()
    except OSError as fault:
        raise error(f"{path} cannot be read ({fault.strerror}); {cure}.") from fault


def read_json(path: Path, kind: type[Content], error: type[Exception], cure: str) -> Content:
    """The object (``dict``) or array (``list``) in a JSON file.

    Other arguments as for :func:`read_bytes`. A file that is not JSON, or holds another type,
    raises the same ``error``.
    """
    text = read_bytes(path, error, cure)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as fault:
        raise error(f"{path} is not JSON ({fault}); {cure}.") from fault
    if not isinstance(content, kind):
        raise error(f"{path} is not a JSON {'array' if kind is list else 'object'}; {cure}.")
    return content


def replaceable_folder(
    path: str | os.PathLike[str], names: Collection[str], what: str, error: type[ValueError]
) -> Path:
    """The resolved path of a folder to be replaced, which may hold only files of these names.

    If it holds others, is a file, or is the current folder, raises ``error``; ``what`` names the
    content to be saved.

    Examples:
        >>> replaceable_folder("recipes", ["card.json"], "an entry", ValueError)
        Traceback (most recent call last):
        ...
        ValueError: ...recipes holds ..., and saving an entry there would remove it; choose ...
    """
    folder = Path(path).expanduser().resolve()
    if folder.is_dir():
        others = sorted({file.name for file in folder.iterdir()} - {*names})
        held = f"holds {others[0]!r}" if others else ""
        if Path.cwd().is_relative_to(folder):
            raise error(f"{folder} is in use as the current folder; choose another for {what}.")
    else:
        held = "is a file" if folder.exists() else ""
    if held:
        raise error(
            f"{folder} {held}, and saving {what} there would remove it; choose another folder."
        )
    return folder


def replace_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Replace the content of ``folder`` by ``files``. Creates parent folders.

    The files are written to a hidden sibling folder and flushed to disk. No portable call swaps two
    folders, so the old one is first renamed to a hidden name. Until the new one is in place,
    :func:`surviving_folder` finds the old one there. Only one process at a time may write to a
    folder.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as parent:
        ...     folder = Path(parent) / "bundle"
        ...     replace_folder(folder, {"old": b"1"})
        ...     replace_folder(folder, {"new": b"2"})
        ...     [path.name for path in folder.iterdir()], len(list(Path(parent).iterdir()))
        (['new'], 1)
    """
    parent, aside = folder.parent, _aside(folder)
    parent.mkdir(parents=True, exist_ok=True)
    if aside.exists() and not folder.exists():  # an earlier crash between the two moves below
        os.replace(aside, folder)
    for stale in parent.glob(f".{glob.escape(folder.name)}.saving-*"):
        shutil.rmtree(stale, ignore_errors=True)
    fresh = folder.with_name(f".{folder.name}.saving-{os.getpid()}")
    try:
        fresh.mkdir()
        for name, content in files.items():
            _write_to_disk(fresh / name, content)
        flush_folder(fresh)
        if folder.exists():
            shutil.rmtree(aside, ignore_errors=True)
            os.replace(folder, aside)
        try:
            os.replace(fresh, folder)
        except BaseException:
            if aside.exists():
                os.replace(aside, folder)
            raise
        flush_folder(parent)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    shutil.rmtree(aside, ignore_errors=True)


def surviving_folder(folder: Path) -> Path:
    """The path with the content of ``folder``: its hidden name if a replacement was interrupted.

    Examples:
        >>> surviving_folder(Path("nowhere"))
        PosixPath('nowhere')
    """
    return _aside(folder) if _aside(folder).exists() and not folder.exists() else folder


def _aside(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.previous")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file, whole or not at all, and flush it to disk."""
    scratch = path.with_name(f".{path.name}.tmp")
    _write_to_disk(scratch, content.encode() if isinstance(content, str) else content)
    os.replace(scratch, path)
    flush_folder(path.parent)


def _write_to_disk(path: Path, content: bytes) -> None:
    try:
        with path.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:  # a full disk does not say of itself which one
        raise OSError(error.errno, error.strerror, str(path)) from error


def as_json(content: Any) -> str:
    """JSON text with a line for each entry.

    NaN, such as the interval of a single episode, becomes null.

    Examples:
        >>> as_json({"low": float("nan")})
        '{\\n  "low": null\\n}\\n'
    """
    finite = json.loads(json.dumps(content), parse_constant=lambda name: None)
    return json.dumps(finite, indent=2) + "\n"


def flush_folder(folder: Path) -> None:
    """Flush the entries of a folder to disk, not only the contents of its files."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def reserve(path: Path) -> None:
    """Allocate the disk space of a sparse file, or raise an ``OSError``.

    Without it, writing through a memory map to a full disk kills the process with a bus error.
    """
    with path.open("r+b") as file:
        _allocate(file, path.stat().st_size, path.parent)


def check_disk_space(folder: Path, size: int) -> None:
    """Raise an ``OSError`` unless ``size`` more bytes can be written to ``folder``.

    Allocates them briefly, since the reported free space ignores quotas and limits.
    """
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / f".room-{os.getpid()}"
    try:
        with probe.open("wb") as file:
            _allocate(file, size, folder)
    finally:
        probe.unlink(missing_ok=True)


def _allocate(file: IO[bytes], size: int, folder: Path) -> None:
    if size == 0 or not hasattr(os, "posix_fallocate"):  # macOS
        return
    try:
        os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        raise OSError(
            f"There is no room for {size / 1e6:,.1f} MB in {folder} ({error.strerror}); free "
            "some space there, or use a run folder on another disk."
        ) from error
