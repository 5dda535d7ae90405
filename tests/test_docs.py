"""Code and commands of README.md and docs/ run, and their links resolve."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.commands import command, recipe_module
from torchrl_etl import zoo
from torchrl_etl.envs import list_tasks, resolve_task
from torchrl_etl.training import validate

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FENCED = re.compile(r"^ *```\w*\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^ *python recipes/(\w+\.py)(.*)$", re.MULTILINE)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
TESTED_ELSEWHERE = {
    # Its code builds all thirteen tasks; the output is compared with the page.
    "docs/tasks.md": "tests/test_envs.py",
    # Its blocks are files that import each other.
    "docs/extend.md": "tests/test_extend.py",
    # Half of its code runs in the environment of the peers.
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
        # Blank lines in front make line numbers of errors those of the page.
        padding = "\n" * (text[: block.start(1)].count("\n"))
        exec(compile(padding + block[1], str(page), "exec"), namespace)


def commands(page: Path) -> list[tuple[str, list[str]]]:
    """Recipes that a page's blocks run and their arguments, without comments."""
    blocks = "\n".join(FENCED.findall(page.read_text(encoding="utf-8")))
    return [(name, shlex.split(rest, comments=True)) for name, rest in COMMAND.findall(blocks)]


@pytest.mark.parametrize(
    # The commands of extend.md need the files of that page.
    "page",
    [page for page in PAGES if commands(page) and name_of(page) != "docs/extend.md"],
    ids=name_of,
)
def test_commands_are_accepted_by_their_recipe(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for recipe, arguments in commands(page):
        told = " ".join([recipe, *arguments])
        if recipe == "list_tasks.py":
            assert arguments in ([], ["names"]), told
            continue
        if recipe == "report.py":
            # Exit code 2: there are no results here. An unknown setting would give 1.
            assert command(recipe, *arguments) == 2, told
            continue
        # With --cfg=job Hydra only prints the configuration; NAME and ... are parts of paths.
        left = command(recipe, *arguments, "--cfg=job")
        said = capsys.readouterr()
        assert left == 0, f"{told}: {said.err}"
        config = OmegaConf.create(said.out)
        if recipe == "etl_sac.py":
            if config.collector.kind == "auto":
                config.collector.kind = "single"  # a run chooses the kind before it validates
            validate(config)
        elif recipe == "sweep.py":
            recipe_module("sweep").queue(config)  # validates each run
        elif config.get("video") and config.zoo in zoo.names():
            assert resolve_task(zoo.read_card(config.zoo).task["name"]).suite != "gymnasium", told


@pytest.mark.parametrize(("page", "test"), TESTED_ELSEWHERE.items())
def test_pages_not_run_here_are_named_in_their_own_test(page, test):
    assert BLOCK.search((ROOT / page).read_text(encoding="utf-8"))
    assert Path(page).name in (ROOT / test).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_resolve(page):
    broken = []
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve() if target else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path)):
            broken.append(link)
    assert not broken


@pytest.fixture(scope="module")
def tasks_page() -> str:
    return (ROOT / "docs" / "tasks.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def cards(tasks_page) -> list[str]:
    gallery = tasks_page.partition("## Gallery\n")[2].partition("\n## ")[0]
    return gallery.split("\n-   ")[1:]


@pytest.mark.parametrize("task", list_tasks(), ids=lambda task: task.name)
def test_gallery_has_clip_actuators_and_command_of_each_task(task, cards, tasks_page):
    (card,) = (card for card in cards if f"**{task.name}**" in card)
    actuators = re.search(rf"^\| {task.name} \| `[^`]+` \| (\d+) \|", tasks_page, re.MULTILINE)[1]
    assert f"](pictures/tasks/{task.name}.webp)" in card
    assert f"**{task.name}**, {actuators} " in card
    assert f"    python recipes/etl_sac.py env={task.name}\n" in card


def test_gallery_shows_each_trained_zoo_policy_with_a_body(cards):
    trained = {name: zoo.read_card(name).task["name"] for name in zoo.names(trained=True)}
    drawn = [name for name, task in trained.items() if resolve_task(task).suite != "gymnasium"]
    for name in drawn:
        (card,) = (card for card in cards if f"](pictures/tasks/{name}-trained.webp)" in card)
        assert "](zoo.md)" in card and f"zoo={name}\n" in card


def test_gallery_clips_are_all_used_and_small(cards):
    clips = list((ROOT / "docs" / "pictures" / "tasks").iterdir())
    sizes = {clip.name: clip.stat().st_size for clip in clips}
    assert sorted(sizes) == sorted(re.findall(r"tasks/([\w-]+\.webp)", "".join(cards)))
    assert max(sizes.values()) <= 80_000 and sum(sizes.values()) <= 1_300_000


def test_table_of_layers_matches_the_import_contract():
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    layers = [layer.split(" | ") for layer in contract["contracts"][0]["layers"]]
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8").partition("## Layers")[2]
    rows = re.findall(r"^\| (`.*?) \|", text.partition("\n\nDimensions")[0], re.MULTILINE)
    named = [re.findall(r"`(\w+)`", row) for row in rows if "recipes/" not in row]
    assert [{f"torchrl_etl.{name}" for name in row} for row in named] == [set(x) for x in layers]
