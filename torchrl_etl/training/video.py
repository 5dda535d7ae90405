"""Episodes as MP4, drawn by MuJoCo's own renderer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_etl.envs import mujoco_state
from torchrl_etl.extras import extra
from torchrl_etl.training.evaluation import EVALUATION_SEED

__all__ = ["check_video_size", "record_episodes"]


def check_video_size(size: Sequence[int]) -> tuple[int, int]:
    """Height and width, if a video can have them.

    Raises:
        ValueError: if they are not two even numbers from 16 to 4096: the usual coding of colours
            in MP4 takes two by two pixels together.

    Examples:
        >>> check_video_size([480, 640])
        (480, 640)
        >>> check_video_size([480, 641])
        Traceback (most recent call last):
        ...
        ValueError: video_size is [480, 641]; it must be ...
    """
    listed = isinstance(size, Sequence) and not isinstance(size, str)
    numbers = list(size) if listed else size
    if not (
        listed
        and len(numbers) == 2
        and all(isinstance(number, int) and number % 2 == 0 for number in numbers)
        and all(16 <= number <= 4096 for number in numbers)
    ):
        raise ValueError(
            f"video_size is {numbers!r}; it must be height and width, two even whole numbers from "
            "16 to 4096, such as [480,640]."
        )
    return numbers[0], numbers[1]


def record_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    folder: Path,
    *,
    episodes: int,
    size: tuple[int, int] = (480, 640),
    camera: str | None = None,
    max_steps: int = 1000,
) -> list[Path]:
    """Render the deterministic policy on the first evaluation seeds.

    Args:
        env (EnvBase): a single environment on MuJoCo, transforms included.
        policy (TensorDictModuleBase): the policy.
        folder (path): where ``episode0.mp4`` and so on go.

    Keyword Args:
        episodes (int): number of episodes.
        size (tuple of int): height and width in pixels.
        camera (str, optional): a camera of the model; by default its first, or else one that sees
            the whole scene.
        max_steps (int): where to cut an episode that does not end.

    Raises:
        RuntimeError: if the machine has no way to draw, naming what to install.
        ValueError: if the environment does not run on MuJoCo or has no such camera.
    """
    model, data = mujoco_state(env)
    with extra("video"):
        import imageio.v2 as imageio
        import mujoco
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if camera is not None and camera not in cameras:
        raise ValueError(f"There is no camera {camera!r}; the model has {', '.join(cameras)}.")
    view = camera or (0 if cameras else -1)
    # The default frame buffer of most models is smaller than a readable picture.
    model.vis.global_.offheight = max(model.vis.global_.offheight, size[0])
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, size[1])
    try:
        renderer = mujoco.Renderer(model, *size)
    except Exception as error:  # the GL back ends share no base class
        raise RuntimeError(
            f"MuJoCo cannot draw here ({type(error).__name__}: {error}); install a GL back end "
            "(Debian: apt-get install libegl1, or libosmesa6 for software rendering) and set "
            "MUJOCO_GL=egl or MUJOCO_GL=osmesa."
        ) from error
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    with (
        renderer,
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
    ):
        for episode in range(episodes):
            frames: list[np.ndarray] = []

            def draw(*_: object, frames: list[np.ndarray] = frames) -> None:
                renderer.update_scene(data, view)
                frames.append(renderer.render())

            env.set_seed(EVALUATION_SEED + episode)
            env.rollout(max_steps, policy, callback=draw)
            paths.append(folder / f"episode{episode}.mp4")
            imageio.mimwrite(paths[-1], frames, fps=25, macro_block_size=1)
    return paths
