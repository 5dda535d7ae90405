"""A clip of every task's body, for the gallery of docs/tasks.md.

    python studies/task_gallery.py                             # all of them, in a minute or two
    python studies/task_gallery.py myoBaoding myoHandReach     # some

makes docs/pictures/tasks/NAME.webp for the paper's tasks and the entries of the zoo. It shows the
body under the default noise of ``exploration=noise``, without a policy, for as many episodes as
the clip holds. NAME-trained.webp shows an entry's policy, from the same initial state.
"""

# ruff: noqa: E402  (MuJoCo chooses how it draws when it is first imported)

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from torchrl_etl.gl_backend import draw_without_display

draw_without_display()
import mujoco
from omegaconf import OmegaConf
from PIL import Image
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from torchrl_etl import zoo
from torchrl_etl.analysis.animation import FPS, animated_picture
from torchrl_etl.analysis.viewer.framing import planes
from torchrl_etl.checks import check_choice
from torchrl_etl.command_line import exit_on_error
from torchrl_etl.envs import (
    EnvironmentSpec,
    has_free_root,
    list_tasks,
    make_env,
    mujoco_state,
    resolve_task,
)
from torchrl_etl.exploration import LastingNoise
from torchrl_etl.io import write_atomically
from torchrl_etl.modules.lasting_noise import PinkNormal
from torchrl_etl.training import EpisodeRecorder
from torchrl_etl.training.evaluation import EVALUATION_SEED

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "pictures" / "tasks"
NOISE = OmegaConf.load(ROOT / "recipes" / "conf" / "exploration" / "noise.yaml").exploration
SECONDS = 3.0
SIZE = (216, 288)  # pixels of a clip
FINER = 3  # supersampling factor
QUALITIES, LARGEST = (30, 20, 10), 75_000  # take the first quality that fits into these bytes
MARGIN = 0.1  # of height and width, around moving pixels
CHANGE = 24  # minimum change of a moving pixel, of 255 levels
GROUND = (1.3, 1.32, 1.36)  # brighter than white, for dim light
AZIMUTHS = {"myoLegStairTerrainWalk": -40.0}  # the stairs are behind the usual camera
FIRST_SEEDS_APART = 100  # otherwise tasks with the same body would have the same clip


def main(*names: str) -> None:
    with exit_on_error(ValueError, OSError, RuntimeError):
        shown = names_of_all()
        for name in names:
            check_choice("NAME", name, shown)
        FOLDER.mkdir(parents=True, exist_ok=True)
        for name in names or shown:
            draw_clips(name, EVALUATION_SEED + FIRST_SEEDS_APART * shown.index(name))


def draw_clips(name: str, seed: int) -> None:
    policy, env = zoo.load(name) if name in zoo.names(trained=True) else (None, make_env(name))
    env = TransformedEnv(env, InitTracker())  # tells the noise when an episode begins
    with recorder_of(env, name) as recorder:
        clips = {name: draw(recorder, noise(env), seed)}
        if policy is not None:
            clips[f"{name}-trained"] = draw(recorder, policy, seed)
    rows, columns = where_it_moves(np.concatenate([*clips.values()]))
    for clip, frames in clips.items():
        write(clip, frames[:, rows, columns])


def recorder_of(env: EnvBase, name: str) -> EpisodeRecorder:
    """Supersampling instead of multisampling takes a tenth of the time without a GPU."""
    model, _ = mujoco_state(env)
    quality = model.vis.quality
    quality.offsamples, quality.numslices, quality.numstacks = 0, 12, 6
    simplify(env)
    height, width = (FINER * length for length in SIZE)
    azimuth = AZIMUTHS.get(name, 132.0)
    return EpisodeRecorder(env, size=(height, width), azimuth=azimuth, seconds=SECONDS)


def simplify(env: EnvBase) -> None:
    """Give the ground one colour, since a pattern would make up most of a file."""
    model, _ = mujoco_state(env)
    if not has_free_root(env):  # this resets the task, which sets its terrain
        return  # the recorder hides floors
    floor, terrain = planes(model), model.geom_type == int(mujoco.mjtGeom.mjGEOM_HFIELD)
    model.geom_matid[floor | terrain], model.geom_rgba[floor | terrain, :3] = -1, GROUND
    model.geom_size[floor] = 0  # infinite
    if (model.geom_rgba[terrain, 3] > 0).any():
        model.geom_rgba[floor, 3] = 0  # it intersects the terrain
    model.light_active[:] = 0  # these make spots on the floor; the recorder has its own light


def names_of_all() -> list[str]:
    """The paper's tasks, then the entries of the zoo that have a body to draw."""
    drawn = [name for name in zoo.names(trained=True) if is_drawn(zoo.read_card(name).task["name"])]
    return list(dict.fromkeys([*(task.name for task in list_tasks()), *drawn]))


def is_drawn(task: str) -> bool:
    return resolve_task(task).suite != "gymnasium"


def noise(env: EnvBase) -> TensorDictModuleBase:
    spec = EnvironmentSpec.of(env)
    return LastingNoise(spec.low, spec.high, PinkNormal(NOISE.longest), std=NOISE.std)


def draw(recorder: EpisodeRecorder, policy: TensorDictModuleBase, seed: int) -> np.ndarray:
    """Frames [T, H, W, 3] of consecutive episodes."""
    frames: list[np.ndarray] = []
    while len(frames) < SECONDS * FPS:
        frames += list(recorder.record(policy, 1, seed=seed)[0])
        seed += 1
    drawn = np.stack(frames[: round(SECONDS * FPS)])
    drawn[~drawn.any(-1)] = 255  # without a skybox, the background is black
    return drawn


def where_it_moves(frames: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around all moving pixels, with the aspect ratio of the frames."""
    height, width = frames.shape[1:3]
    changes = np.ptp(frames.max(-1), axis=0) > CHANGE
    spans = [np.flatnonzero(changes.any(axis))[[0, -1]] for axis in (1, 0)]
    share = max(
        MARGIN + np.ptp(span) / whole for span, whole in zip(spans, (height, width), strict=True)
    )
    share = min(max(share, 1 / FINER), 1.0)  # never enlarges rendered pixels
    cut = []
    for span, whole in zip(spans, (height, width), strict=True):
        length = round(share * whole)
        start = min(max(round(span.mean() - length / 2), 0), whole - length)
        cut.append(slice(start, start + length))
    return cut[0], cut[1]


def write(name: str, frames: np.ndarray) -> None:
    height, width = SIZE
    small = [
        np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling.BOX))
        for frame in frames
    ]
    for quality in QUALITIES:
        content = animated_picture(small, quality=quality)
        if len(content) <= LARGEST:
            break
    path = FOLDER / f"{name}.webp"
    write_atomically(path, content)
    print(f"{path.relative_to(ROOT)}  {len(content) / 1000:.0f} kB")


if __name__ == "__main__":
    main(*sys.argv[1:])
