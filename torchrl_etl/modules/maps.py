"""The kinds of synergy maps, and how a file describes one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torchrl_etl.modules.sar_decoder import SARDecoder
from torchrl_etl.modules.synergy_decoder import SynergyDecoder
from torchrl_etl.modules.synergy_map import SynergyMap
from torchrl_etl.user_code import check_imported, find_class

__all__ = ["MAPS", "describe_map", "make_map"]

MAPS: Mapping[str, type[SynergyMap]] = {"synergies": SynergyDecoder, "sar": SARDecoder}
"""Maps by kind; ``"my_module:MyMap"`` names a user's own."""


def describe_map(decoder: SynergyMap) -> dict[str, Any]:
    """The map's kind and the arguments of its constructor, as JSON-able values.

    Raises:
        ValueError: if it is not a map, or its class cannot be imported, as it is in a script.

    Examples:
        >>> describe_map(SynergyDecoder(1, 2, hidden=[8]))
        {'kind': 'synergies', 'num_synergies': 1, 'action_dim': 2, 'low': [-1.0, -1.0],
         'high': [1.0, 1.0], 'hidden': [8], 'residual': 0.0}
    """
    own = type(decoder)
    if not isinstance(decoder, SynergyMap):
        raise ValueError(
            f"The decoder is a {own.__name__}; it must be a SynergyMap, such as a SynergyDecoder "
            "from SynergyDecoder.from_directions."
        )
    if own.__module__ == "__main__":
        raise ValueError(
            f"{own.__name__} is defined in the script that runs, from which no other can import "
            "it; put the class into a module of its own."
        )
    names = {of: kind for kind, of in MAPS.items()}
    return {"kind": names.get(own, f"{own.__module__}:{own.__name__}"), **decoder.config}


def make_map(
    described: Mapping[str, Any], *, residual: float | None = None, **keys: Any
) -> SynergyMap:
    """The map of this description, before its weights are loaded.

    No module is imported: that of a user's own map must have been.

    Args:
        described (mapping): from :func:`describe_map`.

    Keyword Args:
        residual (float, optional): replaces the map's; it has no weights.
        **keys: ``in_keys`` and ``out_keys`` of the map.

    Raises:
        TypeError, ValueError: for an unknown kind or invalid arguments, or if the map has another
            residual that is not an argument.

    Examples:
        >>> make_map({"kind": "sar", "num_synergies": 1, "action_dim": 2}).synergy_dim
        3
    """
    options = dict(described)
    kind = options.pop("kind", None)
    check_imported(kind, "The kind of the decoder", ValueError, "import it first if you trust it")
    if residual is not None and "residual" in options:
        options["residual"] = residual
    made = find_class(kind, MAPS, SynergyMap)(**options, **keys)
    if residual is not None and not math.isclose(residual, made.residual):
        raise ValueError(
            f"The decoder is a {type(made).__name__}, whose residual is fixed at "
            f"{made.residual:g}, not {residual:g}; use this value, or another map."
        )
    return made
