"""Interventions: checking a request, solving the mutilated model, and feasibility of the scene."""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats, Value
from scm_world.errors import (
    ClosesCycle,
    ConflictingTargets,
    Infeasible,
    InterventionError,
    NotIntervenable,
    OutOfBounds,
    ScmWorldError,
    UnknownVariable,
    WrongValue,
    in_one_line,
    raise_all,
)
from scm_world.graph import SCM, NoiseKey
from scm_world.models import Difference
from scm_world.models.scene import Overlap
from scm_world.variables import Draw, Hard, Intervention, Rotations
from scm_world.variables.checks import check_bounds, check_space, coerce
from scm_world.variables.distributions import word_of
from scm_world.variables.interventions import refuse_time
from scm_world.variables.subsets import AnyRegion
from scm_world.world.compiled_task import PendingInterventions
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import uniforms, words_of
from scm_world.world.snapshot import Base
from scm_world.world.structures import StructureCache, restructured

ATTEMPTS = 1000
"""Maximal number of draws; one in sixty draws of the joints from A keeps the fingers apart."""
CHUNK = 64
"""Number of draws that are screened together."""
ROUNDING = 1e-6
"""Tolerance for the increase of an overlap [m]."""


def same(a: Value, b: Value) -> bool:
    """Return whether two arrays of one shape hold the same numbers."""
    return a is b or bool((a == b).all())


def fixed_action(name: str, acts: Sequence[Intervention]) -> Value:
    """Return the constant action that the interventions on its parts set, or refuse others."""
    values = [np.asarray(act.constant) for act in acts if act.constant is not None]
    if len(values) == len(acts):
        return values[0] if len(values) == 1 else np.concatenate([v.ravel() for v in values])
    raise InterventionError(
        f"do({name}): {acts[0]!r} varies from step to step, so it cannot be compared "
        "with a space; leave out `space`, or give one action as numbers",
        variable=name,
    )


def renewed(
    request: Mapping[str, Any], drawn: Mapping[str, int], initial: Container[str] = ()
) -> tuple[dict[str, Any], dict[str, int]]:
    """Return the request, with fresh noise for repeated draws at this instant, and new counts.

    ``drawn`` counts the draws of each variable so far; those of ``initial`` began with one.
    """
    counts = dict(drawn)

    def fresh(name: str, act: Draw) -> Draw:
        if act.stream is not None or act.of is not None:
            return act
        times = drawn.get(name, int(name in initial))
        counts[name] = times + 1
        return act.model_copy(update={"stream": f"draw {times}"}) if times else act

    acts = {n: a for n, a in request.items() if isinstance(a, Intervention)}
    return {**request, **{name: act.redrawn(name, fresh) for name, act in acts.items()}}, counts


class Level(NamedTuple):
    """The interventions of an instant up to a level: the context, or what is asked, too.

    Attributes:
        request: The interventions by dotted name.
        draws: The draws at their roots, by the variable or bundle that is drawn. Equal ones of
            both levels are one draw.
    """

    request: Mapping[str, Any]
    draws: Mapping[str, Intervention]


def source_of(name: str, act: Intervention) -> str:
    """Return the variable or bundle that the root of an intervention was requested of."""
    asked, root = act.lowest(name)
    return root.whole(asked)


@final
class Transaction:
    """A checked intervention, and the world after it for one noise key.

    The constructor accepts the request and mutilates the model; ``solve`` computes ``row`` for one
    noise key, which parameters have ``changed``, and the ``change`` of the backend; ``remains``
    returns the model and what is pending. Arguments are those of ``feasible``.

    Attributes:
        base: The base in the requested structure.
        asked: The names of the request without errors.
        pending: All interventions at this control step, by target. Those on removed bodies are
            kept, in case the bodies are added again at the same instant.
        acts: The interventions on existing variables.
        relative: Shifts and scales by the numbers that were drawn for them, by requested name.
        model: The model with the interventions that would be in force, draws among them.
        problems: The errors that do not depend on draws.
        order: The targets among the parameters and what follows from them, causes first.
        draws: The targets that are drawn.
        attempts: The attempt of each draw beneath what is asked, by variable; see ``stacked``.
    """

    row: Rows
    change: Difference | None = None
    attempts: Mapping[str, int] | None = None
    _own: frozenset[str] = frozenset()  # targets on which each of several rows has its own

    def __init__(
        self,
        structures: StructureCache,
        base: Base,
        request: Mapping[str, Any],
        space: AnyRegion | None,
        key: NoiseKey,
        found: Iterable[InterventionError] = (),
    ) -> None:
        self.problems = [*found]
        self.request, self.space, self._deciding = request, space, structures.deciding
        self._key, self.relative = key, dict[str, Intervention]()
        asked = [*base.pending.values(), *request.items()]
        if any(getattr(act, "removes", False) or name in self._deciding for name, act in asked):
            base, wrong = restructured(structures, base, request, key)
            request = {name: act for name, act in request.items() if name not in wrong}
            self.problems += wrong.values()
        self.base, self.compiled, self.model = base, base.row.compiled, base.model
        self.pending = {**base.pending, **self._accepted(request)}
        there, by_hand = self.compiled.where, self.compiled.set_by_hand
        self.acts = {t: named for t, named in self.pending.items() if t in there}
        self._states = [t for t in self.acts if t in by_hand]
        computing = [t for t, (_, act) in self.acts.items() if act.root.computes]
        moving = self._refused_mechanisms(computing) if computing else {}
        self.problems += {problem.variable: problem for problem in moving.values()}.values()
        self._impossible = {*moving}  # what has no possible value
        self._boxes: tuple[Any, Any] = (), ()  # draws from boxes that follow nothing; see ``boxes``
        self.draws: list[str] = []
        self.changed: list[str] = []
        self._targets: tuple[str, ...] = ()
        self.order: tuple[str, ...] = ()
        if len(self._states) < len(self.acts):
            self._mutilate({t: named for t, named in self.acts.items() if t not in by_hand})
        self._always_impossible = frozenset(self._impossible)

    def _accepted(self, request: Mapping[str, Any]) -> PendingInterventions:
        """Check names, types and shapes; interventions on a bundle are divided among its parts."""
        base, compiled, model = self.base, self.compiled, self.compiled.model
        accepted: PendingInterventions = {}
        by_target: dict[str, str] = {}
        for name, value in request.items():
            entities = (entity.name for entity in compiled.composition.entities)
            released = getattr(value, "releases", False) and name in entities
            if released or getattr(value, "removes", False):
                if name not in model:
                    refuse_time(name, value)
                continue  # of an entity; see ``restructured``. Released entities exist.
            try:
                try:
                    act = model.accept(name, value)
                except OutOfBounds as problem:
                    # Physics may exceed bounds, so a state can always be set to its present value.
                    present = base.value(name)
                    if present is None or not np.array_equal(problem.value, present):
                        raise
                    act = Hard(problem.value)
                if act.is_soft and name not in compiled.commanded:
                    act = self._in_numbers(name, act)
                targets = model.targets(name)
                for target in targets:
                    if target not in compiled.static and target not in compiled.moved_by_hand:
                        there = compiled.static | compiled.moved_by_hand
                        causes = [n for n in model.parents(target) if n in there]
                        raise NotIntervenable(name, "is computed in every step", causes)
                    if target in by_target:
                        raise ConflictingTargets((by_target[target], name), target)
                    by_target[target] = name
            except InterventionError as problem:
                reason = compiled.composition.system.refused.get(name)
                refused = reason is not None and isinstance(problem, UnknownVariable)
                self.problems.append(NotIntervenable(name, str(reason)) if refused else problem)
                continue
            if name in compiled.bundles:
                parts = act.divided(model.declared(name)).items()
                accepted |= {model.target(part): (part, own) for part, own in parts}
                continue
            target = targets[0]
            accepted[target] = name, act
            if name != target and act.constant is not None:
                # The inverse of coordinates is rounded. Present coordinates set the present value
                # of the quantity itself, so that undoing leaves no trace.
                quantity, present = base.value(target), base.value(name)
                if present is not None and np.array_equal(act.constant, np.ravel(present)):
                    accepted[target] = target, Hard(quantity)
        self.asked = tuple(dict.fromkeys(by_target.values()))
        return accepted

    def _in_numbers(self, name: str, act: Intervention) -> Intervention:
        """Draw what soft interventions add or multiply by; that of an action is drawn in steps."""
        below = act.lower and (act.lower[0], self._in_numbers(*act.lower))
        if act.is_soft and act.has_draw:
            settled = act.settled(self.compiled.model.declared(name), replace(self._key, kept=None))
            self.relative[name], act = settled.on(None), settled
        changed = below is not None and below[1] is not act.lower[1]  # type: ignore[index]
        return act.on(below) if changed else act

    def _mutilate(self, acts: PendingInterventions) -> None:
        """Mutilate the model, and order the descendants of the targets."""
        compiled, base = self.compiled, self.base.model
        roots = {target: act.root for target, (_, act) in acts.items()}
        computes = any(root.computes for root in roots.values())
        draws = {t: acts[t] for t, root in roots.items() if root.draws}
        if draws:
            alone = ((t, n, act) for t, (n, act) in draws.items() if isinstance(act, Draw))
            whole = [(t, a.source, a.stream) for t, n, a in alone if t == n and not a.of]
            self._boxes = compiled.boxes(tuple(whole)) if whole else self._boxes
        # Without added edges, the values of draws from boxes are not needed yet.
        later = () if base.adds_edges or computes else self._boxes[0]
        out = self._impossible
        kept = dict([acts[t] for t in acts if t not in out and t not in later])
        cycles: list[ClosesCycle] = []
        if draws or computes or base.adds_edges:
            self.model, cycles = base._without_cycles(kept)
        else:
            self.model = base._with_interventions(kept)
        self.problems += cycles
        out.update(*[problem.cycle for problem in cycles])
        static = compiled.static
        self._targets = tuple([t for t in acts if t in static and t not in out])
        self.draws = [target for target in draws if target in self._targets]
        if self.model.adds_edges:
            structure = self.model.structure
            follow = {*self._targets, *structure.instant_descendants(self._targets)}
            self.order = tuple(n for n in structure.order if n in follow and n in static)
        else:
            self.order = compiled.static_order(self._targets)

    def _refused_mechanisms(self, computing: list[str]) -> dict[str, InterventionError]:
        """Return an error for each mechanism with a moving parent, or that fails now."""
        found: dict[str, InterventionError] = {}
        compiled, row = self.compiled, self.base.row
        for target in computing:
            name, act = self.acts[target]
            whole = compiled.model._applied(name, act)
            requested = whole.root.requested
            asked, parents = requested.name, whole.root.intervention.follows(requested)
            known, who, what = compiled.static, "a parameter", "parameters of the same instant"
            if target in compiled.actions:
                known, who, what = frozenset(compiled.model), "an action", "the present"
            elif target in compiled.set_by_hand:
                known |= compiled.slices.keys()
                who, what = "a state", "parameters and states"
            names = tuple(parent.name for parent in parents)
            moving = [p.name for p in parents if p.lag or p.name not in known]
            if moving:
                found[target] = InterventionError(
                    f"do({asked}): {who} can follow {what} only, not {', '.join(moving)}; let a "
                    "plan set it step by step instead",
                    variable=asked,
                    value=act,
                )
            if moving or target not in compiled.actions:
                continue
            try:  # it is computed in every control step
                row = row.copy()
                row.evaluate(names)
                requested = whole.requested
                value = compiled.model._intended(target, whole, row, self._key)
                if value.shape != requested.shape:
                    raise WrongValue(asked, act, requested.shape, value.shape)
                if not np.isfinite(value).all():
                    raise WrongValue(asked, value)
            except InterventionError as problem:
                found[target] = problem
            except Exception as error:
                text = f"do({asked}): its function raised {in_one_line(error)}"
                found[target] = InterventionError(text, variable=asked, value=act)
        return found

    # --- solving ------------------------------------------------------------------------------

    @np.errstate(all="ignore")  # values that are not finite are refused by name
    def solve(self, key: NoiseKey, now: Base) -> list[InterventionError]:
        """Solve for the parameters, then for the states; return the problems.

        A mechanism is not called with invalid values of its parents. Without problems, the
        differences from the present ``now`` are ``changed`` and ``change``.
        """
        drawn, groups = self._boxes
        self._known: dict[str, tuple[str, Any]] = {}  # see ``settled``
        self._key, numbers = key, self.base.row.numbers.copy()
        self.row = Rows(self.compiled, numbers, self._targets)
        self._wrong, self._impossible = [*self.problems], {*self._always_impossible}
        for names, streams, columns, low, edges in groups:
            own = zip(names, streams, strict=True)
            words = [word_of(key.stream(*one, key.attempt)) for one in own]
            found = uniforms(key, np.array(words, dtype=np.uint64), len(low[0]))
            numbers[columns] = low + edges * found
        self.row.unknown.difference_update(drawn)
        bounded, acts = self.compiled.bounded, self.acts
        for name in self.order:
            if name in drawn:
                continue
            asked, act = acts.get(name, (name, None))
            free = act is not None and asked == name and name not in bounded
            constant = act.constant if free else None  # type: ignore[union-attr]
            if constant is not None:
                self.row[name] = constant  # it has been checked
            else:
                self._compute(name, follows=name in bounded)
        carries = not self.compiled.carriers.isdisjoint(self.order)
        if (carries or self._states or self.base.fresh) and self._impossible.isdisjoint(
            self._deciding
        ):
            self._set_states()
        if self.space is not None:
            self._check_space(self.space)
        if self._wrong:
            return self._as_asked()
        self.changed = now.row.differing(self.row)
        self.change = difference(now, self.row, self.changed)
        return []

    def obstacles(self, now: Base, draws: Collection[str]) -> list[Any]:
        """List overlaps deeper than those that physics left; or where draws may not put a body."""
        found: list[Any] = []
        if self.change is not None:
            found = overlaps(self.base, now, self.row, self.change, self.asked)
        composition = self.compiled.composition
        if composition.kept_clear and draws and not found:  # of values, all are allowed
            varied = self.compiled.reached(draws)
            if not composition.kept_clear.isdisjoint(varied):
                found = [*composition.obstructed(self.compiled.scene(self.row), varied)]
        return found

    def solve_rows(
        self,
        bases: Rows,
        now: Rows,
        where: NDArray[np.uint64],
        key: Callable[[int], NoiseKey],
        own: Mapping[str, Any],
        alone: Callable[[int], Transaction],
    ) -> tuple[Floats, list[int]]:
        """Solve for worlds that differ in their numbers and their noise only.

        Args:
            bases: Their rows as physics left them.
            now: Their present rows.
            where: The key of the seed, the episode and the control step of each, shape (m, 3).
            key: Returns the noise key of one of them.
            own: What each has of its own, by target: values, shape (m, *shape), or interventions,
                shape (m,).
            alone: Computes what one of them does alone, drawing again where bodies overlap.

        Returns:
            The rows afterwards, shape (m, width), and the places of those that refuse it.
        """
        numbers, acts = bases.numbers.copy(), dict(self.acts)
        drawn, groups = self._boxes
        found = Rows(self.compiled, numbers)
        constants: dict[str, Any] = {t: a.constant for t, (name, a) in acts.items() if name == t}
        constants |= {t: None if one.dtype == object else one for t, one in own.items()}
        free = {*drawn, *(t for t, one in constants.items() if one is not None)}
        special = (self.compiled.bounded, self.compiled.material, self.compiled.carriers)
        plain = free.issuperset(self.order) and all(s.isdisjoint(self.order) for s in special)
        if plain and not (self._states or self.space):
            for names, streams, columns, low, edges in groups:
                words = [words_of(*one, range(1)) for one in zip(names, streams, strict=True)]
                uniform = uniforms(where, np.concatenate(words), len(low[0]))
                numbers[:, columns] = low + edges * uniform
            for name in self.order:
                if name not in drawn:
                    found[name] = constants[name]
            return numbers, []
        refused, draws = list[int](), [n for n, act in acts.values() if act.root.draws]
        self._own = frozenset(own)
        for place in range(len(numbers)):
            for target, each in own.items():
                one = each[place]
                act = one if isinstance(one, Intervention) else Hard.of(np.asarray(one))
                self.acts[target] = target, act
                if target in self.pending:
                    self.pending[target] = target, act
            self.base = replace(self.base, row=bases.row(place))
            before = replace(self.base, row=now.row(place))
            done = self
            try:
                wrong: Any = self.solve(key(place), before)
                if not wrong and self.obstacles(before, draws):  # it draws again, or is refused
                    done = alone(place)
            except ScmWorldError:
                wrong = True
            if wrong or (done.change is not None and done.change.structure is not None):
                refused.append(place)
            else:
                numbers[place] = done.row.numbers
        return numbers, refused

    def _compute(self, name: str, *, follows: bool) -> None:
        """Compute a parameter after its parents; its bounds may depend on others."""
        variable, impossible = self.compiled.model.declared(name), self._impossible
        if impossible and any(p.name in impossible for p in variable.all_parents):
            impossible.add(name)
            return
        try:
            applied = None
            if name in self._own:
                act = self.acts[name][1].on(self.model._beneath(name))
                applied = self.model._applied(name, act)
            value = self.model.evaluate(name, self.row, self._key, applied)
            if value.shape != variable.shape:  # of a mechanism that a user gave
                raise WrongValue(name, value, variable.shape, np.shape(value))
            check_bounds(variable, value, self.row if follows else {})
        except InterventionError as problem:
            self._wrong.append(problem)
            impossible.add(name)
        else:
            self.row[name] = value

    def _set_states(self) -> None:
        """Set states, and update those whose parents were set; parents come first."""
        followed, fresh = self.compiled.set_parents, self.base.fresh
        for target in self._states:
            if target not in followed:
                self._set_state(target)
        moved = {*self.order, *self._states}
        for name, parents in followed.items():
            if name in moved or name in fresh or not moved.isdisjoint(parents):
                self._set_state(name)
                moved.add(name)

    def _set_state(self, name: str) -> None:
        """Update a state after its parents, and apply the intervention on it."""
        asked, act = self.acts.get(name, (name, None))
        root = None if act is None else act.root
        if name in self.compiled.set_parents and (root is None or not root.replaces):
            self._carry(name)
        if act is None or root is None or act.releases or name in self._impossible:
            return
        model, row, values = self.compiled.model, self.row, self.row
        whole, bounds = model._applied(asked, act), model.declared(name).bounds
        requested = whole.requested
        try:
            if root.computes:  # it follows previous states
                values = row.copy()
                states = slice(0, self.compiled.state_size)
                values.numbers[states] = self.base.row.numbers[states]
            value = None
            if requested.name == asked != name and not act.draws:
                there = model._intended(name, whole, values, self._key)
                if np.array_equal(there, self.compiled.coordinates(asked, row)):
                    value = row[name]  # the inverse of coordinates is rounded
            if value is None:
                value = model.evaluate(name, values, self._key, whole)
            if same(value, self.base.row[name]):
                row[name] = self.base.row[name]
                return
            if bounds is None or self._impossible.isdisjoint(bounds.parents()):
                check_bounds(model.declared(name), value, row)
        except InterventionError as problem:
            if problem.variable not in {p.variable for p in self._wrong}:  # of a bundle's parts
                self._wrong.append(problem)
            return
        # Quaternions are normalised; other values stay exact.
        row[name] = bounds.nearest(value) if isinstance(bounds, Rotations) else value

    def _carry(self, name: str) -> None:
        """Update a state for parents that act when set: a resized body is raised."""
        variable: Any = self.compiled.model.declared(name)
        base = self.base
        parents, fresh = self.compiled.set_parents[name], name in base.fresh
        moved = [p for p in parents if not same(base.row[p], self.row[p])]
        if not (moved or fresh):
            return
        new = [self.row[parent] for parent in parents]
        again = fresh or base.at_start or not {*variable.restart}.isdisjoint(moved)
        if variable.start is not None and again:
            self.row[name] = variable.start.bind()(*new)
        elif variable.carry is not None and not fresh:
            old = [base.row[parent] for parent in parents]
            self.row[name] = variable.carry.bind()(base.row[name], *old, *new)

    # --- the requested space ------------------------------------------------------------------

    def _check_space(self, space: AnyRegion) -> None:
        """Check the requested space, as far as the value and the parents of the space are known."""
        model, actions = self.compiled.model, self.compiled.actions
        unknown = self._impossible | {problem.variable for problem in self._wrong}
        for name in self.asked:
            requested, targets = model.declared(name), model.targets(name)
            spaces = (s.parents() for s in (requested.bounds, requested.a, requested.b) if s)
            if not unknown.isdisjoint({name, *targets, *chain(*spaces)}):
                continue
            asked, act = self.pending[targets[0]]
            try:
                if targets[0] in actions:
                    value = fixed_action(name, [self.acts[target][1] for target in targets])
                elif isinstance(act, Draw) and act.source == space:
                    continue
                elif asked == name and act.constant is not None:  # the inverse is rounded
                    value = requested.array(act.constant)
                else:
                    value = self.compiled.coordinates(name, self.row)
                check_space(requested, value, space, self.row)
            except InterventionError as problem:
                self._wrong.append(problem)

    def _as_asked(self) -> list[InterventionError]:
        """Return the problems, with those of the parts of a requested bundle merged into one."""
        found = list(self._wrong)
        for name in self.asked:
            bundle = self.compiled.model.declared(name)
            wrong = {p.variable: p for p in found if isinstance(p, OutOfBounds | WrongValue)}
            if wrong.keys().isdisjoint(bundle.parts):
                continue
            parts = [
                np.asarray(wrong[p].value) if p in wrong else self.row[p] for p in bundle.parts
            ]
            try:
                check_bounds(bundle, self.compiled.in_coordinates(name, *parts), self.row)
            except InterventionError as problem:
                found = [p for p in found if p not in [wrong.get(part) for part in bundle.parts]]
                found.append(problem)
        return found

    # --- bodies and repeated draws --------------------------------------------------------------

    def screened_draws(self, key: NoiseKey, attempts: range, draws: list[str]) -> Iterator[int]:
        """Yield the draws that pass the screening for overlaps, and the last one."""
        composition = self.compiled.composition
        varies = not self.compiled.reached(draws).isdisjoint(composition.screened)
        while attempts:
            chunk, attempts = attempts[:CHUNK], attempts[CHUNK:]
            rows = self._screened(key, chunk) if varies else None
            if rows is None:
                yield from chunk
                continue
            limit = ROUNDING + max((overlap.depth for overlap in self.base.overlaps), default=0.0)
            while len(chunk):
                first = composition.first_clear(rows, limit)
                first = first if attempts else min(first, len(chunk) - 1)
                chunk, rows = chunk[first:], {name: rows[name][first:] for name in rows}
                yield from chunk[:1]
                chunk, rows = chunk[1:], {name: rows[name][1:] for name in rows}

    @np.errstate(all="ignore")
    def _screened(self, key: NoiseKey, attempts: range) -> dict[str, Value] | None:
        """Draw the screened variables, a row per attempt; None if they have other parents."""
        compiled, base, n = self.compiled, self.base.row, len(attempts)
        where = compiled.where
        rows, drawn = dict[str, Value](), dict[str, Value]()
        for name in compiled.composition.screened:
            asked, act = self.acts.get(name, (name, None))
            values = base.numbers[where[name]]
            whole = asked if act is None else act.whole(asked)
            if isinstance(act, Draw) and asked == name and whole in where:
                if whole not in drawn:
                    requested = compiled.model.declared(whole)
                    source, shape = act.distribution(requested), requested.shape
                    if source.parents():
                        return None
                    kept = (key.kept or {}).get(whole)
                    tries = attempts if kept is None else range(kept, kept + 1)
                    words = words_of(whole, act.stream, tries)
                    numbers = uniforms(key, words, source.n_uniforms(shape))
                    drawn[whole] = source.transform(numbers, shape, {}).reshape(len(tries), -1)
                first = where[name].start - where[whole].start
                values = drawn[whole][:, first : first + values.size]
            elif act is not None and asked == name and act.constant is not None:
                values = np.ravel(act.constant)
            elif act is not None or name in self.order or name in compiled.set_parents:
                return None
            rows[name] = np.broadcast_to(values, (n, where[name].stop - where[name].start))
        return rows

    # --- results ------------------------------------------------------------------------------

    def attempt(self, source: str) -> int:
        """Return the attempt at which a variable or bundle was drawn."""
        return (self._key.kept or {}).get(source, self._key.attempt)

    def settled(self, target: str) -> tuple[str, Any]:
        """Return the intervention on a target with the numbers that were drawn, and its name."""
        known = self._known.get(target)
        if known is None:
            name, act = self.acts[target]
            if act.draws:
                known = target, Hard.of(self.row[target])
            else:
                known = name, self._settled(target, act)
            self._known[target] = known
        return known

    def _settled(self, target: str, act: Intervention) -> Intervention:
        if not act.root.draws or act.lower is None:
            return act
        name, below = act.lower
        if not below.draws:
            return act.on((name, self._settled(target, below)))
        model = self.compiled.model
        value = model.evaluate(target, self.row, self._key, model._applied(name, below))
        return act.on((target, Hard.of(value)))

    def remains(self) -> tuple[SCM, PendingInterventions]:
        """Return the model that would be in force, and the interventions at this control step.

        Draws are their values there.
        """
        drawn = dict([self.settled(target) for target in self.draws])
        model = self.model._with_interventions(drawn) if drawn else self.model
        by_hand, actions = self.compiled.set_by_hand, self.compiled.actions
        found: PendingInterventions = {}
        for target, named in self.pending.items():
            lasting = target not in by_hand
            if named[1].constant is not None or target in actions or target not in self.acts:
                found[target] = named
            elif lasting:
                found[target] = self.settled(target)
            else:
                found[target] = target, Hard.of(self.row[target])
        asked = self.request.items()
        found |= {name: (name, act) for name, act in asked if getattr(act, "removes", False)}
        return model, found


# --- bodies ----------------------------------------------------------------------------------


def difference(now: Base, then: Rows, changed: Iterable[str]) -> Difference | None:
    """Return the difference of two scenes, for a backend to apply; None if they are equal.

    ``changed`` is the result of ``Rows.differing``.
    """
    compiled = then.compiled
    if changed or compiled is not now.row.compiled:
        structure = compiled.composition.structure(then)
        if structure is not now.structure:
            scene = compiled.scene(then)
            return Difference(structure, scene.parameters, scene.state)
    keys, state = compiled.parameter_keys, None
    parameters = {keys[name]: then[name] for name in changed if name in keys}
    here, there = (one.numbers[: compiled.state_size] for one in (now.row, then))
    held = False  # whether states move that no engine has, and no others
    if here.tobytes() != there.tobytes():
        layout = compiled.composition.system.layout
        moves = (here != there) & layout.can_be_set
        held = bool(moves.any()) and not (moves & layout.engine_takes).any()
        state = compiled.state_of(then) if moves.any() and not held else None
    is_one = parameters or held or state is not None
    return Difference(None, parameters, state) if is_one else None


def overlaps(
    base: Base, now: Base, then: Rows, change: Difference, asked: Iterable[str] = ()
) -> list[Overlap]:
    """List overlaps deeper than those that physics left, so that undoing is always possible."""
    compiled = then.compiled
    shaping = compiled.composition.surfaces
    moves = change.structure is not None or not shaping.isdisjoint(change.parameters)
    if not moves and change.state is not None:
        size = compiled.state_size
        moves = bool((now.row.numbers[:size] != then.numbers[:size])[compiled.placed].any())
    found = compiled.composition.overlaps(compiled.scene(then), asked=asked) if moves else ()
    if not found:
        return []
    depths = {overlap.bodies: overlap.depth for overlap in base.overlaps}
    return [one for one in found if one.depth > depths.get(one.bodies, 0.0) + ROUNDING]


def feasible(
    structures: StructureCache,
    base: Base,
    now: Base,
    request: Mapping[str, Any],
    space: AnyRegion | None,
    key: NoiseKey,
    found: Iterable[InterventionError] = (),
    fixed: Mapping[str, int] | None = None,
) -> Transaction:
    """Solve an intervention, and refuse it with every problem, or if bodies overlap.

    Bodies that overlap already (one is squeezed) may continue to. Draws are repeated until no
    bodies overlap: they come from the feasible part of their space. If a draw determines which
    bodies exist, each of its values is tried with several draws of the other targets.

    Args:
        structures: The structures of the task.
        base: The world as physics left it.
        now: The present, with earlier interventions at this control step.
        request: The interventions by dotted name.
        space: Space in which every target must lie, if any.
        key: The noise key.
        found: Problems of the request that are known already.
        fixed: The attempts of draws that are not repeated, by variable; see ``stacked``.
    """
    fixed, key = fixed or {}, replace(key, kept=fixed) if fixed else key
    acts = {name: act for name, act in request.items() if isinstance(act, Intervention)}
    sources = {name: source_of(name, act) for name, act in acts.items() if act.root.draws}
    draws = [name for name in sources if sources[name] not in fixed]
    alone = [name for name in draws if request[name].draws]
    deciding = structures.deciding.intersection(alone)
    named: frozenset[str] = frozenset()
    first, turn, tried = 0, 0, ""
    while first < ATTEMPTS:
        asked = dict(request)
        for name in deciding if turn else ():  # the noise of another turn
            stream = f"{request[name].stream or name}#{turn}"
            asked[name] = request[name].model_copy(update={"stream": stream})
        drawn = Transaction(structures, base, asked, space, key, found)
        if not named.issubset(drawn.asked):  # a named body does not exist
            first, turn = first + 1, turn + 1
            continue
        done, named = drawn, frozenset(drawn.asked)
        # Draws that do not move bodies, and draws with errors, are not repeated.
        free = () if done.problems else (name for name in draws if name not in deciding)
        again = [name for name in free if done.compiled.moves_bodies(name)]
        if draws:
            once = {*sources.values()}.difference([sources[name] for name in again])
            key = replace(key, kept={**dict.fromkeys(once, 0), **fixed})
        end = min(first + CHUNK, ATTEMPTS) if deciding else ATTEMPTS
        attempts = range(first, end if again else first + 1)
        for attempt in done.screened_draws(key, attempts, again) if again else attempts:
            wrong = done.solve(replace(key, attempt=attempt) if attempt else key, now)
            if wrong:
                raise_all(wrong)
            problems = done.obstacles(now, draws) if draws or done.change is not None else []
            if not problems:
                return done
            tried = f"with the draws of episode {key.episode}, " if fixed else ""
            if draws:
                tried = f"none of {ATTEMPTS:,} draws was feasible; in the last one "
            moved = {name.partition(".")[0] for name in done.compiled.reached(again)}
            unmoved = {*done.compiled.composition.bodies} - moved
            if draws and (not again or any(unmoved.issuperset(o.bodies) for o in problems)):
                tried = tried if deciding else "for every draw, "
                break
        first, turn = attempt + 1 if deciding else ATTEMPTS, turn + 1
    bodies = {body for overlap in problems for body in overlap.bodies}

    def blame(name: str) -> tuple[bool, bool, bool]:
        known = name in done.compiled.model
        moved = done.compiled.surfaces & done.compiled.reached((name,)) if known else ()
        is_fixed = isinstance(done.request[name], Draw) and sources[name] in fixed
        touches = bool({part.partition(".")[0] for part in moved} & bodies)
        return not is_fixed, touches, bool(moved)

    name = max(done.request, key=blame)  # it moved one of the bodies
    nearest = partial(_nearest, name, structures, base, now, done.request, key)
    reasons = [tried + str(problem) for problem in problems]
    raise Infeasible(name, done.request[name], reasons, nearest)


def stacked(
    structures: StructureCache,
    base: Base,
    now: Base,
    levels: Sequence[Level],
    space: AnyRegion | None,
    key: NoiseKey,
    found: Iterable[InterventionError] = (),
) -> Transaction:
    """Solve the levels of an instant: what is asked, and before it the context, if that draws.

    The context draws what it draws without what is asked, at the same attempt: that does not repeat
    it, and is refused where it does not fit with it. See ``feasible`` for other arguments.
    """
    *lower, (asked, draws) = levels
    request, attempts, fixed = dict(asked), dict[str, int](), dict[str, int]()
    for level in lower:
        beneath = feasible(structures, base, now, level.request, None, key)
        attempts = {name: beneath.attempt(name) for name in level.draws}
        fixed = {n: at for n, at in attempts.items() if draws.get(n) == level.draws[n]}
        for name, act in request.items():
            source = source_of(name, act) if isinstance(act, Intervention) else name
            root = beneath.request.get(source)
            if source in fixed and source in structures.deciding and isinstance(root, Draw):
                request[name] = act.rooted(root)  # of the turn at which it was feasible
    done = feasible(structures, base, now, request, space, key, found, fixed)
    done.attempts = attempts
    return done


def _nearest(
    wanted: str,
    structures: StructureCache,
    base: Base,
    now: Base,
    request: Mapping[str, Any],
    key: NoiseKey,
) -> Any:
    """Return the last feasible value on the line from the present values to the requested ones."""
    here, there = dict[str, Value](), dict[str, Value]()
    compiled = now.row.compiled
    model = compiled.model
    for name, value in request.items():
        if name in structures.deciding or name not in model:
            return None  # the structure changes, without values between
        try:
            plain = value.constant if isinstance(value, Hard) else value
            there[name] = coerce(model.declared(name), plain)
        except InterventionError:
            return None
        here[name] = compiled.coordinates(name, now.row)

    def between(part: float) -> dict[str, Any]:
        return {name: (here[name] + part * (there[name] - here[name])).tolist() for name in here}

    low, high = 0.0, 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        done = Transaction(structures, base, between(middle), None, key)
        # Outside the bounds, or in another body:
        blocked: Any = done.solve(key, now) or done.obstacles(now, ())
        low, high = (low, middle) if blocked else (middle, high)
    return between(low)[wanted]
