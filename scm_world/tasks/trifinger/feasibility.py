"""Which bodies of a scene are in one place."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.geometry.rotations import rotation_matrix
from scm_world.models.scene import TOLERANCE, GoalRegion, Overlap, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.grasping.hand import deepest_kernel
from scm_world.tasks.trifinger.hardware import WALL_HEIGHT, WALL_RADIUS
from scm_world.tasks.trifinger.kinematics import forward, forward_kernel

BALLS_MARGIN = 1e-3  # [m] by which balls of two legs may be deeper in one another than capsules


def overlaps(scene: Scene, *, tolerance: float, enough: float = math.inf) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance.

    Compared are blocks with everything; the middle and lower links of different fingers with one
    another; both with the floor and obstacles; the tips with the ring. What has its center beyond
    the ring has left the arena, and lies in the stage: a block at any height, a tip below the
    upper end.

    Args:
        scene: With complete parameters.
        tolerance: How deep is too deep [m].
        enough: Where some lie deeper than this in one another, those alone may be listed [m].

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
    from scm_world.backends.mujoco import overlaps as engine

    found, state = engine.overlaps(scene, tolerance, enough=enough), scene.state
    if any(overlap.depth > enough for overlap in found):
        return found
    tips = forward(state.joint_positions, float(scene.parameters["robot", "height"])).reshape(3, 3)
    centers = np.vstack([state.positions, tips])
    beyond = np.hypot(centers[:, 0], centers[:, 1]) - WALL_RADIUS
    beyond[len(state.positions) :][tips[:, 2] > WALL_HEIGHT] = 0.0
    if beyond.max() <= tolerance:
        return found
    names = *scene.structure.blocks, *(hardware.link_name(f, 3) for f in hardware.FINGERS)
    deepest = {overlap.bodies: overlap.depth for overlap in found}
    for name, depth in zip(names, beyond.tolist(), strict=True):
        if depth > tolerance:
            deepest[name, "stage"] = max(depth, deepest.get((name, "stage"), 0.0))
    return tuple(Overlap(bodies, depth) for bodies, depth in deepest.items())


@njit(cache=True)
def clear(joints: Floats, heights: Floats, limit: float) -> NDArray[np.bool_]:
    """Return for each row of joints whether fingers may be clear of one another and of the ring.

    Args:
        joints: Shape (n, 9) [rad].
        heights: Of the robot, shape (n,) [m].
        limit: How deep is too deep where a link takes part [m]. Rows with True have to be looked at
            with ``overlaps``.
    """
    found, none = np.empty(len(joints), dtype=np.bool_), np.empty((0, 3))
    for row in range(len(joints)):
        tips, apart = forward_kernel(joints[row], heights[row]), True
        for x, y, z in tips.reshape(3, 3):
            apart &= z > WALL_HEIGHT or math.hypot(x, y) - WALL_RADIUS <= limit
        legs = np.empty((0, 3, 3))
        found[row] = apart and (
            deepest_kernel(joints[row], heights[row], none, none, legs) <= limit + BALLS_MARGIN
        )
    return found


def buried_goals(scene: Scene, names: Container[str]) -> tuple[Overlap, ...]:
    """List goals that lie deeper than ``TOLERANCE`` in an obstacle: nothing can ever fill them.

    Args:
        scene: With complete parameters.
        names: Of the goals to look at.
    """
    found, obstacles = list[Overlap](), scene.structure.obstacles
    goals = [goal for goal in scene.goals if obstacles and goal.name in names]
    for goal in (goal for goal in goals if goal.shape == "sphere"):
        inside = (Overlap((goal.name, o), _depth_in_box(goal, scene, o)) for o in obstacles)
        found += [overlap for overlap in inside if overlap.depth > TOLERANCE]
    solid = [goal for goal in goals if goal.shape != "sphere"]
    if solid:
        listed = overlaps(_filled(solid, scene.parameters, obstacles), tolerance=TOLERANCE)
        found += [overlap for overlap in listed if overlap.bodies[1] in obstacles]
    return tuple(found)


def _filled(
    goals: Sequence[GoalRegion], parameters: Mapping[Any, Any], obstacles: tuple[str, ...] = ()
) -> Scene:
    """Return a scene with blocks in the places of goals."""
    from scm_world.tasks.trifinger.system import trifinger  # it loads an engine

    hulls = tuple((goal.name, goal.hull) for goal in goals if goal.hull is not None)
    blocks = tuple(goal.name for goal in goals)
    scene = trifinger(blocks, obstacles=obstacles, hulls=hulls).default_scene()
    sizes = {(goal.name, "size"): goal.size for goal in goals if goal.hull is None}
    for pose, goal in zip(scene.state.blocks, goals, strict=True):
        pose[:3], pose[3:7] = goal.position, goal.orientation
    return scene.with_(parameters={**scene.parameters, **parameters, **sizes})


def _depth_in_box(goal: GoalRegion, scene: Scene, obstacle: str) -> float:
    """Measure how far a sphere would have to be moved out of an obstacle [m]."""
    size, place, turn = (
        scene.parameters[obstacle, what] for what in ("size", "position", "orientation")
    )
    beyond = np.abs((goal.position - place) @ rotation_matrix(turn)) - 0.5 * size
    distance = np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0)
    return 0.5 * float(goal.size[0]) - float(distance)


def fingers_reach(
    size: Floats, position: Floats, orientation: Floats, joints: Floats, height: float
) -> bool:
    """Return whether a finger lies in a box with these edges and this pose, at given joints."""
    box = GoalRegion("box", "box", size, position, orientation, color=np.zeros(3))
    scene = _filled([box], {("robot", "height"): height})
    scene.state.joint_positions[:] = joints
    found = overlaps(scene, tolerance=TOLERANCE)
    return any("box" in o.bodies and o.bodies[1] in hardware.LINK_NAMES for o in found)
