"""The TriFinger as MuJoCo realizes it: its states, its servos, and the friction of its pairs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, final

import numba
import numpy as np
from mujoco.batch import Batch

from scm_world._types import Floats, Integers
from scm_world.backends.mujoco.realization import Realization, Rows
from scm_world.models.scene import ControlMode, ParameterKey
from scm_world.tasks.trifinger.hardware import N_JOINTS
from scm_world.tasks.trifinger.mujoco.model import compiled, couple, shape_owners, slots, steer
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE
from scm_world.tasks.trifinger.structure import TriFingerStructure

_CLOSE = 1e-14  # relative; a few roundings, far less than any physics


@final
@dataclass(frozen=True)
class LastStep:
    """What the last physics step left.

    Attributes:
        blocks: The blocks there were.
        vector: The state in the units of the scene, shape (27 + 13 n,).
        positions: MuJoCo's own, shape (9 + 7 n,).
        velocities: MuJoCo's own, shape (9 + 6 n,).
    """

    blocks: tuple[str, ...]
    vector: Floats
    positions: Floats
    velocities: Floats

    def source(self, blocks: tuple[str, ...]) -> Integers:
        """Find blocks in the instant; -1 where one is new. Shape (n,)."""
        where = {name: index for index, name in enumerate(self.blocks)}
        return np.array([where.get(name, -1) for name in blocks], dtype=np.int64)


def nothing() -> LastStep:
    """Describe a world in which no physics step was made."""
    return LastStep((), np.zeros(ROBOT_SIZE), np.zeros(N_JOINTS), np.zeros(N_JOINTS))


@numba.njit("void(f8[::1], i8, f8[::1], b1)", cache=True, error_model="numpy")
def _rotate(quaternion: Floats, start: int, vector: Floats, inverse: bool) -> None:
    """Rotate a vector in place by the quaternion (w, x, y, z) that begins at ``start``."""
    w, x, y, z = (
        quaternion[start],
        quaternion[start + 1],
        quaternion[start + 2],
        quaternion[start + 3],
    )
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    if inverse:
        w = -w
    a, b, c = vector[0], vector[1], vector[2]
    # v + 2 w (q x v) + 2 q x (q x v)
    i, j, k = y * c - z * b, z * a - x * c, x * b - y * a
    vector[0] = a + scale * (w * i + y * k - z * j)
    vector[1] = b + scale * (w * j + z * i - x * k)
    vector[2] = c + scale * (w * k + x * j - y * i)


@numba.njit("void(f8[::1], f8[::1], f8[::1], f8[::1])", cache=True)
def read_state(positions: Floats, velocities: Floats, torques: Floats, into: Floats) -> None:
    """Convert MuJoCo's coordinates into the vector of a ``PhysicalState``."""
    spin = np.empty(3)
    for i in range(9):
        into[i] = positions[i]
        into[9 + i] = velocities[i]
        into[18 + i] = torques[i]
    for block in range((into.shape[0] - ROBOT_SIZE) // BLOCK_SIZE):
        q, v, s = 9 + 7 * block, 9 + 6 * block, ROBOT_SIZE + BLOCK_SIZE * block
        sign = -1.0 if positions[q + 3] < 0.0 else 1.0
        for axis in range(3):
            into[s + axis] = positions[q + axis]
            into[s + 3 + axis] = sign * positions[q + 4 + axis]
            into[s + 7 + axis] = velocities[v + axis]
            spin[axis] = velocities[v + 3 + axis]
        into[s + 6] = sign * positions[q + 3]
        _rotate(positions, q + 3, spin, False)
        for axis in range(3):
            into[s + 10 + axis] = spin[axis]


@numba.njit("void(f8[::1], f8[::1])", cache=True)
def settle(written: Floats, into: Floats) -> None:
    """Give back an angular velocity as it was written, where only roundings differ."""
    for s in range(ROBOT_SIZE, into.shape[0], BLOCK_SIZE):
        error, norm = 0.0, 0.0
        for axis in range(s + 10, s + 13):
            error += abs(into[axis] - written[axis])
            norm += abs(written[axis])
        if error <= _CLOSE * norm:
            for axis in range(s + 10, s + 13):
                into[axis] = written[axis]


@numba.njit(
    "void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1], f8[::1], f8[::1])",
    cache=True,
)
def write_state(
    vector: Floats,
    positions: Floats,
    velocities: Floats,
    source: Integers,
    last: Floats,
    last_positions: Floats,
    last_velocities: Floats,
) -> None:
    """Convert the vector of a ``PhysicalState`` into MuJoCo's coordinates.

    Args:
        vector: What to write; orientations of either sign.
        positions: Written, shape (9 + 7 n,).
        velocities: Written, shape (9 + 6 n,).
        source: Index of each block in the last instant, or -1, shape (n,).
        last: State of the last instant.
        last_positions: MuJoCo's own of that instant.
        last_velocities: MuJoCo's own of that instant.
    """
    spin = np.empty(3)
    for i in range(9):
        positions[i] = vector[i]
        velocities[i] = vector[9 + i]
    for block in range(source.shape[0]):
        q, v, s = 9 + 7 * block, 9 + 6 * block, ROBOT_SIZE + BLOCK_SIZE * block
        known = source[block] >= 0
        lq, lv = 9 + 7 * source[block], 9 + 6 * source[block]
        ls = ROBOT_SIZE + BLOCK_SIZE * source[block]
        turned, spun = not known, not known
        if known:
            for axis in range(4):
                turned |= vector[s + 3 + axis] != last[ls + 3 + axis]
            for axis in range(3):
                spun |= vector[s + 10 + axis] != last[ls + 10 + axis]
        sign = -1.0 if vector[s + 6] < 0.0 else 1.0
        for axis in range(3):
            positions[q + axis] = vector[s + axis]
            velocities[v + axis] = vector[s + 7 + axis]
            spin[axis] = vector[s + 10 + axis]
        positions[q + 3] = last_positions[lq + 3] if not turned else sign * vector[s + 6]
        for axis in range(3):
            raw = last_positions[lq + 4 + axis] if not turned else sign * vector[s + 3 + axis]
            positions[q + 4 + axis] = raw
        _rotate(positions, q + 3, spin, True)
        for axis in range(3):
            same = not (turned or spun)
            velocities[v + 3 + axis] = last_velocities[lv + 3 + axis] if same else spin[axis]


_OUTPUT = numba.types.Array(numba.float64, 2, "C", readonly=True)


@numba.njit(
    numba.int64(
        numba.float64[:, :], numba.float64[:, :], _OUTPUT, numba.int32[::1], numba.float64[:, ::1]
    ),
    cache=True,
)
def read_states(
    positions: Floats, velocities: Floats, torques: Floats, which: Any, into: Floats
) -> int:
    """Convert MuJoCo's coordinates of several scenes, one to a row.

    Args:
        positions: MuJoCo's own, shape (n, 9 + 7 k).
        velocities: MuJoCo's own, shape (n, 9 + 6 k).
        torques: MuJoCo's own, shape (n, 9 + 6 k).
        which: The rows, shape (m,).
        into: Their first columns are written, shape (n, at least 27 + 13 k).

    Returns:
        A row in which something is not finite; -1 if there is none.
    """
    position, velocity = np.empty(positions.shape[1]), np.empty(velocities.shape[1])
    torque = np.empty(N_JOINTS)
    end = ROBOT_SIZE + BLOCK_SIZE * ((positions.shape[1] - N_JOINTS) // 7)
    wrong = -1
    for i in which:
        total = 0.0
        for k in range(len(position)):
            position[k] = positions[i, k]
            total += position[k] * 0.0
        for k in range(len(velocity)):
            velocity[k] = velocities[i, k]
            total += velocity[k] * 0.0
        for k in range(N_JOINTS):
            torque[k] = torques[i, k]
        read_state(position, velocity, torque, into[i, :end])
        if total != 0.0:  # also where it is not a number
            wrong = i
    return wrong


_COUPLED = {"friction", "spinning_friction"}
_STEERED = {"position_gains", "velocity_gains"}


@final
class TriFinger(Realization):
    """A ``TriFingerStructure`` of the TriFinger.

    What the last physics step left is kept in an ``LastStep`` as soon as the state is written.
    """

    modes = (ControlMode.JOINT_POSITIONS, ControlMode.JOINT_TORQUES)

    def __init__(self, structure: TriFingerStructure) -> None:
        model = compiled(structure)
        owners = shape_owners(structure)
        super().__init__(
            structure,
            model,
            lambda model, _: slots(model, structure),
            tuple(model.body(i).name for i in range(model.nbody)),
            tuple(owners[model.geom(i).name] for i in range(model.ngeom)),
        )
        model = self.model
        self._torques = self.data.qfrc_actuator[:N_JOINTS]
        self._gains = model.actuator_gainprm, model.actuator_biasprm
        self._pairs = (
            model.geom_friction,
            model.pair_geom1,
            model.pair_geom2,
            model.pair_friction,
        )
        self._begin()

    def _begin(self) -> None:
        self._last: LastStep | None = nothing()
        self._source = self._last.source(self.structure.blocks)
        self._written: Floats | None = None  # since the last step

    def read(self, into: Floats) -> None:
        """Write the state into a vector, shape (27 + 13 n,)."""
        read_state(self._positions, self._velocities, self._torques, into)
        if self._written is not None:
            settle(self._written, into)

    def place(self, vector: Floats) -> None:
        """Write a state; what equals the last instant gets the numbers it had there."""
        self._remember()
        last = self._last or nothing()
        write_state(
            vector,
            self._positions,
            self._velocities,
            self._source,
            last.vector,
            last.positions,
            last.velocities,
        )
        self._written = vector.copy()

    def _remember(self) -> None:
        """Keep what the last physics step left, before the first change of the state."""
        if self._last is not None:
            return
        vector = np.empty(self.structure.layout.size)
        self.read(vector)
        self._last = LastStep(
            self.structure.blocks, vector, self._positions.copy(), self._velocities.copy()
        )
        self._source = np.arange(len(self.structure.blocks))

    def forget(self) -> None:
        """Forget what was before a step that is made now."""
        self._last = self._written = None

    def rows(self, batch: Batch) -> Rows:
        """Give what reads states of such models out of a batch."""
        arrays = batch.bind("qpos"), batch.bind("qvel"), batch.bind("qfrc_actuator")
        return lambda which, into: int(read_states(*arrays, which, into))

    def reset(self) -> None:
        """Forget every step."""
        super().reset()
        self._begin()

    def memory(self) -> Any:
        """Give torques, instant and the state that was written since."""
        return self._torques.copy(), self._last, self._written

    def recall(self, numbers: Floats, memory: Any) -> None:
        """Restore what was kept."""
        super().recall(numbers, memory)
        self._torques[:], self._last, self._written = memory
        if self._last is not None:
            self._source = self._last.source(self.structure.blocks)

    def follow(self, before: Realization) -> None:
        """Keep torques and blocks of the last step."""
        super().follow(before)
        if isinstance(before, TriFinger):
            before._remember()
            self._torques[:], self._last = before._torques, before._last
            self._source = (self._last or nothing()).source(self.structure.blocks)

    def switch(self, mode: ControlMode) -> None:
        """Make the nine servos follow positions, or pass torques on."""
        super().switch(mode)
        steer(*self._gains, mode)
        self.edited = True

    def followed(self, keys: Iterable[ParameterKey]) -> str:
        """Update pairs and servos, and then what MuJoCo derives."""
        keys = tuple(keys)
        changed = {attribute for _, attribute in keys}
        if not _COUPLED.isdisjoint(changed):
            couple(*self._pairs)
        if not _STEERED.isdisjoint(changed):
            steer(*self._gains, self.mode)
        return super().followed(keys)
