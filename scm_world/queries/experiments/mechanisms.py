"""Experiments with the mechanisms of what does not move: sizes, layouts, goals, piles.

An experiment in the world changes one thing about the present structure. Some causes show only
in other circumstances (the noise of a wall only where walls are random). So each mechanism is
also tried on its own: all its causes have values of one circumstance, and one of them gets the
value that it has in another. A mechanism can be handed nothing but its declared causes, so what
is not declared is looked for in the world alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scm_world._types import Value, Values
from scm_world.queries.experiments.effects import Effects
from scm_world.variables import Derived, Exogenous, Noise, Variable
from scm_world.variables.kinds import SpaceName
from scm_world.world import World

FEW = 24  # mechanisms with more causes than this are left to experiments in the world
NUDGE = 0.2  # how far, as a fraction, to move a cause that has no spaces to be drawn from


def see_mechanisms(
    world: World, present: Values, effects: Effects, noise: Noise, number: int
) -> None:
    """Try every mechanism of what does not move.

    Args:
        world: Its model has the mechanisms.
        present: Values of the probe: the first circumstance.
        effects: What is seen is noted there.
        noise: Draws two more, one from the spaces A and one from B.
        number: Of the probe.
    """
    now = {name: present[name] for name in world.static_names}
    drawn = [_circumstance(world, now, noise, 2 * number + i) for i in range(2)]
    one, other = drawn if number % 2 == 0 else reversed(drawn)
    for child in _mechanisms(world):
        _compare(world, child, one, other, effects)
        _compare(world, child, now, one, effects)


def _compare(world: World, child: Derived, base: Values, other: Values, effects: Effects) -> None:
    """Change one cause of a mechanism after another."""
    before = world.model.solve(base, only=(child.name,))[child.name]
    for parent in child.parents:
        known = {**base, parent.name: other[parent.name]}
        after = world.model.solve(known, only=(child.name,))[child.name]
        effects.see(parent.name, child.name, 0, after, before)


def _mechanisms(world: World) -> Iterator[Derived]:
    static = frozenset(world.static_names)
    for variable in world.model.variables:
        if isinstance(variable, Derived) and variable.name in static:
            names = {parent.name for parent in variable.parents}
            if names <= static and len(names) <= FEW:
                yield variable


def _circumstance(world: World, now: Values, noise: Noise, episode: int) -> dict[str, Value]:
    """Draw the roots, from A in even episodes and from B in odd ones, and solve for the rest."""
    space: SpaceName = "B" if episode % 2 else "A"
    roots = {
        variable.name: _drawn(variable, space, now, noise, episode)
        for variable in world.model.variables
        if isinstance(variable, Exogenous) and variable.name in now
    }
    return world.model.solve(roots, only=world.static_names)


def _drawn(variable: Variable, name: SpaceName, now: Values, noise: Noise, episode: int) -> Value:
    space = variable.space(name)
    if space is not None:
        drawn = noise.draw(space, variable.name, variable.shape, now, episode=episode)
        return np.asarray(drawn[0])
    if variable.dtype != "real" or variable.bounds is None:
        return now[variable.name]
    unit = noise.uniforms(f"{variable.name}|nudge", n=1, episode=episode)[0, 0]
    return variable.bounds.nearest(now[variable.name] * (1.0 + NUDGE * unit), now)
