"""Between MuJoCo's coordinates and the state vector of a ``Model``: the same numbers, permuted."""

from __future__ import annotations

import math
from typing import Any

import numba

from scm_world._types import Floats, Integers


@numba.njit("b1(f8[::1], f8[::1], f8[::1], i4[:])", cache=True)
def sound(positions: Floats, velocities: Floats, activations: Floats, counts: Any) -> bool:
    """Tell whether all numbers are finite, and no contact or constraint was left out.

    Args:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        activations: Shape (na,).
        counts: Of MuJoCo's warnings, which begin with 1; the second is of contacts for which
            there was no memory, the third of constraints.
    """
    total = 0.0
    for value in positions:
        total += value * 0.0
    for value in velocities:
        total += value * 0.0
    for value in activations:
        total += value * 0.0
    return total == 0.0 and counts[1] + counts[2] == 2


@numba.njit("void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1])", cache=True)
def read_vector(
    positions: Floats, velocities: Floats, activations: Floats, places: Integers, into: Floats
) -> None:
    """Copy MuJoCo's coordinates into a state vector.

    Args:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        activations: Shape (na,).
        places: Where in the vector each of them stands, in this order, shape (nq + nv + na,).
        into: Written, shape (nq + nv + na,).
    """
    nq, nv = positions.shape[0], velocities.shape[0]
    for i in range(nq):
        into[places[i]] = positions[i]
    for i in range(nv):
        into[places[nq + i]] = velocities[i]
    for i in range(activations.shape[0]):
        into[places[nq + nv + i]] = activations[i]


@numba.njit("void(f8[::1], f8[::1], f8[::1], i8[::1], f8[::1])", cache=True)
def write_vector(
    positions: Floats, velocities: Floats, activations: Floats, places: Integers, vector: Floats
) -> None:
    """Copy a state vector into MuJoCo's coordinates; see ``read_vector``."""
    nq, nv = positions.shape[0], velocities.shape[0]
    for i in range(nq):
        positions[i] = vector[places[i]]
    for i in range(nv):
        velocities[i] = vector[places[nq + i]]
    for i in range(activations.shape[0]):
        activations[i] = vector[places[nq + nv + i]]


@numba.njit("i8(f8[:, ::1], i8[::1], i4[::1], f8[:, ::1])", cache=True)
def read_rows(states: Floats, places: Integers, which: Any, into: Floats) -> int:
    """Copy some rows of MuJoCo's states (time, positions, velocities, activations, ...).

    Args:
        states: Of all simulations, one to a row.
        places: See ``read_vector``.
        which: The rows, shape (m,).
        into: The first columns of these rows are written.

    Returns:
        A row in which something is not finite; -1 if there is none.
    """
    wrong = -1
    for row in which:
        total = 0.0
        for i in range(places.shape[0]):
            value = states[row, 1 + i]
            into[row, places[i]] = value
            total += value * 0.0
        if total != 0.0:
            wrong = row
    return wrong


@numba.njit("b1(f8[::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1])", cache=True)
def sensible(
    masses: Floats, moments: Floats, inertia: Floats, dof_weights: Floats, body_weights: Floats
) -> bool:
    """Tell whether masses and what MuJoCo derives from them are those of something that can move.

    Args:
        masses: Of the bodies, shape (nbody,).
        moments: Their principal moments of inertia, shape (nbody, 3).
        inertia: Diagonal of the inertia matrix, shape (nv,).
        dof_weights: Inverse weights, shape (nv,).
        body_weights: Inverse weights, shape (nbody, 2).
    """
    for body in range(masses.shape[0]):
        a, b, c = moments[body]
        least, most = min(a, b, c), max(a, b, c)
        if not (0.0 <= masses[body] < math.inf and least >= 0.0 and most < math.inf):
            return False
        if not a + b + c - 2.0 * most >= -1e-6 * most:  # the triangle inequality
            return False
        for weight in body_weights[body]:
            if not 0.0 <= weight < math.inf:
                return False
    for dof in range(inertia.shape[0]):
        if not (0.0 < inertia[dof] < math.inf and 0.0 <= dof_weights[dof] < math.inf):
            return False
    return True
