"""A software renderer: the same picture for every engine, without a screen and without OpenGL."""

from scm_world.backends.renderer.picture import (
    ORIGINAL,
    PLAIN,
    Convention,
    RenderedImage,
    automatic_camera,
    body_names,
    camera_pixels,
    following_camera,
    picture,
    png,
    render,
    scene_camera,
    shapes_of,
    views_of,
)
from scm_world.backends.renderer.shapes import NOTHING

__all__ = [
    "NOTHING",
    "ORIGINAL",
    "PLAIN",
    "Convention",
    "RenderedImage",
    "automatic_camera",
    "body_names",
    "camera_pixels",
    "following_camera",
    "picture",
    "png",
    "render",
    "scene_camera",
    "shapes_of",
    "views_of",
]
