"""The interface between a method and a run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import closing
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

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
    """Prepares a run, and builds the stage and the learner that learn its task.

    Args:
        context (Context): configuration, folder and environment of the run.

    Attributes:
        charged_frames (int): frames that :meth:`prepare` plans to use, which divide the budget.
        has_synergies (bool): whether ``stage`` and ``synergies`` may be set.
        takes (tuple of str): names of the method's own options.
        needs (tuple of str): those of them that have no default.
        fixed_settings (tuple): settings with only one valid value, each as (key, value, reason).

    Raises:
        ValueError: for an unknown, missing or invalid option, and for settings that the method
            ignores.
    """

    charged_frames: int = 0
    has_synergies: ClassVar[bool] = False
    takes: ClassVar[tuple[str, ...]] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    fixed_settings: ClassVar[tuple[tuple[str, Any, str], ...]] = ()
    options: Mapping[str, Any]

    def __init__(self, context: Context) -> None:
        self.context = context
        self.options = context.options("method").get("options") or {}
        config = context.config
        for name in self.options:
            if name not in self.takes:
                raise ValueError(
                    f"method.options.{name} is not an option of method={config.method.name} "
                    f"({', '.join(self.takes) or 'it has none'}); settings of the learner, such as "
                    "the discount, are under learn (learn.sac.gamma)."
                )
        if missing := [name for name in self.needs if name not in self.options]:
            raise ValueError(
                f"method.options lacks {', '.join(missing)}, which kind={config.method.kind} "
                "needs; add what is missing, as in the files of recipes/conf/method."
            )
        if not self.has_synergies and (config.stage != "all" or config.synergies.bundle):
            raise ValueError(
                f"method={config.method.name} has one stage and no synergies; leave stage and "
                "synergies out."
            )
        for key, value, reason in self.fixed_settings:
            section, _, name = key.rpartition(".")
            if (given := context.options(section)[name]) != value:
                raise ValueError(
                    f"{key} is {given!r}, but with method={config.method.name} {reason}; "
                    f"use {key}={value}."
                )
        if not self.has_synergies:
            self.record_no_exploration()

    def record_no_exploration(self, bundle: str | None = None) -> None:
        """Record in the run's configuration that it has no stage 1."""
        config = self.context.config
        config.exploration = {"kind": None}
        config.synergies = {"kind": None, "bundle": bundle}
        config.learn.prefill = False

    def prepare(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        """Compute what :meth:`stage` needs and save it in the run folder.

        Results that exist already are reused. Returns facts for ``summary.json``.
        """
        yield from ()  # a generator, see Work; this one never pauses
        return {}

    @abstractmethod
    def stage(self) -> Stage:
        """Build the stage that learns the task.

        Before :meth:`prepare`, placeholders stand in for its results.
        """

    def begin(self, stage: Stage) -> None:  # noqa: B027 most need none
        """Initialize the stage before its first frame; loading a checkpoint overrides this."""

    def actor(self) -> dict[str, Any]:
        """The actor's kind and specific arguments for :func:`~torchrl_etl.zoo.make_policy`."""
        return {"kind": "gaussian"}

    def frames_before(self) -> int:
        """Frames that :meth:`prepare` has used, or will use if it has not run."""
        return self.charged_frames

    def decoder(self) -> SynergyMap | None:
        """The decoder at the start of learning, if it is known already."""
        return None

    def explorer(self) -> Explorer | None:
        """Stage 1, if the method has one."""
        return None

    def check(self) -> None:
        """Build every part once, so that invalid arguments raise before the first frame."""
        self.stage()

    def resolve_for_body(self, option: float | Mapping[str, float]) -> float:
        """Resolve an option that may have separate values for ``legs`` and ``hands``.

        Bodies with a floating root count as legs.
        """
        return option[self._body] if isinstance(option, Mapping) else option

    @cached_property
    def _body(self) -> Literal["legs", "hands"]:
        with closing(self.context.make_env()) as env:
            return "legs" if has_free_root(env) else "hands"
