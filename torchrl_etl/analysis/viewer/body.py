"""A MuJoCo body in a viser scene, its tendons coloured by activation."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_etl.analysis.viewer.framing import (
    SHOWN_GROUPS,
    middle_and_size,
    moving_bodies,
    planes,
    scenery,
    seen,
)
from torchrl_etl.analysis.viewer.muscles import activations, colors, paths
from torchrl_etl.extras import extra

with extra("viewer"):
    import mujoco
    import trimesh
    import viser
    from mjviser.conversions import create_site_mesh, group_geoms_by_visual_compat, merge_geoms
    from viser.transforms import SO3

__all__ = ["Body"]

_SHAPES = {
    "tendons": trimesh.creation.cylinder(radius=1.0, height=1.0, sections=8),
    "joints": trimesh.creation.icosphere(subdivisions=2, radius=1.0),
}
_FREE_TENDON = np.array([150, 150, 150], np.uint8)


class Body:
    """Meshes, sites and tendons of a model; :meth:`draw` moves them to the state of the data.

    This uses mjviser's mesh conversion, but not its scene. The latter fixes static parts when it is
    built, including goals that tasks move through the model, and draws all tendons in one colour.

    The server's scene is cleared first. ``follow`` keeps a moving body in the center.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        *,
        follow: bool = False,
    ) -> None:
        self._server, self._model, self._data = server, model, data
        server.scene.reset()
        server.scene.set_up_direction("+z")
        # Without a GPU, an environment map doubles the time per frame; a lamp replaces it.
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(cast_shadow=False)  # also slow without a GPU
        server.scene.add_light_directional("/lamp", position=(0.9, -1.0, -0.3), intensity=0.5)
        self._world = server.scene.add_frame("/world", show_axes=False)
        self._parts: list[tuple[Any, int]] = [*self._add_geoms()]
        self._sites = [*self._add_sites()]
        self._placed = np.full((len(self._parts) + len(self._sites), 12), np.nan)
        self._shapes: dict[str, Any] = {}
        self._room: dict[str, int] = {}
        self._followed = int(moving_bodies(self._model)[0]) if follow else None
        self._ahead = np.zeros(3)
        self._place_camera()
        self.draw()

    def draw(self) -> None:
        """Show the current state of the data."""
        with self._server.atomic():
            if self._followed is not None:
                self._ahead[:2] = -self._data.xpos[self._followed][:2]
                self._world.position = self._ahead
            self._place(self._parts, self._data.xpos, self._data.xmat, 0)
            self._place(self._sites, self._data.site_xpos, self._data.site_xmat, len(self._parts))
            self._draw_muscles()
        self._server.flush()

    def _add_geoms(self) -> Any:
        model, scene = self._model, self._server.scene
        flat = planes(model)
        opacity = _rgba(model, "geom")[:, 3]
        shown = seen(model) & (opacity > 0) & ~scenery(model)
        for geom in np.flatnonzero(shown & flat):
            scene.add_grid(
                f"/world/plane{geom}",
                infinite_grid=True,
                fade_distance=50.0,
                shadow_opacity=0.2,
                plane_opacity=0.3,
                position=self._data.geom_xpos[geom],
                wxyz=SO3.from_matrix(self._data.geom_xmat[geom].reshape(3, 3)).wxyz,
            )
        for geom in np.flatnonzero(shown & ~flat & (opacity < 1)).tolist():
            mesh, rgba = merge_geoms(model, [geom]), _rgba(model, "geom")[geom]
            yield self._add_flat(f"/world/geom{geom}", mesh, rgba), int(model.geom_bodyid[geom])
        for body in range(model.nbody):
            own = shown & ~flat & (opacity == 1) & (model.geom_bodyid == body)
            alike = group_geoms_by_visual_compat(model, np.flatnonzero(own).tolist())
            for number, geoms in enumerate(alike):
                mesh = merge_geoms(model, geoms)
                yield scene.add_mesh_trimesh(f"/world/body{body}/{number}", mesh), body

    def _add_sites(self) -> Any:
        model, rgba = self._model, _rgba(self._model, "site")
        shown = (model.site_group < SHOWN_GROUPS) & (rgba[:, 3] > 0)
        for site in np.flatnonzero(shown).tolist():
            mesh = create_site_mesh(model, site)
            yield self._add_flat(f"/world/site{site}", mesh, rgba[site]), site

    def _add_flat(self, name: str, mesh: trimesh.Trimesh, rgba: np.ndarray) -> Any:
        """A mesh of a single colour, as the browser requires for transparency."""
        return self._server.scene.add_mesh_simple(
            name,
            mesh.vertices,
            mesh.faces,
            color=tuple(np.clip(rgba[:3], 0, 1).tolist()),
            opacity=None if rgba[3] >= 1 else float(rgba[3]),
        )

    def _place(
        self, parts: list[tuple[Any, int]], places: np.ndarray, turns: np.ndarray, first: int
    ) -> None:
        """Update the poses of parts that have moved."""
        if not parts:
            return
        index = [number for _, number in parts]
        now = np.concatenate([places[index], turns[index]], 1)
        before = self._placed[first : first + len(parts)]
        moved = np.flatnonzero(~(np.abs(now - before) < 1e-5).all(1))
        before[moved] = now[moved]
        turned = SO3.from_matrix(now[moved, 3:].reshape(-1, 3, 3)).wxyz
        for part, wxyz in zip(moved, turned, strict=True):
            handle = parts[part][0]
            handle.position, handle.wxyz = now[part, :3], wxyz

    def _draw_muscles(self) -> None:
        path = paths(self._model, self._data)
        shades = colors(activations(self._model, self._data))
        shade = np.where(path.actuator[:, None] < 0, _FREE_TENDON, shades[path.actuator])
        along = path.end - path.start
        length = np.linalg.norm(along, axis=1)
        joint = length == 0.0
        self._show(
            "tendons",
            (path.start + path.end)[~joint] / 2,
            _from_z(along[~joint] / length[~joint, None]),
            np.stack([*[np.full((~joint).sum(), self._radius)] * 2, length[~joint]], 1),
            shade[~joint],
        )
        self._show(
            "joints",
            path.start[joint],
            np.tile([1.0, 0.0, 0.0, 0.0], (joint.sum(), 1)),
            np.full((joint.sum(), 3), 4 * self._radius),
            shade[joint],
        )

    def _show(
        self,
        name: str,
        positions: np.ndarray,
        wxyzs: np.ndarray,
        scales: np.ndarray,
        shades: np.ndarray,
    ) -> None:
        """Show many copies of one shape, with arrays [N, *].

        The browser updates these one frame later than the poses of nodes, so tendons below a moving
        world frame would be displaced. They are placed outside it, shifted by its offset.
        """
        count, room = len(positions), self._room.get(name, 0)
        if not count:
            return
        if count > room:  # with spare capacity, since tendons wrap and unwrap
            room = self._room[name] = count + count // 4
            if name in self._shapes:
                self._shapes.pop(name).remove()
        padding = ((0, room - count), (0, 0))
        positions = positions + self._ahead
        positions, scales = (np.pad(a, padding).astype(np.float32) for a in (positions, scales))
        wxyzs = np.pad(wxyzs, padding, constant_values=0.5).astype(np.float32)
        shades = np.pad(shades, padding)
        if (handle := self._shapes.get(name)) is None:
            self._shapes[name] = self._server.scene.add_batched_meshes_simple(
                f"/{name}",
                _SHAPES[name].vertices,
                _SHAPES[name].faces,
                batched_wxyzs=wxyzs,
                batched_positions=positions,
                batched_scales=scales,
                batched_colors=shades,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            return
        handle.batched_positions, handle.batched_wxyzs = positions, wxyzs
        handle.batched_scales, handle.batched_colors = scales, shades

    def _place_camera(self) -> None:
        middle, size = middle_and_size(self._model, self._data)
        self._radius = 0.003 * size
        if self._followed is not None:
            middle[:2] -= self._data.xpos[self._followed][:2]
        camera = self._server.initial_camera
        camera.look_at = middle
        camera.position = middle + size * np.array([0.9, -1.0, 0.6])
        camera.fov = np.radians(50)


def _rgba(model: mujoco.MjModel, kind: str) -> np.ndarray:
    """Colours [N, 4] of geoms or sites; unset ones get the colour of their material, if any."""
    rgba = np.array(getattr(model, f"{kind}_rgba"))
    material = getattr(model, f"{kind}_matid")
    default = (rgba == np.float32([0.5, 0.5, 0.5, 1.0])).all(1)  # unset, by MuJoCo's convention
    from_material = (material >= 0) & default
    rgba[from_material] = model.mat_rgba[material[from_material]]
    return rgba


def _from_z(directions: np.ndarray) -> np.ndarray:
    """Quaternions wxyz [N, 4] that rotate the z axis to unit vectors [N, 3]."""
    x, y, z = directions.T
    wxyz = np.stack([1.0 + z, -y, x, np.zeros_like(x)], 1)
    wxyz[z < -0.999999] = [0.0, 1.0, 0.0, 0.0]
    return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
