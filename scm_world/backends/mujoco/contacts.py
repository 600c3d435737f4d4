"""What touched what in the last physics step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.base import Contact


@final
@dataclass(frozen=True)
class Touches:
    """Contact points as arrays, before they get names.

    Attributes:
        owners: Name of the body of each shape.
        shapes: Shape (k, 2).
        positions: Shape (k, 3) [m].
        normals: From the first shape to the second, shape (k, 3).
        distances: Shape (k,) [m], negative where they intersect.
        forces: Normal forces, shape (k,) [N].
    """

    owners: tuple[str, ...]
    shapes: Integers
    positions: Floats
    normals: Floats
    distances: Floats
    forces: Floats

    def contacts(self) -> tuple[Contact, ...]:
        """Name the bodies."""
        return tuple(
            Contact(
                (self.owners[first], self.owners[second]),
                self.positions[i],
                self.normals[i],
                -float(self.distances[i]),
                float(self.forces[i]),
            )
            for i, (first, second) in enumerate(self.shapes)
        )


def touches(data: mujoco.MjData, owners: tuple[str, ...]) -> Touches:
    """Copy the contacts of the last physics step."""
    contact, address = data.contact, data.contact.efc_address
    forces = np.zeros(len(address))
    forces[address >= 0] = data.efc_force[address[address >= 0]]
    return Touches(
        owners,
        contact.geom.astype(np.int64),
        contact.pos.copy(),
        contact.frame[:, :3].copy(),
        contact.dist.copy(),
        forces,
    )
