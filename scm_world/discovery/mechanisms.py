"""Experiments with the mechanisms of what does not move: sizes, layouts, goals, piles.

An experiment in the world changes one thing about the present structure. Some causes show only
in other circumstances (the noise of a wall only where walls are random). So each mechanism is
also tried on its own, with causes drawn from their spaces, one of them changed at a time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scm_world._types import Value, Values
from scm_world.discovery.effects import Effects, gap
from scm_world.variables import Derived, Exogenous, Noise, Variable
from scm_world.world import World

FEW = 24  # mechanisms with more causes than this are left to experiments in the world


def see_mechanisms(world: World, effects: Effects, noise: Noise, number: int) -> None:
    """Try every mechanism of what does not move, in circumstances drawn from A and B."""
    model = world.model
    static = {name: world[name] for name in world.static_names}
    drawn = [_circumstances(world, static, noise, 2 * number + i) for i in range(2)]
    for child in _mechanisms(world):
        parents = [parent.name for parent in child.parents]
        before = model.solve(drawn[0], only=(child.name,))[child.name]
        for cause in parents:
            known = {**drawn[0], cause: drawn[1][cause]}
            after = model.solve(known, only=(child.name,))[child.name]
            effects.see(cause, child.name, 0, gap(after, before))


def _mechanisms(world: World) -> Iterator[Derived]:
    static = frozenset(world.static_names)
    for variable in world.model.variables:
        if isinstance(variable, Derived) and variable.name in static:
            names = {parent.name for parent in variable.parents}
            if names <= static and len(names) <= FEW:
                yield variable


def _circumstances(world: World, static: Values, noise: Noise, episode: int) -> dict[str, Value]:
    """Draw the roots from A or B and solve for the rest."""
    roots = {
        variable.name: _drawn(variable, static, noise, episode)
        for variable in world.model.variables
        if isinstance(variable, Exogenous) and variable.name in static
    }
    return world.model.solve(roots, only=world.static_names)


def _drawn(variable: Variable, static: Values, noise: Noise, episode: int) -> Value:
    space = variable.space(("A", "B")[episode % 2])
    if space is None:
        nudge = noise.uniforms(f"{variable.name}|nudge", n=1, episode=episode)[0, 0]
        if variable.dtype != "real" or variable.bounds is None:
            return static[variable.name]
        return variable.bounds.nearest(static[variable.name] * (1.0 + 0.2 * nudge), static)
    drawn = noise.draw(space, variable.name, variable.shape, static, episode=episode)
    return np.asarray(drawn[0])
