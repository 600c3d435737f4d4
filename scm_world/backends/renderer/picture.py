"""Scenes in, pictures out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from typing import final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.renderer.bodies import (
    NOTHING,
    Bodies,
    body_names,
    goal_bodies,
    solid_bodies,
)
from scm_world.backends.renderer.kernels import View, draw, draw_arena
from scm_world.errors import UnknownOption
from scm_world.scene.camera import Camera
from scm_world.scene.scene import WALL_RADIUS, Scene

GOAL_OPACITY = 0.3  # Source: CausalWorld 1.2, silhouettes
BACKGROUND = (0.86, 0.89, 0.93)
LIGHT = np.array([0.25, -0.5, 0.83]) / np.linalg.norm([0.25, -0.5, 0.83])  # towards the light
SHADOW_TEXELS = 96
SHADOW_BLUR = 2  # passes of a box filter three texels wide


@final
@dataclass(frozen=True)
class RenderedImage:
    """A picture, and what is in it.

    Attributes:
        rgb: Shape (h, w, 3), 0 to 255.
        depth: Along the optical axis, shape (h, w) [m]; ``camera.far`` where there is nothing.
        segmentation: Which body a pixel shows, shape (h, w): an index into ``names``, or -1 where
            there is nothing. Goals are no bodies: they color pixels, but have neither depth nor
            number.
        names: ``"floor"``, ``"stage"``, ``"robot"`` (its hub), the links and the blocks.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    segmentation: NDArray[np.int32]
    names: tuple[str, ...]

    def shows(self, name: str) -> NDArray[np.bool_]:
        """Tell which pixels show a body, shape (h, w).

        Raises:
            UnknownOption: There is no body of this name.
        """
        if name not in self.names:
            raise UnknownOption("body", name, self.names)
        mask: NDArray[np.bool_] = self.segmentation == self.names.index(name)
        return mask


def render(scene: Scene, camera: Camera, *, samples: int = 1) -> RenderedImage:
    """Take a picture of a scene.

    The wall of the ring is seen from within only, so that a camera outside looks through it. A
    camera inside a body sees its inside. Light comes from one direction; shadows fall on the
    floor only.

    Args:
        scene: What to show: everything is taken from its parameters, state and goals.
        camera: Where from.
        samples: How many samples per pixel and axis the colors are averaged over; 2 or 3 make
            smooth edges. Depth and segmentation are those of the center of the pixel.

    Raises:
        ValueError: ``samples`` is not positive, or the camera has no optical axis.

    Example:
        >>> from scm_world.scene import Structure, default_scene
        >>> from scm_world.scene.camera import OVERVIEW
        >>> picture = render(default_scene(Structure(blocks=("tool_block",))), OVERVIEW)
        >>> picture.rgb.shape, bool(picture.shows("tool_block").any())
        ((480, 640, 3), True)
    """
    return render_views(scene, (camera,), samples=samples)[0]


def render_views(
    scene: Scene, cameras: Iterable[Camera], *, samples: int = 1
) -> tuple[RenderedImage, ...]:
    """Take pictures of a scene with several cameras; see ``render``."""
    if samples < 1:
        raise ValueError(f"samples: expected a positive number, got {samples}")
    bodies = solid_bodies(scene)
    shadow = _shadow(bodies)
    pictures = []
    for camera in cameras:
        picture = _render(scene, bodies, shadow, camera, 1)
        if samples > 1:
            fine = _render(scene, bodies, shadow, camera, samples).rgb
            rgb = _average(fine, samples)
            picture = RenderedImage(rgb, picture.depth, picture.segmentation, picture.names)
        pictures.append(picture)
    return tuple(pictures)


def write_png(path: str | PathLike[str], rgb: NDArray[np.uint8]) -> None:
    """Write a picture to a file; the only thing here that needs matplotlib."""
    from matplotlib.image import imsave

    imsave(path, rgb, format="png")


def _render(
    scene: Scene, bodies: Bodies, shadow: Floats, camera: Camera, samples: int
) -> RenderedImage:
    shape = camera.height * samples, camera.width * samples
    depth = np.full(shape, camera.far, dtype=np.float32)
    owners = np.full(shape, NOTHING, dtype=np.int32)
    rgb = np.empty((*shape, 3), dtype=np.uint8)
    view = _camera_view(camera, samples)
    surfaces = [scene.parameters[name, "color"] for name in ("floor", "stage")]
    colors = np.array([*surfaces, BACKGROUND])
    draw(bodies, view, 1.0, depth, owners, rgb)
    draw_arena(view, colors, shadow, depth, owners, rgb)
    if scene.goals:
        goals = goal_bodies(scene.goals, camera.eye)
        draw(goals, view, GOAL_OPACITY, depth, owners, rgb)
    return RenderedImage(rgb, depth, owners, body_names(scene.structure))


@lru_cache(maxsize=64)
def _camera_view(camera: Camera, samples: int) -> View:
    """Give every sample of a pinhole camera its ray."""
    width, height = camera.width * samples, camera.height * samples
    step = 2.0 * math.tan(math.radians(camera.field_of_view) / 2.0) / height  # per pixel
    right, up, back = camera.axes()
    middle_u, middle_v = (width - 1) / 2.0, (height - 1) / 2.0
    corner = -back - right * (step * middle_u) + up * (step * middle_v)
    eye, zero = np.array(camera.eye, dtype=np.float64), np.zeros(3)
    rays = np.stack([eye, zero, zero, corner, right * step, -up * step])
    linear = np.stack([right / step - middle_u * back, -up / step - middle_v * back, -back])
    return View(rays, np.column_stack([linear, -linear @ eye]), LIGHT, float(camera.near))


def _shadow(bodies: Bodies) -> Floats:
    """Look from the floor towards the light, and soften what stands in the way."""
    n = SHADOW_TEXELS
    step = 2.0 * WALL_RADIUS / (n - 1)
    zero = np.zeros(3)
    corner = np.array([-WALL_RADIUS, -WALL_RADIUS, 0.0])
    axes = np.array([[step, 0.0, 0.0], [0.0, step, 0.0]])
    slope = LIGHT / LIGHT[2]
    projection = np.array(
        [
            [1.0 / step, 0.0, -slope[0] / step, WALL_RADIUS / step],
            [0.0, 1.0 / step, -slope[1] / step, WALL_RADIUS / step],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    view = View(np.stack([corner, *axes, slope, zero, zero]), projection, LIGHT, 0.0)
    depth, owners = np.full((n, n), np.inf, dtype=np.float32), np.full((n, n), NOTHING, np.int32)
    draw(bodies, view, 1.0, depth, owners, np.zeros((n, n, 3), dtype=np.uint8))
    shadow = np.where(owners == NOTHING, 0.0, 1.0)
    for _ in range(SHADOW_BLUR):
        shadow[1:-1] = (shadow[:-2] + shadow[1:-1] + shadow[2:]) / 3.0
        shadow[:, 1:-1] = (shadow[:, :-2] + shadow[:, 1:-1] + shadow[:, 2:]) / 3.0
    return shadow


def _average(fine: NDArray[np.uint8], samples: int) -> NDArray[np.uint8]:
    """Average the samples of every pixel."""
    height, width = fine.shape[0] // samples, fine.shape[1] // samples
    blocks = fine.reshape(height, samples, width, samples, 3).astype(np.float64)
    average: NDArray[np.uint8] = np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
    return average
