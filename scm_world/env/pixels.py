"""Observations that are pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Values
from scm_world.backends.renderer import ORIGINAL, PLAIN, goal_pixels, now_pixels
from scm_world.env.vector import Layouts
from scm_world.errors import UnknownOption
from scm_world.scene.camera import CAMERAS, ORIGINAL_CAMERAS, OVERVIEW, Camera
from scm_world.world import World

Size = int | tuple[int, int]


def chosen(
    cameras: Sequence[str | Camera] | None, size: Size | None, *, original: bool
) -> tuple[Camera, ...]:
    """Look up cameras.

    Args:
        cameras: Names, or cameras; the three of the robot if None.
        size: Height and width of the pictures, or both in one [pixels]; those of the cameras
            if None.
        original: Whether the cameras of the robot are as the predecessor realises them.

    Raises:
        UnknownOption: There is no such camera, or the sizes are none or differ.
    """
    own = ORIGINAL_CAMERAS if original else CAMERAS
    known = {camera.name: camera for camera in (*own, OVERVIEW)}
    found = []
    for camera in own if cameras is None else cameras:
        if not isinstance(camera, Camera) and camera not in known:
            raise UnknownOption("camera", camera, known)
        found.append(camera if isinstance(camera, Camera) else known[camera])
    if size is not None:
        height, width = size if isinstance(size, tuple | list) else (size, size)
        found = [replace(camera, height=int(height), width=int(width)) for camera in found]
    sizes = {(camera.height, camera.width) for camera in found}
    if len(sizes) != 1 or min(min(sizes)) < 1:
        raise UnknownOption("image_size", size, ("one positive size for one or more cameras",))
    return tuple(found)


@final
class Pixels:
    """What cameras see, and then what they should see.

    Args:
        world: That is observed.
        cameras: With pictures of one size.
        followed: Names of those that stand where their variables say.

    Attributes:
        names: The variables that have to be computed: none.
        layouts: Where variables stand in vectors: there are none.
        space: uint8, shape (2 n, 3, h, w); under the predecessor's conventions (2 n, h, w, 3).
    """

    names: tuple[str, ...] = ()

    def __init__(
        self, world: World, cameras: tuple[Camera, ...], followed: frozenset[str] = frozenset()
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
            if camera.name in self._followed
            else camera
            for camera in self._cameras
        )


def followed(cameras: Sequence[str | Camera] | None, *, original: bool) -> frozenset[str]:
    """Name the cameras that are asked for by name: they are nodes of the graph.

    Args:
        cameras: As in ``chosen``.
        original: Whether they are as the predecessor realises them, and fixed.
    """
    if original:
        return frozenset()
    own = frozenset(camera.name for camera in CAMERAS)
    return own if cameras is None else own.intersection(c for c in cameras if isinstance(c, str))
