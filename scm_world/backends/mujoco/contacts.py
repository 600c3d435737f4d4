"""What touched what in the last physics step."""

from __future__ import annotations

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.base import ContactPoint

_PYRAMID = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)


Touches = tuple[tuple[str, ...], Integers, Floats]
"""Contact points before they get names: the owners of all shapes, the geoms, then the flexes; two
shapes of each point, (k, 2); position [m], normal from the first shape to the second, distance [m],
negative where they intersect, and normal force [N] of each, (k, 8)."""


def named(found: Touches) -> tuple[ContactPoint, ...]:
    """Name the bodies of contact points."""
    owners, points = found[0], list[ContactPoint]()
    for (one, other), row in zip(*found[1:], strict=True):
        names, (distance, force) = (owners[one], owners[other]), row[6:].tolist()
        points.append(ContactPoint(names, row[:3].copy(), row[3:6].copy(), -distance, force))
    return tuple(points)


def shapes_of(model: mujoco.MjModel, data: mujoco.MjData) -> Integers:
    """Copy the numbers of the shapes of each contact: the geoms, then the flexes, shape (k, 2)."""
    shapes: Integers = data.contact.geom.astype(np.int64)
    return np.where(shapes < 0, model.ngeom + data.contact.flex, shapes) if model.nflex else shapes


def touches(model: mujoco.MjModel, data: mujoco.MjData, owners: tuple[str, ...]) -> Touches:
    """Copy the contacts of the last physics step.

    Their force is the sum of those on the edges of a pyramid, or the first one of an elliptic cone;
    contacts within a gap have none.
    """
    contact, shapes = data.contact, shapes_of(model, data)
    numbers = np.zeros((len(shapes), 8))
    numbers[:, :3], numbers[:, 3:6] = contact.pos, contact.frame[:, :3]
    numbers[:, 6], forces = contact.dist, numbers[:, 7]
    address, size = contact.efc_address, contact.dim
    listed = address >= 0
    forces[listed] = data.efc_force[address[listed]]
    if model.opt.cone == _PYRAMID:
        for i in np.flatnonzero(listed & (size > 1)).tolist():
            forces[i] = data.efc_force[address[i] : address[i] + 2 * (size[i] - 1)].sum()
    return owners, shapes, numbers
