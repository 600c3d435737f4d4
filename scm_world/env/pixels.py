"""Observations that are pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Values
from scm_world.backends.renderer import (
    camera_pixels,
    following_camera,
    scene_camera,
    shape_of_pixels,
    shapes_of,
    views_of,
)
from scm_world.env.vector import Layouts
from scm_world.errors import UnknownOption
from scm_world.models import Scene
from scm_world.models.camera import Camera
from scm_world.world import Simulation

Size = int | tuple[int, int]

AUTOMATIC = "automatic"
"""A camera that looks at what moves in a model, and follows it."""


def _sized(found: Sequence[Camera], size: Size | None) -> tuple[Camera, ...]:
    """Give cameras pictures of one size."""
    if size is not None:
        height, width = height_and_width("image_size", size)
        found = [replace(camera, height=height, width=width) for camera in found]
    sizes = {(camera.height, camera.width) for camera in found}
    if len(sizes) != 1 or min(min(sizes)) < 1:
        raise UnknownOption("image_size", size, ("one positive size for all cameras",))
    return tuple(found)


def read_camera(camera: Any, known: Mapping[str, Camera] | None) -> Any:
    """Look up a camera, or read one that was written down as a dictionary; others are not known."""
    if isinstance(camera, Camera):
        return camera
    if isinstance(camera, Mapping):
        given: dict[str, Any] = {
            field: tuple(value) if isinstance(value, list) else value
            for field, value in camera.items()
        }
        try:
            return Camera(**given)
        except TypeError:
            fields = Camera.__dataclass_fields__
            raise UnknownOption(
                "camera", camera, (f"a dictionary of {', '.join(fields)}",)
            ) from None
    if known is None:
        return camera
    if not isinstance(camera, str) or camera not in known:
        raise UnknownOption("camera", camera, known)
    return known[camera]


def height_and_width(option: str, size: Any) -> tuple[int, int]:
    """Read the size of pictures: height and width, or both in one [pixels]."""
    numbers = np.asarray(size)
    if numbers.shape not in ((), (2,)) or not np.issubdtype(numbers.dtype, np.integer):
        raise UnknownOption(option, size, ("a whole number", "(height, width)"))
    height, width = np.broadcast_to(numbers, (2,)).tolist()
    return height, width


@final
class Pixels:
    """What cameras see, and in the robot's tasks then what they should see.

    Args:
        world: That is observed.
        cameras: Cameras or names. None: of the robot's tasks those of policies, of a model
            ``"automatic"``. Those of the robot stand where their variables say, those of a file
            where they stand now.
        size: Height and width of the pictures, or both in one [pixels]; if None those of the
            cameras, or of a model 128.

    Attributes:
        names: The variables that have to be computed: none.
        layouts: Where variables stand in vectors: there are none.
        space: uint8, shape (n, 3, h, w), with goals (2 n, 3, h, w); under the predecessor's
            conventions (2 n, h, w, 3).
    """

    names: tuple[str, ...] = ()

    def __init__(
        self,
        world: Simulation,
        cameras: Sequence[str | Camera] | None,
        size: Size | None,
    ) -> None:
        views, published = views_of(world.structure), world.options.conventions.published
        self._world, self._shows_goals = world, views is not None
        own: tuple[Camera, ...] = ()
        if views is not None:
            own = views.original_cameras if published else views.cameras
        usual = [AUTOMATIC] if views is None else [camera.name for camera in own]
        given = usual if cameras is None else cameras
        if isinstance(given, str) or not len(given):
            raise UnknownOption("list of cameras", cameras, ("one or more names or cameras",))
        self._given = tuple(given)
        if views is not None:
            known = {camera.name: camera for camera in (*own, views.overview)}
            found = [read_camera(camera, known) for camera in given]
        else:
            plain = Camera("", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
            scene, shape = world.structure.default_scene(), (plain.height, plain.width)
            found = [
                scene_camera(scene, read_camera(c, None), shape if isinstance(c, str) else None)
                for c in given
            ]
        self._follows = [not published and isinstance(c, str) and c in usual for c in given]
        self._cameras = _sized(found, size)
        self.layouts: Layouts = {}
        self._published = published
        one, n = shape_of_pixels(self._cameras[0], published=published), len(given)
        self._goals: NDArray[np.uint8] = np.empty((n, *one), dtype=np.uint8)
        self._shape = (2 * n if self._shows_goals else n, *one)
        self.space: gymnasium.Space[NDArray[np.uint8]] = gymnasium.spaces.Box(
            0, 255, self._shape, np.uint8
        )
        self._version = -1

    def observe(self, now: Values) -> NDArray[np.uint8]:
        """Draw; pictures of the goals are kept until someone intervenes."""
        scene = self._world.compiled.describe(
            self._world.row, self._world.state
        )  # drawn immediately
        published, n = self._published, len(self._cameras)
        pictures: NDArray[np.uint8] = np.empty(self._shape, dtype=np.uint8)
        if not self._shows_goals:
            pairs = zip(self._given, self._cameras, strict=True)
            cameras = [placed(scene, given, camera) for given, camera in pairs]
            camera_pixels(scene, cameras, pictures, published=published)
            return pictures
        if self._version != self._world.version:
            self._version = self._world.version
            present = {camera.name: camera for camera in self._world.cameras()}
            self._cameras = tuple(
                replace(present[camera.name], height=camera.height, width=camera.width)
                if follows
                else camera
                for camera, follows in zip(self._cameras, self._follows, strict=True)
            )
            camera_pixels(scene, self._cameras, self._goals, goals=True, published=published)
        camera_pixels(scene, self._cameras, pictures[:n], published=published)
        pictures[n:] = self._goals
        return pictures


def placed(scene: Scene, given: str | Camera, camera: Camera) -> Camera:
    """Put a camera of a model where it is now."""
    if given == AUTOMATIC:
        return following_camera(camera, shapes_of(scene, goals=False))
    if isinstance(given, str):
        return scene_camera(scene, given, (camera.height, camera.width))
    return camera
