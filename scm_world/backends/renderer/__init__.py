"""A software renderer: the same picture for every engine, without a screen and without OpenGL."""

from scm_world.backends.renderer.bodies import FLOOR, NOTHING, STAGE, body_names
from scm_world.backends.renderer.picture import RenderedImage, render, render_views, write_png

__all__ = [
    "FLOOR",
    "NOTHING",
    "STAGE",
    "RenderedImage",
    "body_names",
    "render",
    "render_views",
    "write_png",
]
