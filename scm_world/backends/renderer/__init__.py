"""A software renderer: pictures for people, and the pixels that a policy observes.

They are the same for every engine, without a screen and without OpenGL.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of
from scm_world._types import Floats
from scm_world.backends.renderer.kernels import Colors
from scm_world.backends.renderer.shapes import (
    corners_of_what_moves,
    draw_parts,
    goal_shapes,
    parted,
)
from scm_world.errors import ModelError, UnknownOption
from scm_world.models.camera import Camera
from scm_world.models.model import Model
from scm_world.models.scene import Scene
from scm_world.models.shapes import Shapes

if TYPE_CHECKING:
    from scm_world.backends.mujoco.drawing import VisibleModel


def _visible(scene: Scene) -> VisibleModel:
    """Put a scene into MuJoCo, which is imported only where it is needed."""
    if not isinstance(scene.structure, Model):
        kind = type(scene.structure).__name__
        raise ModelError([f"{kind} says nothing about shapes, so there are no pictures of it"])
    from scm_world.backends.mujoco.drawing import visible

    return visible(scene)


def shapes_of(scene: Scene, *, goals: bool = True) -> Shapes:
    """Collect everything that is seen, goals last, whatever backend steps the scene."""
    shapes = _visible(scene).shapes()
    return shapes.joined(goal_shapes(scene.goals)) if goals and scene.goals else shapes


def background_of(scene: Scene, *, obstacles: bool = True) -> Shapes:
    """Collect what pictures of the goals of a scene show: nothing that moves.

    In scenes whose structure has ``Views``, these list the bodies shown besides the goals.
    """
    views = scene.structure.views
    shown, hidden = (scene, None) if views is None else views.background(scene, obstacles)
    shapes, names = shapes_of(shown), scene.structure.body_names
    gone = shapes.table.moves
    if hidden is not None:
        gone = np.isin(shapes.table.bodies, [names.index(name) for name in hidden])
    shapes.table.colors[gone, 3] = 0.0
    return shapes


USUAL_SIZE = 480, 640  # [pixels] height and width of a picture for people
THREE_QUARTER = np.array([0.5, -1.0, 0.5]) / np.sqrt(1.5)
"""From the scene towards an automatic camera."""

AUTOMATIC = "automatic"
FIELD_OF_VIEW = 40.0  # [deg] of an automatic camera
MARGIN = 1.3  # how much more an automatic camera sees than it has to
STILL = 0.05  # of the distance: how far from the middle of a picture is near it


@final
@dataclass(frozen=True)
class RenderedImage:
    """A picture, and the bodies in it.

    Attributes:
        rgb: Shape (h, w, 3), 0 to 255; of shape (0, 0, 3) without colors.
        depth: Along the optical axis, shape (h, w) [m]; ``camera.far`` where there is nothing.
        segmentation: Which body a pixel shows, shape (h, w): an index into ``names``, or -1 where
            there is nothing. Goals are no bodies: they color pixels, but have neither depth nor
            number.
        names: Names of the bodies.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    segmentation: NDArray[np.int32]
    names: tuple[str, ...]

    def shows(self, name: str) -> NDArray[np.bool_]:
        """Return which pixels show a body, shape (h, w)."""
        if name not in self.names:
            raise UnknownOption("body", name, self.names)
        mask: NDArray[np.bool_] = self.segmentation == self.names.index(name)
        return mask


def render(
    scene: Scene,
    camera: Camera,
    *,
    samples: int = 1,
    goals_only: bool = False,
    colors: bool = True,
) -> RenderedImage:
    """Take a picture of a scene; ``picture`` can do with less.

    A camera inside a body sees its inside. Light comes from one direction, that of the scene;
    shadows fall on floors only.

    Args:
        scene: What to show: everything is taken from its parameters, state, goals
            and light.
        camera: Where from.
        samples: How many samples per pixel and axis the colors are averaged over; 2 or 3 make
            smooth edges. Depth and segmentation are those of the center of the pixel.
        goals_only: Show the goals, and what ``camera_pixels`` shows with them.
        colors: Whether to color pixels: depth and segmentation alone take half as long.

    Raises:
        ValueError: ``samples`` is not positive, or the camera has no optical axis.
        ModelError: The structure says nothing about shapes.

    Example:
        >>> from scm_world.tasks.trifinger.system import trifinger
        >>> from scm_world.tasks.trifinger.cameras import OVERVIEW
        >>> picture = render(trifinger(blocks=("tool_block",)).default_scene(), OVERVIEW)
        >>> picture.rgb.shape, bool(picture.shows("tool_block").any())
        ((480, 640, 3), True)
    """
    if samples < 1:
        raise ValueError(f"samples: expected a positive number, got {samples}")
    parts = parted(background_of(scene) if goals_only else shapes_of(scene), shadows=True)
    canvas = draw_parts(parts, camera, scene.light, colors=colors)
    rgb = np.ascontiguousarray(canvas.rgb.transpose(1, 2, 0))
    if colors and samples > 1:
        fine = draw_parts(parts, camera, scene.light, samples).rgb.transpose(1, 2, 0)
        blocks = fine.reshape(camera.height, samples, camera.width, samples, 3)
        rgb = np.rint(blocks.mean(axis=(1, 3), dtype=np.float64)).astype(np.uint8)
    return RenderedImage(rgb, canvas.depth, canvas.owners, scene.structure.body_names)


def picture(
    scene: Scene,
    camera: Camera | str | None = None,
    size: tuple[int, int] | None = None,
    *,
    samples: int = 1,
) -> NDArray[np.uint8]:
    """Take a picture for people, of any scene that has shapes. No screen is needed.

    Args:
        scene: What to show.
        camera: Where from: see ``scene_camera``.
        size: Height and width [pixels]; if not given, those of the camera.
        samples: How many samples per pixel and axis colors are averaged over.

    Returns:
        Red, green and blue, shape (h, w, 3).

    Raises:
        UnknownOption: There is no such camera.
        ModelError: The structure says nothing about shapes.
        ValueError: ``samples`` is not positive, or the camera has no optical axis.

    Example:
        >>> from scm_world.tasks.trifinger.system import trifinger
        >>> picture(trifinger().default_scene(), size=(60, 80)).shape
        (60, 80, 3)
    """
    return render(scene, scene_camera(scene, camera, size), samples=samples).rgb


def scene_camera(
    scene: Scene, camera: Camera | str | None = None, size: tuple[int, int] | None = None
) -> Camera:
    """Find a camera for a picture of a scene.

    Args:
        scene: The scene to draw.
        camera: Any camera, or the name of one: of the robot's tasks ``"overview"``, ``"60"``,
            ``"120"`` or ``"300"``; of a model one that its file names, where it stands now, or
            ``"automatic"``: see ``automatic_camera``. If not given, ``"overview"`` or
            ``"automatic"``.
        size: Height and width of the picture [pixels]; if not given, those of the camera that was
            given, or 480 and 640.

    Raises:
        UnknownOption: There is no such camera.
        ModelError: The structure says nothing about shapes.
    """
    height, width = size or USUAL_SIZE
    if isinstance(camera, Camera):
        return camera if size is None else replace(camera, height=height, width=width)
    views = scene.structure.views
    if views is not None:
        known = {one.name: one for one in (views.overview, *views.cameras)}
        one_of("camera", camera, (None, *known))
        return replace(known[camera or views.overview.name], height=height, width=width)
    if camera in (None, AUTOMATIC):
        return automatic_camera(shapes_of(scene, goals=False), (height, width))
    seen = _visible(scene)
    if camera not in seen.cameras:
        raise UnknownOption("camera", camera, (AUTOMATIC, *seen.cameras))
    return seen.camera(str(camera), (height, width))


def automatic_camera(shapes: Shapes, size: tuple[int, int] = USUAL_SIZE) -> Camera:
    """Place a camera so that it sees everything that moves.

    It looks from the front, from the right and from above. Planes do not count; where nothing
    moves, it sees all there is. The shapes are those of one scene or, joined, of several.
    """
    points = corners_of_what_moves(shapes)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    height, width = size
    slope = math.tan(math.radians(FIELD_OF_VIEW) / 2.0) / MARGIN
    right, up, back = _looking(middle, THREE_QUARTER, size).axes() @ (points - middle).T
    distance = float((back + np.maximum(np.abs(right) * height / width, np.abs(up)) / slope).max())
    return _looking(middle, max(distance, 1e-6) * THREE_QUARTER, size)


def _looking(at: Floats, offset: Floats, size: tuple[int, int]) -> Camera:
    """Place a camera at an offset from its target."""
    distance = float(np.linalg.norm(offset))
    return Camera(
        AUTOMATIC,
        tuple((at + offset).tolist()),
        tuple(at.tolist()),
        field_of_view=FIELD_OF_VIEW,
        height=size[0],
        width=size[1],
        near=0.01 * distance,
        far=100.0 * distance,
    )


def following_camera(camera: Camera, shapes: Shapes) -> Camera:
    """Move a camera along with what moves, for the next picture of a film.

    It keeps its direction, and stays where it is as long as the middle of what moves is near the
    middle of the picture. The shapes are those of the next one, without goals.
    """
    points = corners_of_what_moves(shapes)
    eye, target = np.array(camera.eye), np.array(camera.target)
    away = (points.min(axis=0) + points.max(axis=0)) / 2.0 - target
    free, off = STILL * np.linalg.norm(eye - target), np.linalg.norm(away)
    if off <= free:
        return camera
    step = away * (1.0 - free / off)
    return replace(camera, eye=tuple((eye + step).tolist()), target=tuple((target + step).tolist()))


def png(rgb: NDArray[np.uint8]) -> bytes:
    """Encode a picture of shape (h, w, 3) as PNG, without filters: the drawing is flat.

    Source:
        W3C, *Portable Network Graphics (PNG) Specification*, second edition, 2003.
    """
    height, width, _ = rgb.shape
    lines = np.zeros((height, 1 + 3 * width), dtype=np.uint8)
    lines[:, 1:] = rgb.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 1)), (b"IEND", b"")
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def shape_of_pixels(camera: Camera, *, published: bool) -> tuple[int, int, int]:
    """Return the shape of what ``camera_pixels`` writes for a camera."""
    h, w = camera.height, camera.width
    return (h, w, 3) if published else (3, h, w)


def camera_pixels(
    scene: Scene,
    cameras: Sequence[Camera],
    out: Colors,
    *,
    goals: bool = False,
    published: bool = False,
) -> None:
    """Draw the present view of cameras, without goals and shadows, or the view of the goals.

    Colors are those of ``render`` wherever no shadow falls. Pictures of the goals show them as
    silhouettes, and nothing that moves, so they can be kept until an intervention; in the tasks of
    the robot it is parked at the lower limits of its joints, and there are no blocks.

    Args:
        scene: What to show; the state does not matter to the goals.
        cameras: Where from; all with pictures of one size.
        out: Where to write, uint8 of shape (n, 3, h, w), or (n, h, w, 3) if published.
        goals: Whether to show the goals.
        published: Whether pixels are laid out as in CausalWorld 1.2, channels last and the lowest
            row first; its pictures of goals leave obstacles out. With the published cameras they
            are upright and mirrored.

    Source:
        CausalWorld 1.2, ``envs/causalworld.py``: its goal world.
    """
    if goals:
        shapes = background_of(scene, obstacles=not published)
    else:
        shapes = shapes_of(scene, goals=False)
    parts = parted(shapes, shadows=False)
    for picture, camera in zip(out, cameras, strict=True):
        rgb = draw_parts(parts, camera, scene.light).rgb
        picture[:] = rgb[:, ::-1].transpose(1, 2, 0) if published else rgb
