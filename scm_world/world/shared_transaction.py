"""One intervention on parameters, done in the rows of many worlds at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.errors import InterventionError, WrongValue
from scm_world.graph import SCM
from scm_world.models import Parameters
from scm_world.variables import Draw, Hard, Intervention
from scm_world.variables.checks import check_bounds, check_space
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import report
from scm_world.world.interventions import Level, Transaction, renewed, stacked
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import uniforms, words_of
from scm_world.world.snapshot import Base

if TYPE_CHECKING:
    from scm_world.world.simulation import Simulation

OBJECT = np.dtype(object)


@final
class SharedTransaction:
    """An intervention that worlds of one structure, under equal interventions, take together.

    It acts on parameters that move no body: it sets values, draws from boxes, or is soft. Then the
    worlds differ in numbers only, and no draw is repeated. Values and draws are written into all
    rows at once; soft interventions, and what follows from a target, are computed row by row. A
    world that is asked about the intervention later computes the ``Transaction`` that it would have
    had alone, from the same noise.

    Args:
        worlds: Worlds whose ``alike`` is equal.
        now: Their present rows, shape (m, width); they are not changed.
        request: The interventions by name.
        values: Values for each of them, m of them by name: instead of those in the request.
        space: Space in which every target must lie, if any.

    Attributes:
        fits: Whether the intervention is of this kind; the others hold only if so.
        numbers: The rows afterwards, shape (m, width).
        names: The static variables that change in at least one of them, causes before effects.
        changed: Which of these change, shape (m, names).
        refused: The places of the worlds that refuse it, among ``worlds``.
        asked: The requested names.
        model: The causal model below.
        lasting: The interventions that these worlds took together, by target: one for all, or
            the values or the interventions of each, shape (m, *shape) or (m,).
        at_start: Whether this is the first instant of the episodes.
        drawn: Number of draws of each variable at this instant, including the initial one.
    """

    _base: Floats
    _held: Mapping[str, Any]  # what lasts of earlier instants
    at_start: bool

    def __init__(
        self,
        worlds: Sequence[Simulation],
        now: Floats,
        request: Mapping[str, Any],
        values: Mapping[str, Sequence[object]],
        space: AnyRegion | None,
    ) -> None:
        first = worlds[0]
        self.compiled, self._structures = first.compiled, first.structures
        self._structure, self._request, self._values = first.structure, request, values
        self._space = first.variables_space if space is None else as_region("space", space)
        self._before, self.asked = now, tuple(request)
        self._numbers: dict[str, Floats] = {}  # those of ``values``, as they are checked
        self._keys = [world.noise_key(world.index) for world in worlds]
        places = np.array([world.shared[1] for world in worlds if world.shared], dtype=int)
        below = None if first.shared is None else first.shared[0]
        self.model: SCM = first.graph if below is None else below.model

        def here(lasting: Mapping[str, Any]) -> dict[str, Any]:
            each = lasting.items()
            return {name: act if isinstance(act, Hard) else act[places] for name, act in each}

        self._earlier = {} if below is None else here(below.lasting)
        self._pending: tuple[str, ...] = ()  # what of it was done at this instant
        if below is not None and first.is_at_shared:
            self._base, self._held = below._base[places], here(below._held)
            self._pending = (*dict.fromkeys((*below._pending, *below.asked)),)
            self.at_start, self._drawn = below.at_start, below.drawn
        else:
            base = first.base if below is None else None
            self._base, self._held, self._drawn = now, self._earlier, dict[str, int]()
            self.at_start = base is not None and base.at_start
        self.drawn: Mapping[str, int] = self._drawn
        self.fits = self._accept()
        if self.fits:
            self._solve()

    def _accept(self) -> bool:
        """Check the request; return whether it sets parameters that move no body."""
        compiled, model = self.compiled, self.compiled.model
        for name in self._request:
            known = name in compiled.static and name not in compiled.bundles
            if not known or name in self._structures.deciding or compiled.moves_bodies(name):
                return False
            bounds = model.declared(name).bounds
            if model.targets(name) != (name,) or (bounds is not None and bounds.parents()):
                return False
        acts: dict[str, Any] = {}
        try:
            for name, act in self._request.items():
                if name not in self._values:
                    acts[name] = model.accept(name, act)
                    continue
                hard = np.array([model.accept(name, one).constant for one in self._values[name]])
                self._numbers[name] = hard.reshape(-1, *model.declared(name).shape)
        except InterventionError:  # a world alone says what is wrong
            return False
        draws = [name for name, act in acts.items() if isinstance(act, Draw)]
        self._soft = [n for n, act in acts.items() if act.is_soft and act.lower is None]
        hard_ones = [name for name, act in acts.items() if isinstance(act, Hard)]
        if len(acts) > len(draws) + len(hard_ones) + len(self._soft):
            return False
        if draws or self._soft:
            initial = compiled.random if self.at_start else ()
            acts, self.drawn = renewed(acts, self._drawn, initial)
        self._acts: dict[str, Any] = acts
        self._boxes = compiled.boxes(tuple((n, acts[n].source, acts[n].stream) for n in draws))
        self._order = compiled.static_order(self.asked)
        return not (
            self._boxes[0] != {*draws}
            or self.model.adds_edges
            or not compiled.composition.structural.isdisjoint(self._order)
        )

    @np.errstate(all="ignore")  # values that are not finite are refused by name
    def _solve(self) -> None:
        """Compute the rows, as ``Transaction.solve`` does for one."""
        compiled, keys, found = self.compiled, self._keys, self._before.copy()
        where, declared = compiled.where, compiled.model.declared
        own: dict[str, Any] = dict(self._numbers)
        for name, act in self._acts.items():
            if isinstance(act, Hard):
                own[name], found[:, where[name]] = act, np.ravel(act.value)
        for name, values in self._numbers.items():
            found[:, where[name]] = np.reshape(values, (len(found), -1))
        for names, streams, columns, low, edges in self._boxes[1]:
            streamed = [words_of(*one, range(1)) for one in zip(names, streams, strict=True)]
            drawn = uniforms(keys, np.concatenate(streamed), len(low[0]))
            found[:, columns] = low + edges * drawn
            own |= {n: found[:, where[n]].reshape(-1, *declared(n).shape) for n in names}
        for name in self._soft:
            act, variable = self._acts[name], declared(name)
            settled = [act.settled(variable, key) for key in keys] if act.has_draw else [act]
            own[name] = np.array(settled * (len(keys) // len(settled)), dtype=object)
        self.lasting: dict[str, Any] = {**self._earlier, **own}
        soft = {n: one for n, one in self.lasting.items() if getattr(one, "dtype", None) is OBJECT}
        follow = [n for n in self._order if n in soft or n not in self.lasting]
        space: Any = self._space
        drawn_there = [n for n, act in self._acts.items() if getattr(act, "source", ()) == space]
        checked = [] if space is None else [n for n in self.asked if n not in drawn_there]
        self.refused: list[int] = []
        for place, key in enumerate(keys) if follow or checked else ():
            row = Rows(compiled, found[place], self._soft)
            try:
                for name in follow:
                    act = soft[name][place].on(self.model._beneath(name)) if name in soft else None
                    applied = None if act is None else self.model._applied(name, act)
                    value, variable = self.model.evaluate(name, row, key, applied), declared(name)
                    if value.shape != variable.shape:
                        raise WrongValue(name, value, variable.shape, value.shape)
                    check_bounds(variable, value, row)
                    row[name] = value
                for name in checked:
                    check_space(declared(name), row[name], space, row)
            except InterventionError:
                self.refused.append(place)
        self.numbers = found
        owners = compiled.owners[(found != self._before).any(axis=0)]
        there = [compiled.static_names[number] for number in np.unique(owners[owners >= 0])]
        self.names = tuple(there)
        parts = [(found[:, where[n]] != self._before[:, where[n]]).any(axis=1) for n in there]
        self.changed: NDArray[np.bool_] = (
            np.array(parts, dtype=bool).reshape(len(there), len(found)).T
        )

    # --- one of the worlds --------------------------------------------------------------------

    def request(self, place: int) -> Mapping[str, Any]:
        """Return the request of one world, as it was given."""
        if not self._values:
            return self._request
        return {
            n: self._values[n][place] if n in self._values else act
            for n, act in self._request.items()
        }

    def graph(self, place: int) -> SCM:
        """Return the model of one world, with the interventions in force."""
        return self._model(self.lasting, place)

    def _model(self, lasting: Mapping[str, Any], place: int) -> SCM:
        acts = _of_one(lasting, place)
        return self.model._with_interventions(acts) if acts else self.model

    def done(self, place: int) -> tuple[Base, Base, Transaction]:
        """Return the base and the present of one world before, and what it would do alone."""
        model, acts = self._model(self._held, place), _of_one(self._earlier, place)
        pending = {name: (name, acts[name]) for name in self._pending}
        row, now = (Rows(self.compiled, one[place].copy()) for one in (self._base, self._before))
        base = Base(model, row, self._structure, pending, self._drawn, self.at_start)
        before = Base(self._model(self._earlier, place), now, self._structure)
        asked = {n: self._acts.get(n, act) for n, act in self.request(place).items()}
        levels, key = [Level(asked, {})], self._keys[place]
        return base, before, stacked(self._structures, base, before, levels, self._space, key)

    def report(
        self, place: int, inertia: Parameters, reported: Parameters, remarks: tuple[str, ...]
    ) -> tuple[Any, ...]:
        """Return the attributes of the ``Audit`` of one world; see ``scm_world.world.audit``."""
        _, before, done = self.done(place)
        return report(self.request(place), done, before, inertia, reported, remarks)


def _of_one(lasting: Mapping[str, Any], place: int) -> dict[str, Intervention]:
    """Return the interventions of one world."""
    return {
        name: one if isinstance(one, Intervention) else Hard.of(np.asarray(one))
        for name, act in lasting.items()
        for one in [act if isinstance(act, Intervention) else act[place]]
    }
