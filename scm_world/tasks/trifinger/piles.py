"""Piles: where blocks come to lie that are dropped one after another."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from scm_world._types import Floats, Value
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.models import Difference, Scene
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.entities.blocks import lowest_point

MOST = 9
SHAPE = (MOST, 7)
ENGINE = "mujoco"

FALL = 0.8  # [s] that each block is given
AWAY = 2.0  # [m] height of the robot in the simulation: nothing reaches it
SKY = 100.0  # [m] where blocks wait

_NOBODY = (0.0, 0.0, 0.0, *numbers.IDENTITY)


def pile(
    count: Value,
    size: Value,
    mass: Value,
    positions: Floats,
    orientations: Floats,
    gravity: Floats,
    floor_friction: Value,
    *frictions: Value,
) -> Floats:
    """Drop blocks one after another, and find where they lie 0.8 s after the last.

    Simulate on MuJoCo for every backend of the world: one seed gives one goal everywhere.
    There is no robot in reach; what is not an argument here has its default. A block that would
    begin in the floor or in another block begins above it. Blocks that leave the arena (gravity
    may point anywhere) are put at its border. Orientations are rotation vectors [rad]; not more
    blocks are dropped than there are frictions.

    Returns:
        Position [m] and quaternion (x, y, z, w) of each block, shape (..., MOST, 7); zero and
        the identity for those that there are not.

    Raises:
        MissingEngine: MuJoCo is not installed.
    """
    signature = "(),(),(),(n,k),(n,k),(k),(),(f)->(n,p)"
    together = np.stack(np.broadcast_arrays(*frictions), axis=-1)
    each = np.vectorize(_pile, signature=signature)
    return np.asarray(
        each(count, size, mass, positions, orientations, gravity, floor_friction, together)
    )


def _pile(
    count: Value,
    size: Value,
    mass: Value,
    positions: Floats,
    orientations: Floats,
    gravity: Floats,
    floor_friction: Value,
    frictions: Floats,
) -> Floats:
    n = min(int(count), len(frictions))  # no more than there are
    lone = np.array([size, mass, floor_friction, *gravity], dtype=np.float64)
    each = np.column_stack([positions[:n], orientations[:n], frictions[:n]])
    found = np.tile(_NOBODY, (len(positions), 1))
    found[:n] = np.frombuffer(_dropped(lone.tobytes(), each.tobytes())).reshape(n, 7)
    return found


@lru_cache(maxsize=512)
def _dropped(lone: bytes, each: bytes) -> bytes:
    """Simulate a pile once, and cache it: poses of the blocks, shape (n, 7)."""
    from scm_world.backends import make_backend  # these load an engine
    from scm_world.tasks.trifinger.system import trifinger

    size, mass, floor, *gravity = np.frombuffer(lone).tolist()
    drops = np.frombuffer(each).reshape(-1, 7)
    names = tuple(f"block_{index}" for index in range(len(drops)))
    structure = trifinger(names)
    common = {("world", "gravity"): gravity, ("floor", "friction"): floor}
    common[("robot", "height")] = AWAY
    for name, drop in zip(names, drops, strict=True):
        common |= {(name, "size"): [size] * 3, (name, "mass"): mass, (name, "friction"): drop[6]}
    changed = {key: np.asarray(value, dtype=np.float64) for key, value in common.items()}
    rest: Any = structure.empty_state()  # all blocks are in the sky, far from one another
    rest.joint_positions[:] = hardware.RAISED
    rest.positions[:, 0] = 10.0 * np.arange(len(names))
    rest.positions[:, 2] = SKY
    state, substeps = rest.copy(), round(FALL / structure.preset.timestep)
    engine = make_backend(ENGINE)
    engine.build(Scene(structure, structure.default_parameters() | changed, rest))
    for index, drop in enumerate(drops):
        state.vector[:27] = rest.vector[:27]
        state.blocks[index:] = rest.blocks[index:]
        state.orientations[index] = turned = from_rotation_vector(drop[3:6])
        low = lowest_point(np.full(3, size), turned)
        state.positions[index] = _lifted(drop[:3], low, state.positions[:index], size)
        engine.apply(Difference(state=state.copy()))
        engine.step(rest.joint_positions, substeps)
        engine.read(state)
    engine.close()
    inside = np.clip(state.positions, *numbers.POSITION_BOUNDS.bounds((3,), {}))
    return np.concatenate([inside, state.orientations], axis=1).tobytes()


def _lifted(place: Floats, low: float, there: Floats, size: float) -> Floats:
    """Raise a block until it is above the floor and clear of those that lie there.

    ``low`` is how far it reaches below its center [m], and ``there`` has the centers of the others.
    """
    x, y, z = place.tolist()
    height, reach = max(z, low), np.sqrt(3.0) * size
    near = there[np.hypot(there[:, 0] - x, there[:, 1] - y) < reach]
    for other in sorted(near[:, 2].tolist()):
        if abs(height - other) < reach:
            height = other + reach
    return np.array([x, y, height])


def part_of(found: Floats, *, index: float) -> Floats:
    """Return the position of a block of a pile, shape (..., 3) [m]."""
    return found[..., int(index), :3]


def turn_of(found: Floats, *, index: float) -> Floats:
    """Return the quaternion of a block of a pile, made a unit one, shape (..., 4)."""
    return numbers.QUATERNION_BOUNDS.nearest(found[..., int(index), 3:])
