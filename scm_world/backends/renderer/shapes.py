"""Lists of shapes onto pixels."""

from __future__ import annotations

import math
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
from scm_world.backends.renderer.kernels import Canvas, View, draw
from scm_world.backends.renderer.light import (
    LOWEST,
    NO_COLORS,
    NO_OWNERS,
    NO_SHADOW,
    lamp,
    shadow_map,
)
from scm_world.backends.renderer.meshes import Ground, Triangles, draw_ground, draw_mesh
from scm_world.backends.renderer.views import camera_view
from scm_world.geometry import rotation_matrix
from scm_world.models.camera import Camera
from scm_world.models.scene import Goal, Light
from scm_world.models.shapes import Kind, Mesh, Shape, corners, mesh_of

SOLIDS = {
    "box": BOX,
    "sphere": ELLIPSOID,
    "ellipsoid": ELLIPSOID,
    "capsule": CAPSULE,
    "cylinder": CYLINDER,
}
SHADOW_TEXELS = 256
GOAL_OPACITY = 0.3  # Source: CausalWorld 1.2, silhouettes
SKY = (178, 199, 222)  # red, green, blue

THREE_QUARTER = np.array([0.5, -1.0, 0.5]) / np.sqrt(1.5)
"""From what is seen towards an automatic camera."""

AUTOMATIC = "automatic"
"""The name of a camera that is placed here."""

FIELD_OF_VIEW = 40.0  # [deg] of an automatic camera
MARGIN = 1.3  # how much more an automatic camera sees than it has to
AROUND = 2.0  # how much larger the square of a shadow is than that of what moves
STILL = 0.05  # of the distance: how far from the middle of a picture is near it


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
    for shape in sorted(clear, key=lambda shape: -_distance(shape, camera)):
        _draw_clear(shape, view, towards, canvas)
    return canvas


def goal_shapes(goals: Iterable[Goal]) -> list[Shape]:
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


def _distance(shape: Shape, camera: Camera) -> float:
    """Give how far away a shape is; planes lie behind all else."""
    return np.inf if shape.kind == "plane" else float(np.linalg.norm(shape.position - camera.eye))


def _draw_clear(shape: Shape, view: View, towards: Floats, canvas: Canvas) -> None:
    """Blend a shape with what is behind it."""
    alpha = float(shape.color[3])
    if shape.kind == "plane":
        draw_ground(_ground(shape, (), Light(), shadows=False), view, towards, alpha, canvas)
    elif shape.mesh is None:
        draw(_table([shape]), view, towards, alpha, canvas)
    else:
        mesh, nearest = _triangles(shape, shape.mesh), canvas._replace(depth=canvas.depth.copy())
        draw_mesh(mesh, view, towards, 1.0, Canvas(nearest.depth, NO_OWNERS, NO_COLORS))
        draw_mesh(mesh, view, towards, alpha, nearest)


def _table(shapes: Sequence[Shape]) -> Bodies:
    """Collect the shapes that are neither meshes nor planes."""
    round_ = [shape for shape in shapes if shape.kind in SOLIDS]
    n = len(round_)
    return Bodies(
        np.array([SOLIDS[shape.kind] for shape in round_], dtype=np.int64),
        np.array([shape.position for shape in round_]).reshape(n, 3),
        np.array([shape.rotation for shape in round_]).reshape(n, 3, 3),
        np.array([shape.halves for shape in round_]).reshape(n, 3),
        np.array([shape.color for shape in round_]).reshape(n, 4)[:, :3].copy(),
        np.array([shape.body for shape in round_], dtype=np.int64),
        np.empty((0, 4)),
        np.zeros(n + 1, dtype=np.int64),
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
    points = _corners_of_what_moves(above)
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


def framing(
    shapes: Sequence[Shape], size: tuple[int, int], direction: Floats = THREE_QUARTER
) -> Camera:
    """Place a camera so that it sees everything that moves, or all there is if nothing does.

    Planes do not count.

    Args:
        shapes: What there is; the same shape can be there at several places.
        size: Height and width of the picture [pixels].
        direction: Unit vector from what is seen towards the camera, shape (3,).
    """
    points = _corners_of_what_moves(shapes)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    height, width = size
    camera = _looking(AUTOMATIC, middle, direction, size)
    right, up, back = camera.axes() @ (points - middle).T
    slope = math.tan(math.radians(camera.field_of_view) / 2.0) / MARGIN
    distance = float((back + np.maximum(np.abs(right) * height / width, np.abs(up)) / slope).max())
    distance = max(distance, 1e-6)
    return _looking(AUTOMATIC, middle, distance * direction, size)


def following(camera: Camera, shapes: Sequence[Shape]) -> Camera:
    """Move a camera along with what moves, once that is away from the middle of the picture.

    Args:
        camera: That of the last picture; it keeps its direction.
        shapes: What there is now.
    """
    points = _corners_of_what_moves(shapes)
    eye, target = np.array(camera.eye), np.array(camera.target)
    away = (points.min(axis=0) + points.max(axis=0)) / 2.0 - target
    free, off = STILL * np.linalg.norm(eye - target), np.linalg.norm(away)
    if off <= free:
        return camera
    step = away * (1.0 - free / off)
    return replace(camera, eye=tuple((eye + step).tolist()), target=tuple((target + step).tolist()))


def _looking(name: str, at: Floats, offset: Floats, size: tuple[int, int]) -> Camera:
    """Place a camera at an offset from what it looks at."""
    distance = float(np.linalg.norm(offset))
    return Camera(
        name,
        tuple((at + offset).tolist()),
        tuple(at.tolist()),
        field_of_view=FIELD_OF_VIEW,
        height=size[0],
        width=size[1],
        near=0.01 * distance,
        far=100.0 * distance,
    )


def _corners_of_what_moves(shapes: Sequence[Shape]) -> Floats:
    """Give the corners of everything that moves, of all there is if nothing does, (n, 3) [m]."""
    seen = [shape for shape in shapes if shape.kind != "plane" and shape.color[3] > 0.0]
    seen = [shape for shape in seen if shape.moves] or seen
    return np.concatenate([corners(shape) for shape in seen]) if seen else np.eye(3)
