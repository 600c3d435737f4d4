"""Rotations, coordinates, and the volumes that solids share: numbers only."""

from scm_world.geometry.coordinates import from_cylindrical, to_cylindrical
from scm_world.geometry.filling import aabb_overlap_fraction, overlap_fraction
from scm_world.geometry.hulls import Hull, hull_of, hull_overlap, load_hull
from scm_world.geometry.rotations import (
    angle_between,
    canonical,
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
    to_rotation_vector,
)

__all__ = [
    "Hull",
    "aabb_overlap_fraction",
    "angle_between",
    "canonical",
    "from_cylindrical",
    "from_rotation_vector",
    "hull_of",
    "hull_overlap",
    "load_hull",
    "overlap_fraction",
    "quaternion_product",
    "rotation_matrix",
    "to_cylindrical",
    "to_rotation_vector",
]
