"""The core needs six packages; packages of extras are imported where they are used."""

from __future__ import annotations

import pkgutil
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import torchrl_etl
from torchrl_etl.training import run_folder

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

USE = """
import importlib, sys
sys.modules |= dict.fromkeys({blocked!r})  # their import then fails
for name in {packages!r}:
    package = importlib.import_module(f"torchrl_etl.{{name}}")
    [getattr(package, part) for part in package.__all__ if part != "resumed_config"]

import tempfile
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl_etl import *
from torchrl_etl import envs, analysis, baselines, modules, training
env = make_env("overactuated")
spec, actions = env.action_spec, 2 * torch.rand(64, 16) - 1
gmvae = fit_gmvae(GMVAE.from_spec(spec, latent_dim=2), actions, updates=2)
with tempfile.TemporaryDirectory() as folder:
    decoder = SynergyDecoder.from_gmvae(gmvae, actions)
    save_bundle(decoder, folder, task="overactuated", actuators=envs.actuator_names(env))
    decoder, _ = load_bundle(folder)
width = env.observation_spec["observation"].shape[-1]
steps = TransformedEnv(env, SynergyAction(decoder)).rollout(4)
loss = LeanSACLoss(
    modules.make_actor({{"observation": width}}, decoder.synergy_spec, out_key="synergy"),
    modules.make_critic({{"observation": width, "synergy": 2}}),
    action_spec=decoder.synergy_spec,
)
loss.set_keys(action="synergy")
loss(steps)["loss_actor"].backward()

lacking = {{
    "dm_control": lambda: make_env("dog-run"),
    "myosuite": lambda: make_env("myoHandPose"),
    "pictures": lambda: analysis.synergy_heatmap(decoder, "abcdefghijklmnop", "no.png"),
    "recipes": lambda: training.resumed_config("nowhere"),
    "rivals": lambda: baselines.group_muscles(torch.rand(20, 3), num_groups=2, chunk=10),
    "statistics": lambda: analysis.interval([1.0, 2.0]),
    "synergies": lambda: fit_synergies(actions, kind="pca", num_synergies=2),
}}
for extra, use in lacking.items():
    try:
        use()
    except ImportError as error:
        print(extra, "|", error)
"""


def _names(requirements) -> set[str]:
    """Normalized names of the distributions in a list of requirements."""
    found = (re.match(r"[\w.-]+", requirement)[0] for requirement in requirements)
    return {re.sub(r"[-_.]+", "-", name).lower() for name in found}


def _with_what_they_need(names: set[str]) -> set[str]:
    every, new = set(), names
    while new:
        every |= new
        needed: set[str] = set()
        for name in new:
            try:
                needed |= _names(r for r in requires(name) or () if "extra ==" not in r)
            except PackageNotFoundError:  # a requirement of other systems
                continue
        new = needed - every
    return every


def test_package_imports_without_extras_and_names_a_missing_one():
    core = _with_what_they_need(_names(PROJECT["dependencies"]))
    extras = PROJECT["optional-dependencies"]
    optional = _names(r for name in extras.keys() - {"all", "dev"} for r in extras[name]) - core
    blocked = [
        module
        for module, owners in packages_distributions().items()
        if _names(owners) <= optional and module.isidentifier()
    ]
    assert {"hydra", "matplotlib", "mujoco", "myosuite", "scipy", "sklearn"} <= set(blocked)
    packages = [part.name for part in pkgutil.iter_modules(torchrl_etl.__path__) if part.ispkg]
    code = USE.format(blocked=blocked, packages=packages)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=250, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    told = dict(line.split(" | ") for line in done.stdout.splitlines())
    assert set(told) == {
        *("dm_control", "myosuite", "pictures", "recipes", "rivals", "statistics", "synergies")
    }
    for extra, sentence in told.items():
        assert f"pip install 'torchrl_etl[{extra}]'" in sentence


def test_top_level_exports_are_those_of_the_subpackages():
    assert sorted(torchrl_etl.__all__) == sorted(sum(torchrl_etl._HOMES.values(), ()))
    for home, names in torchrl_etl._HOMES.items():
        for name in names:
            part = __import__(f"torchrl_etl.{home}", fromlist=[name])
            assert getattr(torchrl_etl, name) is getattr(part, name)
    assert (Path(torchrl_etl.__file__).parent / "py.typed").is_file()


def test_extras_named_in_code_exist_and_all_lists_every_extra():
    sources = (ROOT / "torchrl_etl").rglob("*.py")
    named = {
        n for path in sources for n in re.findall(r'extra\("(\w+)"\)', path.read_text("utf-8"))
    }
    extras = PROJECT["optional-dependencies"]
    assert named <= set(extras)
    (every,) = extras["all"]
    listed = set(re.search(r"\[(.*)\]", every)[1].split(","))
    assert listed == set(extras) - {"all", "dev", "slurm"}


def test_facts_of_a_run_leave_out_packages_that_are_not_installed(monkeypatch):
    monkeypatch.setattr(run_folder, "_PACKAGES", ("numpy", "not-installed"))
    found = run_folder.facts()
    assert found["numpy"] and "not-installed" not in found
