"""Where causes in the robot's world have a chance to show.

An edge that needs contact shows only where there is contact. So fingers move freely, and are
pressed against a block, on the floor and at the wall; blocks are in the air, at the wall, on one
another, in their goals, and where a further block or obstacle would come into being.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import InterventionError
from scm_world.tasks.base import Scenario
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import WALL_RADIUS
from scm_world.tasks.trifinger.kinematics import inverse
from scm_world.tasks.trifinger.types import parts_of

if TYPE_CHECKING:
    from scm_world.tasks.base import Simulation

TIP = hardware.COLLISION["tip"].radius  # [m]
CLEARANCE = 2e-4  # [m] how far apart bodies are put that are about to touch
LOOSE = 1.5e-3  # [m] the same for blocks on one another, which do not stand quite straight
HIGHEST = 6  # blocks that are stacked
REACH = 0.045  # [m] from here up all three fingers can press on something in the middle
ORIGIN = np.zeros(3)
PLACES = "obstacle_places"

Random = np.random.Generator
States = dict[str, Value]
Setting = tuple[States, Floats]
"""States to set, and the fingertip positions that the robot then drives at, shape (9,) [m]."""


# --- where fingers are --------------------------------------------------------------------------


def facing(rng: Random) -> Floats:
    """Return the direction in which each finger stands, with a little spread [rad]."""
    tips = np.array([[-0.05945, 0.15864], [0.16711, -0.02783], [-0.10766, -0.13080]])
    directions: Floats = np.arctan2(tips[:, 1], tips[:, 0]) + rng.uniform(-0.2, 0.2, 3)
    return directions


def around(middle: Floats, radius: float | Floats, angles: Floats, height: float) -> Floats:
    """Put three fingertips on a circle, or each at a radius of its own, shape (9,) [m]."""
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = np.full((3, 3), height)
    points[:, :2] = middle[:2] + ring * np.reshape(radius, (-1, 1))
    return points.ravel()


def present_tips(world: Simulation) -> Floats:
    """Return the fingertip positions, shape (9,) [m]."""
    return np.array(world["end_effector_positions"])


def joints_for(world: Simulation, tips: Floats) -> Floats:
    """Compute joint positions for fingertip positions, near the resting pose, shape (9,) [rad]."""
    return inverse(tips, float(world["robot_height"]), hardware.REST).joint_positions


def fingers_at(world: Simulation, rng: Random, tips: Floats) -> States:
    """Put the fingertips somewhere, and the blocks out of their way, unless it is not free."""
    states: States = {"joint_positions": joints_for(world, tips)}
    if not parts_of(world).obstacles:  # one may stand in the middle
        states |= stacked(world, rng, ORIGIN)
    return states


# --- where blocks are ---------------------------------------------------------------------------


def sizes(world: Simulation) -> Floats:
    """Return the edge lengths of the blocks that are stacked, shape (n, 3) [m]."""
    names = parts_of(world).blocks[:HIGHEST]
    return np.array([world[f"{name}.size"] for name in names]).reshape(-1, 3)


def top(world: Simulation, name: str) -> Floats:
    """Return the middle of the upper face of something upright [m]."""
    up = np.array([0.0, 0.0, world[f"{name}.size"][2] / 2])
    return np.asarray(world[f"{name}.cartesian_position"] + up)


def stacked(
    world: Simulation, rng: Random, foot: Floats, yaw: float = 0.0, count: int = HIGHEST
) -> States:
    """Stand the first blocks on one another above a point [m], not quite straight."""
    states, (*middle, bottom) = States(), foot
    for name, size in zip(parts_of(world).blocks, sizes(world)[:count], strict=False):
        place = middle + rng.uniform(-0.001, 0.001, 2)
        turn = yaw + rng.uniform(-0.05, 0.05)
        states[f"{name}.cartesian_position"] = np.array([*place, bottom + size[2] / 2])
        states[f"{name}.euler_orientation"] = np.array([0.0, 0.0, turn])
        bottom += size[2]
    return states


def pressed(
    world: Simulation, rng: Random, foot: Floats, yaw: float = 0.0, count: int = HIGHEST
) -> Setting:
    """Stack the first blocks and let the fingers press on one of them that they reach."""
    states, edges = stacked(world, rng, foot, yaw, count), sizes(world)[:count]
    middles = foot[2] + np.cumsum(edges[:, 2]) - edges[:, 2] / 2
    which = int(np.flatnonzero(middles >= min(REACH, middles[-1]))[0])
    height = float(middles[which]) + rng.uniform(-0.2, 0.2) * edges[which, 2]
    angles = facing(rng)
    across = np.abs(np.stack([np.cos(angles - yaw), np.sin(angles - yaw)], axis=-1))
    reach = ((edges[which, :2] / 2 + TIP + LOOSE) / np.maximum(across, 1e-9)).min(axis=-1)
    states["joint_positions"] = joints_for(world, around(foot, reach, angles, height))
    return states, around(foot, rng.uniform(0.0, 0.01), angles + 0.4, height - 0.01)


def somewhere(rng: Random, far: float, foot: Floats = ORIGIN) -> Floats:
    """Draw a point up to so far from another one along x and y [m]."""
    return np.array([*rng.uniform(-far, far, 2), 0.0]) + foot


# --- the robot, and one block -------------------------------------------------------------------


def free(world: Simulation, rng: Random) -> Setting:
    """Change nothing; the robot drives somewhere."""
    return {}, present_tips(world) + rng.uniform(-0.05, 0.05, 9)


def finger_on_floor(world: Simulation, rng: Random) -> Setting:
    """Put the fingertips on the floor and let them rub it."""
    angles, radius = facing(rng), rng.uniform(0.1, 0.13)
    states = fingers_at(world, rng, around(ORIGIN, radius, angles, TIP + CLEARANCE))
    return states, around(ORIGIN, radius - 0.02, angles + 0.2, -0.02)


def finger_at_wall(world: Simulation, rng: Random) -> Setting:
    """Put the fingertips at the ring wall and let them rub it."""
    angles, height = facing(rng), rng.uniform(0.08, 0.14)
    states = fingers_at(world, rng, around(ORIGIN, WALL_RADIUS - TIP - 3e-3, angles, height))
    return states, around(ORIGIN, WALL_RADIUS + 0.03, angles + 0.15, height + 0.02)


def fingers_together(world: Simulation, rng: Random) -> Setting:
    """Put the fingertips side by side in the middle and let them press on one another."""
    angles, middle = facing(rng), somewhere(rng, 0.02)
    height = rng.uniform(0.05, 0.1)
    states = fingers_at(world, rng, around(middle, 1.3 * TIP, angles, height))
    return states, around(middle, 0.0, angles, height + rng.uniform(-0.02, 0.02))


def touch(world: Simulation, rng: Random) -> Setting:
    """Stand the first block amid the fingers and let all three press on it."""
    return pressed(world, rng, somewhere(rng, 0.02), rng.uniform(-0.8, 0.8), count=1)


def block_in_air(world: Simulation, rng: Random) -> Setting:
    """Drop the first block, tumbling."""
    name = parts_of(world).blocks[0]
    states = {
        f"{name}.cartesian_position": somewhere(rng, 0.03, np.array([0.0, 0.0, 0.06])),
        f"{name}.euler_orientation": rng.uniform(-0.7, 0.7, 3),
        f"{name}.linear_velocity": rng.uniform(-0.3, 0.3, 3),
        f"{name}.angular_velocity": rng.uniform(-8.0, 8.0, 3),
    }
    return states, present_tips(world)


# --- all blocks ---------------------------------------------------------------------------------


def tower(world: Simulation, rng: Random) -> Setting:
    """Stand the blocks on one another and let the fingers press on one of them."""
    return pressed(world, rng, somewhere(rng, 0.01))


def on_obstacle(world: Simulation, rng: Random) -> Setting:
    """Stand the blocks on the first obstacle and let all three fingers press on one."""
    foot = top(world, parts_of(world).obstacles[0])
    return pressed(world, rng, somewhere(rng, 0.002, foot))


def block_at_wall(world: Simulation, rng: Random) -> Setting:
    """Slide the blocks along the wall, on one another."""
    size, names = sizes(world)[0], parts_of(world).blocks[:HIGHEST]
    angle = rng.uniform(-np.pi, np.pi)
    out, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    radius = np.sqrt((WALL_RADIUS - 3e-3) ** 2 - (size[1] / 2) ** 2) - size[0] / 2
    velocity = 0.6 * out + rng.uniform(0.2, 0.5) * along
    inward = 4e-3 if len(names) > 1 else 0.0  # they are not quite straight
    foot = np.array([*(radius - inward) * out, CLEARANCE])
    states = stacked(world, rng, foot, angle)
    states |= {f"{name}.linear_velocity": np.array([*velocity, 0.0]) for name in names}
    return states, present_tips(world)


def solved(world: Simulation, rng: Random) -> Setting:
    """Begin where the goal is fulfilled."""
    return world.task.solution(world.values()), present_tips(world)


def leaving(world: Simulation, rng: Random) -> Setting:
    """Begin where the goal is fulfilled, with the blocks on their way up."""
    states, tips = solved(world, rng)
    for name in parts_of(world).blocks:
        up = rng.uniform(0.4, 0.7)
        states[f"{name}.linear_velocity"] = np.array([*rng.uniform(-0.3, 0.3, 2), up])
    return states, tips


# --- what may come into being -------------------------------------------------------------------


def on_newcomer(world: Simulation, rng: Random) -> Setting:
    """Stand some blocks where a further one would come into being, and press on one of them.

    High towers may be out of the fingers' reach there, so how many there are is drawn.
    """
    some = 1 + int(rng.uniform(0.0, len(sizes(world))))
    return pressed(world, rng, _newcomer(world), count=some)


def all_on_newcomer(world: Simulation, rng: Random) -> Setting:
    """Stand all blocks where a further one would come into being; the robot stays where it is."""
    return stacked(world, rng, _newcomer(world)), present_tips(world)


def _newcomer(world: Simulation) -> Floats:
    """Return the top of a further body that would come into being [m]; if none, of the floor."""
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
    return ORIGIN


def on_coming_obstacle(world: Simulation, rng: Random) -> Setting:
    """Set the next obstacle into the middle, and press on blocks above it."""
    places, up = np.array(world[PLACES]), np.array([0.0, 0.0, numbers.OBSTACLE_SIZE[2]])
    middle = somewhere(rng, 0.01)
    places[len(parts_of(world).obstacles)] = middle + up / 2
    states, drive = pressed(world, rng, middle + up)
    return {PLACES: places, **states}, drive


def obstacle_ahead(world: Simulation, rng: Random) -> Setting:
    """Set obstacles, should there be any, to where the fingers are about to go."""
    tips, places = present_tips(world).reshape(3, 3), np.array(world[PLACES])
    inward = -tips * [1.0, 1.0, 0.0] / np.linalg.norm(tips[:, :2], axis=1, keepdims=True)
    each = bool(world.compiled.bundles)  # then it matters in front of which finger one comes
    ahead = tips + inward * (TIP + rng.uniform(0.0056, 0.008 if each else 0.006))
    places[:3] = np.roll(ahead, int(rng.uniform(0.0, 3.0)), axis=0) if each else ahead
    return {PLACES: places}, (tips + 0.05 * inward).ravel()


# --- which there are ----------------------------------------------------------------------------

STEPS: dict[Callable[[Simulation, Random], Setting], int] = {
    on_newcomer: 0,
    all_on_newcomer: 0,
    on_coming_obstacle: 0,
    obstacle_ahead: 0,
    block_at_wall: 0,  # a block hits the wall once
    block_in_air: 0,
    solved: 0,
    leaving: 1,  # a goal that is fulfilled is left in one step
}
"""How many control steps are taken after a state is prepared, where they are not drawn."""


def scenarios(world: Simulation) -> list[Scenario]:
    """List what can be tried in a world, the most telling first."""
    blocks, obstacles = parts_of(world).blocks, parts_of(world).obstacles
    several, places = len(blocks) > 1, PLACES in world.model
    found = [free, finger_on_floor, finger_at_wall, solved]
    if blocks:
        found = [tower] if several else []
        found += [touch, free, block_at_wall, finger_on_floor, tower if several else touch]
        found += [block_in_air, finger_at_wall, solved, leaving]
    if blocks and world.task.decided_by:
        found = [on_newcomer, all_on_newcomer, *found]
    if blocks and obstacles:
        found = [on_obstacle, *found]
    if blocks and places:
        found = [on_coming_obstacle, *found]
    if places:
        found.append(obstacle_ahead)
    if world.compiled.bundles and not blocks:  # else they act through blocks, too
        found.append(fingers_together)
    return [(prepare, driven, STEPS.get(prepare)) for prepare in found]


def driven(world: Simulation, drive: Floats, rng: Random) -> Floats:
    """Turn fingertip positions into an action of the world's mode, with a little variety."""
    if world.options.action_mode == "end_effector_positions":
        return np.asarray(drive + rng.uniform(-0.005, 0.005, 9))
    joints = joints_for(world, drive) + rng.uniform(-0.05, 0.05, 9)
    if world.options.action_mode == "joint_positions":
        return np.asarray(joints)
    return np.asarray(np.clip(5.0 * (joints - np.array(world["joint_positions"])), -0.3, 0.3))
