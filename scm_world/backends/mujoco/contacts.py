"""What touched what in the last physics step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.base import ContactPoint

_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_PYRAMID = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


@final
@dataclass(frozen=True)
class Touches:
    """Contact points as arrays, before they get names.

    Attributes:
        owners: Name of the body of each shape: the geoms, then the flexes.
        shapes: Shape (k, 2).
        numbers: Of each: position [m], normal from the first shape to the second, distance [m],
            negative where they intersect, and normal force [N], shape (k, 8).
    """

    owners: tuple[str, ...]
    shapes: Integers
    numbers: Floats

    def contacts(self) -> tuple[ContactPoint, ...]:
        """Name the bodies."""
        return tuple(
            ContactPoint(
                (self.owners[first], self.owners[second]),
                row[:3],
                row[3:6],
                -float(row[6]),
                float(row[7]),
            )
            for (first, second), row in zip(self.shapes, self.numbers, strict=True)
        )

    def extended(self, other: Touches) -> Touches:
        """Add the contacts of such pairs of shapes as touch in the other alone."""
        pairs = {(first, second) for first, second in self.shapes.tolist()}
        new = [i for i, pair in enumerate(other.shapes.tolist()) if tuple(pair) not in pairs]
        shapes = np.concatenate([self.shapes, other.shapes[new]])
        numbers = np.concatenate([self.numbers, other.numbers[new]])
        return Touches(self.owners, shapes, numbers) if new else self


def touches(model: mujoco.MjModel, data: mujoco.MjData, owners: tuple[str, ...]) -> Touches:
    """Copy the contacts of the last physics step.

    Their force is the sum of those on the edges of a pyramid, or the first one of an elliptic cone;
    contacts within a gap have none.
    """
    contact = data.contact
    shapes = contact.geom.astype(np.int64)
    if model.nflex:
        shapes = np.where(shapes < 0, model.ngeom + contact.flex, shapes)
    numbers = np.zeros((len(shapes), 8))
    numbers[:, :3], numbers[:, 3:6] = contact.pos, contact.frame[:, :3]
    numbers[:, 6], forces = contact.dist, numbers[:, 7]
    address, size = contact.efc_address, contact.dim
    listed = address >= 0
    forces[listed] = data.efc_force[address[listed]]
    if model.opt.cone == _PYRAMID:
        for i in np.flatnonzero(listed & (size > 1)).tolist():
            forces[i] = data.efc_force[address[i] : address[i] + 2 * (size[i] - 1)].sum()
    return Touches(owners, shapes, numbers)


def has_stages(model: mujoco.MjModel) -> bool:
    """Tell whether a physics step looks for contacts in several places (Runge-Kutta)."""
    return int(model.opt.integrator) == _RK4


def earlier_stages(
    model: mujoco.MjModel, numbers: Floats, owners: tuple[str, ...]
) -> Iterator[Touches]:
    """Find the contacts of the first three stages of a Runge-Kutta step; MuJoCo keeps the last.

    Args:
        model: As it was in that step.
        numbers: ``mjSTATE_INTEGRATION`` before it.
        owners: Name of the body of each shape.

    Source:
        ``mj_RungeKutta`` in MuJoCo's ``engine_forward.c``.
    """
    data, half = mujoco.MjData(model), 0.5 * model.opt.timestep
    data.warning.number[:] = 1  # so that MuJoCo prints none
    mujoco.mj_setState(model, data, numbers, _STATE)
    position, velocity, activation = data.qpos.copy(), data.qvel.copy(), data.act.copy()
    for _ in range(3):
        mujoco.mj_forward(model, data)
        yield touches(model, data, owners)
        rate = data.qvel.copy()
        data.qpos[:] = position
        mujoco.mj_integratePos(model, data.qpos, rate, half)
        data.qvel[:] = velocity + half * data.qacc
        data.act[:] = activation + half * data.act_dot
