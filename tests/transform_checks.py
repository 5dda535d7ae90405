"""Checks that every transform of this library must pass."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import MultiStep
from torchrl.envs import (
    CatFrames,
    EnvBase,
    ObservationNorm,
    ParallelEnv,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from tests.point_env import PointEnv, TeamEnv, vectorized_point

WORKERS = 2


def rolled(env: EnvBase) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(3)


def collected(env: EnvBase, postproc) -> TensorDictBase:
    torch.manual_seed(0)
    collector = Collector(env, None, frames_per_batch=12, total_frames=12, postproc=postproc)
    (batch,) = collector
    collector.shutdown()
    return batch


class TransformChecks(ABC):
    """Subclass as ``TestX``, give :meth:`transform`, and fill in the checks of values.

    Layouts are checked here, alike for every transform. The abstract checks depend on the values
    of a transform, so its test class must define them.
    """

    @staticmethod
    @abstractmethod
    def transform(nested: bool = False) -> Transform:
        """The transform (with those it needs before it) for a :class:`PointEnv`.

        A static method so that worker processes can import it.
        """

    @classmethod
    def env(cls, *, nested: bool = False, batch_size: tuple[int, ...] = ()) -> EnvBase:
        return TransformedEnv(PointEnv(batch_size, nested), cls.transform(nested))

    @classmethod
    def worker_envs(cls) -> list[Callable[[], EnvBase]]:
        """Constructors of the envs of collector workers, with the same keys and values."""
        return [cls.env] * WORKERS

    # Layouts

    @pytest.mark.parametrize("nested", [False, True])
    def test_single_env_keeps_its_specs(self, nested):
        check_env_specs(self.env(nested=nested), break_when_any_done="both")

    @pytest.mark.parametrize("nested", [False, True])
    def test_batched_env_keeps_its_specs(self, nested):
        check_env_specs(self.env(nested=nested, batch_size=(3,)), break_when_any_done="both")

    @pytest.mark.parametrize("nested", [False, True])
    def test_serial_env_of_transformed_envs_keeps_its_specs(self, nested):
        check_env_specs(SerialEnv(WORKERS, partial(self.env, nested=nested)))

    @pytest.mark.parametrize("nested", [False, True])
    def test_transformed_serial_env_keeps_its_specs(self, nested):
        serial = SerialEnv(WORKERS, partial(PointEnv, nested=nested))
        check_env_specs(TransformedEnv(serial, self.transform(nested)))

    @pytest.mark.slow
    def test_parallel_env_of_transformed_envs_keeps_its_specs(self):
        parallel = ParallelEnv(WORKERS, self.env, mp_start_method="fork")
        try:
            check_env_specs(parallel)
            self.check_values(parallel.rollout(3, break_when_any_done=True))
            self.check_values(parallel.rollout(6, break_when_any_done=False))
        finally:
            parallel.close(raise_if_closed=False)

    @pytest.mark.slow
    def test_transformed_parallel_env_keeps_its_specs(self):
        parallel = ParallelEnv(WORKERS, PointEnv, mp_start_method="fork")
        env = TransformedEnv(parallel, self.transform())
        try:
            check_env_specs(env)
            self.check_values(env.rollout(6, break_when_any_done=False))
        finally:
            env.close(raise_if_closed=False)

    def test_env_vectorized_below_torchrl_keeps_its_specs_and_values(self):
        env = TransformedEnv(vectorized_point(), self.transform())
        check_env_specs(env)
        self.check_values(env.rollout(9, break_when_any_done=False))

    def test_cloned_transform_serves_an_env_of_another_batch_size(self):
        env = self.env(batch_size=(3,))
        env.rollout(2)
        other = TransformedEnv(PointEnv((2,)), env.transform.clone())
        check_env_specs(other)

    def test_transform_appended_one_by_one_gives_the_same_specs(self):
        env = TransformedEnv(PointEnv((2,)))
        env.append_transform(self.transform())
        assert env.specs == self.env(batch_size=(2,)).specs

    # Values

    @abstractmethod
    def check_values(self, rollout) -> None:
        """Check the values of a rollout of any layout (flat keys, time last)."""

    @pytest.mark.parametrize("batch_size", [(), (3,)])
    def test_rollout_values_are_right(self, batch_size):
        self.check_values(self.env(batch_size=batch_size).rollout(9, break_when_any_done=False))

    def test_values_are_right_in_serial_envs_that_are_stepped_by_hand(self):
        self.check_values(SerialEnv(WORKERS, self.env).rollout(3, break_when_any_done=True))

    def test_values_are_right_across_autoresets_in_serial_envs(self):
        self.check_values(SerialEnv(WORKERS, self.env).rollout(9, break_when_any_done=False))

    def test_partial_reset_leaves_the_other_envs_alone(self):
        env = self.env(batch_size=(3,))
        state = env.rollout(3, break_when_any_done=False)[:, -1]["next"].exclude("reward")
        mask = torch.tensor([[False], [True], [False]])
        after = env.reset(state.clone().set("_reset", mask))
        keys = list(env.observation_spec.keys(True, True))
        for other in (0, 2):
            for key in keys:
                assert torch.equal(after[other][key], state[other][key]), key

    def test_state_dict_round_trip(self):
        env, other = self.env(), self.env()
        env.rollout(3)
        other.load_state_dict(env.state_dict())
        assert env.state_dict().keys() == other.state_dict().keys()
        for name, value in env.state_dict().items():
            assert torch.equal(value, other.state_dict()[name]), name

    @pytest.mark.slow
    def test_two_collector_workers_collect(self):
        collector = MultiSyncCollector(
            self.worker_envs(), frames_per_batch=12, total_frames=24, cat_results="stack"
        )
        try:
            collector.set_seed(0)
            batches = list(collector)
        finally:
            collector.shutdown()
        assert sum(batch.numel() for batch in batches) == 24
        for batch in batches:
            self.check_values(batch)

    # With other transforms and TorchRL components

    def test_a_later_transform_that_rewrites_the_observation_changes_no_values(self):
        def normalized(env):
            return TransformedEnv(
                env, ObservationNorm(loc=3.0, scale=2.0, in_keys=["observation"]), auto_unwrap=False
            )

        for make in (self.env, partial(SerialEnv, WORKERS, self.env)):
            check_env_specs(normalized(make()))
            alone, followed = (rolled(env) for env in (make(), normalized(make())))
            assert (followed["observation"] - alone["observation"]).abs().max() > 1
            observed = ("observation", ("next", "observation"))
            assert (followed.exclude(*observed) == alone.exclude(*observed)).all()

    def test_frames_concatenated_behind_it_change_no_values(self):
        env = self.env(batch_size=(3,))
        env.append_transform(CatFrames(2, dim=-1, in_keys=["observation"], out_keys=["frames"]))
        check_env_specs(env)
        self.check_values(env.rollout(6, break_when_any_done=False))

    def test_multi_step_returns_leave_the_root_alone(self):
        plain, moved = (collected(self.env(), postproc) for postproc in (None, self.multi_step()))
        for key in plain.exclude("next", "collector").keys(True, True):
            assert torch.equal(moved[key], plain[key]), key
        assert not torch.equal(moved["next", "observation"], plain["next", "observation"])
        self.check_multi_step(moved, plain)

    @staticmethod
    def multi_step() -> MultiStep:
        return MultiStep(0.9, 3)

    def check_multi_step(self, moved, plain) -> None:  # noqa: B027 most have nothing to add
        """Further checks of a batch with n-step returns against the same batch without."""

    @pytest.mark.parametrize("batch_size", [(), (3,)])
    def test_agent_group_keeps_its_batch_size(self, batch_size):
        env = TransformedEnv(TeamEnv(batch_size), self.transform(nested=True))
        check_env_specs(env)
        for spec in (env.full_action_spec, env.full_observation_spec, env.full_reward_spec):
            assert spec["agent"].shape == (*batch_size, TeamEnv.AGENTS)
        assert env.rollout(3)["agent"].batch_size[: len(batch_size) + 1] == (*batch_size, 3)
        collected(env, None)

    def test_double_precision_observations_are_taken(self):
        env = TransformedEnv(PointEnv(dtype=torch.float64), self.transform())
        check_env_specs(env)
        assert env.rollout(3)["observation"].dtype == torch.float64

    # Outside of environments

    @abstractmethod
    def test_no_env(self):
        """On bare data."""

    @abstractmethod
    def test_compose(self):
        """On bare data, inside a ``Compose``."""

    @abstractmethod
    def test_model(self):
        """In front of a network, in ``nn.Sequential`` or ``TensorDictSequential``."""

    @abstractmethod
    def test_replay_buffer(self):
        """On a replay buffer, or the refusal of one."""

    @abstractmethod
    def test_inverse(self):
        """The inverse pass, or that it does nothing."""
