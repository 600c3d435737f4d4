"""Experiments with the noise of a control step: one noise is drawn again, all else is the same."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from scm_world._types import Floats, Value, Values
from scm_world.world import Simulation

OTHER = 1_000_000
"""Control steps to the one whose noise is taken instead."""


def driven(
    world: Simulation, snapshot: Any, action: Floats
) -> Iterator[tuple[str, str, Value, Value]]:
    """Draw each noise of a control step again, alone, and yield the states that differ.

    Args:
        world: It is left in any state.
        snapshot: The state before the control step.
        action: The action of the control step, shape (n_actions,).

    Yields:
        The name of a noise, that of a state, and its values after the step, with the other noise
        and with the present one.
    """
    commands: Any = world.composition.commands
    world.restore(snapshot)
    if commands is None or not commands.noisy or not commands.applies(world.row):
        return

    def after(command: Floats) -> Values:
        world.restore(snapshot)
        world.backend.step(command, world.substeps)
        state = world.backend.read()
        return {name: state.vector[at] for name, at in state.layout.slices.items()}

    acted, sent, _ = world.decided(world.compiled.clipped(action))
    command, key = sent.copy(), world.noise_key(world.index + OTHER)
    others = commands.command(acted, world.row, world.state.vector, key).copy()
    base = after(command)
    for noise, place in commands.noisy.items():
        changed = command.copy()
        changed[place] = others[place]
        for state, value in after(changed).items():
            if value.tobytes() != base[state].tobytes():
                yield noise, state, value, base[state]
