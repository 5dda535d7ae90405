"""A file that cannot be read raises the caller's error with one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_etl.io import read_bytes, read_json, replaceable_folder


class OurError(ValueError):
    """A ValueError, as JSON decoding raises, which read_json must let through."""


def test_json_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_text('{"a": ["µ"]}', encoding="utf-8")
    assert read_json(tmp_path / "file", dict, OurError, "mend it") == {"a": ["µ"]}


@pytest.mark.parametrize(
    ("name", "fault"), [("gone", "No such file or directory"), ("folder", "Is a directory")]
)
def test_missing_or_unreadable_file_is_named(name: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for read in (read_bytes, lambda path, *rest: read_json(path, dict, *rest)):
        with pytest.raises(OurError) as caught:
            read(tmp_path / name, OurError, "mend it")
        assert str(caught.value) == f"{tmp_path / name} cannot be read ({fault}); mend it."


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\x00\n", b"[" * 100_000])
def test_invalid_json_is_named_with_the_fault(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(OurError, match=r"file is not JSON \(.+\); mend it\.$"):
        read_json(tmp_path / "file", dict, OurError, "mend it")


@pytest.mark.parametrize(("kind", "word"), [(dict, "object"), (list, "array")])
@pytest.mark.parametrize("content", ["null", "1", '"text"'])
def test_json_of_the_wrong_type_is_named(
    kind: type, word: str, content: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text(content)
    with pytest.raises(OurError, match=f"file is not a JSON {word}; mend it"):
        read_json(tmp_path / "file", kind, OurError, "mend it")


@pytest.mark.parametrize("where", [".", ".."])
def test_current_folder_is_not_replaced(where: str, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    with pytest.raises(ValueError, match="is in use as the current folder; choose another"):
        replaceable_folder(where, ["inner"], "a bundle", ValueError)
