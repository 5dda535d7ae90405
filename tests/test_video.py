"""Videos of a policy: their content, timing and files, and refused settings."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule

from tests.commands import command
from torchrl_etl import zoo
from torchrl_etl.analysis.animation import side_by_side, write_animation
from torchrl_etl.analysis.viewer.framing import middle_and_size
from torchrl_etl.analysis.viewer.muscles import activations, colors, pulled_tendons
from torchrl_etl.envs import make_env, mujoco_state
from torchrl_etl.modules import SynergyMap
from torchrl_etl.training import EpisodeRecorder, evaluate
from torchrl_etl.training.evaluation import EVALUATION_SEED

ELBOW = "myoElbowPose1D6MRandom-v0"


class Blind:
    """MuJoCo's renderer without GL: fills its scene and returns black frames."""

    def __init__(self, model: mujoco.MjModel, height: int, width: int) -> None:
        self.model, self.scene = model, mujoco.MjvScene(model, 2000)
        self.blank = np.zeros((height, width, 3), np.uint8)

    def update_scene(self, data: mujoco.MjData, camera: mujoco.MjvCamera) -> None:
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        option = mujoco.MjvOption()
        mujoco.mjv_updateScene(
            self.model, data, option, mujoco.MjvPerturb(), camera, everything, self.scene
        )

    def render(self) -> np.ndarray:
        return self.blank

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def env():
    return make_env(ELBOW)


@pytest.fixture
def recorder(env, monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", Blind)
    return EpisodeRecorder(env, size=(16, 20), seconds=0.3)


@pytest.fixture(scope="module")
def flexing(env):
    """A policy that excites all muscles fully."""

    def pull(observation):
        return observation.new_ones((*observation.shape[:-1], env.action_spec.shape[-1]))

    return TensorDictModule(pull, ["observation"], ["action"])


def test_tendons_are_colored_by_muscle_activation(recorder, env, flexing):
    recorder.record(flexing, 1)
    model, data = mujoco_state(env)
    tendon = int(mujoco.mjtObj.mjOBJ_TENDON)
    scene = recorder._renderer.scene
    drawn = [geom for geom in scene.geoms[: scene.ngeom] if geom.objtype == tendon]
    expected = colors(activations(model, data)) / 255
    pulled = pulled_tendons(model)
    assert {geom.objid for geom in drawn} >= pulled.keys()
    for geom in drawn:
        np.testing.assert_allclose(geom.rgba[:3], expected[pulled[geom.objid]], atol=1e-6)
    assert (np.subtract(*expected.T[[0, 2]]) > 0.3).all(), "red after 0.3 s of full excitation"


def test_recording_has_25_frames_per_second_with_first_and_last(recorder, env, flexing):
    (frames,) = recorder.record(flexing, 1)
    assert frames.shape == (1 + 7 + 1, 16, 20, 3)  # at 0, 0.04 to 0.28, and 0.3 s
    assert frames.dtype == np.uint8
    assert mujoco_state(env)[1].time == pytest.approx(0.3, abs=0.03)


def test_steps_longer_than_a_frame_are_recorded_in_real_time(flexing, monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", Blind)
    env = make_env(ELBOW, action_repeat=6)
    (frames,) = EpisodeRecorder(env, size=(16, 20), seconds=1.0).record(flexing, 1)
    seconds = mujoco_state(env)[1].time
    step = 6 * env._env.unwrapped.dt
    assert step > 2 / 25 and len(frames) / 25 > seconds - step


def test_recorded_episodes_are_those_of_the_evaluation(recorder, env, flexing):
    before = torch.get_rng_state()
    recorder.record(flexing, 2)
    drawn = mujoco_state(env)[1].qpos.copy()
    steps = round(mujoco_state(env)[1].time / env._env.unwrapped.dt)
    evaluate(flexing, env, episodes=2, max_steps=steps)
    np.testing.assert_allclose(mujoco_state(env)[1].qpos, drawn)
    evaluate(flexing, env, episodes=1, max_steps=steps, seed=EVALUATION_SEED)
    assert not np.allclose(mujoco_state(env)[1].qpos, drawn), "goals and poses are drawn anew"
    assert torch.equal(torch.get_rng_state(), before)


def test_scene_shows_the_body_and_not_the_room(recorder, env):
    recorder.draw()
    model, _ = mujoco_state(env)
    scene = recorder._renderer.scene
    kind = int(mujoco.mjtObj.mjOBJ_GEOM)
    shown = {geom.objid for geom in scene.geoms[: scene.ngeom] if geom.objtype == kind}
    bodies = model.geom_bodyid[sorted(shown)]
    assert len(shown) and (bodies != 0).any()
    untouched = (model.geom_contype | model.geom_conaffinity) == 0
    assert not any(model.geom_bodyid[geom] == 0 and untouched[geom] for geom in shown)


def test_azimuth_sets_the_view_direction(env, monkeypatch):
    monkeypatch.setattr(mujoco, "Renderer", Blind)
    with EpisodeRecorder(env, size=(16, 20), azimuth=90.0) as recorder:
        recorder.draw()
        ahead = recorder._renderer.scene.camera[0].forward
    down = np.deg2rad(24)
    np.testing.assert_allclose(ahead, [0.0, np.cos(down), -np.sin(down)], atol=1e-6)


def test_framing_covers_only_the_visible_geoms_of_the_body():
    # A body with a box above its origin and a large hidden sphere, and a floor.
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="9 9 1"/><body pos="3 0 0"><freejoint/>
        <geom type="box" pos="0 0 .5" size=".25 .1 .5"/><geom type="sphere" size="5" group="3"/>
        </body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    turned = np.deg2rad(90) / 2
    data.qpos[3:] = [
        np.cos(turned),
        0,
        np.sin(turned),
        0,
    ]  # about y, so that the box points along x
    mujoco.mj_forward(model, data)
    middle, size = middle_and_size(model, data)
    np.testing.assert_allclose(middle, [3.5, 0.0, 0.0], atol=1e-6)
    assert size == pytest.approx(np.linalg.norm([1.0, 0.2, 0.5]))


@pytest.mark.slow
def test_terrain_is_set_before_the_renderer_reads_it(monkeypatch):
    heights = []

    class Terrain(Blind):
        def __init__(self, model, height, width):
            heights.append(model.hfield_data.max())
            super().__init__(model, height, width)

    monkeypatch.setattr(mujoco, "Renderer", Terrain)
    EpisodeRecorder(make_env("myoLegStairTerrainWalk"), size=(16, 20))
    assert heights[0] > 0.5


def test_unknown_camera_is_refused_with_the_known_ones(env):
    with pytest.raises(ValueError, match="no camera 'moon'; the model has none"):
        EpisodeRecorder(env, camera="moon")


def test_missing_gl_library_error_names_the_packages(env, monkeypatch):
    def refuse(*_):
        raise OSError("libEGL.so.1 not found")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(RuntimeError, match=r"libEGL.so.1 not found.*libegl1, or libosmesa6"):
        EpisodeRecorder(env)


def test_video_and_animation_are_written_without_leftovers(tmp_path):
    brightness = np.arange(0, 225, 25, dtype=np.uint8)[:, None, None, None]
    episode = np.broadcast_to(brightness, (9, 16, 32, 3))
    clips = [episode[:4], episode]
    sides = {"before training": clips, "after training": clips[::-1]}
    video, picture = write_animation(tmp_path / "videos", sides)
    assert sorted(path.name for path in video.parent.iterdir()) == [picture.name, video.name][::-1]
    with Image.open(picture) as image:
        assert image.size == (2 * 2 * 32, 24 + 16)
        assert image.n_frames == 5 and image.info["loop"] == 0  # every second frame; loops forever
    import imageio.v2 as imageio

    decoded = imageio.mimread(video)
    assert len(decoded) == 9 and decoded[0].shape == (40, 128, 3)
    expected = list(side_by_side(sides))[-1]
    assert np.abs(decoded[-1][24:].astype(int) - expected[24:]).mean() < 4


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("video_episodes=0", "video_episodes"),
        ("video_size=[2048,2048]", "each side must be at most 4096"),
        ("video_seconds=0", "video_seconds"),
        ("video_before=maybe", "video_before"),
        ("video=1", "video"),
    ],
)
def test_invalid_video_setting_gives_a_one_line_error_and_no_files(
    setting, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert command("evaluate.py", "zoo=overactuated", setting) != 0
    said = capsys.readouterr().err
    assert words in said and said.startswith("Error: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_video_of_a_task_without_mujoco_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    assert command("evaluate.py", "zoo=overactuated", "episodes=1", "video=true") != 0
    assert "does not run on MuJoCo, which is needed to draw" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_untrained_entry_has_new_networks_and_the_same_synergies():
    fresh, trained = zoo.untrained("overactuated"), zoo.load("overactuated")[0]
    old, new = trained.state_dict(), fresh.state_dict()
    of_decoder = next(
        f"{name}." for name, part in fresh.named_modules() if isinstance(part, SynergyMap)
    )
    same = {key for key in new if torch.equal(new[key], old[key])}
    assert same >= {key for key in new if key.startswith(of_decoder)}
    weights = {key for key in new if key.endswith("weight") and not key.startswith(of_decoder)}
    assert weights and not same & weights
    again = zoo.untrained("overactuated").state_dict()
    assert all(torch.equal(new[key], again[key]) for key in new)
