"""MuJoCo's window, for scenes of any engine."""

from __future__ import annotations

from typing import Any, final

import mujoco
import numpy as np

from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.geometry import rotation_matrix
from scm_world.models.scene import Goal, Scene
from scm_world.scene.scene import Structure

GOAL_OPACITY = 0.3  # Source: CausalWorld 1.2, silhouettes


@final
class Viewer:
    """A window that shows what it is given; it simulates nothing."""

    def __init__(self) -> None:
        self._backend = MujocoBackend()
        self._structure: Structure | None = None
        self._handle: Any = None

    def show(self, scene: Scene) -> None:
        """Show a scene; the first one, and one with other bodies, opens the window.

        Once someone has closed the window, nothing is shown.
        """
        engine = self._backend
        if scene.structure != self._structure:
            self.close()
            engine.build(scene)
            self._structure = scene.structure
            self._handle = _launch(engine.realization.model, engine.realization.data)
        handle = self._handle
        if not handle.is_running():
            return
        with handle.lock():
            engine.build(scene)
            mujoco.mj_forward(engine.realization.model, engine.realization.data)
            _draw_goals(handle.user_scn, scene.goals)
        handle.sync()

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._handle is not None:
            self._handle.close()
        self._handle = None


def _launch(model: Any, data: Any) -> Any:
    import mujoco.viewer  # loads a window system, so only when a window is wanted

    return mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)


def _draw_goals(canvas: Any, goals: tuple[Goal, ...]) -> None:
    """Draw goals as silhouettes; of a hull, the box around it."""
    canvas.ngeom = min(len(goals), canvas.maxgeom)
    for shape, goal in zip(canvas.geoms, goals, strict=False):
        round_ = goal.shape == "sphere"
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if round_ else mujoco.mjtGeom.mjGEOM_BOX
        mujoco.mjv_initGeom(
            shape,
            kind,
            np.asarray(goal.size, dtype=np.float64) / 2.0,
            np.asarray(goal.position, dtype=np.float64),
            rotation_matrix(goal.orientation).ravel(),
            np.array([*goal.color, GOAL_OPACITY], dtype=np.float32),
        )
