"""Imports of user code named ``"module:name"``."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from types import ModuleType
from typing import TypeVar

from torchrl_etl.checks import check_choice

__all__ = ["check_imported", "find_class", "import_user_module"]

T = TypeVar("T")


def check_imported(name: object, source: str, error: type[ValueError], remedy: str) -> None:
    """Reject a name read from a data file if using it would import a new module.

    The error message begins with ``source``, the origin of the name. ``remedy`` tells users who
    trust the module what to do.

    Examples:
        >>> import fractions
        >>> check_imported("fractions:Fraction", "The task of my_file", ValueError, "import it")
        >>> check_imported("fractals:T-v0", "The task of my_file", ValueError, "import it")
        Traceback (most recent call last):
        ...
        ValueError: The task of my_file is 'fractals:T-v0', and files may not import
        'fractals'; import it.
    """
    module = str(name).rpartition(":")[0]
    if module and module not in sys.modules:
        raise error(f"{source} is {name!r}, and files may not import {module!r}; {remedy}.")


def find_class(kind: str, kinds: Mapping[str, type[T]], base: type[T]) -> type[T]:
    """The class of a kind: one of ``kinds``, or a user's subclass of ``base`` as
    ``"module:Class"``.

    Raises:
        ImportError: if there is no such module.
        ValueError: if the name is unknown, or the module has no such subclass.

    Examples:
        >>> find_class("whole", {"whole": int, "real": float}, object)
        <class 'int'>
        >>> find_class("fractions:Fraction", {}, object)
        <class 'fractions.Fraction'>
        >>> find_class("fractions:Fraktion", {}, int)
        Traceback (most recent call last):
        ...
        ValueError: kind is 'fractions:Fraktion', but fractions has no class Fraktion that is
        derived from int.
    """
    if not isinstance(kind, str) or ":" not in kind:
        check_choice("kind", kind, list(kinds))
        return kinds[kind]
    module, _, name = kind.rpartition(":")
    own = import_user_module(module, f"{kind!r}; a kind of your own is 'module:Class'")
    found = getattr(own, name, None)
    if not isinstance(found, type) or not issubclass(found, base):
        raise ValueError(
            f"kind is {kind!r}, but {module} has no class {name} that is derived from "
            f"{base.__name__}."
        )
    return found


def import_user_module(module: str, usage: str) -> ModuleType:
    """Import a module that is installed or in the current folder.

    The current folder is added at the end of ``sys.path``, since scripts in other folders lack it.
    ``usage`` goes into the error message: what the module is for, and how to name it.

    Raises:
        ImportError: if there is no such module. Failing imports inside the module raise their own
            errors.
    """
    here = os.getcwd()
    if here not in sys.path:
        sys.path.append(here)
    fault = ImportError(
        f"There is no module {module!r} for {usage}; the module must be installed or in the "
        "current folder."
    )
    if not all(part.isidentifier() for part in module.split(".")):
        raise fault
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):  # it exists, but lacks a dependency
            raise
        raise fault from error
