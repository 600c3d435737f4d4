"""Scenarios: the kinds of place in state space where causes have a chance to show.

An edge that needs contact shows only where there is contact. So besides free motion, fingers are
held against a block, on the floor and at the wall; blocks are in the air, at the wall, on one
another, in their goals, and where a further block or obstacle would come into being.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import InterventionError
from scm_world.queries.experiments.placing import (
    CLEARANCE,
    HIGHEST,
    TIP,
    Dice,
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
from scm_world.scene.scene import WALL_RADIUS
from scm_world.variables import catalogue as numbers
from scm_world.world import World

PLACES = "obstacle_places"


@final
@dataclass(frozen=True)
class Scenario:
    """A kind of probe.

    Attributes:
        prepare: Chooses what to set in a world that has just been reset.
        steps: How many control steps are taken before the experiments; drawn from 0 to 2 if None.
    """

    prepare: Callable[[World, Dice], Setting]
    steps: int | None = None

    @property
    def name(self) -> str:
        """How the probe came about."""
        return self.prepare.__name__


# --- one block, or none -------------------------------------------------------------------------


def touch(world: World, dice: Dice) -> Setting:
    """Stand the first block amid the fingers and let all three press on it."""
    middle = dice.between(-0.02, 0.02, 2)
    states, angles, _ = touched(world, dice, middle, 0.0, heights=(0.3, 0.8), yaw=0.8)
    center = np.array([*middle, 0.0])
    drive = around(center, dice.between(0.0, 0.02), angles + 0.4, dice.between(0.01, 0.06))
    return states, drive


def on_obstacle(world: World, dice: Dice) -> Setting:
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


def block_in_air(world: World, dice: Dice) -> Setting:
    """Let the first block fall and tumble."""
    name = world.composition.blocks[0]
    states = {
        f"{name}.cartesian_position": np.array([*dice.between(-0.03, 0.03, 2), 0.06]),
        f"{name}.euler_orientation": dice.between(-0.7, 0.7, 3),
        f"{name}.linear_velocity": dice.between(-0.3, 0.3, 3),
        f"{name}.angular_velocity": dice.between(-8.0, 8.0, 3),
    }
    return states, present_tips(world)


def free(world: World, dice: Dice) -> Setting:
    """Change nothing; the robot drives somewhere."""
    return {}, present_tips(world) + dice.between(-0.05, 0.05, 9)


def start(world: World, dice: Dice) -> Setting:
    """Change nothing; the robot stays where it is."""
    return {}, present_tips(world)


def finger_on_floor(world: World, dice: Dice) -> Setting:
    """Put the fingertips on the floor and let them rub it."""
    angles, center = facing(dice), np.zeros(3)
    radius = dice.between(0.1, 0.13)
    states = {"joint_positions": joints_for(world, around(center, radius, angles, TIP + CLEARANCE))}
    states.update(out_of_the_way(world, dice))
    return states, around(center, radius - 0.02, angles + 0.2, -0.02)


def finger_at_wall(world: World, dice: Dice) -> Setting:
    """Put the fingertips at the ring wall and let them rub it."""
    angles, center = facing(dice), np.zeros(3)
    inside = WALL_RADIUS - TIP - 3e-3
    height = dice.between(0.08, 0.14)
    states = {"joint_positions": joints_for(world, around(center, inside, angles, height))}
    states.update(out_of_the_way(world, dice))
    return states, around(center, WALL_RADIUS + 0.03, angles + 0.15, height + 0.02)


# --- all blocks ---------------------------------------------------------------------------------


def tower(world: World, dice: Dice) -> Setting:
    """Stand the blocks on one another and let the fingers press on one of them."""
    return pressed(world, dice, dice.between(-0.01, 0.01, 2), 0.0)


def block_at_wall(world: World, dice: Dice) -> Setting:
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


def solved(world: World, dice: Dice) -> Setting:
    """Begin where the goal is fulfilled."""
    return world.task.solution(world.values()), present_tips(world)


def leaving(world: World, dice: Dice) -> Setting:
    """Begin where the goal is fulfilled, with the blocks on their way up."""
    states = world.task.solution(world.values())
    for name in world.composition.blocks:
        up = dice.between(0.4, 0.7)
        states[f"{name}.linear_velocity"] = np.array([*dice.between(-0.3, 0.3, 2), up])
    return states, present_tips(world)


# --- what may come into being -------------------------------------------------------------------


def on_newcomer(world: World, dice: Dice) -> Setting:
    """Stand some blocks where a further one would come into being, and press on one of them.

    High towers may be out of the fingers' reach there, so how many there are is drawn.
    """
    place = _newcomer(world)
    if place is None:
        return tower(world, dice)
    some = 1 + int(dice.between(0.0, min(HIGHEST, len(world.composition.blocks))))
    return pressed(world, dice, place[:2], place[2], some)


def all_on_newcomer(world: World, dice: Dice) -> Setting:
    """Stand all blocks where a further one would come into being; the robot stays where it is."""
    place = _newcomer(world)
    if place is None:
        return tower(world, dice)
    return stacked(world, dice, place[:2], place[2]), present_tips(world)


def on_coming_obstacle(world: World, dice: Dice) -> Setting:
    """Say that the next obstacle comes to lie in the middle, and press on blocks above it."""
    places, here = np.array(world[PLACES]), len(world.composition.obstacles)
    edge = numbers.OBSTACLE_SIZE[2]
    middle = dice.between(-0.01, 0.01, 2)
    places[here] = [*middle, edge / 2]
    states, drive = pressed(world, dice, middle, edge)
    return {PLACES: places, **states}, drive


def obstacle_ahead(world: World, dice: Dice) -> Setting:
    """Say that obstacles, should there be any, are where the fingers are about to go."""
    tips = present_tips(world).reshape(3, 3)
    places = np.array(world[PLACES])
    inward = -tips * [1.0, 1.0, 0.0] / np.linalg.norm(tips[:, :2], axis=1, keepdims=True)
    places[:3] = tips + inward * (TIP + dice.between(0.0056, 0.006))
    return {PLACES: places}, (tips + 0.05 * inward).ravel()


def _newcomer(world: World) -> Floats | None:
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

_WITHOUT_BLOCKS = (
    Scenario(free),
    Scenario(finger_on_floor),
    Scenario(finger_at_wall),
    Scenario(solved, steps=0),
)
_WITH_BLOCK = (
    Scenario(touch),
    Scenario(free),
    Scenario(block_at_wall, steps=0),  # a block hits the wall once
    Scenario(finger_on_floor),
    Scenario(touch),
    Scenario(block_in_air, steps=0),
    Scenario(finger_at_wall),
    Scenario(solved, steps=0),
    Scenario(leaving, steps=1),  # a goal that is fulfilled is left in one step
)
_WITH_BLOCKS = (Scenario(tower), *_WITH_BLOCK[:4], Scenario(tower), *_WITH_BLOCK[5:])
AT_START = Scenario(start)
"""What is left where nothing else is feasible."""


def _by_blocks(count: int) -> tuple[Scenario, ...]:
    match count:
        case 0:
            return _WITHOUT_BLOCKS
        case 1:
            return _WITH_BLOCK
    return _WITH_BLOCKS


def scenarios(world: World) -> tuple[Scenario, ...]:
    """List what can be tried in a world, the most telling first."""
    made = world.composition
    found = _by_blocks(len(made.blocks))
    if made.blocks and world.task.decided_by:
        found = (Scenario(on_newcomer, steps=0), Scenario(all_on_newcomer, steps=0), *found)
    if made.blocks and made.obstacles:
        found = (Scenario(on_obstacle), *found)
    if PLACES not in world.model:
        return found
    if made.blocks:
        found = (Scenario(on_coming_obstacle, steps=0), *found)
    return (*found, Scenario(obstacle_ahead, steps=0))
