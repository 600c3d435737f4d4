"""What one can look at in an environment: a window, layouts, measured pictures."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of, whole_number
from scm_world.env.observer import Observer
from scm_world.errors import EngineError
from scm_world.models import Scene
from scm_world.models.camera import Camera
from scm_world.queries.world import World

if TYPE_CHECKING:
    from scm_world.backends.mujoco.viewer import Viewer


@final
class Window:
    """A window in which MuJoCo draws scenes of any engine."""

    def __init__(self) -> None:
        if not self.is_possible():
            raise EngineError(
                "render_mode='human' opens a window, and there is no screen: neither DISPLAY nor "
                "WAYLAND_DISPLAY is set; use render_mode='rgb_array', which needs none",
                "mujoco",
            )
        self._viewer: Viewer | None = None

    @staticmethod
    def is_possible() -> bool:
        """Tell whether there is a screen."""
        if not sys.platform.startswith("linux"):
            return True
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))

    def show(self, scene: Scene) -> None:
        """Show a scene; the first time, the window opens."""
        if self._viewer is None:
            from scm_world.backends.mujoco.viewer import Viewer

            self._viewer = Viewer()
        self._viewer.show(scene)

    def close(self) -> None:
        """Close the window."""
        if self._viewer is not None:
            self._viewer.close()


class Looks:
    """Layouts, modes and measured pictures of an environment.

    Attributes:
        world: That is observed.
    """

    world: World
    _observer: Observer
    _modes: tuple[str, str]
    _automatic: Camera | None = None
    _view: Camera | str | None = None
    _size: tuple[int, int] | None = None

    @property
    def observation_mode(self) -> str:
        """What is observed; chosen when the environment is made."""
        return self._modes[0]

    @property
    def action_mode(self) -> str:
        """What an action means; chosen when the environment is made."""
        return self._modes[1]

    @property
    def layout(self) -> dict[str, slice]:
        """Where each variable stands in the vector that is observed; empty for pictures."""
        return dict(self._observer.layouts.get("observation", {}))

    @property
    def context_layout(self) -> dict[str, slice]:
        """Where each variable stands in the privileged context; empty without one."""
        return dict(self._observer.layouts.get("context", {}))

    def _choose_view(self, camera: Any, size: Any) -> None:
        """Choose camera and size of the pictures for people."""
        from scm_world.env.pixels import height_and_width, read_camera

        if camera is not None:
            from scm_world.backends.renderer import scene_camera

            self._view = read_camera(camera, None)
            scene_camera(self.world.structure.default_scene(), self._view)
        if size is not None:
            self._size = height_and_width("render_size", size)
            whole_number("render_size", min(self._size), least=1)

    def _camera(self, camera: Camera | str | None) -> Camera:
        from scm_world.backends.renderer import scene_camera, views_of

        if isinstance(camera, Camera):
            return camera
        views = views_of(self.world.structure)
        if views is None:
            return scene_camera(self.world.scene(), camera)
        camera = views.overview.name if camera is None else camera
        known = {one.name: one for one in (*self.world.cameras(), views.overview)}
        one_of("camera", camera, known)
        return known[camera]

    def depth(self, camera: Camera | str | None = None) -> NDArray[np.float32]:
        """Measure how far away everything is, shape (h, w) [m].

        Args:
            camera: Any, or the name of one: of the robot's tasks ``"60"``, ``"120"``, ``"300"``,
                ``"overview"``, of a model one in its file, or ``"automatic"``. The last one if
                None.
        """
        from scm_world.backends.renderer import render

        return render(self.world.scene(), self._camera(camera), colors=False).depth

    def _camera_of(self, scene: Scene) -> Camera:
        """Give the camera of pictures for people: of a model it follows what moves."""
        from scm_world.backends.renderer import following_camera, scene_camera, shapes_of, views_of
        from scm_world.env.pixels import AUTOMATIC

        views = views_of(self.world.structure)
        if self._view is not None and (views is not None or self._view != AUTOMATIC):
            return self._camera(self._view)
        if views is not None:
            return views.overview
        if self._automatic is None:
            self._automatic = scene_camera(self.world.structure.default_scene())
        return following_camera(self._automatic, shapes_of(scene, goals=False))

    def segmentation(
        self, camera: Camera | str | None = None
    ) -> tuple[NDArray[np.int32], tuple[str, ...]]:
        """Tell which body every pixel shows.

        Args:
            camera: As in ``depth``.

        Returns:
            Shape (h, w): an index into the names of the bodies, -1 where there is nothing; and
            these names.
        """
        from scm_world.backends.renderer import render

        image = render(self.world.scene(), self._camera(camera), colors=False)
        return image.segmentation, image.names
