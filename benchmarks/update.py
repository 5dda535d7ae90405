"""Milliseconds per update: ours, TorchRL's recipe, Stable-Baselines3, SBX, and products only.

    python benchmarks/update.py --peer none
    make .venv-peers/.complete && python benchmarks/update.py --compile --repeats 15

Measures CPU time on one core, which other processes affect little; cases alternate in blocks of
updates. All have two layers of 256 with ReLU and without layer norm, and a batch of 256. The buffer
holds random transitions with the sizes of one task, since their values do not affect the cost.
``floor`` is the time of an update's matrix products (``floor.py``).

``sac`` is SAC on raw actions, with the same networks for all libraries. ``explore`` and ``learn``
are the whole updates of both stages. Ours run through the training code, 16 updates at a time, or
one for ``_singly``. ``sbx`` makes 16 updates in one compiled call (``gradient_steps=16``), or one
for ``_singly``.
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before importing torch

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from floor import floor, sac_products, stage_products
from harness import Child, interleave, line, recipe, train
from machine import on_one_core
from peers import PYTHON, peer_python
from tensordict import TensorDict
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_etl.command_line import quiet_torchrl
from torchrl_etl.experiment import Experiment
from torchrl_etl.methods.explorer import Explorer
from torchrl_etl.modules import make_actor, make_critic
from torchrl_etl.training import Stage

TRANSITIONS = 4096
AT_ONCE = 16
PEERS = {  # library, updates per call
    "stable_baselines3": ("stable_baselines3", AT_ONCE),
    "sbx": ("sbx", AT_ONCE),
    "sbx_singly": ("sbx", 1),
}
# References of each case, used if measured.
COMPARED = {
    "torchrl/sac": ["compiled/sac"],
    "stable_baselines3/sac": ["compiled/sac", "floor/sac"],
    "sbx/sac": ["compiled/sac", "floor/sac"],
    "sbx_singly/sac": ["compiled_singly/sac", "floor/sac"],
    "compiled/sac": ["sbx/sac", "floor/sac"],
    "compiled_singly/sac": ["sbx/sac", "sbx_singly/sac", "floor/sac"],
    "compiled/learn": ["sbx/sac", "floor/learn"],
    "compiled/explore": ["compiled/learn", "floor/explore"],
    "eager/sac": ["compiled/sac", "floor/sac"],
    "eager/learn": ["compiled/learn", "floor/learn"],
    "eager/explore": ["compiled/explore", "floor/explore"],
}


def stages(env: str, compile: bool) -> dict[str, Stage]:
    """Plain SAC and both stages as built by the recipe, with filled buffers."""
    overrides = [f"env={env}", "run_dir=unused", "threads=1", f"compile={str(compile).lower()}"]
    overrides += ["actor.layer_norm=false"]
    etl = Experiment(recipe(*overrides))
    sac = Experiment(recipe(*overrides, "method=sac"))
    all_ = {
        "sac": sac.method.stage(),
        "explore": Explorer(etl.context).stage,
        "learn": etl.method.stage(),
    }
    spec, d = etl.context.spec, etl.config.num_synergies
    for stage in all_.values():
        stage.prefill(transitions(spec.observation_dim, spec.action_dim, d))
        stage.progress.owed = 0.0
    return all_


def transitions(observation_dim: int, action_dim: int, num_synergies: int) -> TensorDict:
    """Random transitions with all entries that any update reads."""
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


def torchrl_recipe(rows: TensorDict, batch: int, hidden: list[int]) -> Callable[[], object]:
    """An update as in TorchRL's own SAC recipe."""
    kept = rows.select("observation", "action", "next")
    sizes = {key: kept[key].shape[-1] for key in ("observation", "action")}
    spec = Bounded(-1, 1, shape=(sizes["action"],))
    network = {"hidden": hidden, "layer_norm": False}
    actor = make_actor({"observation": sizes["observation"]}, spec, **network)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(kept)), batch_size=batch)
    buffer.extend(kept)
    loss = SACLoss(actor, make_critic(sizes, **network), action_spec=spec)
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
    """A library in its own process and virtual environment."""

    def __init__(self, python: Path, case: dict[str, Any]) -> None:
        super().__init__([python, Path(__file__).with_name("peer_update.py"), json.dumps(case)])
        self.versions = json.loads(self.answer())

    def block(self, updates: int) -> float:
        return json.loads(self.ask(updates))["ms"]


def measured(run: Callable[[int], object], updates: int) -> float:
    """Milliseconds of CPU time per update."""
    start = time.process_time()
    run(updates)
    return 1e3 * (time.process_time() - start) / updates


def repeated(update: Callable[[], object]) -> Callable[[int], None]:
    def run(updates: int) -> None:
        for _ in range(updates):
            update()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="myoHandPenTwirl")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument(
        "--block", type=int, default=32, help=f"updates measured at a time, in {AT_ONCE}s"
    )
    parser.add_argument("--compile", action="store_true", help="also with compile=true")
    parser.add_argument("--peer", default=PYTHON, help="Python of the peers, or none")
    arguments = parser.parse_args()
    python = peer_python(arguments.peer)
    quiet_torchrl()
    torch.set_num_threads(1)
    torch.manual_seed(0)

    eager = stages(arguments.env, compile=False)
    cfg = Experiment(recipe(f"env={arguments.env}", "run_dir=unused")).config
    rows = eager["learn"].buffer.storage[:]
    sizes = rows["observation"].shape[-1], rows["action"].shape[-1]
    batch, hidden = cfg.learn.batch_size, list(cfg.actor.hidden)

    runs = {
        "floor/sac": repeated(floor(sac_products(batch, *sizes, sizes[1], hidden))),
        "floor/explore": repeated(floor(stage_products(cfg, "explore", *sizes))),
        "floor/learn": repeated(floor(stage_products(cfg, "learn", *sizes))),
        "torchrl/sac": repeated(torchrl_recipe(rows, batch, hidden)),
    }
    for name, stage in eager.items():
        runs[f"eager/{name}"] = partial(train, stage, at_once=AT_ONCE)
    more: dict[str, Any] = {}
    if arguments.compile:
        for name, stage in stages(arguments.env, compile=True).items():
            start = time.perf_counter()
            train(stage, AT_ONCE, at_once=AT_ONCE)
            more[f"compile_{name}_seconds"] = round(time.perf_counter() - start, 1)
            runs[f"compiled/{name}"] = partial(train, stage, at_once=AT_ONCE)
            if name == "sac":
                runs[f"compiled_singly/{name}"] = partial(train, stage, at_once=1)
    on_one_core()
    cases = {name: partial(measured, run, arguments.block) for name, run in runs.items()}
    case = {"observation_dim": sizes[0], "action_dim": sizes[1], "hidden": hidden}
    case |= {"batch_size": batch, "transitions": TRANSITIONS}
    peers = {}
    for name, (library, at_once) in PEERS.items() if python else ():
        peers[name] = Peer(python, {**case, "library": library, "updates_at_once": at_once})
        more |= {"peer_versions": more.get("peer_versions", {}) | peers[name].versions}
        cases[f"{name}/sac"] = partial(peers[name].block, arguments.block)

    values = interleave(cases, arguments.repeats)
    for peer in peers.values():
        peer.close()
    for name, each in values.items():
        others = {other: values[other] for other in COMPARED.get(name, ()) if other in values}
        line("update", name, "ms", each, peers=others, **more)


if __name__ == "__main__":
    main()
