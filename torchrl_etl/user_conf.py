"""A user's own YAML files, in the folder ``conf`` of the working directory."""

from __future__ import annotations

from pathlib import Path

from torchrl_etl.extras import extra

with extra("recipes"):
    from hydra.core.config_search_path import ConfigSearchPath
    from hydra.core.plugins import Plugins
    from hydra.plugins.search_path_plugin import SearchPathPlugin

__all__ = ["group_files"]

OWN = Path("conf")


def group_files(groups: Path, group: str) -> dict[str, Path]:
    """Files of a group by name: those of the recipes in ``groups``, and the user's.

    Examples:
        >>> sorted(group_files(Path("recipes/conf"), "learner"))
        ['plain']
    """
    found: dict[str, Path] = {}
    for conf in (groups, OWN):  # on equal names the recipes' file wins, as in Hydra
        for file in sorted((conf / group).glob("*.yaml")):
            found.setdefault(file.stem, file)
    return found


class _OwnFolder(SearchPathPlugin):
    """Adds the user's folder at the end of Hydra's search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if OWN.is_dir():
            search_path.append("torchrl_etl", f"file://{OWN.resolve()}")  # spaces not escaped


Plugins.instance().register(_OwnFolder)
