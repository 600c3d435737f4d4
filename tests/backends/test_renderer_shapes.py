"""Facts about pictures of lists of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from robot_scenes import box_hull

from scm_world._types import Floats
from scm_world.backends.renderer import automatic_camera, following_camera
from scm_world.backends.renderer.kernels import Canvas
from scm_world.backends.renderer.shapes import SKY, draw_parts, goal_shapes, parted
from scm_world.geometry.rotations import rotation_matrix
from scm_world.models.camera import Camera
from scm_world.models.scene import GoalRegion, Light
from scm_world.models.shapes import KINDS, Mesh, Shapes, mesh_of

LIGHT = Light()
CAMERA = Camera("test", (0.7, -1.1, 0.9), (0.0, 0.0, 0.0), width=160, height=120)
TURN = rotation_matrix(np.array([0.2, -0.4, 0.1, 0.9]) / np.linalg.norm([0.2, -0.4, 0.1, 0.9]))
RED = np.array([1.0, 0.0, 0.0, 1.0])
GREEN = np.array([0.0, 1.0, 0.0, 1.0])


def shape(
    kind: str,
    halves: tuple[float, float, float],
    at: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    color: Floats = RED,
    rotation: Floats = TURN,
    mesh: Mesh | None = None,
    tiles: Sequence[float] | None = None,
    moves: bool = False,
) -> Shapes:
    """Make body 0."""
    numbers = [KINDS.index(kind)], [halves], [at], [rotation], [color]
    found = Shapes.of(*numbers, [0], [moves])._replace(meshes={} if mesh is None else {0: mesh})
    if tiles is not None:
        found.table.tiles[0] = tiles
    return found


def together(shapes: Sequence[Shapes]) -> Shapes:
    """Put shapes into one scene."""
    return reduce(Shapes.joined, shapes, Shapes.of([], [], [], [], []))


def draw_shapes(
    shapes: Sequence[Shapes], camera: Camera, light: Light, *, shadows: bool = True
) -> Canvas:
    """Draw a list of shapes."""
    return draw_parts(parted(together(shapes), shadows=shadows), camera, light)


def corners(one: Shapes) -> Floats:
    """Compute the corners of the box around a shape."""
    found: Floats = one.corners(np.array([0]))[0]
    return found


FLOOR = shape("plane", (0.0, 0.0, 0.0), rotation=np.eye(3), color=GREEN)


def box_mesh(halves: tuple[float, float, float]) -> Mesh:
    """Triangulate a box."""
    hull = box_hull([2.0 * half for half in halves])
    return mesh_of(hull.vertices, hull.faces)


def grid_mesh(halves: tuple[float, float, float], kind: str, n: int = 200) -> Mesh:
    """Triangulate an ellipsoid, or the side and the ends of a cylinder, finely."""
    around = np.linspace(0.0, 2.0 * np.pi, n)
    if kind == "cylinder":
        radius, height = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0])
    else:
        along = np.linspace(-np.pi / 2.0, np.pi / 2.0, n)
        radius, height = np.cos(along), np.sin(along)
    rows = [
        np.stack([r * np.cos(around), r * np.sin(around), np.full(n, h)], axis=1)
        for r, h in zip(radius, height, strict=True)
    ]
    corner = (np.arange(len(rows) - 1)[:, None] * n + np.arange(n - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + n + 1], axis=1)
    other = np.stack([corner, corner + n + 1, corner + n], axis=1)
    return mesh_of(np.concatenate(rows) * halves, np.concatenate([one, other]))


def seen(canvas: Canvas) -> np.ndarray:
    """Tell which pixels show a body."""
    return canvas.owners >= 0


@pytest.mark.parametrize("kind", ["box", "cylinder", "ellipsoid"])
def test_a_solid_looks_like_its_triangles(kind: str) -> None:
    """Depth, color and outline of a solid are those of a fine mesh of it, but for rounding."""
    halves = (0.3, 0.2, 0.4) if kind != "cylinder" else (0.3, 0.3, 0.4)
    mesh = box_mesh(halves) if kind == "box" else grid_mesh(halves, kind)
    solid = draw_shapes([shape(kind, halves)], CAMERA, LIGHT)
    triangles = draw_shapes([shape("mesh", halves, mesh=mesh)], CAMERA, LIGHT)
    both = seen(solid) & seen(triangles)

    assert both.sum() > 1_000
    assert (seen(solid) != seen(triangles)).sum() <= 0.01 * both.sum()
    depths = np.abs(solid.depth - triangles.depth)[both]
    assert np.quantile(depths, 0.99) < 1e-3  # the rest is seen at grazing angles
    off = np.abs(solid.rgb.astype(int) - triangles.rgb).max(axis=0)[both]
    assert np.quantile(off, 0.97) <= 3


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule", "ellipsoid", "mesh"])
def test_the_inside_is_seen_from_within(kind: str) -> None:
    """A camera in a solid sees it everywhere, at the distance of its far side."""
    mesh = box_mesh((2.0, 2.0, 2.0)) if kind == "mesh" else None
    around = shape(kind, (2.0, 2.0, 4.0 if kind == "capsule" else 2.0), mesh=mesh)
    canvas = draw_shapes([around], CAMERA, LIGHT)

    assert seen(canvas).all()
    assert canvas.depth.min() > 0.1
    assert canvas.depth.max() < 8.0


def test_a_cylinder_has_flat_ends() -> None:
    """From above, a cylinder is a disk of one depth, and as large as the pinhole formula says."""
    upright = shape("cylinder", (0.2, 0.2, 0.3), rotation=np.eye(3))
    top = Camera("top", (0.0, 0.0, 1.3), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    canvas = draw_shapes([upright], top, LIGHT)
    radius = 0.2 / 1.0 * 64.0 / np.tan(np.radians(26.0))

    np.testing.assert_allclose(canvas.depth[seen(canvas)], 1.0, rtol=1e-6)
    assert seen(canvas).sum() == pytest.approx(np.pi * radius**2, rel=0.03)


def test_triangles_that_share_an_edge_leave_no_gap() -> None:
    """A square of thousands of triangles covers its pixels without a hole."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 61), np.linspace(-1.0, 1.0, 61))
    corner = (np.arange(60)[:, None] * 61 + np.arange(60)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 62], axis=1),
         np.stack([corner, corner + 62, corner + 61], axis=1)]
    )  # fmt: skip
    sheet = mesh_of(np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1), faces)
    canvas = draw_shapes([shape("mesh", (1, 1, 1), mesh=sheet, rotation=np.eye(3))], CAMERA, LIGHT)
    whole = shape("plane", (1, 1, 0), rotation=np.eye(3))

    assert seen(canvas).sum() > 5_000
    assert (seen(canvas) != seen(draw_shapes([whole], CAMERA, LIGHT))).sum() <= 5


def test_what_is_behind_the_camera_is_not_seen() -> None:
    """Solids and triangles behind the camera cover nothing, nor does what is nearer than near."""
    behind = (1.4, -2.2, 1.8)
    mesh = box_mesh((0.1, 0.1, 0.1))
    for one in (shape("mesh", (1, 1, 1), behind, mesh=mesh), shape("cylinder", (1, 1, 1), behind)):
        assert not seen(draw_shapes([one], replace(CAMERA, near=0.5), LIGHT)).any()


@pytest.mark.parametrize("kind", ["box", "mesh", "plane"])
def test_a_clear_shape_is_blended_once(kind: str) -> None:
    """Half of the light comes from a clear shape, half from behind; depth is that of the solid."""
    clear = np.array([0.0, 0.0, 1.0, 0.5])
    mesh = box_mesh((0.4, 0.4, 0.4)) if kind == "mesh" else None
    glass, pane = (
        shape(kind, (0.4, 0.4, 0.4), mesh=mesh, color=color, rotation=np.eye(3))
        for color in (clear, np.array([0.0, 0.0, 1.0, 1.0]))
    )
    with_, opaque, without = (
        draw_shapes(shapes, CAMERA, LIGHT) for shapes in ([glass], [pane], [])
    )
    inside = seen(opaque)
    middle = (opaque.rgb.astype(float) + without.rgb)[:, inside] / 2.0

    assert not seen(with_).any()
    np.testing.assert_array_equal(with_.depth, without.depth)
    off = np.abs(with_.rgb[:, inside] - middle).max(axis=0)
    # The edges of silhouettes of boxes are twice as opaque.
    assert np.quantile(off, 0.6) <= 1.0
    np.testing.assert_array_equal(with_.rgb[:, ~inside], without.rgb[:, ~inside])


def test_a_clear_shape_does_not_hide_what_is_before_it() -> None:
    """A solid in front of a clear mesh keeps its color."""
    front = shape("ellipsoid", (0.1, 0.1, 0.1), (0.35, -0.55, 0.45))
    mesh = box_mesh((0.3, 0.3, 0.3))
    glass = shape("mesh", (0.3, 0.3, 0.3), mesh=mesh, color=np.array([0.0, 0.0, 1.0, 0.5]))
    alone, both = (draw_shapes(shapes, CAMERA, LIGHT) for shapes in ([front], [glass, front]))

    ball = seen(alone)
    assert ball.sum() > 100
    np.testing.assert_array_equal(both.rgb[:, ball], alone.rgb[:, ball])
    assert (both.rgb != alone.rgb).any()


def test_depth_of_a_plane() -> None:
    """Every pixel of an endless floor has the depth at which its ray meets height zero."""
    canvas = draw_shapes([FLOOR], CAMERA, LIGHT)
    low = seen(canvas)
    rows, columns = np.nonzero(low)
    points = np.stack([columns + 0.5, rows + 0.5], axis=1)
    right, up, back = CAMERA.axes()
    focal = CAMERA.height / (2.0 * np.tan(np.radians(CAMERA.field_of_view / 2.0)))
    u, v = (points[:, :1] - 80.0) / focal, (60.0 - points[:, 1:]) / focal
    rays = u * right + v * up - back

    assert low[60:].all()
    np.testing.assert_allclose(canvas.depth[low], -0.9 / rays[:, 2], rtol=1e-5)


def test_a_plane_is_seen_from_its_front_only() -> None:
    """From below there is no floor."""
    below = replace(CAMERA, eye=(0.7, -1.1, -0.9))
    assert not seen(draw_shapes([FLOOR], below, LIGHT)).any()


def test_a_plane_ends_where_it_says() -> None:
    """A plane of one by two meters covers as many pixels as a flat box of that size."""
    sheet = shape("plane", (0.25, 0.5, 0.0), color=GREEN, rotation=np.eye(3))
    flat = shape("box", (0.25, 0.5, 1e-6), color=GREEN, rotation=np.eye(3))
    one, other = (seen(draw_shapes([shape], CAMERA, LIGHT)) for shape in (sheet, flat))

    assert one.sum() > 1_000
    assert (one != other).sum() <= 5


def test_tiles_of_a_plane() -> None:
    """The tile of the least x and greatest y has the first color, its neighbors the second."""
    tiles = 0.2, 0.2, 0.0, 0.0, 1.0
    sheet = shape(
        "plane", (0.3, 0.3, 0.0), color=GREEN, rotation=np.eye(3), tiles=tiles
    )  # three by three
    top = Camera("top", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    rgb = draw_shapes([sheet], top, LIGHT).rgb
    pixels = [
        tuple(int(number) for number in np.floor(top.project([x, y, 0.0])[:2]))
        for x, y in ((-0.2, 0.2), (0.0, 0.2), (-0.2, 0.0), (0.0, 0.0))
    ]
    blue = [int(rgb[2, row, column]) > int(rgb[1, row, column]) for column, row in pixels]

    assert blue == [False, True, True, False]


def test_far_tiles_fade() -> None:
    """Near the horizon a checkerboard has one color; there is no flicker of single pixels."""
    floor = shape("plane", (0, 0, 0), rotation=np.eye(3), color=GREEN, tiles=(0.3, 0.3, 0, 0, 0))
    low = replace(CAMERA, eye=(0.0, -3.0, 1.0), target=(0.0, 0.0, 0.9), far=1e4)
    canvas = draw_shapes([floor], low, LIGHT)
    first = int(np.argmax(seen(canvas)[:, 80]))
    row = canvas.rgb[1, first + 1]

    assert row.max() - row.min() <= 2
    assert np.ptp(canvas.rgb[1, -1].astype(int)) > 50


def test_shadows_fall_on_planes() -> None:
    """Below a box, away from the light, a floor is darker; without shadows it has one color."""
    light = Light((0.0, -1.0, 1.0))
    box = shape("box", (0.1, 0.1, 0.1), (0.0, 0.0, 0.5), rotation=np.eye(3))
    with_, without = (
        draw_shapes([FLOOR, box], CAMERA, light, shadows=shadows) for shadows in (True, False)
    )
    column, row = (int(number) for number in CAMERA.project([0.0, 0.5, 0.0])[:2])
    green = without.rgb[1][(without.rgb[0] == 0) & seen(without)]

    assert with_.rgb[1, row, column] < 0.7 * without.rgb[1, row, column]
    assert green.min() == green.max()


@pytest.mark.parametrize("kind", ["box", "mesh"])
def test_shadow_of_a_tilted_plane(kind: str) -> None:
    """A plane that is turned shows the shadow where the light meets it."""
    turn = rotation_matrix(np.array([np.sin(0.2), 0.0, 0.0, np.cos(0.2)]))
    normal = turn[:, 2]
    mesh = box_mesh((0.1, 0.1, 0.1)) if kind == "mesh" else None
    block = shape(kind, (0.1, 0.1, 0.1), tuple(0.4 * normal), mesh=mesh, rotation=np.eye(3))
    slope = shape("plane", (0.0, 0.0, 0.0), rotation=turn, color=GREEN)
    light = Light(tuple(normal.tolist()))
    camera = replace(CAMERA, eye=(1.5, -1.0, 1.3))
    with_, without = (
        draw_shapes([slope, block], camera, light, shadows=shadows) for shadows in (True, False)
    )

    assert with_.rgb[1, 60, 80] < 0.7 * without.rgb[1, 60, 80]


def test_an_empty_list_is_a_picture_of_the_sky() -> None:
    """Where there is nothing, there is sky."""
    canvas = draw_shapes([], CAMERA, LIGHT)

    assert (canvas.rgb == np.reshape(SKY, (3, 1, 1))).all()
    assert not seen(canvas).any()


def test_framing_shows_all_that_moves_and_fills_the_picture() -> None:
    """All corners of what moves lie in the picture, near two opposite edges of it."""
    moving = [
        shape("capsule", (0.1, 0.1, 0.8), (3.0, 2.0, 1.0), moves=True),
        shape("box", (0.2, 0.4, 0.1), (5.0, 2.0, 1.5), moves=True),
    ]
    wall = shape("box", (20.0, 0.1, 20.0), (0.0, 30.0, 0.0))
    size = 90, 200
    camera = automatic_camera(together([FLOOR, wall, *moving]), size)
    points = camera.project(np.concatenate([corners(one) for one in moving]))
    share = points[:, :2] / (200, 90)

    assert (camera.height, camera.width) == size
    assert ((share > 0.0) & (share < 1.0)).all()
    assert max(np.ptp(share[:, 0]), np.ptp(share[:, 1])) > 0.6
    assert (points[:, 2] > camera.near).all()


def test_framing_of_what_stands_still() -> None:
    """Where nothing moves, everything but planes is seen."""
    table = shape("box", (0.5, 0.5, 0.1), (1.0, 1.0, 0.5))
    assert automatic_camera(together([FLOOR, table]), (60, 80)).target == pytest.approx(
        (1.0, 1.0, 0.5)
    )


def test_following_keeps_a_body_near_the_middle() -> None:
    """A camera stays while a body moves a little, and then goes along with it."""
    body = shape("ellipsoid", (0.1, 0.1, 0.1), moves=True)
    camera = automatic_camera(together([FLOOR, body]), (60, 80))
    near = shape("ellipsoid", (0.1, 0.1, 0.1), (0.02, 0.0, 0.0), moves=True)
    assert following_camera(camera, near) is camera

    offset = np.subtract(camera.eye, camera.target)
    for x in np.linspace(0.0, 10.0, 50):
        there = shape("ellipsoid", (0.1, 0.1, 0.1), (x, 0.0, np.sin(x)), moves=True)
        camera = following_camera(camera, together([FLOOR, there]))
        pixels = camera.project(corners(there))[:, :2]
        assert (pixels > 0.0).all()
        assert (pixels < (80.0, 60.0)).all()
    np.testing.assert_allclose(np.subtract(camera.eye, camera.target), offset, atol=1e-12)


def test_goals_are_silhouettes() -> None:
    """Goals of every shape color pixels, and have neither depth nor number."""
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    for kind, hull in (("box", None), ("sphere", None), ("hull", box_hull([0.3, 0.3, 0.3]))):
        goal = GoalRegion("goal", kind, np.full(3, 0.3), np.zeros(3), upright, RED[:3], hull)
        with_, without = (
            draw_shapes(shapes, CAMERA, LIGHT) for shapes in ([goal_shapes([goal])], [])
        )
        assert (with_.rgb != without.rgb).any(axis=0).sum() > 400
        np.testing.assert_array_equal(with_.depth, without.depth)
        assert not seen(with_).any()
