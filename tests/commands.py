"""Recipes and scripts as commands: in this process, where imports are done, or in another."""

from __future__ import annotations

import importlib.util
import logging
import os
import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from pytest import MonkeyPatch

from tests.configs import ROOT


def process(recipe: str, *overrides: str, cwd: Path) -> subprocess.CompletedProcess:
    """Run ``recipes/RECIPE`` in another process, in the folder ``cwd``, until it ends."""
    return subprocess.run(
        [sys.executable, str(ROOT / "recipes" / recipe), *overrides],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=240,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def begun(recipe: str, *overrides: str, cwd: Path) -> subprocess.Popen:
    """Start ``recipes/RECIPE`` in another process; its output includes stderr."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "recipes" / recipe), *overrides],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def wait_until(
    condition: Callable[[], object], process: subprocess.Popen, seconds: float = 200
) -> None:
    """Wait for a condition that a running process brings about; fail if the process ends first."""
    deadline = time.monotonic() + seconds
    while not condition():
        if process.poll() is not None:
            output, _ = process.communicate(timeout=20)
            pytest.fail(f"it ended before that, with {process.returncode}: {output}")
        assert time.monotonic() < deadline, f"it did not come about in {seconds} seconds"
        time.sleep(0.02)


def command(recipe: str, *arguments: str) -> int:
    """Run ``recipes/RECIPE`` with arguments as its command line; returns its exit code."""
    return script(ROOT / "recipes" / recipe, *arguments)


def script(path: Path, *arguments: str) -> int:
    """Run a script with arguments as its command line; returns its exit code.

    A text in ``sys.exit`` is printed to stderr, as the interpreter does.
    """
    with MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(path), *arguments])
        patch.setattr(sys, "path", [str(path.parent), *sys.path])
        # Hydra reconfigures logging, whereupon absl closes its stream, which is pytest's.
        patch.setattr(logging, "shutdown", lambda *handlers: None)
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as left:
            if isinstance(left.code, str):
                sys.stderr.write(f"{left.code}\n")
                return 1
            return left.code or 0
    return 0


def recipe_module(name: str) -> ModuleType:
    """``recipes/NAME.py`` imported as a module, for tests of its functions."""
    spec = importlib.util.spec_from_file_location(f"{name}_recipe", ROOT / "recipes" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
