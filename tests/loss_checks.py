"""Checks that every loss of this library must pass: TorchRL's conventions for losses.

Subclass :class:`LossChecks` in a test file, say how to build the loss and a batch for it, and
pytest runs the whole list on it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import deepcopy
from typing import Any, ClassVar

import pytest
import torch
from tensordict import TensorDict, assert_close
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

SEED = 7


class LossChecks(ABC):
    """The check list of a loss module.

    Class attributes:
        default_keys: accepted keys with their defaults.
        trained: for each ``loss_*`` output, the parameter groups (first part of the parameter's
            name) that its gradient must reach; it must reach no other.
        targets: names of the target networks, such as ``target_encoder_params``.
        per_sample: outputs that have the batch's shape under ``reduction="none"``.
        optional_keys: in keys that a batch may lack.
        recorded: in keys that are data and targets to the loss: no gradient may flow into them.
        written: entries [*] that the loss leaves in its input.
        kept: parameters that a reset leaves as they are.
    """

    default_keys: ClassVar[dict[str, NestedKey]]
    trained: ClassVar[dict[str, set[str]]]
    targets: ClassVar[set[str]] = set()
    per_sample: ClassVar[set[str] | None] = None
    optional_keys: ClassVar[set[NestedKey]] = set()
    recorded: ClassVar[set[NestedKey]] = set()
    written: ClassVar[set[NestedKey]] = set()
    kept: ClassVar[set[str]] = set()

    @abstractmethod
    def make_loss(self, *, nested: bool = False, **kwargs: Any) -> LossModule:
        """A small loss; with ``nested`` it reads keys as ``make_data(nested=True)`` has them."""

    @abstractmethod
    def make_data(self, batch: tuple[int, ...] = (8,), *, nested: bool = False) -> TensorDict:
        """A batch for it; ``nested`` changes the keys and none of the numbers."""

    def seeded(self, build: Any, *args: Any, **kwargs: Any) -> Any:
        torch.manual_seed(SEED)
        return build(*args, **kwargs)

    def built(self, **kwargs: Any) -> LossModule:
        loss = self.seeded(self.make_loss, **kwargs)
        if self.targets:
            SoftUpdate(loss, tau=0.1)
        return loss

    def data(self, *args: Any, **kwargs: Any) -> TensorDict:
        return self.seeded(self.make_data, *args, **kwargs)

    def losses(self, out: TensorDict) -> dict[str, torch.Tensor]:
        return {key: value for key, value in out.items() if key.startswith("loss_")}

    # Outputs and inputs

    def test_writes_exactly_its_out_keys_and_they_are_finite(self) -> None:
        loss = self.built()
        out = loss(self.data())
        assert set(out.keys(True, True)) == set(loss.out_keys)
        assert set(self.losses(out)) == set(self.trained)
        assert all(value.isfinite().all() for value in out.values())

    def test_only_losses_carry_gradients(self) -> None:
        out = self.built()(self.data())
        for key, value in out.items():
            assert value.requires_grad == key.startswith("loss_"), key

    def test_needs_its_in_keys_and_nothing_else(self) -> None:
        loss, data = self.built(), self.data()
        assert_close(
            self.seeded(loss, data.select(*loss.in_keys, strict=False)), self.seeded(loss, data)
        )
        for key in set(loss.in_keys) - self.optional_keys:
            with pytest.raises((KeyError, AttributeError, RuntimeError, TypeError)):
                loss(data.exclude(key))

    def test_leaves_its_input_unchanged(self) -> None:
        loss, data = self.built(), self.data()
        before = data.clone()
        sum(value.sum() for value in self.losses(loss(data)).values()).backward()
        for written in [data.pop(key) for key in self.written]:
            assert written.shape == data.shape and not written.requires_grad
        assert set(data.keys(True, True)) == set(before.keys(True, True))
        assert_close(data, before)

    @pytest.mark.parametrize("batch", [(8,), (2, 4), (3, 1, 2)])
    def test_any_batch_shape(self, batch: tuple[int, ...]) -> None:
        for key, value in self.built()(self.data(batch)).items():
            assert value.shape == (), key

    def test_same_seed_same_value(self) -> None:
        loss, data = self.built(), self.data()
        assert_close(self.seeded(loss, data), self.seeded(loss, data))

    # Calls without a tensordict

    def test_dispatch_equals_the_tensordict_call(self) -> None:
        loss, data = self.built(), self.data()
        flat = {
            key if isinstance(key, str) else "_".join(key): data.get(key)
            for key in loss.in_keys
            if data.get(key, None) is not None
        }
        expected = self.seeded(loss, data)
        values = self.seeded(loss, **flat)
        values = values if isinstance(values, tuple) else (values,)
        for key, value in zip(loss.out_keys, values, strict=True):
            torch.testing.assert_close(value, expected.get(key))

    def test_selected_out_keys_are_all_that_dispatch_returns(self) -> None:
        loss, data = self.built(), self.data()
        expected = self.seeded(loss, data)
        key = next(iter(self.trained))
        loss.select_out_keys(key)
        flat = {
            name if isinstance(name, str) else "_".join(name): data.get(name)
            for name in loss.in_keys
            if data.get(name, None) is not None
        }
        torch.testing.assert_close(self.seeded(loss, **flat), expected.get(key))

    # Keys

    def test_default_keys(self) -> None:
        loss = self.built()
        assert {name: getattr(loss.tensor_keys, name) for name in self.default_keys} == (
            self.default_keys
        )

    def test_every_key_can_be_set_and_reset(self) -> None:
        loss = self.built()
        for name, default in self.default_keys.items():
            loss.set_keys(**{name: "elsewhere"})
            assert getattr(loss.tensor_keys, name) == "elsewhere"
            loss.set_keys(**{name: None})
            assert getattr(loss.tensor_keys, name) == default

    def test_unknown_key_is_refused(self) -> None:
        with pytest.raises(ValueError, match="not an accepted tensordict key"):
            self.built().set_keys(no_such_key="elsewhere")

    def test_nested_keys_give_the_same_numbers(self) -> None:
        flat, nested = self.built(), self.built(nested=True)
        data, nested_data = self.data(), self.data(nested=True)
        assert set(nested_data.keys(True, True)).isdisjoint(flat.in_keys)
        assert_close(self.seeded(flat, data), self.seeded(nested, nested_data))

    # Reductions

    def test_reductions_agree(self) -> None:
        data = self.data((2, 4))
        outs = {
            reduction: self.losses(self.seeded(self.built(reduction=reduction), data))
            for reduction in ("none", "mean", "sum")
        }
        per_sample = self.per_sample if self.per_sample is not None else set(self.trained)
        for key, values in outs["none"].items():
            if key in per_sample:
                assert values.shape == (2, 4), key
            torch.testing.assert_close(values.mean(), outs["mean"][key])
            if key in per_sample:
                torch.testing.assert_close(values.sum(), outs["sum"][key])

    def test_unknown_reduction_is_refused_at_construction(self) -> None:
        with pytest.raises((ValueError, NotImplementedError)):
            self.make_loss(reduction="average")

    def test_masked_samples_do_not_count(self) -> None:
        data = self.data((8,))
        mask = torch.arange(8) < 5
        kept = self.losses(self.seeded(self.built(reduction="none"), data))
        masked = data.clone().set(("collector", "mask"), mask.unsqueeze(-1))
        out = self.seeded(self.built(), masked)
        for key in self.per_sample if self.per_sample is not None else self.trained:
            torch.testing.assert_close(out[key], kept[key][mask].mean())

    # Parameters

    def test_gradients_reach_the_right_parameters_and_no_others(self) -> None:
        loss, data = self.built(), self.data()
        for key, groups in self.trained.items():
            loss.zero_grad()
            loss(data)[key].backward()
            reached = {
                name.split(".")[0]
                for name, parameter in loss.named_parameters()
                if parameter.grad is not None and parameter.grad.abs().sum() > 0
            }
            assert reached == groups, key

    def test_every_trained_parameter_gets_a_gradient(self) -> None:
        loss = self.built()
        sum(self.losses(loss(self.data())).values()).backward()
        groups = set().union(*self.trained.values())
        idle = [
            name
            for name, parameter in loss.named_parameters()
            if name.split(".")[0] in groups and parameter.grad is None
        ]
        assert not idle

    def test_gradients_do_not_reach_what_was_recorded(self) -> None:
        data = self.data().apply(lambda x: x.requires_grad_() if x.is_floating_point() else x)
        sum(self.losses(self.built()(data)).values()).backward()
        for key in self.recorded:
            assert data.get(key).grad is None, key

    def test_state_dict_round_trip_gives_the_same_losses(self) -> None:
        loss, data = self.built(), self.data()
        with torch.no_grad():
            for tensor in (*loss.parameters(), *loss.buffers()):
                if tensor.is_floating_point():
                    tensor.mul_(1.1)
        torch.manual_seed(SEED + 1)
        other = self.make_loss()
        if self.targets:
            SoftUpdate(other, tau=0.1)
        before = self.seeded(other, data)
        other.load_state_dict(loss.state_dict())
        after = self.seeded(other, data)
        assert_close(after, self.seeded(loss, data))
        assert any((before[key] != after[key]).any() for key in self.trained)

    def test_copies_are_independent(self) -> None:
        loss, data = self.built(), self.data()
        expected = self.seeded(loss, data)
        copy = deepcopy(loss)
        with torch.no_grad():
            for parameter in copy.parameters():
                parameter.add_(1.0)
        assert_close(self.seeded(loss, data), expected)

    def test_double_precision(self) -> None:
        loss, data = self.built().double(), self.data()
        data = data.apply(lambda x: x.double() if x.is_floating_point() else x)
        out = self.losses(loss(data))
        assert {value.dtype for value in out.values()} == {torch.float64}

    # Several seeds at once

    def test_vmap_over_stacked_parameters_gives_what_single_losses_give(self) -> None:
        losses = [self.built() for _ in range(3)]
        for parameter in (p for loss in losses for p in loss.parameters()):
            parameter.data += 0.05 * torch.randn_like(parameter)
        singles = [dict(TensorDict.from_module(loss).items(True, True)) for loss in losses]
        stacked = {key: torch.stack([one[key].data for one in singles]) for key in singles[0]}
        trained = {key for key, value in singles[0].items() if value.requires_grad}
        data = torch.stack([self.make_data() for _ in losses])

        def total(weights: Any, fixed: Any, batch: TensorDict) -> Any:
            with TensorDict(fixed | weights).to_module(losses[0]):
                out = self.losses(losses[0](batch))
            return sum(out.values()), out

        weights = {key: stacked.pop(key) for key in trained}
        # Every seed has the draws of a single loss.
        gradient = torch.vmap(torch.func.grad(total, has_aux=True), randomness="same")
        gradients, outs = self.seeded(gradient, weights, stacked, data)
        for i, (loss, single) in enumerate(zip(losses, singles, strict=True)):
            out = self.losses(self.seeded(loss, data[i].clone()))
            sum(out.values()).backward()
            for key, value in out.items():
                torch.testing.assert_close(outs[key][i], value.detach(), rtol=1e-4, atol=1e-5)
            for key in trained:
                expected = single[key].grad
                expected = torch.zeros_like(single[key]) if expected is None else expected
                torch.testing.assert_close(gradients[key][i], expected, rtol=1e-3, atol=1e-5)

    def test_vmap_with_different_randomness_draws_for_every_seed(self) -> None:
        """Copies of a batch differ only in draws; a loss without draws gives equal values."""
        loss, data = self.built(), self.data()
        draws = not all(
            torch.equal(first, second)
            for first, second in zip(
                self.losses(loss(data.clone())).values(),
                self.losses(loss(data.clone())).values(),
                strict=True,
            )
        )

        def forward(batch: TensorDict) -> TensorDict:
            return TensorDict(self.losses(loss(batch)))

        out = torch.vmap(forward, randomness="different")(data.expand(2, *data.shape).clone())
        assert draws == any((value[0] != value[1]).any() for value in out.values())

    def test_parameters_can_be_drawn_anew(self) -> None:
        loss = self.built()
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(1000.0)
        loss.reset_parameters_recursive()
        stale = {
            name
            for name, parameter in loss.named_parameters()
            if parameter.requires_grad and parameter.abs().max() > 500
        }
        assert stale == self.kept

    # Targets

    def test_targets_are_these_and_stand_still_until_updated(self) -> None:
        loss = self.seeded(self.make_loss)
        names = {name for name, _ in loss.named_children() if name.startswith("target_")}
        assert names == self.targets
        if not names:
            with pytest.raises(RuntimeError, match="target parameters"):
                SoftUpdate(loss, tau=0.1)
            return
        updater = SoftUpdate(loss, tau=0.5)
        pairs = {
            name: (getattr(loss, name.removeprefix("target_")), getattr(loss, name))
            for name in names
        }
        old = {name: target.data.clone() for name, (_, target) in pairs.items()}
        with torch.no_grad():
            for parameter in loss.parameters():
                parameter.add_(1.0)
        for name, (_, target) in pairs.items():
            assert_close(target.data, old[name])
            assert not any(value.requires_grad for value in target.values(True, True))
        updater.step()
        for name, (source, target) in pairs.items():
            for key, value in target.items(True, True):
                if source.get(key).requires_grad:
                    expected = (old[name].get(key) + source.get(key).detach()) / 2
                    torch.testing.assert_close(value.detach(), expected)

    def test_every_target_is_read(self) -> None:
        loss, data = self.built(), self.data()
        for name in self.targets:
            before = self.losses(self.seeded(loss, data))
            with torch.no_grad():
                for value in getattr(loss, name).values(True, True):
                    if value.is_floating_point():
                        value.mul_(1.5)
            after = self.losses(self.seeded(loss, data))
            assert any((before[key] != after[key]).any() for key in before), name

    def test_is_a_tensordict_module_with_key_lists(self) -> None:
        loss = self.built()
        assert isinstance(loss, TensorDictModuleBase)
        assert len(set(loss.in_keys)) == len(loss.in_keys)
        assert len(set(loss.out_keys)) == len(loss.out_keys)
