"""Zoo entries: exported from runs, refused if damaged, and loaded as the same policies."""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
import sys

import gymnasium
import pytest
import safetensors.torch
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from tests.commands import command
from tests.configs import BRIEFLY, CONF, ELBOW, ROOT, composed, tiny
from torchrl_etl import zoo
from torchrl_etl.command_line import translate
from torchrl_etl.envs import EnvironmentSpec, make_env, resolve_task
from torchrl_etl.experiment import Experiment
from torchrl_etl.export import command_of, describe_policy, export_run, rebuilt
from torchrl_etl.inspection import open_zoo
from torchrl_etl.synergies import check_compatible, load_bundle
from torchrl_etl.training import Evaluation, evaluate_task, resumed_config, validate
from torchrl_etl.zoo import ZooError


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished tiny run of both stages."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    Experiment(tiny(f"run_dir='{folder}'", "env=torchrl_etl/Overactuated-v0")).run()
    return folder


@pytest.fixture(scope="module")
def exported(run):
    """A zoo entry exported from the run."""
    export_run(run, run.parent / "toy", composed, CONF, episodes=3)
    return run.parent / "toy"


def test_card_with_former_argument_names_gives_the_same_policy():
    actor = {"kind": "gaussian", "quiet": 1, "quiet_std": 0.02}
    policy = zoo.make_policy(observation_dim=3, low=[-1.0] * 2, high=[1.0] * 2, actor=actor)
    scale = policy(TensorDict({"observation": torch.zeros(4, 3)}, [4]))["scale"]
    assert (scale[:, 1] == 0.02).all() and (scale[:, 0] > 0.5).all()


@pytest.mark.parametrize("kind", ["synergies=pca", "exploration=metra"])
def test_saved_config_of_another_kind_is_read_unchanged(kind, tmp_path):
    made = Experiment(tiny(f"run_dir='{tmp_path}/run'", kind))
    made.folder.open(resume=False)
    made.folder.close()
    read = resumed_config(made.folder.path, defaults=composed())
    assert OmegaConf.to_container(read) == OmegaConf.to_container(made.config)


@pytest.fixture
def entry(exported, tmp_path):
    """A copy of the entry, to be damaged."""
    return shutil.copytree(exported, tmp_path / "toy")


def observations(size: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    return TensorDict({"observation": torch.randn(5, size, generator=generator)}, [5])


def test_myohand_synergies_fit_all_hand_tasks():
    _, info = load_bundle(zoo.synergies("myohand"))
    for task in ("myoHandPose", "myo2HandPose", "myoHandKeyTurn", "myoHandPenTwirl"):
        spec = EnvironmentSpec.of(make_env(task))
        check_compatible(info, spec.actuators, spec.low.tolist(), spec.high.tolist())
    subject = open_zoo("myohand")
    assert subject.policy is None and subject.decoder.num_synergies == 8


@pytest.mark.parametrize("name", zoo.names(trained=True))
def test_every_entry_earns_the_returns_on_its_card(name):
    policy, env = zoo.load(name)
    card = zoo.read_card(name)
    found = evaluate_task(policy, env, card.task, episodes=2)
    told = card.evaluation["episodes"]
    # Processors round differently, and contacts amplify it: an episode need not be the same.
    margin = 0.02 * max(map(abs, told["returns"]))
    for episode, value in enumerate(found.returns):
        assert min(told["returns"]) - margin <= value <= max(told["returns"]) + margin
        if told["successes"] and value == pytest.approx(told["returns"][episode], rel=0.02):
            assert found.successes[episode] == told["successes"][episode]
    assert {"method", "frames", "seed", "commit", "versions", "command"} == card.training.keys()
    assert "dirty" not in card.training["commit"]
    for word in ("/tmp", "/home", "run_dir"):
        assert word not in card.json


@pytest.mark.parametrize("name", zoo.names(trained=True))
def test_card_intervals_follow_from_its_episodes(name):
    told = zoo.read_card(name).evaluation
    found = Evaluation(**told["episodes"]).summary()
    assert found.keys() == told.keys()
    for key in told.keys() - {"episodes", "first_seed"}:
        assert told[key] == pytest.approx(found[key], nan_ok=True), key
    returns, solved = told["episodes"]["returns"], told["episodes"]["successes"]
    assert told["return"]["mean"] == pytest.approx(sum(returns) / len(returns))
    assert told["solved"]["mean"] == pytest.approx(sum(solved) / len(solved))


@pytest.mark.parametrize("name", zoo.names(trained=True))
def test_card_command_is_valid_for_its_task(name):
    card = zoo.read_card(name)
    told = shlex.split(card.training["command"])
    config = composed(translate([*told[2:], "run_dir=unused"], CONF))
    validate(config)
    assert told[:2] == ["python", "recipes/etl_sac.py"]
    assert resolve_task(config.env, config.goal) == resolve_task(
        card.task["name"], card.task["goal"]
    )


def test_zoo_page_states_the_facts_of_myohand():
    info = json.loads((zoo.synergies("myohand") / "synergies.json").read_text("utf-8"))
    page = (ROOT / "docs" / "zoo.md").read_text(encoding="utf-8")
    (told,) = (line for line in page.splitlines() if line.startswith("`myohand` was explored"))
    facts = info["facts"]
    assert f"commit {facts['commit'][:7]} with seed {facts['seed']}: {facts['frames']:,} fr" in told
    assert f"{info['num_synergies']} synergies, {info['num_components']} components" in told
    for key in ("vaf", "pca_vaf", "nmf_vaf", "control_authority"):
        assert f"{facts[key]:.3f}" in told, key


def test_exported_entry_holds_the_policy_and_bundle_of_the_run(run, exported):
    card = zoo.read_card(exported)
    assert (
        card.training["frames"]
        == json.loads((run / "summary.json").read_text())["learn"]["frames_charged"]
    )
    assert card.training["method"] == "etl" and card.training["versions"]["torch"]
    own = Experiment(resumed_config(run), resume=run).learned().learner.policy
    policy, env = zoo.load(exported)
    rows = observations(6)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(policy(rows)["action"], own(rows)["action"])
    again = evaluate_task(policy, env, card.task, episodes=3)
    assert again.returns == card.evaluation["episodes"]["returns"]
    assert card.evaluation["return"]["mean"] == again.mean_return.mean
    found, kept = load_bundle(zoo.synergies(exported))[0], load_bundle(run)[0]
    torch.testing.assert_close(found.state_dict(), kept.state_dict())
    assert (
        sorted(path.suffix for path in exported.iterdir())
        == [".json", ".json"] + [".safetensors"] * 2
    )


def test_loaded_policy_is_deterministic_unless_exploring(exported):
    policy, _ = zoo.load(exported)
    rows = observations(6)
    assert torch.equal(policy(rows.clone())["action"], policy(rows.clone())["action"])
    with set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(policy(rows.clone())["action"], policy(rows.clone())["action"])


def test_loading_leaves_the_global_rng_unchanged(exported):
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    zoo.load(exported)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("method", ["sac", "dynsyn", "lattice", "lattice_plain", "sar", "eme"])
def test_policy_of_every_method_is_rebuilt(method):
    experiment = Experiment(
        tiny(ELBOW, f"method={method}", "run_dir=unused", *BRIEFLY.get(method, []))
    )
    learner = experiment.method.stage().learner
    described = json.loads(json.dumps(describe_policy(experiment, learner)))
    rows = observations(described["observation_dim"])
    policy = rebuilt(learner.policy, described)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = learner.policy(rows.clone())["action"]
        torch.testing.assert_close(policy(rows.clone())["action"], expected)


def test_actor_that_its_method_does_not_describe_is_refused(monkeypatch):
    experiment = Experiment(tiny(ELBOW, "method=lattice", "run_dir=unused"))
    learner = experiment.method.stage().learner
    monkeypatch.setattr(experiment.method, "actor", lambda: {"kind": "gaussian"})
    with pytest.raises(ValueError, match="its method must describe its actor"):
        rebuilt(learner.policy, describe_policy(experiment, learner))


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["method=sac", "goal=random", "frames=700", "learn.sac.lr=1e-3", "seed=3"],
        ["method=lattice", "action_repeat=2", "critic.hidden=[16]", "collector=process"],
        ["synergies=nmf", "exploration=metra", "+env_kwargs.max_episode_steps=9", "faithful=paper"],
        ["+env_kwargs.words=['a,b','1','it\\'s (so)',\"x\"]", "success_key='a=b'"],
    ],
)
def test_card_command_gives_the_same_config(overrides):
    made = tiny("run_dir=unused", *overrides)
    told = shlex.split(command_of(made, composed, CONF, "toy"))
    assert told[:2] == ["python", "recipes/etl_sac.py"]
    again = composed(translate(told[2:], CONF))
    assert without_output_settings(again) == without_output_settings(made)


def without_output_settings(config) -> dict:
    """The configuration without run_dir, logs, pictures and threads."""
    plain = OmegaConf.to_container(config)
    for key in (
        "run_dir",
        "seeds",
        "progress",
        "pictures",
        "threads",
        "log",
        "log_every",
        "vaf_curve",
    ):
        del plain[key]
    if plain["frames"] is not None:
        del plain["learn"]["frames"]
    return plain


def test_card_command_names_the_synergies_of_the_entry(exported):
    made = tiny("run_dir=unused", f"synergies=zoo:{exported}")
    assert Experiment(made).config.num_synergies == 2
    assert "synergies=zoo:toy" in command_of(made, composed, CONF, "toy")
    assert str(exported) not in command_of(made, composed, CONF, "toy")


def test_card_command_ignores_a_local_conf_folder(tmp_path, monkeypatch):
    (own := tmp_path / "conf" / "synergies").mkdir(parents=True)
    (own / "a_wide.yaml").write_text("kind: nmf")
    (own / "broken.yaml").write_text("a: [")
    monkeypatch.chdir(tmp_path)
    made = composed(["env=overactuated", "synergies=nmf"])
    assert "synergies=nmf" in command_of(made, composed, CONF, "toy")


@pytest.mark.parametrize("choice", ["synergies=zoo:{}", "method=sac", "method=lattice"])
def test_card_command_of_a_run_without_stage_1_gives_the_same_config(choice, exported):
    made = Experiment(tiny("run_dir=unused", choice.format(exported))).config
    told = shlex.split(command_of(made, composed, CONF, exported))
    again = Experiment(composed(translate([*told[2:], "run_dir=unused"], CONF))).config
    assert without_output_settings(again) == without_output_settings(made)


def rewrite(entry, **changes):
    card = json.loads((entry / "card.json").read_text())
    (entry / "card.json").write_text(json.dumps({**card, **changes}))


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def swap_weights(entry, value=0.0):
    weights = safetensors.torch.save({"weight": torch.full((2,), value)})
    (entry / "policy.safetensors").write_bytes(weights)
    rewrite(entry, sha256=hashlib.sha256(weights).hexdigest())


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda entry: cut(entry / "policy.safetensors"), "SHA-256 is not the one in card.json"),
        (lambda entry: (entry / "policy.safetensors").unlink(), "cannot be read"),
        (lambda entry: cut(entry / "card.json"), "is not JSON"),
        (lambda entry: (entry / "card.json").write_text("[]"), "is not a JSON object"),
        (lambda entry: rewrite(entry, format_version=9), "format_version 9"),
        (lambda entry: rewrite(entry, policy=[]), "'policy' in .* is missing, unknown or invalid"),
        (lambda entry: rewrite(entry, more=1), "'more' in .* is missing, unknown or invalid"),
        (lambda entry: rewrite(entry, policy={}), "describes no policy"),
        (lambda entry: rewrite(entry, task={"name": "myoHand"}), "names no task"),
        (lambda entry: rewrite(entry, actuators=["a"] * 16), "not the environment's 16"),
        (lambda entry: rewrite(entry, actuators=[]), "moves 0 actuators"),
        (lambda entry: rewrite(entry, task={"name": "antigravity:T-v0"}), "files may not import"),
        (swap_weights, "do not fit the policy"),
        (lambda entry: swap_weights(entry, torch.nan), "weight of .* is not finite"),
        (lambda entry: shutil.rmtree(entry), "The zoo has no"),
        (lambda entry: (entry / "card.json").unlink(), "holds synergies alone"),
    ],
)
def test_damaged_or_foreign_entry_gives_a_one_line_error(damage, words, entry):
    damage(entry)
    with pytest.raises(ZooError, match=words) as caught:
        zoo.load(entry)
    assert "\n" not in str(caught.value)


def test_entry_whose_replacement_was_interrupted_is_found(entry):
    entry.rename(entry.with_name(f".{entry.name}.previous"))
    zoo.load(entry)


def test_policy_on_another_body_is_refused(exported):
    with pytest.raises(ZooError, match=r"reads 6 observations and the environment gives"):
        zoo.load(exported, env=make_env("cheetah-run"))


def test_export_into_a_folder_that_is_no_entry_is_refused(run, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ZooError, match=r"holds 'thesis.tex'"):
        export_run(run, tmp_path, composed, CONF, episodes=1)
    assert (tmp_path / "thesis.tex").exists()


def test_run_of_a_gpu_is_exported_without_one(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    config = OmegaConf.load(run / "config.yaml")
    OmegaConf.save(OmegaConf.merge(config, {"device": "cuda:7"}), tmp_path / "run" / "config.yaml")
    card = export_run(tmp_path / "run", tmp_path / "toy", composed, CONF, episodes=1)
    assert "device=cuda:7" in card.training["command"]
    assert zoo.load(tmp_path / "toy")


def test_export_and_evaluate_commands(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command("export.py", f"run={run}", "name=toy", "episodes=2") == 0
    assert "zoo.load('zoo/toy')" in capsys.readouterr().out
    assert command("evaluate.py", "zoo=zoo/toy", "episodes=2") == 0
    assert "same return as on its card in each of 2 episodes" in capsys.readouterr().out
    assert (tmp_path / "runs" / "zoo-toy" / "evaluation.json").is_file()
    assert command("export.py", f"run={run}", "part=synergies", "out=hand") == 0
    assert zoo.synergies("hand").name == "hand"
    with pytest.raises(ZooError, match="synergies alone"):
        zoo.load("hand")


@pytest.mark.parametrize(
    ("evaluation", "said"),
    [
        (
            {
                "return": {"mean": 1.0, "low": None, "high": None},
                "episodes": {"returns": [1.0]},
            },
            "1 of 1 episodes differ from its card, which has the return 1.000;",
        ),
        ({}, "evaluation.json"),
    ],
)
def test_evaluate_reads_a_card_of_one_episode_or_none(
    evaluation, said, exported, tmp_path, monkeypatch, capsys
):
    shutil.copytree(exported, tmp_path / "toy")
    rewrite(tmp_path / "toy", evaluation=evaluation, task={"name": "overactuated"})
    monkeypatch.chdir(tmp_path)
    assert command("evaluate.py", "zoo=toy", "episodes=1") == 0
    assert said in capsys.readouterr().out


def test_entry_of_a_custom_task_requires_env_from_the_user(exported, tmp_path, monkeypatch, capsys):
    shutil.copytree(exported, tmp_path / "toy")
    task = json.loads((tmp_path / "toy" / "card.json").read_text())["task"]
    rewrite(tmp_path / "toy", task={**task, "name": "own_toys:OwnToy-v0"})
    made = "'OwnToy-v0', 'torchrl_etl.envs:AnalyticOveractuated', max_episode_steps=25"
    (tmp_path / "own_toys.py").write_text(f"import gymnasium\ngymnasium.register({made})")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert command("evaluate.py", "zoo=toy", "episodes=1") != 0
    assert "if you trust it, pass env=own_toys:OwnToy-v0" in capsys.readouterr().err
    assert command("evaluate.py", "zoo=toy", "env=own_toys:OwnToy-v1", "episodes=1") != 0
    assert "is 'own_toys:OwnToy-v0', not 'own_toys:OwnToy-v1'" in capsys.readouterr().err
    assert "own_toys" not in sys.modules
    assert command("evaluate.py", "zoo=toy", "env=own_toys:OwnToy-v0", "episodes=1") == 0
    assert open_zoo("toy", "own_toys:OwnToy-v0").drivers[0] == "policy"
    sys.modules.pop("own_toys"), gymnasium.registry.pop("OwnToy-v0")


@pytest.mark.parametrize(
    ("recipe", "arguments", "words"),
    [
        ("export.py", [], "no run is given"),
        ("export.py", ["run=nowhere"], "holds no run"),
        ("export.py", ["run=explored"], "has no complete checkpoint of stage 2"),
        ("export.py", ["run=explored", "part=policy"], "part is 'policy'; choose one of"),
        ("export.py", ["run=explored", "name=../pen"], "name is '../pen'; it must not be a path"),
        ("export.py", ["run=explored", "name=.."], "name is '..'; it must not be a path"),
        ("evaluate.py", ["zoo=overactuted"], "nearest: overactuated"),
        ("evaluate.py", ["zoo=a", "run=b"], "both run and zoo are given"),
        ("evaluate.py", ["run=b", "env=a"], "env is only for an entry of the zoo"),
        ("evaluate.py", ["zoo=overactuated", "device=gpu"], "device is 'gpu'; use cpu, cuda or"),
        ("etl_sac.py", ["synergies=zoo:nowhere", "env=overactuated"], "The zoo has no 'nowhere'"),
    ],
)
def test_invalid_export_and_evaluate_arguments_are_refused(
    recipe, arguments, words, run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "explored").mkdir()
    shutil.copy(run / "config.yaml", tmp_path / "explored")
    assert command(recipe, *arguments) != 0
    assert words in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["explored"]
