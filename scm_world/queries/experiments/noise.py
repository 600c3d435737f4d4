"""Whether variables have noise of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from scm_world._types import Floats, Values
from scm_world.graph import SCM, NoiseKey
from scm_world.variables import Derived, Exogenous, Noise

KEYS, ALIKE = 64, 0.9
"""Draws whose ranks are compared, and the rank correlation from which noise is one and the same.

Independent ranks of 64 draws have a correlation with standard deviation 0.13.
"""


def shared_noise(
    model: SCM, values: Values, previous: Values, command: Callable[[int], Floats] | None = None
) -> set[tuple[str, str]]:
    """Name the pairs of variables that are given one and the same noise.

    Each is computed many times with other noise and the same parents. Where two have independent
    noise, the ranks of their values are independent.

    Args:
        model: Has the mechanisms.
        values: Of the parents.
        previous: Of one control step ago.
        command: Gives the command of a control step of this number, which may be random.
    """
    keys = [NoiseKey(Noise(0), episode) for episode in range(KEYS)]
    columns: list[Floats] = []
    owners: list[str] = []

    def take(name: str, found: list[Any]) -> None:
        numbers = np.array([np.ravel(value) for value in found], dtype=float)
        for number, column in enumerate(numbers.T):
            if len(np.unique(column)) > KEYS // 2:
                columns.append(np.argsort(np.argsort(column)).astype(float))
                owners.append(f"{name}[{number}]" if name == "command" else name)

    for variable in model.variables:
        name = variable.name
        is_random = (isinstance(variable, Exogenous) and variable.distribution is not None) or (
            isinstance(variable, Derived) and variable.noise is not None
        )
        if is_random and name not in model.interventions:
            known = {n: v for n, v in values.items() if n != name}
            solve = model.solve
            take(name, [solve(known, previous=previous, key=k, only=(name,))[name] for k in keys])
    if command is not None:
        take("command", [np.array(command(step)) for step in range(KEYS)])
    if len(columns) < 2:
        return set()
    alike = np.abs(np.corrcoef(np.array(columns))) > ALIKE
    pairs = ((owners[i], owners[j]) for i, j in np.argwhere(np.triu(alike, 1)))
    return {(one, other) for one, other in pairs if one != other}
