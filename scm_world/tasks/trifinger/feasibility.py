"""Which bodies of a scene are in one place."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from typing import Any

import numpy as np

from scm_world._types import ArrayLike, Floats, Integers
from scm_world.geometry.arrays import compact, rows
from scm_world.geometry.hulls import Convex, box_hull, placed, sides_depth
from scm_world.geometry.penetration import box_capsule
from scm_world.geometry.rotations import rotation_matrix
from scm_world.geometry.sweep import FLOOR, OTHERS, WALL, apart_in_rows, sweep
from scm_world.models.scene import TOLERANCE, Overlap, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import WALL_HEIGHT, WALL_RADIUS
from scm_world.tasks.trifinger.kinematics import FRAMES_PER_FINGER, frames_of_rows, link_frames
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE

_LINK = {"upper": 1, "middle": 2, "lower": 3, "tip": 3}
"""The link that a collision shape belongs to: the tip is a part of the lower link."""

_FRAME = {"upper": 1, "middle": 2, "lower": 3, "tip": 4}
"""The frame of a finger in which a collision shape is given."""

_FLAGS = {
    "upper": 0,
    "middle": OTHERS | FLOOR,
    "lower": OTHERS | FLOOR,
    "tip": OTHERS | FLOOR | WALL,
}


def _capsules() -> tuple[Floats, Integers]:
    """Gather the collision shapes of all fingers, as ``sweep`` wants them."""
    capsules, members = [], []
    for finger in range(len(hardware.FINGERS)):
        for part, capsule in hardware.COLLISION.items():
            capsules.append((*capsule.start, *capsule.end, capsule.radius))
            frame = FRAMES_PER_FINGER * finger + _FRAME[part]
            body = hardware.LINKS_PER_FINGER * finger + _LINK[part]
            members.append((frame, body, finger, _FLAGS[part]))
    return np.array(capsules), np.array(members, dtype=np.int64)


_CAPSULES, _MEMBERS = _capsules()
_WALL = (WALL_RADIUS, WALL_HEIGHT)
_CENTER, _TURN = slice(0, 3), slice(3, 7)  # of a pose


def overlaps(scene: Scene, *, tolerance: float) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance.

    Compared are blocks with everything; the middle and lower links of different fingers with one
    another; both with the floor; the tips with the ring, as in the engines. A block whose center
    is outside the arena lies in the stage (beyond the ring, at any height) or in the floor (below
    it). Links of the same finger, and the upper links, cannot collide with anything but blocks.
    Obstacles cannot move, so that they are not compared with one another, the floor or the ring.

    A block that is a hull is judged by its corners, against the floor and the inner radius of the
    ring, and by the sides of both bodies elsewhere (see ``sides_depth``): its depth is never
    underestimated, and it may be reported where only two edges pass one another closely.

    Args:
        scene: With complete parameters.
        tolerance: How deep is too deep [m].

    Returns:
        One entry for each pair of names, blocks first.

    Example:
        >>> from scm_world.tasks.trifinger.system import trifinger
        >>> scene = trifinger(("tool_block",)).default_scene()
        >>> overlaps(scene, tolerance=1e-4)
        ()
        >>> scene.state.positions[0, 2] = 0.03
        >>> print(*overlaps(scene, tolerance=1e-4))
        'tool_block' lies 2.5 mm deep in 'floor'
    """
    structure = scene.structure
    height = float(scene.parameters["robot", "height"])
    found = sweep(
        *_boxes(scene),
        _CAPSULES,
        _MEMBERS,
        *link_frames(scene.state.joint_positions, height),
        n_fixed=len(structure.obstacles),
        wall=_WALL,
        tolerance=float(tolerance),
    )
    if not len(found.depths):
        return ()
    names = (*structure.blocks, *hardware.LINK_NAMES, *structure.obstacles, "floor", "stage")
    pairs = zip(found.pairs.tolist(), found.depths.tolist(), strict=True)
    result = (Overlap((names[i], names[j]), depth) for (i, j), depth in pairs)
    return tuple(_sharper(scene, result, tolerance) if structure.hulls else result)


def thin(
    candidates: Any,
    blocks: tuple[str, ...],
    obstacles: tuple[str, ...],
    before: Iterable[Overlap],
    tolerances: tuple[float, float],
) -> None:
    """Leave out candidates with bodies that lie too deep in one another: first fingers, then all.

    Args:
        candidates: Draws of an intervention.
        blocks: Names of the blocks, all of them boxes.
        obstacles: Names of the obstacles.
        before: What lies in one another already may do so as deep as it does.
        tolerances: How deep is too deep where a link takes part, and elsewhere [m].
    """
    names = (*blocks, *hardware.LINK_NAMES, *obstacles, "floor", "stage")
    links = slice(len(blocks), len(blocks) + len(hardware.LINK_NAMES))
    allowed = np.full((len(names), len(names)), tolerances[1])
    allowed[links] = allowed[:, links] = tolerances[0]
    for overlap in before:
        if not set(names).issuperset(overlap.bodies):
            continue  # it is taken away
        pair = names.index(overlap.bodies[0]), names.index(overlap.bodies[1])
        allowed[pair] = max(allowed[pair], overlap.depth + 1e-6)
    robot = [*range(*links.indices(len(names))), len(names) - 2, len(names) - 1]
    stages = [((), (), allowed[np.ix_(robot, robot)]), (blocks, obstacles, allowed)]
    if not blocks and not obstacles:
        del stages[1:]
    for some, fixed, depths in stages:
        joints = candidates.state(slice(0, hardware.N_JOINTS))
        heights = candidates.parameter(("robot", "height"))
        n = len(candidates.attempts)
        frames = np.empty((n, len(hardware.FINGERS) * FRAMES_PER_FINGER, 3))
        turns = np.empty((*frames.shape[:2], 4))
        frames_of_rows(np.ascontiguousarray(joints), np.ascontiguousarray(heights), frames, turns)
        boxes = [*some, *fixed]
        sizes = _together([candidates.parameter((name, "size")) for name in boxes], 3)
        firsts = [ROBOT_SIZE + BLOCK_SIZE * index for index in range(len(some))]
        poses = [candidates.state(slice(first, first + 7)) for first in firsts]
        centers, orientations = ([pose[:, at] for pose in poses] for at in (_CENTER, _TURN))
        centers += [candidates.parameter((name, "position")) for name in fixed]
        orientations += [candidates.parameter((name, "orientation")) for name in fixed]
        apart = apart_in_rows(
            sizes,
            _together(centers, 3),
            _together(orientations, 4),
            _CAPSULES,
            _MEMBERS,
            frames,
            turns,
            len(fixed),
            _WALL,
            depths,
        )
        candidates.keep(apart)
        if not len(candidates.attempts):
            return


def _together(parts: list[Floats], size: int) -> Floats:
    """Put values of bodies together, shape (n or 1, bodies, size)."""
    n = max(map(len, parts), default=1)
    found = np.empty((n, len(parts), size))
    for index, part in enumerate(parts):
        found[:, index] = part
    return found


def buried_goals(scene: Scene, names: Container[str]) -> tuple[Overlap, ...]:
    """List goals that lie deeper than ``TOLERANCE`` in an obstacle: nothing can ever fill them.

    Args:
        scene: With complete parameters.
        names: Of the goals to look at.
    """
    found = []
    for goal in scene.goals:
        for obstacle in scene.structure.obstacles if goal.name in names else ():
            if goal.shape == "sphere":
                size, place, turn = (
                    scene.parameters[obstacle, what] for what in ("size", "position", "orientation")
                )
                center, radius = goal.position, 0.5 * float(goal.size[0])
                depth = box_capsule(size, place, turn, center, center, radius)
            else:
                hull = goal.hull or box_hull(goal.size)
                body = placed(hull, goal.position, goal.orientation)
                depth = sides_depth(body, _solid(scene, obstacle))
            if depth > TOLERANCE:
                found.append(Overlap((goal.name, obstacle), depth))
    return tuple(found)


def fingers_reach(
    size: ArrayLike, position: ArrayLike, orientation: ArrayLike, joints: ArrayLike, height: float
) -> bool:
    """Tell whether a finger lies in a box.

    Args:
        size: Full edge lengths of the box, shape (3,) [m].
        position: Its center, shape (3,) [m].
        orientation: Its quaternion (x, y, z, w).
        joints: Of the robot, shape (9,) [rad].
        height: Of its base [m].
    """
    capsules = [part for parts in _placed_links(joints, height).values() for part in parts]
    return any(
        box_capsule(size, position, orientation, p.corners[0], p.corners[1], p.radius) > TOLERANCE
        for p in capsules
    )


def _boxes(scene: Scene) -> tuple[Floats, Floats, Floats]:
    """Gather sizes, centers and orientations of the boxes: blocks first, then obstacles."""
    structure, parameters = scene.structure, scene.parameters
    centers, orientations = compact(scene.state.positions), compact(scene.state.orientations)
    sizes = {
        name: parameters[name, "size"] for name in structure.blocks if not structure.hull(name)
    }
    for name, hull in structure.hulls:
        corners, index = np.array(hull.vertices), structure.blocks.index(name)
        low, high = corners.min(axis=0), corners.max(axis=0)
        sizes[name] = high - low
        centers[index] += 0.5 * rotation_matrix(orientations[index]) @ (low + high)
    fixed = structure.obstacles
    if fixed:
        sizes |= {name: parameters[name, "size"] for name in fixed}
        centers = np.vstack([centers, *(parameters[name, "position"] for name in fixed)])
        turned = (parameters[name, "orientation"] for name in fixed)
        orientations = np.vstack([orientations, *turned])
    return rows([sizes[name] for name in (*structure.blocks, *fixed)], 3), centers, orientations


def _sharper(scene: Scene, found: Iterable[Overlap], tolerance: float) -> Iterator[Overlap]:
    """Judge hulls by their shapes, of which the boxes around them are only bounds."""
    hulls = {name for name, _ in scene.structure.hulls}
    links: dict[str, list[Convex]] = {}
    for overlap in found:
        first, second = overlap.bodies
        depth = overlap.depth
        if hulls & {first, second}:
            if second in hardware.LINK_NAMES:
                height = float(scene.parameters["robot", "height"])
                links = links or _placed_links(scene.state.joint_positions, height)
                deep = max(sides_depth(_solid(scene, first), part) for part in links[second])
            elif second in ("floor", "stage"):
                corners = _solid(scene, first).corners
                beyond = np.hypot(corners[:, 0], corners[:, 1]) - WALL_RADIUS
                deep = float((-corners[:, 2] if second == "floor" else beyond).max())
            else:
                deep = sides_depth(_solid(scene, first), _solid(scene, second))
            depth = min(depth, deep)
        if depth > tolerance:
            yield Overlap(overlap.bodies, depth)


def _solid(scene: Scene, name: str) -> Convex:
    """Give a block or an obstacle its flat sides."""
    structure, parameters = scene.structure, scene.parameters
    hull = structure.hull(name) or box_hull(parameters[name, "size"])
    if name in structure.obstacles:
        return placed(hull, parameters[name, "position"], parameters[name, "orientation"])
    pose = scene.state.blocks[structure.blocks.index(name)]
    return placed(hull, pose[:3], pose[3:7])


def _placed_links(joints: ArrayLike, height: float) -> dict[str, list[Convex]]:
    """Put the capsules of all links into the world."""
    origins, orientations = link_frames(joints, height)
    links: dict[str, list[Convex]] = {}
    for capsule, (frame, body, *_) in zip(_CAPSULES, _MEMBERS.tolist(), strict=True):
        ends = origins[frame] + capsule[:6].reshape(2, 3) @ rotation_matrix(orientations[frame]).T
        part = Convex(ends, np.empty((0, 3)), float(capsule[6]))
        links.setdefault(hardware.LINK_NAMES[body], []).append(part)
    return links
