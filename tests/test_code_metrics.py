"""studies/code_metrics.py on a small package with known call chains and checks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

STUDY = Path(__file__).parents[1] / "studies" / "code_metrics.py"
PACKAGE = {
    "__init__.py": "",
    "functional/__init__.py": "def equation():\n    return 1\n",
    "objectives/__init__.py": (
        "from torchrl_etl.functional import equation\n\ndef loss():\n    return equation()\n"
    ),
    "run.py": (
        "from torchrl_etl.objectives import loss\n\n"
        "def work():\n    yield from stage()\n\n"
        "def stage():\n    yield loss\n\n"
        "def alone(work):\n    return next(work)()\n"
    ),
    "training/config.py": (
        'def validate(of):\n    check_integer(1, **of("a.size", "seed"))\n'
        '    check_choice("kind", 1, ("one", "width"))\n'
    ),
    "part.py": (
        "def part(size, width):\n    check_integer(1, width=width)\n"
        "    if size < 1:\n        raise ValueError\n"
    ),
}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    recipe = "from torchrl_etl.run import alone, work\n\nalone(work())\n"
    files = {f"torchrl_etl/{name}": text for name, text in PACKAGE.items()}
    for name, text in (files | {"recipes/etl_sac.py": recipe}).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def counted(*arguments: object) -> list[str]:
    done = subprocess.run(
        [sys.executable, STUDY, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def test_call_chain_includes_suspended_generators(checkout: Path) -> None:
    names = ["alone", "work", "stage", "loss", "equation"]
    *chain, total = counted(checkout, "chain")
    assert [link.split()[1] for link in chain] == names and total == "5 functions"


def test_setting_checked_in_two_files_is_named(checkout: Path) -> None:
    assert counted(checkout, "checks") == [
        "size",
        "3 settings, 1 of these names elsewhere too",
    ]
