"""MuJoCo's rendering backend. This module imports nothing that could import MuJoCo."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import warnings

__all__ = ["draw_without_display", "ignore_unusable_backend"]

_TRY = "import mujoco; mujoco.GLContext(16, 16).make_current()"
_LIBRARIES = {"egl": ("libEGL", "libegl1"), "osmesa": ("libOSMesa", "libosmesa6")}
_ON, _OFF = ("enable", "enabled", "on", "true", "1"), ("disable", "disabled", "off", "false", "0")
_TAKEN = ("", "glfw", "glx", *_ON, *_OFF)
"""Other values that MuJoCo accepts on Linux; none needs a library at import."""


def ignore_unusable_backend() -> None:
    """Unset ``MUJOCO_GL``, with a warning, if it is no backend or its library is missing.

    MuJoCo reads it and loads the library at import, so nothing would run, even without rendering.
    The warning names the package to install, or the valid backends.
    """
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    if sys.platform != "linux" or backend in _TAKEN:
        return
    fault = "it is not a MuJoCo backend; use egl, osmesa or glfw, or leave it unset"
    if backend in _LIBRARIES:
        library, package = _LIBRARIES[backend]
        if any(map(_opens, (f"{library}.so", *(f"{library}.so.{i}" for i in range(10))))):
            return
        fault = f"{library} is not installed (Debian: apt-get install {package})"
    warnings.warn(f"MUJOCO_GL={backend} is ignored, since {fault}.", stacklevel=2)
    del os.environ["MUJOCO_GL"]


def draw_without_display() -> None:
    """Without a display, let MuJoCo render through EGL, or else OSMesa.

    MuJoCo chooses its backend when it is first imported, for example by TorchRL, so call this
    before. Only rendering shows whether a library works, so each is tried in a subprocess.
    ``MUJOCO_GL`` stays unchanged if it is set already, or if neither works.
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


def _opens(file: str) -> bool:
    try:
        ctypes.CDLL(file)
    except OSError:
        return False
    return True
