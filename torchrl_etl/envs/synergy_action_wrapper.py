"""Synergy actions for Gymnasium environments, without TorchRL's collectors and losses."""

from __future__ import annotations

import os

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces

from torchrl_etl.checks import check_width
from torchrl_etl.envs.action_space import check_action_space
from torchrl_etl.envs.factory import actuator_names
from torchrl_etl.modules import SynergyMap
from torchrl_etl.synergies import check_compatible, load_bundle

__all__ = ["SynergyActionWrapper"]


class SynergyActionWrapper(gym.ActionWrapper, gym.utils.RecordConstructorArgs):
    """Executes the decoded action of a synergy decoder at each step.

    The Gymnasium counterpart of :class:`~torchrl_etl.transforms.SynergyAction`. The action space
    becomes the decoder's synergy space.

    Equation: a = Dec(z^a) of section 4.2.

    Args:
        env (gymnasium.Env): an environment with a flat ``Box`` action space.
        bundle (path-like or SynergyMap): a bundle's folder, a run folder, or a decoder. A bundle's
            muscles must match the environment's by name; a decoder must match in number of
            actuators and bounds.

    Keyword Args:
        residual (float, optional): replaces the residual share of a bundle. With 0 the action has
            d entries.

    Raises:
        TypeError: if ``bundle`` is neither.
        BundleError: if there is no bundle, or its muscles or bounds do not match.
        ValueError: if the action space is no flat float ``Box``, or does not fit the decoder.

    Examples:
        >>> import gymnasium
        >>> from torchrl_etl.modules import SynergyDecoder
        >>> env = gymnasium.make("torchrl_etl/Overactuated-v0")  # 16 muscles
        >>> env = SynergyActionWrapper(env, SynergyDecoder(4, 16))
        >>> env.action_space
        Box(-1.0, 1.0, (4,), float32)
        >>> _ = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    """

    def __init__(
        self,
        env: gym.Env,
        bundle: str | os.PathLike[str] | SynergyMap,
        *,
        residual: float | None = None,
    ) -> None:
        if not isinstance(bundle, (str, os.PathLike, SynergyMap)):
            raise TypeError(
                f"bundle is a {type(bundle).__name__}; pass a bundle's folder, or a decoder such "
                "as SynergyDecoder.from_gmvae(gmvae)."
            )
        given = bundle if isinstance(bundle, SynergyMap) else os.fspath(bundle)
        gym.utils.RecordConstructorArgs.__init__(self, bundle=given, residual=residual)
        gym.ActionWrapper.__init__(self, env)
        box = env.action_space
        check_action_space(box, "The environment")
        if len(box.shape) != 1:
            raise ValueError(
                f"The environment has actions of shape {box.shape}; put a wrapper around it that "
                "makes them one flat array."
            )
        if isinstance(bundle, SynergyMap):
            if residual is not None:
                raise ValueError(
                    "residual is only for a bundle's folder; this decoder has its own."
                )
            self.decoder = bundle
            _check_decoder(bundle, box)
        else:
            self.decoder, info = load_bundle(bundle, residual=residual)
            names = actuator_names(env)
            check_compatible(info, names, torch.tensor(box.low), torch.tensor(box.high))
        spec = self.decoder.synergy_spec
        self.action_space = spaces.Box(-1.0, 1.0, tuple(spec.shape), np.float32)

    @torch.no_grad()
    def action(self, action: np.ndarray) -> np.ndarray:
        """The muscle action [n] for coefficients [d], or [d + n] with a residual."""
        synergy = torch.as_tensor(action, dtype=self.decoder.low.dtype)
        check_width(self.action_space.shape[0], action=synergy)
        decoded = self.decoder.module(synergy.to(self.decoder.low.device))
        box = self.env.action_space  # float32 may round the action beyond its bounds
        return decoded.cpu().numpy().astype(box.dtype).clip(box.low, box.high)


def _check_decoder(decoder: SynergyMap, box: spaces.Box) -> None:
    if decoder.action_dim != box.shape[0]:
        raise ValueError(
            f"The decoder writes {decoder.action_dim} actuators but the environment has "
            f"{box.shape[0]}; use a decoder fitted on this body."
        )
    low, high = decoder.low.cpu().numpy(), decoder.high.cpu().numpy()
    if not (np.allclose(low, box.low) and np.allclose(high, box.high)):
        raise ValueError(
            f"The decoder acts in [{low.min():g}, {high.max():g}] but the environment in "
            f"[{box.low.min():g}, {box.high.max():g}]; use a decoder fitted with these bounds."
        )
