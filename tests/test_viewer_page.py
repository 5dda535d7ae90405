"""The viewer's page without a browser: its controls and their effects."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from torchrl_etl.analysis.viewer import Session, Subject
from torchrl_etl.analysis.viewer.page import Page
from torchrl_etl.envs import EnvironmentSpec, make_env, resolve_task
from torchrl_etl.modules import SynergyDecoder

SMALL = "cartpole-balance"


def open_page(name: str, **parts) -> Page:
    """A page of a task on a free port, with one synergy that moves all actuators."""
    spec = EnvironmentSpec.of(make_env(name))
    low, high = spec.low, spec.high
    decoder = SynergyDecoder.from_directions(
        (low + high) / 2, (high - low)[None] / 4, low=low.tolist(), high=high.tolist()
    )
    make = lambda goal: make_env(name)  # noqa: E731
    subject = Subject("test", resolve_task(name), make, spec.actuators, decoder)
    return Page(Session(replace(subject, **parts)), port=0)


def use_control(page: Page, label: str, value: object = None) -> None:
    """Use the control with this label as viser does for a browser."""
    handles = page.server.gui._gui_input_handle_from_uuid.values()
    handle = next(handle for handle in handles if handle.label == label)
    if value is not None:
        handle.value = value
    for callback in handle._impl.update_cb:
        callback(SimpleNamespace(client=object(), target=handle))
    page._shown_at = page._refreshed_at = 0.0  # so that this tick updates everything
    page.tick(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["myo2HandPose", "myoLegStairTerrainWalk", "dog-run"])
def test_slider_moves_and_recolors_the_drawn_body(name):
    page = open_page(name)
    try:
        placed, shapes = page.body._placed.copy(), page.body._shapes
        shades = {key: shape.batched_colors.copy() for key, shape in shapes.items()}
        use_control(page, "1", 1.0)
        assert page.session.steps > 0 and page.session.coefficients.tolist() == [1.0]
        assert page.body._parts and np.isfinite(placed).all()
        assert (page.body._placed != placed).any()
        assert shades and any((shapes[key].batched_colors != shades[key]).any() for key in shades)
    finally:
        page.close()


def test_joints_are_drawn_at_a_followed_body():
    page = open_page("humanoid-stand")
    try:
        body, data = page.body, page.session.data
        joints = body._shapes["joints"]
        before = joints.batched_positions.copy()
        data.qpos[:2] += 1.0, -2.0
        mujoco.mj_forward(page.session.model, data)
        body.draw()
        np.testing.assert_allclose(body._world.position[:2], -data.body("torso").xpos[:2])
        # The browser moves the world one frame before it moves the joints.
        assert not joints.name.startswith("/world")
        np.testing.assert_allclose(joints.batched_positions, before, atol=1e-5)
    finally:
        page.close()


def test_every_click_draws_another_direction():
    act = lambda observation, direction: observation.new_zeros(1)  # noqa: E731
    explorer = TensorDictModule(act, ["observation", "direction"], ["action"])
    page = open_page(SMALL, explorer=explorer, direction_dim=3)
    try:
        drawn = []
        for _ in range(2):
            use_control(page, "New random direction")
            drawn.append(page.session.direction)
        assert not torch.equal(*drawn)
        use_control(page, "Direction", "−2")
        assert page.session.direction.tolist() == [0.0, -1.0, 0.0]
    finally:
        page.close()


def test_failed_goal_shows_its_error_and_restores_the_menu():
    def make(goal):
        if goal == "random":
            raise ValueError("no such simulator")
        return make_env(SMALL)

    both = replace(resolve_task(SMALL), random_id="another")
    page = open_page(SMALL, task=both, make_env=make)
    try:
        use_control(page, "Goal", "random")
        assert "no such simulator" in page._controls["message"].content
        assert page._controls["goal"].value == "fixed"
        use_control(page, "Step")
        assert page.session.steps == 1
    finally:
        page.close()
