"""Relabeling of collected transitions with other directions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right, unravel_key
from torchrl.envs.transforms import Transform

from torchrl_etl.checks import check_real
from torchrl_etl.objectives.checks import read
from torchrl_etl.transforms.direction import DirectionPrimer

__all__ = ["RedrawDirection"]


class RedrawDirection(Transform):
    """Relabels sampled transitions with newly drawn directions.

    Eq. 1 rewards any transition along any direction. An off-policy learner can therefore learn for
    directions that were not followed, as hindsight experience replay does for goals. A few thousand
    frames follow only dozens of directions; relabeled transitions serve any direction.

    Append it to a replay buffer, before :class:`IntrinsicReward` if both are used, or call it on
    transitions of any batch size. The buffer's contents are not changed.

    Deviates: Algorithm 1 learns from the direction that was followed; ``share=0`` is as printed.

    Args:
        primer (DirectionPrimer): draws the directions and names their key.

    Keyword Args:
        share (float): probability that a transition gets a new direction, in [0, 1]. Default: 1.

    Keys:
        rewrites ``direction`` [*, k] and ``("next", "direction")`` with the same direction.

    Raises:
        ValueError: if the share is outside [0, 1].
        RuntimeError: in an environment, where :class:`DirectionPrimer` draws directions.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.transforms import DirectionPrimer, RedrawDirection
        >>> primer = DirectionPrimer(2, kind="orthonormal", num_directions=1)
        >>> followed = torch.tensor([[0.0, 1.0]])
        >>> step = TensorDict({"direction": followed, "next": {"direction": followed}}, [1])
        >>> RedrawDirection(primer)(step)["next", "direction"]
        tensor([[1., 0.]])
    """

    def __init__(self, primer: DirectionPrimer, *, share: float = 1.0) -> None:
        check_real("[0, 1]", share=share)
        super().__init__(in_keys=primer.out_keys, out_keys=primer.out_keys)
        self.primer, self.share = primer, share

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        (key,) = self.in_keys
        following = unravel_key(("next", key))
        followed, _ = (read("RedrawDirection", tensordict, each) for each in (key, following))
        shape = followed.shape[:-1]  # in a group of agents, one each
        drawn = self.primer.draw(shape, followed.device)
        again = torch.rand(shape, device=followed.device) < self.share
        direction = torch.where(expand_as_right(again, drawn), drawn, followed)
        return tensordict.set(key, direction).set(following, direction.clone())

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "RedrawDirection is for sampled transitions: append it to a replay buffer, and use "
            "DirectionPrimer in an environment."
        )
