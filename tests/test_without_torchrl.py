"""Bundles and policies for code with Gymnasium and NumPy alone."""

from __future__ import annotations

import os
import re
import subprocess
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import GymWrapper, TransformedEnv

from tests.configs import ROOT
from tests.test_docs import BLOCK
from torchrl_etl.envs import SynergyActionWrapper, actuator_names, make_env
from torchrl_etl.modules import GMVAE, SynergyDecoder, make_actor, policy_function
from torchrl_etl.synergies import BundleError, save_bundle
from torchrl_etl.transforms import SynergyAction

TASK = "torchrl_etl/Overactuated-v0"
PAGE = ROOT / "docs" / "without_torchrl.md"
PEERS = ROOT / ".venv-peers" / "bin" / "python"


def decoder(residual: float = 0.0) -> SynergyDecoder:
    torch.manual_seed(0)
    return SynergyDecoder(3, 16, residual=residual)


@pytest.fixture
def bundle(tmp_path):
    names = actuator_names("overactuated")
    return save_bundle(decoder(0.5), tmp_path / "synergies", task="toy", actuators=names)


@pytest.mark.parametrize("residual", [0.0, 0.5])
def test_wrapper_equals_the_transform(residual):
    wrapped = SynergyActionWrapper(gymnasium.make(TASK), decoder(residual))
    transformed = TransformedEnv(make_env("overactuated"), SynergyAction(decoder(residual)))
    transformed.set_seed(3)
    state = transformed.reset()
    wrapped.reset(seed=3)
    observation, _ = wrapped.reset()  # TorchRL resets once to seed, then again
    np.testing.assert_array_equal(observation, state["observation"])
    for _ in range(5):
        synergy = transformed.full_action_spec["synergy"].rand()
        assert wrapped.action_space.contains(synergy.numpy())
        state = transformed.step(state.set("synergy", synergy))["next"]
        observation, reward, *_ = wrapped.step(synergy.numpy())
        np.testing.assert_array_equal(observation, state["observation"])
        assert reward == pytest.approx(state["reward"].item())


class DoublePrecision(gymnasium.Env):
    """An env that refuses actions beyond its bounds, which single precision rounds outwards."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-0.3, 0.3, (5,), np.float64)

    def reset(self, **kwargs):
        super().reset(**kwargs)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return np.zeros(2, np.float32), 0.0, False, False, {}


def step_wrapped(decoder, synergy):
    SynergyActionWrapper(DoublePrecision(), decoder).step(np.array([synergy], np.float32))


def step_transformed(decoder, synergy):
    env = TransformedEnv(GymWrapper(DoublePrecision()), SynergyAction(decoder))
    env.step(env.reset().set("synergy", torch.tensor([synergy])))


@pytest.mark.parametrize("step", [step_wrapped, step_transformed])
@pytest.mark.parametrize("synergy", [-1.0, 1.0])
def test_actions_at_bounds_in_double_precision_stay_inside(step, synergy):
    far = torch.full((1, 5), 99.0)
    step(SynergyDecoder.from_directions(torch.zeros(5), far, low=-0.3, high=0.3), synergy)


def test_wrapper_passes_gymnasiums_checker(bundle):
    env = SynergyActionWrapper(gymnasium.make(TASK), bundle)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*different from the unwrapped version.*")
        warnings.filterwarnings("ignore", ".*bounds.*infinity.*|.*Box observation space.*")
        check_env(env)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (3 + 16,))
    again = env.spec.make()
    assert isinstance(again, SynergyActionWrapper) and again.action_space == env.action_space


def test_a_residual_of_a_bundle_can_be_left_out(bundle):
    env = SynergyActionWrapper(gymnasium.make(TASK), bundle, residual=0.0)
    assert env.action_space.shape == (3,)


def test_bundle_must_fit_the_muscles_of_the_environment(tmp_path):
    names = [f"other_{i}" for i in range(16)]
    bundle = save_bundle(decoder(), tmp_path / "synergies", task="toy", actuators=names)
    env = gymnasium.make(TASK)
    with pytest.raises(BundleError, match="no name in common"):
        SynergyActionWrapper(env, bundle)
    with pytest.raises(BundleError, match="There is no synergy bundle"):
        SynergyActionWrapper(env, tmp_path / "nowhere")
    with pytest.raises(TypeError, match="bundle is a GMVAE; pass a bundle's folder, or a decoder"):
        SynergyActionWrapper(env, GMVAE(16, 2))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (SynergyDecoder(3, 15), "writes 15 actuators but the environment has 16"),
        (SynergyDecoder(3, 16, low=0.0), r"acts in \[0, 1\] but the environment in \[-1, 1\]"),
    ],
)
def test_decoder_of_another_body_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        SynergyActionWrapper(gymnasium.make(TASK), given)


def test_discrete_action_space_is_refused():
    with pytest.raises(ValueError, match="continuous actuators"):
        SynergyActionWrapper(gymnasium.make("CartPole-v1"), decoder())


def test_a_policy_function_is_the_policy_without_noise():
    actor = make_actor({"observation": 6}, Bounded(-1, 1, shape=(16,)))
    act, seen = policy_function(actor), np.random.default_rng(0).random((4, 6))
    written = actor[0](TensorDict({"observation": torch.tensor(seen).float()}, [4]))
    np.testing.assert_allclose(act(seen), written["loc"].detach().tanh(), atol=1e-6)
    np.testing.assert_array_equal(act(seen), act(seen.tolist()))
    np.testing.assert_allclose(act(seen[0]), act(seen)[0], atol=1e-6)
    with pytest.raises(ValueError, match="write 'synergy'; otherwise pass other keys"):
        policy_function(actor, action_key="synergy")


def test_a_policy_function_follows_the_dtype_of_the_policy():
    actor = make_actor({"observation": 6}, Bounded(-1, 1, shape=(16,)))
    act, seen = policy_function(actor), np.zeros(6)
    single = act(seen)
    actor.double()
    assert act(seen).dtype == single.dtype == np.float32
    np.testing.assert_allclose(act(seen), single, atol=1e-6)


def blocks() -> tuple[str, str, str]:
    """The page's code for a policy, for synergies, and for Stable-Baselines3."""
    policy, synergies, agent = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    assert "stable_baselines3" in agent
    return policy, synergies, agent


def test_page_runs_with_stable_baselines3(tmp_path):
    if not PEERS.exists():
        pytest.skip("Stable-Baselines3 is not installed; make .venv-peers/.complete installs it.")
    environ = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [str(PEERS), "-c", "\n".join(blocks())]
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_gymnasium_part_of_the_page_runs_and_imports_no_torchrl(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    block = "\n".join(blocks()[:2])
    exec(compile(block, str(PAGE), "exec"), {"__name__": "__main__"})
    assert not re.search(r"(import|from) (torchrl|tensordict)\b(?!_)", block)
    assert not any(tmp_path.iterdir())
