"""The pixels that a policy sees: quickly, without shadows, into arrays of the caller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.backends.renderer.arena import (
    NO_COLORS,
    NO_OWNERS,
    empty_arena,
    lamp,
    lit_arena,
    palette,
)
from scm_world.backends.renderer.bodies import Bodies, model_shapes, solid_bodies
from scm_world.backends.renderer.kernels import Canvas, Colors, draw
from scm_world.backends.renderer.picture import draw_scene
from scm_world.backends.renderer.shapes import draw_shapes, goal_shapes
from scm_world.backends.renderer.views import camera_view
from scm_world.models.scene import Scene
from scm_world.models.shapes import Shape
from scm_world.scene.camera import Camera
from scm_world.scene.scene import Structure
from scm_world.scene.state import PhysicalState
from scm_world.scene.trifinger import JOINT_LOW


@final
@dataclass(frozen=True)
class Convention:
    """How pixels are laid out, and what a goal picture shows besides goals, arena and robot.

    Attributes:
        flipped: Whether the first row is the lowest one.
        channels_last: Whether a picture has shape (h, w, 3) instead of (3, h, w).
        goal_obstacles: Whether goal pictures show the obstacles.
    """

    flipped: bool = False
    channels_last: bool = False
    goal_obstacles: bool = True

    def shape(self, camera: Camera) -> tuple[int, int, int]:
        """Give the shape of a picture of a camera."""
        h, w = camera.height, camera.width
        return (h, w, 3) if self.channels_last else (3, h, w)


PLAIN = Convention()

ORIGINAL = Convention(flipped=True, channels_last=True, goal_obstacles=False)
"""That of CausalWorld 1.2. Together with ``ORIGINAL_CAMERAS`` pictures are upright and mirrored."""


def resized(cameras: Sequence[Camera], height: int, width: int) -> tuple[Camera, ...]:
    """Give the cameras another picture size [pixels]."""
    return tuple(replace(camera, height=height, width=width) for camera in cameras)


def now_pixels(
    scene: Scene, cameras: Sequence[Camera], out: Colors, *, convention: Convention = PLAIN
) -> None:
    """Draw what cameras see now: robot, blocks and obstacles, without goals and shadows.

    Colors are those of ``render`` wherever no shadow falls.

    Args:
        scene: What to show.
        cameras: Where from; all with pictures of one size.
        out: Where to write, uint8 of shape (n, 3, h, w), or (n, h, w, 3) with channels last.
        convention: How pixels are laid out.

    Raises:
        ValueError: ``out`` has another shape or another dtype.

    Example:
        >>> from scm_world.scene import Structure, default_scene
        >>> from scm_world.scene.camera import CAMERAS
        >>> out = np.empty((3, 3, 128, 128), dtype=np.uint8)
        >>> now_pixels(default_scene(Structure(blocks=("tool_block",))), CAMERAS, out)
        >>> out[0, :, 127, 64].tolist()  # the floor
        [74, 65, 60]
    """
    scene = scene.with_(goals=())
    _draw_all(scene, _content(scene), cameras, out, convention)


def goal_pixels(
    scene: Scene, cameras: Sequence[Camera], out: Colors, *, convention: Convention = PLAIN
) -> None:
    """Draw what cameras should see: the goals as silhouettes in the arena, without blocks.

    The robot is parked at the lower limits of its joints. So the pictures depend on goals,
    colors, light, obstacles and the height of the robot only: they can be kept as long as those
    stay. Of a model they show nothing that moves.

    Args:
        scene: Whose goals to show; the state does not matter.
        cameras: See ``now_pixels``.
        out: See ``now_pixels``.
        convention: How pixels are laid out, and whether obstacles are shown.

    Raises:
        ValueError: See ``now_pixels``.

    Source:
        CausalWorld 1.2, ``envs/causalworld.py``: its goal world.
    """
    if isinstance(scene.structure, Structure):
        scene = _parked(scene, obstacles=convention.goal_obstacles)
    content = _content(scene)
    if not isinstance(content, Bodies):
        content = [shape for shape in content if not shape.moves]
    _draw_all(scene, content, cameras, out, convention)


def pixels(
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    goals: Scene | None = None,
    size: tuple[int, int] | None = None,
    convention: Convention = PLAIN,
) -> Colors:
    """Draw the pixel observation: what cameras see now, and then what they should see.

    Args:
        scene: What to show.
        cameras: Where from; all with pictures of one size.
        goals: The scene whose goals to show; if not given, ``scene``.
        size: Height and width of the pictures; if not given, those of the cameras [pixels].
        convention: How pixels are laid out.

    Returns:
        uint8 of shape (2 n, 3, h, w), or (2 n, h, w, 3) with channels last: ``now_pixels`` and
        then ``goal_pixels``.

    Raises:
        ValueError: There are no cameras, or their sizes differ.

    Example:
        >>> from scm_world.scene import Structure, default_scene
        >>> from scm_world.scene.camera import CAMERAS
        >>> pixels(default_scene(Structure()), CAMERAS, size=(64, 96)).shape
        (6, 3, 64, 96)
    """
    if size is not None:
        cameras = resized(cameras, *size)
    if not cameras:
        raise ValueError("cameras: there must be at least one")
    n = len(cameras)
    out = np.empty((2 * n, *convention.shape(cameras[0])), dtype=np.uint8)
    now_pixels(scene, cameras, out[:n], convention=convention)
    goal_pixels(scene if goals is None else goals, cameras, out[n:], convention=convention)
    return out


def depth_and_segmentation(
    scene: Scene, cameras: Sequence[Camera], *, convention: Convention = PLAIN
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Measure how far away what cameras see now is, and tell what it is.

    Args:
        scene: What to show; goals have neither depth nor number.
        cameras: Where from; all with pictures of one size.
        convention: Whether rows are flipped.

    Returns:
        Depth along the optical axis [m], ``camera.far`` where there is nothing, and numbers of
        bodies (see ``body_names``), -1 where there is nothing; both of shape (n, h, w).

    Raises:
        ValueError: There are no cameras, or their sizes differ.
    """
    if len({(camera.height, camera.width) for camera in cameras}) != 1:
        raise ValueError("cameras: there must be at least one, and all with pictures of one size")
    content, light = _content(scene.with_(goals=())), lamp(scene.light)
    shape = len(cameras), cameras[0].height, cameras[0].width
    depths, owners = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.int32)
    for i, camera in enumerate(cameras):
        if not isinstance(content, Bodies):
            drawn = draw_shapes(content, camera, scene.light, shadows=False, colors=False)
            depths[i], owners[i] = drawn.depth, drawn.owners
            continue
        empty = empty_arena(camera)
        depths[i], owners[i] = empty.depth, empty.owners
        draw(content, camera_view(camera, 1), light, 1.0, Canvas(depths[i], owners[i], NO_COLORS))
    return _rows(depths, convention), _rows(owners, convention)


def _rows(stack: NDArray[Any], convention: Convention) -> NDArray[Any]:
    """Flip the rows of pictures (n, h, w) if the convention asks for it."""
    return np.ascontiguousarray(stack[:, ::-1]) if convention.flipped else stack


def _parked(scene: Scene, *, obstacles: bool) -> Scene:
    """Take away the blocks, and the obstacles unless they are wanted, and park the robot."""
    state = PhysicalState(0)
    state.joint_positions[:] = JOINT_LOW
    structure = replace(
        scene.structure,
        blocks=(),
        hulls=(),
        obstacles=scene.structure.obstacles if obstacles else (),
    )
    return scene.with_(structure=structure, state=state)


def _content(scene: Scene) -> Bodies | list[Shape]:
    """List what a scene shows: the TriFinger's bodies, or the shapes and goals of a model."""
    if isinstance(scene.structure, Structure):
        return solid_bodies(scene)
    return model_shapes(scene)[0] + goal_shapes(scene.goals)


def _draw_all(
    scene: Scene,
    content: Bodies | list[Shape],
    cameras: Sequence[Camera],
    out: Colors,
    convention: Convention,
) -> None:
    """Draw a scene with all cameras in the layout that is asked for."""
    if out.dtype != np.uint8:
        raise ValueError(f"out: expected dtype uint8, got {out.dtype}")
    for shape in {convention.shape(camera) for camera in cameras} or {(0, 0, 0)}:
        if out.shape != (len(cameras), *shape):
            raise ValueError(f"out: expected shape {(len(cameras), *shape)}, got {out.shape}")
    direct = out.flags.c_contiguous and not (convention.flipped or convention.channels_last)
    for picture, camera in zip(out, cameras, strict=True):
        rgb = picture if direct else np.empty((3, camera.height, camera.width), dtype=np.uint8)
        _draw_one(scene, content, camera, rgb)
        if not direct:
            rows = rgb[:, ::-1] if convention.flipped else rgb
            picture[:] = rows.transpose(1, 2, 0) if convention.channels_last else rows


def _draw_one(scene: Scene, content: Bodies | list[Shape], camera: Camera, rgb: Colors) -> None:
    """Draw a scene into a picture of shape (3, h, w)."""
    if not isinstance(content, Bodies):
        rgb[:] = draw_shapes(content, camera, scene.light, shadows=False).rgb
        return
    rgb[:] = lit_arena(camera, scene.light, palette(scene))
    depth = empty_arena(camera).depth.copy()
    draw_scene(scene, content, camera, 1, Canvas(depth, NO_OWNERS, rgb))
