"""Videos of a policy, with muscles colored by their activation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_etl.analysis.animation import CAPTION_HEIGHT, FPS, grid_shape
from torchrl_etl.analysis.viewer.framing import SHOWN_GROUPS, middle_and_size, planes, scenery
from torchrl_etl.checks import check_integer
from torchrl_etl.envs import has_free_root, mujoco_state
from torchrl_etl.extras import extra
from torchrl_etl.training.evaluation import EVALUATION_SEED, as_evaluated

__all__ = ["EpisodeRecorder", "check_video_size"]

_FINGER = 0.05  # m
_BACKDROP = [0.93, 0.94, 0.96, 1.0]
_MOST_PIXELS = 4096  # per dimension: what MP4 decoders reliably support


def check_video_size(size: Sequence[int], *, episodes: int = 1, sides: int = 1) -> tuple[int, int]:
    """Check height and width of one episode's frames; returns them.

    Args:
        size (sequence of int): height and width.

    Keyword Args:
        episodes (int): number of episodes in a grid. Default: 1.
        sides (int): number of grids side by side. Default: 1.

    Raises:
        ValueError: if they are not two even numbers from 16 to 4096 (MP4 usually subsamples colors
            two by two), or if the frame with all episodes exceeds 4096.

    Examples:
        >>> check_video_size([480, 640])
        (480, 640)
        >>> check_video_size([480, 641])
        Traceback (most recent call last):
        ...
        ValueError: video_size is [480, 641]; it must be ...
    """
    check_integer(1, video_episodes=episodes)
    listed = isinstance(size, Sequence) and not isinstance(size, str)
    numbers = list(size) if listed else size
    if not (
        listed
        and len(numbers) == 2
        and all(isinstance(number, int) and number % 2 == 0 for number in numbers)
        and all(16 <= number <= _MOST_PIXELS for number in numbers)
    ):
        raise ValueError(
            f"video_size is {numbers!r}; it must be height and width of an episode, two even whole "
            f"numbers from 16 to {_MOST_PIXELS}, such as [240,320]."
        )
    rows, columns = grid_shape(episodes)
    height, width = CAPTION_HEIGHT + rows * numbers[0], sides * columns * numbers[1]
    if max(height, width) > _MOST_PIXELS:
        raise ValueError(
            f"video_size={numbers!r} and video_episodes={episodes} make a picture of {height} by "
            f"{width} pixels; each side must be at most {_MOST_PIXELS}, so lower one of them."
        )
    return numbers[0], numbers[1]


class EpisodeRecorder:
    """Records a MuJoCo environment while a policy acts in it; works headless.

    Tendons are colored by activation (:func:`~torchrl_etl.analysis.viewer.muscles.colors`): slate
    at rest, red when active. The frame rate is 25 per second of simulated time.

    Args:
        env (EnvBase): a single environment on MuJoCo, transforms included.

    Keyword Args:
        size (tuple of int): height and width in pixels.
        camera (str, optional): a camera of the model, which shows the whole scene. Default: a
            camera that centers the body and hides scenery.
        azimuth (float): viewing direction of the default camera, in degrees from the world's x
            towards its y. Default: 132.
        seconds (float): simulated seconds after which an episode is cut. Default: 10.

    Raises:
        RuntimeError: if rendering fails; the message names what to install.
        ValueError: if the environment does not run on MuJoCo or has no such camera.
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        size: tuple[int, int] = (240, 320),
        camera: str | None = None,
        azimuth: float = 132.0,
        seconds: float = 10.0,
    ) -> None:
        self._env, self._seconds, self._azimuth = env, seconds, azimuth
        self._model, self._data = mujoco_state(env)
        model = self._model
        with extra("video"):
            import imageio.v2  # noqa: F401  (writes the frames later: fail now if it is missing)
            import mujoco
        cameras = [model.camera(i).name for i in range(model.ncam)]
        if camera is not None and camera not in cameras:
            named = ", ".join(cameras) or "none"
            raise ValueError(f"There is no camera {camera!r}; the model has {named}.")
        self._camera = camera
        # The default frame buffer of most models is too small.
        model.vis.global_.offheight = max(model.vis.global_.offheight, size[0])
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, size[1])
        # has_free_root resets the environment, before the renderer copies its terrain.
        self._follows = has_free_root(env)
        self._framed: Any = None
        try:
            self._renderer = mujoco.Renderer(model, *size)
        except Exception as error:  # the GL back ends share no base class
            raise RuntimeError(
                f"MuJoCo cannot draw here ({type(error).__name__}: {error}); install a GL back end "
                "(Debian: apt-get install libegl1, or libosmesa6 for software rendering) and set "
                "MUJOCO_GL=egl or MUJOCO_GL=osmesa."
            ) from error
        for costly in ("SHADOW", "REFLECTION"):  # seconds per frame without a GPU
            self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{costly}")] = 0
        if camera is None:
            around = scenery(model) | (planes(model) & (not self._follows))
            model.geom_group[around] = SHOWN_GROUPS  # the first hidden group
            zones = model.site_size.max(1) > _FINGER  # site markers large enough to hide a hand
            model.site_rgba[zones, 3] = model.site_rgba[zones, 3].clip(max=0.15)
            light = model.vis.headlight  # even light from the camera
            light.active, light.ambient[:], light.diffuse[:] = 1, 0.4, 0.5

    def record(
        self, policy: TensorDictModuleBase, episodes: int, *, seed: int = EVALUATION_SEED
    ) -> list[np.ndarray]:
        """Frames [T, H, W, 3] of each episode under the deterministic policy; ``seed`` is that of
        the first, as in :func:`~torchrl_etl.training.evaluate`."""
        with as_evaluated(self._env):
            return [self._episode(policy, seed + number) for number in range(episodes)]

    def _episode(self, policy: TensorDictModuleBase, seed: int) -> np.ndarray:
        torch.manual_seed(seed)
        self._env.set_seed(seed)
        state, over = self._env.reset(), False
        start, frames = self._data.time, [self.draw()]
        while not over and (passed := self._data.time - start) < self._seconds:
            while passed + 1e-9 >= len(frames) / FPS:  # a long step spans several frames
                frames.append(self.draw())
            after = self._env.step(policy(state))
            over = bool(after["next", "done"].any())
            state = self._env.step_mdp(after)
        return np.stack([*frames, self.draw()])

    def draw(self) -> np.ndarray:
        """Render the current state [H, W, 3]."""
        import mujoco  # there, since its model is

        from torchrl_etl.analysis.viewer.muscles import activations, colors, pulled_tendons

        self._renderer.update_scene(self._data, self._camera or self._view())
        shades = colors(activations(self._model, self._data)) / 255
        pulled = pulled_tendons(self._model)
        scene, tendon = self._renderer.scene, int(mujoco.mjtObj.mjOBJ_TENDON)
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objtype == tendon and geom.objid in pulled:
                geom.matid, geom.rgba[:3] = -1, shades[pulled[geom.objid]]
                geom.emission = 0.5  # emission keeps the color readable under shading
        if self._framed is not None and not self._follows:
            self._add_backdrop()
        return self._renderer.render()

    def _add_backdrop(self) -> None:
        """Add a light wall behind the body, so that dark tendons are visible."""
        import mujoco  # there, since its model is

        scene, eye = self._renderer.scene, self._renderer.scene.camera[0]
        forward, up = np.array(eye.forward, float), np.array(eye.up, float)
        frame = np.stack([np.cross(forward, up), up, -forward], 1)
        far, box = 3 * self._framed.distance, int(mujoco.mjtGeom.mjGEOM_BOX)
        wall = scene.geoms[scene.ngeom]
        place, size = self._framed.lookat + far * forward, np.array([4 * far, 4 * far, 1e-3])
        mujoco.mjv_initGeom(
            wall, box, size, place, frame.reshape(-1), np.array(_BACKDROP, np.float32)
        )
        wall.emission, wall.specular, wall.reflectance = 1.0, 0.0, 0.0
        scene.ngeom += 1

    def _view(self) -> Any:
        """Default camera, as in the viewer; it follows a body with a free root."""
        import mujoco  # there, since its model is

        if not self._follows and self._framed is not None:
            return self._framed
        middle, size = middle_and_size(self._model, self._data)
        view = self._framed = mujoco.MjvCamera()
        view.lookat, view.distance = middle, 1.35 * size
        view.azimuth, view.elevation = self._azimuth, -24.0
        return view

    def close(self) -> None:
        """Release the renderer; the environment stays open."""
        self._renderer.close()

    def __enter__(self) -> EpisodeRecorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
