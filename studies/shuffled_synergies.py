"""Explored synergies with permuted muscles, a control for which muscles move together.

    python studies/shuffled_synergies.py runs/EXPLORED shuffled/hand_pose

The new bundle has the same range, nonlinearity and variance as that of the run, but moves other
muscles together. If stage 2 is as good with it, the choice of muscles does not matter. The explored
transitions are written beside it, with the best-fitting coefficients for each action.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_etl.modules import SynergyDecoder
from torchrl_etl.synergies import load_bundle, save_bundle

STEPS, LR = 500, 0.02


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)

    decoder, info = load_bundle(arguments.run, residual=0.0)
    last = [module for module in decoder.modules() if isinstance(module, torch.nn.Linear)][-1]
    places = torch.randperm(decoder.action_dim)
    with torch.no_grad():
        last.weight.copy_(last.weight[places])
        last.bias.copy_(last.bias[places])
    decoder.set_encoder(None)  # its encoder expects the original order of muscles
    save_bundle(
        decoder,
        arguments.out / "synergies",
        task=info.task,
        actuators=info.actuators,
        kind=info.kind,
        facts=dict(info.facts) | {"shuffled": places.tolist()},
    )
    rows = load_file(arguments.run / "explored.safetensors")
    rows["synergy"], error = nearest(decoder, rows["action"])
    save_file(rows, arguments.out / "explored.safetensors")
    print(f"{arguments.out}: mean squared error of decoded actions {error:.3f}")


def nearest(decoder: SynergyDecoder, actions: Tensor) -> tuple[Tensor, float]:
    """Coefficients [N, d] in [-1, 1] that best fit actions [N, n], and the mean squared error."""
    free = torch.zeros(len(actions), decoder.num_synergies, requires_grad=True)
    optimizer = torch.optim.Adam([free], LR)
    for _ in range(STEPS):
        error = (decoder.module(free.tanh()) - actions).square()
        optimizer.zero_grad()
        error.mean(-1).sum().backward()
        optimizer.step()
    return free.detach().tanh(), error.mean().item()


if __name__ == "__main__":
    main()
