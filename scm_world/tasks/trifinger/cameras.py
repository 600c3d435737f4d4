"""The cameras of the robot, and one for people."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scm_world.models.camera import Camera, Vector, Views, camera_from, down_and_forward
from scm_world.models.scene import Scene
from scm_world.tasks.trifinger.hardware import JOINT_LOW, TABLE_OFFSET
from scm_world.tasks.trifinger.types import of_robot

_PUBLISHED: Mapping[str, tuple[Vector, tuple[float, float, float, float]]] = {
    "60": ((0.2496, 0.2458, 0.58 - TABLE_OFFSET), (0.3760, 0.8690, -0.2918, -0.1354)),
    "120": ((0.0047, -0.2834, 0.58 - TABLE_OFFSET), (0.9655, -0.0098, -0.0065, -0.2603)),
    "300": ((-0.2470, 0.2513, 0.50 - TABLE_OFFSET), (-0.3633, 0.8686, -0.3141, 0.1220)),
}
POSES = {
    name: (np.array(eye), np.divide(turn, np.linalg.norm(turn)))
    for name, (eye, turn) in _PUBLISHED.items()
}
"""Position of each camera, z from the table top [m], and its unit quaternion (x, y, z, w)."""

CAMERAS = tuple(camera_from(name, *pose) for name, pose in POSES.items())
"""The three cameras of the real robot, upright and looking along their optical axes.

Source:
    CausalWorld 1.2, ``envs/robot/camera.py``: positions, orientations, 52°, 128 x 128.
"""

ORIGINAL_CAMERAS = tuple(
    Camera(name, eye, (x, y, z - TABLE_OFFSET), down)
    for name, (eye, turn) in _PUBLISHED.items()
    for down, (x, y, z) in (down_and_forward(turn),)
)
"""The same cameras as CausalWorld 1.2 realises them.

It takes the direction of the optical axis for a point to look at, so that its views are off by
1.6° to 2.7°, and holds the camera upside down. It then flips the rows of the picture, which
makes it upright and mirrored: ``picture[::-1]``.
"""

OVERVIEW = Camera(
    name="overview",
    eye=(0.3, -0.68, 0.72),
    target=(0.0, 0.0, 0.1),
    field_of_view=39.0,
    width=640,
    height=480,
    near=0.01,
    far=10.0,
)
"""For people: the whole arena from the front and above, between fingers 120 and 300."""


def background(scene: Scene, obstacles: bool) -> tuple[Scene, frozenset[str]]:
    """Park the robot, and leave out the blocks, and the obstacles unless they are wanted."""
    structure, state = of_robot(scene)
    state = state.copy()
    state.joint_positions[:] = JOINT_LOW
    left_out = structure.blocks if obstacles else (*structure.blocks, *structure.obstacles)
    return scene.with_(state=state), frozenset(left_out)


VIEWS = Views(OVERVIEW, CAMERAS, ORIGINAL_CAMERAS, background)
