"""Adam that takes gradients as an argument, and the parameter groups of a learner."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import Adam, adam

from torchrl_etl.learners.term import Term

__all__ = ["GradientAdam", "make_optimizer", "parameter_groups"]


class GradientAdam(Adam):
    """:class:`torch.optim.Adam` that takes gradients as an argument, with one fused step.

    Adam loops over its parameters in Python at every step, which with cold caches takes twice as
    long as the step itself. Here the loop runs once for each set of parameters with a gradient, and
    its result is reused.

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
        """Learning rates in effect, known without a GPU synchronization."""
        return [self.factor * group["initial_lr"] for group in self.param_groups]

    def scale_rates(self, factor: float) -> None:
        """Set all learning rates to ``factor`` times their initial values."""
        self.factor = factor
        for group, rate in zip(self.param_groups, self.rates, strict=True):
            _set_rate(group, rate)

    @property
    def moments(self) -> list[Tensor]:
        """First and second moment of each parameter, in the order of the parameters."""
        return [state[key] for state in self._states for key in ("exp_avg", "exp_avg_sq")]

    @property
    def steps(self) -> list[Tensor]:
        """Step count of each parameter."""
        return [state["step"] for state in self._states]

    def steps_of(self, parameters: Iterable[Tensor]) -> int:
        """Largest step count among these parameters."""
        steps = [self.state[each]["step"] for each in parameters if each in self.state]
        return int(torch.stack(steps).max()) if steps else 0

    def mapped(self, other: Callable[[Tensor], Tensor]) -> GradientAdam:
        """A fresh optimizer with the same settings for ``other(parameter)`` of each parameter."""
        groups = [
            {**each, "params": list(map(other, each["params"]))} for each in self.param_groups
        ]
        return GradientAdam(groups)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state dict, also from another device; keeps this one's initial learning rates."""
        kept = ("lr", "initial_lr", "capturable")
        own = [{key: group[key] for key in kept} for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, before in zip(self.param_groups, own, strict=True):
            loaded = float(group["lr"])
            initial = group.get("initial_lr", loaded)
            self.factor = loaded / initial
            group |= before
            same = initial == group["initial_lr"]  # then free of the rounding of the factor
            _set_rate(group, loaded if same else self.factor * group["initial_lr"])
        for parameter, state in self.state.items():
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment] = _laid_out(state[moment], parameter)
        self._begin()

    @torch.no_grad()
    def step_along(self, gradients: Sequence[Tensor | None]) -> None:
        """Take a step along gradients in the order of the parameters; ``None`` skips one."""
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
        """Create the state that Adam creates at the first gradient of a parameter."""
        self._walked: dict[tuple[bool, ...], list[tuple[dict[str, Any], list[int], Any]]] = {}
        for parameter in self._parameters:
            if parameter not in self.state:
                step = torch.zeros((), dtype=torch.float32, device=parameter.device)
                moments = {key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")}
                self.state[parameter] = {"step": step, **moments}

    def _walk(self, absent: Sequence[bool]) -> list[tuple[dict[str, Any], list[int], Any]]:
        """Each group with the indices of its gradients, its parameters and their states."""
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


def parameter_groups(sac: nn.Module, terms: Sequence[Term], lr: float) -> list[dict[str, Any]]:
    """All trainable parameters, each once: those of terms at their own rates, then SAC's."""
    groups, known = [], set()
    of_terms = ((term.loss, lr if term.lr is None else term.lr) for term in terms)
    for module, rate in (*of_terms, (sac, lr)):
        fresh = [p for p in module.parameters() if p.requires_grad and id(p) not in known]
        known |= {id(parameter) for parameter in fresh}
        if fresh:
            groups.append({"params": fresh, "lr": rate})
    return groups


def make_optimizer(groups: Sequence[dict[str, Any]], device: torch.device) -> GradientAdam:
    """Fused Adam, which a CUDA graph can capture.

    On CUDA it keeps learning rates in tensors, so that they can change after the capture.
    """
    graphed = device.type == "cuda"
    if graphed:
        groups = [{**group, "lr": torch.tensor(group["lr"], device=device)} for group in groups]
    return GradientAdam(list(groups), fused=True, capturable=graphed)


def _set_rate(group: dict[str, Any], rate: float) -> None:
    """Set a learning rate, in place if it is a tensor, which a CUDA graph may read."""
    group["lr"] = group["lr"].fill_(rate) if isinstance(group["lr"], Tensor) else rate


def _laid_out(tensor: Tensor, parameter: Tensor) -> Tensor:
    """Copy a gradient or moment to the strides of its parameter if they differ: fused Adam (torch
    2.13) ignores strides on a CPU, and rejects differing ones on a GPU."""
    if tensor.stride() == parameter.stride():
        return tensor
    return torch.empty_like(parameter).copy_(tensor)
