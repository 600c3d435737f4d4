"""How the robot, its arena, blocks, obstacles and goals are drawn."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from scm_world._types import Floats
from scm_world.backends.renderer.bodies import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    HULL,
    NOTHING,
    Bodies,
    empty_bodies,
    goal_bodies,
    turn_kernel,
)
from scm_world.backends.renderer.kernels import (
    SHADOW,
    Canvas,
    Colors,
    Depths,
    Owners,
    View,
    brightness,
    byte,
    camera_view,
    draw,
    shade_at,
)
from scm_world.backends.renderer.meshes import (
    NO_COLORS,
    NO_SHADOW,
    Triangles,
    draw_mesh,
    lamp,
    shadow_map,
)
from scm_world.backends.renderer.picture import Drawing
from scm_world.backends.renderer.shapes import goal_shapes
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import rotation_kernel, rotation_matrix
from scm_world.models.camera import Camera
from scm_world.models.scene import Light, Scene
from scm_world.models.shapes import GOAL_OPACITY, Kind, Mesh, Shape, mesh_of
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.cameras import CAMERAS, ORIGINAL_CAMERAS, OVERVIEW
from scm_world.tasks.trifinger.kinematics import FRAMES_PER_FINGER, link_frames
from scm_world.tasks.trifinger.state import PhysicalState
from scm_world.tasks.trifinger.structure import WALL_HEIGHT, WALL_RADIUS, TriFingerStructure

FLOOR, STAGE, ROBOT = range(3)
"""What a pixel shows, where it is none of the links, blocks or obstacles; see ``names``."""

HUB_COLOR = (0.35, 0.35, 0.38)
HUB_HALVES = (0.034, 0.034, 0.012)  # [m] of the ellipsoid that carries the fingers
MOUNT = hardware.Capsule((0.012, 0.0, 0.0), (-0.004, 0.0, 0.0), 0.0235)
"""What is drawn for link 0, whose published mesh is a frame that hides the arena from above."""

BACKGROUND = (0.86, 0.89, 0.93)
SHADOW_TEXELS = 96
FLOOR_HALF, RING_PARTS = 1e-3, 48  # [m] half the height of the floor's disk; parts of the wall
_KINDS: dict[int, Kind] = {
    BOX: "box", ELLIPSOID: "ellipsoid", CAPSULE: "capsule", CYLINDER: "cylinder", HULL: "mesh"
}  # fmt: skip

Palette = tuple[tuple[float, ...], ...]
"""The colors of the floor, of the wall and of the background."""


class Content(NamedTuple):
    """What pictures of one scene have in common.

    Attributes:
        bodies: The hub, the links, the blocks and the obstacles.
        shadow: How dark the floor is; None where shadows are not drawn.
        links: The links as published, in pictures for people; else they are among the bodies, as
            the capsules of physics.
    """

    bodies: Bodies
    shadow: Floats | None
    links: tuple[Triangles, ...] = ()


class TriFingerDrawing(Drawing):
    """How scenes of the robot are drawn."""

    overview = OVERVIEW
    cameras = CAMERAS
    original_cameras = ORIGINAL_CAMERAS

    def names(self, structure: TriFingerStructure) -> tuple[str, ...]:
        """Name what the numbers of a segmentation stand for.

        Example:
            >>> DRAWING.names(TriFingerStructure(blocks=("tool_block",)))[:4]
            ('floor', 'stage', 'robot', 'robot_finger_60_link_0')
            >>> DRAWING.names(TriFingerStructure(blocks=("tool_block",), obstacles=("wall",)))[-2:]
            ('tool_block', 'wall')
        """
        links = hardware.LINK_NAMES
        return ("floor", "stage", "robot", *links, *structure.blocks, *structure.obstacles)

    def content(self, scene: Scene, *, shadows: bool, published: bool = False) -> Content:
        """Gather the bodies of a scene, and their shadow on the floor."""
        bodies = solid_bodies(scene)
        shadow = None
        if shadows:
            shadow = shadow_map(bodies, scene.light, half=WALL_RADIUS, n=SHADOW_TEXELS)
        if not published:
            return Content(bodies, shadow)
        return Content(_without_links(bodies), shadow, _links(scene, bodies))

    def shapes(self, scene: Scene) -> list[Shape]:
        """List the floor, the wall, the hub, the links, blocks, obstacles and goals."""
        whole, hulls = solid_bodies(scene), dict(scene.structure.hulls)
        bodies = _without_links(whole)
        names = (*scene.structure.blocks, *scene.structure.obstacles)
        floor, wall = (np.array([*color, 1.0]) for color in palette(scene)[:2])
        flat = np.array([WALL_RADIUS, WALL_RADIUS, FLOOR_HALF])
        below, turn = np.array([0.0, 0.0, -FLOOR_HALF]), np.eye(3)
        found = [
            Shape("cylinder", flat, below, turn, floor, FLOOR),
            Shape("mesh", np.zeros(3), np.zeros(3), turn, wall, STAGE, mesh=_ring()),
        ]
        first = len(bodies.shapes) - len(names)
        for i, kind in enumerate(bodies.shapes.tolist()):
            hull = hulls.get(names[i - first]) if kind == HULL else None
            found.append(
                Shape(
                    _KINDS[kind],
                    bodies.halves[i],
                    bodies.centers[i],
                    bodies.rotations[i],
                    np.array([*bodies.colors[i], 1.0]),
                    int(bodies.owners[i]),
                    bool(bodies.owners[i] < FIRST_BLOCK + len(scene.structure.blocks)),
                    None if hull is None else _hull_mesh(hull),
                )
            )
        for link, mesh in zip(_links(scene, whole), N_FINGERS * link_meshes(), strict=True):
            place = np.zeros(3), link.position, link.rotation
            color = np.array([*link.color, 1.0])
            found.append(Shape("mesh", *place, color, link.owner, True, mesh))
        return found + goal_shapes(scene.goals)

    def background(self, scene: Scene, *, obstacles: bool) -> Scene:
        """Take away the blocks, and the obstacles unless they are wanted, and park the robot."""
        state = PhysicalState(0)
        state.joint_positions[:] = hardware.JOINT_LOW
        structure = replace(
            scene.structure,
            blocks=(),
            hulls=(),
            obstacles=scene.structure.obstacles if obstacles else (),
        )
        return scene.with_(structure=structure, state=state)

    def draw(
        self,
        scene: Scene,
        content: Content,
        camera: Camera,
        *,
        samples: int = 1,
        colors: bool = True,
    ) -> Canvas:
        """Draw the bodies over the arena, and then the goals over the bodies."""
        bodies, shadow, links = content
        view, light = camera_view(camera, samples), lamp(scene.light)
        empty = trace_arena(camera, samples) if samples > 1 else empty_arena(camera)
        canvas = Canvas(empty.depth.copy(), empty.owners.copy(), NO_COLORS)
        if colors and shadow is None and samples == 1:
            canvas = canvas._replace(rgb=lit_arena(camera, scene.light, palette(scene)).copy())
        elif colors:
            dark = NO_SHADOW if shadow is None else shadow
            colored = paint_arena(empty, view, scene.light, palette(scene), dark)
            canvas = canvas._replace(rgb=colored)
        draw(bodies, view, light, 1.0, canvas)
        for link in links:
            draw_mesh(link, view, light, 1.0, canvas)
        if scene.goals:
            draw(goal_bodies(scene.goals, camera.eye), view, light, GOAL_OPACITY, canvas)
        return canvas


DRAWING = TriFingerDrawing()


@lru_cache(maxsize=1)
def link_meshes() -> tuple[Mesh, ...]:
    """Read the upper, the middle and the lower link as published, each in its frame.

    Source:
        robot_properties_fingers 2.0.2, ``meshes/edu`` and ``urdf/edu``, BSD-3-Clause: its text is
        beside the files.
    """
    found, folder = [], Path(__file__).parent / "meshes"
    rows = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    for name, offset in (("upper", 0.0195), ("middle", 0.0), ("lower", 0.0)):
        triangles = np.frombuffer((folder / f"{name}_link.stl").read_bytes()[84:], rows)
        points, faces = np.unique(triangles["corners"].reshape(-1, 3), axis=0, return_inverse=True)
        found.append(mesh_of(points + np.array([offset, 0.0, 0.0]), faces.reshape(-1, 3)))
    return tuple(found)


def _links(scene: Scene, bodies: Bodies) -> tuple[Triangles, ...]:
    """Put the published links where they are, in the colors of the capsules among the bodies."""
    height = float(scene.parameters["robot", "height"])
    origins, orientations = link_frames(scene.state.joint_positions, height)
    found = []
    for finger in range(N_FINGERS):
        for part, mesh in enumerate(link_meshes(), start=1):
            frame = FRAMES_PER_FINGER * finger + part
            look = mesh.vertices, mesh.faces, mesh.normals
            place = origins[frame], rotation_matrix(orientations[frame])
            of = bodies.colors[frame + 1], int(bodies.owners[frame + 1])
            found.append(Triangles(*look, *place, *of))
    return tuple(found)


def _without_links(bodies: Bodies) -> Bodies:
    """Leave out the capsules of the links, of which none has flat sides."""
    mounts = [1 + FRAMES_PER_FINGER * finger for finger in range(N_FINGERS)]
    kept = [0, *mounts, *range(N_ROBOT, len(bodies.shapes))]
    gone = len(bodies.shapes) - len(kept)
    each = "shapes", "centers", "rotations", "halves", "colors", "owners"
    rows: dict[str, Any] = {name: getattr(bodies, name)[kept] for name in each}
    return bodies._replace(**rows, first=bodies.first[gone:])


@lru_cache(maxsize=1)
def _ring() -> Mesh:
    """Make the wall of the arena, seen from within."""
    angles = np.linspace(0.0, 2.0 * np.pi, RING_PARTS, endpoint=False)
    circle = WALL_RADIUS * np.column_stack([np.cos(angles), np.sin(angles)])
    low, high = (np.column_stack([circle, np.full(RING_PARTS, z)]) for z in (0.0, WALL_HEIGHT))
    one = np.arange(RING_PARTS)
    other = np.roll(one, -1)
    lower = np.column_stack([one, one + RING_PARTS, other])
    upper = np.column_stack([other, one + RING_PARTS, other + RING_PARTS])
    return mesh_of(np.concatenate([low, high]), np.concatenate([lower, upper]))


@lru_cache(maxsize=128)
def _hull_mesh(hull: Hull) -> Mesh:
    return mesh_of(hull.vertices, hull.faces)


def palette(scene: Scene) -> Palette:
    """Give the colors of the arena of a scene."""
    floor, wall = (scene.parameters[name, "color"].tolist() for name in ("floor", "stage"))
    return tuple(floor), tuple(wall), BACKGROUND


@njit(cache=True, error_model="numpy")
def _hit_arena(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float
) -> tuple[float, int]:
    """Meet the floor from above, or the wall of the ring from within."""
    if oz > 0.0 > dz:
        t = -oz / dz
        x, y = ox + t * dx, oy + t * dy
        if t >= near and x * x + y * y <= WALL_RADIUS * WALL_RADIUS:
            return t, FLOOR
    a, b = dx * dx + dy * dy, ox * dx + oy * dy
    discriminant = b * b - a * (ox * ox + oy * oy - WALL_RADIUS * WALL_RADIUS)
    if a > 0.0 and discriminant >= 0.0:
        t = (-b + math.sqrt(discriminant)) / a
        if t >= near and 0.0 <= oz + t * dz <= WALL_HEIGHT:
            return t, STAGE
    return math.inf, NOTHING


@njit(cache=True, error_model="numpy")
def _trace_arena(view: View, depth: Depths, owners: Owners) -> None:
    """Write depth and owner of every pixel that shows floor or wall nearer than what is there."""
    (ox, oy, oz), (ax, ay, az), (bx, by, bz) = view.rays[0], view.rays[4], view.rays[5]
    for v in range(depth.shape[0]):
        cx, cy, cz = view.rays[3, 0] + v * bx, view.rays[3, 1] + v * by, view.rays[3, 2] + v * bz
        for u in range(depth.shape[1]):
            dx, dy, dz = cx + u * ax, cy + u * ay, cz + u * az
            t, owner = _hit_arena(ox, oy, oz, dx, dy, dz, view.near)
            if t < depth[v, u]:
                depth[v, u], owners[v, u] = t, owner


@njit(cache=True, error_model="numpy")
def _paint_arena(view: View, light: Floats, colors: Floats, shadow: Floats, canvas: Canvas) -> None:
    """Color the pixels that show floor, wall or nothing.

    Args:
        view: The rays of the pixels; all from one origin.
        light: Unit vector towards the light, and the ambient brightness, shape (4,).
        colors: Of the floor, of the wall and of the background, shape (3, 3).
        shadow: How dark the floor is, shape (m, m) in [0, 1], over the square around the ring;
            of shape (0, 0) if there are no shadows.
        canvas: Depth and owners are read, colors are written.
    """
    depth, owners, rgb = canvas
    ambient, dark = light[3], SHADOW * (1.0 - light[3])
    top = brightness(light[2], ambient)
    (ox, oy, _), (ax, ay, _), (bx, by, _) = view.rays[0], view.rays[4], view.rays[5]
    for v in range(depth.shape[0]):
        cx, cy = view.rays[3, 0] + v * bx, view.rays[3, 1] + v * by
        for u in range(depth.shape[1]):
            x, y = ox + depth[v, u] * (cx + u * ax), oy + depth[v, u] * (cy + u * ay)
            shade, row = 1.0, 2
            if owners[v, u] == FLOOR:
                shade, row = top * (1.0 - dark * shade_at(shadow, WALL_RADIUS, x, y)), 0
            elif owners[v, u] == STAGE:
                cosine = -(x * light[0] + y * light[1]) / WALL_RADIUS
                shade, row = brightness(cosine, ambient), 1
            for i in range(3):
                rgb[i, v, u] = byte(255.0 * shade * colors[row, i])


def trace_arena(camera: Camera, samples: int) -> Canvas:
    """Show floor and wall to a camera, without colors."""
    shape = camera.height * samples, camera.width * samples
    depth = np.full(shape, camera.far, dtype=np.float32)
    owners = np.full(shape, NOTHING, dtype=np.int32)
    _trace_arena(camera_view(camera, samples), depth, owners)
    return Canvas(depth, owners, NO_COLORS)


@lru_cache(maxsize=32)
def empty_arena(camera: Camera) -> Canvas:
    """Keep what ``trace_arena`` returns for one sample. The arrays are shared: copy them."""
    return trace_arena(camera, 1)


def paint_arena(
    empty: Canvas, view: View, light: Light, colors: Palette, shadow: Floats = NO_SHADOW
) -> Colors:
    """Color an empty arena, shape (3, h, w)."""
    rgb = np.empty((3, *empty.depth.shape), dtype=np.uint8)
    _paint_arena(view, lamp(light), np.array(colors), shadow, empty._replace(rgb=rgb))
    return rgb


@lru_cache(maxsize=32)
def lit_arena(camera: Camera, light: Light, colors: Palette) -> Colors:
    """Show the arena without shadows, shape (3, h, w). The array is shared: copy it."""
    return paint_arena(empty_arena(camera), camera_view(camera, 1), light, colors)


def solid_bodies(scene: Scene) -> Bodies:
    """List the hub, the links, the blocks and the obstacles of a scene."""
    structure, parameters, state = scene.structure, scene.parameters, scene.state
    names = (*structure.blocks, *structure.obstacles)
    hulls = dict(structure.hulls)
    n, n_blocks = N_ROBOT + len(names), N_ROBOT + len(structure.blocks)
    bodies = empty_bodies(n, [hulls.get(name) for name in names])
    height = float(parameters["robot", "height"])
    bodies.shapes[:N_ROBOT] = _ROBOT_SHAPES
    bodies.halves[:N_ROBOT] = _ROBOT_HALVES
    bodies.owners[:N_ROBOT] = _ROBOT_OWNERS
    bodies.centers[0] = (0.0, 0.0, height - hardware.TABLE_OFFSET)
    bodies.rotations[0] = np.eye(3)
    bodies.colors[0] = HUB_COLOR
    colors = np.array([parameters[link, "color"] for link in hardware.LINK_NAMES])
    bodies.colors[1:N_ROBOT] = colors[_LINKS]
    _hang(*link_frames(state.joint_positions, height), _CENTERS, _ROTATIONS, bodies)
    bodies.centers[N_ROBOT:n_blocks] = state.positions
    turn_kernel(np.ascontiguousarray(state.orientations), bodies.rotations[N_ROBOT:n_blocks])
    for i, name in enumerate(names, start=N_ROBOT):
        bodies.colors[i] = parameters[name, "color"]
        if name not in hulls:
            bodies.halves[i] = parameters[name, "size"]
            bodies.halves[i] *= 0.5
    if structure.obstacles:
        poses = [parameters[name, "orientation"] for name in structure.obstacles]
        turn_kernel(np.array(poses, dtype=np.float64), bodies.rotations[n_blocks:])
        bodies.centers[n_blocks:] = [parameters[name, "position"] for name in structure.obstacles]
    bodies.owners[N_ROBOT:] = np.arange(FIRST_BLOCK, FIRST_BLOCK + len(names))
    return bodies


def _along(capsule: hardware.Capsule) -> tuple[Floats, Floats, Floats]:
    """Give center, rotation and halves of a capsule along x or z in the frame of its link."""
    start, end = np.array(capsule.start), np.array(capsule.end)
    length, radius = float(np.linalg.norm(end - start)), capsule.radius
    flat = abs(start[2] - end[2]) < length / 2.0
    rotation = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) if flat else np.eye(3)
    return (start + end) / 2.0, rotation, np.array([radius, radius, radius + length / 2.0])


_COLLISION = hardware.COLLISION
_CAPSULES = tuple(_along(capsule) for capsule in (MOUNT, *_COLLISION.values()))
_CENTERS, _ROTATIONS, _HALVES = (np.array(column) for column in zip(*_CAPSULES, strict=True))
N_FINGERS = len(hardware.FINGERS)
_LINKS = np.array([4 * f + min(i, 3) for f in range(N_FINGERS) for i in range(FRAMES_PER_FINGER)])
"""The link that each capsule belongs to: links 0 to 3 and the tip, which belongs to link 3."""

N_ROBOT = 1 + len(_LINKS)
"""How many bodies the robot is drawn with: its hub and the capsules of its fingers."""

FIRST_BLOCK = ROBOT + 1 + len(hardware.LINK_NAMES)

_ROBOT_SHAPES = np.array([ELLIPSOID] + [CAPSULE] * len(_LINKS))
_ROBOT_HALVES = np.vstack([HUB_HALVES, np.tile(_HALVES, (N_FINGERS, 1))])
_ROBOT_OWNERS = np.array([ROBOT, *(_LINKS + ROBOT + 1)])


@njit(cache=True)
def _hang(
    origins: Floats, orientations: Floats, centers: Floats, turns: Floats, bodies: Bodies
) -> None:
    """Hang one capsule into each frame of the fingers, behind the hub."""
    frame = np.empty((3, 3))
    for n in range(len(origins)):
        rotation_kernel(orientations[n], frame)
        kind = n % len(centers)
        for i in range(3):
            bodies.centers[n + 1, i] = origins[n, i]
            for j in range(3):
                bodies.centers[n + 1, i] += frame[i, j] * centers[kind, j]
                bodies.rotations[n + 1, i, j] = 0.0
                for k in range(3):
                    bodies.rotations[n + 1, i, j] += frame[i, k] * turns[kind, k, j]
