"""Synergy bundles: an exact round trip through the disk, and errors of one sentence."""

import copy
import hashlib
import json
import os
import pickle
import shutil

import numpy as np
import pytest
import safetensors.torch
import torch
from tensordict import TensorDict

from torchrl_etl.envs import actuator_names, make_env
from torchrl_etl.modules import GMVAE, SARDecoder, SynergyDecoder
from torchrl_etl.synergies import (
    BundleError,
    BundleInfo,
    check_compatible,
    copy_bundle,
    load_bundle,
    save_bundle,
)

NAMES = ("biceps", "triceps", "deltoid", "soleus", "psoas")
LOW, HIGH = [0.0, -1.0, 0.0, 0.1, 0.0], [1.0, 1.0, 2.0, 0.7, 1.0]


def actions(rows):
    """Random actions between the bounds of the decoder."""
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    return low + torch.rand(rows, 5) * (high - low)


def fitted_decoder(seed=0, **kwargs):
    torch.manual_seed(seed)
    gmvae = GMVAE(5, 2, num_components=3, low=LOW, high=HIGH, hidden=(8, 16))
    return SynergyDecoder.from_gmvae(gmvae, actions(64), **kwargs)


def save(decoder, path, **facts):
    return save_bundle(decoder, path, task="toy", actuators=NAMES, facts=facts)


def edit(folder, **changes):
    """Change entries of the description; None removes one."""
    file = folder / "synergies.json"
    content = json.loads(file.read_text()) | changes
    dropped = {key for key, value in changes.items() if value is None}
    file.write_text(json.dumps({k: v for k, v in content.items() if k not in dropped}))


@pytest.fixture
def bundle(tmp_path):
    return save(fitted_decoder(), tmp_path / "run" / "synergies")


def same_weights(decoder, other):
    ours, theirs = decoder.state_dict(), other.state_dict()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[k], theirs[k]) for k in ours)


@pytest.mark.parametrize("residual", [0.0, 0.25])
def test_round_trip_is_bit_equal(tmp_path, residual):
    decoder = fitted_decoder(residual=residual)
    facts = {
        "frames": np.int64(1000),
        "vaf": torch.tensor(0.5),
        "worst": float("nan"),
        "versions": {"torch": "2"},
    }
    folder = save_bundle(decoder, tmp_path / "b", task="toy", actuators=NAMES, facts=facts)
    loaded, info = load_bundle(folder)
    assert same_weights(decoder, loaded)
    synergy = torch.rand(7, decoder.synergy_dim) * 2 - 1
    assert torch.equal(loaded(synergy), decoder(synergy))
    assert (info.task, info.actuators, info.residual) == ("toy", NAMES, residual)
    assert (info.num_synergies, info.encoder["num_components"]) == (2, 3)
    assert info.low == tuple(decoder.low.tolist()) and info.high == tuple(decoder.high.tolist())
    assert info.facts == {"frames": 1000, "vaf": 0.5, "worst": None, "versions": {"torch": "2"}}
    assert sorted(os.listdir(folder)) == ["synergies.json", "synergies.safetensors"]


def test_round_trip_of_sars_map_keeps_its_kind_and_blend(tmp_path):
    decoder = SARDecoder.from_basis(torch.zeros(5), torch.rand(2, 5), low=LOW, high=HIGH, blend=0.6)
    loaded, info = load_bundle(save(decoder, tmp_path / "b"))
    assert type(loaded) is SARDecoder and loaded.config == decoder.config
    assert same_weights(decoder, loaded)
    assert (info.kind, info.residual) == ("sar", 0.4)
    with pytest.raises(BundleError, match=r"is a SARDecoder, whose residual is fixed at 0\.4"):
        load_bundle(tmp_path / "b", residual=0.5)


def test_description_of_a_synergy_decoder_has_no_kind_as_in_older_bundles(bundle):
    config = json.loads((bundle / "synergies.json").read_text())["config"]
    assert list(config) == ["num_synergies", "action_dim", "low", "high", "hidden", "residual"]


def test_loads_from_the_run_folder_with_other_keys_and_residual(bundle):
    decoder, info = load_bundle(
        bundle.parent, residual=0.5, in_keys=[("arm", "synergy")], out_keys=[("arm", "action")]
    )
    data = decoder(TensorDict({"arm": {"synergy": torch.zeros(3, 7)}}, [3]))
    assert data["arm", "action"].shape == (3, 5)
    assert info.residual == 0.0


def test_redundant_num_components_of_an_older_bundle_is_ignored(bundle):
    _, info = load_bundle(bundle)
    edit(bundle, num_components=3)  # as older releases wrote
    assert load_bundle(bundle)[1] == info


def test_loading_leaves_the_global_rng_alone(bundle):
    state = torch.get_rng_state()
    load_bundle(bundle)
    assert torch.equal(torch.get_rng_state(), state)


def flip_a_byte(folder):
    file = folder / "synergies.safetensors"
    content = bytearray(file.read_bytes())
    content[-3] ^= 1
    file.write_bytes(content)


def widen(folder):
    config = json.loads((folder / "synergies.json").read_text())["config"]
    edit(folder, config=config | {"hidden": [9, 9]})


DAMAGE = {
    "SHA-256": flip_a_byte,
    r"safetensors cannot be read \(No such file": lambda f: (f / "synergies.safetensors").unlink(),
    r"synergies\.json cannot be read \(No such file": lambda f: (f / "synergies.json").unlink(),
    "is not JSON": lambda f: (f / "synergies.json").write_text("{"),
    r"synergies\.json is not a JSON object": lambda f: (f / "synergies.json").write_text("[1]"),
    "does not describe a synergy bundle": lambda f: (f / "synergies.json").write_text("{}"),
    "format version 3 and this torchrl_etl reads 1 and 2": lambda f: edit(f, format_version=3),
    r"lacks \['task'\]": lambda f: edit(f, task=None),
    r"has unknown \['surprise'\]": lambda f: edit(f, surprise=1),
    "low in .* is 'x'; it must be a JSON array": lambda f: edit(f, low="x"),
    "task in .* is 5; it must be a JSON string": lambda f: edit(f, task=5),
    "do not make a decoder": widen,
    "files may not import 'antigravity'": lambda f: edit(f, config={"kind": "antigravity:Map"}),
    "unexpected keyword argument": lambda f: edit(f, config={"cells": 3}),
    "synergies of 1 actuators": lambda f: edit(f, actuators=["biceps"]),
    "states 99 synergies": lambda f: edit(f, num_synergies=99),
    "states a residual of 0.5 for a decoder with 0.0": lambda f: edit(f, residual=0.5),
    "actuators that are not strings": lambda f: edit(f, actuators=[1, 2, 3]),
    "There is no synergy bundle": shutil.rmtree,
}


@pytest.mark.parametrize("words", DAMAGE)
def test_damaged_bundle_is_refused_with_the_cause(bundle, words):
    DAMAGE[words](bundle)
    with pytest.raises(BundleError, match=words):
        load_bundle(bundle)


def test_a_pickle_in_disguise_is_refused_without_running(bundle, tmp_path):
    trap = tmp_path / "ran"

    class Payload:
        def __reduce__(self):
            return (open, (str(trap), "w"))

    for content in (pickle.dumps(Payload()), b"\x80\x02" + b"\x00" * 64):
        (bundle / "synergies.safetensors").write_bytes(content)
        edit(bundle, sha256=hashlib.sha256(content).hexdigest())
        with pytest.raises(BundleError, match="not a safetensors file"):
            load_bundle(bundle)
    assert not trap.exists()


@pytest.mark.parametrize("survives", [0, 1])
@pytest.mark.parametrize("killed", [False, True], ids=["error", "killed"])
def test_interrupted_save_keeps_the_old_bundle(bundle, monkeypatch, survives, killed):
    """``survives`` moves succeed, then one fails; ``killed``: no clean-up runs after it either."""
    old, new = load_bundle(bundle)[0], fitted_decoder(seed=1)
    calls, replace = [], os.replace

    def failing(source, target):
        calls.append(source)
        if len(calls) == survives + 1 or (killed and len(calls) > survives):
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing)
        if killed:
            patch.setattr(shutil, "rmtree", lambda *args, **kwargs: None)
        with pytest.raises(KeyboardInterrupt):
            save(new, bundle)
    assert same_weights(load_bundle(bundle)[0], old)
    assert same_weights(load_bundle(bundle.parent)[0], old)
    save(new, bundle)
    assert same_weights(load_bundle(bundle)[0], new)
    assert os.listdir(bundle.parent) == ["synergies"]


def test_tilde_is_the_home_folder_in_every_path(bundle, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert copy_bundle(bundle, "~/copy") == tmp_path / "copy"
    assert load_bundle("~/copy")[1] == load_bundle(bundle)[1]


def test_saving_refuses_to_overwrite_other_files(bundle):
    run = bundle.parent
    with pytest.raises(BundleError, match="holds 'synergies', and saving a bundle there would"):
        save(fitted_decoder(), run)
    with pytest.raises(BundleError, match="holds 'synergies', and saving a bundle there would"):
        copy_bundle(bundle, run)
    (run / "file").touch()
    with pytest.raises(BundleError, match="is a file"):
        save(fitted_decoder(), run / "file")
    assert load_bundle(run)


def test_saving_refuses_wrong_names_and_facts_that_json_cannot_hold(tmp_path):
    decoder = fitted_decoder()
    for names in (NAMES[:4], NAMES[:4] + NAMES[:1]):
        with pytest.raises(BundleError, match="decoder of 5 actuators"):
            save_bundle(decoder, tmp_path / "b", task="toy", actuators=names)
    for name, value in (("task", None), ("kind", 3)):
        with pytest.raises(BundleError, match=f"{name} is {value}; it must be a string"):
            save_bundle(decoder, tmp_path / "b", **{"task": "toy", "actuators": NAMES, name: value})
    with pytest.raises(BundleError, match=r"facts\['a'\]\[1\] is a object"):
        save(decoder, tmp_path / "b", a=[1, object()])
    assert not list(tmp_path.iterdir())


def test_actuator_names_are_saved_as_strings(tmp_path):
    folder = save_bundle(fitted_decoder(), tmp_path / "b", task="toy", actuators=range(5))
    assert load_bundle(folder)[1].actuators == ("0", "1", "2", "3", "4")


def info(names=NAMES, low=0.0, high=1.0):
    n = len(names)
    return BundleInfo("toy", tuple(names), (low,) * n, (high,) * n, 2, 0.0, {}, "")


def test_the_same_muscles_and_bounds_are_compatible():
    check_compatible(info(), NAMES, 0.0, 1.0)
    check_compatible(info(low=0.1), list(NAMES), torch.full((5,), 0.1), [1.0] * 5)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (NAMES[::-1], "different order .number 0 is 'biceps' in the bundle, 'psoas' in the env"),
        ([*NAMES, "gracilis"], "5 actuators and the environment has 6, .*a part of this body"),
        (NAMES[:3], "also moves 'soleus', 'psoas'.* on a larger body"),
        ([f"finger{i}" for i in range(39)], "has 39, with no name in common"),
        ([*NAMES[:4], "psoas_r"], "perhaps renamed: 'psoas' for 'psoas_r'"),
    ],
)
def test_other_muscles_are_refused_with_the_likeliest_reason(names, words):
    with pytest.raises(BundleError, match=words):
        check_compatible(info(), names, 0.0, 1.0)


@pytest.mark.parametrize(("low", "high", "side"), [(-1.0, 1.0, "lower"), (0.0, 2.0, "upper")])
def test_other_bounds_are_refused(low, high, side):
    words = f"other {side} action bounds .* 5 of 5 actuators .'biceps'"
    with pytest.raises(BundleError, match=words):
        check_compatible(info(), NAMES, low, high)


@pytest.mark.slow
def test_synergies_of_hand_pose_fit_the_other_hand_tasks_and_no_leg(tmp_path):
    spaces = {
        task: (actuator_names(env), env.action_spec_unbatched.space)
        for task in ("myoHandPose", "myoHandKeyTurn", "myoHandPenTwirl", "myoLegWalk")
        for env in [make_env(task)]
    }
    names, space = spaces["myoHandPose"]
    decoder = SynergyDecoder(4, 39, low=space.low.tolist(), high=space.high.tolist(), hidden=(8,))
    folder = save_bundle(decoder, tmp_path / "b", task="myoHandPose", actuators=names)
    described = load_bundle(folder)[1]
    for task in ("myoHandPose", "myoHandKeyTurn", "myoHandPenTwirl"):
        names, space = spaces[task]
        check_compatible(described, names, space.low, space.high)
    names, space = spaces["myoLegWalk"]
    with pytest.raises(BundleError, match=r"with no name in common: it is for another body"):
        check_compatible(described, names, space.low, space.high)


@pytest.mark.parametrize("fault", [float("nan"), float("inf")])
def test_saving_a_non_finite_decoder_is_refused(fault, tmp_path):
    decoder = SynergyDecoder(2, 3)
    with torch.no_grad():
        next(decoder.parameters()).view(-1)[0] = fault
    with pytest.raises(BundleError, match="not finite"):
        save_bundle(decoder, tmp_path / "own", task="toy", actuators=["a", "b", "c"])
    assert not list(tmp_path.iterdir())


def test_saving_a_map_of_a_script_is_refused(tmp_path):
    mine = type("MyMap", (SynergyDecoder,), {"__module__": "__main__"})
    with pytest.raises(ValueError, match=r"MyMap is defined in the script .* module of its own"):
        save_bundle(mine(2, 3), tmp_path / "own", task="toy", actuators=["a", "b", "c"])
    assert not list(tmp_path.iterdir())


def test_loading_a_non_finite_decoder_is_refused(tmp_path, monkeypatch):
    decoder = SynergyDecoder(2, 3)
    with torch.no_grad():
        next(decoder.parameters()).view(-1)[0] = float("nan")
    with monkeypatch.context() as patch:  # earlier releases saved such a decoder
        patch.setattr("torchrl_etl.synergies.bundle.not_finite", lambda state: None)
        save_bundle(decoder, tmp_path / "own", task="toy", actuators=["a", "b", "c"])
    with pytest.raises(BundleError, match="not finite: its training diverged before it was saved"):
        load_bundle(tmp_path / "own")


def test_format_1_bundle_loads_but_cannot_encode(bundle):
    new = load_bundle(bundle)[0]
    state = safetensors.torch.load_file(bundle / "synergies.safetensors")
    content = safetensors.torch.save(
        {key: value for key, value in state.items() if not key.startswith("encoder.")}
    )
    (bundle / "synergies.safetensors").write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    edit(bundle, format_version=1, kind=None, encoder=None, sha256=digest)
    old, described = load_bundle(bundle)
    assert same_weights(old, new) and old.encoder is None
    assert (described.kind, described.format_version) == ("gmvae", 1)
    with pytest.raises(RuntimeError, match="has no encoder, so actions cannot be turned into"):
        old.encode(actions(3))


def test_encoder_is_not_in_the_decoders_state_dict_and_follows_its_dtype(bundle):
    decoder = load_bundle(bundle)[0]
    assert not any("encoder" in key for key in decoder.state_dict())
    assert not any(parameter.requires_grad for parameter in decoder.encoder.parameters())
    assert copy.deepcopy(decoder).double().encode(actions(3)).dtype == torch.float64
    assert decoder.encode(actions(3)).dtype == torch.float32
