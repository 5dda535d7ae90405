"""What the recipes share: a typo gets the nearest right word, a fault one sentence."""

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

from torchrl_etl.checks import check_choice
from torchrl_etl.envs import SimulationError
from torchrl_etl.extras import extra
from torchrl_etl.own_conf import group_files
from torchrl_etl.training.config import OPEN_SECTIONS, PRESETS, RENAMED, quoted
from torchrl_etl.training.resumed import check_prefix, parse_override

with extra("recipes"):
    from hydra import compose, initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from yaml import YAMLError

__all__ = [
    "OPENING_FAULTS",
    "check_overrides",
    "interval_in_words",
    "one_sentence",
    "print_intervals",
    "quiet_torchrl",
    "quote_paths",
    "translate",
]

OPENING_FAULTS = (ValueError, OSError, ImportError, SimulationError, gymnasium.error.Error)
"""What explains itself when a run, a bundle or an entry is opened with its simulators."""


def check_overrides(
    config: Path, arguments: list[str], usage: str, *, short: Sequence[str] = ()
) -> None:
    """Answer ``--help``, and leave with the nearest key if an override names none that exists.

    Hydra does both, but its help drops the comments of the YAML file, and it suggests nothing. What
    exists depends on the files that are chosen: each kind has options of its own. A plus in front
    of a key is no way around: nothing would read what it adds, but in the sections that are handed
    on to another library.

    ``config`` is the primary YAML file, beside which folders are groups, and ``usage`` what the
    help begins with; ``short`` are ways to write a setting that the recipe has translated already,
    to be suggested like the rest.
    """
    text = config.read_text(encoding="utf-8")
    defaults = OmegaConf.create(text).get("defaults", [])
    groups = [name for entry in defaults if isinstance(entry, DictConfig) for name in entry]
    chosen = []
    for argument in arguments:
        key, separator, value = argument.lstrip("+").partition("=")
        if key in groups and separator:
            with one_sentence(ValueError):
                _check_file(config.parent, key, value)
            chosen.append(f"{key}={value}")
    with one_sentence(HydraException, YAMLError):
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
                f"Error: {argument} is not supported; recipes/sweep.py runs several, such as "
                "methods=[sac,etl] seeds=[0,1], side by side, and goes on if it is interrupted."
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
        with one_sentence(ValueError):
            check_prefix(parse_override(argument), key in known)


def translate(arguments: Sequence[str], groups: Path) -> list[str]:
    """Short and former ways to write a setting, as Hydra reads them.

    ``synergies=PATH`` is ``synergies.bundle=PATH`` unless it names a kind, ``KIND`` of
    ``synergies.kind=KIND``, ``exploration.kind=KIND`` and ``method.kind=KIND`` brings that kind's
    other settings unless it is a class of one's own, ``module:Class``, and the presets that hold
    today's defaults are no preset: they are left out, as ``null`` is, which Hydra does not take for
    a group. ``groups`` is the folder of the configuration's groups.

    Raises:
        ValueError: for a setting that has another name now, which it tells.

    Examples:
        >>> groups = Path("recipes/conf")
        >>> translate(["synergies=runs/a", "exploration.kind=metra", "learner=residual"], groups)
        ['synergies.bundle=runs/a', 'exploration=metra']
        >>> translate(["learn.anchor=0.2"], groups)
        Traceback (most recent call last):
        ...
        ValueError: learn.anchor is called learn.decoder.distillation_weight now.
    """
    translated = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        name = key.lstrip("+~")
        if (old := _former(name)) is not None:
            raise ValueError(f"{name} is called {RENAMED[old]}{name.removeprefix(old)} now.")
        kinds = group_files(groups, "synergies")
        if name in ("synergies.kind", "exploration.kind", "method.kind") and ":" not in value:
            key = name.removesuffix(".kind")
        elif name == "synergies" and equals and value not in kinds:
            key = "synergies.bundle"
        elif value in PRESETS.get(name, ()):
            continue
        translated.append(f"{key}{equals}{value}")
    return translated


def _former(name: str) -> str | None:
    """The former name of a setting or a section that this one is, or is below."""
    below = [old for old in RENAMED if f"{name}.".startswith(f"{old}.")]
    return max(below, key=len, default=None)


def quote_paths(arguments: list[str], *keys: str) -> list[str]:
    """Quote the values of path settings, in which Hydra's grammar allows no bracket or space.

    A ``~`` is the home folder, as in the arguments that the shell expands. A list stays as it is.

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
def one_sentence(*kinds: type[Exception]) -> Iterator[None]:
    """Turn faults of these kinds, which explain themselves, into one line and exit code 2."""
    try:
        yield
    except kinds as error:
        print(f"Error: {error}", file=sys.stderr)
        sys.exit(2)


def print_intervals(summary: Mapping[str, Any]) -> None:
    """Print return and solved, as :meth:`~torchrl_etl.training.Evaluation.summary` has them."""
    for key in ("return", "solved", "solved_time"):
        if key in summary:
            mean, *ends = summary[key].values()
            interval = interval_in_words(*ends, digits=3)
            print(f"  {key:<12} {mean:.3f}" + (f"  ({interval})" if interval else ""))


def interval_in_words(low: float, high: float, digits: int) -> str:
    """The ends of a 95 % interval; nothing for one episode alone, which has none."""
    return "" if math.isnan(low) else f"95% interval {low:.{digits}f} to {high:.{digits}f}"


def quiet_torchrl() -> None:
    """Keep out of the progress bar what libraries tell their developers; a warning is one line."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.simplefilter("ignore", FutureWarning)
    warnings.formatwarning = lambda message, *place, **source: f"Warning: {message}\n"


def _check_file(conf: Path, group: str, choice: str) -> None:
    files = group_files(conf, group)
    try:
        check_choice(group, choice, list(files))
    except ValueError as error:
        said = str(error).removesuffix(".")
        raise ValueError(f"{said}, or give it a file of its own in ./conf/{group}.") from None


def _composed(config: Path, chosen: list[str]) -> tuple[DictConfig, Mapping[str, str]]:
    """All settings there are with these files of groups, and the file of each group."""
    with initialize_config_dir(str(config.parent.resolve()), version_base="1.3"):
        settings = compose(config.stem, chosen, return_hydra_config=True)
    OmegaConf.set_struct(settings, False)
    return settings, settings.pop("hydra").runtime.choices


def _print(*parts: str) -> None:
    """Print with blank lines between, also to a pipe that is closed before the end, as of head."""
    try:
        print(*parts, sep="\n\n", flush=True)
    except BrokenPipeError:  # what is left would be tried again at the exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _of_groups(conf: Path, groups: list[str], choices: Mapping[str, str]) -> Iterator[str]:
    """The settings of the files that were chosen, each as the section that it fills."""
    for group in groups:
        if (file := group_files(conf, group).get(choices.get(group))) is not None:
            inner = textwrap.indent(file.read_text(encoding="utf-8").rstrip(), "  ")
            yield f"{group}:   # {group}={choices[group]}\n{inner}"


def _keys(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in config:
        yield f"{prefix}{key}"
        value = config._get_node(key)
        if isinstance(value, DictConfig):
            yield from _keys(value, f"{prefix}{key}.")
