"""Every kind of synergies, against factors planted in the actions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.configs import tiny
from tests.stages import explorer, update
from torchrl_etl.analysis import describe_synergies, draw_synergies, variance_accounted_for
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.synergies import (
    SYNERGY_MODELS,
    GMVAESynergies,
    SynergyModel,
    fit_synergies,
    load_bundle,
)
from torchrl_etl.training import run_alone

AFFINE = ("pca", "nmf", "sar")
FEW = {"gmvae": {"updates": 20, "hidden": (8,)}, "vae": {"updates": 20, "hidden": (8,)}}


def activity(rows: int = 400) -> Tensor:
    """Activity of six muscles in [0, 1], mixed from two nonnegative sources."""
    return torch.rand(rows, 2) @ (torch.rand(2, 6) / 2)


def fitted(kind: str, actions: Tensor) -> SynergyModel:
    return fit_synergies(actions, kind, 2, low=0.0, high=1.0, **FEW.get(kind, {}))


def linear(decoder: nn.Module) -> nn.Linear:
    (layer,) = (module for module in decoder.modules() if isinstance(module, nn.Linear))
    return layer


def test_pca_recovers_two_directions_and_their_ranges_before_tanh() -> None:
    center, basis = torch.randn(16) / 4, torch.linalg.qr(torch.randn(16, 2)).Q.mT
    coefficients = (2 * torch.rand(20_000, 2) - 1) * torch.tensor([1.2, 0.4])
    actions = (center + coefficients @ basis).tanh()
    layer = linear(fit_synergies(actions, "pca", 2).decoder(actions))
    # Columns span 98 % of a uniform range; the larger comes first, signs are arbitrary.
    sizes = layer.weight.norm(dim=0)
    torch.testing.assert_close(sizes, 0.98 * torch.tensor([1.2, 0.4]), rtol=0.02, atol=0)
    overlap = (layer.weight.mT / sizes[:, None]) @ basis.mT
    torch.testing.assert_close(overlap.abs(), torch.eye(2), rtol=0, atol=0.02)
    torch.testing.assert_close(layer.bias, center, rtol=0, atol=0.02)


def test_pca_of_a_known_covariance_keeps_its_larger_variance() -> None:
    """Rows ±(3, 3) and ±(1, -1), over ten: variances 9 : 1 along the diagonals."""
    before = torch.tensor([[3.0, 3.0], [-3.0, -3.0], [1.0, -1.0], [-1.0, 1.0]]) / 10
    model = fit_synergies(before.tanh(), "pca", 1)
    torch.testing.assert_close(model.basis.abs(), torch.full((1, 2), 0.5**0.5))
    torch.testing.assert_close(model.mean, torch.zeros(2))
    kept = torch.tensor([[3.0, 3.0], [-3.0, -3.0], [0.0, 0.0], [0.0, 0.0]]) / 10
    torch.testing.assert_close(model.reconstruct(before.tanh()), kept.tanh(), atol=1e-6, rtol=0)


def test_actions_at_the_bounds_give_a_finite_decoder() -> None:
    actions = torch.ones(100, 16)
    actions[::2] = -1.0
    decoder = fit_synergies(actions, "pca", 1).decoder(actions)
    ends = decoder.module(torch.tensor([[-1.0], [1.0]]))
    assert ends.isfinite().all()
    torch.testing.assert_close(ends.abs(), torch.full((2, 16), 0.99), atol=1e-4, rtol=0)


def test_nmf_recovers_planted_factors() -> None:
    """Each source is alone in some rows and in one muscle, so the factorization is unique."""
    parts = torch.tensor([[0.8, 0.0, 0.4, 0.2], [0.0, 0.6, 0.3, 0.9]])
    weights = torch.rand(600, 2) / 2
    weights[:100, 0] = 0.0
    weights[100:200, 1] = 0.0
    low = torch.tensor([-1.0, 0.0, 2.0, -1.0])
    actions = low + weights @ parts
    model = fit_synergies(actions, "nmf", 2, low=low, high=low + 2)
    assert (model.basis >= 0).all()
    found = nn.functional.normalize(model.basis, dim=-1)
    found = found[found[:, 0].argsort(descending=True)]
    torch.testing.assert_close(found, nn.functional.normalize(parts, dim=-1), atol=0.02, rtol=0)
    assert variance_accounted_for(actions, model.reconstruct(actions)) > 0.999


@pytest.mark.parametrize("kind", AFFINE)
def test_the_unit_of_a_recording_does_not_change_its_synergies(kind: str) -> None:
    actions = activity() + 0.05 * torch.rand(400, 6)
    model = fitted(kind, actions)
    for unit in (1e-6, 1e6):
        other = fit_synergies(unit * actions, kind, 2, low=0.0, high=unit)
        expected = unit * model.reconstruct(actions)
        found = other.reconstruct(unit * actions)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-3 * unit)


@pytest.mark.parametrize(("kind", "origin"), [("nmf", "low"), ("sar", "mean")])
def test_decoder_has_the_models_slope_at_mid_range(kind: str, origin: str) -> None:
    """Models of actions: a = origin + c·basis."""
    actions = activity()
    model = fitted(kind, actions)
    decoder = model.decoder(actions)
    ends = model.coefficients(actions).quantile(torch.tensor([0.01, 0.99]), dim=0)
    at = torch.zeros(2)
    middle = getattr(model, origin) + ends.mean(0) @ model.basis
    torch.testing.assert_close(decoder.module(at), middle)
    slope = torch.autograd.functional.jacobian(decoder.module, at)
    torch.testing.assert_close(slope.mT, (ends[1] - ends[0])[:, None] / 2 * model.basis)


def test_sar_recovers_independent_sources_with_unit_variance() -> None:
    """Two sources of ±1, every combination equally often: the mixing matrix is recovered."""
    signs = torch.cartesian_prod(torch.tensor([-1.0, 1.0]), torch.tensor([-1.0, 1.0])).repeat(50, 1)
    mixing = torch.tensor([[0.3, 0.1, 0.0], [0.1, -0.3, 0.2]])
    middle = torch.tensor([0.1, 0.2, 0.3])
    model = fit_synergies(middle + signs @ mixing, "sar", 2)
    torch.testing.assert_close(model.mean, middle)
    found = model.basis[model.basis[:, 2].abs().argsort()]  # order and signs are arbitrary
    torch.testing.assert_close(found.abs(), mixing.abs(), atol=1e-3, rtol=0)
    coefficients = model.coefficients(middle + signs @ mixing)
    torch.testing.assert_close(
        coefficients.mT @ coefficients / 200, torch.eye(2), atol=1e-3, rtol=0
    )


def test_sar_with_constant_components_keeps_an_orthonormal_basis() -> None:
    """One source of three muscles: one component of three varies."""
    actions = torch.rand(200, 1) @ torch.tensor([[0.5, 0.3, 0.1]])
    model = fit_synergies(actions, "sar", 3, low=0.0, high=1.0)
    torch.testing.assert_close(model.basis @ model.basis.mT, torch.eye(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(model.reconstruct(actions), actions, atol=1e-5, rtol=0)


def test_nmf_keeps_a_resting_muscle_at_rest() -> None:
    actions = activity()
    actions[:, 3] = 0.0
    decoder = fitted("nmf", actions).decoder(actions)
    moved = decoder.module(2 * torch.rand(200, 2) - 1)
    assert moved[:, 3].max() < 0.01
    assert moved.isfinite().all()


def test_gmvae_refit_starts_over_and_uses_the_loss_weights() -> None:
    actions, bounds = activity(), (torch.zeros(6), torch.ones(6))

    def rebuilt(model: SynergyModel) -> Tensor:
        torch.manual_seed(1)
        model.fit(actions)
        return model.reconstruct(actions)

    for weight in ("kl_weight", "component_kl_weight"):
        plain, other = (
            SYNERGY_MODELS["gmvae"](*bounds, 2, **FEW["gmvae"], **{weight: w}) for w in (1, 9)
        )
        first = rebuilt(plain)
        assert torch.equal(rebuilt(plain), first)
        assert not torch.equal(rebuilt(other), first)


def test_vae_is_bit_identical_to_a_gmvae_of_one_component() -> None:
    actions = activity()
    torch.manual_seed(1)
    one = fitted("vae", actions)
    torch.manual_seed(1)
    other = fit_synergies(actions, "gmvae", 2, low=0.0, high=1.0, num_components=1, **FEW["gmvae"])
    assert one.model.num_components == 1
    assert torch.equal(one.reconstruct(actions), other.reconstruct(actions))


@pytest.mark.parametrize("kind", SYNERGY_MODELS)
def test_any_array_type_is_fitted_and_invalid_arrays_are_refused(kind: str) -> None:
    actions = activity().double().numpy()
    decoder = fitted(kind, actions).decoder(actions)
    assert decoder.low.tolist() == [0.0] * 6 and decoder.num_synergies == 2
    rebuilt = fitted(kind, actions.tolist()).reconstruct(actions)
    assert rebuilt.shape == (400, 6) and rebuilt.dtype == torch.float32
    actions[3, 1] = np.nan
    with pytest.raises(ValueError, match="NaN or infinity in 1 of 400 rows, the first in row 3"):
        fitted(kind, actions)
    with pytest.raises(ValueError, match="scale the actions to these bounds"):
        fitted(kind, activity() + 9)
    with pytest.raises(ValueError, match=r"only 6 actuators; choose at most 6"):
        fit_synergies(activity(), kind, 7, low=0.0, high=1.0)
    with pytest.raises(ValueError, match=r"shape \(3,\) but there are 6 actuators"):
        fit_synergies(activity(), kind, 2, low=[0.0] * 3, high=1.0)


def test_options_may_be_numpy_numbers(tmp_path) -> None:
    options = {"lr": np.float32(1e-3), "updates": np.int64(2), "hidden": [np.int64(8)]}
    model = fit_synergies(activity(), "gmvae", np.int64(2), low=0.0, high=1.0, **options)
    model.save(tmp_path / "b", activity(), task="toy", actuators=list("abcdef"))
    assert load_bundle(tmp_path / "b")[1].num_synergies == 2
    with pytest.raises(ValueError, match="num_components is True"):
        fit_synergies(activity(), "gmvae", 2, num_components=True)


def test_updates_of_a_model_that_does_not_train_are_refused() -> None:
    with pytest.raises(TypeError, match="updates is 7, but PCASynergies does not train"):
        fit_synergies(activity(), "pca", 2, low=0.0, high=1.0, updates=7)
    for kind in ("gmvae", "vae"):
        assert fit_synergies(activity(), kind, 2, low=0.0, high=1.0, updates=7).updates == 7


def test_unknown_kind_is_refused_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="nmf"):
        fit_synergies(activity(), "nfm")


@pytest.mark.parametrize("kind", AFFINE)
def test_use_before_fit_is_refused(kind: str) -> None:
    model = SYNERGY_MODELS[kind](torch.zeros(6), torch.ones(6), 2)
    for use in (model.decoder, model.reconstruct):
        with pytest.raises(RuntimeError, match=rf"The {kind} has no synergies yet; call fit"):
            use(activity())


@pytest.mark.parametrize("kind", AFFINE)
@pytest.mark.filterwarnings("ignore:All 50 actions are the same")
def test_identical_actions_give_a_finite_decoder(kind: str) -> None:
    for value in (0.0, 0.3):
        actions = torch.full((50, 6), value)
        decoder = fitted(kind, actions).decoder(actions)
        assert decoder.module(torch.ones(2)).isfinite().all()


@pytest.mark.parametrize("kind", SYNERGY_MODELS)
def test_every_kind_is_described_and_drawn_under_its_name(kind: str, tmp_path) -> None:
    actions = activity()
    numbers, warnings = describe_synergies(
        model := fitted(kind, actions), model.decoder(actions), actions
    )
    assert {"vaf", "pca_vaf", "nmf_vaf", "control_authority"} <= set(numbers)
    assert not any("GMVAE" in words for words in warnings) or kind == "gmvae"
    bounds = torch.zeros(6), torch.ones(6)
    draw_synergies(
        lambda d: SYNERGY_MODELS[kind](*bounds, d, **FEW.get(kind, {})),
        model.decoder(actions),
        actions,
        list("abcdef"),
        tmp_path,
        dims=[1, 2],
    )
    assert {file.name for file in tmp_path.iterdir()} == {"synergies.png", "vaf.png"}


def test_describe_reports_a_collapsed_mixture() -> None:
    model = GMVAESynergies(-torch.ones(6), torch.ones(6), 2, num_components=4)
    final = model.model.encoder[-1]
    with torch.no_grad():
        final.weight[:4] = 0.0
        final.bias[:4] = 0.0
    numbers, faults = model.describe(torch.rand(10, 6))
    assert numbers == {"effective_components": pytest.approx(4.0, abs=1e-4)} and not faults
    final.bias.data[2] = 50.0
    actions = torch.rand(9000, 6)  # more than one chunk
    numbers, faults = describe_synergies(model, model.decoder(actions), actions)
    assert numbers["effective_components"] == pytest.approx(1.0, abs=1e-4)
    assert "collapsed: 1.0 of its 4 components are in use, the largest for 100%" in faults[-1]


def test_describe_reports_no_collapse_of_one_component() -> None:
    model = SYNERGY_MODELS["vae"](-torch.ones(6), torch.ones(6), 2)
    assert model.describe(torch.rand(10, 6)) == ({"effective_components": pytest.approx(1.0)}, [])


@pytest.mark.parametrize("kind", SYNERGY_MODELS)
def test_both_stages_run_with_every_kind(kind: str, tmp_path) -> None:
    run = tmp_path / "run"
    pictures = f"pictures={str(kind in AFFINE).lower()}"
    settings = (f"synergies={kind}", "vaf_curve.dims=[1]", "learn.prefill=true")
    settings += ("explore.frames=192", "learn.frames=64", "evaluation.episodes=1")
    experiment = Experiment(tiny(f"run_dir='{run}'", *settings, pictures))
    summary = experiment.run()
    assert summary["learn"]["frames"] == 64
    assert load_bundle(run)[0].num_synergies == 2


@pytest.mark.parametrize("kind", AFFINE)
def test_affine_synergies_add_no_loss_to_stage_1(kind: str) -> None:
    found = explorer(f"synergies={kind}")
    assert found.model.loss is None and not len(found.fitter.objective.terms)
    for _ in range(6):
        found.stage.collect()
    update(found.stage)
    decoder = run_alone(found.condense())
    assert torch.equal(run_alone(found.condense())(torch.ones(2)), decoder(torch.ones(2)))
    found.stage.close()


@pytest.mark.parametrize("kind", SYNERGY_MODELS)
def test_bundle_round_trip_preserves_encode_and_decode(kind: str, tmp_path) -> None:
    actions = activity()
    model = fitted(kind, actions)
    decoder, facts = model.decoder(actions, residual=0.5), {"rows": len(actions)}
    model.save(tmp_path / "b", actions, task="toy", actuators=list("abcdef"), facts=facts)
    copy, info = load_bundle(tmp_path / "b", residual=0.5)
    assert info.kind == kind and info.facts == facts and info.format_version == 2
    components = None if info.encoder is None else info.encoder["num_components"]
    assert components == {"gmvae": 2, "vae": 1}.get(kind)
    synergy = 2 * torch.rand(20, 8) - 1
    assert torch.equal(copy(synergy), decoder(synergy))
    assert torch.equal(copy.encode(actions), decoder.encode(actions))
    assert copy.state_dict().keys() == decoder.state_dict().keys()


@pytest.mark.parametrize("kind", AFFINE)
def test_encode_inverts_decode(kind: str) -> None:
    actions = activity()
    for residual in (0.0, 0.5):
        decoder = fitted(kind, actions).decoder(actions, residual=residual)
        synergy = 2 * torch.rand(3, 50, 2) - 1
        silent = torch.zeros(3, 50, decoder.synergy_dim - 2)
        found = decoder.encode(decoder(torch.cat([synergy, silent], -1)))
        torch.testing.assert_close(found, synergy, atol=1e-3, rtol=0)
    assert decoder.encode(actions.numpy()).abs().max() <= 1


@pytest.mark.parametrize("kind", SYNERGY_MODELS)
def test_log_slope_is_the_log_determinant_relative_to_mid_range(kind: str) -> None:
    actions = activity()
    decoder = fitted(kind, actions).decoder(actions, residual=0.4).double()
    for row in 2 * torch.rand(3, 8, dtype=torch.float64) - 1:
        found = torch.func.jacrev(decoder.module)(row)[:, 2:].slogdet().logabsdet
        middle = 6 * torch.tensor(0.4 / 2, dtype=torch.float64).log()
        torch.testing.assert_close(decoder.log_slope(row), found - middle)


@pytest.mark.parametrize(("section", "kind"), [("synergies", "nmf"), ("exploration", "metra")])
def test_kind_with_the_options_of_another_is_refused(section: str, kind: str) -> None:
    config = tiny("run_dir=unused")
    config[section].kind = kind
    with pytest.raises(ValueError, match=rf"choose {section}={kind}, which brings its own"):
        Explorer(Experiment(config).context)
