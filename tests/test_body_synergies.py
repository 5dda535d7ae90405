"""Synergies from a body's moment arms, and the studies that compare others with them."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from tests.commands import script
from tests.configs import ROOT, tiny
from torchrl_etl.analysis import joint_effects
from torchrl_etl.envs import (
    actuator_names,
    body_decoder,
    body_synergies,
    excitation,
    joint_torques,
    make_env,
    muscle_changes,
)
from torchrl_etl.experiment import Experiment
from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import load_bundle, save_bundle
from torchrl_etl.training import resumed_config
from torchrl_etl.training.context import Context

TASK = "myoHandKeyTurn"


def test_each_synergy_turns_one_joint_with_a_largest_change_of_one():
    # Two antagonists at the first joint, and a muscle over both joints.
    torques = np.array([[2.0, -2.0, 1.0], [0.0, 0.0, 3.0]])
    changes = muscle_changes(torques)
    turned = changes @ torques.T
    assert turned[~np.eye(2, dtype=bool)] == pytest.approx(0.0, abs=1e-12)
    assert (np.diag(turned) > 0).all()
    # By hand: (1/2, -1/2, 0) turns the first joint. The third muscle turns the second joint, and
    # the antagonists cancel its torque on the first: (-1/4, 1/4, 1).
    assert changes == pytest.approx(np.array([[1.0, -1.0, 0.0], [-0.25, 0.25, 1.0]]))


def test_fewer_synergies_are_those_of_the_largest_torques():
    # The first two muscles turn the first two joints, and the third muscle turns the last joint.
    torques = np.array([[1.0, 1.0, 0.0], [5.0, 5.0, 0.0], [0.0, 0.0, 9.0]])
    (change,) = muscle_changes(torques, 1)
    assert np.abs(change) == pytest.approx([1.0, 1.0, 0.0])
    with pytest.raises(ValueError, match="num_synergies is 4 but muscles turn only 3 joints"):
        muscle_changes(torques, 4)


def test_body_decoder_rests_at_the_given_excitation_and_moves_joints():
    env = make_env(TASK, seed=0)
    env.reset()
    torques = joint_torques(env, num_postures=2).matrix
    changes = muscle_changes(torques)
    decoder = body_decoder(env, changes, rest=0.25)
    at = torch.zeros(len(changes))
    rested = excitation(env, decoder.module(at))
    assert torch.allclose(rested, torch.full((39,), 0.25), atol=1e-5)
    slope = torch.autograd.functional.jacobian(lambda u: excitation(env, decoder.module(u)), at)
    assert torch.allclose(slope.mT, torch.from_numpy(changes).float(), atol=1e-4)
    near = excitation(env, decoder.module(0.05 * torch.randn(500, len(changes)))).detach()
    assert joint_effects(near, torques).share > 0.99
    with pytest.raises(ValueError, match="an excitation that actions inside the bounds reach"):
        body_decoder(env, changes, rest=0.95)


def study(name, *arguments):
    assert script(ROOT / "studies" / name, *map(str, arguments)) == 0


def test_studies_write_a_body_bundle_and_rows_of_joint_effects(tmp_path):
    study("body_synergies.py", TASK, tmp_path / "body", "--num-synergies", 5)
    decoder, info = load_bundle(tmp_path / "body")
    assert decoder.num_synergies == 5
    assert info.facts["joint_share"] > 0.8
    study("body_synergies.py", TASK, tmp_path / "other", "--num-synergies", 5, "--shuffle", 0)
    assert load_bundle(tmp_path / "other")[1].facts["joint_share"] < 0.75  # chance: 0.59
    assert list(info.actuators) == actuator_names(TASK)

    run = tmp_path / "run"
    random = SynergyDecoder(2, 39)
    facts = {"frames": 7, "commit": "abc"}
    save_bundle(random, run / "synergies", task=TASK, actuators=info.actuators, facts=facts)
    config = tiny(f"env={TASK}", "seed=3", "exploration.bonus.extrinsic_weight=1")
    OmegaConf.save(config, run / "config.yaml")
    study("joint_effects.py", run, "--out", tmp_path / "rows.csv")
    study("joint_effects.py", run, "--out", tmp_path / "rows.csv")
    with (tmp_path / "rows.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    kinds = ["uniform_actions", "random_directions", "body", "explored", "explored"]
    assert [row["synergies"] for row in rows] == kinds
    assert rows[3] == rows[4]
    assert (rows[3]["extrinsic_weight"], rows[3]["seed"], rows[3]["run_commit"]) == (
        "1",
        "3",
        "abc",
    )
    assert float(rows[0]["share"]) == pytest.approx(float(rows[0]["chance"]), abs=0.03)
    assert float(rows[2]["share"]) > 0.9
    for row in rows:
        assert float(row["shuffled"]) == pytest.approx(float(row["chance"]), abs=0.05)
        assert 0 < float(row["shuffled_sd"]) < 0.2  # about 0.1 for two synergies


def test_run_with_body_synergies_saves_them_and_resumes(tmp_path):
    run = tmp_path / "run"
    made = tiny(f"env={TASK}", "method=etl_body", "learn.frames=192", f"run_dir={run}")
    made.num_synergies = None
    assert Experiment(made).run()["learn"]["frames"] == 192
    decoder, info = load_bundle(run)
    env = make_env(TASK, seed=0)
    env.reset()
    synergies = torch.rand(5, 23)
    assert torch.equal(decoder.module(synergies), body_synergies(env).module(synergies))
    assert (info.kind, info.facts["frames"]) == ("body", 0)
    config = resumed_config(run, ["learn.frames=256"])
    assert Experiment(config, resume=run).run()["learn"]["frames"] == 256


@pytest.mark.parametrize(
    ("env", "words"), [("overactuated", "MuJoCo"), ("humanoid-stand", "21 actuators, 0 of them")]
)
def test_body_synergies_without_muscles_are_refused_before_the_run(
    env, words, tmp_path, monkeypatch
):
    made, make_env = [], Context.make_env

    def remembered(self, **options):
        made.append((make_env(self, **options), options))
        return made[-1][0]

    monkeypatch.setattr(Context, "make_env", remembered)
    with pytest.raises(ValueError, match=words):
        Experiment(tiny(f"env={env}", "synergies.bundle=body", f"run_dir={tmp_path / 'run'}"))
    assert not (tmp_path / "run").exists()
    (looked_at,) = (env for env, options in made if "seed" in options)
    assert looked_at.is_closed
