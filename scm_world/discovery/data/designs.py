"""Designs: the interventions of each episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, final

import numpy as np

from scm_world._arguments import EPISODES, MANY, one_of, real_number, typed, whole_number
from scm_world.discovery.data.dataset import Bools, Regime
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.queries.plans import Plan, as_act
from scm_world.variables import Draw, Intervention, Noise
from scm_world.variables.spaces import Frozen

DESIGNS = ("observational", "single", "all", "half")

STREAM = "design"
"""The stream of the random choices of a design."""

Case = tuple[int, int, Regime]
"""Number of an episode, of its unit (which has its noise), and its interventions."""


@typed
@final
@dataclass(frozen=True)
class Design:
    """The interventions of episode i: a function of the seed and of i only.

    Attributes:
        name: ``"observational"``: none; ``"single"``: one target in each episode, in turn;
            ``"all"``: every target, each on its own; ``"half"``: in each episode half of the
            targets (rounded up), drawn at random.
        targets: Variables to intervene on, or patterns such as ``"*.mass"``.
        values: Where their values come from: a space ``"A"``, ``"B"`` or ``"A|B"``, a distribution,
            a value or any intervention; or a mapping of these by target.
        observational_fraction: Share of the episodes without an intervention. They are spread
            evenly, beginning with the first one, so that the first N episodes hold the same share.

    Raises:
        UnknownOption: The design is unknown, a target is given twice or has no values, or the
            share is not within 0 and 1.

    Example:
        >>> design = Design("single", ("x", "y"), values="A", observational_fraction=0.5)
        >>> [design.regime(i).targets for i in range(4)]
        [(), ('x',), (), ('y',)]
    """

    name: str = "observational"
    targets: tuple[str, ...] = ()
    values: object = "A"
    observational_fraction: float = 0.3
    acts: Mapping[str, Intervention] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check it, and read the values."""
        one_of("design", self.name, DESIGNS)
        given = (self.targets,) if isinstance(self.targets, str) else tuple(self.targets)
        if bool(given) == (self.name == "observational"):
            allowed = ("none with 'observational'", "one or more with the other designs")
            raise UnknownOption("targets", given, allowed)
        if len(set(given)) < len(given):
            raise UnknownOption("targets", given, ("names, each of them once",))
        share = self.observational_fraction
        share = real_number("observational_fraction", share, least=0.0, most=1.0)
        values = self.values
        if not isinstance(values, Mapping):
            values = dict.fromkeys(given, values)
        for name in given:
            if name not in values:
                raise UnknownOption("values", sorted(values), (f"a source for {name!r}, too",))
        object.__setattr__(self, "observational_fraction", share)
        object.__setattr__(self, "targets", given)
        object.__setattr__(self, "acts", {name: act_of(values[name]) for name in given})

    @typed
    def named(self, model: SCM) -> Design:
        """Return the design with the variables of a model that its patterns fit.

        Raises:
            InterventionError: A pattern fits nothing, or two fit one quantity.
        """
        found = model.named(self.acts)
        return self if found is self.acts else replace(self, targets=tuple(found), values=found)

    @typed
    def chosen(self, seed: int, first: int, count: int) -> Bools:
        """Return which targets are intervened on in some episodes, shape (count, k)."""
        seed = whole_number("seed", seed, least=0)
        first = whole_number("first", first, least=0, most=EPISODES)
        count = whole_number("count", count, least=0, most=MANY)
        episodes, k = np.arange(first, first + count), len(self.targets)
        share = Fraction(self.observational_fraction).limit_denominator(1_000_000)
        ends = np.arange(first, first + count + 1)
        watched = -((-ends * share.numerator) // share.denominator)  # before each, in whole numbers
        done = np.ones((count, k), dtype=bool)
        if self.name == "single":
            done = ((episodes - watched[:-1]) % k)[:, None] == np.arange(k)
        elif self.name == "half":
            drawn = Noise(seed).uniforms(STREAM, n=k, episode=first, count=count)
            order = np.argsort(drawn, axis=1, kind="stable")
            done = np.argsort(order, axis=1) < (k + 1) // 2
        return np.asarray(done & (np.diff(watched) == 0)[:, None])

    @typed
    def regime(self, episode: int, *, seed: int = 0) -> Regime:
        """Return the interventions of an episode."""
        episode = whole_number("episode", episode, least=0, most=EPISODES)
        ((_, _, regime),) = self.cases(seed, range(episode, episode + 1))
        return regime

    @typed
    def cases(self, seed: int, numbers: range) -> Iterator[Case]:
        """Yield the episodes of a range."""
        regimes: dict[bytes, Regime] = {}
        for number, chosen in zip(
            numbers, self.chosen(seed, numbers.start, len(numbers)), strict=True
        ):
            key = chosen.tobytes()
            if key not in regimes:
                names = [name for name, is_in in zip(self.targets, chosen, strict=True) if is_in]
                plan = Plan({name: self.acts[name] for name in names})
                regimes[key] = Regime(plan, tuple(sorted(names)))
            yield number, number, regimes[key]

    def interventions(self) -> Iterator[tuple[str, Intervention]]:
        """Yield every intervention that an episode can have, with its target."""
        yield from self.acts.items()

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "name": self.name,
            "observational_fraction": float(self.observational_fraction),
            "do": Plan(self.acts).as_dict()["do"],
        }

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules whose functions serve as mechanisms."""
        functions = (function for act in self.acts.values() for function in act.functions())
        found = {function.reference.partition(":")[0] for function in functions}
        return tuple(sorted(found))


def act_of(source: object) -> Intervention:
    """Return the intervention that draws from a space or a distribution, or sets a value."""
    draws = isinstance(source, str) or (
        isinstance(source, Frozen) and not isinstance(source, Intervention)
    )
    act: Intervention = Draw(source) if draws else as_act(source)
    return act


@final
@dataclass(frozen=True)
class Grid:
    """The points of a sweep, in turn: episode k is unit k // p at point k % p of p points.

    Attributes:
        points: The interventions at each point, by variable.
    """

    points: tuple[Mapping[str, Any], ...]

    @property
    def targets(self) -> tuple[str, ...]:
        """The variables that are set at every point."""
        return tuple(self.points[0])

    def cases(self, seed: int, numbers: range) -> Iterator[Case]:
        """Yield the episodes of a range, those of one point together."""
        size = len(self.points)
        for place, point in enumerate(self.points):
            if some := numbers[(place - numbers.start) % size :: size]:
                regime = Regime(Plan(point), tuple(sorted(point)))
                yield from ((number, number // size, regime) for number in some)

    def interventions(self) -> Iterator[tuple[str, Intervention]]:
        """Yield every intervention that an episode can have, with its target."""
        for point in self.points:
            yield from Plan(point).acts()

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {"points": [Plan(point).as_dict()["do"] for point in self.points]}
