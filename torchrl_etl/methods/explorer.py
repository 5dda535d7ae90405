"""Stage 1 of ETL: explore, and extract synergies from the actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase

from torchrl_etl.checks import naming
from torchrl_etl.exploration import EXPLORATIONS, Exploration
from torchrl_etl.learners import SACLearner, Term
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies import SYNERGY_MODELS, ActionSelector, SynergyModel
from torchrl_etl.training.context import Context
from torchrl_etl.training.work import Work
from torchrl_etl.user_code import find_class

__all__ = ["Explorer", "make_exploration", "make_synergy_model"]

T = TypeVar("T")
_OTHER_OPTIONS = ("unexpected keyword argument", "required keyword-only argument")


class Explorer:
    """Stage 1: an exploration, a learner that maximizes its reward, and a synergy model.

    Each update trains the policy, the representation and the synergy model on one batch. The bonus
    is computed with the current representation.

    Deviates: after the last frame the synergy model gets ``final_updates`` more updates; Algorithm
    1 stops at the last frame (0).

    Attributes:
        exploration (Exploration): the exploration method.
        model (SynergyModel): the synergy model.
        stage (Stage): stage 1.
        fitter (SACLearner): updates the synergy model only, with the optimizer of stage 1.
    """

    def __init__(self, context: Context) -> None:
        fit = dict(context.options("explore")["fit"])
        self.final_updates = fit.pop("final_updates")
        context.seed_everything("explore")
        self.exploration = make_exploration(context)
        if not self.exploration.trains_policy and fit["actions"] in ("policy", "mean"):
            raise ValueError(
                f"explore.fit.actions is {fit['actions']!r}, but exploration="
                f"{context.config.exploration.kind} trains no policy; use sampled or activation."
            )
        self.model = make_synergy_model(context)
        self.relabel = self.exploration.relabel_transforms()
        for transform in self.relabel:
            transform.to(context.device)
        actor = context.actor("explore", inputs=self.exploration.inputs)
        with naming("explore.fit"):
            self.selector = ActionSelector(actor, **fit)
        with naming("exploration"):
            terms = [*self.exploration.terms()]
        fitted = []
        if self.model.loss is not None:
            with naming("synergies"):
                fitted = [Term(self.model.loss, lr=self.model.lr, inputs=self.selector)]
        learner = context.learner(
            actor,
            "explore",
            behavior=self.exploration.behavior(context.behavior(actor, "explore")),
            terms=[*terms, *fitted],
            transforms=self.exploration.batch_transforms(),
            reward=self.exploration.reward,
            loss=context.loss(actor, "explore", inputs=self.exploration.inputs),
        )
        self.fitter = learner.only(*fitted)
        updated: SACLearner | None = learner
        if not self.exploration.trains_policy:
            updated = self.fitter if fitted else None  # none: the model is fitted once, at the end
        env_options = {"activations": True} if fit["actions"] == "activation" else {}
        self.stage = context.stage(
            learner,
            "explore",
            updated=updated,
            env_options=env_options,
            env_transforms=self.exploration.reset_transforms(),
            transforms=self.relabel,
            keep=(*self.exploration.keep, *self.selector.keep),
        )

    def condense(self, on_update: Callable[[], None] = lambda: None) -> Work[SynergyMap]:
        """Finish the training of the synergy model; returns the decoder for stage 2.

        ``on_update`` is called before every few updates and may raise to stop.
        """
        torch.manual_seed(self.stage.seed)  # the same whether or not the run was resumed
        if self.model.loss is None:
            self.model.fit(self.actions(), on_update=on_update)
        else:
            for few in self.stage.updates(self.final_updates, self.fitter, "synergies"):
                on_update()
                yield few
        return self.model.decoder(self.actions())

    def actions(self, count: int = 20_000) -> torch.Tensor:
        """Up to ``count`` of the latest actions, as the synergy model is trained on them [N, n].

        Transitions are relabeled and normalized first, as in an update.
        """
        rows = self.stage.newest(count).to(self.stage.device)
        for transform in self.relabel:
            rows = transform(rows)
        return self.selector(self.fitter.objective.prepare(rows))["action"]

    def transitions(self, decoder: SynergyMap) -> TensorDictBase:
        """All transitions of stage 1 for the buffer of stage 2, with the unscaled task reward and
        with coefficients encoded from each executed action.
        """
        rows = self.stage.newest(self.stage.budget)
        kept = rows.select("observation", "action", ("next", "observation"))
        kept["next"].update(rows["next"].select("done", "terminated"))
        kept["next", "reward"] = rows["next", "reward"] / self.stage.reward_scale
        return kept.set("synergy", decoder.encode(rows["action"]))


def make_exploration(context: Context) -> Exploration:
    """Build the exploration that the configuration names."""
    options = context.options("exploration")
    return _make("exploration", EXPLORATIONS, Exploration, (context.spec,), **options)


def make_synergy_model(context: Context, num_synergies: int | None = None) -> SynergyModel:
    """Build the synergy model that the configuration names; ``num_synergies`` overrides its d."""
    options = context.options("synergies")
    options.pop("bundle", None)
    number = context.config.num_synergies if num_synergies is None else num_synergies
    inputs = (context.spec.low, context.spec.high, number)
    return _make("synergies", SYNERGY_MODELS, SynergyModel, inputs, **options)


def _make(
    section: str,
    kinds: Mapping[str, type[T]],
    base: type[T],
    inputs: tuple[Any, ...],
    *,
    kind: str,
    **options: Any,
) -> T:
    """Build one of ``kinds``, or a user's class, with the options of its section."""
    with naming(section):
        found = find_class(kind, kinds, base)
    try:
        with naming(section):
            return found(*inputs, **options)
    except TypeError as error:
        if not any(fault in str(error) for fault in _OTHER_OPTIONS):
            raise
        cure = f"choose {section}={kind}, which brings its own"
        if kind not in kinds:
            cure = f"add a file for this kind to ./conf/{section}"
        raise ValueError(
            f"{section}.kind is {kind}, but the section has options of another kind ({error}); "
            f"{cure}."
        ) from error
