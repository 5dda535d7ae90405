"""Fixtures of all tests: speed for hundreds of tiny runs in one process, and fixed seeds."""

from __future__ import annotations

import gc
import os
import sys
from types import SimpleNamespace

import pytest


def pytest_collection_finish() -> None:
    """Exclude imported objects, which live as long as the tests, from garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> None:
    """Turn off fsync, which every file of a checkpoint waits for: no test needs it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(autouse=True)
def same_numbers() -> None:
    """Seed PyTorch before every test, so that its draws do not depend on earlier tests."""
    if "torch" in sys.modules:  # not imported here: some tests do without it
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def traced_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled functions run the traced graph without lowering it; a failed trace fails."""
    # Imported here because the process that distributes tests loads this file too.
    from torchrl_etl.learners import compiled

    monkeypatch.setattr(compiled._inductor, "compile", lambda graph, inputs: graph)
    monkeypatch.setattr(
        compiled, "warnings", SimpleNamespace(warn=lambda text, *_, **__: pytest.fail(text))
    )
