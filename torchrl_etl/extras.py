"""Error messages for optional packages, with the extra that installs them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

__all__ = ["extra"]


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """A context for importing packages that ``pip install torchrl_etl[name]`` installs.

    Args:
        name (str): name of the extra in ``pyproject.toml``.

    Raises:
        ImportError: naming the package and the extra, if one is missing.

    Examples:
        >>> with extra("pictures"):
        ...     import not_installed
        Traceback (most recent call last):
        ...
        ImportError: not_installed is needed here but not installed; run pip install
        'torchrl_etl[pictures]'.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ImportError(
            f"{error.name} is needed here but not installed; run pip install "
            f"'torchrl_etl[{name}]'.",
            name=error.name,
        ) from error
