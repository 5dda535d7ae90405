"""Milliseconds an update: ours, TorchRL's own recipe, Stable-Baselines3, and the products alone.

    python benchmarks/update.py
    make .venv-peers/.complete && python benchmarks/update.py --compile --repeats 15

One thread and CPU time, so that other processes disturb little; the cases take turns in blocks of
updates. ``floor`` is what ``torch.mm`` takes for exactly the products of an update, each on tensors
of its own, without a gradient where none is needed. Random transitions of one task's sizes stand in
for a buffer: the cost of an update does not depend on what they hold.

``sac`` is SAC on raw actions, the same nets for all three libraries; ``explore`` and ``learn`` are
the whole updates of both stages. A ratio is to the floor; for TorchRL and Stable-Baselines3 it is
to ours, compiled if asked.
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is there

import platform
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from harness import Child, interleave, line, recipe
from tensordict import TensorDict
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.learners import SACLearner
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.training import Stage

ROOT = Path(__file__).parent.parent
PEER = ROOT / ".venv-peers" / "bin" / "python"
TRANSITIONS = 4096
Shape = tuple[int, int, int]


def config(env: str, compile: bool, layer_norm: bool) -> Any:
    overrides = [f"env={env}", "run_dir=unused", "threads=1", f"compile={str(compile).lower()}"]
    overrides += [f"actor.layer_norm={str(layer_norm).lower()}"]
    return recipe(*overrides)


def stages(env: str, compile: bool, layer_norm: bool) -> tuple[Stage, Stage]:
    """Both stages as the recipe builds them, their buffers filled."""
    experiment = Experiment(config(env, compile, layer_norm))
    both = Explorer(experiment.context).stage, experiment.method.stage()
    spec, d = experiment.context.spec, experiment.config.num_synergies
    for stage in both:
        stage.buffer.extend(transitions(spec.observation_dim, spec.action_dim, d))
    return both


def transitions(observation_dim: int, action_dim: int, num_synergies: int) -> TensorDict:
    """Every entry that some update reads."""
    direction = torch.nn.functional.normalize(torch.randn(TRANSITIONS, num_synergies), dim=-1)
    flags = torch.zeros(TRANSITIONS, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.randn(TRANSITIONS, observation_dim),
            "direction": direction,
            "action": torch.rand(TRANSITIONS, action_dim),
            "synergy": 2 * torch.rand(TRANSITIONS, num_synergies) - 1,
            "next": {
                "observation": torch.randn(TRANSITIONS, observation_dim),
                "direction": direction,
                "reward": 0.1 * torch.randn(TRANSITIONS, 1),
                "done": flags,
                "terminated": flags.clone(),
            },
        },
        [TRANSITIONS],
    )


# The floor ------------------------------------------------------------------------------------


def products(batch: int, widths: list[int], passes: str) -> Iterator[Shape]:
    """Products of a perceptron's passes.

    ``f``: forward; ``w``: gradient of its weights; ``h``: of its hidden layers, on the way there;
    ``i``: of its input.
    """
    layers = list(pairwise(widths))
    for kind in passes:
        for index, (wide, narrow) in enumerate(layers):
            if kind == "f":
                yield batch, wide, narrow
            elif kind == "w":
                yield wide, batch, narrow
            elif kind == "i" or index:
                yield batch, narrow, wide


def sac_products(batch: int, inputs: int, action: int, out: int, hidden: list[int]) -> list[Shape]:
    """Twin critics on ``inputs`` + ``action``, an actor that emits ``out``."""
    critic = [inputs + action, *hidden, 1]
    shapes = list(products(batch, [inputs, *hidden, 2 * out], "ffwh"))
    for _ in range(2):
        shapes += products(batch, critic, "ffwhfh")  # target, regression, under the actor
        shapes.append((batch, hidden[0], action))  # and its gradient at the action alone
    return shapes


def stage_products(cfg: Any, name: str, observation_dim: int, action_dim: int) -> list[Shape]:
    d, batch, hidden = cfg.num_synergies, cfg[name].batch_size, list(cfg.actor.hidden)
    body = list(cfg.synergies.hidden)
    decoder = [d, *reversed(body), action_dim]
    if name == "learn":
        shapes = sac_products(batch, observation_dim, action_dim, d, hidden)
        return shapes + list(products(batch, decoder, "ffwifwh"))  # s', s, Eq. 10
    shapes = sac_products(batch, observation_dim + d, action_dim, action_dim, hidden)
    shapes += products(batch, [observation_dim, *cfg.exploration.encoder.hidden, d], "fwhff")
    shapes += products(batch, [action_dim, *body, d * (1 + 2 * d)], "fwh")
    return shapes + list(products(d * batch, decoder, "fwi"))


def floor(shapes: list[Shape]) -> Callable[[], object]:
    operands = [
        (torch.randn(rows, inner), torch.randn(inner, columns), torch.empty(rows, columns))
        for rows, inner, columns in shapes
    ]

    def run() -> None:
        for left, right, out in operands:
            torch.mm(left, right, out=out)

    return run


# Plain SAC ------------------------------------------------------------------------------------


def plain_sac(cfg: Any, stage: Stage, library: str) -> Callable[[], object]:
    """SAC on raw actions, with our loss as the stages use it or as TorchRL's recipe does."""
    kept = stage.buffer.storage[:].select("observation", "action", "next")
    sizes = {key: kept[key].shape[-1] for key in ("observation", "action")}
    spec = Bounded(-1, 1, shape=(sizes["action"],))
    network = {"hidden": list(cfg.actor.hidden), "layer_norm": cfg.actor.layer_norm}
    actor = make_actor({"observation": sizes["observation"]}, spec, **network)
    critic = make_critic(sizes, **network)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(TRANSITIONS), batch_size=cfg.learn.batch_size
    )
    buffer.extend(kept)
    if library != "torchrl":
        learner = SACLearner(actor, critic, action_spec=spec, compile=library == "compiled")
        return lambda: learner.update(buffer.sample())
    loss = SACLoss(actor, critic, action_spec=spec)
    loss.make_value_estimator(gamma=0.99)
    target, parameters = SoftUpdate(loss, tau=0.005), list(loss.parameters())
    optimizer = torch.optim.Adam(parameters, lr=3e-4)

    def run() -> None:
        out = loss(buffer.sample())
        total = out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]
        gradients = torch.autograd.grad(total, parameters)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()
        target.step()

    return run


class Peer(Child):
    """Stable-Baselines3 in its own process and environment."""

    def __init__(self, case: dict[str, Any]) -> None:
        script = ROOT / "benchmarks" / "peer_sb3.py"
        env = {**os.environ, "OMP_NUM_THREADS": "1"}
        super().__init__([PEER, script, json.dumps(case)], env=env)
        self.versions = json.loads(self.answer())

    def block(self, updates: int) -> float:
        return json.loads(self.ask(updates))["ms"]


def cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if "model name" in line), "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandPenTwirl")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--block", type=int, default=20, help="updates measured at a time")
    parser.add_argument("--compile", action="store_true", help="also with compile=true")
    parser.add_argument("--no-layer-norm", dest="layer_norm", action="store_false")
    arguments = parser.parse_args()
    quiet_torchrl()
    torch.set_num_threads(1)
    torch.manual_seed(0)

    cfg = config(arguments.env, False, arguments.layer_norm)
    explore, learn = stages(arguments.env, False, arguments.layer_norm)
    example = learn.buffer.storage[:2]
    sizes = example["observation"].shape[-1], example["action"].shape[-1]
    batch, hidden = cfg.learn.batch_size, list(cfg.actor.hidden)

    def timed(update: Callable[[], object]) -> Callable[[], float]:
        def block() -> float:
            start = time.process_time()
            for _ in range(arguments.block):
                update()
            return 1e3 * (time.process_time() - start) / arguments.block

        return block

    cases = {
        "floor/sac": timed(floor(sac_products(batch, *sizes, sizes[1], hidden))),
        "floor/explore": timed(floor(stage_products(cfg, "explore", *sizes))),
        "floor/learn": timed(floor(stage_products(cfg, "learn", *sizes))),
        "ours/sac": timed(plain_sac(cfg, learn, "ours")),
        "ours/explore": timed(explore.update),
        "ours/learn": timed(learn.update),
        "torchrl/sac": timed(plain_sac(cfg, learn, "torchrl")),
    }
    more: dict[str, Any] = {"cpu": cpu_model(), "layer_norm": arguments.layer_norm}
    if arguments.compile:
        cases["compiled/sac"] = timed(plain_sac(cfg, learn, "compiled"))
        for stage in stages(arguments.env, True, arguments.layer_norm):
            start = time.perf_counter()
            stage.update(), stage.update()
            more[f"compile_{stage.name}_seconds"] = round(time.perf_counter() - start, 1)
            cases[f"compiled/{stage.name}"] = timed(stage.update)
    peer = None
    if PEER.exists():
        case = {"observation_dim": sizes[0], "action_dim": sizes[1], "hidden": hidden}
        case |= {"batch_size": batch, "transitions": TRANSITIONS}
        peer = Peer(case | {"layer_norm": arguments.layer_norm})
        more |= {"peer_versions": peer.versions}
        cases["stable_baselines3/sac"] = lambda: peer.block(arguments.block)

    values = interleave(cases, arguments.repeats)
    if peer is not None:
        peer.close()
    ours = "compiled/sac" if arguments.compile else "ours/sac"
    for name, each in values.items():
        library, part = name.split("/")
        other = ours if library in ("torchrl", "stable_baselines3") else f"floor/{part}"
        line("update", name, "ms", each, peer=other, peer_values=values[other], **more)


if __name__ == "__main__":
    main()
