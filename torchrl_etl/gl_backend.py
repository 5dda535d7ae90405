"""Which library MuJoCo draws with; imports nothing that could import MuJoCo."""

from __future__ import annotations

import os
import subprocess
import sys

__all__ = ["draw_without_display"]

_TRY = "import mujoco; mujoco.GLContext(16, 16).make_current()"


def draw_without_display() -> None:
    """Let MuJoCo draw through EGL, or else OSMesa, where there is no display.

    MuJoCo chooses its back end when it is first imported (by TorchRL, for one), so call this before
    any such import. Whether a library works is known only once it has drawn, so each is tried, in a
    process of its own. A ``MUJOCO_GL`` that is set already is left as it is, and so it is if
    neither works.
    """
    has_display = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if sys.platform != "linux" or has_display or os.environ.get("MUJOCO_GL"):
        return
    for backend in ("egl", "osmesa"):
        environ = os.environ | {"MUJOCO_GL": backend}
        tried = subprocess.run([sys.executable, "-c", _TRY], capture_output=True, env=environ)
        if tried.returncode == 0:
            os.environ["MUJOCO_GL"] = backend
            return
