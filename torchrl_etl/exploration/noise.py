"""Exploration without a policy: temporally correlated noise moves the muscles."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_etl.checks import check_choice, check_real
from torchrl_etl.envs import EnvironmentSpec
from torchrl_etl.exploration.exploration import Exploration
from torchrl_etl.modules.lasting_noise import HeldNormal, PinkNormal

__all__ = ["LastingNoise", "NoiseExploration"]

Color = Literal["pink", "held"]


class NoiseExploration(Exploration):
    """Acts by temporally correlated noise and trains no policy: the cheapest baseline.

    Keyword Args:
        color (str): ``"pink"``, see :class:`~torchrl_etl.modules.lasting_noise.PinkNormal`, or
            ``"held"``, see :class:`~torchrl_etl.modules.lasting_noise.HeldNormal`.
        std (float): standard deviation of the noise before the tanh.
        longest (int): steps of pink noise's slowest time constant, or of held noise's longest hold.
        exponent (float): exponent of the hold lengths, for held noise.
    """

    trains_policy = False

    def __init__(
        self, spec: EnvironmentSpec, *, color: Color, std: float, longest: int, exponent: float
    ) -> None:
        super().__init__(spec)
        check_choice("color", color, get_args(Color))
        check_real("(0, inf)", std=std)
        draw = HeldNormal(longest, exponent) if color == "held" else PinkNormal(longest)
        self._noise = LastingNoise(spec.low, spec.high, draw, std=std)

    def behavior(self, policy: TensorDictModuleBase) -> TensorDictModuleBase:
        return self._noise


class LastingNoise(TensorDictModuleBase):
    """Policy of temporally correlated noise, which reads only where episodes begin.

    Equation: a = tanh(std · x) where the bounds are [-1, 1].

    Args:
        low, high (Tensor): bounds of the action [n].
        draw (callable): returns the noise x [*, n] of a step, given a tensor like it and a mask of
            where episodes begin [*].

    Keyword Args:
        std (float): standard deviation before the tanh.

    Keys:
        reads ``is_init`` [*, 1]; writes ``action`` [*, n] in [low, high].

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_etl.modules.lasting_noise import PinkNormal
        >>> policy = LastingNoise(torch.zeros(2), torch.ones(2), PinkNormal(longest=64), std=1.0)
        >>> data = policy(TensorDict({"is_init": torch.ones(4, 1, dtype=torch.bool)}, [4]))
        >>> bool((data["action"] > 0).all() and (data["action"] < 1).all())
        True
    """

    low: Tensor
    high: Tensor

    def __init__(
        self, low: Tensor, high: Tensor, draw: HeldNormal | PinkNormal, *, std: float
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["is_init"], ["action"]
        self.draw, self.std = draw, std
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_init = tensordict.get("is_init").squeeze(-1)
        noise = self.draw(self.low.expand(*is_init.shape, -1), is_init)
        unit = (self.std * noise).tanh()
        action = self.low + (unit + 1) / 2 * (self.high - self.low)
        return tensordict.set("action", action)
