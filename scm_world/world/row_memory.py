"""What many worlds did together: the beginning of their episodes, and interventions since then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Integers, Mask
from scm_world.errors import InterventionError
from scm_world.graph import SCM, NoiseKey
from scm_world.models import Parameters, Structure
from scm_world.variables import Hard, Intervention
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.variables.subsets import AnyRegion
from scm_world.world.audit import Audit, report
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.interventions import Level, Transaction, renewed, stacked
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import CompiledNoise
from scm_world.world.snapshot import Base
from scm_world.world.structures import StructureCache

Named = dict[str, tuple[str, Any]]
"""By target: the requested name, and an intervention; or the values (m, *shape) or interventions
(m,) of m worlds."""

Change = tuple[Integers, list[str], bool]
"""Places of rows that change alike, the static variables that do, and whether the engine's state
does."""


@final
class RowMemory:
    """What worlds of one structure have done together since their episodes began.

    Without ``ask``, it is an intervention on nothing: the beginning of episodes. With it, one
    ``Transaction`` is accepted for all worlds, and solved in each row. A world that goes on alone
    computes the ``Transaction`` that it would have had alone, from the same noise; so does an
    audit when it is read.

    Args:
        structures: The structures of the task.
        structure: What the engine has compiled.
        compiled: The task compiled for it.
        now: The present rows, shape (m, width); they are not changed.
        where: The key of the seed, the episode and the control step of each, shape (m, 3).
        seeds: The seeds.
        below: What these worlds did together before, and the place of each there; None at the
            beginning of an episode.

    Attributes:
        numbers: The rows after the intervention, shape (m, width).
        groups: The places of the worlds by what changes in them; see ``changes``.
        differs: Whether anything changes in each world, shape (m,).
        states: The states as the engine reported them, if it was given any, shape (m, size).
        refused: The places of the worlds that refuse it, or have to compute it alone.
        asked: The requested names.
        model: The causal model below.
        in_force: The interventions of this episode, and on states those of this instant.
        at_start: Whether this is the first instant of the episodes.
        drawn: Number of draws of each variable at this instant, including the initial one.
    """

    _request: Mapping[str, Any] = {}
    _values: Mapping[str, Sequence[object]] = {}
    _space: AnyRegion | None = None
    asked: tuple[str, ...] = ()
    states: Floats | None = None
    drawn: Mapping[str, int]
    numbers: Floats
    groups: list[Change]
    differs: Mask

    def __init__(
        self,
        structures: StructureCache,
        structure: Structure,
        compiled: CompiledTask,
        now: Floats,
        where: NDArray[np.uint64],
        seeds: Sequence[int],
        below: tuple[RowMemory, Integers] | None = None,
    ) -> None:
        self.structures, self.structure, self.compiled = structures, structure, compiled
        self._before, self.where, self._seeds = now, where, seeds
        self.refused: list[int] = []
        self._base, self._held = now, Named()  # of this instant, and what lasts of earlier ones
        self._pending: tuple[str, ...] = ()  # targets at this instant
        self._acts: Mapping[str, Any] = {}
        self._drawn: Mapping[str, int] = {}
        self.model, self.in_force, self.at_start = compiled.model, Named(), below is None
        if below is not None:
            one, places = below
            self.in_force = _here(one.in_force, places)
            if len(where) and where[0, 2] == one.where[places[0], 2]:
                self._base, self._held = one._base[places], _here(one._held, places)
                self._pending = one._pending
                self.at_start, self._drawn = one.at_start, one.drawn
            else:
                by_hand = compiled.set_by_hand
                self.in_force = {t: act for t, act in self.in_force.items() if t not in by_hand}
                self._held = self.in_force
        self._earlier, self._waiting = self.in_force, self._pending
        self.drawn = self._drawn

    def ask(
        self,
        request: Mapping[str, Any],
        values: Mapping[str, Sequence[object]],
        space: AnyRegion | None,
    ) -> bool:
        """Compute an intervention; return False if each world has to compute it alone.

        These are: what changes which bodies exist or what the engine compiles, sets the clock, or
        is on an action; an intervention that acts on another one; a value in other coordinates;
        and what is wrong in all of them.

        Args:
            request: The interventions by name.
            values: Values for each of them, m of them by name: instead of those in the request.
            space: Space in which every target must lie, if any.
        """
        compiled, model, declared = self.compiled, self.compiled.model, self.compiled.model.declared
        by_hand, deciding = compiled.set_by_hand, self.structures.deciding
        if any(name not in model or name in deciding for name in request):
            return False
        first = {n: values[n][0] if n in values else act for n, act in request.items()}
        own: dict[str, Any] = {}
        try:
            accepted = {name: model.accept(name, act) for name, act in first.items()}
            for name, each in values.items():
                hard = np.array([model.accept(name, one).constant for one in each])
                own[name] = hard.reshape(-1, *declared(name).shape)
        except InterventionError:  # a world alone says what is wrong
            return False
        initial = compiled.random if self.at_start else ()
        first, self.drawn = renewed(first, self._drawn, initial)
        self._acts = {name: act for name, act in first.items() if name not in values}
        self._request, self._values, self._space = request, values, space
        base = self._base_of(0)
        done = Transaction(self.structures, base, first, space, self.key(0))
        for name in done.relative:
            act: Any = model.accept(name, first[name])
            settled = [act.settled(declared(name), self.key(n)) for n in range(len(self.where))]
            own[name] = np.array(settled, dtype=object)
        others = [n for n in done.asked if model.targets(n) != (n,) and n not in compiled.bundles]
        if (
            done.problems
            or not {CONTROL_INDEX, *compiled.actions}.isdisjoint(done.pending)
            or any(act.lower is not None for act in accepted.values())
            or any(accepted[name].constant is not None for name in others)
            or any(model.targets(name) != (name,) for name in own)
            or not compiled.composition.structural.isdisjoint(done.order)
        ):
            return False
        targets = {target for name in done.asked for target in model.targets(name)}
        kept = {t: one for t, (_, one) in self.in_force.items() if isinstance(one, np.ndarray)}
        there = {*done.order, *done.pending}.difference(targets)
        kept = {t: one for t, one in kept.items() if t in there} | own
        bases, now = (Rows(compiled, numbers) for numbers in (self._base, self._before))
        found, self.refused = done.solve_rows(
            bases, now, self.where, self.key, kept, lambda place: self.done(place)[2]
        )
        self.numbers, self.asked = found, done.asked
        self.groups, self.differs = changes(compiled, self._before, found)
        anew: Named = {}
        for target, (name, act) in done.pending.items():
            if target not in targets:
                anew[target] = self._earlier[target]
            elif target in own:
                anew[target] = target, own[target]
            elif act.draws or (target in by_hand and act.constant is None and not act.releases):
                drawn = found[:, compiled.where[target]]
                anew[target] = target, drawn.reshape(-1, *declared(target).shape)
            else:
                anew[target] = name, act
        # In the order of a world alone: interventions at this instant come later, draws last.
        self._pending = (*dict.fromkeys((*self._pending, *anew)),)
        names = (*(t for t in self._held if t not in self._pending), *self._pending)
        both = {**self._earlier, **anew}
        self.in_force = {t: both[t] for t in sorted(names, key={*done.draws}.__contains__)}
        return True

    # --- one of the worlds --------------------------------------------------------------------

    def key(self, place: int) -> NoiseKey:
        """Return the noise key of one world."""
        _, episode, step = self.where[place].tolist()
        return NoiseKey(CompiledNoise(self._seeds[place]), episode, step, origin=0)

    def request(self, place: int) -> Mapping[str, Any]:
        """Return the request of one world, as it was given."""
        return {
            n: self._values[n][place] if n in self._values else act
            for n, act in self._request.items()
        }

    @property
    def is_one(self) -> bool:
        """Whether the same interventions are in force in all of them."""
        return all(isinstance(one, Intervention) for _, one in self.in_force.values())

    def graph(self, place: int) -> SCM:
        """Return the model of one world, with the interventions in force."""
        return self._model(self.in_force, place)

    def _model(self, acts: Named, place: int) -> SCM:
        by_hand = self.compiled.set_by_hand
        held = dict(_of_one(one, place) for t, one in acts.items() if t not in by_hand)
        return self.model._with_interventions(held) if held else self.model

    def _base_of(self, place: int) -> Base:
        model, row = self._model(self._held, place), Rows(self.compiled, self._base[place].copy())
        pending = {t: _of_one(self._earlier[t], place) for t in self._waiting}
        return Base(model, row, self.structure, pending, self._drawn, self.at_start)

    def done(self, place: int) -> tuple[Base, Base, Transaction]:
        """Return the base and the present of one world before, and what it would do alone."""
        base, now = self._base_of(place), Rows(self.compiled, self._before[place].copy())
        before = Base(self._model(self._earlier, place), now, self.structure)
        asked = {n: self._acts.get(n, act) for n, act in self.request(place).items()}
        levels, key = [Level(asked, {})], self.key(place)
        done = stacked(self.structures, base, before, levels, self._space, key)
        if self.states is not None:
            done.row.numbers[: self.compiled.state_size] = self.states[place]
        return base, before, done

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


def _here(acts: Named, places: Integers) -> Named:
    """Return the interventions of some worlds."""
    return {
        target: (name, one[places] if isinstance(one, np.ndarray) else one)
        for target, (name, one) in acts.items()
    }


def _of_one(named: tuple[str, Any], place: int) -> tuple[str, Intervention]:
    """Return the requested name, and the intervention of one world."""
    name, one = named
    own = one[place] if isinstance(one, np.ndarray) else one
    return name, own if isinstance(own, Intervention) else Hard.of(np.asarray(own))


def changes(compiled: CompiledTask, now: Floats, then: Floats) -> tuple[list[Change], Mask]:
    """Return how rows differ, in groups that differ in the same variables.

    Args:
        compiled: The task.
        now: The rows before, shape (m, width).
        then: The rows afterwards, shape (m, width).

    Returns:
        The groups, together all rows; and whether each row differs in parameters or states.
    """
    differ, layout = now != then, compiled.composition.system.layout
    owners = {*compiled.owners[differ.any(axis=0)].tolist()}
    names = [compiled.static_names[number] for number in sorted(owners) if number >= 0]
    parts = [differ[:, compiled.where[name]].any(axis=1) for name in names]
    moves = differ[:, : compiled.state_size] & layout.can_be_set
    taken = (moves & layout.engine_takes).any(axis=1)
    patterns: NDArray[np.bool_] = np.array([*parts, taken]).T
    kinds, of = patterns[:1], np.zeros(len(now), dtype=int)  # nearly always alike
    if (patterns != kinds).any():
        kinds, of = np.unique(patterns, axis=0, return_inverse=True)
    groups = [
        (
            np.flatnonzero(of.ravel() == number),
            [name for name, is_one in zip(names, kind[:-1], strict=True) if is_one],
            bool(kind[-1]),
        )
        for number, kind in enumerate(kinds)
    ]
    return groups, patterns.any(axis=1) | moves.any(axis=1)
