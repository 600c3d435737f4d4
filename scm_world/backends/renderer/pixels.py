"""The pixels that a policy sees: quickly, without shadows, into arrays of the caller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.backends.renderer.drawing import drawing_of
from scm_world.backends.renderer.kernels import Colors
from scm_world.models.camera import Camera
from scm_world.models.model import Model
from scm_world.models.scene import Scene


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
        >>> from scm_world.tasks.trifinger.structure import Structure, default_scene
        >>> from scm_world.tasks.trifinger.cameras import CAMERAS
        >>> out = np.empty((3, 3, 128, 128), dtype=np.uint8)
        >>> now_pixels(default_scene(Structure(blocks=("tool_block",))), CAMERAS, out)
        >>> out[0, :, 127, 64].tolist()  # the floor
        [74, 65, 60]
    """
    scene = scene.with_(goals=())
    content = drawing_of(scene.structure).content(scene, shadows=False)
    _draw_all(scene, content, cameras, out, convention)


def goal_pixels(
    scene: Scene, cameras: Sequence[Camera], out: Colors, *, convention: Convention = PLAIN
) -> None:
    """Draw what cameras should see: the goals as silhouettes in the arena, without blocks.

    They show nothing that moves, so they can be kept until an intervention; in the tasks of the
    robot it is parked at the lower limits of its joints.

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
    drawing = drawing_of(scene.structure)
    scene = drawing.background(scene, obstacles=convention.goal_obstacles)
    content = drawing.content(scene, shadows=False)
    if isinstance(scene.structure, Model):
        content = [shape for shape in content[0] if not shape.moves], False
    _draw_all(scene, content, cameras, out, convention)


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
    scene, drawing = scene.with_(goals=()), drawing_of(scene.structure)
    content = drawing.content(scene, shadows=False)
    drawn = [drawing.draw(scene, content, camera, colors=False) for camera in cameras]
    depths, owners = (
        np.stack([getattr(one, name) for one in drawn]) for name in ("depth", "owners")
    )
    return _rows(depths, convention), _rows(owners, convention)


def _rows(stack: NDArray[Any], convention: Convention) -> NDArray[Any]:
    """Flip the rows of pictures (n, h, w) if the convention asks for it."""
    return np.ascontiguousarray(stack[:, ::-1]) if convention.flipped else stack


def _draw_all(
    scene: Scene,
    content: Any,
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
    drawing = drawing_of(scene.structure)
    for picture, camera in zip(out, cameras, strict=True):
        rgb = drawing.draw(scene, content, camera).rgb
        rows = rgb[:, ::-1] if convention.flipped else rgb
        picture[:] = rows.transpose(1, 2, 0) if convention.channels_last else rows
