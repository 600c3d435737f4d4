"""MuJoCo's window."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, final

import mujoco
import numpy as np

from scm_world.backends.mujoco.realization import Realization
from scm_world.geometry.rotations import rotation_matrix
from scm_world.models.scene import Scene
from scm_world.models.shapes import GOAL_OPACITY


@final
class Viewer:
    """A window that shows scenes; it simulates nothing."""

    def __init__(self) -> None:
        self._shown: Realization | None = None
        self._handle: Any = None

    def show(self, scene: Scene) -> None:
        """Show a scene; the first one, and one with other bodies, opens the window.

        Once someone has closed the window, nothing is shown.
        """
        now, handle = self._shown, self._handle
        with nullcontext() if handle is None else handle.lock():
            if now is None or now.structure != scene.structure:
                now = Realization(scene.structure, scene.parameters, whole=True)
            now.edit(scene.parameters)
            now.reset()
            now.place(scene.state.vector)
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
        shown, kinds = handle.user_scn, mujoco.mjtGeom
        with handle.lock():
            shown.ngeom = min(len(scene.goals), shown.maxgeom)
            for geom, goal in zip(shown.geoms, scene.goals, strict=False):
                mujoco.mjv_initGeom(  # a silhouette; of a hull, the box around it
                    geom,
                    kinds.mjGEOM_SPHERE if goal.shape == "sphere" else kinds.mjGEOM_BOX,
                    np.asarray(goal.size, dtype=np.float64) / 2.0,
                    np.asarray(goal.position, dtype=np.float64),
                    rotation_matrix(goal.orientation).ravel(),
                    np.array([*goal.color, GOAL_OPACITY], dtype=np.float32),
                )
        handle.sync()

    def close(self) -> None:
        """Close the window, if it is open."""
        if self._handle is not None:
            self._handle.close()
        self._handle = None
