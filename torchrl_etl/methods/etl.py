"""Explore to Learn: explore to find synergies, then learn the task in them (Algorithm 1)."""

from __future__ import annotations

from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import safetensors.torch
from tensordict import TensorDict
from torch import nn

from torchrl_etl import zoo
from torchrl_etl.analysis import describe_synergies, direction_alignment
from torchrl_etl.checks import check_choice, check_real, naming, renaming
from torchrl_etl.envs import body_synergies, resolve_task
from torchrl_etl.io import surviving_folder, write_atomically
from torchrl_etl.learners import Term
from torchrl_etl.methods.explorer import Explorer, make_synergy_model
from torchrl_etl.methods.method import Method
from torchrl_etl.modules import SynergyDecoder, SynergyMap
from torchrl_etl.objectives import DecoderLoss
from torchrl_etl.synergies import (
    BundleInfo,
    SynergyModel,
    check_compatible,
    copy_bundle,
    load_bundle,
    save_bundle,
)
from torchrl_etl.training.context import Context
from torchrl_etl.training.loop import StopOnSignal
from torchrl_etl.training.run_folder import facts
from torchrl_etl.training.stage import Stage, check_budget
from torchrl_etl.training.work import Work
from torchrl_etl.user_code import import_user_module

__all__ = ["ETL", "FineTuning"]

FineTuning = Literal["critic", "reconstruction", "frozen"]
BODY = "body"
"""Value of ``synergies=`` that computes synergies from the body's moment arms."""
MOST_SYNERGIES = 8
"""d of bodies with at least twice as many actuators, which include all of the paper's tasks."""


def default_num_synergies(actuators: int) -> int:
    """Default d for a body: half of its number of actuators, between 1 and 8.

    Examples:
        >>> [default_num_synergies(n) for n in (1, 6, 21, 80)]
        [1, 3, 8, 8]
    """
    return min(MOST_SYNERGIES, max(1, actuators // 2))


class ETL(Method):
    """Algorithm 1: explore and extract synergies, or load a bundle; then SAC on their coefficients.

    A bundle comes from another run, from the zoo, or from the body's moment arms.

    Fine-tuning of the decoder is ``"critic"`` (trained on the actor loss, with Eq. 10 weighted by
    ``distillation_weight`` against drift), ``"reconstruction"`` (Eq. 10 only, as printed) or
    ``"frozen"``.

    Deviates: see :class:`~torchrl_etl.objectives.SynergySACLoss`,
    :class:`~torchrl_etl.objectives.DecoderLoss`, and ``docs/faithfulness.md``.
    """

    has_synergies = True

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        config = context.config
        self.given = config.synergies.bundle is not None
        self.charged_frames = 0 if self.given else config.explore.frames
        if config.stage == "learn" and not self.given:
            raise ValueError(
                "stage=learn needs synergies=PATH, the run folder or bundle of an earlier "
                "exploration, or synergies=body; use stage=all to explore first."
            )
        if config.stage == "explore" and self.given:
            raise ValueError(
                f"stage=explore finds synergies, but synergies={config.synergies.bundle} was given;"
                " leave it out or use stage=learn."
            )
        with naming("learn.decoder"):
            check_real("[0, 1]", residual=config.learn.decoder.residual)
        self.of_body: SynergyDecoder | None = None
        if self.given:
            self._settle_given()
        self._settle_num_synergies()
        if (learn := config.learn).prefill is None:
            with naming("learn"):
                check_budget(learn.frames, learn.replay_ratio)
            learn.prefill = learn.replay_ratio >= 1  # below, it only did harm (log, 116 and 118)
        self.prefills = learn.prefill

    def _settle_given(self) -> None:
        """Check the given synergies; compute the body's, if asked for and not saved already."""
        config, space = self.context.config, self.context.spec
        given, own = config.synergies.bundle, self.context.folder.synergies
        kind = config.synergies.kind
        # Store the absolute path in the run's configuration.
        absolute = given if given == BODY else str(zoo.bundle_path(given).resolve())
        self.record_no_exploration(bundle=absolute)
        if ":" in str(kind):  # names the module of a user's own map, also for a resumed run
            config.synergies.kind = kind
        config.stage = "learn"
        if given == BODY and not surviving_folder(own).exists():
            with closing(self.context.make_env(seed=0)) as env:
                env.reset()
                self.of_body = body_synergies(env, config.num_synergies)
            config.num_synergies = self.of_body.num_synergies
            return
        _, info = self._load()
        config.num_synergies = info.num_synergies
        check_compatible(info, space.actuators, space.low.tolist(), space.high.tolist())

    def _settle_num_synergies(self) -> None:
        """Fill in a missing number of synergies; refuse more synergies than actuators."""
        config, actuators = self.context.config, self.context.spec.action_dim
        if config.num_synergies is None:
            config.num_synergies = default_num_synergies(actuators)
            if config.num_synergies < MOST_SYNERGIES:
                self.context.say(
                    f"num_synergies is {config.num_synergies}, as {config.env} has {actuators} "
                    "actuators."
                )
        elif config.num_synergies > actuators:
            raise ValueError(
                f"num_synergies is {config.num_synergies} but {config.env} has {actuators} "
                "actuators; choose at most that many, or null for a number that fits."
            )

    def check(self) -> None:
        if not self.given:
            explorer = Explorer(self.context)
            if explorer.selector.actions == "activation":
                self.context.make_env(activations=True).close()
            self._try_out(explorer.model)
        self.stage()

    def _try_out(self, model: SynergyModel) -> None:
        """Refuse a model whose bundle stage 2 cannot load, before stage 1 takes hours."""
        actions = self.context.spec.action_spec.rand((256,))
        if model.loss is None:
            model.fit(actions)
        with TemporaryDirectory(prefix="try-out-") as folder:
            model.save(folder, actions, task="try-out", actuators=self.context.spec.actuators)
            load_bundle(folder, residual=self.context.config.learn.decoder.residual)

    # Stage 1 -----------------------------------------------------------------------------------

    @property
    def bundle(self) -> Path:
        """Path of the synergies: in the run folder once saved there, before that as given."""
        own, given = self.context.folder.synergies, self.context.config.synergies.bundle
        if given is None or surviving_folder(own).exists():
            return own
        if (self.context.folder.path / "config.yaml").exists() and not Path(given).exists():
            raise FileNotFoundError(
                f"{self.context.folder.path} needs the synergies of {given}, which no longer "
                f"exists; copy that bundle to {own}."
            )
        return Path(given)

    def prepare(self, stop: StopOnSignal) -> Work[dict[str, Any]]:
        if self.of_body is not None:
            self._save(self.of_body, BODY, frames=0)
        elif self.given:  # keeps the run folder complete, wherever it is moved
            copy_bundle(self.bundle, self.context.folder.synergies)
        if not self.given and not surviving_folder(self.context.folder.synergies).exists():
            yield from self._explore(stop)
        _, info = self._load()
        return {"synergies": {"task": info.task, **info.facts}}

    def _explore(self, stop: StopOnSignal) -> Work[None]:
        """Explore and save a bundle in the run folder; its presence marks stage 1 as complete."""
        context, explorer = self.context, Explorer(self.context)
        stage = explorer.stage
        yield from context.run_stage(stage, stop)
        decoder = yield from explorer.condense(stop.check)
        numbers, warnings = describe_synergies(explorer.model, decoder, explorer.actions())
        try:
            if (embedded := explorer.exploration.embed(stage.newest(20_000))) is not None:
                numbers["direction_alignment"] = direction_alignment(*embedded)
        except Exception as error:  # in a user's class, after hours: still save the synergies
            warnings.append(f"the exploration could not embed its transitions ({error!r}).")
        numbers["frames"] = stage.frames
        for warning in warnings:
            context.say(f"Warning: {warning}")
        if context.config.pictures:
            self._draw(explorer, decoder, stop)
        if self.prefills:
            rows = explorer.transitions(decoder).flatten_keys(".").cpu()
            tensors = {key: value.contiguous() for key, value in rows.items()}
            write_atomically(context.folder.explored, safetensors.torch.save(tensors))
        self._save(decoder, explorer.model.kind, **numbers, seed=context.config.seed)

    def _save(self, decoder: SynergyMap, kind: str, **known: Any) -> None:
        """Save the bundle in the run folder."""
        config = self.context.config
        save_bundle(
            decoder,
            self.context.folder.synergies,
            task=resolve_task(config.env, config.goal).env_id,
            actuators=self.context.spec.actuators,
            kind=kind,
            facts={**known, **facts()},
        )

    def _draw(self, explorer: Explorer, decoder: SynergyMap, stop: StopOnSignal) -> None:
        from torchrl_etl.analysis import draw_synergies, embedding

        context, curve = self.context, self.context.options("vaf_curve")
        folder, updates = context.folder.pictures, curve.pop("updates")

        def make_model(d: int) -> SynergyModel:
            model = make_synergy_model(context, d)
            if model.updates is not None:
                model.updates = updates
            return model

        try:
            draw_synergies(
                make_model,
                decoder,
                explorer.actions(),
                context.spec.actuators,
                folder,
                **curve,
                on_update=stop.check,
            )
            if (embedded := explorer.exploration.embed(explorer.stage.newest(5000))) is not None:
                embedding(*embedded, folder / "embedding.png")
        except Exception as error:  # still save the synergies
            context.say(f"Warning: the pictures of the synergies could not be drawn ({error}).")

    # Stage 2 -----------------------------------------------------------------------------------

    def decoder(self) -> SynergyMap | None:
        """The decoder that was given, explored or computed, if it is available already."""
        there = self.given and self.of_body is None
        if there or surviving_folder(self.context.folder.synergies).exists():
            return self._load()[0]
        return None

    def explorer(self) -> Explorer:
        return Explorer(self.context)

    def frames_before(self) -> int:
        own = self.context.folder.synergies
        if not self.given and surviving_folder(own).exists():
            # Whole batches may exceed the budget of stage 1 by a few frames.
            return self._load()[1].facts["frames"]
        return super().frames_before()

    def _load(self) -> tuple[SynergyMap, BundleInfo]:
        kind = self.context.config.synergies.kind
        if module := str(kind).rpartition(":")[0]:  # a map of the user's own needs it
            with suppress(ImportError):
                import_user_module(module, repr(kind))
        return load_bundle(self.bundle, residual=self.context.config.learn.decoder.residual)

    def stage(self) -> Stage:
        decoder = self.decoder()
        return self.learn_stage(self._placeholder() if decoder is None else decoder)

    def learn_stage(self, decoder: SynergyMap) -> Stage:
        """Build stage 2 with this decoder."""
        options = self.context.options("learn")["decoder"]
        with naming("learn.decoder"):
            check_choice("fine_tuning", mode := options["fine_tuning"], get_args(FineTuning))
            if options["residual_std"] is not None:
                check_real("(0, inf)", residual_std=options["residual_std"])
                check_real("(0, 1]", residual=options["residual"])
        weight = {"frozen": 0.0, "reconstruction": 1.0}.get(mode, options["distillation_weight"])
        decoder = decoder.to(self.context.device).requires_grad_(mode != "frozen")
        with naming("learn.decoder"), renaming(weight="distillation_weight"):
            term = Term(DecoderLoss(decoder), weight=weight, lr=options["lr"])
        # The policy does not control the entropy of a residual with fixed noise.
        fixed = self._fixed_std
        entropy_dims = decoder.synergy_dim - fixed["fixed_std_dims"] if fixed else None
        self.context.seed_everything("learn")
        actor = self.context.actor(decoder=decoder, **fixed)
        loss = self.context.loss(
            actor,
            decoder=decoder,
            train_decoder=mode == "critic",
            entropy_spec=decoder.synergy_spec[:entropy_dims],
            entropy_dims=entropy_dims,
        )
        learner = self.context.learner(actor, decoder=decoder, loss=loss, terms=[term])
        room = self.context.config.explore.frames if self.prefills else 0
        return self.context.stage(learner, keep=("synergy",), prefill_size=room)

    def actor(self) -> dict[str, Any]:
        return {**super().actor(), **self._fixed_std}

    @property
    def _fixed_std(self) -> dict[str, Any]:
        """Arguments of the actor if the residual has a fixed standard deviation."""
        std = self.context.config.learn.decoder.residual_std
        if std is None:
            return {}
        return {"fixed_std_dims": self.context.spec.action_dim, "fixed_std": std}

    def begin(self, stage: Stage) -> None:
        if self.prefills:
            stage.prefill(self._explored(stage.learner.decoder))

    def _placeholder(self) -> SynergyDecoder:
        """An untrained decoder of the configured sizes."""
        spec, config = self.context.spec, self.context.config
        return SynergyDecoder(
            config.num_synergies,
            spec.action_dim,
            low=spec.low,
            high=spec.high,
            residual=config.learn.decoder.residual,
        )

    def _explored(self, decoder: SynergyMap) -> TensorDict:
        """Transitions saved by stage 1, with a residual of zero if the decoder has one."""
        file = self.context.folder.explored
        try:
            tensors = safetensors.torch.load(file.read_bytes())
        except (FileNotFoundError, safetensors.SafetensorError) as error:
            fault = "missing" if isinstance(error, FileNotFoundError) else f"damaged ({error})"
            raise OSError(
                f"{file} is {fault}, and stage 2 needs the transitions in it; start a new run "
                f"(with synergies={self.context.folder.path} to keep the same synergies)."
            ) from error
        rows = TensorDict(tensors, tensors["action"].shape[:1]).unflatten_keys(".")
        missing = decoder.synergy_dim - rows["synergy"].shape[-1]
        rows["synergy"] = nn.functional.pad(rows["synergy"], (0, missing))
        return rows.to(self.context.device)
