"""A software renderer: the same picture for every engine, without a screen and without OpenGL."""

from scm_world.backends.renderer.bodies import FLOOR, NOTHING, STAGE, body_names
from scm_world.backends.renderer.picture import RenderedImage, render, render_views, write_png
from scm_world.backends.renderer.pixels import (
    ORIGINAL,
    PLAIN,
    Convention,
    depth_and_segmentation,
    goal_pixels,
    now_pixels,
    pixels,
    resized,
)

__all__ = [
    "FLOOR",
    "NOTHING",
    "ORIGINAL",
    "PLAIN",
    "STAGE",
    "Convention",
    "RenderedImage",
    "body_names",
    "depth_and_segmentation",
    "goal_pixels",
    "now_pixels",
    "pixels",
    "render",
    "render_views",
    "resized",
    "write_png",
]
