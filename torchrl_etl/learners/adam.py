"""Adam that is handed its gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import Adam, adam

__all__ = ["GradientAdam"]


class GradientAdam(Adam):
    """:class:`torch.optim.Adam` whose step takes gradients, all parameters in one operation.

    Adam walks its parameters in Python at every step. Between products that fill a processor's
    caches this takes twice as long as the step itself; here they are walked once for every choice
    of parameters that have a gradient.

    Examples:
        >>> import torch
        >>> from torchrl_etl.learners.adam import GradientAdam
        >>> weight = torch.nn.Parameter(torch.tensor([1.0]))
        >>> optimizer = GradientAdam([weight], lr=0.1, fused=True)
        >>> for _ in range(2):  # the first steps are as long as the learning rate
        ...     optimizer.step_along([torch.tensor([5.0])])
        >>> weight
        Parameter containing:
        tensor([0.8000], requires_grad=True)
    """

    factor = 1.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        for group in self.param_groups:
            group.setdefault("initial_lr", float(group["lr"]))
        self._begin()

    @property
    def rates(self) -> list[float]:
        """The learning rates that :meth:`scale_rates` set, without asking a GPU."""
        return [self.factor * group["initial_lr"] for group in self.param_groups]

    def scale_rates(self, factor: float) -> None:
        """Set all learning rates to a share of those that they began with."""
        self.factor = factor
        for group, rate in zip(self.param_groups, self.rates, strict=True):
            _set_rate(group, rate)

    @property
    def moments(self) -> list[Tensor]:
        """Both moments of each parameter, in their order."""
        return [state[key] for state in self._states for key in ("exp_avg", "exp_avg_sq")]

    @property
    def steps(self) -> list[Tensor]:
        """The number of steps that each parameter has had."""
        return [state["step"] for state in self._states]

    def steps_of(self, parameters: Iterable[Tensor]) -> int:
        """The most steps that one of these parameters has had."""
        steps = [self.state[each]["step"] for each in parameters if each in self.state]
        return int(torch.stack(steps).max()) if steps else 0

    def over(self, other: Callable[[Tensor], Tensor]) -> GradientAdam:
        """The same for other parameters than these, before its first step."""
        groups = [
            {**each, "params": list(map(other, each["params"]))} for each in self.param_groups
        ]
        return GradientAdam(groups)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the state of another one, perhaps of another device; what rates began with stays."""
        kept = ("lr", "initial_lr", "capturable")
        own = [{key: group[key] for key in kept} for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, before in zip(self.param_groups, own, strict=True):
            loaded = float(group["lr"])
            self.factor = loaded / group.get("initial_lr", loaded)
            group |= before
            _set_rate(group, loaded)
        for parameter, state in self.state.items():
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment] = _laid_out(state[moment], parameter)
        self._begin()

    @torch.no_grad()
    def step_along(self, gradients: Sequence[Tensor | None]) -> None:
        """One step along gradients in the order of the parameters; ``None`` leaves its own."""
        absent = tuple(gradient is None for gradient in gradients)
        if absent not in self._walked:
            self._walked[absent] = self._walk(absent)
        for group, at, (parameters, *moments, steps) in self._walked[absent]:
            beta1, beta2 = group["betas"]
            own = [gradients[i] for i in at]
            adam(
                parameters,
                [_laid_out(*each) for each in zip(own, parameters, strict=True)],
                *moments,
                [],
                steps,
                fused=True,
                amsgrad=False,
                beta1=beta1,
                beta2=beta2,
                **{name: group[name] for name in ("lr", "weight_decay", "eps", "maximize")},
            )

    @property
    def _parameters(self) -> list[Tensor]:
        return [parameter for group in self.param_groups for parameter in group["params"]]

    @property
    def _states(self) -> list[dict[str, Tensor]]:
        return [self.state[parameter] for parameter in self._parameters]

    def _begin(self) -> None:
        """As Adam begins where a parameter has its first gradient."""
        self._walked: dict[tuple[bool, ...], list[tuple[dict[str, Any], list[int], Any]]] = {}
        for parameter in self._parameters:
            if parameter not in self.state:
                step = torch.zeros((), dtype=torch.float32, device=parameter.device)
                moments = {key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")}
                self.state[parameter] = {"step": step, **moments}

    def _walk(self, absent: Sequence[bool]) -> list[tuple[dict[str, Any], list[int], Any]]:
        """Each group, which gradients are its own, and what a step of their parameters changes."""
        parameters, index, walked = self._parameters, 0, []
        for group in self.param_groups:
            at = [i for i, _ in enumerate(group["params"], index) if not absent[i]]
            index += len(group["params"])
            own = [parameters[i] for i in at]
            states = [self.state[parameter] for parameter in own]
            kept = [[state[key] for state in states] for key in ("exp_avg", "exp_avg_sq", "step")]
            if own:
                walked.append((group, at, [own, *kept]))
        return walked


def _set_rate(group: dict[str, Any], rate: float) -> None:
    """Set a learning rate; a CUDA graph reads it from a tensor, and from that same tensor."""
    group["lr"] = group["lr"].fill_(rate) if isinstance(group["lr"], Tensor) else rate


def _laid_out(tensor: Tensor, parameter: Tensor) -> Tensor:
    """A gradient or a moment, in memory as its parameter is: fused Adam (torch 2.13) takes no
    notice of strides on a CPU, and refuses others on a GPU."""
    if tensor.stride() == parameter.stride():
        return tensor
    return torch.empty_like(parameter).copy_(tensor)
