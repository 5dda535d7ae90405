"""What makes hundreds of tiny runs in one process quick, and each draw what it always draws."""

from __future__ import annotations

import gc
import os
import sys
from types import SimpleNamespace

import pytest


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over what was imported, which lives as long as the tests."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> None:
    """No test cuts the power, and a checkpoint waits for the disk at every file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(autouse=True)
def same_numbers() -> None:
    """What a test draws by PyTorch's generator does not depend on the tests before it."""
    if "torch" in sys.modules:  # not imported here: a test without it need not wait for it
        sys.modules["torch"].manual_seed(0)


@pytest.fixture
def traced_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled functions run the graph that was traced as it is; one that cannot be fails."""
    # Not at the top: the process that only hands tests out loads this file too.
    from torchrl_etl.learners import compiled

    monkeypatch.setattr(compiled._inductor, "compile", lambda graph, inputs: graph)
    monkeypatch.setattr(
        compiled, "warnings", SimpleNamespace(warn=lambda text, *_, **__: pytest.fail(text))
    )
