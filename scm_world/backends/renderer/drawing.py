"""How scenes are drawn: those of models by their shapes, others as their structure says."""

from __future__ import annotations

from typing import Any

from scm_world.backends.renderer.bodies import model_shapes
from scm_world.backends.renderer.kernels import Canvas
from scm_world.backends.renderer.shapes import draw_shapes, goal_shapes
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene


class Drawing:
    """How scenes of a ``Model`` are drawn; other structures bring a class derived from it.

    Attributes:
        overview: The camera of pictures for people; None for one that follows what moves.
        cameras: Those of policies, by default.
        original_cameras: The same as the published code realises them.
    """

    overview: Camera | None = None
    cameras: tuple[Camera, ...] = ()
    original_cameras: tuple[Camera, ...] = ()

    def names(self, structure: Any) -> tuple[str, ...]:
        """Name what the numbers of a segmentation stand for."""
        return model_shapes(structure.default_scene())[1]

    def content(self, scene: Scene, *, shadows: bool) -> Any:
        """Gather what pictures of a scene have in common, whatever the camera."""
        return model_shapes(scene)[0] + goal_shapes(scene.goals), shadows

    def background(self, scene: Scene, *, obstacles: bool) -> Scene:
        """Return a scene without what moves, for pictures of goals."""
        return scene  # what moves is left out of its content

    def draw(
        self, scene: Scene, content: Any, camera: Camera, *, samples: int = 1, colors: bool = True
    ) -> Canvas:
        """Draw a scene.

        Args:
            scene: What to show.
            content: Of this scene.
            camera: Where from.
            samples: Per pixel and axis.
            colors: Whether to color pixels.

        Returns:
            New arrays: depth, owners and, with colors, red, green and blue.
        """
        shapes, shadows = content
        light = scene.light
        return draw_shapes(shapes, camera, light, samples=samples, shadows=shadows, colors=colors)


_MODELS = Drawing()


def drawing_of(structure: Any) -> Drawing:
    """Return how scenes of a structure are drawn."""
    found: Drawing = structure.realization("renderer") or _MODELS
    return found


def body_names(structure: Any) -> tuple[str, ...]:
    """Name what the numbers of a segmentation stand for."""
    return drawing_of(structure).names(structure)
