"""Designs: what is done in which episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any, final

import numpy as np

from scm_world._arguments import typed
from scm_world.discovery.data.dataset import SEEN, Bools, Ints, Regime
from scm_world.errors import UnknownOption
from scm_world.queries.plans import Plan, as_act
from scm_world.variables import ACTS, Draw, Function, Intervention, Mechanism, Noise
from scm_world.variables.kinds import SPACES
from scm_world.variables.spaces import Frozen

DESIGNS = ("observational", "single", "all", "half")

STREAM = "design"
"""The stream of what a design draws by lot."""


@typed
@final
@dataclass(frozen=True)
class Design:
    """What is done in episode i: a function of the seed and of i only.

    Attributes:
        name: ``"observational"``: nothing; ``"single"``: one target in each episode, in turn;
            ``"all"``: every target, each on its own; ``"half"``: in each episode half of the
            targets (rounded up), drawn by lot.
        targets: Variables to intervene on.
        values: Where their values come from: a space ``"A"``, ``"B"`` or ``"A|B"``, a distribution,
            a value or any intervention; or a mapping of these by target.
        observational_fraction: In which share of the episodes nothing is done. They are spread
            evenly, beginning with the first one, so that the first N episodes hold the same share.

    Raises:
        UnknownOption: There is no such design, a target is given twice or has no values, or the
            share is none.

    Example:
        >>> design = Design("single", ("x", "y"), values="A", observational_fraction=0.5)
        >>> [design.regime(i).targets for i in range(4)]
        [(), ('x',), (), ('y',)]
    """

    name: str = "observational"
    targets: tuple[str, ...] = ()
    values: Any = "A"
    observational_fraction: float = 0.3
    _acts: dict[str, Intervention] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check it, and read the values."""
        if self.name not in DESIGNS:
            raise UnknownOption("design", self.name, DESIGNS)
        given = (self.targets,) if isinstance(self.targets, str) else tuple(self.targets)
        if bool(given) == (self.name == "observational"):
            allowed = ("none with 'observational'", "one or more with the other designs")
            raise UnknownOption("targets", given, allowed)
        if len(set(given)) < len(given):
            raise UnknownOption("targets", given, ("names, each of them once",))
        share = self.observational_fraction
        if isinstance(share, str) or not 0.0 <= share <= 1.0:
            raise UnknownOption("observational_fraction", share, ("a share from 0 to 1",))
        object.__setattr__(self, "targets", given)
        object.__setattr__(self, "_acts", _acts(given, self.values))

    # --- looking ------------------------------------------------------------------------------

    @property
    def acts(self) -> Mapping[str, Intervention]:
        """What is done to each target, where something is."""
        return dict(self._acts)

    def chosen(self, seed: int, first: int, count: int) -> Bools:
        """Tell which targets are intervened on, shape (count, k).

        Args:
            seed: Of the noise; only ``"half"`` draws something.
            first: Number of the first episode.
            count: How many episodes.
        """
        episodes, k = np.arange(first, first + count), len(self.targets)
        match self.name:
            case "observational":
                return np.zeros((count, 0), dtype=bool)
            case "single":
                turn = (episodes - self._seen_before(episodes)) % k
                done = turn[:, None] == np.arange(k)
            case "all":
                done = np.ones((count, k), dtype=bool)
            case _:
                lots = Noise(seed).uniforms(STREAM, n=k, episode=first, count=count)
                order = np.argsort(lots, axis=1, kind="stable")
                done = np.argsort(order, axis=1) < (k + 1) // 2
        watched = self._seen_before(episodes + 1) > self._seen_before(episodes)
        return np.asarray(done & ~watched[:, None])

    def regime(self, episode: int, *, seed: int = 0) -> Regime:
        """Say what is done in an episode."""
        return self.regime_of(self.chosen(seed, episode, 1)[0])

    def regime_of(self, chosen: Bools) -> Regime:
        """Say what is done where some targets are chosen, shape (k,)."""
        names = [name for name, is_chosen in zip(self.targets, chosen, strict=True) if is_chosen]
        if not names:
            return Regime()
        return Regime(self.plan_of(names), tuple(sorted(names)))

    def plan_of(self, names: Iterable[str]) -> Plan:
        """Give the plan that intervenes on some of the targets."""
        return Plan({name: self._acts[name] for name in names}) if names else SEEN

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data.

        Raises:
            ModelError: A value is a mechanism that cannot be found again under its name.
        """
        return {
            "name": self.name,
            "observational_fraction": float(self.observational_fraction),
            "do": self.plan_of(self.targets).as_dict()["do"],
        }

    @property
    def modules(self) -> tuple[str, ...]:
        """Name the modules whose functions serve as mechanisms."""
        functions = (a.function for a in self._acts.values() if isinstance(a, Mechanism))
        found = {f.reference.partition(":")[0] for f in functions if isinstance(f, Function)}
        return tuple(sorted(found))

    # --- how the watched episodes are spread --------------------------------------------------

    @cached_property
    def _share(self) -> Fraction:
        share = 1 if self.name == "observational" else self.observational_fraction
        return Fraction(share).limit_denominator(1_000_000)

    def _seen_before(self, episodes: Ints) -> Ints:
        """Count the watched episodes before each of some episodes, in whole numbers."""
        over, under = self._share.as_integer_ratio()
        return -((-episodes * over) // under)


def _acts(targets: tuple[str, ...], values: Any) -> dict[str, Intervention]:
    if not isinstance(values, Mapping):
        act = act_of(values)
        return dict.fromkeys(targets, act)
    for name in targets:
        if name not in values:
            raise UnknownOption("values", sorted(values), (f"a source for {name!r}, too",))
    return {name: act_of(values[name]) for name in targets}


def act_of(source: Any) -> Intervention:
    """Turn a source of values into an intervention.

    Args:
        source: A space, a distribution, a value or an intervention.

    Raises:
        UnknownOption: It is none of these.

    Example:
        >>> act_of("A"), act_of(0.5)
        (Draw(kind='draw', source='A'), Hard(kind='hard', value=0.5))
    """
    if isinstance(source, str):
        if source not in SPACES:
            raise UnknownOption("values", source, (*SPACES, "a distribution, such as a Box"))
        return Draw(source)
    if isinstance(source, Frozen) and not isinstance(source, ACTS):
        return Draw(source)
    act: Intervention = as_act(source)
    return act
