"""What many worlds hold together: the beginning of their episodes, and interventions since then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers
from scm_world.errors import InterventionError, WrongValue
from scm_world.graph import SCM, NoiseKey
from scm_world.models import Parameters, Structure
from scm_world.variables import Draw, Hard, Intervention
from scm_world.variables.checks import check_bounds, check_space
from scm_world.variables.subsets import AnyRegion
from scm_world.world.audit import Audit, report
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.interventions import Level, Transaction, renewed, stacked
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import CompiledNoise, uniforms, words_of
from scm_world.world.snapshot import Base
from scm_world.world.structures import StructureCache

OBJECT = np.dtype(object)


@final
class SharedTransaction:
    """What worlds of one structure have done together since their episodes began.

    Without ``ask``, it is an intervention on nothing: the beginning of episodes. An intervention
    acts on parameters that move no body: it sets values, draws from boxes, or is soft. Then the
    worlds differ in numbers only, and no draw is repeated. Values and draws are written into all
    rows at once; soft interventions, and what follows from a target, are computed row by row. A
    world that goes on alone computes the ``Transaction`` that it would have had alone, from the
    same noise.

    Args:
        structures: The structures of the task.
        structure: What the engine has compiled.
        now: The present rows, shape (m, width); they are not changed.
        where: The key of the seed, the episode and the control step of each, shape (m, 3).
        seeds: The seeds.
        below: What these worlds did together before, and the place of each there; None at the
            beginning of an episode.

    Attributes:
        numbers: The rows after the intervention, shape (m, width).
        names: The static variables that it changes in at least one of them, causes before effects.
        changed: Which of these change, shape (m, names).
        refused: The places of the worlds that refuse it.
        asked: The requested names.
        model: The causal model below.
        lasting: The interventions in force, by target: one for all, or the values or the
            interventions of each, shape (m, *shape) or (m,).
        at_start: Whether this is the first instant of the episodes.
        drawn: Number of draws of each variable at this instant, including the initial one.
    """

    _request: Mapping[str, Any] = {}
    _values: Mapping[str, Sequence[object]] = {}
    _space: AnyRegion | None = None
    _acts: Mapping[str, Any] = {}
    asked: tuple[str, ...] = ()
    drawn: Mapping[str, int]
    numbers: Floats
    names: tuple[str, ...]
    changed: NDArray[np.bool_]

    def __init__(
        self,
        structures: StructureCache,
        structure: Structure,
        compiled: CompiledTask,
        now: Floats,
        where: NDArray[np.uint64],
        seeds: Sequence[int],
        below: tuple[SharedTransaction, Integers] | None = None,
    ) -> None:
        self.structures, self.structure, self.compiled = structures, structure, compiled
        self._before, self.where, self._seeds = now, where, seeds
        self.refused: list[int] = []
        self._base, self._held = now, dict[str, Any]()  # of this instant, what lasts of earlier
        self._pending: tuple[str, ...] = ()  # interventions at this instant
        self._drawn: Mapping[str, int] = {}
        self.model, self.lasting, self.at_start = compiled.model, dict[str, Any](), below is None
        if below is not None:
            one, places = below
            self.model, self.lasting = one.model, _here(one.lasting, places)
            self._held = self.lasting
            if len(where) and where[0, 2] == one.where[places[0], 2]:
                self._base, self._held = one._base[places], _here(one._held, places)
                self._pending = (*dict.fromkeys((*one._pending, *one.asked)),)
                self.at_start, self._drawn = one.at_start, one.drawn
        self._earlier = self.lasting
        self.drawn = self._drawn

    def ask(
        self,
        request: Mapping[str, Any],
        values: Mapping[str, Sequence[object]],
        space: AnyRegion | None,
    ) -> bool:
        """Compute an intervention; return False if each world has to compute it alone.

        Args:
            request: The interventions by name.
            values: Values for each of them, m of them by name: instead of those in the request.
            space: Space in which every target must lie, if any.
        """
        self._request, self._values, self._space = request, values, space
        self.asked = tuple(request)
        if not self._accept():
            return False
        self._solve()
        return True

    def _accept(self) -> bool:
        """Check the request; return whether it sets parameters that move no body."""
        compiled, model = self.compiled, self.compiled.model
        for name in self._request:
            known = name in compiled.static and name not in compiled.bundles
            if not known or name in self.structures.deciding or compiled.moves_bodies(name):
                return False
            if model.targets(name) != (name,) or name in compiled.bounded:
                return False
        acts: dict[str, Any] = {}
        self._numbers: dict[str, Floats] = {}  # those of ``values``, as they are checked
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
        self._acts = acts
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
        compiled, found = self.compiled, self._before.copy()
        where, declared, count = compiled.where, compiled.model.declared, len(found)
        own: dict[str, Any] = dict(self._numbers)
        for name, act in self._acts.items():
            if isinstance(act, Hard):
                own[name], found[:, where[name]] = act, np.ravel(act.value)
        for name, values in self._numbers.items():
            found[:, where[name]] = np.reshape(values, (count, -1))
        for names, streams, columns, low, edges in self._boxes[1]:
            streamed = [words_of(*one, range(1)) for one in zip(names, streams, strict=True)]
            drawn = uniforms(self.where, np.concatenate(streamed), len(low[0]))
            found[:, columns] = low + edges * drawn
            own |= {n: found[:, where[n]].reshape(-1, *declared(n).shape) for n in names}
        for name in self._soft:
            act, variable = self._acts[name], declared(name)
            each = range(count if act.has_draw else 0)
            settled = [act.settled(variable, self.key(place)) for place in each] or [act] * count
            own[name] = np.array(settled, dtype=object)
        # In the order of a world alone: interventions at this instant come later, draws last.
        names = (*dict.fromkeys((*self._pending, *self.asked)),)
        names = (*(n for n in self._held if n not in names), *names)
        names = sorted(names, key=self._boxes[0].__contains__)
        both = {**self._earlier, **own}
        self.lasting = {name: both[name] for name in names}
        soft = {n: one for n, one in self.lasting.items() if getattr(one, "dtype", None) is OBJECT}
        follow = [n for n in self._order if n in soft or n not in self.lasting]
        space: Any = self._space
        drawn_there = [n for n, act in self._acts.items() if getattr(act, "source", ()) == space]
        checked = [] if space is None else [n for n in self.asked if n not in drawn_there]
        for place in range(count) if follow or checked else ():
            row, key = Rows(compiled, found[place], self._soft), self.key(place)
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
        self.changed = np.array(parts, dtype=bool).reshape(len(there), count).T

    # --- one of the worlds --------------------------------------------------------------------

    def key(self, place: int) -> NoiseKey:
        """Return the noise key of one world."""
        _, episode, step = self.where[place].tolist()
        return NoiseKey(CompiledNoise(self._seeds[place]), episode, step, origin=0)

    def request(self, place: int) -> Mapping[str, Any]:
        """Return the request of one world, as it was given."""
        if not self._values:
            return self._request
        return {
            n: self._values[n][place] if n in self._values else act
            for n, act in self._request.items()
        }

    @property
    def is_one(self) -> bool:
        """Whether the same interventions are in force in all of them."""
        return all(isinstance(one, Intervention) for one in self.lasting.values())

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
        base = Base(model, row, self.structure, pending, self._drawn, self.at_start)
        before = Base(self._model(self._earlier, place), now, self.structure)
        asked = {n: self._acts.get(n, act) for n, act in self.request(place).items()}
        levels, key = [Level(asked, {})], self.key(place)
        return base, before, stacked(self.structures, base, before, levels, self._space, key)

    def audit(
        self,
        places: Integers,
        inertia: Parameters,
        reported: Parameters,
        remarks: Sequence[tuple[str, ...]],
        at: int,
    ) -> Audit:
        """Return the audit of one world.

        Args:
            places: The places of worlds that changed the same parameters.
            inertia: Their moments of inertia before, each of shape (m, 3).
            reported: What the engine reports for them.
            remarks: Its words about each; empty without any.
            at: Which of them.
        """

        def found() -> tuple[Any, ...]:
            place = int(places[at])
            old, new = ({k: v[at] for k, v in each.items()} for each in (inertia, reported))
            said = remarks[at] if remarks else ()
            _, before, done = self.done(place)
            return report(self.request(place), done, before, old, new, said)

        return Audit(found)


def _here(lasting: Mapping[str, Any], places: Integers) -> dict[str, Any]:
    """Return the interventions of some worlds."""
    each = lasting.items()
    return {name: act if isinstance(act, Hard) else act[places] for name, act in each}


def _of_one(lasting: Mapping[str, Any], place: int) -> dict[str, Intervention]:
    """Return the interventions of one world."""
    return {
        name: one if isinstance(one, Intervention) else Hard.of(np.asarray(one))
        for name, act in lasting.items()
        for one in [act if isinstance(act, Intervention) else act[place]]
    }
