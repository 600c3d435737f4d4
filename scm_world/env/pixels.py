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
    ORIGINAL,
    PLAIN,
    drawing_of,
    following_camera,
    goal_pixels,
    now_pixels,
    scene_camera,
)
from scm_world.env.vector import Layouts
from scm_world.errors import UnknownOption
from scm_world.models import Scene
from scm_world.models.camera import Camera
from scm_world.world import World

Size = int | tuple[int, int]

AUTOMATIC = "automatic"
"""A camera that looks at what moves in a model, and follows it."""


def pixel_observer(
    world: World, cameras: Sequence[str | Camera] | None, size: Size | None
) -> Pixels | ModelPixels:
    """Return what observes a world by pictures.

    Args:
        world: That is observed.
        cameras: Names, or cameras; those of policies if None.
        size: Height and width of the pictures, or both in one [pixels]; those of the cameras
            if None.

    Raises:
        UnknownOption: There is no such camera, or the sizes are none or differ.
    """
    drawing = drawing_of(world.structure)
    if drawing.overview is None:
        return ModelPixels(world, cameras, size)
    original = world.conventions.published_observation
    own = drawing.original_cameras if original else drawing.cameras
    known = {camera.name: camera for camera in (*own, drawing.overview)}
    if isinstance(cameras, str) or (cameras is not None and not len(cameras)):
        raise UnknownOption("list of cameras", cameras, ("one or more names or cameras",))
    asked = [camera.name for camera in own] if cameras is None else cameras
    names = {camera.name for camera in own}
    follows = tuple(not original and isinstance(c, str) and c in names for c in asked)
    return Pixels(world, _sized([_camera(camera, known) for camera in asked], size), follows)


def _sized(found: Sequence[Camera], size: Size | None) -> tuple[Camera, ...]:
    """Give cameras pictures of one size."""
    if size is not None:
        height, width = _height_and_width(size)
        found = [replace(camera, height=height, width=width) for camera in found]
    sizes = {(camera.height, camera.width) for camera in found}
    if len(sizes) != 1 or min(min(sizes)) < 1:
        raise UnknownOption("image_size", size, ("one positive size for all cameras",))
    return tuple(found)


def _camera(camera: Any, known: Mapping[str, Camera]) -> Camera:
    """Look up a camera, or read one that was written down as a dictionary."""
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
    if not isinstance(camera, str) or camera not in known:
        raise UnknownOption("camera", camera, known)
    return known[camera]


def _height_and_width(size: Any) -> tuple[int, int]:
    numbers = np.asarray(size)
    if numbers.shape not in ((), (2,)) or not np.issubdtype(numbers.dtype, np.integer):
        raise UnknownOption("image_size", size, ("a whole number", "(height, width)"))
    height, width = np.broadcast_to(numbers, (2,)).tolist()
    return height, width


@final
class Pixels:
    """What cameras see, and then what they should see.

    Args:
        world: That is observed.
        cameras: With pictures of one size.
        followed: Of each, whether it stands where its variables say.

    Attributes:
        names: The variables that have to be computed: none.
        layouts: Where variables stand in vectors: there are none.
        space: uint8, shape (2 n, 3, h, w); under the predecessor's conventions (2 n, h, w, 3).
    """

    names: tuple[str, ...] = ()

    def __init__(
        self, world: World, cameras: tuple[Camera, ...], followed: tuple[bool, ...]
    ) -> None:
        self._world, self._cameras, self._followed = world, cameras, followed
        self.layouts: Layouts = {}
        self._convention = ORIGINAL if world.conventions.published_observation else PLAIN
        self._shape = (2 * len(cameras), *self._convention.shape(cameras[0]))
        self.space: gymnasium.Space[NDArray[np.uint8]] = gymnasium.spaces.Box(
            0, 255, self._shape, np.uint8
        )
        self._goals = np.empty((len(cameras), *self._shape[1:]), dtype=np.uint8)
        self._version = -1

    def observe(self, now: Values) -> NDArray[np.uint8]:
        """Draw; pictures of the goals are kept until someone intervenes."""
        scene, layout = self._world.scene(), self._convention
        if self._version != self._world.version:
            self._version = self._world.version
            self._cameras = self._present_cameras()
            goal_pixels(scene, self._cameras, self._goals, convention=layout)
        pictures: Any = np.empty(self._shape, dtype=np.uint8)
        half = len(self._cameras)
        now_pixels(scene, self._cameras, pictures[:half], convention=layout)
        pictures[half:] = self._goals
        found: NDArray[np.uint8] = pictures
        return found

    def _present_cameras(self) -> tuple[Camera, ...]:
        """Put the cameras of the robot where their variables say."""
        present = {camera.name: camera for camera in self._world.cameras()}
        return tuple(
            replace(present[camera.name], height=camera.height, width=camera.width)
            if follows
            else camera
            for camera, follows in zip(self._cameras, self._followed, strict=True)
        )


@final
class ModelPixels:
    """What cameras see of a model.

    Args:
        world: That is observed.
        cameras: Cameras; names of those in the file, which stand where they stand now; or
            ``"automatic"``, which is what None stands for.
        size: Height and width of the pictures, or both in one [pixels]; 128 if None.

    Attributes:
        names: The variables that have to be computed: none.
        layouts: Where variables stand in vectors: there are none.
        space: uint8, shape (n, 3, h, w).

    Raises:
        UnknownOption: There is no such camera, or the sizes are none or differ.
        ModelError: The world has no shapes.
    """

    names: tuple[str, ...] = ()

    def __init__(
        self, world: World, cameras: Sequence[str | Camera] | None, size: Size | None
    ) -> None:
        given = (AUTOMATIC,) if cameras is None else cameras
        if isinstance(given, str) or not len(given):
            raise UnknownOption("list of cameras", cameras, ("one or more names or cameras",))
        self._world, self._given = world, tuple(given)
        usual = Camera("", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        scene, shape = world.structure.default_scene(), (usual.height, usual.width)
        found = [scene_camera(scene, c, shape if isinstance(c, str) else None) for c in given]
        self._cameras = _sized(found, size)
        self.layouts: Layouts = {}
        self._shape = (len(given), 3, self._cameras[0].height, self._cameras[0].width)
        self.space: gymnasium.Space[NDArray[np.uint8]] = gymnasium.spaces.Box(
            0, 255, self._shape, np.uint8
        )

    def observe(self, now: Values) -> NDArray[np.uint8]:
        """Draw."""
        scene = self._world.scene()
        pictures: Any = np.empty(self._shape, dtype=np.uint8)
        pairs = zip(self._given, self._cameras, strict=True)
        cameras = [placed(scene, given, camera) for given, camera in pairs]
        now_pixels(scene, cameras, pictures)
        found: NDArray[np.uint8] = pictures
        return found


def placed(scene: Scene, given: str | Camera, camera: Camera) -> Camera:
    """Put a camera of a model where it is now.

    Args:
        scene: Of the present.
        given: What was asked for.
        camera: The same, as it is in the default scene.
    """
    if given == AUTOMATIC:
        return following_camera(camera, scene)
    if isinstance(given, str):
        return scene_camera(scene, given, (camera.height, camera.width))
    return camera
