"""Pictures of an environment: where its cameras stand, and observations that are pictures."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of
from scm_world._types import Values
from scm_world.backends.renderer import (
    AUTOMATIC,
    camera_pixels,
    following_camera,
    scene_camera,
    shape_of_pixels,
    shapes_of,
)
from scm_world.errors import UnknownOption
from scm_world.models import Scene
from scm_world.models.camera import Camera
from scm_world.world import Simulation

Size = int | tuple[int, int]


def has_screen() -> bool:
    """Return whether a window can be opened."""
    displays = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(displays) or not sys.platform.startswith("linux")


def read_camera(camera: object) -> Any:
    """Read a camera that was written down as a dictionary; a name stays a name."""
    if not isinstance(camera, Mapping):
        return camera
    given: dict[str, Any] = {
        field: tuple(value) if isinstance(value, list) else value for field, value in camera.items()
    }
    try:
        return Camera(**given)
    except TypeError:
        fields = ", ".join(Camera.__dataclass_fields__)
        raise UnknownOption("camera", camera, (f"a dictionary of {fields}",)) from None


def height_and_width(option: str, size: Size | None) -> tuple[int, int] | None:
    """Read the size of pictures: height and width, or both in one [pixels]."""
    if size is None:
        return None
    numbers = np.asarray(size)
    is_whole = numbers.shape in ((), (2,)) and np.issubdtype(numbers.dtype, np.integer)
    if not is_whole or numbers.min() < 1:
        allowed = ("a positive whole number", "two of them: (height, width)")
        raise UnknownOption(option, size, allowed)
    height, width = np.broadcast_to(numbers, (2,)).tolist()
    return height, width


@final
class Cameras:
    """The cameras of a world, where they stand now."""

    def __init__(self, world: Simulation) -> None:
        self._world = world
        self._first: Camera | None = None

    def now(
        self, scene: Scene, camera: Camera | str | None, size: tuple[int, int] | None = None
    ) -> Camera:
        """Return a camera for a scene of the world.

        Those of the robot stand where their variables say, those of a file where they stand in the
        scene; ``"automatic"`` follows the moving bodies of a model.

        Args:
            scene: The present one.
            camera: A camera or its name; if None ``"overview"`` of the robot, ``"automatic"`` of a
                model.
            size: Height and width of the picture [pixels]; those of the camera if None.
        """
        views = scene.structure.views
        if views is not None and not isinstance(camera, Camera):
            known = {one.name: one for one in (*self._world.cameras(), views.overview)}
            name = views.overview.name if camera is None else camera
            one_of("camera", name, known)
            camera = known[name]
        elif views is None and camera in (None, AUTOMATIC):
            if self._first is None:
                self._first = scene_camera(self._world.structure.default_scene(), None, size)
            camera = following_camera(self._first, shapes_of(scene, goals=False))
        return scene_camera(scene, camera, size)


@final
class Pixels:
    """The present views of cameras, and in the robot's tasks then the views of the goals.

    Args:
        world: That is observed.
        cameras: Cameras or names. None: of the robot's tasks those of policies, of a model
            ``"automatic"``.
        size: Height and width of the pictures, or both in one [pixels]; 128 if None.
        stacked: Whether all of them are the channels of one picture.

    Attributes:
        names: The variables that have to be computed: none.
        layout: Where variables stand in a vector, which pictures are not.
        together: Whether several worlds can be observed in one call.
        space: uint8, shape (n, 3, h, w), with goals (2 n, 3, h, w); stacked (3 n, h, w) or
            (6 n, h, w); under the predecessor's conventions channels are last.
    """

    names: tuple[str, ...] = ()
    together = False

    def __init__(
        self,
        world: Simulation,
        cameras: Sequence[str | Camera] | None,
        size: Size | None,
        *,
        stacked: bool = False,
    ) -> None:
        views, self._published = world.structure.views, world.options.conventions.published
        self._world, self._cameras = world, Cameras(world)
        self._size = height_and_width("image_size", size) or (Camera.height, Camera.width)
        own = () if views is None else views.cameras
        if views is not None and self._published:
            own = views.original_cameras
        given = [camera.name for camera in own] or [AUTOMATIC] if cameras is None else cameras
        if isinstance(given, str) or not len(given):
            raise UnknownOption("list of cameras", cameras, ("one or more names or cameras",))
        fixed = {camera.name: camera for camera in own if self._published}
        read = [read_camera(camera) for camera in given]
        self._given = [fixed.get(camera, camera) for camera in read]
        scene = world.structure.default_scene()
        self._placed = [scene_camera(scene, camera, self._size) for camera in self._given]
        self.layout: dict[str, slice] = {}
        one, n = shape_of_pixels(self._placed[0], published=self._published), len(given)
        self._shows_goals = views is not None
        self._goals: NDArray[np.uint8] = np.empty((n, *one), dtype=np.uint8)
        self._shape = (2 * n if self._shows_goals else n, *one)
        self._stacked = stacked
        shape = (
            self._as_one(np.empty(self._shape, dtype=np.uint8)).shape if stacked else self._shape
        )
        self.space: gymnasium.Space[NDArray[np.uint8]] = gymnasium.spaces.Box(
            0, 255, shape, np.uint8
        )
        self._version = -1

    def observe(self, now: Values) -> NDArray[np.uint8]:
        """Draw; pictures of the goals are kept until someone intervenes."""
        scene = self._world.compiled.scene(self._world.row)  # drawn immediately: no copies
        published, n = self._published, len(self._given)
        pictures: NDArray[np.uint8] = np.empty(self._shape, dtype=np.uint8)
        if self._version != self._world.version or not self._shows_goals:
            self._version = self._world.version
            self._placed = [self._cameras.now(scene, one, self._size) for one in self._given]
            if self._shows_goals:
                camera_pixels(scene, self._placed, self._goals, goals=True, published=published)
        camera_pixels(scene, self._placed, pictures[:n], published=published)
        pictures[n:] = self._goals[: len(pictures) - n]
        return self._as_one(pictures) if self._stacked else pictures

    def _as_one(self, pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return pictures as the channels of one, those of the first picture first."""
        return np.concatenate(pictures, axis=-1 if self._published else 0)
