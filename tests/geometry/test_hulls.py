"""Facts about convex polyhedra."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from robot_scenes import box_hull
from scipy.spatial import ConvexHull, HalfspaceIntersection

from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption
from scm_world.geometry.filling import overlap_fraction
from scm_world.geometry.hulls import Hull, hull_of, hull_overlap, load_hull
from scm_world.geometry.rotations import rotation_matrix

HERE, UPRIGHT = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])


def cube_corners(edge: float = 1.0) -> Floats:
    """List the corners of a cube that stands in the first octant."""
    return edge * np.array(list(product((0.0, 1.0), repeat=3)))


def shapes() -> list[Hull]:
    """Make a few shapes: rough, flat, round and square."""
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(60, 3))
    grid = np.array(list(product(range(4), range(3), range(5))), dtype=float)
    return [
        hull_of(TETRAHEDRON),
        hull_of(rng.uniform(-1.0, 1.0, size=(30, 3)) * [1.0, 0.5, 0.05]),
        hull_of(ball / np.linalg.norm(ball, axis=1, keepdims=True)),
        hull_of(grid),
        box_hull([1.0, 2.0, 3.0]),
    ]


@pytest.mark.parametrize("hull", shapes())
def test_surface_is_closed_and_faces_outward(hull: Hull) -> None:
    """Euler's formula holds, every plane has all corners below it, and faces sum to the volume."""
    vertices, planes = np.array(hull.vertices), np.array(hull.planes)
    corners = vertices[np.array(hull.faces)]
    edges = {frozenset((f[k], f[k - 1])) for f in hull.faces for k in range(3)}
    heights = vertices @ planes[:, :3].T - planes[:, 3]

    assert len(hull.vertices) - len(edges) + len(hull.faces) == 2
    assert heights.max() < 1e-6
    assert ((np.abs(heights) < 1e-6).sum(axis=0) >= 3).all()
    np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.det(corners).sum() / 6.0, hull.volume)
    np.testing.assert_allclose(ConvexHull(vertices).volume, hull.volume)


@pytest.mark.parametrize("hull", shapes())
def test_frame_is_that_of_mass_and_principal_axes(hull: Hull) -> None:
    """Wrapping a shape again changes nothing: center, axes and moments are in place."""
    again = hull_of(hull.vertices)

    np.testing.assert_allclose(
        sorted(np.round(again.vertices, 9).tolist()), sorted(np.round(hull.vertices, 9).tolist()),
        atol=2e-9,
    )  # fmt: skip
    np.testing.assert_allclose(again.moments, hull.moments)


def test_moments_of_a_box() -> None:
    """They are those of the textbook, in the order of the axes of the file."""
    hull = hull_of(cube_corners() * [1.0, 2.0, 3.0] + [5.0, -7.0, 9.0])

    np.testing.assert_allclose(hull.moments, [13.0 / 12.0, 10.0 / 12.0, 5.0 / 12.0])
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0), [1.0, 2.0, 3.0])
    assert hull.volume == pytest.approx(6.0)


def test_moments_by_sampling() -> None:
    """A tetrahedron's center and moments are those of points spread in it."""
    hull, rng = hull_of(TETRAHEDRON), np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(4), size=200_000)
    points = weights @ np.array(hull.vertices)
    squares = (points**2).mean(axis=0)

    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=4e-3)
    np.testing.assert_allclose(hull.moments, squares.sum() - squares, rtol=0.01)
    np.testing.assert_allclose(np.cov(points.T) - np.diag(squares), 0.0, atol=2e-3)


@pytest.mark.parametrize("corners", [cube_corners(), cube_corners() * [1, 1, 2]])
def test_symmetric_shapes_keep_the_axes_of_the_file(corners: Floats) -> None:
    """Where axes can be chosen, those of the file are."""
    centered = corners - corners.mean(axis=0)

    np.testing.assert_allclose(sorted(hull_of(corners).vertices), sorted(centered.tolist()))


def test_turned_box_comes_out_straight() -> None:
    """A box turned by less than 45° about each axis keeps the order and signs of its axes."""
    turn = rotation_matrix([0.05, -0.1, 0.2, 1.0])
    corners = (cube_corners() - 0.5) * [1.0, 2.0, 3.0]

    found = np.array(hull_of(corners @ turn.T).vertices)
    np.testing.assert_allclose(found[np.lexsort(found.round(6).T[::-1])], corners, atol=1e-12)


def test_moving_and_turning_a_mesh_changes_no_shape() -> None:
    """Volume, moments and number of corners belong to the solid, not to the file."""
    turn = rotation_matrix([0.3, -0.1, 0.7, 0.4])
    one, other = hull_of(TETRAHEDRON), hull_of(TETRAHEDRON @ turn.T + [1.0, 2.0, 3.0])

    assert other.volume == pytest.approx(one.volume)
    np.testing.assert_allclose(sorted(other.moments), sorted(one.moments))


def test_points_within_do_not_count() -> None:
    """Points inside a body, on its sides and on its edges are no corners."""
    hull = hull_of(np.array(list(product(range(4), repeat=3)), dtype=float))

    assert len(hull.vertices) == 8
    assert len(hull.planes) == 6
    assert len(hull.faces) == 12


@pytest.mark.parametrize("seed", range(10))
def test_rounding_of_a_file_makes_no_corners(seed: int) -> None:
    """A turned grid and a turned cylinder in single precision have the sides they should."""
    rng = np.random.default_rng(seed)
    turn = rotation_matrix(rng.normal(size=4))
    angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.ones(64)])
    grid = np.array(list(product(range(5), repeat=3)), dtype=float)
    cylinder = np.vstack([ring, ring * [1.0, 1.0, -1.0]])
    for points, corners, sides in ((grid, 8, 6), (cylinder, 128, 66)):
        hull = hull_of((points @ turn.T).astype(np.float32))
        assert (len(hull.vertices), len(hull.planes)) == (corners, sides)


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.zeros((0, 3)), "no volume"),
        (TETRAHEDRON[:3], "no volume"),
        (cube_corners() * [1.0, 1.0, 0.0], "one plane"),
        (np.full((5, 3), np.nan), "finite"),
        (np.zeros((4, 2)), "shape"),
        (np.random.default_rng(0).normal(size=(5000, 3)) ** 3, None),
    ],
)  # fmt: skip
def test_points_that_make_no_hull(points: Floats, problem: str | None) -> None:
    """What has no volume is refused with a reason; many points with few corners are not."""
    if problem is None:
        assert len(hull_of(points).vertices) <= 256
    else:
        with pytest.raises(ModelError, match=problem):
            hull_of(points)


def test_too_many_corners_are_refused() -> None:
    """A round shape of many corners is answered with advice."""
    ball = np.random.default_rng(0).normal(size=(300, 3))
    with pytest.raises(ModelError, match="300 corners, more than 256; simplify"):
        hull_of(ball / np.linalg.norm(ball, axis=1, keepdims=True))


def write_obj(path: Path, points: Floats) -> Path:
    """Write points and the triangles between neighbors in their order."""
    lines = [f"v {x} {y} {z}" for x, y, z in points.tolist()]
    lines += [f"f {n} {n + 1} {n + 2}" for n in range(1, len(points) - 1)]
    path.write_text("\n".join(lines))
    return path


def test_obj_is_read_in_its_unit(tmp_path: Path) -> None:
    """The convex hull of the file's corners is taken, in meters."""
    file = write_obj(tmp_path / "plate.obj", cube_corners() * [2.0, 4.0, 1.0])
    hull = load_hull(file, scale=0.01)

    assert hull.volume == pytest.approx(8e-6)
    np.testing.assert_allclose(np.ptp(hull.vertices, axis=0), [0.02, 0.04, 0.01])


def test_stl_is_read(tmp_path: Path) -> None:
    """A text STL says its corners once per triangle."""
    triangles = TETRAHEDRON[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    text = "solid body\n"
    for triangle in triangles:
        text += "facet normal 0 0 0\nouter loop\n"
        text += "".join(f"vertex {x} {y} {z}\n" for x, y, z in triangle.tolist())
        text += "endloop\nendfacet\n"
    file = tmp_path / "body.STL"
    file.write_text(text + "endsolid body\n")

    assert load_hull(file).volume == pytest.approx(1.0)


def test_files_that_are_no_meshes(tmp_path: Path) -> None:
    """Wrong formats, missing, broken and flat files, and senseless scales are refused."""
    flat = write_obj(tmp_path / "flat.obj", cube_corners() * [1.0, 1.0, 0.0])
    broken = tmp_path / "broken.stl"
    broken.write_bytes(b"\x00\x01")
    with pytest.raises(UnknownOption, match="no mesh format is named 'png'"):
        load_hull(tmp_path / "picture.png")
    with pytest.raises(ModelError, match=r"missing\.obj cannot be read"):
        load_hull(tmp_path / "missing.obj")
    with pytest.raises(ModelError, match=r"broken\.stl"):
        load_hull(broken)
    with pytest.raises(ModelError, match=r"flat\.obj .* no volume"):
        load_hull(flat)
    with pytest.raises(ModelError, match="positive and finite, got -1"):
        load_hull(flat, scale=-1.0)


@pytest.mark.parametrize("seed", range(40))
def test_overlap_of_boxes(seed: int) -> None:
    """Boxes as polyhedra share exactly what boxes share, also where faces are coplanar."""
    rng = np.random.default_rng(seed)
    size_a, size_b = rng.uniform(0.02, 0.2, size=(2, 3))
    turn_a, turn_b = rng.normal(size=(2, 4))
    shift = rng.uniform(-0.05, 0.05, size=3)
    if seed % 4 == 1:
        turn_b = turn_a
    elif seed % 4 == 2:
        turn_a = turn_b = UPRIGHT
        size_b[:2], shift = size_a[:2], shift * [0.0, 0.0, 1.0]
    elif seed % 4 == 3:
        turn_b = turn_a + 1e-9 * rng.normal(size=4)
        size_b, shift = size_a, HERE
    boxes = (size_a, shift, turn_a, size_b, HERE, turn_b)
    shared = overlap_fraction(*(row[None].astype(float) for row in boxes)) * np.prod(size_b)
    hulls = (box_hull(size_a), shift, turn_a, box_hull(size_b), HERE, turn_b)

    smaller = min(np.prod(size_a), np.prod(size_b))
    assert hull_overlap(*hulls) == pytest.approx(shared, abs=1e-12 * smaller)


@pytest.mark.parametrize("seed", range(10))
def test_overlap_of_rough_shapes(seed: int) -> None:
    """The shared volume is that of the intersection of all half-spaces."""
    rng = np.random.default_rng(seed)
    a, b = (hull_of(rng.normal(size=(12, 3))) for _ in range(2))
    poses = [(rng.uniform(-0.3, 0.3, size=3), rng.normal(size=4)) for _ in range(2)]
    half_spaces = []
    for hull, (position, orientation) in zip((a, b), poses, strict=True):
        planes = np.array(hull.planes)
        normals = planes[:, :3] @ rotation_matrix(orientation).T
        half_spaces.append(np.column_stack([normals, -planes[:, 3] - normals @ position]))
    shared = HalfspaceIntersection(np.vstack(half_spaces), HERE).intersections

    expected = ConvexHull(shared).volume
    assert hull_overlap(a, *poses[0], b, *poses[1]) == pytest.approx(expected, rel=1e-9)
    assert hull_overlap(b, *poses[1], a, *poses[0]) == pytest.approx(expected, rel=1e-9)


def test_overlap_with_itself_and_with_what_is_far() -> None:
    """A shape shares all of itself, and nothing with what only touches it or is elsewhere."""
    hull, cube = hull_of(TETRAHEDRON), box_hull([1.0, 1.0, 1.0])

    assert hull_overlap(hull, HERE, UPRIGHT, hull, HERE, UPRIGHT) == pytest.approx(hull.volume)
    assert hull_overlap(cube, [1.0, 0.0, 0.0], UPRIGHT, cube, HERE, UPRIGHT) == 0.0
    assert hull_overlap(hull, [9.0, 0.0, 0.0], UPRIGHT, cube, HERE, UPRIGHT) == 0.0


def test_overlap_of_one_within_the_other() -> None:
    """A body inside another shares its own volume, whichever is named first."""
    small, big = hull_of(0.1 * TETRAHEDRON), box_hull([2.0, 2.0, 2.0])
    turned = np.array([0.1, 0.2, 0.3, 0.4])
    away = np.array([0.3, -0.4, 0.2])

    expected = pytest.approx(small.volume, rel=1e-12)
    assert hull_overlap(small, away, turned, big, HERE, UPRIGHT) == expected
    assert hull_overlap(big, HERE, UPRIGHT, small, away, turned) == expected


def test_the_pose_of_the_points_is_kept() -> None:
    """Turned by the axes and moved, the corners are those that were given."""
    points = np.array([[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [0.0, 0.2, 0.1], [0.1, 0.0, 0.4]])
    hull = hull_of(points)
    turned = np.array(hull.vertices) @ rotation_matrix(hull.axes).T
    order = [int(np.argmin(np.linalg.norm(points - points.mean(0) - v, axis=1))) for v in turned]
    np.testing.assert_allclose(turned, points[order] - points.mean(0), atol=1e-12)
    assert sorted(order) == [0, 1, 2, 3]
