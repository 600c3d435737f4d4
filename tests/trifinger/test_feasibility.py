"""Facts about which bodies are reported to be in one place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robot_scenes import box_hull, link_frames, octahedron

from scm_world._types import ArrayLike
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.models import Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.block_world import overlaps
from scm_world.tasks.trifinger.hardware import WALL_HEIGHT, WALL_RADIUS
from scm_world.tasks.trifinger.kinematics import inverse
from scm_world.tasks.trifinger.system import trifinger

TOLERANCE = 1e-4  # [m]
CUBE = 0.065  # [m]


def _scene(*positions: ArrayLike) -> Scene:
    """Put default cubes, named a, b, …, at the given positions."""
    scene = trifinger(blocks=tuple("abcdefgh"[: len(positions)])).default_scene()
    for block, position in zip(scene.state.positions, positions, strict=True):
        block[:] = position
    return scene


def _found(scene: Scene) -> dict[tuple[str, str], float]:
    return {overlap.bodies: overlap.depth for overlap in overlaps(scene, tolerance=TOLERANCE)}


def test_one_block_on_the_table_is_feasible() -> None:
    """A block that stands on the floor touches it and is not in it."""
    assert overlaps(_scene((0.0, 0.0, CUBE / 2)), tolerance=TOLERANCE) == ()


def test_stacked_blocks_are_feasible() -> None:
    """Blocks may stand on one another."""
    assert not _found(_scene((0, 0, CUBE / 2), (0, 0, 1.5 * CUBE), (0.01, 0, 2.5 * CUBE)))


def test_blocks_in_one_place_are_reported_with_their_depth() -> None:
    """Two cubes a centimeter in one another are named in order, with that depth."""
    found = _found(_scene((0, 0, CUBE / 2), (CUBE - 0.01, 0.01, CUBE / 2)))
    assert found == {("a", "b"): pytest.approx(0.01)}


def test_every_pair_is_reported_once() -> None:
    """Three blocks in one place are three pairs, the lower index first."""
    found = _found(_scene(*[(0, 0, 0.15)] * 3))
    assert set(found) == {("a", "b"), ("a", "c"), ("b", "c")}


def test_depths_within_the_tolerance_are_not_reported() -> None:
    """A tolerance of a millimeter forgives half a millimeter and not two."""
    scene = _scene((0, 0, CUBE / 2 - 0.0005))
    assert overlaps(scene, tolerance=1e-3) == ()
    scene.state.positions[0, 2] = CUBE / 2 - 0.002
    (overlap,) = overlaps(scene, tolerance=1e-3)
    assert overlap.bodies == ("a", "floor")
    assert overlap.depth == pytest.approx(0.002)


def test_the_size_of_a_block_counts() -> None:
    """A block grown in its place is in the floor by half of what it grew."""
    scene = _scene((0, 0, CUBE / 2))
    grown = {**scene.parameters, ("a", "size"): np.array([0.065, 0.065, 0.085])}
    assert _found(scene.with_(parameters=grown)) == {("a", "floor"): pytest.approx(0.01)}


def test_a_block_that_leans_on_an_edge_is_in_the_floor() -> None:
    """Turning a standing block about a horizontal axis puts its edge into the floor."""
    scene = _scene((0, 0, CUBE / 2))
    scene.state.orientations[0] = from_rotation_vector([np.pi / 4, 0.0, 0.0])
    expected = pytest.approx(CUBE / 2 * (np.sqrt(2.0) - 1.0))
    assert _found(scene) == {("a", "floor"): expected}


def test_a_block_in_the_ring_is_in_the_stage() -> None:
    """A block whose side reaches beyond the flat segment before it is in the stage."""
    assert not _found(_scene((0, -0.18, CUBE / 2)))
    reach = 0.215 + CUBE / 2 - WALL_RADIUS
    assert _found(_scene((0, -0.215, CUBE / 2)))["a", "stage"] == pytest.approx(reach)


@pytest.mark.parametrize("z", [CUBE / 2, WALL_HEIGHT + 0.5, 5.0])
def test_a_block_outside_the_ring_is_in_the_stage_at_any_height(z: float) -> None:
    """Beyond the ring there is no arena, above the wall either."""
    assert ("a", "stage") in _found(_scene((0.3, 0.0, z)))


@pytest.mark.parametrize("z", [-0.01, -1.0])
def test_a_block_below_the_floor_is_in_the_floor(z: float) -> None:
    """A center below zero is reported against the floor, however far below."""
    assert ("a", "floor") in _found(_scene((0.0, 0.0, z)))


@pytest.mark.parametrize("finger", range(3))
@pytest.mark.parametrize(("frame", "link"), [(1, 1), (2, 2), (3, 3), (4, 3)])
def test_a_block_in_a_link_is_reported_with_the_published_name(
    finger: int, frame: int, link: int
) -> None:
    """A block where a link or its tip is, is in that link; the tip belongs to link 3."""
    scene = _scene((0, 0, 0.03))
    origins, _ = link_frames(scene.state.joint_positions)
    scene.state.positions[0] = origins[5 * finger + frame]
    name = hardware.link_name(hardware.FINGERS[finger], link)
    assert ("a", name) in _found(scene)


def test_the_deepest_shape_of_a_link_counts() -> None:
    """A block around the tip lies in link 3 once, much deeper than the radius of the tip."""
    scene = _scene((0, 0, 0.03))
    origins, _ = link_frames(scene.state.joint_positions)
    scene.state.positions[0] = origins[4]
    found = {pair: depth for pair, depth in _found(scene).items() if "floor" not in pair}
    (depth,) = found.values()
    assert 2 * hardware.COLLISION["tip"].radius < depth < CUBE


@pytest.mark.parametrize("joints", [hardware.REST, hardware.RAISED], ids=["rest", "raised"])
@pytest.mark.parametrize("height", [0.30, 0.34, 0.38])
def test_the_robot_alone_is_feasible(joints: tuple[float, ...], height: float) -> None:
    """Neither published pose is reported by itself, at any height the robot may have."""
    scene = trifinger().default_scene()
    scene.state.joint_positions[:] = joints
    raised = {**scene.parameters, ("robot", "height"): np.array(height)}
    assert overlaps(scene.with_(parameters=raised), tolerance=0.0) == ()


def test_poses_near_rest_are_reported_only_where_a_finger_reaches_the_ring() -> None:
    """Within 0.35 rad of rest nothing but a lower link that is truly beyond the ring is found."""
    rng, scene, reported = np.random.default_rng(0), trifinger().default_scene(), 0
    reach = WALL_RADIUS - hardware.COLLISION["tip"].radius
    for _ in range(500):
        joints = hardware.REST + rng.uniform(-0.35, 0.35, 9)
        scene.state.joint_positions[:] = np.clip(joints, hardware.JOINT_LOW, hardware.JOINT_HIGH)
        origins, _ = link_frames(scene.state.joint_positions)
        for overlap in overlaps(scene, tolerance=0.0):
            reported += 1
            link, body = overlap.bodies
            tip = origins[5 * hardware.FINGERS.index(link.split("_")[2]) + 4]
            assert (link[-1], body) == ("3", "stage")
            assert np.hypot(tip[0], tip[1]) > reach
    assert reported > 50


def test_a_finger_in_the_floor_is_reported() -> None:
    """A finger stretched downwards from a low base is in the floor with its lower link."""
    scene = trifinger().default_scene()
    scene.state.joint_positions[:3] = 0.0
    low = {**scene.parameters, ("robot", "height"): np.array(0.2)}
    depth = _found(scene.with_(parameters=low))["robot_finger_60_link_3", "floor"]
    tip_z = 0.2 - hardware.TABLE_OFFSET - 2 * hardware.LEG_LENGTH
    assert depth == pytest.approx(hardware.COLLISION["tip"].radius - tip_z)


def test_fingers_in_one_another_are_reported() -> None:
    """Fingers that all reach for the middle are in one another, each pair of links once."""
    scene = trifinger().default_scene()
    middle = np.tile([0.0, 0.0, 0.1], 3)
    solution = inverse(middle, hardware.NOMINAL_HEIGHT, near=hardware.REST)
    scene.state.joint_positions[:] = solution.joint_positions
    found = overlaps(scene, tolerance=TOLERANCE)
    assert {overlap.bodies for overlap in found} >= {
        ("robot_finger_60_link_3", "robot_finger_120_link_3"),
        ("robot_finger_60_link_3", "robot_finger_300_link_3"),
        ("robot_finger_120_link_3", "robot_finger_300_link_3"),
    }
    assert len({overlap.bodies for overlap in found}) == len(found)
    for overlap in found:
        first, second = overlap.bodies
        assert first.split("_")[2] != second.split("_")[2]


def test_an_overlap_reads_as_a_sentence() -> None:
    """An overlap says which bodies, and how deep in millimeters."""
    (overlap,) = overlaps(_scene((0, 0, 0.03)), tolerance=TOLERANCE)
    assert str(overlap) == "'a' lies 2.5 mm deep in 'floor'"


def test_looking_changes_nothing() -> None:
    """Neither the state nor the parameters are written."""
    scene = _scene((0, 0, 0.02), (0, 0, 0.03))
    state, parameters = scene.state.copy(), {k: v.copy() for k, v in scene.parameters.items()}
    scene.state.vector.flags.writeable = False
    overlaps(scene, tolerance=TOLERANCE)
    assert scene.state == state
    assert all(np.array_equal(scene.parameters[k], v) for k, v in parameters.items())


def _with_wall(scene: Scene, size: ArrayLike, position: ArrayLike, yaw: float = 0.0) -> Scene:
    """Put an obstacle named wall into a scene."""
    values = {
        "size": np.array(size),
        "position": np.array(position),
        "orientation": from_rotation_vector([0.0, 0.0, yaw]),
    }
    structure = scene.structure.with_(obstacles=("wall",))
    parameters = dict(structure.default_scene().parameters)
    parameters |= {("wall", name): value for name, value in values.items()}
    return scene.with_(structure=structure, parameters=parameters)


def test_a_block_in_an_obstacle_is_reported() -> None:
    """A block that reaches into an obstacle is named before it, with the depth."""
    wall = [0.015, 0.5, 0.065], [0.0, 0.0, CUBE / 2]
    free = _with_wall(_scene((0.0, 0.15, 2 * CUBE), (0.1, 0.0, CUBE / 2)), *wall)
    assert not _found(free)
    free.state.positions[1, 0] = CUBE / 2 + 0.0055
    assert _found(free) == {("b", "wall"): pytest.approx(0.002)}


def test_size_and_orientation_of_an_obstacle_count() -> None:
    """A wall that grows or turns towards a block reaches it."""
    block = (0.0, 0.1, CUBE / 2)
    place = [0.0, 0.0, CUBE / 2]
    assert not _found(_with_wall(_scene(block), [0.2, 0.015, 0.065], place))
    long = _with_wall(_scene(block), [0.015, 0.2, 0.065], place)
    assert set(_found(long)) == {("a", "wall")}
    turned = _with_wall(_scene(block), [0.2, 0.015, 0.065], place, np.pi / 2)
    assert _found(turned) == {("a", "wall"): pytest.approx(_found(long)["a", "wall"])}


def test_a_finger_in_an_obstacle_is_reported() -> None:
    """Middle and lower links are compared with obstacles, upper ones are not."""
    scene = trifinger().default_scene()
    origins, _ = link_frames(scene.state.joint_positions)
    at_tip = _with_wall(scene, [0.01] * 3, origins[4])
    assert set(_found(at_tip)) == {("robot_finger_60_link_3", "wall")}
    everywhere = _with_wall(scene, [1.0] * 3, [0.0, 0.0, 0.5])
    links = {f"robot_finger_{f}_link_{i}" for f in hardware.FINGERS for i in (2, 3)}
    assert set(_found(everywhere)) == {(link, "wall") for link in links}


def test_obstacles_may_stand_anywhere() -> None:
    """What cannot move may reach through the floor, the ring and other obstacles."""
    structure = trifinger(obstacles=("wall", "post"))
    parameters = dict(structure.default_scene().parameters)
    for name in structure.obstacles:
        parameters[name, "size"] = np.array([1.0, 1.0, 0.02])
        parameters[name, "position"] = np.zeros(3)
    assert not _found(structure.default_scene().with_(parameters=parameters))


def _stone(hull: Hull, position: ArrayLike) -> Scene:
    """Put a hull named a somewhere."""
    scene = trifinger(("a", "b"), hulls=(("a", hull),)).default_scene()
    scene.state.positions[0], scene.state.positions[1] = position, (0.0, 0.15, CUBE / 2)
    return scene


def test_a_hull_on_a_side_stands_on_the_floor() -> None:
    """A hull that lies on a side is not in the floor, although the box around it is."""
    hull = octahedron(0.03, 0.03, 0.03)
    scene = _stone(hull, (0.0, 0.0, 0.03 / np.sqrt(3.0)))
    axis = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2.0)
    scene.state.orientations[0] = from_rotation_vector(axis * np.arccos(-1 / np.sqrt(3.0)))
    assert not _found(scene)
    scene.state.positions[0, 2] -= 0.001
    assert _found(scene) == {("a", "floor"): pytest.approx(0.001)}


def test_a_hull_in_the_ring_is_in_the_stage() -> None:
    """The corner of a hull that is beyond the inner radius counts, not that of its box."""
    scene = _stone(octahedron(0.03, 0.03, 0.03), (WALL_RADIUS - 0.0305, 0.0, 0.1))
    assert not _found(scene)
    scene.state.positions[0, 0] += 0.001
    assert _found(scene) == {("a", "stage"): pytest.approx(0.0005, abs=1e-8)}


def test_a_stone_may_lie_on_a_block() -> None:
    """A hull that lies on a side on a block or an obstacle is in neither, though its box is."""
    hull = octahedron(0.03, 0.03, 0.03)
    scene = _with_wall(_stone(hull, (0.0, 0.0, 0.0)), [0.1, 0.1, 0.02], [0.0, -0.05, 0.09])
    axis = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2.0)
    scene.state.orientations[0] = from_rotation_vector(axis * np.arccos(-1 / np.sqrt(3.0)))
    for place, height, below in (((0.0, -0.05), 0.1, "wall"), ((0.0, 0.15), CUBE, "b")):
        scene.state.positions[0] = (*place, height + 0.03 / np.sqrt(3.0) + 1e-9)
        assert not _found(scene)
        scene.state.positions[0, 2] -= 0.002
        assert _found(scene) == {("a", below): pytest.approx(0.002, abs=1e-6)}


def test_a_finger_beside_a_stone_is_not_in_it() -> None:
    """A fingertip in the box around a hull is reported only where it reaches a side."""
    hull = octahedron(0.05, 0.05, 0.05)
    scene = _stone(hull, (0.0, 0.0, 0.0))
    origins, _ = link_frames(scene.state.joint_positions)
    radius = hardware.COLLISION["tip"].radius
    name = "robot_finger_60_link_3"
    for gap, hit in ((0.004, False), (-0.004, True)):
        normal = np.ones(3) / np.sqrt(3.0)  # the stone hangs below the tip, beside it
        scene.state.positions[0] = origins[4] - normal * (0.05 / np.sqrt(3.0) + radius + gap)
        assert (("a", name) in _found(scene)) == hit


def test_a_box_that_is_a_hull_is_a_box() -> None:
    """A box that is a hull is as deep in a block as the box itself, wherever its center is."""
    box = box_hull([0.04, 0.05, 0.06])
    corners = np.add(box.vertices, [0.01, 0.0, 0.0])
    shifted = replace(box, vertices=tuple(tuple(corner) for corner in corners.tolist()))
    for hull, x in ((box, 0.0), (shifted, -0.01)):
        scene = _stone(hull, (x, 0.15 - CUBE / 2 - 0.024, 0.1))
        scene.state.positions[1, 2] = 0.1
        assert _found(scene) == {("a", "b"): pytest.approx(0.001)}
