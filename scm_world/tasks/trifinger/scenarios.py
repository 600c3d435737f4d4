"""Where causes in the robot's world have a chance to show.

An edge that needs contact shows only where there is contact. So besides free motion, fingers are
held against a block, on the floor and at the wall; blocks are in the air, at the wall, on one
another, in their goals, and where a further block or obstacle would come into being.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scm_world._types import Floats
from scm_world.errors import InterventionError
from scm_world.tasks.experiments import Dice, Scenario
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.placing import (
    CLEARANCE,
    HIGHEST,
    TIP,
    Setting,
    around,
    facing,
    joints_for,
    out_of_the_way,
    present_tips,
    pressed,
    sizes,
    stacked,
    top,
    touched,
)
from scm_world.tasks.trifinger.structure import WALL_RADIUS

PLACES = "obstacle_places"


# --- one block, or none -------------------------------------------------------------------------


def touch(world: Any, dice: Dice) -> Setting:
    """Stand the first block amid the fingers and let all three press on it."""
    middle = dice.between(-0.02, 0.02, 2)
    states, angles, _ = touched(world, dice, middle, 0.0, heights=(0.3, 0.8), yaw=0.8)
    center = np.array([*middle, 0.0])
    drive = around(center, dice.between(0.0, 0.02), angles + 0.4, dice.between(0.01, 0.06))
    return states, drive


def on_obstacle(world: Any, dice: Dice) -> Setting:
    """Stand the blocks on the first obstacle and let all three fingers press on one."""
    obstacle = world.composition.obstacles[0]
    center = world[f"{obstacle}.cartesian_position"]
    bottom = float(center[2] + world[f"{obstacle}.size"][2] / 2)
    middle = center[:2] + dice.between(-0.002, 0.002, 2)
    if len(world.composition.blocks) > 1:
        return pressed(world, dice, middle, bottom)
    states, angles, height = touched(world, dice, middle, bottom, heights=(0.4, 0.7), yaw=0.1)
    center = np.array([*middle, 0.0])
    return states, around(center, dice.between(0.0, 0.02), angles + 0.4, height - 0.02)


def block_in_air(world: Any, dice: Dice) -> Setting:
    """Let the first block fall and tumble."""
    name = world.composition.blocks[0]
    states = {
        f"{name}.cartesian_position": np.array([*dice.between(-0.03, 0.03, 2), 0.06]),
        f"{name}.euler_orientation": dice.between(-0.7, 0.7, 3),
        f"{name}.linear_velocity": dice.between(-0.3, 0.3, 3),
        f"{name}.angular_velocity": dice.between(-8.0, 8.0, 3),
    }
    return states, present_tips(world)


def free(world: Any, dice: Dice) -> Setting:
    """Change nothing; the robot drives somewhere."""
    return {}, present_tips(world) + dice.between(-0.05, 0.05, 9)


def finger_on_floor(world: Any, dice: Dice) -> Setting:
    """Put the fingertips on the floor and let them rub it."""
    angles, center = facing(dice), np.zeros(3)
    radius = dice.between(0.1, 0.13)
    states = {"joint_positions": joints_for(world, around(center, radius, angles, TIP + CLEARANCE))}
    states.update(out_of_the_way(world, dice))
    return states, around(center, radius - 0.02, angles + 0.2, -0.02)


def finger_at_wall(world: Any, dice: Dice) -> Setting:
    """Put the fingertips at the ring wall and let them rub it."""
    angles, center = facing(dice), np.zeros(3)
    inside = WALL_RADIUS - TIP - 3e-3
    height = dice.between(0.08, 0.14)
    states = {"joint_positions": joints_for(world, around(center, inside, angles, height))}
    states.update(out_of_the_way(world, dice))
    return states, around(center, WALL_RADIUS + 0.03, angles + 0.15, height + 0.02)


def fingers_together(world: Any, dice: Dice) -> Setting:
    """Put the fingertips side by side in the middle and let them press on one another."""
    angles, center = facing(dice), np.array([*dice.between(-0.02, 0.02, 2), 0.0])
    radius, height = 1.3 * TIP, dice.between(0.05, 0.1)
    states = {"joint_positions": joints_for(world, around(center, radius, angles, height))}
    states.update(out_of_the_way(world, dice))
    return states, around(center, 0.0, angles, height + dice.between(-0.02, 0.02))


# --- all blocks ---------------------------------------------------------------------------------


def tower(world: Any, dice: Dice) -> Setting:
    """Stand the blocks on one another and let the fingers press on one of them."""
    return pressed(world, dice, dice.between(-0.01, 0.01, 2), 0.0)


def block_at_wall(world: Any, dice: Dice) -> Setting:
    """Let the blocks slide along the wall, on one another."""
    size = sizes(world)[0]
    angle = dice.between(-np.pi, np.pi)
    out, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    radius = np.sqrt((WALL_RADIUS - 3e-3) ** 2 - (size[1] / 2) ** 2) - size[0] / 2
    velocity = 0.6 * out + dice.between(0.2, 0.5) * along
    several = len(world.composition.blocks) > 1
    inward = 4e-3 if several else 0.0  # they are not quite straight
    states = stacked(world, dice, (radius - inward) * out, CLEARANCE, angle)
    for name in world.composition.blocks[:HIGHEST]:
        states[f"{name}.linear_velocity"] = np.array([*velocity, 0.0])
    return states, present_tips(world)


def solved(world: Any, dice: Dice) -> Setting:
    """Begin where the goal is fulfilled."""
    return world.task.solution(world.values()), present_tips(world)


def leaving(world: Any, dice: Dice) -> Setting:
    """Begin where the goal is fulfilled, with the blocks on their way up."""
    states = world.task.solution(world.values())
    for name in world.composition.blocks:
        up = dice.between(0.4, 0.7)
        states[f"{name}.linear_velocity"] = np.array([*dice.between(-0.3, 0.3, 2), up])
    return states, present_tips(world)


# --- what may come into being -------------------------------------------------------------------


def on_newcomer(world: Any, dice: Dice) -> Setting:
    """Stand some blocks where a further one would come into being, and press on one of them.

    High towers may be out of the fingers' reach there, so how many there are is drawn.
    """
    place = _newcomer(world)
    if place is None:
        return tower(world, dice)
    some = 1 + int(dice.between(0.0, min(HIGHEST, len(world.composition.blocks))))
    return pressed(world, dice, place[:2], place[2], some)


def all_on_newcomer(world: Any, dice: Dice) -> Setting:
    """Stand all blocks where a further one would come into being; the robot stays where it is."""
    place = _newcomer(world)
    if place is None:
        return tower(world, dice)
    return stacked(world, dice, place[:2], place[2]), present_tips(world)


def on_coming_obstacle(world: Any, dice: Dice) -> Setting:
    """Say that the next obstacle comes to lie in the middle, and press on blocks above it."""
    places, here = np.array(world[PLACES]), len(world.composition.obstacles)
    edge = numbers.OBSTACLE_SIZE[2]
    middle = dice.between(-0.01, 0.01, 2)
    places[here] = [*middle, edge / 2]
    states, drive = pressed(world, dice, middle, edge)
    return {PLACES: places, **states}, drive


def obstacle_ahead(world: Any, dice: Dice) -> Setting:
    """Say that obstacles, should there be any, are where the fingers are about to go."""
    tips = present_tips(world).reshape(3, 3)
    places = np.array(world[PLACES])
    inward = -tips * [1.0, 1.0, 0.0] / np.linalg.norm(tips[:, :2], axis=1, keepdims=True)
    each = bool(world.compiled.bundles)  # then it matters in front of which finger one comes
    ahead = tips + inward * (TIP + dice.between(0.0056, 0.008 if each else 0.006))
    places[:3] = np.roll(ahead, int(dice.between(0.0, 3.0)), axis=0) if each else ahead
    return {PLACES: places}, (tips + 0.05 * inward).ravel()


def _newcomer(world: Any) -> Floats | None:
    """Find where a further block or obstacle would be: its middle and its top, shape (3,) [m]."""
    before = world.snapshot()
    for request in world.task.nearby(world.values()):
        try:
            came = world.do(request).came
        except InterventionError:
            continue
        found = top(world, came[-1]) if came else None
        world.restore(before)
        if found is not None:
            return found
    return None


# --- which there are ----------------------------------------------------------------------------

Kind = tuple[Callable[[Any, Dice], Setting], int | None]
"""How a state is prepared, and how many control steps are then taken; see ``Scenario``."""

_WITHOUT_BLOCKS: tuple[Kind, ...] = (
    (free, None),
    (finger_on_floor, None),
    (finger_at_wall, None),
    (solved, 0),
)
_WITH_BLOCK: tuple[Kind, ...] = (
    (touch, None),
    (free, None),
    (block_at_wall, 0),  # a block hits the wall once
    (finger_on_floor, None),
    (touch, None),
    (block_in_air, 0),
    (finger_at_wall, None),
    (solved, 0),
    (leaving, 1),  # a goal that is fulfilled is left in one step
)
_WITH_BLOCKS: tuple[Kind, ...] = (
    (tower, None),
    *_WITH_BLOCK[:4],
    (tower, None),
    *_WITH_BLOCK[5:],
)


def scenarios(world: Any) -> tuple[Scenario, ...]:
    """List what can be tried in a world, the most telling first."""
    made = world.composition
    found = (_WITHOUT_BLOCKS, _WITH_BLOCK, _WITH_BLOCKS)[min(2, len(made.blocks))]
    if made.blocks and world.task.decided_by:
        found = ((on_newcomer, 0), (all_on_newcomer, 0), *found)
    if made.blocks and made.obstacles:
        found = ((on_obstacle, None), *found)
    if PLACES in world.model and made.blocks:
        found = ((on_coming_obstacle, 0), *found)
    if PLACES in world.model:
        found = (*found, (obstacle_ahead, 0))
    if world.compiled.bundles and not made.blocks:  # else they act through blocks, too
        found = (*found, (fingers_together, None))
    return tuple(Scenario(prepare.__name__, prepare, driven, steps) for prepare, steps in found)


def driven(world: Any, drive: Floats, dice: Dice) -> Floats:
    """Turn fingertip positions into an action of the world's mode, with a little variety."""
    if world.action_mode == "end_effector_positions":
        return np.asarray(drive + dice.between(-0.005, 0.005, 9))
    joints = joints_for(world, drive) + dice.between(-0.05, 0.05, 9)
    if world.action_mode == "joint_positions":
        return np.asarray(joints)
    return np.asarray(np.clip(5.0 * (joints - np.array(world["joint_positions"])), -0.3, 0.3))
