"""The draws of an intervention that are made together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.graph import SCM, NoiseKey
from scm_world.variables import Box, Draw, Space, whole_of
from scm_world.variables.noise import word_of
from scm_world.world.compiled_task import PendingInterventions
from scm_world.world.philox import philox

_LARGEST = float(np.finfo(np.float64).max)


@final
class Draws:
    """Draws from boxes whose ends follow nothing, made with a few calls for all of them.

    The numbers are those that each draw has on its own.

    Args:
        model: That declares the variables.
        acts: The interventions, by target.
        order: The targets that are drawn, and others.
    """

    def __init__(self, model: SCM, acts: PendingInterventions, order: Iterable[str]) -> None:
        found: dict[int, dict[str, tuple[str, Box, Space | None]]] = {}
        for name in order:
            asked, act = acts.get(name, (name, None))
            variable = model.declared(name)
            if not isinstance(act, Draw) or asked != name or whole_of(act, name) != name:
                continue
            source = variable.space(act.source) if isinstance(act.source, str) else act.source
            plain = all(
                isinstance(space, Box) and not space.parents()
                for space in (source, variable.bounds or source)
            )
            if plain and isinstance(source, Box) and variable.dtype == "real":
                stream = name if act.stream is None else f"{act.stream}/{name}"
                group = found.setdefault(source.n_uniforms(variable.shape), {})
                group[name] = stream, source, variable.bounds
        self._groups = [_Group(model, n, group) for n, group in found.items() if n]

    def at(self, key: NoiseKey) -> Mapping[str, Value]:
        """Draw; what comes out of its bounds is left out, for an error to be made of it."""
        drawn: dict[str, Value] = {}
        for group in self._groups:
            drawn |= group.at(key)
        return drawn


@final
class _Group:
    """Draws of one size.

    Args:
        model: That declares the variables.
        n: How many numbers each has.
        members: Stream, space and bounds by name.
    """

    def __init__(
        self, model: SCM, n: int, members: Mapping[str, tuple[str, Box, Space | None]]
    ) -> None:
        self._streams = {name: stream for name, (stream, _, _) in members.items()}
        self._shapes = [model.declared(name).shape for name in members]
        rows = []
        for (_, source, bounds), shape in zip(members.values(), self._shapes, strict=True):
            low, high = source.bounds(shape, {})
            ends = bounds.bounds(shape, {}) if isinstance(bounds, Box) else (-_LARGEST, _LARGEST)
            rows.append([np.broadcast_to(end, shape).ravel() for end in (low, high - low, *ends)])
        self._low, self._edges, self._least, self._most = np.array(rows).swapaxes(0, 1)
        self._uniforms = np.empty((len(rows), n))

    def at(self, key: NoiseKey) -> dict[str, Value]:
        again, kept = f"#{key.attempt}" if key.attempt else "", key.kept
        words = [word_of(own if n in kept else own + again) for n, own in self._streams.items()]
        where = np.array([key.noise.key, key.episode, key.step], dtype=np.uint64)
        philox(where, np.array(words, dtype=np.uint64), self._uniforms)
        values: Floats = self._low + self._edges * self._uniforms
        inside = ((values >= self._least) & (values <= self._most)).all(axis=1)
        return {
            name: value.reshape(shape)
            for name, value, shape, fits in zip(
                self._streams, values, self._shapes, inside.tolist(), strict=True
            )
            if fits
        }
