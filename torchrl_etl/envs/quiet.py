"""Suppresses simulator warnings that a user can do nothing about, and no others."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from types import ModuleType

from torchrl_etl.extras import extra

__all__ = ["dm_control_suite", "quiet_compiler"]

_HARMLESS = (
    "Attaching a spec with an empty prefix",  # MyoSuite's hands: only affects saving the model
    "compiler attribute 'settotalmass' is deprecated",  # some of DMControl's models
)


@contextlib.contextmanager
def quiet_compiler() -> Iterator[None]:
    """Suppresses known warnings of MuJoCo's compiler while models are built.

    MuJoCo would write them to stderr and to a file in the working directory. Other warnings
    become Python warnings.
    """
    try:
        import mujoco
    except ModuleNotFoundError:
        yield
        return

    def report(message: str) -> None:
        if not message.startswith(_HARMLESS):
            warnings.warn(message, stacklevel=2)

    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(report)
    try:
        with warnings.catch_warnings():
            for message in _HARMLESS:
                warnings.filterwarnings("ignore", message=message)
            yield
    finally:
        mujoco.set_mju_user_warning(previous)


def dm_control_suite() -> ModuleType:
    """Imports DMControl's suite without its warning about a missing display."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*DISPLAY environment variable is missing")
        with extra("dm_control"):
            from dm_control import suite
    return suite
