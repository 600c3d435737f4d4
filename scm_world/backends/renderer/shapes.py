"""Shapes onto pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.renderer.kernels import (
    NO_COLORS,
    NO_SHADOW,
    TIE,
    Canvas,
    Shadow,
    View,
    camera_view,
    draw,
    draw_mesh,
    parallel_view,
)
from scm_world.geometry.rotations import rotation_matrix
from scm_world.models.camera import Camera
from scm_world.models.scene import GoalRegion, Light
from scm_world.models.shapes import BOX, ELLIPSOID, GOAL_OPACITY, MESH, PLANE, Shapes, mesh_of

NOTHING = -1
"""Color of a pixel without a body."""

SKY = (178, 199, 222)  # red, green, blue
SHADOW_TEXELS = 64, 256  # least and most along an edge; between them as many as a picture has rows
SHADOW_BLUR = 2  # passes of a box filter three texels wide
AROUND = 2.0  # how much larger the square of a shadow is than that of what moves
LOWEST = 1e-3  # [1] the height of a light below which nothing throws a shadow on the floor
LYING = 0.7  # [1] the height of the normal of a plane above which it is a floor
MOST_KEPT = 16  # pictures of what does not move


@final
@dataclass(frozen=True)
class Parts:
    """Shapes in the order in which they are drawn; equal where those that stay look alike.

    Attributes:
        look: All numbers of the solid shapes that do not move.
        shapes: All of them; a picture may be kept, so their arrays must not change.
        still: Rows of the solid shapes that do not move, shape (k,).
        moving: Rows of those that are drawn anew in each picture, shape (m,).
        clear: Rows of those that are transparent.
        shadows: Whether there are any.
    """

    look: tuple[Any, ...]
    shapes: Shapes = field(compare=False)
    still: Integers = field(compare=False)
    moving: Integers = field(compare=False)
    clear: Integers = field(compare=False)
    shadows: bool = field(compare=False)


def parted(shapes: Shapes, *, shadows: bool) -> Parts:
    """Decide how shapes are drawn: first those that do not move, then the others, then clear ones.

    Their arrays must not change afterwards. Shadows fall on floors: on planes that lie.
    """
    table = shapes.table
    opacity, moves = table.colors[:, 3], table.moves
    if shadows:
        moves = moves | (table.kinds == PLANE) & (table.rotations[:, 2, 2] > LYING)
    solid = opacity >= 1.0
    still, moving = np.flatnonzero(solid & ~moves), np.flatnonzero(solid & moves)
    meshes = tuple((i, id(mesh)) for i, mesh in shapes.meshes.items())
    look = *(column[still].tobytes() for column in table), meshes
    return Parts(look, shapes, still, moving, np.flatnonzero(~solid & (opacity > 0.0)), shadows)


def draw_parts(
    parts: Parts, camera: Camera, light: Light, samples: int = 1, *, colors: bool = True
) -> Canvas:
    """Draw shapes in front of the sky: the solid ones, then the clear ones from far to near."""
    shapes, moving, clear = parts.shapes, parts.moving, parts.clear
    table, towards, view = shapes.table, lamp(light), camera_view(camera, samples)
    if samples == 1:
        depth, owners, rgb = _backdrop(parts, camera, light, 1, colors)
        canvas = Canvas(depth.copy(), owners.copy(), rgb.copy())
    else:
        canvas = _backdrop.__wrapped__(parts, camera, light, samples, colors)
    thrown: dict[int, Shadow] = {}
    if parts.shadows and colors:
        planes = moving[table.kinds[moving] == PLANE]
        thrown = {row: _shadow(parts, row, towards, camera.height) for row in planes.tolist()}
    _draw(shapes, moving, thrown, view, towards, canvas)
    if colors and len(clear):
        away = np.linalg.norm(table.positions[clear] - camera.eye, axis=1)
        away[table.kinds[clear] == PLANE] = np.inf  # behind all else
        for row in clear[np.argsort(-away, kind="stable")].tolist():
            _blend(shapes, row, view, towards, canvas)
    return canvas


@lru_cache(maxsize=MOST_KEPT)
def _backdrop(parts: Parts, camera: Camera, light: Light, samples: int, colors: bool) -> Canvas:
    """Draw the sky, and what does not move, without shadows. Kept: do not change the arrays."""
    size = camera.height * samples, camera.width * samples
    rgb = NO_COLORS
    if colors:
        rgb = np.empty((3, *size), dtype=np.uint8)
        rgb[:] = np.reshape(SKY, (3, 1, 1))
    depth, owners = np.full(size, camera.far, np.float32), np.full(size, NOTHING, np.int32)
    canvas = Canvas(depth, owners, rgb)
    _draw(parts.shapes, parts.still, {}, camera_view(camera, samples), lamp(light), canvas)
    return canvas


def _draw(
    shapes: Shapes,
    rows: Integers,
    shadows: Mapping[int, Shadow],
    view: View,
    towards: Floats,
    canvas: Canvas,
) -> None:
    """Draw solid shapes: those that are neither planes nor meshes, then those."""
    table, kinds = shapes.table, shapes.table.kinds[rows]
    draw(table, rows[kinds < PLANE], NO_SHADOW, view, towards, 1.0, canvas)
    for row in rows[kinds == PLANE]:
        shadow = shadows.get(int(row), NO_SHADOW)
        draw(table, np.array([row]), shadow, view, towards, 1.0, canvas)
    for row in rows[kinds == MESH].tolist():
        draw_mesh(shapes.meshes[row], table, row, view, towards, 1.0, canvas)


def _blend(shapes: Shapes, row: int, view: View, towards: Floats, canvas: Canvas) -> None:
    """Draw one transparent shape over the image."""
    table, alpha = shapes.table, float(shapes.table.colors[row, 3])
    if table.kinds[row] == MESH:
        mesh, nearest = shapes.meshes[row], canvas.depth - np.float32(TIE)
        layer = Canvas(nearest, np.empty_like(canvas.owners), NO_COLORS)
        draw_mesh(mesh, table, row, view, towards, 1.0, layer)
        draw_mesh(mesh, table, row, view, towards, alpha, canvas._replace(depth=nearest))
    else:
        draw(table, np.array([row]), NO_SHADOW, view, towards, alpha, canvas)


def goal_shapes(goals: Sequence[GoalRegion]) -> Shapes:
    """Make the silhouettes of goals."""
    hulls = {i: goal.hull for i, goal in enumerate(goals) if goal.hull is not None}
    usual = [ELLIPSOID if goal.shape == "sphere" else BOX for goal in goals]
    return Shapes.of(
        [MESH if i in hulls else kind for i, kind in enumerate(usual)],
        [np.asarray(goal.size) / 2.0 for goal in goals],
        [goal.position for goal in goals],
        [rotation_matrix(goal.orientation) for goal in goals],
        [[*goal.color, GOAL_OPACITY] for goal in goals],
    )._replace(meshes={i: mesh_of(hull.vertices, hull.faces) for i, hull in hulls.items()})


def lamp(light: Light) -> Floats:
    """Return the unit vector towards the light, and the ambient brightness, shape (4,)."""
    length = math.hypot(*light.direction)
    if not (length > 0.0 and math.isfinite(length)):
        raise ValueError(f"light: the direction must have a length, got {light.direction}")
    return np.array([*(x / length for x in light.direction), light.ambient])


def _shadow(parts: Parts, plane: int, light: Floats, rows: int) -> Shadow:
    """Compute the shadow of shapes on a plane, with soft edges.

    There is no shadow where the light comes from the side or from below. ``rows`` is the height of
    the picture.
    """
    table = parts.shapes.table
    turn, towards = table.rotations[plane], light[:3] @ table.rotations[plane]
    others = np.concatenate([parts.moving, parts.still])
    others = np.sort(others[table.kinds[others] != PLANE])
    local = table._replace(
        positions=(table.positions - table.positions[plane]) @ turn,
        rotations=turn.T @ table.rotations,
    )
    corners = parts.shapes._replace(table=local).corners(others)
    high = corners[:, :, 2].max(axis=1) > 0.0
    if towards[2] < LOWEST or not high.any():
        return NO_SHADOW
    above, corners = others[high], corners[high]
    moves = table.moves[above]
    points = (corners[moves] if moves.any() else corners).reshape(-1, 3)
    feet = points[:, :2] - np.maximum(points[:, 2:], 0.0) * towards[:2] / towards[2]
    least, most = feet.min(axis=0), feet.max(axis=0)
    middle, half = (least + most) / 2.0, max(AROUND * float((most - least).max()) / 2.0, 1e-6)
    local = local._replace(positions=local.positions - [*middle, 0.0])
    n = min(max(rows, SHADOW_TEXELS[0]), SHADOW_TEXELS[1])
    depth, owners = np.full((n, n), np.inf, dtype=np.float32), np.empty((n, n), dtype=np.int32)
    canvas = Canvas(depth, owners, NO_COLORS)
    view = parallel_view(towards / towards[2], half, n)
    _draw(parts.shapes._replace(table=local), above, {}, view, light, canvas)
    shadow = np.isfinite(canvas.depth).astype(np.uint8)
    for _ in range(2 * SHADOW_BLUR):  # along the first axis, and then along the second one
        sums = 3 * shadow
        sums[1:-1] = shadow[:-2] + shadow[1:-1] + shadow[2:]
        shadow = sums.T
    return Shadow(shadow / 9.0**SHADOW_BLUR, np.array([*middle, half]))


def corners_of_what_moves(shapes: Shapes) -> Floats:
    """Compute the corners of everything that moves, of all there is if nothing does, (n, 3) [m]."""
    seen = (shapes.table.kinds != PLANE) & (shapes.table.colors[:, 3] > 0.0)
    moving = seen & shapes.table.moves
    rows = np.flatnonzero(moving if moving.any() else seen)
    return shapes.corners(rows).reshape(-1, 3) if len(rows) else np.eye(3)
