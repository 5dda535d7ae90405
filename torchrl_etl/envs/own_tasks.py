"""Tasks of one's own: ``"module:id"`` imports the module that registers the id.

Gymnasium 1 loads no plugins, so nothing else runs a user's ``gymnasium.register``. The name travels
to worker processes as it is, and each of them imports the module for itself.
"""

from __future__ import annotations

import gymnasium as gym

from torchrl_etl.own_code import import_own

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
    import_own(module, f"the task {name!r}; a task of your own is 'module:id'")
    if env_id not in gym.registry:
        raise ValueError(
            f"Importing {module!r} registers no task {env_id!r}; register it in that module with "
            "gymnasium.register, under an id with a version, such as 'MyTask-v0'."
        )
    return env_id
