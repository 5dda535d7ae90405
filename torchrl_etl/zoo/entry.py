"""A zoo entry: a folder with a card and weights, a synergy bundle, or both."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from safetensors import SafetensorError
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_etl.checks import choose_one, not_finite
from torchrl_etl.envs import EnvironmentSpec, make_env, resolve_task
from torchrl_etl.io import read_bytes, replace_folder, replaceable_folder, surviving_folder
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies.bundle import BUNDLE_FILES, bundle_files
from torchrl_etl.synergies.bundle_info import some
from torchrl_etl.user_code import check_imported
from torchrl_etl.zoo.card import CARD, WEIGHTS, Card, ZooError
from torchrl_etl.zoo.policy import make_policy

__all__ = [
    "ENTRIES",
    "find",
    "load",
    "names",
    "read_card",
    "save_entry",
    "synergies",
    "synergies_alone",
    "trust",
    "untrained",
]

# Of a card with values of other types or sizes.
_FAULTS = (AttributeError, KeyError, RuntimeError, TypeError, ValueError)

ENTRIES = Path(__file__).parent / "entries"
"""The folder of the entries that come with torchrl_etl."""


def names(*, trained: bool = False) -> list[str]:
    """Names of the entries that come with torchrl_etl.

    Keyword Args:
        trained (bool): only entries with a policy. Default: ``False``.

    Examples:
        >>> "myohand" in names(), "myohand" in names(trained=True)
        (True, False)
    """
    entries = (path for path in ENTRIES.iterdir() if path.is_dir())
    return sorted(path.name for path in entries if not trained or (path / CARD).exists())


def find(name: str | os.PathLike[str]) -> Path:
    """The folder of an entry, by its name in torchrl_etl or by its path.

    Raises:
        ZooError: if there is none.

    Examples:
        >>> find("overactuted")
        Traceback (most recent call last):
        ...
        torchrl_etl.zoo.card.ZooError: The zoo has no 'overactuted'; choose one of ...
    """
    if (given := os.fspath(name)) in names():
        return ENTRIES / given
    folder = Path(given).expanduser()
    if not folder.is_dir():  # perhaps a crash interrupted its replacement
        folder = surviving_folder(folder.resolve())
    if not folder.is_dir():
        raise ZooError(
            f"The zoo has no {given!r}; {choose_one(given, names())}, or pass the folder of "
            "another entry."
        )
    return folder


def read_card(name: str | os.PathLike[str]) -> Card:
    """The :class:`Card` of an entry.

    Raises:
        ZooError: if there is no such entry, or its card is missing or damaged.
    """
    folder = find(name)
    if not (folder / CARD).exists():
        held = "synergies alone" if synergies_alone(folder) else "no entry of the zoo"
        raise ZooError(
            f"{folder} holds {held}; pass an entry with a policy, that is, with {CARD} and "
            f"{WEIGHTS}."
        )
    return Card.read(folder)


def load(
    name: str | os.PathLike[str],
    *,
    env: EnvBase | None = None,
    device: torch.device | str | None = None,
) -> tuple[TensorDictModuleBase, EnvBase]:
    """A trained policy and the environment of its task.

    The policy is deterministic unless a collector sets another exploration type. It writes muscle
    actions and includes its decoder, if any. Loading executes no code of the entry. The digest
    protects against damage, not against forgery.

    Args:
        name (str or path-like): an entry, see :func:`find`.

    Keyword Args:
        env (EnvBase, optional): an environment to act in. Default: a new one on the entry's task.
        device (torch.device, optional): device of the policy and the new environment.
            Default: the CPU.

    Raises:
        ZooError: if there is no such entry, it is damaged, or its policy does not match the
            environment's sizes, bounds and muscles.

    Examples:
        >>> from torchrl_etl import zoo
        >>> policy, env = zoo.load("overactuated")
        >>> env.rollout(2, policy)["next", "reward"].shape
        torch.Size([2, 1])
    """
    folder = find(name)
    card = read_card(folder)
    policy = _policy(folder, card).to(device or "cpu")
    if env is None:
        env = _make_env(folder, card, device)
    _check_env(folder, card, EnvironmentSpec.of(env))
    return policy, env


def untrained(
    name: str | os.PathLike[str], *, device: torch.device | str | None = None
) -> TensorDictModuleBase:
    """An entry's policy with newly initialized networks, as an untrained baseline.

    A decoder keeps its trained weights. The other weights are not the initial ones of the entry's
    run, which an entry does not store.

    Args:
        name (str or path-like): an entry, see :func:`find`.

    Keyword Args:
        device (torch.device, optional): device of the policy. Default: the CPU.

    Raises:
        ZooError: if there is no such entry, or it is damaged.

    Examples:
        >>> from torchrl_etl import zoo
        >>> zoo.untrained("overactuated").in_keys
        ['observation']
    """
    folder = find(name)
    card = read_card(folder)
    trained = _policy(folder, card)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        fresh = make_policy(**card.policy)
    for drawn, learned in zip(fresh.modules(), trained.modules(), strict=True):
        if isinstance(drawn, SynergyMap):
            drawn.load_state_dict(learned.state_dict())
    return fresh.to(device or "cpu")


def synergies(name: str | os.PathLike[str]) -> Path:
    """The folder of an entry's synergy bundle, for ``synergies=zoo:NAME``.

    Raises:
        ZooError: if there is no such entry, or it has no bundle.
    """
    folder = find(name)
    if not _holds_bundle(folder):
        raise ZooError(f"{folder} has no synergies; its policy moves muscles one by one.")
    return folder


def bundle_path(given: str) -> Path:
    """The folder of a bundle given as a path, or as ``zoo:NAME``.

    Raises:
        ZooError: as :func:`synergies`.

    Examples:
        >>> bundle_path("zoo:myohand") == synergies("myohand")
        True
    """
    entry = given.removeprefix("zoo:")
    return Path(given).expanduser() if entry == given else synergies(entry)


def synergies_alone(name: str | os.PathLike[str]) -> bool:
    """Whether an entry is a synergy bundle without a policy.

    Raises:
        ZooError: if there is no such entry.

    Examples:
        >>> synergies_alone("myohand"), synergies_alone("overactuated")
        (True, False)
    """
    folder = find(name)
    return not (folder / CARD).exists() and _holds_bundle(folder)


def trust(name: str | os.PathLike[str], env: str) -> None:
    """Import the module of an entry's task, which the user must name, since cards import nothing.

    Raises:
        ZooError: if ``env`` is not the entry's task.
    """
    if env != (task := read_card(name).task.get("name")):
        raise ZooError(
            f"The task of {find(name)} is {task!r}, not {env!r}; pass env={task} instead."
        )
    resolve_task(env)


def save_entry(
    folder: str | os.PathLike[str],
    policy: TensorDictModuleBase,
    card: Card,
    *,
    bundle: str | os.PathLike[str] | None = None,
) -> Path:
    """Write an entry atomically, replacing an existing one.

    Args:
        folder (path-like): the entry's folder; parents are created.
        policy (TensorDictModuleBase): a policy that the card describes, from
            :func:`~torchrl_etl.zoo.make_policy` or of a learner.
        card (Card): the entry's card; its digest is filled in.

    Keyword Args:
        bundle (path-like, optional): a synergy bundle or a run folder that holds one.

    Raises:
        ZooError: if the folder holds other files, or the card does not describe the policy.
    """
    folder = replaceable_folder(folder, (CARD, WEIGHTS, *BUNDLE_FILES), "an entry", ZooError)
    state = {key: value.detach().cpu().clone() for key, value in policy.state_dict().items()}
    weights = safetensors.torch.save(state)
    files = {} if bundle is None else bundle_files(bundle)
    card = replace(card, sha256=hashlib.sha256(weights).hexdigest())
    _fill(folder, make_policy(**card.policy), state)
    replace_folder(folder, {CARD: card.json.encode(), WEIGHTS: weights, **files})
    return folder


def _holds_bundle(folder: Path) -> bool:
    return all((folder / name).exists() for name in BUNDLE_FILES)


def _policy(folder: Path, card: Card) -> TensorDictModuleBase:
    path = folder / WEIGHTS
    content = read_bytes(path, ZooError, "copy the entry again")
    if hashlib.sha256(content).hexdigest() != card.sha256:
        raise ZooError(
            f"{path} is damaged or belongs to another entry: its SHA-256 is not the one in {CARD}; "
            "copy the entry again."
        )
    if isinstance(decoder := card.policy.get("decoder"), dict):
        remedy = "if you trust it, import it first in Python, as no setting of the recipes does"
        check_imported(decoder.get("kind"), f"The decoder of {folder}", ZooError, remedy)
    try:
        policy, state = make_policy(**card.policy), safetensors.torch.load(content)
    except (*_FAULTS, SafetensorError) as error:
        raise ZooError(
            f"{CARD} in {folder} describes no policy ({error}); copy it again."
        ) from error
    return _fill(folder, policy, state)


def _fill(
    folder: Path, policy: TensorDictModuleBase, state: dict[str, torch.Tensor]
) -> TensorDictModuleBase:
    if (broken := not_finite(state)) is not None:
        raise ZooError(
            f"{broken} of the policy for {folder} is not finite: its training diverged, so use one "
            "of a run that did not."
        )
    try:
        policy.load_state_dict(state)
    except RuntimeError as error:
        raise ZooError(
            f"The weights of {folder} do not fit the policy that its {CARD} describes "
            f"({' '.join(str(error).split())[:200]}); both must be of the same run and release."
        ) from error
    return policy


def _make_env(folder: Path, card: Card, device: torch.device | str | None) -> EnvBase:
    source, task = f"The task of {folder}", card.task.get("name")
    remedy = f"if you trust it, pass env={task} to the recipe, or import it first in Python"
    check_imported(task, source, ZooError, remedy)
    try:
        return make_env(**card.task, device=device)
    except (TypeError, ValueError) as error:
        raise ZooError(f"{CARD} in {folder} names no task that can be built: {error}") from error


def _check_env(folder: Path, card: Card, found: EnvironmentSpec) -> None:
    made, has = card.policy, f"The policy of {folder}"
    if found.observation_dim != made["observation_dim"]:
        raise ZooError(
            f"{has} reads {made['observation_dim']} observations and the environment gives "
            f"{found.observation_dim}; use the release of its simulator that the card names."
        )
    if list(found.actuators) != card.actuators:
        raise ZooError(
            f"{has} moves {len(card.actuators)} actuators ({some(card.actuators)}) that are not "
            f"the environment's {found.action_dim} ({some(found.actuators)}) by name and order; "
            "use it on its own body."
        )
    for side in ("low", "high"):
        theirs = getattr(found, side).cpu().numpy()
        if not np.allclose(made[side], theirs):
            raise ZooError(
                f"{has} has other {side} action bounds than the environment; actions are scaled "
                "differently, so use the release of its simulator that the card names."
            )
