"""A software renderer: the same picture for every engine, without a screen and without OpenGL."""

from scm_world.backends.renderer.bodies import NOTHING
from scm_world.backends.renderer.drawing import Drawing, body_names, drawing_of
from scm_world.backends.renderer.picture import (
    RENDERERS,
    RenderedImage,
    automatic_camera,
    following_camera,
    picture,
    render,
    scene_camera,
    write_png,
)
from scm_world.backends.renderer.pixels import (
    ORIGINAL,
    PLAIN,
    Convention,
    depth_and_segmentation,
    goal_pixels,
    now_pixels,
    resized,
)

__all__ = [
    "NOTHING",
    "ORIGINAL",
    "PLAIN",
    "RENDERERS",
    "Convention",
    "Drawing",
    "RenderedImage",
    "automatic_camera",
    "body_names",
    "depth_and_segmentation",
    "drawing_of",
    "following_camera",
    "goal_pixels",
    "now_pixels",
    "picture",
    "render",
    "resized",
    "scene_camera",
    "write_png",
]
