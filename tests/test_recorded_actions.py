"""Recorded actions as NumPy arrays, lists and tensors of any type."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_etl.modules import GMVAE, SynergyDecoder
from torchrl_etl.modules.recorded_actions import as_actions
from torchrl_etl.objectives import GMVAELoss
from torchrl_etl.synergies import fit_gmvae
from torchrl_etl.synergies.gmvae import component_shares

ACTIONS = np.tanh(np.random.default_rng(0).normal(size=(64, 2)) @ np.ones((2, 4)))
WITH_NAN = ACTIONS.copy()
WITH_NAN[[3, 7], 1] = np.nan


def gmvae() -> GMVAE:
    torch.manual_seed(0)
    return GMVAE(4, 2, hidden=(8,))


def uses():
    """Functions of a model and recorded actions, with one signature."""
    yield "fit_gmvae", lambda model, actions: fit_gmvae(model, actions, updates=2)
    yield "from_gmvae", lambda model, actions: SynergyDecoder.from_gmvae(model, actions)
    yield "encode", lambda model, actions: SynergyDecoder.from_gmvae(model).encode(actions)


USES = [pytest.param(use, id=name) for name, use in uses()]


def numbers(made) -> torch.Tensor:
    tensors = [made] if isinstance(made, torch.Tensor) else made.state_dict().values()
    return torch.cat([tensor.flatten() for tensor in tensors])


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize(
    "given",
    [
        pytest.param(ACTIONS, id="NumPy, double"),
        pytest.param(torch.from_numpy(ACTIONS), id="double"),
        pytest.param(ACTIONS.tolist(), id="lists"),
        pytest.param(ACTIONS.astype(np.float16).astype(np.float32)[::-1][::-1], id="strided"),
        pytest.param(ACTIONS.reshape(8, 8, 4), id="by episode"),
        pytest.param(ACTIONS[::-1, ::-1], id="reversed"),
        pytest.param(ACTIONS.astype(">f8"), id="big-endian"),
        pytest.param(ACTIONS.astype(np.longdouble), id="long double"),
        pytest.param(list(torch.from_numpy(ACTIONS)), id="list of tensors"),
    ],
)
def test_any_array_type_gives_the_result_of_a_float_tensor(use, given):
    reference = torch.from_numpy(np.array(given, np.float64)).float()
    torch.manual_seed(1)
    expected = numbers(use(gmvae(), reference))
    torch.manual_seed(1)
    assert torch.equal(numbers(use(gmvae(), given)), expected)
    assert expected.isfinite().all()


@pytest.mark.parametrize("use", USES)
def test_integers_and_constant_columns_give_finite_numbers(use):
    integers = np.sign(ACTIONS).astype(np.int64)
    assert numbers(use(gmvae(), integers)).isfinite().all()
    constant = ACTIONS.copy()
    constant[:, 2] = 0.3
    assert numbers(use(gmvae(), constant)).isfinite().all()


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (ACTIONS[:, :3], ValueError, r"shape \(64, 3\), but there are 4 actuators; pass an array"),
        (ACTIONS[:, 0], ValueError, "but there are 4 actuators"),
        (WITH_NAN, ValueError, "NaN or infinity in 2 of 64 rows, the first in row 3"),
        (100 * ACTIONS, ValueError, r"bounds are \[-1, 1\]; scale the actions to these bounds"),
        (np.array([["a"] * 4]), TypeError, "not an array of real numbers"),
        (ACTIONS * 1j, TypeError, "not an array of real numbers"),
        (torch.from_numpy(ACTIONS * 1j), TypeError, "complex"),
        (np.ma.masked_greater(ACTIONS, 0.9), ValueError, "masked values; leave their rows out"),
    ],
)
def test_unusable_array_is_refused_and_leaves_the_model_unchanged(use, given, error, message):
    model = gmvae()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(error, match=message):
        use(model, given)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"updates": 0}, "updates is 0; it must be a whole number, 1 or more"),
        ({"updates": 2, "batch_size": 0}, "batch_size is 0"),
        ({"updates": 2, "loss": GMVAELoss(gmvae())}, "loss is for another GMVAE"),
    ],
)
def test_invalid_fit_options_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        fit_gmvae(gmvae(), ACTIONS, **options)


def test_gmvae_reconstructs_numpy_and_double_arrays():
    model = gmvae()
    expected = model.reconstruct(torch.from_numpy(ACTIONS).float())
    for given in (ACTIONS, torch.from_numpy(ACTIONS)):
        assert torch.equal(model.reconstruct(given), expected)
        assert component_shares(model, given).sum().item() == pytest.approx(1)


@pytest.mark.parametrize("use", USES[:2])
def test_fit_refuses_one_row_and_warns_of_identical_rows(use):
    with pytest.raises(ValueError, match=r"1 row\(s\), too few to find synergies"):
        use(gmvae(), ACTIONS[:1])
    with pytest.warns(UserWarning, match="9 actions are the same"):
        assert numbers(use(gmvae(), np.zeros((9, 4)))).isfinite().all()


@pytest.mark.parametrize("use", USES[:2])
def test_actions_in_far_smaller_units_than_the_bounds_are_warned_of(use):
    with pytest.warns(UserWarning, match="pass the model low= and high= in the units"):
        use(gmvae(), 1e-3 * np.abs(ACTIONS) - 1)


def test_one_action_is_enough_to_encode():
    assert SynergyDecoder.from_gmvae(gmvae()).encode(ACTIONS[0]).shape == (2,)


def test_small_overshoot_of_the_bounds_is_accepted():
    low, high = torch.zeros(4), torch.ones(4)
    assert as_actions(np.full((1, 4), 1.05), low=low, high=high).max() > 1
    with pytest.raises(ValueError, match=r"between 1\.2 and 1\.2"):
        as_actions(np.full((1, 4), 1.2), low=low, high=high)


def test_from_gmvae_takes_more_rows_than_torch_quantile():
    actions = torch.rand(9_000_000, 2)
    decoder = SynergyDecoder.from_gmvae(GMVAE(2, 2, 1, hidden=(2,)), actions)
    assert decoder.module.scale.isfinite().all()
