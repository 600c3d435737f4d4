"""Scenes in, pictures out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from typing import final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.renderer.arena import (
    lamp,
    paint_arena,
    palette,
    shadow_map,
    trace_arena,
)
from scm_world.backends.renderer.bodies import Bodies, body_names, goal_bodies, solid_bodies
from scm_world.backends.renderer.kernels import Canvas, draw
from scm_world.backends.renderer.views import camera_view
from scm_world.errors import UnknownOption
from scm_world.models.scene import Scene
from scm_world.scene.camera import Camera

GOAL_OPACITY = 0.3  # Source: CausalWorld 1.2, silhouettes


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
        names: ``"floor"``, ``"stage"``, ``"robot"`` (its hub), the links, the blocks and the
            obstacles.
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
    camera inside a body sees its inside. Light comes from one direction, that of the scene;
    shadows fall on the floor only.

    Args:
        scene: What to show: everything is taken from its parameters, state, goals
            and light.
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
    shadow = shadow_map(bodies, scene.light)
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
    view, canvas = camera_view(camera, samples), trace_arena(camera, samples)
    rgb = paint_arena(canvas, view, scene.light, palette(scene), shadow)
    canvas = canvas._replace(rgb=rgb)
    draw_scene(scene, bodies, camera, samples, canvas)
    shown = np.ascontiguousarray(rgb.transpose(1, 2, 0))
    return RenderedImage(shown, canvas.depth, canvas.owners, body_names(scene.structure))


def draw_scene(scene: Scene, bodies: Bodies, camera: Camera, samples: int, canvas: Canvas) -> None:
    """Draw the bodies, and then the goals, over the arena."""
    view, light = camera_view(camera, samples), lamp(scene.light)
    draw(bodies, view, light, 1.0, canvas)
    if scene.goals:
        draw(goal_bodies(scene.goals, camera.eye), view, light, GOAL_OPACITY, canvas)


def _average(fine: NDArray[np.uint8], samples: int) -> NDArray[np.uint8]:
    """Average the samples of every pixel."""
    height, width = fine.shape[0] // samples, fine.shape[1] // samples
    blocks = fine.reshape(height, samples, width, samples, 3).astype(np.float64)
    average: NDArray[np.uint8] = np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
    return average
