"""Time per step of ETL's transforms: environments with and without them in TorchRL's rollout.

    python benchmarks/transforms.py

Uses the small analytic environment, whose own step is nearly free, in batches of eight. Times are
per step of the whole batch in ``env.rollout`` with a random policy.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import torch
from harness import interleave, line
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.envs import make_env
from torchrl_etl.modules import StateEncoder, SynergyDecoder
from torchrl_etl.transforms import DirectionPrimer, IntrinsicReward, SynergyAction


def environments(num_envs: int) -> dict[str, EnvBase]:
    def transformed(*transforms) -> EnvBase:
        env = TransformedEnv(make_env("overactuated", num_envs=num_envs, seed=0))
        for transform in transforms:
            env.append_transform(transform)
        return env

    encoder, decoder = StateEncoder(6, 4), SynergyDecoder(4, 16)
    return {
        "bare": make_env("overactuated", num_envs=num_envs, seed=0),
        "no_transform": transformed(),
        "direction": transformed(DirectionPrimer(4)),
        "direction+intrinsic_reward": transformed(DirectionPrimer(4), IntrinsicReward(encoder)),
        "synergy_action": transformed(SynergyAction(decoder)),
    }


def microseconds_per_step(env: EnvBase, steps: int) -> float:
    begun = time.perf_counter()
    env.rollout(steps, break_when_any_done=False)
    return 1e6 * (time.perf_counter() - begun) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=int, default=8)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quiet_torchrl()
    cases = {
        name: partial(microseconds_per_step, env, arguments.steps)
        for name, env in environments(arguments.num_envs).items()
    }
    values = interleave(cases, arguments.repeats)
    for name in cases:
        line(
            "transforms",
            name,
            "us/step",
            values[name],
            peers={"bare": values["bare"]},
            num_envs=arguments.num_envs,
        )


if __name__ == "__main__":
    main()
