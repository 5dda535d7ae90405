"""What every transform must pass before it may be called one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial

import pytest
import torch
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.point_env import PointEnv, vectorized_point

WORKERS = 2


class TransformChecks(ABC):
    """Subclass as ``TestX``, give :meth:`transform`, and fill in the checks of values.

    The layouts are checked here, for every transform alike. The abstract checks are those that
    only the transform's author can write, because they say what its values must be.
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
        """Hold a rollout of any layout (flat keys, time last) against what it must contain."""

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
            [self.env] * WORKERS, frames_per_batch=12, total_frames=24, cat_results="stack"
        )
        try:
            collector.set_seed(0)
            batches = list(collector)
        finally:
            collector.shutdown()
        assert sum(batch.numel() for batch in batches) == 24
        for batch in batches:
            self.check_values(batch)

    # What the transform means elsewhere

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
