"""Error messages for simulator arguments that do not exist."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

__all__ = ["argument_errors", "check_known"]


@contextmanager
def argument_errors(name: str, env_kwargs: Mapping[str, Any]) -> Iterator[None]:
    """Add the task and its arguments to a simulator's "unexpected keyword" error."""
    try:
        yield
    except TypeError as error:
        if not env_kwargs:
            raise
        raise ValueError(
            f"{name} does not take env_kwargs={dict(env_kwargs)} ({error}); use the arguments of "
            "its own constructor."
        ) from error


def check_known(env: gym.Env, name: str, env_kwargs: Mapping[str, Any]) -> None:
    """Reject arguments that an environment's constructors accept and ignore.

    MyoSuite's constructors accept unused ``**kwargs``. An argument is known if a constructor, or
    the function registered as entry point, has it as a parameter, or if its code names it
    (``kwargs.pop("model_recipe", None)``).

    Raises:
        ValueError: naming the argument and the nearest known ones.
    """
    spec = env.unwrapped.spec
    entry = None if spec is None else spec.entry_point
    maker = load_env_creator(entry) if isinstance(entry, str) else entry
    classes = type(env.unwrapped).__mro__
    constructors = [maker, *(vars(base).get("__init__") for base in classes)]
    known, named = set(inspect.signature(gym.make).parameters), set()
    for constructor in filter(inspect.isfunction, constructors):
        known |= inspect.signature(constructor).parameters.keys()
        named |= {const for const in constructor.__code__.co_consts if isinstance(const, str)}
    known -= {"self", "kwargs"}
    for key in env_kwargs:
        if key not in known | named:
            near = difflib.get_close_matches(key, known) or sorted(known)
            raise ValueError(
                f"{name} ignores env_kwargs.{key}, since no constructor of its simulator reads it; "
                f"they read {', '.join(near)}."
            )
