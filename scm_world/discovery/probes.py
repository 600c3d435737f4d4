"""Probe states: places in state space where causes have a chance to show.

An edge that needs contact shows only where there is contact. So besides free motion the probes
hold fingers against a block, on the floor and at the wall, and blocks in the air and at the wall.
All choices are drawn from keyed noise: probe i of a seed is the same, whatever ran before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.errors import InterventionError
from scm_world.scene import trifinger
from scm_world.scene.kinematics import inverse
from scm_world.scene.scene import WALL_RADIUS
from scm_world.variables import Noise
from scm_world.world import World, WorldSnapshot

TIP = trifinger.COLLISION["tip"].radius  # [m]
CLEARANCE = 2e-4  # [m] how far apart bodies are put that are about to touch
HIGHEST = 6  # blocks that are stacked
REACH = 0.045  # [m] from here up all three fingers can press on something in the middle
_DRAWS = 96


@final
class Dice:
    """The random numbers of one probe.

    Args:
        noise: The seed's noise.
        probe: Number of the probe.
        attempt: Counts up where a choice was not feasible.
    """

    def __init__(self, noise: Noise, probe: int, attempt: int = 0) -> None:
        self._numbers = noise.uniforms("probe", n=_DRAWS, episode=probe, step=attempt)[0]
        self._used = 0

    def between(self, low: float, high: float, n: int | None = None) -> Any:
        """Draw one number, or an array of ``n``."""
        count = 1 if n is None else n
        drawn = self._numbers[self._used : self._used + count]
        self._used += count
        scaled = low + (high - low) * drawn
        return float(scaled[0]) if n is None else scaled


@final
@dataclass(frozen=True)
class Probe:
    """A state to experiment in.

    Attributes:
        kind: How it came about.
        snapshot: Of the world.
        action: What the robot does next, shape (9,).
    """

    kind: str
    snapshot: WorldSnapshot
    action: Floats


Setting = tuple[dict[str, Value], Floats]
"""States to set, and the fingertip positions that the robot then drives at, shape (9,) [m]."""


def _sizes(world: World) -> Floats:
    return np.array([world[f"{name}.size"] for name in world.composition.blocks]).reshape(-1, 3)


def _around(center: Floats, radius: float, angles: Floats, height: float) -> Floats:
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=-1) * radius
    points: Floats = center + ring
    points[:, 2] = height
    return points.ravel()


def _facing(dice: Dice) -> Floats:
    """Give the direction in which each finger stands, with a little spread [rad]."""
    tips = np.array([[-0.05945, 0.15864], [0.16711, -0.02783], [-0.10766, -0.13080]])
    directions: Floats = np.arctan2(tips[:, 1], tips[:, 0]) + dice.between(-0.2, 0.2, 3)
    return directions


def touch(world: World, dice: Dice) -> Setting:
    """Stand the block amid the fingers and let all three press on it."""
    size = _sizes(world)[0]
    name = world.composition.blocks[0]
    place = np.array([*dice.between(-0.02, 0.02, 2), size[2] / 2])
    angles = _facing(dice)
    reach = float(np.hypot(size[0], size[1])) / 2 + TIP + CLEARANCE
    height = dice.between(0.3, 0.8) * size[2]
    states = {
        f"{name}.cartesian_position": place,
        f"{name}.euler_orientation": np.array([0.0, 0.0, dice.between(-0.8, 0.8)]),
        "joint_positions": _joints(world, _around(place, reach, angles, height)),
    }
    drive = _around(place, dice.between(0.0, 0.02), angles + 0.4, dice.between(0.01, 0.06))
    return states, drive


def tower(world: World, dice: Dice) -> Setting:
    """Stand the blocks on one another and let the fingers press on one of them."""
    return _pressed(world, dice, dice.between(-0.01, 0.01, 2), 0.0)


def on_newcomer(world: World, dice: Dice) -> Setting:
    """Stand the blocks where a further one would come into being, as if it were there already."""
    place = _newcomer(world)
    return tower(world, dice) if place is None else _pressed(world, dice, place[:2], place[2])


def _newcomer(world: World) -> Floats | None:
    """Find where a further block or obstacle would be: its middle and its top, shape (3,) [m]."""
    start = world.snapshot()
    for request in world.task.nearby(world.values()):
        try:
            came = world.do(request).came
        except InterventionError:
            continue
        if came:
            center, size = world[f"{came[-1]}.cartesian_position"], world[f"{came[-1]}.size"]
            world.restore(start)
            return np.array([center[0], center[1], center[2] + size[2] / 2])
        world.restore(start)
    return None


def _pressed(world: World, dice: Dice, middle: Floats, bottom: float) -> Setting:
    """Stack the blocks and let the fingers press on one of them that they reach."""
    sizes = _sizes(world)[:HIGHEST]
    states = _stacked(world, dice, middle, bottom)
    middles = bottom + np.cumsum(sizes[:, 2]) - sizes[:, 2] / 2
    pressed = int(np.flatnonzero(middles >= min(REACH, middles[-1]))[0])
    height = float(middles[pressed]) + dice.between(-0.2, 0.2) * sizes[pressed, 2]
    center, angles = np.array([*middle, 0.0]), _facing(dice)
    reach = float(np.hypot(*sizes[pressed, :2])) / 2 + TIP + CLEARANCE
    states["joint_positions"] = _joints(world, _around(center, reach, angles, height))
    return states, _around(center, dice.between(0.0, 0.01), angles + 0.4, height - 0.01)


def _stacked(
    world: World, dice: Dice, middle: Floats, bottom: float, yaw: float = 0.0
) -> dict[str, Value]:
    """Stand the blocks on one another, not quite straight."""
    states: dict[str, Value] = {}
    for name, size in zip(world.composition.blocks[:HIGHEST], _sizes(world), strict=False):
        place = middle + dice.between(-0.001, 0.001, 2)
        turn = yaw + dice.between(-0.05, 0.05)
        states[f"{name}.cartesian_position"] = np.array([*place, bottom + size[2] / 2])
        states[f"{name}.euler_orientation"] = np.array([0.0, 0.0, turn])
        bottom += size[2]
    return states


def on_obstacle(world: World, dice: Dice) -> Setting:
    """Stand the block on an obstacle and let all three fingers press on it."""
    obstacle, name, size = (
        world.composition.obstacles[0],
        world.composition.blocks[0],
        _sizes(world)[0],
    )
    middle = world[f"{obstacle}.cartesian_position"]
    bottom = float(middle[2] + world[f"{obstacle}.size"][2] / 2)
    place = np.array([*(middle[:2] + dice.between(-0.002, 0.002, 2)), bottom + size[2] / 2])
    angles = _facing(dice)
    reach = float(np.hypot(size[0], size[1])) / 2 + TIP + CLEARANCE
    height = bottom + dice.between(0.4, 0.7) * size[2]
    states = {
        f"{name}.cartesian_position": place,
        f"{name}.euler_orientation": np.array([0.0, 0.0, dice.between(-0.1, 0.1)]),
        "joint_positions": _joints(world, _around(place, reach, angles, height)),
    }
    return states, _around(place, dice.between(0.0, 0.02), angles + 0.4, height - 0.02)


def obstacle_ahead(world: World, dice: Dice) -> Setting:
    """Say that obstacles, should there be any, are where the fingers are about to go."""
    tips = np.array(world["end_effector_positions"]).reshape(3, 3)
    places = np.array(world["obstacle_places"])
    inward = -tips * [1.0, 1.0, 0.0] / np.linalg.norm(tips[:, :2], axis=1, keepdims=True)
    places[:3] = tips + inward * (TIP + dice.between(0.0056, 0.006))
    return {"obstacle_places": places}, (tips + 0.05 * inward).ravel()


def finger_on_floor(world: World, dice: Dice) -> Setting:
    """Put the fingertips on the floor and let them rub it."""
    angles = _facing(dice)
    radius = dice.between(0.1, 0.13)
    center = np.zeros(3)
    states = {"joint_positions": _joints(world, _around(center, radius, angles, TIP + CLEARANCE))}
    states.update(_out_of_the_way(world, dice))
    return states, _around(center, radius - 0.02, angles + 0.2, -0.02)


def finger_at_wall(world: World, dice: Dice) -> Setting:
    """Put the fingertips at the ring wall and let them rub it."""
    angles = _facing(dice)
    center = np.zeros(3)
    inside = WALL_RADIUS - TIP - 3e-3
    height = dice.between(0.08, 0.14)
    states = {"joint_positions": _joints(world, _around(center, inside, angles, height))}
    states.update(_out_of_the_way(world, dice))
    return states, _around(center, WALL_RADIUS + 0.03, angles + 0.15, height + 0.02)


def block_at_wall(world: World, dice: Dice) -> Setting:
    """Let the blocks slide along the wall, on one another."""
    size = _sizes(world)[0]
    angle = dice.between(-np.pi, np.pi)
    out, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    radius = np.sqrt((WALL_RADIUS - 3e-3) ** 2 - (size[1] / 2) ** 2) - size[0] / 2
    velocity = 0.6 * out + dice.between(0.2, 0.5) * along
    several = len(world.composition.blocks) > 1
    inward = 4e-3 if several else 0.0  # they are not quite straight
    states = _stacked(world, dice, (radius - inward) * out, CLEARANCE, angle)
    for name in world.composition.blocks[:HIGHEST]:
        states[f"{name}.linear_velocity"] = np.array([*velocity, 0.0])
    return states, _rest_tips(world)


def block_in_air(world: World, dice: Dice) -> Setting:
    """Let the block fall and tumble."""
    name = world.composition.blocks[0]
    states = {
        f"{name}.cartesian_position": np.array([*dice.between(-0.03, 0.03, 2), 0.06]),
        f"{name}.euler_orientation": dice.between(-0.7, 0.7, 3),
        f"{name}.linear_velocity": dice.between(-0.3, 0.3, 3),
        f"{name}.angular_velocity": dice.between(-8.0, 8.0, 3),
    }
    return states, _rest_tips(world)


def solved(world: World, dice: Dice) -> Setting:
    """Begin where the goal is fulfilled."""
    return world.task.solution(world.values()), _rest_tips(world)


def leaving(world: World, dice: Dice) -> Setting:
    """Begin where the goal is fulfilled, with the blocks on their way up."""
    states = world.task.solution(world.values())
    for name in world.composition.blocks:
        up = dice.between(0.4, 0.7)
        states[f"{name}.linear_velocity"] = np.array([*dice.between(-0.3, 0.3, 2), up])
    return states, _rest_tips(world)


def free(world: World, dice: Dice) -> Setting:
    """Change nothing; the robot drives somewhere."""
    tips = np.array(world["end_effector_positions"])
    return {}, tips + dice.between(-0.05, 0.05, 9)


def _rest_tips(world: World) -> Floats:
    return np.array(world["end_effector_positions"])


def _joints(world: World, tips: Floats) -> Floats:
    near = np.array(trifinger.REST)
    return inverse(tips, float(world["robot_height"]), near).joint_positions


def _out_of_the_way(world: World, dice: Dice) -> dict[str, Value]:
    """Stack the blocks in the middle, unless an obstacle may stand there."""
    if world.composition.obstacles:
        return {}
    return _stacked(world, dice, np.zeros(2), 0.0)


_WITH_BLOCKS: tuple[Callable[[World, Dice], Setting], ...] = (
    touch,
    free,
    block_at_wall,
    finger_on_floor,
    touch,
    block_in_air,
    finger_at_wall,
    solved,
    leaving,
)
_WITHOUT_BLOCKS: tuple[Callable[[World, Dice], Setting], ...] = (
    free,
    finger_on_floor,
    finger_at_wall,
    solved,
)


def _scenarios(world: World) -> tuple[Callable[[World, Dice], Setting], ...]:
    """List what can be tried in a world, the most telling first."""
    made = world.composition
    found = _WITH_BLOCKS if made.blocks else _WITHOUT_BLOCKS
    if len(made.blocks) > 1:
        found = (tower, *found)
    if made.blocks and world.task.decided_by:
        found = (on_newcomer, *found)
    if made.blocks and made.obstacles:
        found = (on_obstacle, *found)
    return (*found, obstacle_ahead) if "obstacle_places" in world.model else found


_STEPS = {
    **dict.fromkeys(
        (s.__name__ for s in (solved, block_at_wall, block_in_air, obstacle_ahead, on_newcomer)), 0
    ),
    leaving.__name__: 1,
}
"""How many steps to take where that matters: a block hits the wall once, and a goal that is
fulfilled is left in one step."""


def probes(world: World, n: int, seed: int) -> Iterator[Probe]:
    """Prepare probe states one after another.

    Args:
        world: To experiment with; it is reset for each probe.
        n: How many.
        seed: Of the choices.
    """
    noise = Noise(seed)
    world.reset(seed=seed)
    kinds = _scenarios(world)
    for number in range(n):
        yield _prepare(world, kinds[number % len(kinds)], noise, number)


def _prepare(
    world: World, scenario: Callable[[World, Dice], Setting], noise: Noise, number: int
) -> Probe:
    for attempt in range(20):
        dice = Dice(noise, number, attempt)
        world.reset(seed=number)
        try:
            states, drive = scenario(world, dice)
            world.do(states)
        except InterventionError:
            continue
        return _settle(world, scenario.__name__, drive, dice)
    world.reset(seed=number)
    return _settle(world, "start", _rest_tips(world), Dice(noise, number))


def _settle(world: World, kind: str, drive: Floats, dice: Dice) -> Probe:
    action = _command(world, drive, dice)
    steps = round(dice.between(0.0, 2.0))
    if kind in _STEPS:
        steps = _STEPS[kind]
    for _ in range(steps):
        world.step(action)
    return Probe(kind, world.snapshot(), _command(world, drive, dice))


def _command(world: World, drive: Floats, dice: Dice) -> Floats:
    """Turn fingertip positions into an action of the world's mode, with a little variety."""
    if world.action_mode == "end_effector_positions":
        return np.asarray(drive + dice.between(-0.005, 0.005, 9))
    joints = _joints(world, drive) + dice.between(-0.05, 0.05, 9)
    if world.action_mode == "joint_positions":
        return np.asarray(joints)
    return np.asarray(np.clip(5.0 * (joints - np.array(world["joint_positions"])), -0.3, 0.3))
