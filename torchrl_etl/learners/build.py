"""Build a learner from the sections of a configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, TypeAlias, get_args

from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torchrl.data import Bounded

from torchrl_etl.checks import check_choice, check_flag, naming
from torchrl_etl.learners.objective import NORMALIZED
from torchrl_etl.learners.parts import entropy_target
from torchrl_etl.learners.sac import SACLearner
from torchrl_etl.modules import (
    HeldNoise,
    RunningNorm,
    SynergyMap,
    UniformWarmup,
    make_actor,
    make_critic,
)

__all__ = ["Noise", "build_learner"]

Noise = Literal["independent", "held"]
Actor: TypeAlias = ProbabilisticTensorDictSequential


def build_learner(
    observation_dim: int,
    action_spec: Bounded,
    *,
    actor: Mapping[str, Any],
    critic: Mapping[str, Any],
    sac: Mapping[str, Any],
    noise: Mapping[str, Any],
    init_random_actions: int = 0,
    decoder: SynergyMap | None = None,
    inputs: Mapping[str, int] | None = None,
    make_actor: Callable[..., Actor] = make_actor,
    make_behavior: Callable[[Actor], TensorDictModuleBase] | None = None,
    wrap_behavior: Callable[[TensorDictModuleBase], TensorDictModuleBase] = lambda policy: policy,
    entropy: Callable[[Bounded, float | None], float] = entropy_target,
    extra_options: Callable[[Actor], Mapping[str, Any]] = lambda actor: {},
) -> SACLearner:
    """Build networks for an environment and the learner that owns them.

    Args:
        observation_dim (int): size of an observation.
        action_spec (Bounded): the environment's action spec, unbatched; its device is the
            learner's.

    Keyword Args:
        actor, critic (mapping): keyword arguments of ``make_actor`` and
            :func:`~torchrl_etl.modules.make_critic`.
        sac (mapping): keyword arguments of :class:`~torchrl_etl.learners.SACLearner`, and
            ``action_std`` (see :func:`~torchrl_etl.learners.entropy_target`) and
            ``normalize_observations`` (actor and critics read observations normalized by
            :class:`~torchrl_etl.modules.RunningNorm`).
        noise (mapping): ``kind`` of exploration noise, ``"independent"`` at each step or ``"held"``
            for several, and keyword arguments of :class:`~torchrl_etl.modules.HeldNoise`.
        init_random_actions (int): number of first actions of each worker that are drawn uniformly
            from the bounds of the actor's output. Default: 0.
        decoder (SynergyMap, optional): maps actor outputs to actions. Default: they are actions.
        inputs (mapping, optional): sizes of network inputs besides the observation, by key.
        make_actor (callable): builds the actor. Default: :func:`~torchrl_etl.modules.make_actor`.
        make_behavior (callable, optional): builds the behavior policy from the actor; ``noise`` is
            then ignored.
        wrap_behavior (callable): wraps the behavior policy, noise included.
        entropy (callable): maps the spec of actor outputs and ``action_std`` to a target entropy.
        extra_options (callable): maps the actor to additional arguments of the learner.

    Raises:
        ValueError: if an argument is invalid; the message names it.
    """
    sac, device = dict(sac), action_spec.device
    with naming("sac"):
        check_flag(normalize_observations=(norm := sac.pop("normalize_observations")))
    normalizer = RunningNorm(observation_dim).to(device) if norm else None
    inputs = {NORMALIZED if norm else "observation": observation_dim, **(inputs or {})}
    if decoder is None:
        emitted, out_key = action_spec, "action"
    else:
        emitted, out_key = decoder.to(device).synergy_spec, decoder.in_keys[0]
    with naming("actor"):
        policy = make_actor(inputs, emitted, out_key=out_key, **actor).to(device)
    with naming("critic"):
        value = make_critic({**inputs, "action": action_spec.shape[-1]}, **critic).to(device)
    explore = make_behavior or partial(with_noise, **noise)
    behavior, options = wrap_behavior(explore(policy)), dict(extra_options(policy))
    if init_random_actions:
        warmup = UniformWarmup(emitted, init_random_actions, action_key=out_key)
        behavior = TensorDictSequential(behavior, warmup)
        options["on_restart"] = [*options.get("on_restart", ()), partial(setattr, warmup, "seen")]
    with naming("sac"):
        return SACLearner(
            policy,
            value,
            action_spec=emitted,
            decoder=decoder,
            behavior=behavior,
            normalizer=normalizer,
            target_entropy=entropy(emitted, sac.pop("action_std")),
            bins=critic.get("bins", 1),
            **sac,
            **options,
        )


def with_noise(actor: Actor, *, kind: Noise, **options: Any) -> TensorDictModuleBase:
    """The actor with exploration noise, drawn at every step or held for several."""
    with naming("noise"):
        check_choice("kind", kind, get_args(Noise))
        return HeldNoise(actor, **options) if kind == "held" else actor
