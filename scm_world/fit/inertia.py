"""The inertia of a body as ten numbers, of which all values are those of a body that can exist."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import final

import numpy as np

from scm_world._types import ArrayLike, Floats
from scm_world.errors import NotIntervenable
from scm_world.geometry.rotations import (
    from_rotation_vector,
    quaternion_product,
    rotation_matrix,
    to_rotation_vector,
)

INERTIAL = ".inertial"  # after the name of a body: its mass, center of mass and inertia
AXES = "principal_axes"
PARTS = ("mass", "center_of_mass", "inertia", AXES)
NUMBERS = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "kg m^2")
NUMBERS = {"mass": "kg", "mx": "kg m", "my": "kg m", "mz": "kg m"} | NUMBERS
LOGS = (0, 4, 7, 9)  # which of the searched numbers are logarithms
UPPER = np.triu_indices(3)
THIN = 1e-9  # least second moment of a body, in the largest one


def second_moments(mass: float, center: Floats, moments: Floats, axes: Floats) -> Floats:
    """Return the integral of x xᵀ over the mass of a body about its frame [kg m²], shape (3, 3).

    Args:
        mass: Its mass [kg].
        center: Its center of mass in its frame [m], shape (3,).
        moments: Its principal moments of inertia [kg m²], shape (3,).
        axes: Orientation of its principal axes in its frame, (x, y, z, w).
    """
    turn, along = rotation_matrix(axes), swapped(moments, 0.5)
    return np.asarray((turn * along) @ turn.T + mass * np.outer(center, center))


def ten_numbers(mass: float, center: Floats, moments: Floats, axes: Floats) -> Floats:
    """Return mass, mass times center, and the tensor of inertia about the frame, shape (10,)."""
    spread = second_moments(mass, center, moments, axes)
    tensor = np.trace(spread) * np.eye(3) - spread
    return np.concatenate([[mass], mass * center, tensor[UPPER]])


def swapped(moments: Floats, share: float = 1.0) -> Floats:
    """Return a share of the sum, less each: moments of second moments, or these, with 0.5, back."""
    return np.asarray(share * moments.sum(axis=-1, keepdims=True) - moments)


SECOND = partial(swapped, share=0.5)


def turned_by(axes: Floats, vector: Floats) -> Floats:
    """Return axes that are turned by a rotation vector in their own frame, (..., 4)."""
    return quaternion_product(axes, from_rotation_vector(vector))


def turn_from(axes: Floats, other: Floats) -> Floats:
    """Return the rotation vector from axes to others, (..., 3); see ``turned_by``."""
    return to_rotation_vector(quaternion_product(axes * [-1.0, -1.0, -1.0, 1.0], other))


def _factor(matrix: Floats) -> Floats:
    """Return the upper triangle U of a positive matrix U Uᵀ."""
    return np.asarray(np.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1])


@final
@dataclass(frozen=True, eq=False)
class InertiaBlock:
    """The mass, the center of mass and the inertia of a body, as a search moves them.

    The searched numbers are those of the factor U of the pseudo-inertia matrix U Uᵀ, with a
    positive diagonal, less those of the body as it is: the logarithm of the mass, the center of
    mass, and the upper triangle of the factor of the second moments per mass, with twice the
    logarithms of its diagonal. All but logarithms are in lengths of the body. So any ten numbers
    have a positive definite matrix, and no others do.

    Attributes:
        name: ``"link.inertial"``.
        usual: The ``PARTS`` in the world.
        length: Root of the mean square distance of the mass from the frame [m].
        root: Factor of the second moments per mass about the center [m], shape (3, 3).

    Source:
        Rucker and Wensing, *Smooth parameterization of rigid-body inertia*, IEEE Robotics and
        Automation Letters 2022: the log-Cholesky parameters; Wensing, Kim and Slotine, *Linear
        matrix inequalities for physically consistent inertial parameter identification*, 2018:
        a body can exist if and only if the matrix is positive.
    """

    name: str
    usual: tuple[float, Floats, Floats, Floats]
    length: float
    root: Floats

    @classmethod
    def of(cls, name: str, values: Mapping[str, ArrayLike]) -> InertiaBlock:
        """Return the block of a body with these values of its ``PARTS``.

        Raises:
            NotIntervenable: The body has no thickness, so that smaller changes are impossible.
        """
        mass, center, moments, axes = (np.array(values[part], float) for part in PARTS)
        around = second_moments(float(mass), 0.0 * center, moments, axes) / mass
        length = float(np.sqrt(np.trace(around) + center @ center))
        sizes = np.linalg.eigvalsh(around)
        if sizes[0] < THIN * sizes[2]:
            said = f"has the moments of inertia {moments.tolist()} of a body without thickness"
            raise NotIntervenable(name, f"{said}: reduce the largest of them in the model")
        return cls(name, (float(mass), center, moments, axes), length, _factor(around))

    def body(self, scaled: Floats) -> tuple[float, Floats, Floats, Floats]:
        """Return the ``PARTS`` of the body of ten searched numbers, shape (10,).

        The principal axes are in the order, and near to the axes, of the body as it is.
        """
        mass, center, _, axes = self.usual
        if not scaled.any():
            return self.usual
        from scipy.spatial.transform import Rotation

        mass, root = mass * float(np.exp(scaled[0])), np.zeros((3, 3))
        root[UPPER] = scaled[4:]
        size = np.exp(0.5 * np.diag(root)) * np.diag(self.root)
        root = self.root + self.length * root
        np.fill_diagonal(root, size)
        turned = rotation_matrix(axes).T @ root
        along, turn = np.linalg.eigh(turned @ turned.T)
        order = max(permutations(range(3)), key=lambda o: np.abs(turn[range(3), o]).sum())
        along, turn = mass * np.maximum(along[[*order]], 0.0), turn[:, order]
        turn = turn * np.where(np.diag(turn) < 0.0, -1.0, 1.0)
        turn[:, np.abs(np.diag(turn)).argmin()] *= np.sign(np.linalg.det(turn))
        moments = np.roll(along, -1) + np.roll(along, -2)  # whose rounding obeys the triangle
        axes = quaternion_product(axes, Rotation.from_matrix(turn).as_quat())
        return mass, center + self.length * scaled[1:4], moments, axes / np.linalg.norm(axes)

    def values(self, scaled: Floats) -> dict[str, Floats]:
        """Return the values of the variables of searched numbers, by name."""
        body, parts = self.name.removesuffix(INERTIAL), self.body(scaled)
        return {f"{body}.{p}": np.array(v) for p, v in zip(PARTS, parts, strict=True)}

    def numbers(self, scaled: Floats) -> Floats:
        """Return the ten inertial parameters of searched numbers; see ``ten_numbers``."""
        return ten_numbers(*self.body(scaled))

    def searched(self, numbers: Floats) -> Floats | None:
        """Return the searched numbers of ten inertial parameters; None if no body has them."""
        mass, center = numbers[0], numbers[1:4] / numbers[0]
        tensor = np.zeros((3, 3))
        tensor[UPPER] = numbers[4:]
        tensor = tensor + np.triu(tensor, 1).T
        around = (0.5 * np.trace(tensor) * np.eye(3) - tensor) / mass - np.outer(center, center)
        if mass <= 0.0 or not (np.linalg.eigvalsh(around) > 0.0).all():
            return None
        root = (factor := _factor(around)) - self.root
        root /= self.length
        np.fill_diagonal(root, 2.0 * np.log(np.diag(factor) / np.diag(self.root)))
        moved = (center - self.usual[1]) / self.length
        return np.concatenate([[np.log(mass / self.usual[0])], moved, root[UPPER]])

    def units(self, scaled: Floats) -> Floats:
        """Return sizes of the ten inertial parameters at searched numbers, shape (10,).

        They are the mass m, m times the length of the body there, and roots of products of the
        moments about its frame, which no product of inertia exceeds.
        """
        mass, center, moments, axes = self.body(scaled)
        about = second_moments(mass, center, moments, axes)
        tensor = np.trace(about) - np.diag(about)
        first = np.full(3, np.sqrt(mass * np.trace(about)))
        return np.concatenate([[mass], first, np.sqrt(np.outer(tensor, tensor))[UPPER]])
