"""RunningNorm: mean and deviation of all values seen, for any division into batches."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch

from torchrl_etl.modules import RunningNorm
from torchrl_etl.modules.running_deviation import RunningDeviation

SEEN = torch.tensor([[1.0, -3.0, 7.0], [2.0, 5.0, 7.0], [6.0, 1.0, 7.0], [3.0, 9.0, 7.0]])


@pytest.mark.parametrize("cuts", [(), (1,), (1, 3)])
def test_output_is_standardized_by_all_values_seen(cuts):
    norm = RunningNorm(3)
    for part in SEEN.tensor_split(cuts):
        norm.update_moments(part)
    expected = (SEEN - SEEN.mean(0)) / SEEN.std(0, correction=0)
    torch.testing.assert_close(norm(SEEN)[:, :2], expected[:, :2])


def test_constant_entry_is_only_centered():
    norm = RunningNorm(3)
    norm.update_moments(SEEN)
    assert norm(torch.tensor([0.0, 0.0, 8.0]))[2] == 1.0


def test_batches_of_any_shape_count_as_rows():
    norm, flat = RunningNorm(3), RunningNorm(3)
    norm.update_moments(SEEN.view(2, 2, 3))
    flat.update_moments(SEEN)
    torch.testing.assert_close(norm(SEEN.view(2, 2, 3)), flat(SEEN).view(2, 2, 3))


@pytest.mark.parametrize(
    "take", [RunningNorm(3).update_moments, RunningDeviation(decay=0.9).update]
)
def test_an_empty_batch_changes_nothing(take):
    take(SEEN)
    before = deepcopy(take.__self__.state_dict())
    take(SEEN[:0])
    for name, value in take.__self__.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_integers_are_normalized_like_floats():
    norm = RunningNorm(3)
    norm.update_moments(SEEN.long() * 3 + 1)
    assert torch.equal(norm(SEEN.long()), norm(SEEN))


def test_output_is_unchanged_before_any_value_is_seen():
    assert torch.equal(RunningNorm(3)(SEEN), SEEN)


def test_outliers_are_clipped():
    norm = RunningNorm(3, clip=2.0)
    norm.update_moments(SEEN)
    assert norm(SEEN + 1e6).max() == 2.0


def test_statistics_change_only_in_update_moments_and_survive_a_round_trip():
    norm, other = RunningNorm(3), RunningNorm(3)
    norm.update_moments(SEEN)
    before = norm(SEEN)
    norm.train()(SEEN * 100)
    other.load_state_dict(norm.state_dict())
    assert torch.equal(norm(SEEN), before) and torch.equal(other(SEEN), before)


@pytest.mark.parametrize(
    ("size", "kwargs", "words"), [(0, {}, "size is 0"), (3, {"clip": 0.0}, "clip is 0")]
)
def test_unusable_settings_are_refused(size, kwargs, words):
    with pytest.raises(ValueError, match=words):
        RunningNorm(size, **kwargs)
