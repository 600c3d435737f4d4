"""MuJoCo's window, for scenes of any engine: of the TriFinger, and of any ``Model``."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, final

import mujoco

from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.backends.mujoco.drawing import draw_goals
from scm_world.backends.mujoco.realization import Realization
from scm_world.models.scene import Scene


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
            self._shown, self._handle = now, _launch(now.model, now.data)
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


def _launch(model: Any, data: Any) -> Any:
    import mujoco.viewer  # loads a window system, so only when a window is wanted

    return mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
