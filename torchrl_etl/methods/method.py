"""What every method is to a run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from torchrl_etl.envs import has_free_root
from torchrl_etl.modules import SynergyMap
from torchrl_etl.training.context import Context
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.stage import Stage
from torchrl_etl.training.work import Work

if TYPE_CHECKING:
    from torchrl_etl.methods.explorer import Explorer

__all__ = ["Method"]


class Method(ABC):
    """What a run does before it learns the task, and with which learner it then does.

    Args:
        context (Context): configuration, folder and environment of the run.

    Attributes:
        charged (int): frames that :meth:`prepare` takes; they count.
        has_synergies (bool): whether ``stage`` and ``synergies`` may be given.
        takes (tuple of str): names of its own options.
        fixed (tuple): settings that it can have in one way alone, each with that value and why.

    Raises:
        ValueError: for options that it does not have, or that cannot be used, and for settings
            that it would not heed.
    """

    charged: int = 0
    has_synergies: ClassVar[bool] = False
    takes: ClassVar[tuple[str, ...]] = ()
    fixed: ClassVar[tuple[tuple[str, Any, str], ...]] = ()
    options: Mapping[str, Any]

    def __init__(self, context: Context) -> None:
        self.context = context
        self.options = context.options("method").get("options") or {}
        config = context.config
        for name in self.options:
            if name not in self.takes:
                raise ValueError(
                    f"method.options.{name} is none of the options of method={config.method.name} "
                    f"({', '.join(self.takes) or 'it has none'}); settings of the learner, such as "
                    "the discount, are those of learn, such as learn.sac.gamma."
                )
        if not self.has_synergies and (config.stage != "all" or config.synergies.bundle):
            raise ValueError(
                f"method={config.method.name} has one stage and no synergies; leave stage and "
                "synergies out."
            )
        for key, value, reason in self.fixed:
            section, _, name = key.rpartition(".")
            if (given := context.options(section)[name]) != value:
                raise ValueError(
                    f"{key} is {given!r}, but with method={config.method.name} {reason}; "
                    f"use {key}={value}."
                )
        if not self.has_synergies:
            self.explores_nothing()

    def explores_nothing(self, bundle: str | None = None) -> None:
        """Say so in the run's configuration: there is no stage 1 whose settings would hold."""
        config = self.context.config
        config.exploration = {"kind": None}
        config.synergies = {"kind": None, "bundle": bundle}
        config.learn.prefill = False

    def prepare(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        """Find out what :meth:`stage` needs and leave it in the run folder.

        What is there already is not done again. Returns facts for ``summary.json``.
        """
        yield from ()
        return {}

    @abstractmethod
    def stage(self) -> Stage:
        """The stage that learns the task, before its first frame.

        Before :meth:`prepare` it has placeholders for what that finds.
        """

    def begin(self, stage: Stage) -> None:  # noqa: B027 most have nothing to give
        """Give the stage what it has before its first frame; a checkpoint replaces it."""

    def actor(self) -> dict[str, Any]:
        """The actor's kind, and arguments of its own, for :func:`~torchrl_etl.zoo.make_policy`."""
        return {"kind": "gaussian"}

    def frames_before(self) -> int:
        """Frames that :meth:`prepare` has taken, where it is done; else those that it will."""
        return self.charged

    def decoder(self) -> SynergyMap | None:
        """What learning begins to act through, if that is known by now."""
        return None

    def explorer(self) -> Explorer | None:
        """Stage 1, if the method has one."""
        return None

    def check(self) -> None:
        """Build every part once, so that each objects to its arguments before the first frame."""
        self.stage()

    def of_the_body(self, option: float | Mapping[str, float]) -> float:
        """An option as given, or the one for this body of the two for ``legs`` and for ``hands``.

        Legs are what stands free: a body whose root floats.
        """
        if not isinstance(option, Mapping):
            return option
        return option["legs" if has_free_root(self.context.make_env()) else "hands"]
