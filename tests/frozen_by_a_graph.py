"""Policies that a traced graph would not reproduce: 6 observations, 16 actions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Normal
from torchrl.data import Bounded
from torchrl.modules import Actor, OrnsteinUhlenbeckProcessModule, ProbabilisticActor

SPEC = Bounded(-1, 1, shape=(3, 16))
act = partial(TensorDictModule, in_keys=["observation"], out_keys=["action"])


class Odd(nn.Linear):
    """A layer with a number, a call count and a branch in Python, and a second method."""

    def __init__(self) -> None:
        super().__init__(6, 16)
        self.gain, self.calls = 1.0, 0

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        sign = 1.0 if observation.mean() > 0.1 else -1.0
        return sign * self.gain * super().forward(observation) / self.calls

    def doubled(self, observation: torch.Tensor) -> torch.Tensor:
        return 2 * super().forward(observation)


class Difference(nn.Module):
    def forward(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return x - 2 * y


class Moody(Normal):
    def rsample(self, sample_shape=()):
        return self.loc if int(1000 * self.loc.sum()) % 2 else -self.loc


class Doubled(TensorDictSequential):
    def forward(self, tensordict):
        return super().forward(tensordict).update({"action": 2 * tensordict["action"]})


def hooked(policy: TensorDictModule) -> TensorDictModule:
    policy.register_forward_hook(lambda _, __, out: out.set("action", -out["action"]))
    return policy


def hooked_inside(policy: TensorDictModule) -> TensorDictModule:
    policy.module[0].register_forward_pre_hook(lambda _, inputs: (inputs[0].clamp_min(0),))
    return policy


def linear() -> TensorDictModule:
    return act(nn.Sequential(nn.Linear(6, 16), nn.Tanh()))


def difference() -> TensorDictSequential:
    two = TensorDictModule(nn.Linear(6, 16), in_keys=["observation"], out_keys=["other"])
    keys = {"y": "action", "x": "other"}
    return TensorDictSequential(
        linear(), two, TensorDictModule(Difference(), keys, ["action"], out_to_in_map=True)
    )


def dropped() -> TensorDictModule:
    layers = nn.Sequential(nn.Linear(6, 32), NormalParamExtractor())
    return TensorDictModule(layers, in_keys=["observation"], out_keys=["action", "_"])


def normed(momentum: float | None) -> TensorDictModule:
    return act(nn.Sequential(nn.BatchNorm1d(6, momentum=momentum), nn.Linear(6, 16)))


def wide() -> nn.Linear:
    layer = nn.Linear(6, 16)
    nn.init.normal_(layer.weight, std=50.0)
    return layer


def noisy() -> TensorDictSequential:
    return TensorDictSequential(linear(), OrnsteinUhlenbeckProcessModule(spec=SPEC.clone()))


def actor(distribution: type[Normal], **kwargs: object) -> ProbabilisticActor:
    layers = nn.Sequential(nn.Linear(6, 32), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(layers, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=distribution,
        **kwargs,
    )


def partly() -> TensorDictSequential:
    of_a_goal = TensorDictModule(nn.Linear(2, 2), in_keys=["goal"], out_keys=["embedded"])
    return TensorDictSequential(linear(), of_a_goal, partial_tolerant=True)


MAKERS: dict[str, Callable[[], nn.Module]] = {
    "Python in forward": lambda: act(Odd()),
    "another method": lambda: act(Odd(), method="doubled"),
    "a function": lambda: act(lambda x: x.repeat(1, 3)[:, :16].clone()),
    "inputs by name": difference,
    "safe": lambda: Actor(wide(), in_keys=["observation"], spec=SPEC, safe=True),
    "a hook": lambda: hooked(linear()),
    "a sequence of its own": lambda: Doubled(linear()),
    "partly tolerant": partly,
    "an output to drop": dropped,
    "noise in the tensordict": noisy,
    "a distribution of its own": lambda: actor(Moody),
    "its own random numbers": lambda: actor(Normal, generator=torch.Generator().manual_seed(3)),
}

CHANGES: dict[str, tuple[Callable[[], nn.Module], Callable[[nn.Module], object]]] = {
    "evaluation": (
        lambda: act(nn.Sequential(nn.Linear(6, 16), nn.Dropout(0.5))),
        lambda policy: policy.eval(),
    ),
    "a number": (lambda: act(Odd()), lambda policy: setattr(policy.module, "gain", 0.0)),
    "another layer": (linear, lambda policy: policy.module.__setitem__(1, nn.ReLU())),
    "a hook": (linear, hooked_inside),
    "evaluation by means of late": (lambda: normed(0.1), lambda policy: policy.eval()),
    "evaluation by means of all": (lambda: normed(None), lambda policy: policy.eval()),
}
