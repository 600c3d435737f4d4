"""How scenes are drawn: those of models by their shapes, others as their structure says."""

from __future__ import annotations

from typing import Any, Protocol

from scm_world.backends.renderer.bodies import model_shapes
from scm_world.backends.renderer.kernels import Canvas
from scm_world.backends.renderer.shapes import draw_shapes, goal_shapes
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene
from scm_world.models.shapes import Shape


class Drawing(Protocol):
    """How scenes of one kind of structure are drawn.

    Attributes:
        overview: The camera of pictures for people; None for one that follows what moves.
        cameras: Those of policies, by default.
        original_cameras: The same as the published code realises them.
    """

    overview: Camera | None
    cameras: tuple[Camera, ...]
    original_cameras: tuple[Camera, ...]

    def names(self, structure: Any) -> tuple[str, ...]:
        """Name what the numbers of a segmentation stand for."""

    def content(self, scene: Scene, *, shadows: bool) -> Any:
        """Gather what pictures of a scene have in common, whatever the camera."""

    def background(self, scene: Scene, *, obstacles: bool) -> Scene:
        """Return a scene without what moves, for pictures of goals."""

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


class ModelDrawing:
    """How scenes of a ``Model`` are drawn."""

    overview: Camera | None = None
    cameras: tuple[Camera, ...] = ()
    original_cameras: tuple[Camera, ...] = ()

    def names(self, structure: Any) -> tuple[str, ...]:
        """Name the bodies."""
        return model_shapes(structure.default_scene())[1]

    def content(self, scene: Scene, *, shadows: bool) -> tuple[list[Shape], bool]:
        """Gather the shapes of bodies and goals."""
        return model_shapes(scene)[0] + goal_shapes(scene.goals), shadows

    def background(self, scene: Scene, *, obstacles: bool) -> Scene:
        """Return the scene: what moves in it is left out of its content."""
        return scene

    def draw(
        self,
        scene: Scene,
        content: tuple[list[Shape], bool],
        camera: Camera,
        *,
        samples: int = 1,
        colors: bool = True,
    ) -> Canvas:
        """Draw shapes."""
        shapes, shadows = content
        return draw_shapes(
            shapes, camera, scene.light, samples=samples, shadows=shadows, colors=colors
        )


_MODELS = ModelDrawing()


def drawing_of(structure: Any) -> Drawing:
    """Return how scenes of a structure are drawn."""
    found: Drawing = structure.realization("renderer") or _MODELS
    return found


def body_names(structure: Any) -> tuple[str, ...]:
    """Name what the numbers of a segmentation stand for."""
    return drawing_of(structure).names(structure)
