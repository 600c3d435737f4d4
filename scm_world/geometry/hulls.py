"""Convex shapes that are no boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

Vector = tuple[float, float, float]


@final
@dataclass(frozen=True)
class Hull:
    """A solid convex polyhedron, in the frame of its center of mass and its principal axes.

    Attributes:
        vertices: Corners [m].
        faces: Triangles, as indices of corners, counterclockwise seen from outside.
        planes: One per flat side: unit outward normal and offset; inside is
            ``normal · x <= offset`` [m].
        volume: [m³].
        moments: Principal moments of inertia divided by the mass, about the three axes [m²].
    """

    vertices: tuple[Vector, ...]
    faces: tuple[tuple[int, int, int], ...]
    planes: tuple[tuple[float, float, float, float], ...]
    volume: float
    moments: Vector
