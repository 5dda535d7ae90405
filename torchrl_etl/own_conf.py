"""A user's own YAML files: the folder ``conf`` in the folder that a command is started from."""

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
    """Files that may be chosen of a group, by name: the recipes' in ``groups``, and one's own.

    Examples:
        >>> sorted(group_files(Path("recipes/conf"), "learner"))
        ['plain']
    """
    found: dict[str, Path] = {}
    for conf in (groups, OWN):  # of two with one name Hydra, too, takes the recipes'
        for file in sorted((conf / group).glob("*.yaml")):
            found.setdefault(file.stem, file)
    return found


class _OwnFolder(SearchPathPlugin):
    """Lets Hydra look there last, wherever a configuration is composed."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        if OWN.is_dir():
            search_path.append("torchrl_etl", f"file://{OWN.resolve()}")  # spaces as they are


Plugins.instance().register(_OwnFolder)
