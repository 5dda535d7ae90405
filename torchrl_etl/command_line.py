"""Command-line code of the recipes: nearest matches for typos, one sentence for errors."""

from __future__ import annotations

import difflib
import logging
import math
import os
import sys
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium

from torchrl_etl.checks import check_choice, choose_one
from torchrl_etl.envs import SimulationError
from torchrl_etl.extras import extra
from torchrl_etl.methods.etl import BODY
from torchrl_etl.training.config import OPEN_SECTIONS, PRESETS, REMOVED, RENAMED, quoted
from torchrl_etl.training.resumed import check_prefix, parse_override
from torchrl_etl.user_conf import group_files

with extra("recipes"):
    from hydra import compose, initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from yaml import YAMLError

__all__ = [
    "OPENING_ERRORS",
    "check_overrides",
    "exit_on_error",
    "interval_in_words",
    "print_intervals",
    "quiet_torchrl",
    "quote_paths",
    "translate",
]

OPENING_ERRORS = (ValueError, OSError, ImportError, SimulationError, gymnasium.error.Error)
"""Errors with a clear message when a run, a bundle or a zoo entry is opened."""


def check_overrides(
    config: Path, arguments: list[str], usage: str, *, short: Sequence[str] = ()
) -> None:
    """Print help for ``--help``; exit with the nearest key if an override names an unknown one.

    Hydra's help drops the comments of the YAML file, and its errors suggest nothing. The known keys
    depend on the chosen group files, since each kind has its own options. A leading plus does not
    bypass the check, except in sections passed to another library: nothing would read the new key.

    ``config`` is the primary YAML file, with the folders of groups beside it. ``usage`` begins the
    help text. ``short`` lists short keys, already translated by the recipe, that are suggested
    like all others.
    """
    text = config.read_text(encoding="utf-8")
    defaults = OmegaConf.create(text).get("defaults", [])
    groups = [name for entry in defaults if isinstance(entry, DictConfig) for name in entry]
    chosen = []
    for argument in arguments:
        key, separator, value = argument.lstrip("+").partition("=")
        if key in groups and separator:
            with exit_on_error(ValueError):
                _check_file(config.parent, key, value)
            chosen.append(f"{key}={value}")
    with exit_on_error(HydraException, YAMLError):
        settings, choices = _composed(config, chosen)
    if {"-h", "--help"} & set(arguments):
        own, _, _ = text.partition("\nhydra:")
        _print(usage.strip(), own, *_of_groups(config.parent, groups, choices))
        sys.exit()
    known = [*_keys(settings), *groups]
    for argument in arguments:
        key, separator, _ = argument.partition("=")
        key = key.lstrip("+~")
        section = key.partition(".")[0]
        if argument in ("-m", "--multirun"):
            sys.exit(
                f"Error: {argument} is not supported; recipes/sweep.py runs several side by side, "
                "such as methods=[sac,etl] seeds=[0,1], and continues after an interruption."
            )
        if argument.startswith("-") or section == "hydra" or key.startswith("hydra/"):
            continue
        if not separator and not argument.startswith("~"):
            sys.exit(f"Error: {argument!r} is not of the form key=value; see --help.")
        if key not in known and section not in OPEN_SECTIONS:
            near = difflib.get_close_matches(key, list(dict.fromkeys([*known, *short])), n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else "--help lists them all."
            of = f"with {section}={choices[section]} " if choices.get(section) else ""
            sys.exit(f"Error: {of}there is no setting {key!r}; {hint}")
        with exit_on_error(ValueError):
            check_prefix(parse_override(argument), key in known)


def translate(arguments: Sequence[str], groups: Path) -> list[str]:
    """Translates short and former settings to Hydra's overrides.

    ``synergies=PATH`` becomes ``synergies.bundle=PATH`` unless it names a kind. For ``synergies``,
    ``exploration`` and ``method``, ``GROUP.kind=KIND`` becomes ``GROUP=KIND`` and so selects that
    kind's settings, unless KIND is a user's class, ``module:Class``. Presets equal to the current
    defaults are removed. So is ``null``, which Hydra does not accept for a group. ``groups`` is
    the folder of the configuration's groups.

    Raises:
        ValueError: for a renamed setting, with its new name, a removed one, or unknown synergies.

    Examples:
        >>> groups = Path("recipes/conf")
        >>> translate(["synergies=runs/a", "exploration.kind=metra", "learner=residual"], groups)
        ['synergies.bundle=runs/a', 'exploration=metra']
        >>> translate(["learn.anchor=0.2"], groups)
        Traceback (most recent call last):
        ...
        ValueError: learn.anchor is called learn.decoder.distillation_weight now.
    """
    kinds, translated = group_files(groups, "synergies"), []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        name = key.lstrip("+~")
        if (old := _former(name)) is not None:
            raise ValueError(f"{name} is called {RENAMED[old]}{name.removeprefix(old)} now.")
        if name in REMOVED:
            raise ValueError(f"{name} was removed, since it did not help; leave it out.")
        if name in ("synergies.kind", "exploration.kind", "method.kind") and ":" not in value:
            key = name.removesuffix(".kind")
        elif name == "synergies" and equals and value not in kinds:
            if value.isidentifier() and value != "null" and not Path(value).exists():
                check_choice("synergies", value, [*kinds, BODY, "zoo:NAME", "an existing folder"])
            key = "synergies.bundle"
        elif value in PRESETS.get(name, ()):
            continue
        translated.append(f"{key}{equals}{value}")
    return translated


def _former(name: str) -> str | None:
    """The renamed setting or section that ``name`` is or belongs to, if any."""
    below = [old for old in RENAMED if f"{name}.".startswith(f"{old}.")]
    return max(below, key=len, default=None)


def quote_paths(arguments: list[str], *keys: str) -> list[str]:
    """Quote the values of path settings, since Hydra's grammar allows no brackets or spaces.

    Expands ``~`` to the home folder. Lists remain unchanged.

    Examples:
        >>> quote_paths(["run_dir=/my (new) runs/a", "seed=1"], "run_dir")
        ["run_dir='/my (new) runs/a'", 'seed=1']
    """
    result = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        is_list = value.startswith("[") and value.endswith("]")
        if key.lstrip("+") in keys and value not in ("", "null") and not is_list:
            if value[0] in "'\"":
                value = value[0] + os.path.expanduser(value[1:])
            else:
                value = quoted(os.path.expanduser(value))
            argument = f"{key}={value}"
        result.append(argument)
    return result


@contextmanager
def exit_on_error(*kinds: type[Exception]) -> Iterator[None]:
    """Print an error of these kinds as one line and exit with code 2; Ctrl-C exits with 130."""
    try:
        yield
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        sys.exit(130)
    except kinds as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(2)


def print_intervals(summary: Mapping[str, Any]) -> None:
    """Print the return and success of an :meth:`~torchrl_etl.training.Evaluation.summary`."""
    for key in ("return", "solved", "solved_time"):
        if key in summary:
            mean, low, high = summary[key].values()
            interval = interval_in_words(low, high, digits=3)
            print(f"  {key:<12} {mean:.3f}" + (f"  ({interval})" if interval else ""))


def interval_in_words(low: float, high: float, digits: int) -> str:
    """The bounds of a 95 % interval; empty for a single episode, which has none."""
    return "" if math.isnan(low) else f"95% interval {low:.{digits}f} to {high:.{digits}f}"


def quiet_torchrl() -> None:
    """Keep libraries' developer messages out of the progress bar; print warnings in one line."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.simplefilter("ignore", FutureWarning)
    warnings.formatwarning = lambda message, *place, **source: f"Warning: {message}\n"


def _check_file(conf: Path, group: str, choice: str) -> None:
    files = group_files(conf, group)
    if choice not in files:
        raise ValueError(
            f"{group} is {choice!r}; {choose_one(choice, list(files))}, or add a file for it to "
            f"./conf/{group}."
        )


def _composed(config: Path, chosen: list[str]) -> tuple[DictConfig, Mapping[str, str]]:
    """All settings with the chosen group files, and the choice of each group."""
    with initialize_config_dir(str(config.parent.resolve()), version_base="1.3"):
        settings = compose(config.stem, chosen, return_hydra_config=True)
    OmegaConf.set_struct(settings, False)
    return settings, settings.pop("hydra").runtime.choices


def _print(*parts: str) -> None:
    """Print parts separated by blank lines; allows a pipe that closes early, such as ``head``."""
    try:
        print(*parts, sep="\n\n", flush=True)
    except BrokenPipeError:  # the interpreter would flush again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _of_groups(conf: Path, groups: list[str], choices: Mapping[str, str]) -> Iterator[str]:
    """The settings of the chosen group files, as sections of the configuration."""
    for group in groups:
        if (file := group_files(conf, group).get(choices.get(group, ""))) is not None:
            inner = textwrap.indent(file.read_text(encoding="utf-8").rstrip(), "  ")
            yield f"{group}:   # {group}={choices[group]}\n{inner}"


def _keys(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in config:
        yield f"{prefix}{key}"
        value = config._get_node(key)
        if isinstance(value, DictConfig):
            yield from _keys(value, f"{prefix}{key}.")
