"""Exploration noise that lasts."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import TanhNormal

from torchrl_etl.modules.lasting_noise import HeldNormal

__all__ = ["HeldNoise"]


class HeldNoise(TensorDictModuleBase):
    """An actor whose noise is held for several steps: it moves a body where white noise shakes it.

    The action is that of the actor's own distribution, with its standard normal variable as
    :class:`~torchrl_etl.modules.lasting_noise.HeldNormal` draws it. Each step's action is
    distributed as before; only the correlation over time is new, and off-policy learners need not
    know of it.

    The noise is this module's own, by row of the batch: it must be called with the same simulators
    in the same order, as a collector does. Under any other exploration type than random it is the
    actor itself.

    Args:
        actor (ProbabilisticTensorDictSequential): with a ``TanhNormal``, as of
            :func:`~torchrl_etl.modules.make_actor`.

    Keyword Args:
        exponent (float): above 0; the larger, the shorter. Default: 2.
        longest (int): most steps. Default: 16.
        init_key (NestedKey): see :class:`torchrl.envs.InitTracker`. Default: ``"is_init"``.

    Keys:
        reads the actor's, and ``is_init`` [*, 1], where noise is drawn anew; writes the actor's,
        but for a log-probability.

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
        kind = getattr(kind, "func", kind)  # of a partial
        if not (isinstance(kind, type) and issubclass(kind, TanhNormal)):
            raise ValueError(
                f"The actor draws from {getattr(kind, '__name__', kind)}; noise is held in a "
                "TanhNormal, such as make_actor's."
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
        begins = tensordict.get(self.init_key, None)
        if begins is None:
            raise KeyError(
                f"HeldNoise reads {self.init_key!r}, which the data lacks; give the environment an "
                "InitTracker()."
            )
        noise = self._draw(distribution.loc, begins.squeeze(-1))
        action = distribution.loc + distribution.scale * noise
        for transform in distribution.transforms:
            action = transform(action)
        return tensordict.set(self.actor.dist_sample_keys[0], action)
