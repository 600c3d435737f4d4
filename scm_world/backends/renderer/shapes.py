"""Shapes onto pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.renderer.kernels import TIE, Canvas, View, camera_view, draw
from scm_world.backends.renderer.meshes import (
    LOWEST,
    NO_COLORS,
    NO_OWNERS,
    NO_SHADOW,
    Ground,
    draw_ground,
    draw_mesh,
    lamp,
    shadow_map,
)
from scm_world.geometry import rotation_matrix
from scm_world.models.camera import Camera
from scm_world.models.scene import GoalRegion, Light
from scm_world.models.shapes import (
    GOAL_OPACITY,
    MESH,
    PLANE,
    Kind,
    Shape,
    Shapes,
    mesh_of,
)

NOTHING = -1
"""What a pixel shows where there is no body."""

SKY = (178, 199, 222)  # red, green, blue
SHADOW_TEXELS = 64, 256  # least and most along an edge; between them as many as a picture has rows
AROUND = 2.0  # how much larger the square of a shadow is than that of what moves
LYING = 0.7  # [1] the height of the normal of a plane above which it is a floor
MOST_KEPT = 16  # pictures of what does not move


class Parts(NamedTuple):
    """Shapes, and in which order they are drawn.

    Attributes:
        shapes: What there is.
        still: What does not move.
        moving: Rows of what is drawn anew in each picture, shape (k,).
        clear: Rows of what one can look through, shape (m,).
        shadows: Whether there are any.
    """

    shapes: Shapes
    still: Still
    moving: Integers
    clear: Integers
    shadows: bool


@final
class Still:
    """Rows of shapes that do not move, which are equal to others that look alike.

    Args:
        shapes: Kept: their arrays must not change.
        rows: Which of them, shape (k,).
    """

    def __init__(self, shapes: Shapes, rows: Integers) -> None:
        self.shapes, self.rows = shapes, rows
        meshes = [(i, id(mesh)) for i, mesh in shapes.meshes.items()]
        tiles = shapes.tiles.items()
        self._look = *(column[rows].tobytes() for column in shapes.table), *meshes, *tiles

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Still) and self._look == other._look

    def __hash__(self) -> int:
        return hash(self._look)


def parted(shapes: Shapes, *, shadows: bool) -> Parts:
    """Decide how shapes are drawn: first what does not move, then all else, then what is clear.

    Args:
        shapes: What is drawn. Its arrays must not change afterwards.
        shadows: Whether there are any. They fall on floors: on planes that lie.
    """
    table = shapes.table
    opacity = table.colors[:, 3]
    solid, moves = opacity >= 1.0, shapes.moves
    if shadows:
        moves = moves | (table.kinds == PLANE) & (table.rotations[:, 2, 2] > LYING)
    still = Still(shapes, np.flatnonzero(solid & ~moves))
    moving, clear = np.flatnonzero(solid & moves), np.flatnonzero(~solid & (opacity > 0.0))
    return Parts(shapes, still, moving, clear, shadows)


def draw_parts(
    parts: Parts, camera: Camera, light: Light, samples: int = 1, *, colors: bool = True
) -> Canvas:
    """Draw shapes in front of the sky: the solid ones, then the clear ones from far to near.

    Args:
        parts: What to draw.
        camera: Where from.
        light: Of the picture.
        samples: Per pixel and axis.
        colors: Whether to color pixels.
    """
    shapes, still, moving, clear, shadows = parts
    if samples == 1:
        depth, owners, rgb = _kept(still, camera, light, colors=colors)
        canvas = Canvas(depth.copy(), owners.copy(), rgb.copy())
    else:
        canvas = _backdrop(still, camera, light, samples, colors=colors)
    view = camera_view(camera, samples)
    grounds = {}
    for row in moving[shapes.table.kinds[moving] == PLANE].tolist():
        shadow = _shadow(parts, row, light, camera.height) if shadows and colors else _NO_SHADOW
        grounds[row] = _ground(shapes, row, *shadow)
    _draw(shapes, moving, grounds, view, light, canvas)
    if colors and len(clear):
        away = np.linalg.norm(shapes.table.positions[clear] - camera.eye, axis=1)
        away[shapes.table.kinds[clear] == PLANE] = np.inf  # behind all else
        for row in clear[np.argsort(-away, kind="stable")].tolist():
            _blend(shapes, row, view, light, canvas)
    return canvas


@lru_cache(maxsize=MOST_KEPT)
def _kept(still: Still, camera: Camera, light: Light, *, colors: bool) -> Canvas:
    """Keep what ``_backdrop`` returns. The arrays are shared: copy them."""
    return _backdrop(still, camera, light, 1, colors=colors)


def _backdrop(still: Still, camera: Camera, light: Light, samples: int, *, colors: bool) -> Canvas:
    """Draw the sky, and what does not move, without shadows."""
    height, width = camera.height * samples, camera.width * samples
    depth = np.full((height, width), camera.far, dtype=np.float32)
    owners = np.full((height, width), NOTHING, dtype=np.int32)
    rgb = NO_COLORS
    if colors:
        rgb = np.empty((3, height, width), dtype=np.uint8)
        rgb[:] = np.reshape(SKY, (3, 1, 1))
    canvas, shapes, rows = Canvas(depth, owners, rgb), still.shapes, still.rows
    planes = rows[shapes.table.kinds[rows] == PLANE].tolist()
    grounds = {row: _ground(shapes, row, *_NO_SHADOW) for row in planes}
    _draw(shapes, rows, grounds, camera_view(camera, samples), light, canvas)
    return canvas


def _draw(
    shapes: Shapes,
    rows: Integers,
    grounds: Mapping[int, Ground],
    view: View,
    light: Light,
    canvas: Canvas,
) -> None:
    """Draw solid shapes: those that are neither planes nor meshes, then those."""
    table, towards = shapes.table, lamp(light)
    draw(table, rows[table.kinds[rows] < PLANE], view, towards, 1.0, canvas)
    for row, ground in grounds.items():
        draw_ground(ground, table, row, view, towards, 1.0, canvas)
    if shapes.meshes:
        for row in rows[table.kinds[rows] == MESH].tolist():
            draw_mesh(shapes.meshes[row], table, row, view, towards, 1.0, canvas)


def _blend(shapes: Shapes, row: int, view: View, light: Light, canvas: Canvas) -> None:
    """Draw one clear shape over what is there."""
    table, towards = shapes.table, lamp(light)
    alpha = float(table.colors[row, 3])
    if table.kinds[row] == PLANE:
        ground = _ground(shapes, row, *_NO_SHADOW)
        draw_ground(ground, table, row, view, towards, alpha, canvas)
    elif table.kinds[row] == MESH:
        mesh, nearest = shapes.meshes[row], canvas.depth - np.float32(TIE)
        layer = Canvas(nearest, NO_OWNERS, NO_COLORS)
        draw_mesh(mesh, table, row, view, towards, 1.0, layer)
        draw_mesh(mesh, table, row, view, towards, alpha, canvas._replace(depth=nearest))
    else:
        draw(table, np.array([row]), view, towards, alpha, canvas)


def goal_shapes(goals: Iterable[GoalRegion]) -> Shapes:
    """Make the silhouettes of goals."""
    shapes = []
    for goal in goals:
        hull = None if goal.hull is None else mesh_of(goal.hull.vertices, goal.hull.faces)
        usual: Kind = "ellipsoid" if goal.shape == "sphere" else "box"
        halves = np.asarray(goal.size, dtype=np.float64) / 2.0
        position = np.asarray(goal.position, dtype=np.float64)
        rotation = rotation_matrix(goal.orientation)
        color = np.array([*goal.color, GOAL_OPACITY])
        kind: Kind = usual if hull is None else "mesh"
        shapes.append(Shape(kind, halves, position, rotation, color, mesh=hull))
    return Shapes.of(shapes)


_NO_SHADOW = NO_SHADOW, np.zeros(3)


def _ground(shapes: Shapes, row: int, shadow: Floats, square: Floats) -> Ground:
    """Prepare what lies on a plane."""
    tiles = shapes.tiles.get(row)
    if tiles is None:
        return Ground(np.ones(2), shapes.table.colors[row, :3].copy(), shadow, square)
    return Ground(np.array(tiles.size), np.array(tiles.color), shadow, square)


def _shadow(parts: Parts, plane: int, light: Light, rows: int) -> tuple[Floats, Floats]:
    """Make the shadow map of a plane, and the middle and half the edge of its square.

    Args:
        parts: With all that can throw a shadow.
        plane: Its row.
        light: Of the picture.
        rows: Of the picture.
    """
    table = parts.shapes.table
    turn, towards = table.rotations[plane], lamp(light)[:3] @ table.rotations[plane]
    if towards[2] < LOWEST:
        return _NO_SHADOW
    others = np.concatenate([parts.moving, parts.still.rows])
    others = np.sort(others[table.kinds[others] != PLANE])
    local = table._replace(
        positions=(table.positions - table.positions[plane]) @ turn,
        rotations=turn.T @ table.rotations,
    )
    corners = parts.shapes._replace(table=local).corners(others)
    high = corners[:, :, 2].max(axis=1) > 0.0
    if not high.any():
        return _NO_SHADOW
    above, corners = others[high], corners[high]
    moves = parts.shapes.moves[above]
    points = (corners[moves] if moves.any() else corners).reshape(-1, 3)
    feet = points[:, :2] - np.maximum(points[:, 2:], 0.0) * towards[:2] / towards[2]
    least, most = feet.min(axis=0), feet.max(axis=0)
    middle, half = (least + most) / 2.0, max(AROUND * float((most - least).max()) / 2.0, 1e-6)
    local = local._replace(positions=local.positions - [*middle, 0.0])
    there = replace(light, direction=tuple(towards.tolist()))
    texels = min(max(rows, SHADOW_TEXELS[0]), SHADOW_TEXELS[1])
    shadow = shadow_map(local, parts.shapes.meshes, above, there, half=half, n=texels)
    return shadow, np.array([*middle, half])


def corners_of_what_moves(shapes: Shapes) -> Floats:
    """Compute the corners of everything that moves, of all there is if nothing does, (n, 3) [m]."""
    seen = (shapes.table.kinds != PLANE) & (shapes.table.colors[:, 3] > 0.0)
    moving = seen & shapes.moves
    rows = np.flatnonzero(moving if moving.any() else seen)
    return shapes.corners(rows).reshape(-1, 3) if len(rows) else np.eye(3)
