"""Interventions: what is asked for, what the world would be, and whether its bodies allow that."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Integers, Value
from scm_world.errors import (
    ConflictingTargets,
    Infeasible,
    InterventionError,
    NotIntervenable,
    OutOfBounds,
    UnknownVariable,
    WrongValue,
    raise_all,
)
from scm_world.graph import SCM, NoiseKey
from scm_world.graph.acceptance import refuse_time
from scm_world.graph.evaluate import noise_of
from scm_world.models import Difference, ParameterKey, Structure
from scm_world.models.scene import SURFACES, Overlap
from scm_world.variables import (
    SOFT,
    Draw,
    Hard,
    Intervention,
    Measured,
    Mechanism,
    Natural,
    Null,
    Rotations,
    Shift,
    Variable,
    divided,
    whole_of,
)
from scm_world.variables.checks import check_bounds, check_space, coerce
from scm_world.variables.subsets import AnyRegion
from scm_world.world.compiled_task import CompiledTask, PendingInterventions, StepBase
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import uniforms
from scm_world.world.structures import StructureCache, restructured, wrong_structure

ATTEMPTS = 1000
"""How often is drawn; one in sixty draws of the joints from A leaves all fingers apart."""
CHUNK = 64
"""How many draws are screened together."""
ROUNDING = 1e-6
"""How much deeper than before is no deeper [m]."""


def same(a: Value, b: Value) -> bool:
    """Tell whether two arrays of one shape hold the same numbers."""
    return a is b or bool((a == b).all())


def merged(model: SCM, *requests: Mapping[str, Any]) -> dict[str, Any]:
    """Combine interventions; the last one that sets a quantity counts.

    Args:
        model: Knows which names are coordinates of one quantity, and which are bundles.
        requests: With dotted names.
    """
    found: dict[str, Any] = {}
    for acts in requests:
        mine = {target for name in acts for target in _targets(model, name)}
        kept = {n: a for n, a in found.items() if not mine.issuperset(_targets(model, n))}
        found = {**kept, **acts}
    return found


def _targets(model: SCM, name: str) -> tuple[str, ...]:
    return model.targets(name) if name in model else (name,)


@final
@dataclass
class Present:
    """The present of a world, in which an intervention is planned.

    Attributes:
        structures: Of the task.
        base: The world as physics left it.
        now: The present values.
        structure: What the backend has compiled.
    """

    structures: StructureCache
    base: StepBase
    now: Rows
    structure: Structure


@final
class CheckedRequest:
    """An intervention that has been checked, to be solved once for each draw.

    Args:
        structures: Of the task.
        base: The world as physics left it.
        request: The intervention, with dotted names.
        space: Every target has to lie in, if any.
        key: Where to draw which bodies there are.
        found: Problems of the request that are known already.

    Attributes:
        base: In the structure that is asked for.
        asked: The names of the request that are right.
        pending: All interventions at this control step, by target. What was asked of bodies that
            are gone is kept, in case they come back at the same instant.
        acts: Those on what there is.
        targets: The parameters among them that have a possible value.
        order: Parameters that are computed, causes before effects.
        model: With the interventions that would hold, draws among them.
        problems: What is wrong, whatever is drawn.
        impossible: Parameters without a possible value.
        head: What decides which bodies there are.
    """

    def __init__(
        self,
        structures: StructureCache,
        base: StepBase,
        request: Mapping[str, Any],
        space: AnyRegion | None,
        key: NoiseKey,
        found: Iterable[InterventionError] = (),
    ) -> None:
        self.problems = [*found]
        self.request = request
        asked = (*base.pending.values(), *request.items())
        if any(isinstance(act, Null) or name in structures.deciding for name, act in asked):
            wrong = wrong_structure(structures, base, request)
            request = {name: act for name, act in request.items() if name not in wrong}
            base = restructured(structures, base, request, key)
            self.problems += wrong.values()
        self.base, self.compiled, self.space = base, base.compiled, space
        self.head = structures.deciding
        self.pending = {**base.pending, **self._accepted(request)}
        there = self.compiled.mechanisms.where
        self.acts = {t: named for t, named in self.pending.items() if t in there}
        self.states = [t for t in self.acts if t in self.compiled.set_by_hand]
        self.model, self.order = base.model, tuple[str, ...]()
        self.impossible: set[str] = set()
        self.targets, self.draws = tuple[str, ...](), list[str]()
        if len(self.states) < len(self.acts):
            self._mutilate()

    def _accepted(self, request: Mapping[str, Any]) -> PendingInterventions:
        """Check names, types and shapes; what is asked of a bundle is asked of its parts."""
        compiled, model = self.compiled, self.compiled.model
        accepted: PendingInterventions = {}
        asked: dict[str, str] = {}
        for name, value in request.items():
            try:
                if isinstance(value, Null | Natural) and name not in model:
                    refuse_time(name, value)
                if isinstance(value, Null):  # of an entity, not of a variable; see ``restructured``
                    continue
                if isinstance(value, Natural) and name in compiled.entity_names:
                    continue  # it is there
                kept, act = self._checked(name, value)
                targets = model.targets(name)
                for target in targets:
                    if target in asked:
                        raise ConflictingTargets((asked[target], name), target)
                asked |= dict.fromkeys(targets, name)
                if kept in compiled.bundles:
                    parts = divided(model.declared(kept), act).items()
                    accepted |= {model.target(part): (part, own) for part, own in parts}
                else:
                    accepted[targets[0]] = (kept, act)
            except InterventionError as problem:
                reason = dict(compiled.composition.system.refused).get(name)
                refused = reason is not None and isinstance(problem, UnknownVariable)
                self.problems.append(NotIntervenable(name, str(reason)) if refused else problem)
        self.asked = tuple(dict.fromkeys(asked.values()))
        return accepted

    def _checked(self, name: str, value: Any) -> tuple[str, Intervention]:
        """Check an intervention; return it with the name of what it sets.

        Coordinates that are those of the instant set the quantity to what it was at the instant:
        their inverse is rounded, and taking something back leaves no trace.
        """
        base, model = self.base, self.compiled.model
        try:
            act = model.accept(name, value)
        except OutOfBounds as problem:
            # What physics did is possible: a state can always be put back to where it is.
            present = base.value(name)
            if present is None or not np.array_equal(problem.value, present):
                raise
            act = Hard(problem.value)
        target = model.targets(name)[0]
        if name != target and isinstance(act, Hard) and name not in self.compiled.bundles:
            quantity, present = base.value(target), base.value(name)
            if present is not None and np.array_equal(act.value, np.ravel(present)):
                return target, Hard(quantity)
        return name, act

    def _mutilate(self) -> None:
        """Mutilate the model, and order the descendants of the targets."""
        compiled, by_hand = self.compiled, self.compiled.set_by_hand
        acts = {t: named for t, named in self.acts.items() if t not in by_hand}
        follows = [t for t, (_, act) in acts.items() if isinstance(act, Mechanism)]
        moving = self._moving({target: acts[target] for target in follows}) if follows else {}
        held = self.base.model.interventions.values()
        ties = bool(follows) or any(isinstance(act, Mechanism) for act in held)
        # Where nothing follows others than before, draws from boxes can wait for their values.
        draws = [t for t, (_, act) in acts.items() if isinstance(act, Draw)]
        later = self.boxes.keys() if draws and not ties else ()
        kept = dict([acts[t] for t in acts if t not in moving and t not in later])
        self.model, cycles = self.base.model.without_cycles(kept)
        self.problems += [*{p.variable: p for p in moving.values()}.values(), *cycles]
        self.impossible = {*moving, *chain(*(problem.cycle for problem in cycles))}
        static = compiled.static
        self.targets = tuple([t for t in acts if t in static and t not in self.impossible])
        self.draws = [target for target in draws if target in self.targets]
        if ties:
            structure = self.model.structure
            follow = {*self.targets, *structure.instant_descendants(self.targets)}
            self.order = tuple(n for n in structure.order if n in follow and n in static)
        else:
            self.order = compiled.static_order(self.targets)
        drawn = (acts[target] for target in self.draws if target not in self.boxes)
        sources = (self.source(name, act) for name, act in drawn if isinstance(act, Draw))
        if any(source.parents() for source in sources):
            self.order = tuple(n for n in self.model.structure.order if n in {*self.order})

    def _moving(self, acts: Mapping[str, tuple[str, Intervention]]) -> dict[str, InterventionError]:
        """Return an error for each parameter that should follow what moves.

        Parameters change at interventions only; actions follow the present, not what was earlier.
        """
        found: dict[str, InterventionError] = {}
        for target, (name, act) in acts.items():
            if not isinstance(act, Mechanism):
                continue
            static = self.compiled.static
            moving = [p.name for p in act.parents if p.lag or p.name not in static]
            who, what = "a parameter", "parameters of the same instant"
            if target in self.compiled.actions:
                moving, who, what = (
                    [p.name for p in act.parents if p.lag],
                    "an action",
                    "the present",
                )
            if moving:
                asked = whole_of(act, name)
                found[target] = InterventionError(
                    f"do({asked}): {who} can follow {what} only, not {', '.join(moving)}; let a "
                    "plan set it step by step instead",
                    variable=asked,
                    value=act,
                )
        return found

    def source(self, name: str, act: Draw) -> Any:
        """Return what a variable is drawn from."""
        requested = self.compiled.model.declared(whole_of(act, name))
        return requested.space(act.source) if isinstance(act.source, str) else act.source

    @cached_property
    def boxes(self) -> dict[str, tuple[str, Integers, Floats, Floats]]:
        """Draws from boxes that follow nothing: stream, columns, lower ends and edges."""
        found: dict[str, tuple[str, Integers, Floats, Floats]] = {}
        for name, (asked, act) in self.acts.items():
            if isinstance(act, Draw) and asked == name and name in self.compiled.static:
                box = None if act.of else self.compiled.box(name, act.source)
                if box is not None:
                    own = name if act.stream is None else f"{act.stream}/{name}"
                    found[name] = own, *box
        return found

    @cached_property
    def together(self) -> list[tuple[list[str], list[str], Integers, Floats, Floats]]:
        """The same by size; columns, lower ends and edges have the shape (draws, size)."""
        sizes = dict[int, list[tuple[str, str, Integers, Floats, Floats]]]()
        for name, box in self.boxes.items():
            sizes.setdefault(len(box[1]), []).append((name, *box))
        groups = [zip(*group, strict=True) for group in sizes.values()]
        return [
            ([*names], [*streams], np.stack(columns), np.stack(low), np.stack(edges))
            for names, streams, columns, low, edges in groups
        ]

    def redraws(self, name: str) -> bool:
        """Return whether a draw takes part in where bodies are; what is wrong is drawn once."""
        return not self.problems and self.compiled.is_material(name)

    def drawn(self, name: str, key: NoiseKey, attempts: Iterable[int]) -> Value | None:
        """Draw a variable in several attempts; None where its space follows other variables."""
        asked, act = self.acts.get(name, (name, None))
        if not isinstance(act, Draw) or asked != name or whole_of(act, name) != name:
            return None
        source, shape = self.source(name, act), self.compiled.model.declared(name).shape
        if source.parents():
            return None
        own = name if act.stream is None else f"{act.stream}/{name}"
        again = (f"{own}#{n}" if n and name not in key.kept else own for n in attempts)
        drawn: Value = source.transform(uniforms(key, again, source.n_uniforms(shape)), shape, {})
        return drawn


@final
class Solution:
    """What a world would be after an intervention, with one of its draws.

    Args:
        checked: The intervention.
        key: Where to draw.
        numbers: The row that is written, shape (width,); as physics left it if None.

    Attributes:
        row: The values of the world.
        problems: What is wrong with it.
        changed: Parameters whose values are not the present ones, once ``feasible`` has compared.
    """

    def __init__(self, checked: CheckedRequest, key: NoiseKey, numbers: Any = None) -> None:
        self.checked, self.key, self.compiled = checked, key, checked.compiled
        self.asked = checked.asked
        self._base = checked.base.row
        numbers = self._base.numbers.copy() if numbers is None else numbers
        self.row = Rows(self.compiled.mechanisms, numbers, {*checked.targets})
        self.problems = [*checked.problems]
        self._impossible = {*checked.impossible}
        self.changed: list[str] = []
        self._drawn: set[str] = set()
        self._whole: dict[str, Value] = {}  # what bundles are to be
        self._earlier = self.row  # parameters as they will be, states as they were

    def solve(self) -> list[InterventionError]:
        """Solve for the parameters, then for the states; return what is wrong.

        A mechanism never meets values that its parents cannot have.
        """
        checked = self.checked
        if checked.draws:
            self._draw_boxes()
        for name in checked.order:
            if name not in self._drawn:
                self.compute(name)
        if self._impossible.isdisjoint(checked.head):
            self._set_states()
        if checked.space is not None:
            self._check_space(checked.space)
        return self._as_asked() if self.problems else []

    def _draw_boxes(self) -> None:
        attempt, kept = self.key.attempt, self.key.kept
        for names, streams, columns, low, edges in self.checked.together:
            own = zip(names, streams, strict=True)
            again = (s if n in kept or not attempt else f"{s}#{attempt}" for n, s in own)
            drawn = uniforms(self.key, again, columns.shape[1])
            self.row.numbers[columns] = low + edges * drawn
            self._drawn |= {*names}
            self.row.unknown -= {*names}

    def compute(self, name: str) -> None:
        """Compute a parameter, whose parents have been."""
        checked, declared = self.checked, self.compiled.model.declared
        variable = declared(name)
        asked, act = checked.acts.get(name, (name, None))
        bounds = variable.bounds
        follows = bounds is not None and bool(bounds.parents())
        if isinstance(act, Hard) and asked == name and not follows:
            self.row[name] = act.value  # it has been checked
            return
        if self._impossible and not self._impossible.isdisjoint(
            p.name for p in variable.all_parents
        ):
            self._impossible.add(name)
            return
        try:
            drawn = checked.drawn(name, self.key, (self.key.attempt,))
            if drawn is None:
                value = checked.model.evaluate(name, self.row, self.key)
                if value.shape != variable.shape:  # of a mechanism that a user gave
                    raise WrongValue(name, value, variable.shape, np.shape(value))
            else:
                value = drawn[0]
            check_bounds(variable, value, self.row if follows else {})
        except InterventionError as problem:
            self.problems.append(problem)
            self._impossible.add(name)
        else:
            self.row[name] = value

    # --- states -------------------------------------------------------------------------------

    def _set_states(self) -> None:
        """Set states, and carry along those whose parents were set.

        States that others follow come first; a shift or scale starts from where its state was
        carried to.
        """
        acts, followed = self.checked.acts, self.compiled.set_parents
        if any(isinstance(acts[target][1], Mechanism) for target in self.checked.states):
            self._earlier = Rows(self.row.mechanisms, self.row.numbers.copy())
        for target in self.checked.states:
            if target not in followed:
                self.set_state(target)
        moved, fresh = {*self.checked.order, *self.checked.states}, self.checked.base.fresh
        for variable in self.compiled.carried:
            name = variable.name
            if name in moved or name in fresh or not moved.isdisjoint(followed[name]):
                self.set_state(name)
                moved.add(name)

    def set_state(self, name: str) -> None:
        """Carry a state along with its parents, and do what is asked of it."""
        asked, act = self.checked.acts.get(name, (name, None))
        if name in self.compiled.set_parents and (act is None or isinstance(act, SOFT)):
            self._carry(name)
        if act is None:
            return
        variable = self.compiled.model.declared(name)
        try:
            value = self._wish(name, asked, act)
            if same(value, self._base[name]):
                self.row.numbers[self.row.mechanisms.where[name]] = np.ravel(self._base[name])
                return
            if variable.bounds is None or self._impossible.isdisjoint(variable.bounds.parents()):
                check_bounds(variable, value, self.row)
        except InterventionError as problem:
            if problem.variable not in {p.variable for p in self.problems}:  # of a bundle's parts
                self.problems.append(problem)
            return
        # A quaternion gets norm 1; other values are as exact as they were given.
        bounds = variable.bounds
        self.row[name] = bounds.nearest(value) if isinstance(bounds, Rotations) else value

    def _wish(self, target: str, name: str, act: Intervention) -> Value:
        """Return the value that a state is to have."""
        whole = whole_of(act, name)
        requested: Any = self.compiled.model.declared(whole)
        if whole == name:
            value = self._wanted(name, act)
            if name == target:
                return value
            if np.array_equal(value, self.coordinates(name)):
                return self.row[target]
            return np.asarray(requested.inverse.bind()(value))
        if whole not in self._whole:
            self._whole[whole] = self._wanted(whole, act)
        return np.asarray(
            requested.mechanism.split(self._whole[whole])[requested.parts.index(name)]
        )

    def _wanted(self, name: str, act: Intervention) -> Value:
        """Return the value that is asked of a state, of other coordinates or of a bundle."""
        requested: Any = self.compiled.model.declared(name)
        if isinstance(act, Hard):
            value = requested.array(act.value)
        elif isinstance(act, Mechanism):
            value = self._followed(requested, act)
        elif isinstance(act, Natural | Null):
            value = self.coordinates(name)
        elif isinstance(act, Draw):
            source = self.checked.source(name, act)
            value = self.key.draw(source, name, requested.shape, self.row, act.stream)
        else:
            present = self.coordinates(name)
            by = np.asarray(act.by)
            value = present + by if isinstance(act, Shift) else present * by
        return np.asarray(value)

    def _followed(self, requested: Variable, act: Mechanism) -> Value:
        """Compute the value that a state is set to."""
        known, values = self.compiled.static | self.compiled.slices.keys(), self._earlier
        unknown = [p.name for p in act.parents if p.lag or p.name not in known]
        if unknown:
            raise InterventionError(
                f"do({requested.name}): a state can be set to a function of parameters and "
                f"states, not of {', '.join(unknown)}",
                variable=requested.name,
                value=act,
            )
        given = (np.array(values[p.name]) for p in act.parents)
        found: Any = act.equation.bind()(*given, **noise_of(requested, act, self.key, values))
        return coerce(requested, found)

    def _carry(self, name: str) -> None:
        """Move a state with the parents that act on it when set (a block that grows)."""
        variable: Measured = self.compiled.carried_by_name[name]
        parents, base = self.compiled.set_parents[name], self.checked.base
        if name not in base.fresh:
            moved = [p for p in parents if not same(self._base[p], self.row[p])]
            if not moved:
                return
        new = [self.row[parent] for parent in parents]
        if name in base.fresh:
            if variable.start is not None:
                self.row[name] = variable.start.bind()(*new)
        elif variable.start and (base.at_start or not {*variable.restart}.isdisjoint(moved)):
            self.row[name] = variable.start.bind()(*new)
        elif variable.carry is not None:
            old = [self._base[parent] for parent in parents]
            self.row[name] = variable.carry.bind()(self._base[name], *old, *new)

    def coordinates(self, name: str) -> Value:
        """Return the value of a variable that was asked for, such as other coordinates."""
        targets = self.compiled.model.targets(name)
        if targets == (name,):
            return self.row[name]
        return self.compiled.in_coordinates(name, *(self.row[target] for target in targets))

    # --- the space that is asked for ----------------------------------------------------------

    def _check_space(self, space: AnyRegion) -> None:
        """Check the asked space, where the value and what the space follows are known."""
        model, actions = self.compiled.model, self.compiled.actions
        unknown = self._impossible | {problem.variable for problem in self.problems}
        for name in self.asked:
            requested, targets = model.declared(name), model.targets(name)
            spaces = (s.parents() for s in (requested.bounds, requested.a, requested.b) if s)
            if not unknown.isdisjoint({name, *targets, *chain(*spaces)}):
                continue
            try:
                acts = targets[0] in actions
                value = self._held_action(name) if acts else self.coordinates(name)
                check_space(requested, value, space, self.row)
            except InterventionError as problem:
                if not self._asked_within(requested, space):
                    self.problems.append(problem)

    def _asked_within(self, requested: Variable, space: AnyRegion) -> bool:
        """Tell whether an intervention on other coordinates always lies in a space."""
        if getattr(requested, "inverse", None) is None:
            return False
        _, act = self.checked.pending[self.compiled.model.target(requested.name)]
        if not isinstance(act, Hard):
            return isinstance(act, Draw) and act.source == space
        try:
            check_space(requested, requested.array(act.value), space, self.row)
        except InterventionError:
            return False
        return True

    def _held_action(self, name: str) -> Value:
        """Return the action that is to be taken from now on."""
        acts = [self.checked.acts[target][1] for target in self.compiled.model.targets(name)]
        values = [np.asarray(act.value) for act in acts if isinstance(act, Hard)]
        if len(values) == len(acts):
            return values[0] if len(values) == 1 else np.concatenate([v.ravel() for v in values])
        raise InterventionError(
            f"do({name}): {acts[0]!r} is another action at every step, so it cannot be compared "
            "with a space; leave out `space`, or give one action as numbers",
            variable=name,
        )

    def _as_asked(self) -> list[InterventionError]:
        """Say of a bundle, if that was asked for, what is wrong with its parts."""
        found = list(self.problems)
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

    # --- what is kept of it -------------------------------------------------------------------

    @cached_property
    def _fixed(self) -> dict[str, Hard]:
        """The values that came out of draws, as interventions by target."""
        return {target: Hard(self.row[target].tolist()) for target in self.checked.draws}

    @property
    def model(self) -> SCM:
        """The model with the interventions that would hold, draws as the values that came out."""
        model = self.checked.model
        return model.with_interventions(self._fixed) if self.checked.draws else model

    def kept(self) -> PendingInterventions:
        """Return the interventions at this control step, draws as the values that came out."""
        acts, by_hand, actions = self.checked.acts, self.compiled.set_by_hand, self.compiled.actions
        found: PendingInterventions = {}
        for target, named in self.checked.pending.items():
            lasting = target not in by_hand and isinstance(named[1], (*SOFT, Mechanism, Natural))
            stays = isinstance(named[1], Hard) or lasting or target in actions
            if stays or target not in acts:
                found[target] = named
            else:
                value = self._fixed.get(target) or Hard(self.row[target].tolist())
                found[target] = target, value
        removals = self.checked.request.items()
        return found | {name: (name, act) for name, act in removals if isinstance(act, Null)}


@final
class Candidates:
    """The worlds of several draws of one intervention: a row for each, computed where asked.

    Args:
        checked: The intervention.
        key: Where to draw.
        attempts: Numbers of the draws.
        varying: What follows from a draw.
    """

    def __init__(
        self, checked: CheckedRequest, key: NoiseKey, attempts: range, varying: frozenset[str]
    ) -> None:
        self.attempts = [*attempts]
        self._checked, self._key, self._varying = checked, key, varying
        self._numbers = np.repeat(checked.base.row.numbers[None], len(attempts), axis=0)
        self._names = {key: name for name, key in checked.compiled.parameter_keys.items()}
        self._done: set[str] = set()

    def keep(self, which: Value) -> None:
        """Leave out draws; ``which`` tells of each whether it stays, shape (n,)."""
        self.attempts = [n for n, stays in zip(self.attempts, which.tolist(), strict=True) if stays]
        self._numbers = self._numbers[which]

    def parameter(self, key: ParameterKey) -> Value:
        """Compute a physical parameter, shape (n or 1, *shape); it must be a variable."""
        name = self._names[key]
        where = self._checked.compiled.mechanisms.where[name]
        shape = self._checked.compiled.model.declared(name).shape
        return self._computed([name], where).reshape(-1, *shape)

    def state(self, where: slice) -> Value:
        """Compute some numbers of the state vector, shape (n or 1, size)."""
        compiled = self._checked.compiled
        inside = (
            n
            for n, own in compiled.slices.items()
            if n not in compiled.bundles and where.start <= own.start and own.stop <= where.stop
        )
        return self._computed([*inside], where)

    def _computed(self, names: list[str], where: slice) -> Value:
        for name in names:
            self._compute(name)
        found: Value = self._numbers[:, where]
        return found[:1] if self._varying.isdisjoint(names) else found

    def _compute(self, name: str) -> None:
        checked, compiled = self._checked, self._checked.compiled
        is_state = name in compiled.slices
        if name in self._done or not (is_state or name in checked.order):
            return
        self._done.add(name)
        drawn = checked.drawn(name, self._key, self.attempts)
        if drawn is not None and not isinstance(compiled.model.declared(name).bounds, Rotations):
            where = compiled.mechanisms.where[name]
            self._numbers[:, where] = drawn.reshape(len(drawn), -1)
            return
        parents = compiled.set_parents.get(name, ()) if is_state else ()
        for parent in parents if is_state else checked.model.structure.parents(name):
            self._compute(parent)
        for attempt, numbers in zip(self.attempts, self._numbers, strict=True):
            one = Solution(checked, replace(self._key, attempt=attempt), numbers)
            if is_state:
                one.set_state(name)
            else:
                one.compute(name)


# --- bodies ----------------------------------------------------------------------------------


def _shapes(key: ParameterKey | None) -> bool:
    return key is not None and key[1] in SURFACES


def difference(
    compiled: CompiledTask, now: Rows, structure: Structure, then: Rows, changed: Iterable[str]
) -> Difference | None:
    """Return what a backend has to change; None if nothing.

    It is the difference of two scenes, without describing them.

    Args:
        compiled: The task in the structure that is wanted.
        now: The present values.
        structure: What the backend has compiled.
        then: The values that are wanted.
        changed: What ``Rows.differing`` lists.
    """
    same_columns = then.mechanisms is now.mechanisms
    wanted = compiled.structure(then) if changed or not same_columns else structure
    if wanted is not structure:
        scene = compiled.describe(then, compiled.state_of(then))
        return Difference(wanted, scene.parameters, scene.state)
    keys, size = compiled.parameter_keys, compiled.mechanisms.state_size
    parameters = {keys[name]: then[name] for name in changed if name in keys}
    moves = (now.numbers[:size] != then.numbers[:size]) & compiled.can_be_set
    state = compiled.state_of(then) if moves.any() else None
    return Difference(None, parameters, state) if parameters or state is not None else None


def overlaps(
    compiled: CompiledTask,
    base: StepBase,
    now: Rows,
    then: Rows,
    change: Difference,
    asked: Iterable[str] = (),
) -> list[Overlap]:
    """List overlaps deeper than what physics left; taking something back is always possible."""
    moves = change.structure is not None or any(map(_shapes, change.parameters))
    if not moves and change.state is not None:
        size = compiled.mechanisms.state_size
        moves = bool((now.numbers[:size] != then.numbers[:size])[compiled.placed].any())
    if not moves:
        return []
    scene = compiled.describe(then, compiled.state_of(then))
    found = compiled.composition.overlaps(scene, asked=asked)
    if not found:
        return []
    depths = {overlap.bodies: overlap.depth for overlap in _overlaps_before(base)}
    return [one for one in found if one.depth > depths.get(one.bodies, 0.0) + ROUNDING]


def _overlaps_before(base: StepBase) -> tuple[Overlap, ...]:
    """List what lies in one another as physics left it, however little."""
    scene = base.compiled.describe(base.row, base.compiled.state_of(base.row))
    return base.compiled.composition.overlaps(scene, 0.0)


def feasible(
    here: Present,
    request: Mapping[str, Any],
    space: AnyRegion | None,
    key: NoiseKey,
    found: Iterable[InterventionError] = (),
) -> tuple[Solution, Difference | None]:
    """Compute what a world would be after an intervention that puts no two bodies in one place.

    Bodies that intersect already (a block that is being squeezed) may continue to. What is
    drawn is drawn again until the world can be like that: from the feasible part of its space.
    What takes no part in where bodies are is drawn once. Where it is drawn which bodies there are,
    each of these draws is followed by some of the rest.

    Args:
        here: The world.
        request: The intervention, with dotted names.
        space: Every target has to lie in, if any.
        key: Where to draw.
        found: Problems of the request that are known already.

    Raises:
        InterventionError: With every problem of the request. Whether bodies overlap is asked only
            where there is no other problem.
        Infeasible: With the bodies, the depths, and the nearest value that is feasible; or no
            draw was.
    """
    draws = [name for name, act in request.items() if isinstance(act, Draw)]
    deciding = here.structures.deciding.intersection(draws)
    first, turn, tried, named = 0, 0, "", frozenset[str]()
    while first < ATTEMPTS:
        asked = _drawn_anew(request, deciding, turn) if turn else request
        drawn = CheckedRequest(here.structures, here.base, asked, space, key, found)
        if not named.issubset(drawn.asked):  # it leaves out bodies that are named
            first, turn = first + 1, turn + 1
            continue
        checked, named = drawn, frozenset(drawn.asked)
        again = [name for name in draws if name not in deciding and checked.redraws(name)]
        key = replace(key, kept=frozenset(draws).difference(again)) if draws else key
        end = min(first + CHUNK, ATTEMPTS) if deciding else ATTEMPTS
        attempts = range(first, end if again else first + 1)
        for attempt in _promising(checked, key, attempts, again) if again else attempts:
            solution = Solution(checked, replace(key, attempt=attempt) if attempt else key)
            with np.errstate(all="ignore"):  # what is not finite is refused by name
                wrong = solution.solve()
            if wrong:
                raise_all(wrong)
            row, compiled = solution.row, checked.compiled
            solution.changed = changed = here.now.differing(row)
            change = difference(compiled, here.now, here.structure, row, changed)
            problems = []
            if change is not None:
                problems = overlaps(compiled, checked.base, here.now, row, change, checked.asked)
            if draws and not problems:
                problems = _in_obstacles(solution, draws)
            if not problems:
                return solution, change
            tried = f"none of {ATTEMPTS:,} draws was feasible; in the last one " if draws else ""
            if draws and _anyhow(checked, again, problems):
                tried = tried if deciding else "whatever is drawn, "
                break
        first, turn = attempt + 1 if deciding else ATTEMPTS, turn + 1
    raise refusal(here, checked, problems, key, tried)


def _drawn_anew(request: Mapping[str, Any], names: Iterable[str], turn: int) -> Mapping[str, Any]:
    """Give some draws of a request the noise of another turn."""
    streams = {name: f"{request[name].stream or name}#{turn}" for name in names}
    anew = {n: request[n].model_copy(update={"stream": own}) for n, own in streams.items()}
    return {**request, **anew}


def _promising(
    checked: CheckedRequest, key: NoiseKey, attempts: range, draws: list[str]
) -> Iterator[int]:
    """Yield the draws that may be feasible, and the last one.

    A draw that is left out puts two bodies in one place.
    """
    before = max((overlap.depth for overlap in _overlaps_before(checked.base)), default=0.0)
    varying = checked.compiled.reached(draws)
    for first in range(0, len(attempts), CHUNK):
        chunk = attempts[first : first + CHUNK]
        candidates = Candidates(checked, key, chunk, varying)
        try:
            with np.errstate(all="ignore"):
                checked.compiled.composition.thin(candidates, before + ROUNDING)
        except Exception:  # solving says what is wrong
            yield from chunk
        else:
            yield from candidates.attempts
    if attempts[-1] not in candidates.attempts:
        yield attempts[-1]


def _anyhow(checked: CheckedRequest, draws: Iterable[str], problems: Iterable[Overlap]) -> bool:
    """Tell whether every draw has an overlap: of bodies that can be moved and follow no draw."""
    moved = {name.partition(".")[0] for name in checked.compiled.reached(draws)}
    unmoved = {*checked.compiled.composition.bodies} - moved
    return not draws or any(unmoved.issuperset(overlap.bodies) for overlap in problems)


def _in_obstacles(solution: Solution, draws: Iterable[str]) -> list[Overlap]:
    """List goals that were drawn into an obstacle. Where they are put by hand, they may be."""
    compiled, row = solution.compiled, solution.row
    if not compiled.composition.hides_goals:
        return []
    moved = {name.partition(".")[0] for name in compiled.reached(draws)}
    return [*compiled.composition.buried(compiled.describe(row, compiled.state_of(row)), moved)]


def refusal(
    here: Present, checked: CheckedRequest, problems: list[Overlap], key: NoiseKey, tried: str = ""
) -> Infeasible:
    """Return the error that names the target to blame, and its nearest feasible value."""
    bodies = {body for overlap in problems for body in overlap.bodies}

    def blame(name: str) -> tuple[bool, bool]:
        moved = checked.compiled.surfaces((name,)) if name in checked.compiled.model else ()
        return bool({part.partition(".")[0] for part in moved} & bodies), bool(moved)

    name = max(checked.request, key=blame)
    key = replace(key, attempt=0, kept=frozenset())
    found = _nearest(here, checked.request, key)
    reasons = [tried + str(problem) for problem in problems]
    return Infeasible(name, checked.request[name], reasons, None if found is None else found[name])


def _nearest(
    at: Present, request: Mapping[str, Any], key: NoiseKey, *, halvings: int = 20
) -> dict[str, Any] | None:
    """Search the straight line from the present values to the wanted ones for the last feasible."""
    here: dict[str, Value] = {}
    there: dict[str, Value] = {}
    model = at.base.compiled.model
    for name, value in request.items():
        if name in at.structures.deciding or name not in model:
            return None  # bodies come and go: there is nothing between
        try:
            plain = value.value if isinstance(value, Hard) else value
            there[name] = coerce(model.declared(name), plain)
        except InterventionError:
            return None
        here[name] = at.base.compiled.coordinates(name, at.now)

    def between(part: float) -> dict[str, Any]:
        return {name: (here[name] + part * (there[name] - here[name])).tolist() for name in here}

    low, high = 0.0, 1.0
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        checked = CheckedRequest(at.structures, at.base, between(middle), None, key)
        solution = Solution(checked, key)
        with np.errstate(all="ignore"):
            blocked = bool(solution.solve())  # outside the bounds on the way
        if not blocked:
            row, compiled = solution.row, checked.compiled
            change = difference(compiled, at.now, at.structure, row, at.now.differing(row))
            if change is not None:
                found = overlaps(compiled, checked.base, at.now, row, change, checked.asked)
                blocked = bool(found)
        low, high = (low, middle) if blocked else (middle, high)
    return between(low)
