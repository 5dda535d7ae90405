"""What README.md and docs/ show runs, and what they link to exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
TESTED_ELSEWHERE = {
    # Builds all thirteen tasks and is compared with the page.
    "docs/tasks.md": "tests/test_envs.py",
    # Files of which one imports the other.
    "docs/extend.md": "tests/test_extend.py",
    # Half of it runs in the environment of the peers.
    "docs/without_torchrl.md": "tests/test_without_torchrl.py",
}


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(page: Path) -> set[str]:
    """The anchors that a Markdown renderer makes of a page's headings."""
    headings = (
        re.sub(r"[^\w\- ]", "", h) for h in HEADING.findall(page.read_text(encoding="utf-8"))
    )
    return {heading.strip().lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(
    "page",
    [
        page
        for page in PAGES
        if BLOCK.search(page.read_text(encoding="utf-8")) and name_of(page) not in TESTED_ELSEWHERE
    ],
    ids=name_of,
)
def test_python_blocks_run_in_order(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = page.read_text(encoding="utf-8")
    namespace = {"__name__": "__main__"}
    for block in BLOCK.finditer(text):
        # Blank lines in front give errors the page's own line numbers.
        padding = "\n" * (text[: block.start(1)].count("\n"))
        exec(compile(padding + block[1], str(page), "exec"), namespace)


@pytest.mark.parametrize(("page", "test"), TESTED_ELSEWHERE.items())
def test_what_is_left_out_here_is_run_elsewhere(page, test):
    assert BLOCK.search((ROOT / page).read_text(encoding="utf-8"))
    assert Path(page).name in (ROOT / test).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_point_at_something(page):
    broken = []
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve() if target else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(link)
    assert not broken
