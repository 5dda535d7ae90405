"""SAR: its basis against scikit-learn's transforms, and its decoder in transforms and losses."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from sklearn.decomposition import PCA, FastICA
from sklearn.preprocessing import MinMaxScaler
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv, check_env_specs

from tests.configs import tiny
from tests.stages import update
from torchrl_etl.envs import make_env
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import SARDecoder, make_actor, make_critic
from torchrl_etl.objectives import DecoderLoss, SynergySACLoss
from torchrl_etl.synergies import SARSynergies
from torchrl_etl.transforms import SynergyAction

MUSCLES, SYNERGIES = 7, 3


def sources(rows: int = 500) -> Tensor:
    """Independent, non-Gaussian sources, which ICA can separate."""
    return torch.rand(rows, SYNERGIES, dtype=torch.float64) * 2 - 1


def planted(rows: int = 500, noise: float = 0.0) -> tuple[Tensor, Tensor, Tensor]:
    """Actions of three sources, their mixing matrix [3, n] and the mean [n]."""
    mixing = torch.randn(SYNERGIES, MUSCLES, dtype=torch.float64) * 0.2
    middle = torch.rand(MUSCLES, dtype=torch.float64) * 0.4 - 0.2
    actions = middle + sources(rows) @ mixing
    actions = (actions + noise * torch.randn_like(actions)).clamp(-1, 1)
    return actions, mixing, middle


def decode(decoder: SARDecoder, synergy: Tensor) -> Tensor:
    entry = TensorDict({decoder.in_keys[0]: synergy}, synergy.shape[:-1])
    return decoder(entry)[decoder.out_keys[0]]


def fitted(
    actions: Tensor,
    num: int,
    *,
    low: float = -1.0,
    high: float = 1.0,
    seed: int = 0,
    **options: Any,
) -> SARDecoder:
    """The published map of these actions, in their dtype."""
    bounds = (actions.new_full(actions.shape[-1:], bound) for bound in (low, high))
    model = SARSynergies(*bounds, num, seed=seed)
    model.fit(actions)
    return model.blended_decoder(actions, **options)


def by_hand(**kwargs: Any) -> SARDecoder:
    """Two synergies of three muscles."""
    basis = torch.tensor([[0.5, 0.0, -0.5], [0.0, 0.25, 0.25]])
    return SARDecoder.from_basis(torch.tensor([0.1, 0.2, 0.3]), basis, **kwargs)


# The basis ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("seed", [0, 1])
def test_decoding_equals_scikit_learns_inverse_transforms(noise: float, seed: int) -> None:
    actions, *_ = planted(noise=noise)
    decoder = fitted(actions, SYNERGIES, low=-9.0, high=9.0, blend=1.0, seed=seed)
    pca = PCA(SYNERGIES, random_state=seed)
    ica = FastICA(whiten="unit-variance", max_iter=1000, random_state=seed)
    scaler = MinMaxScaler((-1, 1))
    scaler.fit(ica.fit_transform(pca.fit_transform(actions.numpy())))
    synergy = torch.rand(50, SYNERGIES, dtype=torch.float64) * 2 - 1
    expected = pca.inverse_transform(
        ica.inverse_transform(scaler.inverse_transform(synergy.numpy()))
    )
    torch.testing.assert_close(
        decode(decoder, synergy), torch.as_tensor(expected), atol=1e-5, rtol=0
    )


def test_planted_synergies_are_found() -> None:
    """Each axis is one of the planted sources, up to order, sign and scale."""
    actions, mixing, middle = planted(rows=3000)
    decoder = fitted(actions, SYNERGIES, blend=1.0)
    found = torch.nn.functional.normalize(decoder.module.basis, dim=-1)
    cosines = (found @ torch.nn.functional.normalize(mixing, dim=-1).T).abs()
    assert (cosines.amax(1) > 0.98).all() and len(set(cosines.argmax(1).tolist())) == 3
    # Sources and coefficients both span [-1, 1].
    planted_sizes = mixing.norm(dim=-1)[cosines.argmax(1)]
    torch.testing.assert_close(decoder.module.basis.norm(dim=-1), planted_sizes, rtol=0.1, atol=0)
    torch.testing.assert_close(decoder.module.mean, middle, rtol=0, atol=0.05)


def test_planted_actions_are_reconstructed_by_coefficients_in_the_box() -> None:
    actions, *_ = planted()
    decoder = fitted(actions, SYNERGIES, blend=1.0)
    basis, mean = decoder.module.basis, decoder.module.mean
    synergy = torch.linalg.lstsq(basis.T, (actions - mean).T).solution.T
    torch.testing.assert_close(decode(decoder, synergy), actions, atol=1e-6, rtol=0)
    ones = torch.ones(SYNERGIES, dtype=torch.float64)
    torch.testing.assert_close(synergy.amax(0), ones, atol=1e-6, rtol=0)
    torch.testing.assert_close(synergy.amin(0), -ones, atol=1e-6, rtol=0)


def test_fitting_is_deterministic_keeps_dtype_and_leaves_the_rng_alone() -> None:
    actions = planted(noise=0.05)[0].float()
    before = torch.get_rng_state()
    one, other = (fitted(actions, SYNERGIES, seed=5) for _ in range(2))
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(one.module.basis, other.module.basis)
    assert one.module.basis.dtype == torch.float32 == one.low.dtype


# The decoder -------------------------------------------------------------------------------------


def test_blend_by_hand() -> None:
    decoder = by_hand(blend=0.6)
    # mean + (1, -0.4)·basis = (0.6, 0.1, -0.3); raw is (-1, 0.5, 1).
    synergy = torch.tensor([1.0, -0.4, -1.0, 0.5, 1.0])
    expected = torch.tensor([0.36 - 0.4, 0.06 + 0.2, -0.18 + 0.4])
    torch.testing.assert_close(decode(decoder, synergy), expected)


def test_raw_actions_are_in_the_units_of_the_bounds() -> None:
    decoder = by_hand(blend=0.6, low=[0.0, 0.0, -2.0], high=[1.0, 1.0, 4.0])
    # The raw (-1, 0.5, 1) of a policy is the action (0, 0.75, 4).
    synergy = torch.tensor([1.0, -0.4, -1.0, 0.5, 1.0])
    expected = torch.tensor([0.36, 0.06 + 0.3, -0.18 + 1.6])
    torch.testing.assert_close(decode(decoder, synergy), expected)


def test_decoding_without_residual_by_hand() -> None:
    decoder = by_hand(blend=1.0)
    assert decoder.synergy_dim == 2 and not decoder.residual
    action = decode(decoder, torch.tensor([[1.0, -0.4], [0.0, 0.0]]))
    torch.testing.assert_close(action, torch.tensor([[0.6, 0.1, -0.3], [0.1, 0.2, 0.3]]))


def test_coefficients_of_any_dtype_are_decoded_in_that_of_the_basis() -> None:
    decoder = SARDecoder(SYNERGIES, MUSCLES, blend=0.5)
    synergy = torch.rand(2, SYNERGIES + MUSCLES, dtype=torch.float64)
    assert torch.equal(decoder(synergy), decoder(synergy.float()))


@pytest.mark.parametrize("blend", [1.0, 0.66])
def test_actions_stay_in_the_bounds_and_reach_them(blend: float) -> None:
    basis = 5 * torch.randn(2, 3, generator=torch.Generator().manual_seed(0))
    low, high = torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 1.0, 3.0])
    decoder = SARDecoder.from_basis(torch.zeros(3), basis, low=low, high=high, blend=blend)
    action = decode(decoder, decoder.synergy_spec.rand((500,)))
    assert ((action >= low) & (action <= high)).all()
    assert (action == low).any(0).all() and (action == high).any(0).all()


def test_attributes_are_those_of_a_synergy_decoder() -> None:
    decoder = by_hand()
    assert (decoder.num_synergies, decoder.action_dim, decoder.synergy_dim) == (2, 3, 5)
    assert decoder.residual == pytest.approx(0.34)
    assert (decoder.in_keys, decoder.out_keys) == (["synergy"], ["action"])
    spec = decoder.synergy_spec
    assert spec.shape == (5,) and (spec.space.low == -1).all() and (spec.space.high == 1).all()
    assert decoder.low.tolist() == [-1] * 3 and decoder.high.tolist() == [1] * 3


def test_decoder_has_no_parameters() -> None:
    decoder = by_hand()
    assert not list(decoder.parameters())
    assert {name for name, _ in decoder.named_buffers()} == {
        f"module.{name}" for name in ("mean", "basis", "low", "high")
    }


def test_gradients_flow_through_to_the_coefficients() -> None:
    synergy = torch.zeros(5, requires_grad=True)
    decode(by_hand(blend=0.6), synergy)[0].backward()
    torch.testing.assert_close(synergy.grad, torch.tensor([0.3, 0.0, 0.4, 0.0, 0.0]))


def test_state_dict_round_trip() -> None:
    one = by_hand(low=[-1.0, -2.0, -3.0])
    other = SARDecoder(2, 3)
    other.load_state_dict(one.state_dict())
    synergy = one.synergy_spec.rand((9,))
    assert torch.equal(decode(other, synergy), decode(one, synergy))
    assert torch.equal(other.low, one.low)


def test_decoder_shares_no_memory_with_inputs_or_copies() -> None:
    mean, basis = torch.zeros(3), torch.ones(2, 3)
    decoder = SARDecoder.from_basis(mean, basis)
    copied = copy.deepcopy(decoder)
    for tensor in (mean, basis, decoder.module.mean):
        tensor.fill_(9)
    assert not copied.module.mean.any() and (copied.module.basis == 1).all()
    assert (decoder.module.basis == 1).all()


def test_spec_and_bounds_follow_the_device() -> None:
    decoder = by_hand().to("meta")
    assert decoder.synergy_spec.device.type == "meta" and decoder.low.is_meta


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_nested_keys_and_batch_shapes(batch: tuple[int, ...]) -> None:
    flat = by_hand()
    nested = by_hand(in_keys=[("agent", "z")], out_keys=[("agent", "a")])
    synergy = torch.rand(*batch, 5)
    out = nested(TensorDict({"agent": {"z": synergy}}, batch))
    assert out["agent", "a"].shape == (*batch, 3)
    assert torch.equal(out["agent", "a"], decode(flat, synergy))


# Bad input ---------------------------------------------------------------------------------------


def test_bad_arguments_are_refused() -> None:
    for blend in (0.0, 1.1, -0.5):
        with pytest.raises(ValueError, match=rf"blend is {blend}"):
            by_hand(blend=blend)
    with pytest.raises(ValueError, match=r"mean has shape \[3\] and basis \[2, 4\]"):
        SARDecoder.from_basis(torch.zeros(3), torch.zeros(2, 4))
    with pytest.raises(ValueError, match="every lower bound must be finite and below"):
        by_hand(low=1.0, high=1.0)
    with pytest.raises(ValueError, match=r"shape \(2,\) but there are 3 actuators"):
        by_hand(low=[0.0, 0.0])


def test_actions_that_cannot_be_fitted_are_refused() -> None:
    actions, *_ = planted()
    with pytest.raises(ValueError, match="vary in 3 dimensions are too few for 4 synergies"):
        fitted(actions, 4)
    with pytest.raises(ValueError, match="vary in 1 dimensions are too few for 2 synergies"):
        fitted(actions[:2], 2)
    with pytest.raises(ValueError, match=r"have 2 row.*at least 3 different actions"):
        fitted(actions[:2], 3)
    with pytest.raises(ValueError, match=r"the bounds are \[0, 1\]; scale the actions to these"):
        fitted(actions, 3, low=0.0, high=1.0)
    with pytest.raises(ValueError, match="NaN or infinity"):
        fitted(torch.where(actions > 0.3, torch.nan, actions), 3)
    with pytest.raises(ValueError, match=r"num_synergies is 0"):
        fitted(actions, 0)


# In transforms, losses and stage 2 ---------------------------------------------------------------


def overactuated_decoder(blend: float) -> SARDecoder:
    activity = torch.rand(300, 2) @ torch.randn(2, 16)
    return fitted((0.3 * activity).clamp(-1, 1), 2, blend=blend)


@pytest.mark.parametrize("blend", [1.0, 0.66])
def test_composes_with_synergy_action(blend: float) -> None:
    decoder = overactuated_decoder(blend)
    env = TransformedEnv(make_env("overactuated", num_envs=2, seed=0), SynergyAction(decoder))
    check_env_specs(env)
    rollout = env.rollout(3)
    assert rollout["synergy"].shape == (2, 3, decoder.synergy_dim)
    executed = rollout["next", "executed_action"]
    torch.testing.assert_close(executed, decode(decoder, rollout["synergy"]))


@pytest.mark.parametrize("blend", [1.0, 0.66])
def test_composes_with_synergy_sac(blend: float) -> None:
    decoder = overactuated_decoder(blend)
    actor = make_actor({"observation": 6}, decoder.synergy_spec, out_key="synergy", hidden=(8,))
    critic = make_critic({"observation": 6, "action": 16}, hidden=(8,))
    loss = SynergySACLoss(
        actor, critic, decoder, train_decoder=False, action_spec=decoder.synergy_spec
    )
    batch = TensorDict({"observation": torch.randn(8, 6), "action": torch.zeros(8, 16)}, [8])
    batch["next"] = {
        "observation": torch.randn(8, 6),
        "reward": torch.randn(8, 1),
        "done": torch.zeros(8, 1, dtype=torch.bool),
        "terminated": torch.zeros(8, 1, dtype=torch.bool),
    }
    loss.make_value_estimator(gamma=0.9)
    before = {key: value.clone() for key, value in decoder.state_dict().items()}
    loss(batch)["loss_actor"].backward()
    reached = {
        name.split(".")[0]
        for name, parameter in loss.named_parameters()
        if parameter.grad is not None and parameter.grad.abs().sum() > 0
    }
    assert reached == {"actor_network_params"}
    assert not list(loss.decoder_network_params.parameters())
    for key, value in decoder.state_dict().items():
        assert torch.equal(value, before[key]), key


def test_decoder_loss_of_decoded_actions_is_zero() -> None:
    decoder = overactuated_decoder(0.66)
    synergy = decoder.synergy_spec.rand((8,))
    batch = TensorDict({"synergy": synergy, "action": decode(decoder, synergy)}, [8])
    assert DecoderLoss(decoder)(batch)["loss_decoder"] == 0


@pytest.mark.parametrize("blend", [1.0, 0.66])
def test_stage_2_trains_the_actor_and_keeps_the_sar_decoder(blend: float) -> None:
    decoder = overactuated_decoder(blend)
    overrides = ("run_dir=unused", "learn.decoder.fine_tuning=frozen")
    stage = Experiment(tiny(*overrides)).method.learn_stage(decoder)
    stage.restart_collection()
    try:
        for _ in range(4):
            batch = stage.collect()
        actor = {key: value.clone() for key, value in stage.learner.actor.state_dict().items()}
        fixed = {key: value.clone() for key, value in decoder.state_dict().items()}
        torch.testing.assert_close(batch["action"], decode(decoder, batch["synergy"]))
        assert update(stage)["loss_decoder"] < 1e-10
        assert any(
            not torch.equal(v, actor[k]) for k, v in stage.learner.actor.state_dict().items()
        )
        assert all(torch.equal(v, fixed[k]) for k, v in decoder.state_dict().items())
    finally:
        stage.close()


@pytest.mark.parametrize("blend", [0.66, 1.0])
def test_encode_inverts_decode_inside_the_bounds(blend: float) -> None:
    decoder = SARDecoder.from_basis(
        torch.tensor([0.4, 0.5, 0.6]),
        torch.tensor([[0.2, 0.0, 0.1], [0.0, 0.1, -0.1]]),
        low=0.0,
        blend=blend,
    )
    synergy = torch.zeros(50, decoder.synergy_dim)
    synergy[:, :2] = 2 * torch.rand(50, 2) - 1
    found = decoder.encode(decode(decoder, synergy))
    torch.testing.assert_close(found, synergy[:, :2], atol=1e-5, rtol=0)


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
def test_encode_with_nearly_parallel_components_is_the_nearest_in_the_box(
    batch: tuple[int, ...],
) -> None:
    basis = torch.tensor([[0.5, 0.0, 0.5], [0.5, 0.01, 0.5]])
    decoder = SARDecoder.from_basis(torch.zeros(3), basis, blend=1.0)
    action = torch.tensor([0.25, 0.05, 0.25]).expand(*batch, 3)
    found = decoder.encode(action)
    # Without the box: (-4.5, 5), whose clamped values (-1, 1) cancel.
    assert found.shape == (*batch, 2)
    torch.testing.assert_close(found, torch.tensor([-0.5, 1.0]).expand_as(found), atol=1e-3, rtol=0)


def test_log_slope_is_the_log_determinant_inside_the_bounds() -> None:
    decoder = by_hand(blend=0.6)
    row = torch.tensor([0.2, -0.1, 0.3, 0.1, -0.2])
    found = torch.func.jacrev(decoder.module)(row)[:, 2:].slogdet().logabsdet
    middle = 3 * torch.tensor(0.4).log()  # half of a range of 2 is 1
    torch.testing.assert_close(decoder.log_slope(row), found - middle)
    assert decoder.log_slope(row.expand(4, 5)).tolist() == [0.0] * 4
