"""Exploration noise that is held over several steps."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import TanhNormal

from torchrl_etl.modules.lasting_noise import HeldNormal

__all__ = ["HeldNoise"]


class HeldNoise(TensorDictModuleBase):
    """Actor that holds its noise for several steps, which moves a body more than white noise does.

    It samples the actor's own distribution, with the standard normal noise of
    :class:`~torchrl_etl.modules.lasting_noise.HeldNormal`. The distribution of each step's action
    is unchanged; only the correlation over time is new. Off-policy learners need no change.

    The noise is kept per row of the batch. Every call must have the same simulators in the same
    order, as in a collector. Under an exploration type other than random the actor runs unchanged.

    Args:
        actor (ProbabilisticTensorDictSequential): actor with a ``TanhNormal``, such as from
            :func:`~torchrl_etl.modules.make_actor`.

    Keyword Args:
        exponent (float): exponent of the hold lengths, above 0; larger is shorter. Default: 2.
        longest (int): longest hold, in steps. Default: 16.
        init_key (NestedKey): see :class:`torchrl.envs.InitTracker`. Default: ``"is_init"``.

    Keys:
        reads the actor's in-keys and ``is_init`` [*, 1], where noise is redrawn; writes the actor's
        out-keys, except for a log-probability.

    Raises:
        ValueError: if exponent or longest are not positive, or the actor is no tanh-Gaussian.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_etl.modules import HeldNoise, make_actor
        >>> policy = HeldNoise(make_actor({"observation": 3}, Bounded(-1, 1, shape=(2,))))
        >>> entries = {"observation": torch.zeros(4, 3), "is_init": torch.ones(4, 1).bool()}
        >>> policy(TensorDict(entries, [4]))["action"].shape
        torch.Size([4, 2])
    """

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        *,
        exponent: float = 2.0,
        longest: int = 16,
        init_key: NestedKey = "is_init",
    ) -> None:
        kind = actor[-1].distribution_class
        kind = getattr(kind, "func", kind)  # unwraps a partial
        if not (isinstance(kind, type) and issubclass(kind, TanhNormal)):
            raise ValueError(
                f"The actor samples from {getattr(kind, '__name__', kind)}; held noise needs a "
                "TanhNormal, as from make_actor."
            )
        super().__init__()
        self.actor, self.init_key = actor, init_key
        self.in_keys = [*actor.in_keys, init_key]
        self.out_keys = [key for key in actor.out_keys if key not in actor.log_prob_keys]
        self._draw = HeldNormal(longest, exponent)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if exploration_type() not in (None, ExplorationType.RANDOM):
            return self.actor(tensordict)
        distribution = self.actor.get_dist(tensordict)
        is_init = tensordict.get(self.init_key, None)
        if is_init is None:
            raise KeyError(
                f"HeldNoise reads {self.init_key!r}, which the data lacks; give the environment an "
                "InitTracker()."
            )
        noise = self._draw(distribution.loc, is_init.squeeze(-1))
        action = distribution.loc + distribution.scale * noise
        for transform in distribution.transforms:
            action = transform(action)
        return tensordict.set(self.actor.dist_sample_keys[0], action)
