"""General: put blocks where others came to lie that were dropped one after another."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from typing import Unpack, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.models import Difference, Scene
from scm_world.tasks.composition import Entity
from scm_world.tasks.rewards import Common
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.building import MASS, Building, Part, Piece, blocks_mass
from scm_world.tasks.trifinger.entities.bodies import lowest_point
from scm_world.variables import Box, Derived, Function

COUNT = "nums_objects"
SIZE = "tool_block_size"
PLACES = "drop_positions"
TURNS = "drop_orientations"
PILE = "pile"

DROPS = (
    (0.1, 0.1, 0.2),
    (0.0, 0.0, 0.2),
    (0.05, 0.05, 0.3),
    (-0.05, -0.05, 0.1),
    (-0.12, -0.12, 0.2),
    (-0.12, 0.12, 0.2),
    (0.12, -0.10, 0.3),
    (0.09, -0.08, 0.1),
)
"""Where blocks are let go by default, in turn [m]."""
REGION = ((-0.11, -0.11, 0.0), (0.11, 0.11, 0.22))  # [m] where they are let go in A and B

STARTS = ((1, -1), (-1, 1), (0, -1), (1, 0), (-1, 0), (0, 1), (-1, -1), (1, 1), (0, 0))
"""Where blocks begin, in steps along x and y: first where the default drops are not."""
STEP = 0.11  # [m]

MOST = 9
SHAPE = (MOST, 7)
FALL = 0.8  # [s] that each block is given
AWAY = 2.0  # [m] height of the robot in the simulation: nothing reaches it
SKY = 100.0  # [m] where blocks wait


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
    The robot is out of reach; everything else has its default. A block that would begin
    in the floor or in another block begins above it. Blocks that leave the arena (gravity
    may point anywhere) are put at its border. Orientations are rotation vectors [rad]; not more
    blocks are dropped than there are frictions.

    Returns:
        Position [m] and quaternion (x, y, z, w) of each block, shape (..., MOST, 7); zero and
        the identity for those that there are not.

    Raises:
        MissingEngine: MuJoCo is not installed.
    """

    def one(count: Value, *causes: Floats) -> Floats:
        *lone, places, turns, each = causes
        n = min(int(count), len(each))
        drops = np.column_stack([places[:n], turns[:n], each[:n]])
        poses = _dropped(np.hstack(lone).astype(float).tobytes(), drops.tobytes())
        found = np.tile((0.0, 0.0, 0.0, *numbers.IDENTITY), (len(places), 1))
        found[:n] = np.frombuffer(poses).reshape(n, 7)
        return found

    together = np.stack(np.broadcast_arrays(*frictions), axis=-1)
    alone = count, size, mass, floor_friction, gravity
    each = np.vectorize(one, signature="(),(),(),(),(k),(n,k),(n,k),(f)->(n,p)")
    return np.asarray(each(*alone, positions, orientations, together))


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
    rest = structure.empty_state()  # all blocks are in the sky, far from one another
    rest.joint_positions[:] = hardware.RAISED
    rest.positions[:, 0] = 10.0 * np.arange(len(names))
    rest.positions[:, 2] = SKY
    state, substeps = rest.copy(), round(FALL / structure.preset.timestep)
    engine = make_backend("mujoco")
    engine.build(Scene(structure, {**structure.defaults, **changed}, rest))
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


def cube(edge: Floats) -> Floats:
    """Compute the edge lengths of a cube, shape (..., 3) [m]."""
    return np.stack([edge, edge, edge], axis=-1)


def start(size: Floats, orientation: Floats, *, index: float) -> Floats:
    """Compute where a block begins: in a square on the floor, shape (3,) [m]."""
    x, y = STARTS[int(index)]
    return np.array([STEP * x, STEP * y, lowest_point(size, orientation)])


@final
class General(Building):
    """Blocks on the floor, and the places where such blocks came to lie that were dropped.

    From where they are dropped is a variable: draw it for another goal. What the blocks are like,
    gravity and the friction of the floor are causes of the goal, as they are of all motion. The
    pile is simulated on MuJoCo for every backend of the world, so that one seed gives the same
    goal everywhere. The fingers begin raised.

    Args:
        tool_block_mass: Default mass of a block [kg].
        tool_block_size: Default edge length of a block [m].
        nums_objects: Default number of blocks.
        common: Options of every task; see ``Common``.
    """

    name = "general"
    decided_by = (COUNT,)
    goal_causes = (COUNT, MASS, SIZE, PLACES, TURNS)
    interleaved = False
    piece = Piece(
        size=(cube, SIZE),
        place=(part_of, PILE),
        start=(start,),
        turn=(turn_of, PILE),
    )

    def __init__(
        self,
        *,
        tool_block_mass: float = numbers.BLOCKS_MASS,
        tool_block_size: float = 0.05,
        nums_objects: int = 5,
        **common: Unpack[Common],
    ) -> None:
        super().__init__(**common)
        region, anywhere = (
            Box(*(end * MOST for end in ends)) for ends in (REGION, numbers.POSITION_ENDS)
        )
        bounds, turns = Box(-2.0 * math.pi, 2.0 * math.pi), Box(0.0, 2.0 * math.pi)
        self.roots = (
            blocks_mass(tool_block_mass),
            numbers.NUMS_OBJECTS.option(COUNT, nums_objects, "How many blocks there are."),
            numbers.DROPPED_SIZE.option(SIZE, tool_block_size, "Edge length of every block."),
            numbers.Range(anywhere, region, region, "m", (MOST, 3)).root(
                PLACES,
                tuple(x for i in range(MOST) for x in DROPS[i % len(DROPS)]),
                "Where the center of each block is let go, or above it if something is there.",
            ),
            numbers.Range(bounds, turns, turns, "rad", (MOST, 3)).root(
                TURNS,
                (0.0,) * (3 * MOST),
                "How each block is turned when it is let go, as a rotation vector.",
            ),
        )

    def arrange(self, values: Values) -> int:
        """Count the blocks."""
        return int(values[COUNT])

    def parts(self) -> Iterable[Part]:
        """List the blocks."""
        return ((str(index), {"index": float(index)}) for index in range(self.arranged))

    def entities(self) -> Iterable[Entity]:
        """List the blocks, the pile, and the places of the blocks in it."""
        bodies, count = tuple(super().entities()), self.arranged
        fallen = Derived(
            name=PILE,
            unit="m, 1",
            shape=SHAPE,
            bounds=Box(-1.0, 1.0),
            parents=(
                *(COUNT, SIZE, MASS, PLACES, TURNS, "gravity", "floor_friction"),
                *(f"{tool}.friction" for tool in self.tools),
            ),
            mechanism=Function(pile),
            doc="Position and quaternion of each block some time after it was dropped.",
        )
        return *bodies[:count], Entity(PILE, (fallen,)), *bodies[count:]
