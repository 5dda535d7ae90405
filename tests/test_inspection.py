"""Runs, bundles and zoo entries opened in the viewer."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
from urllib.request import urlopen

import gymnasium
import pytest
import torch
from omegaconf import OmegaConf

from tests.commands import command, recipe_module
from tests.configs import ROOT, tiny
from torchrl_etl.analysis.viewer import Session
from torchrl_etl.analysis.viewer.muscles import driven_muscles
from torchrl_etl.analysis.viewer.page import Page, check_port
from torchrl_etl.envs import SimulationError, actuator_names, make_env
from torchrl_etl.experiment import Experiment
from torchrl_etl.inspection import open_bundle, open_run, open_zoo
from torchrl_etl.modules import SARDecoder, SynergyDecoder
from torchrl_etl.synergies import BundleError, save_bundle
from torchrl_etl.zoo import ZooError, read_card, synergies


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a tiny run of both stages."""
    folder = tmp_path_factory.mktemp("runs") / "etl"
    short = ("explore.frames=128", "learn.frames=128", "evaluation.episodes=2")
    Experiment(tiny(f"run_dir='{folder}'", "learn.decoder.residual=0.2", *short)).run()
    return folder


@pytest.fixture(scope="module")
def opened(finished):
    return open_run(finished)


def test_run_of_both_stages_offers_policy_sliders_and_explorer(opened):
    assert opened.drivers == ["policy", "sliders", "explorer"]
    assert opened.decoder.num_synergies == 2 and opened.direction_dim > 0
    with Session(opened) as session:
        assert session.has_residual
        for driver in opened.drivers:
            session.drive(driver)
            session.step()


def test_untrained_policy_is_that_of_the_run_before_stage_2(finished):
    def weights(policy):
        return torch.cat([value.flatten().float() for value in policy.state_dict().values()])

    experiment = Experiment(OmegaConf.load(finished / "config.yaml"), resume=finished)
    learned = weights(experiment.learned().learner.policy)
    torch.rand(7)  # other draws must not matter
    before = weights(experiment.untrained())
    assert torch.equal(before, weights(experiment.method.stage().learner.policy))
    assert not torch.equal(before, learned)
    decoder = open_bundle(finished).decoder.state_dict()
    found = [part for part in experiment.untrained().modules() if isinstance(part, SynergyDecoder)]
    for key, value in found[0].state_dict().items():
        assert torch.equal(value, decoder[key]), "the synergies that learning began with"


def test_episode_0_is_the_first_evaluation_episode(opened, finished):
    experiment = Experiment(OmegaConf.load(finished / "config.yaml"), resume=finished)
    found = experiment.evaluator(experiment.learned())()
    with Session(opened) as session:
        while not session.over:
            session.step()
    assert session.total_reward == pytest.approx(found.returns[0], rel=1e-5)


def test_run_without_stage_2_offers_sliders_and_explorer(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "learn")
    assert open_run(tmp_path / "run").drivers == ["sliders", "explorer"]


def test_a_run_without_policy_and_synergies_is_refused(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    for part in ("checkpoints", "synergies"):
        shutil.rmtree(tmp_path / "run" / part)
    with pytest.raises(ValueError, match=r"neither a policy .* nor synergies"):
        open_run(tmp_path / "run")


def test_bundle_opens_on_the_task_of_its_exploration(finished):
    subject = open_bundle(finished)
    assert subject.drivers == ["sliders"] and subject.task.name == "overactuated"
    assert subject.decoder.residual == 0.0


@pytest.mark.parametrize(
    "decoder",
    [SARDecoder.from_basis(torch.zeros(16), torch.ones(2, 16)), SynergyDecoder(2, 16, residual=1)],
    ids=["fixed", "free"],
)
def test_sliders_move_only_the_synergies_of_a_bundle_with_a_residual(decoder, tmp_path):
    muscles = actuator_names("overactuated")
    save_bundle(decoder, tmp_path / "a", task="overactuated", actuators=muscles)
    with Session(open_bundle(tmp_path / "a")) as session:
        session.coefficients[0] = 1.0
        session.step()
        assert session.subject.drivers == ["sliders"] and session.steps == 1
        assert len(driven_muscles(session.subject.decoder, muscles)) == 2


def test_opening_a_bundle_leaves_no_simulator_open(monkeypatch):
    made = []

    def build(*name, **options):
        made.append(make_env(*name, **options))
        return made[-1]

    monkeypatch.setattr("torchrl_etl.inspection.make_env", build)
    open_bundle(synergies("overactuated"))
    assert [env.is_closed for env in made] == [True]


def test_zoo_entry_repeats_the_first_return_on_its_card():
    subject = open_zoo("overactuated")
    with Session(subject) as session:
        while not session.over:
            session.step()
    card = read_card("overactuated").evaluation
    assert session.total_reward == pytest.approx(card["episodes"]["returns"][0], rel=1e-4)


def test_zoo_synergies_open_with_either_goal():
    with Session(open_zoo("myohand")) as session:
        assert session.subject.name == "zoo=myohand"
        for goal in ("random", "fixed"):
            session.choose_goal(goal)
            session.step()
            assert session.goal == goal and session.steps == 1


def test_run_and_bundle_of_an_environment_id_open_with_either_goal(tmp_path):
    made_on = "env=torchrl_etl/OveractuatedRandom-v0"
    short = ("explore.frames=128", "learn.frames=128", "evaluation.episodes=2")
    Experiment(tiny(f"run_dir='{tmp_path}/run'", made_on, *short)).run()
    for subject in (open_run(tmp_path / "run"), open_bundle(tmp_path / "run")):
        with Session(subject) as session:
            assert session.goal == "random"
            session.choose_goal("fixed")
            session.step()


def test_folder_of_synergies_alone_opens_as_a_zoo_entry(finished, tmp_path):
    folder = shutil.copytree(finished / "synergies", tmp_path / "hand")
    assert open_zoo(str(folder)).drivers == ["sliders"]
    (folder / "synergies.safetensors").unlink()
    with pytest.raises(ZooError, match="no entry of the zoo"):
        open_zoo(str(folder))


def test_bundle_cannot_import_a_module(finished, tmp_path):
    folder = shutil.copytree(finished / "synergies", tmp_path / "foreign")
    info = json.loads((folder / "synergies.json").read_text())
    info["task"] = "antigravity:T-v0"
    (folder / "synergies.json").write_text(json.dumps(info))
    with pytest.raises(BundleError, match=r"files may not import .*; pass env=\S+ yourself"):
        open_bundle(folder)
    assert "antigravity" not in sys.modules
    assert open_bundle(folder, "overactuated").task.name == "overactuated"


def test_a_bundle_of_a_recording_is_shown_on_the_task_that_is_named(tmp_path):
    muscles = actuator_names("overactuated")
    folder = save_bundle(SynergyDecoder(2, 16), tmp_path / "a", task="emg", actuators=muscles)
    with pytest.raises(BundleError, match="is of 'emg', which is not a known task; pass env=TASK"):
        open_bundle(folder)
    assert open_bundle(folder, "overactuated").task.name == "overactuated"


@pytest.mark.parametrize("fault", [SimulationError, gymnasium.error.DependencyNotInstalled])
@pytest.mark.parametrize(
    ("recipe", "opening"),
    [("view.py", "torchrl_etl.inspection.open_zoo"), ("evaluate.py", "torchrl_etl.zoo.load")],
)
def test_simulator_error_is_printed_in_one_line(recipe, opening, fault, monkeypatch, capsys):
    def fail(*arguments, **options):
        raise fault("the simulator says why")

    monkeypatch.setattr(opening, fail)
    port = ["port=0"] if recipe == "view.py" else []
    assert command(recipe, "zoo=overactuated", *port) == 2
    assert capsys.readouterr().err == "Error: the simulator says why\n"


def test_a_bundle_of_another_body_is_refused(finished):
    with pytest.raises(BundleError, match="it is for another body"):
        open_bundle(finished, "humanoid-stand")


def test_page_of_a_task_without_mujoco_is_refused(opened):
    with Session(opened) as session, pytest.raises(ValueError, match="does not run on MuJoCo"):
        Page(session, port=0)


def test_busy_port_is_refused_with_advice():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(ValueError, match=re.escape("pass another port, or port=0")):
            check_port("127.0.0.1", other.getsockname()[1])


@pytest.mark.parametrize("port", [-1, 65536, "http", True, None])
def test_invalid_port_is_refused(port):
    with pytest.raises(ValueError, match=r"from 0 .* to 65535"):
        check_port("127.0.0.1", port)


@pytest.mark.parametrize("host", [None, 1, ""])
def test_invalid_host_is_refused(host):
    with pytest.raises(ValueError, match="it must be an address to listen on"):
        check_port(host, 0)


@pytest.fixture(scope="module")
def recipe():
    return recipe_module("view")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "nothing to view was given; pass run=PATH"),
        ({"run": "a", "bundle": "b"}, "run and bundle were given"),
        ({"run": "a", "env": "dog-run"}, "run has its own task; leave env out"),
        ({"zoo": "a", "goal": "random"}, "zoo has its own task; leave goal out"),
        ({"bundle": "nowhere"}, "no synergy bundle at 'nowhere'"),
    ],
)
def test_view_refuses_missing_and_conflicting_settings(recipe, settings, message):
    defaults = OmegaConf.load(ROOT / "recipes" / "conf" / "view.yaml")
    with pytest.raises(ValueError, match=re.escape(message)):
        recipe.open_subject(OmegaConf.merge(defaults, settings))


def test_view_opens_a_zoo_bundle_on_another_task_of_its_body(recipe):
    defaults = OmegaConf.load(ROOT / "recipes" / "conf" / "view.yaml")
    settings = {"bundle": "zoo:myohand", "env": "myoHandKeyTurn"}
    subject = recipe.open_subject(OmegaConf.merge(defaults, settings))
    assert (subject.task.name, subject.decoder.num_synergies) == ("myoHandKeyTurn", 8)


@pytest.mark.slow
def test_view_serves_the_printed_address_until_ctrl_c(tmp_path):
    names = actuator_names("cartpole-balance")
    bundle = save_bundle(
        SynergyDecoder(1, 1), tmp_path / "a bundle", task="cartpole-balance", actuators=names
    )
    command = [sys.executable, str(ROOT / "recipes" / "view.py"), f"bundle={bundle}", "port=0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        line = process.stdout.readline()
        assert str(bundle) in line and "http://127.0.0.1:" in line
        with urlopen(re.search(r"http://[\d.:]+", line)[0]) as page:
            assert b"<html" in page.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0 and "has stopped" in process.stdout.read()
    finally:
        process.kill()
