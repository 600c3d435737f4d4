"""MuJoCo's own renderer, without a screen."""

from __future__ import annotations

import atexit
import importlib
import math
import os
import subprocess
import sys
import threading
from contextlib import nullcontext, suppress
from functools import lru_cache
from typing import Any, final

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.backends.mujoco.drawing import VisibleModel, draw_goals, drawn
from scm_world.backends.mujoco.realization import Realization
from scm_world.models.camera import Camera
from scm_world.models.scene import Light, Scene

LIBRARIES = ("egl", "osmesa")
"""What OpenGL can draw with where there is no screen."""

FORBIDDEN = ("disable", "disabled", "off", "false", "0")
"""Values of ``MUJOCO_GL`` with which MuJoCo does not draw."""

_TRIAL = """
import importlib, sys, mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(8, 8)
context.make_current()
mujoco.MjrContext(model, 100).free()
context.free()
"""


def opengl() -> str | None:
    """Name the library with which MuJoCo can draw here without a screen; None if none can.

    Each is tried once, in another process, since a driver that fails can end its process. The
    environment variable ``MUJOCO_GL`` can name one of them, or forbid all with ``disabled``. No
    library works in a process forked from one that has drawn with it: its threads are missing.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in FORBIDDEN or _drew - {os.getpid()}:
        return None
    return next(filter(_works, [wanted] if wanted in LIBRARIES else LIBRARIES), None)


@lru_cache(maxsize=len(LIBRARIES))
def _works(library: str) -> bool:
    """Make a context of a library in another process, and free it."""
    try:
        trial = subprocess.run(  # noqa: S603 # our own interpreter, our own code
            [sys.executable, "-c", _TRIAL, library],
            env={**os.environ, "MUJOCO_GL": library, "PYOPENGL_PLATFORM": library},
            capture_output=True,
            timeout=60.0,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    with suppress(Exception):  # it is torch's, if there is one
        # A software driver and triton have an LLVM each: the process ends if triton comes second.
        importlib.import_module("triton")
    return trial.returncode == 0


def draw_scene(
    scene: Scene, camera: Camera, sky: tuple[int, int, int], library: str
) -> NDArray[np.uint8]:
    """Draw with MuJoCo the scene of a ``Model``, shape (h, w, 3).

    Args:
        scene: What to show. Its light shines if the model has none; the headlight always does.
        camera: Where from.
        sky: Red, green and blue where there is nothing, unless the model has a sky.
        library: One of ``LIBRARIES`` that works here; see ``opengl``.
    """
    drawing, data = drawn(scene)
    abstract = drawing.scene(data)
    draw_goals(abstract, scene.goals)
    _, up, back = camera.axes()
    top = camera.near * math.tan(math.radians(camera.field_of_view) / 2.0)
    for eye in abstract.camera:
        eye.pos[:], eye.forward[:], eye.up[:] = camera.eye, -back, up
        eye.frustum_near, eye.frustum_far = camera.near, camera.far
        eye.frustum_top, eye.frustum_bottom = top, -top
        eye.frustum_center = eye.frustum_width = 0.0
        eye.orthographic = 0
    for lamp in abstract.lights[: abstract.nlight]:
        if lamp.headlight:
            lamp.pos[:], lamp.dir[:] = camera.eye, -back
    if drawing.model.nlight == 0:
        _light(abstract, scene.light, camera, float(drawing.model.stat.extent))
    rgb, there = _canvas(drawing, (camera.height, camera.width), library).picture(abstract)
    if not (drawing.model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).any():
        rgb[~there] = sky
    return rgb


def _light(abstract: mujoco.MjvScene, light: Light, camera: Camera, extent: float) -> None:
    """Add a light from one direction, with shadows around what the camera looks at."""
    towards = np.divide(light.direction, math.hypot(*light.direction))
    lamp = abstract.lights[abstract.nlight]
    lamp.id, lamp.texid, lamp.headlight, lamp.castshadow = -1, -1, 0, 1
    lamp.type = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    lamp.pos[:], lamp.dir[:] = camera.target + extent * towards, -towards
    lamp.attenuation[:], lamp.cutoff, lamp.exponent = (1.0, 0.0, 0.0), 45.0, 0.0
    lamp.ambient[:], lamp.diffuse[:], lamp.specular[:] = light.ambient / 2.0, 0.5, 0.2
    abstract.nlight += 1


@final
class _Canvas:
    """An OpenGL context with the meshes and textures of a model."""

    def __init__(self, drawing: VisibleModel, size: tuple[int, int], library: str) -> None:
        self._of = drawing, size, library
        _drew.add(os.getpid())
        height, width = size
        self._place = mujoco.MjrRect(0, 0, width, height)
        self._context = importlib.import_module(f"mujoco.{library}").GLContext(width, height)
        self._context.make_current()
        drawing.model.vis.quality.offsamples = 0  # edges would be mixed with black, not the sky
        self._renderer = mujoco.MjrContext(drawing.model, int(mujoco.mjtFontScale.mjFONTSCALE_100))
        mujoco.mjr_resizeOffscreen(width, height, self._renderer)
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._renderer)

    def fits(self, drawing: VisibleModel, size: tuple[int, int], library: str) -> bool:
        """Tell whether it was made for this."""
        mine, *rest = self._of
        return mine is drawing and rest == [size, library]

    def picture(self, scene: mujoco.MjvScene) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Draw a scene; give the colors (h, w, 3), and where there is something (h, w)."""
        rgb = np.empty((self._place.height, self._place.width, 3), dtype=np.uint8)
        depth = np.empty(rgb.shape[:2], dtype=np.float32)
        self._context.make_current()
        mujoco.mjr_render(self._place, scene, self._renderer)
        mujoco.mjr_readPixels(rgb, depth, self._place, self._renderer)
        return rgb[::-1].copy(), depth[::-1] < 1.0

    def close(self) -> None:
        """Free all of it, unless it belongs to the process that this one was forked from."""
        if not _drew - {os.getpid()}:
            self._context.make_current()
            self._renderer.free()
            self._context.free()


_drew: set[int] = set()
"""Numbers of the processes that have made a canvas: of this one, and of those before a fork."""

_local = threading.local()
"""The canvas of each thread: an OpenGL context belongs to one."""


def _canvas(drawing: VisibleModel, size: tuple[int, int], library: str) -> _Canvas:
    """Give the canvas of this thread, a new one if the last one does not fit."""
    canvas: _Canvas | None = getattr(_local, "canvas", None)
    if canvas is None or not canvas.fits(drawing, size, library):
        _close()
        canvas = _local.canvas = _Canvas(drawing, size, library)
        atexit.unregister(_close)
        atexit.register(_close)  # runs before what the library registered when it was imported
    return canvas


def _close() -> None:
    """Free the canvas of this thread."""
    canvas: _Canvas | None = getattr(_local, "canvas", None)
    _local.canvas = None
    if canvas is not None:
        canvas.close()


@final
class Viewer:
    """A window that shows what it is given; it simulates nothing."""

    def __init__(self) -> None:
        self._backend = MujocoBackend()
        self._shown: Realization | None = None
        self._handle: Any = None

    def show(self, scene: Scene) -> None:
        """Show a scene; the first one, and one with other bodies, opens the window.

        Once someone has closed the window, nothing is shown.
        """
        engine, handle = self._backend, self._handle
        with nullcontext() if handle is None else handle.lock():
            engine.build(scene)
            now = engine.realization
            mujoco.mj_forward(now.model, now.data)
        if now is not self._shown:
            self.close()
            from mujoco import viewer  # loads a window system, so only when a window is wanted

            self._shown = now
            self._handle = viewer.launch_passive(
                now.model, now.data, show_left_ui=False, show_right_ui=False
            )
        handle = self._handle
        if not handle.is_running():
            return
        with handle.lock():
            handle.user_scn.ngeom = 0
            draw_goals(handle.user_scn, scene.goals)
        handle.sync()

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._handle is not None:
            self._handle.close()
        self._handle = None
