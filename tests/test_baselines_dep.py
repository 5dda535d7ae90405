"""DEP: its equations against numbers worked by hand, and when it takes the policy's place."""

from __future__ import annotations

import copy
import math
from itertools import pairwise
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded, Unbounded
from torchrl.envs import ExplorationType, InitTracker, TransformedEnv, set_exploration_type

from torchrl_etl.baselines.dep import DEPController, DEPExploration
from torchrl_etl.collectors import VectorCollector
from torchrl_etl.envs import make_env
from torchrl_etl.modules import make_actor

MUSCLES = 3
POLICY_ACTION = 0.123
SPEC = Bounded(0, 1, shape=(MUSCLES,))


# The controller ----------------------------------------------------------------------------------

# A joint at these angles, which two antagonists follow: one is as long as the other is short.
ANGLES = (0.0, 0.9, 0.4, 0.6)
# Sensors over a range of 0.9 + 0.1 = 1 are s1 = 2a - 1 and s2 = 0.8 - 2a, but for the first angle,
# where the range is 0.1 and each length at its lower end.
SENSORS = ((-1.0, -1.0), (0.8, -1.0), (-0.2, 0.0), (0.2, -0.4))
MOVES = ((0.0, 0.0), (1.8, 0.0), (-1.0, 1.0), (0.4, -0.4))


def antagonists(**settings: Any) -> tuple[DEPController, list[Tensor]]:
    settings = {"kappa": 2.0, "tau": 2, "time_distance": 1, "s4avg": 1.0, **settings}
    controller = DEPController(1, 2, **settings)
    return controller, [controller.step(torch.tensor([[a, -a]])) for a in ANGLES]


def close(value: Tensor, expected: Any) -> None:
    torch.testing.assert_close(value, torch.tensor(expected), atol=1e-5, rtol=0)


def test_sensors_and_movements_of_two_antagonists() -> None:
    controller = DEPController(1, 2, s4avg=1.0)
    for angle, sensors, move in zip(ANGLES, SENSORS, MOVES, strict=True):
        controller.step(torch.tensor([[angle, -angle]]))
        close(controller.sensed[0], sensors)
        close(controller.moves[0, 0], move)


def test_sensor_is_smoothed_from_the_second_step_on() -> None:
    controller = DEPController(1, 2, s4avg=4.0)
    x = torch.tensor(SENSORS[0])
    for angle, sensors in zip(ANGLES, SENSORS, strict=True):
        controller.step(torch.tensor([[angle, -angle]]))
        x = 0.75 * x + 0.25 * torch.tensor(sensors)
        close(controller.sensed[0], x.tolist())


def test_matrix_of_two_antagonists() -> None:
    """C = -[Δx3 Δx2ᵀ + Δx2 Δx1ᵀ]: the antagonists get opposite rows."""
    controller, _ = antagonists()
    close(controller.matrix()[0], [[2.2, -0.4], [-2.2, 0.4]])


def test_commands_and_bias_of_two_antagonists() -> None:
    controller, (first, second, third, fourth) = antagonists(bias_rate=0.1)
    assert not first.any() and not second.any()  # no movement follows another yet
    # C x is along (-1, 1), then along (1, -1), so that κq is ±2/√2 without a bias.
    y = math.tanh(math.sqrt(2))
    close(third[0], [-y, y])
    # bias_rate·y = 0.089 is clipped to 0.05.
    close(controller.bias[0], [0.05, -0.05])
    close(fourth[0], [math.tanh(math.sqrt(2) + 0.05), -math.tanh(math.sqrt(2) + 0.05)])


def test_bias_is_worn_down_and_decays() -> None:
    controller, (*_, third, fourth) = antagonists(bias_rate=0.01)
    close(controller.bias, (-0.01 * third).tolist())
    before = controller.bias = torch.tensor([[0.5, -0.25]])
    controller.step(torch.tensor([[0.7, -0.7]]))
    close(controller.bias, (before - 0.01 * fourth - 0.001 * before).tolist())


def test_rows_are_normalised_by_kappa() -> None:
    """Rows (3, 4), (0, -2) become κ(0.6, 0.8), κ(0, -1): q is along (1.4, -1) for x = (1, 1)."""
    controller = DEPController(1, 2, kappa=0.5, tau=1, time_distance=1, bias_rate=0.0)
    controller.matrix = lambda: torch.tensor([[[3.0, 4.0], [0.0, -2.0]]])
    controller._sense = lambda lengths: setattr(controller, "sensed", lengths)
    norm = math.hypot(1.4, 1)
    expected = [math.tanh(0.5 * 1.4 / norm), math.tanh(-0.5 / norm)]
    close(controller.step(torch.ones(1, 2))[0], expected)


@pytest.mark.parametrize(("tau", "distance", "steps"), [(4, 2, 12), (3, 5, 20), (40, 5, 12)])
def test_matrix_is_the_sum_of_the_paper(tau: int, distance: int, steps: int) -> None:
    torch.manual_seed(0)
    rows, n = 2, 3
    controller = DEPController(rows, n, tau=tau, time_distance=distance, dtype=torch.float64)
    sensed = []
    for _ in range(steps):
        controller.step(torch.rand(rows, n, dtype=torch.float64))
        sensed.append(controller.sensed)
    moves = [torch.zeros_like(sensed[0])] + [b - a for a, b in pairwise(sensed)]
    expected = torch.zeros(rows, n, n, dtype=torch.float64)
    for row in range(rows):
        for k in range(tau):
            late, early = steps - 1 - k, steps - 1 - k - distance
            if early >= 0:
                for i in range(n):
                    for j in range(n):
                        expected[row, i, j] -= moves[late][row, i] * moves[early][row, j]
    torch.testing.assert_close(controller.matrix(), expected)


def test_a_body_at_rest_is_left_at_rest() -> None:
    controller = DEPController(2, 4)
    for _ in range(60):
        command = controller.step(torch.full((2, 4), 0.3))
    assert not command.any()


def test_commands_are_bounded_and_finite_for_any_lengths() -> None:
    torch.manual_seed(0)
    for size in (1e-8, 1.0, 1e4):
        controller = DEPController(3, 5)
        for _ in range(60):
            command = controller.step(size * torch.randn(3, 5))
        assert command.isfinite().all() and command.abs().max() <= 1


def test_a_reset_is_no_movement_and_forgets_nothing_else() -> None:
    torch.manual_seed(0)
    controller = DEPController(3, 4)
    for _ in range(20):
        controller.step(torch.rand(3, 4))
    before = copy.deepcopy(controller)
    controller.reset(torch.tensor([False, True, False]))
    controller.step(torch.full((3, 4), 0.5))
    assert not controller.moves[1, 0].any() and controller.moves[[0, 2], 0].all()
    assert torch.equal(controller.moves[:, 1:], before.moves[:, :-1])
    assert torch.equal(controller.shortest, before.shortest)
    # Without smoothing across the reset.
    sensor = 2 * ((0.5 - before.shortest[1]) / (before.longest - before.shortest + 0.1)[1] - 0.5)
    torch.testing.assert_close(controller.sensed[1], sensor)


def test_rows_of_the_controller_are_independent() -> None:
    torch.manual_seed(0)
    lengths, others = torch.rand(2, 30, 3, 4)
    others[:, 1] = lengths[:, 1]
    one, other = DEPController(3, 4), DEPController(3, 4)
    for a, b in zip(lengths, others, strict=True):
        first, second = one.step(a), other.step(b)
        assert torch.equal(first[1], second[1])
    assert not torch.isclose(first[0], second[0]).all()


@pytest.mark.parametrize(
    "settings", [{"kappa": 0}, {"tau": 0}, {"time_distance": 0}, {"bias_rate": -1}, {"s4avg": 0.5}]
)
def test_settings_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"positive"):
        DEPExploration(SPEC, **settings)


# In place of the policy ---------------------------------------------------------------------------


def replaced(
    module: DEPExploration,
    steps: int,
    rows: int = 2,
    *,
    episode: int | None = None,
    ids: bool = False,
    kind: ExplorationType | None = ExplorationType.RANDOM,
) -> Tensor:
    """Whether the module replaced the policy's actions: [steps, rows]."""
    batches = []
    for step in range(steps):
        td = TensorDict({"muscle_length": torch.rand(rows, MUSCLES)}, [rows])
        td["action"] = torch.full((rows, MUSCLES), POLICY_ACTION)
        if episode is not None and ids:
            td["collector", "traj_ids"] = torch.arange(rows) + rows * (step // episode)
        elif episode is not None:
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
    module = DEPExploration(SPEC, dep_frames=20, probability=0.0)
    acted = replaced(module, 30, rows=2)
    assert acted[:10].all() and not acted[10:].any()
    assert module.frames == 60


@pytest.mark.parametrize("length", [1, 5])
def test_bursts_last_exactly_their_length(length: int) -> None:
    torch.manual_seed(0)
    module = DEPExploration(SPEC, dep_frames=0, probability=0.1, intervention_length=length)
    acted = replaced(module, 400, rows=3)
    for row in acted.T:
        runs = run_lengths(row)
        if row[-1]:
            runs.pop()  # it may be cut off
        assert len(runs) > 5 and set(runs) == {length}
    assert not torch.equal(acted[:, 0], acted[:, 1])  # each row draws for itself


def test_share_of_bursts_is_that_of_the_probability() -> None:
    """A policy's step begins a burst with p: bursts per policy's step are p, within 3 sigma."""
    torch.manual_seed(0)
    p, rows, steps = 0.02, 50, 300
    acted = replaced(DEPExploration(SPEC, dep_frames=0, probability=p), steps, rows)
    begins = (acted[1:] & ~acted[:-1]).sum().item()
    policys = (~acted).sum().item()
    assert abs(begins / policys - p) < 3 * math.sqrt(p / policys)


@pytest.mark.parametrize("ids", [False, True])
def test_every_third_episode_is_the_policys(ids: bool) -> None:
    torch.manual_seed(0)
    key = ("collector", "traj_ids") if ids else "is_init"
    module = DEPExploration(SPEC, dep_frames=0, probability=0.5, episode_key=key)
    acted = replaced(module, 9 * 20, episode=20, ids=ids).view(9, 20, 2)
    for episode in range(9):
        assert acted[episode].any(0).all() == (episode % 3 != 2), episode
        assert not acted[episode, 0].any()  # a burst ends with its episode


def test_dep_alone_also_takes_the_third_episode() -> None:
    assert replaced(DEPExploration(SPEC, dep_frames=10_000), 40, episode=10).all()


def test_without_an_episode_entry_all_is_one_episode() -> None:
    module = DEPExploration(SPEC, dep_frames=0, probability=1.0, policy_every=2)
    assert replaced(module, 20).any()
    module = DEPExploration(SPEC, dep_frames=0, probability=1.0, policy_every=1)
    assert not replaced(module, 20).any()


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, None])
def test_it_passes_through_and_does_not_adapt_unless_exploration_is_random(
    kind: ExplorationType | None,
) -> None:
    module = DEPExploration(SPEC, dep_frames=100)
    replaced(module, 10)
    before = copy.deepcopy(vars(module.controller))
    assert not replaced(module, 5, rows=7, kind=kind).any()
    assert module.frames == 20
    for name, value in vars(module.controller).items():
        assert torch.equal(torch.as_tensor(value), torch.as_tensor(before[name])), name


def test_it_adapts_while_the_policy_acts() -> None:
    """The action of a burst is the one of a controller that saw every step."""
    torch.manual_seed(0)
    module = DEPExploration(SPEC, dep_frames=0, probability=0.0)
    alone = DEPController(2, MUSCLES)
    for step in range(30):
        module.dep_frames = 0 if step < 29 else 1_000
        td = TensorDict({"muscle_length": torch.rand(2, MUSCLES)}, [2])
        td["action"] = torch.full((2, MUSCLES), POLICY_ACTION)
        command = alone.step(td["muscle_length"])
        with set_exploration_type(ExplorationType.RANDOM):
            module(td)
    torch.testing.assert_close(td["action"], (command + 1) / 2)


def test_an_episodes_first_lengths_are_no_movement() -> None:
    module = DEPExploration(SPEC, dep_frames=0)
    replaced(module, 11, episode=10)
    assert not module.controller.moves[:, 0].any()
    replaced(module, 1)
    assert module.controller.moves[:, 0].all()


def test_actions_fill_the_bounds_of_the_spec() -> None:
    torch.manual_seed(0)
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
        seen.append(replaced(DEPExploration(SPEC, dep_frames=0, probability=0.1), 50))
    assert torch.equal(*seen)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_batch_shapes_and_nested_keys(batch: tuple[int, ...]) -> None:
    module = DEPExploration(
        SPEC,
        action_key=("agent", "action"),
        length_key=("agent", "length"),
        episode_key=("agent", "begins"),
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


def test_rows_do_not_depend_on_others() -> None:
    torch.manual_seed(0)
    lengths, others = torch.rand(2, 60, 3, MUSCLES)
    others[:, 1] = lengths[:, 1]
    seen = []
    for series in (lengths, others):
        torch.manual_seed(1)
        module = DEPExploration(SPEC, dep_frames=60, probability=0.2)
        actions = []
        for entry in series:
            td = TensorDict({"muscle_length": entry, "action": torch.zeros_like(entry)}, [3])
            with set_exploration_type(ExplorationType.RANDOM):
                actions.append(module(td)["action"])
        seen.append(torch.stack(actions))
    assert torch.equal(seen[0][:, 1], seen[1][:, 1])
    assert not torch.equal(seen[0][:, 0], seen[1][:, 0])


def test_another_number_of_rows_starts_anew_but_for_the_frames() -> None:
    torch.manual_seed(0)
    module = DEPExploration(SPEC, dep_frames=20, probability=0.0)
    replaced(module, 10, rows=2)
    assert module.controller.moves.any()
    assert not replaced(module, 1, rows=3).any()  # the frames that were DEP's are over
    assert module.controller.rows == 3 and module.frames == 23
    assert not module.controller.moves.any()


def test_memory_is_not_in_the_state_dict_and_copies_are_independent() -> None:
    module = DEPExploration(SPEC)
    replaced(module, 10)
    assert not module.state_dict() and not list(module.parameters())
    other = copy.deepcopy(module)
    replaced(other, 5)
    assert (module.frames, other.frames) == (20, 30)
    before = module.controller.moves
    module.load_state_dict(DEPExploration(SPEC).state_dict())
    assert torch.equal(module.controller.moves, before) and module.frames == 20


def test_no_device_is_cached() -> None:
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
    for settings in ({"probability": 1.5}, {"probability": -0.1}, {"dep_frames": -1}):
        with pytest.raises(ValueError, match="probability at most 1"):
            DEPExploration(SPEC, **settings)
    for settings in ({"intervention_length": 0}, {"policy_every": 0}):
        with pytest.raises(ValueError, match="positive integer"):
            DEPExploration(SPEC, **settings)


def test_missing_or_foreign_lengths_are_explained() -> None:
    module = DEPExploration(SPEC)
    td = TensorDict({"action": torch.zeros(2, 3)}, [2])
    with set_exploration_type(ExplorationType.RANDOM):
        with pytest.raises(KeyError, match=r"make_env\(\.\.\., muscle_lengths=True\)"):
            module(td)
        with pytest.raises(ValueError, match="4 entries for 3 actuators"):
            module(td.set("muscle_length", torch.zeros(2, 4)))


# In a collector ----------------------------------------------------------------------------------


@pytest.mark.parametrize("collector_class", [Collector, VectorCollector])
def test_a_collector_records_what_dep_did(collector_class: type[Collector]) -> None:
    env = make_env("myoHandPose", num_envs=2, seed=0, muscle_lengths=True)
    key: Any = ("collector", "traj_ids")
    if collector_class is Collector:
        env, key = TransformedEnv(env, InitTracker()), "is_init"
    spec = env.full_action_spec_unbatched["action"]
    constant = TensorDictModule(
        lambda observation: observation.new_full((*observation.shape[:-1], 39), POLICY_ACTION),
        in_keys=["observation"],
        out_keys=["action"],
    )
    dep = DEPExploration(spec, dep_frames=40, probability=0.0, episode_key=key)
    policy = TensorDictSequential(constant, dep)
    collector = collector_class(env, policy, frames_per_batch=210, total_frames=210)
    try:
        (batch,) = list(collector)
    finally:
        collector.shutdown()
    assert (batch["action"][:, :20] != POLICY_ACTION).all()
    assert (batch["action"][:, 20:] == POLICY_ACTION).all()
    assert batch["action"][:, 10:20].abs().mean() > 0.5  # DEP drives muscles to their ends
    assert dep._episode.tolist() == [2, 2] and dep.frames == 210  # episodes are 100 steps long


def test_a_policy_with_an_actor_gives_its_loss_the_actors_gradient() -> None:
    """DEP replaces what was sampled, and leaves alone what the loss evaluates."""
    actor = make_actor({"observation": 2}, SPEC, hidden=(8,))
    policy = TensorDictSequential(actor, DEPExploration(SPEC))
    td = TensorDict({"observation": torch.randn(4, 2), "muscle_length": torch.rand(4, 3)}, [4])
    with set_exploration_type(ExplorationType.RANDOM):
        out = policy(td)
    assert not out["action"].requires_grad
    out["loc"].sum().backward()
    assert all(parameter.grad is not None for parameter in actor.parameters())
