"""The viewer without a browser: drawn parts of a body, and the view of the camera."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO

import mujoco
import numpy as np
import pytest
import trimesh
import viser

from torchrl_etl.analysis.viewer.body import Body

# A bone in a hidden group, a skin over it, a hidden ball, and a tendon from high above.
ANIMAL = """
<mujoco>
  <asset><mesh name="bone" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody>
    <site name="high" pos="0 0 2"/>
    <body name="leg">
      <joint axis="0 1 0"/>
      <geom type="mesh" mesh="bone" group="5" mass="1"/>
      <geom type="sphere" size=".1" group="4" pos="0 0 -3"/>
      <site name="low"/>
    </body>
  </worldbody>
  <deformable>{skin}</deformable>
  <tendon><spatial name="cord"><site site="high"/><site site="low"/></spatial></tendon>
  <actuator><motor tendon="cord" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
SKIN = """
<skin vertex="0 0 0  .1 0 0  0 .1 0" face="0 1 2">
  <bone body="leg" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/>
</skin>
"""


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def draw(server: viser.ViserServer, skin: str) -> Body:
    model = mujoco.MjModel.from_xml_string(ANIMAL.format(skin=skin))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Body(server, model, data)


@pytest.mark.parametrize(("skin", "faces"), [(SKIN, [4]), ("", [])])
def test_hidden_bone_is_drawn_only_under_a_skin(server, skin, faces):
    sent = [BytesIO(handle.glb_data) for handle, _ in draw(server, skin)._parts]
    assert [len(trimesh.load_mesh(file, file_type="glb").faces) for file in sent] == faces


def test_camera_frames_a_tendon_beyond_the_body(server):
    draw(server, SKIN)
    camera = server.initial_camera
    view = camera.look_at - camera.position
    for end in ([0, 0, 0], [0, 0, 2]):
        ray = end - camera.position
        aside = np.arccos(ray @ view / np.linalg.norm(ray) / np.linalg.norm(view))
        assert aside < camera.fov / 2
    assert np.linalg.norm(view) < 4 * 2  # and not too far away
