"""Tasks of one's own: ``"module:id"`` imports the module that registers the id.

Gymnasium 1 loads no plugins, so nothing else runs a user's ``gymnasium.register``. The name travels
to worker processes as it is, and each of them imports the module for itself.
"""

from __future__ import annotations

import importlib
import os
import sys

import gymnasium as gym

__all__ = ["import_own_task"]


def import_own_task(name: str) -> str:
    """Imports what registers a task, and returns the task's bare id.

    Modules are looked for where Python looks for them, and last in the current folder, which a
    script in another folder would not see.

    Args:
        name (str): ``"module:id"``, or an id, for which nothing is imported.

    Returns:
        str: the id, without the module.

    Raises:
        ImportError: if there is no such module.
        ValueError: if it registers no such id.
    """
    module, _, env_id = name.rpartition(":")
    if not module:
        return env_id
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
    try:
        importlib.import_module(module)
    except (ModuleNotFoundError, TypeError) as error:
        # What the module itself fails to import is for its author to see as it is.
        if isinstance(error, ModuleNotFoundError) and not _is_part(error.name, module):
            raise
        raise ImportError(
            f"There is no module {module!r} for the task {name!r}; a task of your own is "
            "'module:id', with the module installed or in the current folder."
        ) from error
    if env_id not in gym.registry:
        raise ValueError(
            f"Importing {module!r} registers no task {env_id!r}; register it in that module with "
            "gymnasium.register, under an id with a version, such as 'MyTask-v0'."
        )
    return env_id


def _is_part(missing: str | None, module: str) -> bool:
    return missing is not None and f"{module}.".startswith(f"{missing}.")
