"""DEP: when it replaces the policy's actions, alone and in a collector."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Unbounded
from torchrl.envs import ExplorationType, InitTracker, TransformedEnv, set_exploration_type

from tests.test_baselines_dep import MUSCLES, SPEC
from torchrl_etl.baselines.dep import DEPController, DEPExploration
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import make_env
from torchrl_etl.modules import make_actor

POLICY_ACTION = 0.123


def replaced(
    module: DEPExploration,
    steps: int,
    rows: int = 2,
    *,
    episode: int | None = None,
    kind: ExplorationType | None = ExplorationType.RANDOM,
) -> Tensor:
    """Whether the module replaced the policy's actions: [steps, rows]."""
    batches = []
    for step in range(steps):
        td = TensorDict({"muscle_length": torch.rand(rows, MUSCLES)}, [rows])
        td["action"] = torch.full((rows, MUSCLES), POLICY_ACTION)
        if episode is not None:
            td["is_init"] = torch.full((rows, 1), step % episode == 0)
        with set_exploration_type(kind):
            batches.append(module(td)["action"])
    return (torch.stack(batches) != POLICY_ACTION).any(-1)


def run_lengths(replaced: Tensor) -> list[int]:
    """Lengths of the runs of True."""
    runs, length = [], 0
    for value in [*replaced.tolist(), False]:
        if value:
            length += 1
        elif length:
            runs.append(length)
            length = 0
    return runs


def test_dep_acts_alone_for_its_frames_and_the_policy_afterwards() -> None:
    module = DEPExploration(SPEC, dep_actions=20, probability=0.0)
    acted = replaced(module, 30, rows=2)
    assert acted[:10].all() and not acted[10:].any()
    assert module.seen == 60


@pytest.mark.parametrize("length", [1, 5])
def test_bursts_last_exactly_intervention_length(length: int) -> None:
    module = DEPExploration(SPEC, dep_actions=0, probability=0.1, intervention_length=length)
    acted = replaced(module, 400, rows=3)
    for row in acted.T:
        runs = run_lengths(row)
        if row[-1]:
            runs.pop()  # it may be cut off
        assert len(runs) > 5 and set(runs) == {length}
    assert not torch.equal(acted[:, 0], acted[:, 1])  # each row draws for itself


def test_bursts_begin_with_the_given_probability() -> None:
    """Bursts per step of the policy are the probability p, within 3 sigma."""
    p, rows, steps = 0.02, 50, 300
    acted = replaced(DEPExploration(SPEC, dep_actions=0, probability=p), steps, rows)
    begins = (acted[1:] & ~acted[:-1]).sum().item()
    policys = (~acted).sum().item()
    assert abs(begins / policys - p) < 3 * math.sqrt(p / policys)


def test_every_third_episode_is_the_policys() -> None:
    module = DEPExploration(SPEC, dep_actions=0, probability=0.5)
    acted = replaced(module, 9 * 20, episode=20).view(9, 20, 2)
    for episode in range(9):
        assert acted[episode].any(0).all() == (episode % 3 != 2), episode
        assert not acted[episode, 0].any()  # a burst ends with its episode


def test_initial_dep_actions_include_the_third_episode() -> None:
    assert replaced(DEPExploration(SPEC, dep_actions=10_000), 40, episode=10).all()


def test_without_is_init_all_steps_are_one_episode() -> None:
    module = DEPExploration(SPEC, dep_actions=0, probability=1.0, policy_every=2)
    assert replaced(module, 20).any()
    module = DEPExploration(SPEC, dep_actions=0, probability=1.0, policy_every=1)
    assert not replaced(module, 20).any()


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, None])
def test_dep_is_inactive_unless_exploration_is_random(
    kind: ExplorationType | None,
) -> None:
    module = DEPExploration(SPEC, dep_actions=100)
    replaced(module, 10)
    before = copy.deepcopy(vars(module.controller))
    assert not replaced(module, 5, rows=7, kind=kind).any()
    assert module.seen == 20
    for name, value in vars(module.controller).items():
        if isinstance(value, Tensor):
            assert torch.equal(value, before[name]), name
        else:
            assert value == before[name], name


def test_controller_adapts_while_the_policy_acts() -> None:
    """The action of a burst is that of a controller that saw every step."""
    module = DEPExploration(SPEC, dep_actions=0, probability=0.0)
    alone = DEPController(2, MUSCLES)
    for step in range(30):
        module.dep_actions = 0 if step < 29 else 1_000
        td = TensorDict({"muscle_length": torch.rand(2, MUSCLES)}, [2])
        td["action"] = torch.full((2, MUSCLES), POLICY_ACTION)
        command = alone.step(td["muscle_length"])
        with set_exploration_type(ExplorationType.RANDOM):
            module(td)
    torch.testing.assert_close(td["action"], (command + 1) / 2)


def test_first_step_of_an_episode_records_no_movement() -> None:
    module = DEPExploration(SPEC, dep_actions=0)
    replaced(module, 11, episode=10)
    assert not module.controller.moves[:, 0].any()
    replaced(module, 1)
    assert module.controller.moves[:, 0].all()


def test_actions_fill_the_bounds_of_the_spec() -> None:
    low, high = torch.tensor([-3.0, 0.0, 1.0]), torch.tensor([-1.0, 1.0, 9.0])
    module = DEPExploration(Bounded(low, high))
    for _ in range(40):
        td = TensorDict({"muscle_length": torch.rand(4, 3), "action": torch.zeros(4, 3)}, [4])
        with set_exploration_type(ExplorationType.RANDOM):
            action = module(td)["action"]
        assert (action >= low).all() and (action <= high).all()
    assert ((action - low) / (high - low)).min() < 0.1
    assert ((action - low) / (high - low)).max() > 0.9


def test_same_seed_same_actions() -> None:
    seen = []
    for _ in range(2):
        torch.manual_seed(3)
        seen.append(replaced(DEPExploration(SPEC, dep_actions=0, probability=0.1), 50))
    assert torch.equal(*seen)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_batch_shapes_and_nested_keys(batch: tuple[int, ...]) -> None:
    module = DEPExploration(
        SPEC,
        action_key=("agent", "action"),
        length_key=("agent", "length"),
        init_key=("agent", "begins"),
    )
    assert module.in_keys == [("agent", "length"), ("agent", "action"), ("agent", "begins")]
    assert module.out_keys == [("agent", "action")]
    for step in range(30):
        length, action = torch.rand(2, *batch, MUSCLES)
        entries = {"length": length, "action": action.clone()}
        entries["begins"] = torch.full((*batch, 1), step == 0)
        td = TensorDict({"agent": entries}, batch)
        with set_exploration_type(ExplorationType.RANDOM):
            out = module(td)
    assert set(out["agent"].keys()) == {"length", "action", "begins"}
    assert out["agent", "action"].shape == action.shape
    assert not torch.isclose(out["agent", "action"], action).any()
    assert torch.equal(out["agent", "length"], length)


def test_rows_are_independent() -> None:
    lengths, others = torch.rand(2, 60, 3, MUSCLES)
    others[:, 1] = lengths[:, 1]
    seen = []
    for series in (lengths, others):
        torch.manual_seed(1)
        module = DEPExploration(SPEC, dep_actions=60, probability=0.2)
        actions = []
        for entry in series:
            td = TensorDict({"muscle_length": entry, "action": torch.zeros_like(entry)}, [3])
            with set_exploration_type(ExplorationType.RANDOM):
                actions.append(module(td)["action"])
        seen.append(torch.stack(actions))
    assert torch.equal(seen[0][:, 1], seen[1][:, 1])
    assert not torch.equal(seen[0][:, 0], seen[1][:, 0])


def test_new_batch_size_resets_the_controller_and_keeps_the_frame_count() -> None:
    module = DEPExploration(SPEC, dep_actions=20, probability=0.0)
    replaced(module, 10, rows=2)
    assert module.controller.moves.any()
    assert not replaced(module, 1, rows=3).any()  # the initial frames of DEP are over
    assert module.controller.rows == 3 and module.seen == 23
    assert not module.controller.moves.any()


def test_state_dict_excludes_memory_and_copies_are_independent() -> None:
    module = DEPExploration(SPEC)
    replaced(module, 10)
    assert not module.state_dict() and not list(module.parameters())
    other = copy.deepcopy(module)
    replaced(other, 5)
    assert (module.seen, other.seen) == (20, 30)
    before = module.controller.moves
    module.load_state_dict(DEPExploration(SPEC).state_dict())
    assert torch.equal(module.controller.moves, before) and module.seen == 20


def test_module_follows_device_and_dtype() -> None:
    module = DEPExploration(SPEC).to("meta")
    assert module.low.is_meta
    module = DEPExploration(SPEC).double()
    assert replaced(module, 3).all() and module.low.dtype == torch.float64


# Bad input ---------------------------------------------------------------------------------------


def test_bad_specs_and_settings_are_refused() -> None:
    with pytest.raises(TypeError, match=r"pass the action's Bounded leaf"):
        DEPExploration(Unbounded((3,)))
    with pytest.raises(ValueError, match=r"shape \[2, 3\].*pass the unbatched one"):
        DEPExploration(Bounded(0, 1, shape=(2, 3)))
    with pytest.raises(TypeError, match="kapa"):
        DEPExploration(SPEC, kapa=3)
    for settings in ({"probability": 1.5}, {"probability": -0.1}, {"dep_actions": -1}):
        with pytest.raises(ValueError, match=rf"{next(iter(settings))} is -?[\d.]+; it must be"):
            DEPExploration(SPEC, **settings)
    for settings in ({"intervention_length": 0}, {"policy_every": 0}):
        with pytest.raises(ValueError, match="whole number, 1 or more"):
            DEPExploration(SPEC, **settings)


def test_missing_or_wrong_muscle_lengths_are_refused() -> None:
    module = DEPExploration(SPEC)
    td = TensorDict({"action": torch.zeros(2, 3)}, [2])
    with set_exploration_type(ExplorationType.RANDOM):
        with pytest.raises(KeyError, match=r"make_env\(\.\.\., muscle_lengths=True\)"):
            module(td)
        with pytest.raises(ValueError, match="4 entries for 3 actuators"):
            module(td.set("muscle_length", torch.zeros(2, 4)))


# In a collector ----------------------------------------------------------------------------------


@pytest.mark.parametrize("collector_class", [Collector, VectorCollector])
def test_collector_records_deps_actions(collector_class: type[Collector]) -> None:
    env = make_env("myoHandPose", num_envs=2, seed=0, muscle_lengths=True)
    env = TransformedEnv(env, InitTracker())
    spec = env.full_action_spec_unbatched["action"]
    constant = TensorDictModule(
        lambda observation: observation.new_full((*observation.shape[:-1], 39), POLICY_ACTION),
        in_keys=["observation"],
        out_keys=["action"],
    )
    dep = DEPExploration(spec, dep_actions=40, probability=0.0)
    policy = TensorDictSequential(constant, dep)
    collector = collector_class(env, policy, frames_per_batch=210, total_frames=210)
    try:
        (batch,) = list(collector)
    finally:
        collector.shutdown()
    assert (batch["action"][:, :20] != POLICY_ACTION).all()
    assert (batch["action"][:, 20:] == POLICY_ACTION).all()
    assert batch["action"][:, 10:20].abs().mean() > 0.5  # DEP drives muscles to their ends
    assert dep._episode.tolist() == [2, 2] and dep.seen == 210  # episodes are 100 steps long


def test_dep_leaves_the_gradient_of_the_actor_intact() -> None:
    """DEP replaces the sampled action and leaves the distribution that the loss evaluates."""
    actor = make_actor({"observation": 2}, SPEC, hidden=(8,))
    policy = TensorDictSequential(actor, DEPExploration(SPEC))
    td = TensorDict({"observation": torch.randn(4, 2), "muscle_length": torch.rand(4, 3)}, [4])
    with set_exploration_type(ExplorationType.RANDOM):
        out = policy(td)
    assert not out["action"].requires_grad
    out["loc"].sum().backward()
    assert all(parameter.grad is not None for parameter in actor.parameters())
