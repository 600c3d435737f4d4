"""Where and when a variable is computed: the key of its noise, and the values that there are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from scm_world._types import Value, Values
from scm_world.variables.distributions import Distribution, Noise

if TYPE_CHECKING:
    from scm_world.variables.kinds import Parent, Variable


@final
@dataclass
class NoiseKey:
    """Where in a noise stream a draw is taken.

    Attributes:
        noise: The seed's noise.
        episode: The first episode.
        step: The control step.
        count: For how many episodes in a row; None for a single one without a batch axis.
        origin: The control step at which variables got their own noise, if that was another one:
            noise drawn at the start of an episode stays, however late one intervenes.
        attempt: How many draws were rejected before, because they were infeasible.
        kept: The attempt of variables that are not drawn again at another one.
        given: Noise that is known: of some variables, instead of draws.
    """

    noise: Noise
    episode: int = 0
    step: int = 0
    count: int | None = None
    origin: int | None = None
    attempt: int = 0
    kept: Mapping[str, int] | None = None
    given: Values | None = None

    def of(self, variable: Variable) -> NoiseKey:
        """Return the key of a variable: in equations one of an episode is drawn at step 0."""
        once = variable.per_episode and self.origin is None and self.step
        return replace(self, step=0) if once else self

    def natural(
        self, source: Distribution, name: str, shape: tuple[int, ...], values: Values
    ) -> Value:
        """Draw what a variable has by itself, without intervention."""
        key = self
        if self.attempt or self.origin is not None:
            step = self.step if self.origin is None else self.origin
            key = replace(self, attempt=0, step=step, origin=None)
        return key.draw(source, name, shape, values)

    def draw(
        self,
        source: Distribution,
        name: str,
        shape: tuple[int, ...],
        values: Values,
        stream: str | None = None,
    ) -> Value:
        """Draw a value of a variable, shape ``(count, *shape)`` or ``shape``."""
        if stream is None and self.given is not None and name in self.given:
            return self.given[name]
        drawn = self.noise.draw(
            source,
            self.stream(name, stream, self.attempt),
            shape,
            values,
            episode=self.episode,
            step=self.step,
            count=self.count or 1,
        )
        return drawn if self.count is not None else drawn[0]

    def stream(self, name: str, stream: str | None, attempt: int) -> str:
        """Return the name of the stream that an attempt to draw a variable takes its noise from."""
        return stream_of(name, stream, (self.kept or {}).get(name, attempt))


def stream_of(name: str, stream: str | None, attempt: int) -> str:
    """Return the name of the stream of an attempt to draw a variable."""
    own = name if stream is None else f"{stream}/{name}"
    return f"{own}#{attempt}" if attempt else own


def earlier(name: str, lag: int) -> str:
    """Name the value of so many control steps ago; that of one step ago has the plain name."""
    return name if lag == 1 else f"{name}@-{lag}"


@final
@dataclass(slots=True)
class Moment:
    """The values from which a variable is computed, and the key of its noise.

    Attributes:
        declared: The declarations by name.
        values: The values so far, of this instant.
        previous: Values of earlier control steps, as ``earlier`` names them.
        key: The key; None if nothing is drawn, and noise is zero.
    """

    declared: Mapping[str, Variable]
    values: Values
    previous: Values
    key: NoiseKey | None

    def arguments(self, parents: Iterable[Parent]) -> Iterator[Value]:
        """Yield the values of parents; before the first step it is the first one."""
        for parent in parents:
            name = parent.name if parent.lag < 2 else earlier(parent.name, parent.lag)
            known = self.previous if parent.lag else self.values
            if parent.lag and name not in known:
                yield self.declared[parent.name].first
            else:
                yield known[name]

    def noise(self, variable: Variable, source: Distribution | None) -> dict[str, Value]:
        """Return the argument ``noise`` of a function, if it has any; zero without a key."""
        if source is None:
            return {}
        shape = variable.shape_of_noise
        if self.key is None:
            return {"noise": np.zeros(shape)}
        return {"noise": self.key.natural(source, variable.name, shape, self.values)}
