"""Lists of shapes onto pixels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from scm_world._types import Floats
from scm_world.backends.renderer.bodies import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    NOTHING,
    Bodies,
)
from scm_world.backends.renderer.kernels import Canvas, camera_view, draw
from scm_world.backends.renderer.meshes import (
    LOWEST,
    NO_COLORS,
    NO_OWNERS,
    NO_SHADOW,
    Ground,
    Triangles,
    draw_ground,
    draw_mesh,
    lamp,
    shadow_map,
)
from scm_world.geometry import rotation_matrix
from scm_world.geometry.arrays import compact, rows
from scm_world.models.camera import Camera
from scm_world.models.scene import GoalRegion, Light
from scm_world.models.shapes import GOAL_OPACITY, Kind, Mesh, Shape, corners, mesh_of

SOLIDS = {
    "box": BOX,
    "sphere": ELLIPSOID,
    "ellipsoid": ELLIPSOID,
    "capsule": CAPSULE,
    "cylinder": CYLINDER,
}
SHADOW_TEXELS = 256
SKY = (178, 199, 222)  # red, green, blue

AROUND = 2.0  # how much larger the square of a shadow is than that of what moves


def draw_shapes(
    shapes: Sequence[Shape],
    camera: Camera,
    light: Light,
    *,
    samples: int = 1,
    shadows: bool = True,
    colors: bool = True,
) -> Canvas:
    """Draw shapes in front of the sky: the solid ones, then the clear ones from far to near.

    Args:
        shapes: What to draw.
        camera: Where from.
        light: Of the picture. Shadows fall on planes only.
        samples: Per pixel and axis.
        shadows: Whether there are any.
        colors: Whether to color pixels.
    """
    view, towards = camera_view(camera, samples), lamp(light)
    height, width = camera.height * samples, camera.width * samples
    depth = np.full((height, width), camera.far, dtype=np.float32)
    owners = np.full((height, width), NOTHING, dtype=np.int32)
    rgb = NO_COLORS
    if colors:
        rgb = np.empty((3, height, width), dtype=np.uint8)
        rgb[:] = np.reshape(SKY, (3, 1, 1))
    canvas = Canvas(depth, owners, rgb)
    solid = [shape for shape in shapes if shape.color[3] >= 1.0]
    clear = [shape for shape in shapes if 0.0 < shape.color[3] < 1.0] if colors else []
    draw(_table(solid), view, towards, 1.0, canvas)
    for shape in solid:
        if shape.mesh is not None:
            draw_mesh(_triangles(shape, shape.mesh), view, towards, 1.0, canvas)
        elif shape.kind == "plane":
            draw_ground(_ground(shape, solid, light, shadows), view, towards, 1.0, canvas)
    away = {id(s): float(np.linalg.norm(s.position - camera.eye)) for s in clear}
    away |= {id(s): np.inf for s in clear if s.kind == "plane"}  # behind all else
    for shape in sorted(clear, key=lambda shape: -away[id(shape)]):
        alpha = float(shape.color[3])
        if shape.kind == "plane":
            ground = _ground(shape, (), Light(), shadows=False)
            draw_ground(ground, view, towards, alpha, canvas)
        elif shape.mesh is None:
            draw(_table([shape]), view, towards, alpha, canvas)
        else:
            mesh, nearest = _triangles(shape, shape.mesh), canvas.depth.copy()
            draw_mesh(mesh, view, towards, 1.0, Canvas(nearest, NO_OWNERS, NO_COLORS))
            draw_mesh(mesh, view, towards, alpha, canvas._replace(depth=nearest))
    return canvas


def goal_shapes(goals: Iterable[GoalRegion]) -> list[Shape]:
    """Give the silhouettes of goals."""
    shapes = []
    for goal in goals:
        hull = None if goal.hull is None else mesh_of(goal.hull.vertices, goal.hull.faces)
        kind: Kind = "mesh" if hull is not None else "sphere" if goal.shape == "sphere" else "box"
        halves = np.asarray(goal.size, dtype=np.float64) / 2.0
        position = np.asarray(goal.position, dtype=np.float64)
        rotation = rotation_matrix(goal.orientation)
        color = np.array([*goal.color, GOAL_OPACITY])
        shapes.append(Shape(kind, halves, position, rotation, color, mesh=hull))
    return shapes


def _table(shapes: Sequence[Shape]) -> Bodies:
    """Collect the shapes that are neither meshes nor planes."""
    round_ = [shape for shape in shapes if shape.kind in SOLIDS]
    return Bodies(
        np.array([SOLIDS[shape.kind] for shape in round_], dtype=np.int64),
        rows([shape.position for shape in round_], 3),
        compact([shape.rotation for shape in round_]).reshape(-1, 3, 3),
        rows([shape.halves for shape in round_], 3),
        rows([shape.color[:3] for shape in round_], 3),
        np.array([shape.body for shape in round_], dtype=np.int64),
        np.empty((0, 4)),
        np.zeros(len(round_) + 1, dtype=np.int64),
    )


def _triangles(shape: Shape, mesh: Mesh) -> Triangles:
    """Put a mesh into the world."""
    place = shape.position, shape.rotation, shape.color[:3], shape.body
    return Triangles(mesh.vertices, mesh.faces, mesh.normals, *place)


def _ground(plane: Shape, others: Sequence[Shape], light: Light, shadows: bool) -> Ground:
    """Prepare a plane, with the shadow of what is solid."""
    tiles = plane.tiles
    halves = np.where(plane.halves[:2] > 0.0, plane.halves[:2], np.inf)
    shadow, square = _shadow(plane, others, light) if shadows else (NO_SHADOW, np.zeros(3))
    return Ground(
        plane.position,
        plane.rotation,
        halves,
        np.ones(2) if tiles is None else np.array(tiles.size),
        np.array([plane.color[:3], plane.color[:3] if tiles is None else tiles.color]),
        shadow,
        square,
        plane.body,
    )


def _shadow(plane: Shape, others: Sequence[Shape], light: Light) -> tuple[Floats, Floats]:
    """Give the shadow map of a plane, and the middle and half the edge of its square."""
    turn = plane.rotation
    towards = lamp(light)[:3] @ turn
    above = [
        shape._replace(
            position=(shape.position - plane.position) @ turn, rotation=turn.T @ shape.rotation
        )
        for shape in others
        if shape.kind != "plane"
    ]
    above = [shape for shape in above if corners(shape)[:, 2].max() > 0.0]
    if not above or towards[2] < LOWEST:
        return NO_SHADOW, np.zeros(3)
    points = corners_of_what_moves(above)
    feet = points[:, :2] - np.maximum(points[:, 2:], 0.0) * towards[:2] / towards[2]
    low, high = feet.min(axis=0), feet.max(axis=0)
    middle, half = (low + high) / 2.0, max(AROUND * float((high - low).max()) / 2.0, 1e-6)
    offset = np.array([*middle, 0.0])
    moved = [shape._replace(position=shape.position - offset) for shape in above]
    map_ = shadow_map(
        _table(moved),
        replace(light, direction=tuple(towards.tolist())),
        [_triangles(shape, shape.mesh) for shape in moved if shape.mesh is not None],
        half=half,
        n=SHADOW_TEXELS,
    )
    return map_, np.array([*middle, half])


def corners_of_what_moves(shapes: Sequence[Shape]) -> Floats:
    """Give the corners of everything that moves, of all there is if nothing does, (n, 3) [m]."""
    seen = [shape for shape in shapes if shape.kind != "plane" and shape.color[3] > 0.0]
    seen = [shape for shape in seen if shape.moves] or seen
    return np.concatenate([corners(shape) for shape in seen]) if seen else np.eye(3)
