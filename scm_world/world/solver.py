"""What the values of a world would be after an intervention, computed without touching it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import chain
from typing import Any, final

import numpy as np

from scm_world._types import Value, Values
from scm_world.errors import InterventionError, OutOfBounds, WrongValue
from scm_world.graph import NoiseKey
from scm_world.graph.evaluate import noise_of
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
    whole_of,
)
from scm_world.variables.checks import check_bounds, check_space, coerce
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.variables.subsets import AnyRegion
from scm_world.world.compiled_task import PendingInterventions, StepBase
from scm_world.world.draws import Draws


def same(a: Value, b: Value) -> bool:
    """Tell whether two arrays of one shape hold the same numbers."""
    return a is b or bool((a == b).all())


@final
class Solver:
    """Solves a causal model for the values and the state after an intervention.

    Args:
        base: Where the intervention starts from.
        asked: The names of the present request.
        pending: All interventions at this control step, by target. What was asked of bodies that
            are gone is kept, in case they come back at the same instant.
        key: Where to draw.
        earlier: The solver of another attempt at the same request, if there was one.

    Attributes:
        static: Values of everything that physics does not move.
        state: Where everything would be.
        index: The control step.
        model: With the interventions that would hold, draws among them.
        problems: What is wrong with the request.
        acts: The interventions on what there is, by target.
        order: What is computed, causes before effects.
    """

    def __init__(
        self,
        base: StepBase,
        asked: tuple[str, ...],
        pending: PendingInterventions,
        key: NoiseKey,
        earlier: Solver | None = None,
    ) -> None:
        self.base, self.asked, self.pending = base, asked, pending
        self._task, self._key = base.compiled, key
        self.acts = {t: named for t, named in pending.items() if t in base.compiled.model}
        self._earlier = earlier
        self._draws: list[str] = []
        self.order: tuple[str, ...] = ()
        self._unchanged: frozenset[str] = frozenset()
        self._same: dict[frozenset[str], frozenset[str]] = {}
        self._together: Draws | None = None
        self.static: dict[str, Value] = dict(base.static)
        self.model = base.model
        self.state = base.state
        self.index = base.index
        self.problems: list[InterventionError] = []
        self._whole: dict[str, Value] = {}  # what bundles are to be
        self._impossible: set[str] = set()  # their values are not known

    def _is_state(self, target: str) -> bool:
        return self._task.model.declared(target).role == "state"

    @property
    def attempt(self) -> int:
        """How many draws were rejected before."""
        return self._key.attempt

    def again(self, key: NoiseKey) -> Solver:
        """Return a solver of the same request at another draw."""
        return Solver(self.base, self.asked, self.pending, key, self)

    def solve(self, space: AnyRegion | None, head: frozenset[str]) -> list[InterventionError]:
        """Solve for the parameters, then for the states; return what is wrong.

        Args:
            space: Every target has to lie in, if any.
            head: What decides which bodies there are. Where that is impossible, nothing is known
                of the bodies, and states are not looked at.
        """
        self._solve_parameters()
        if head.isdisjoint(self._impossible):
            self._set_states()
        self._check(space)
        return self.problems

    def _solve_parameters(self) -> None:
        """Mutilate the model and recompute the descendants of the targets."""
        acts = {t: na for t, na in self.acts.items() if not self._is_state(t)}
        if not acts:
            return
        targets = tuple(target for target in acts if target in self.static)
        draws = [t for t in targets if isinstance(acts[t][1], Draw)]
        if self._earlier is None:
            moving = _moving(acts, self.static, self._task.actions)
            kept = {target: named for target, named in acts.items() if target not in moving}
            self.model, cycles = self.base.model.without_cycles(dict(kept.values()))
            self.problems += [*{p.variable: p for p in moving.values()}.values(), *cycles]
            self._impossible = {*moving, *chain(*(problem.cycle for problem in cycles))}
            targets = tuple(target for target in targets if target not in self._impossible)
            draws = [target for target in draws if target in targets]
            self.order = tuple(self._following(targets))
            if any(self._follows_others(*acts[target]) for target in draws):
                follow = frozenset(self.order)
                self.order = tuple(n for n in self.model.structure.order if n in follow)
        else:
            self.model, self.order = self._earlier.model, self._earlier.order
            self._unchanged = self._earlier.same_at(self._key)
            self._together = self._earlier._together
            if self._together is None:
                self._together = Draws(self._task.model, self.acts, self.order)
                self._earlier._together = self._together
        known = dict(self.static)
        for target in targets:
            del known[target]
        if draws:  # and states among them
            known |= self._task.states(self.base.state)
        self._solve(self.order, known)
        self._draws = draws
        self._earlier = None  # attempts are no chain

    def _following(self, targets: tuple[str, ...]) -> tuple[str, ...]:
        """Name what has to be computed again, causes first; mechanisms may have added edges."""
        held = self.model.interventions.items()
        actions = self._task.actions
        if not any(isinstance(act, Mechanism) and name not in actions for name, act in held):
            return self._task.static_order(targets)
        structure = self.model.structure
        follow = {*targets, *structure.instant_descendants(targets)}
        return tuple(n for n in structure.order if n in follow and n in self.static)

    def _follows_others(self, name: str, act: Intervention) -> bool:
        """Tell whether what a variable is drawn from depends on other variables."""
        requested: Any = self._task.model.declared(whole_of(act, name))
        source = act.source if isinstance(act, Draw) else None
        found = requested.space(source) if isinstance(source, str) else source
        return found is not None and bool(found.parents())

    def same_at(self, key: NoiseKey) -> frozenset[str]:
        """Name what was computed and does not follow from anything that is drawn again."""
        mine = self._key
        here = (key.noise, key.episode, key.step) == (mine.noise, mine.episode, mine.step)
        kept = key.kept if here else frozenset()
        if kept not in self._same:
            self._same[kept] = self._without_draws(kept)
        return self._same[kept]

    def _without_draws(self, kept: frozenset[str]) -> frozenset[str]:
        anew = {
            target
            for target, (name, act) in self.acts.items()
            if isinstance(act, Draw) and whole_of(act, name) not in kept
        }
        for name in self.order:
            bounds = self._task.model.declared(name).bounds
            is_bound = bounds is not None and bounds.parents()
            if is_bound or not anew.isdisjoint(self.model.structure.parents(name)):
                anew.add(name)
        return frozenset(self.order) - anew

    @cached_property
    def fixed(self) -> dict[str, Hard]:
        """What holds the values that came out of draws, by target."""
        return {target: Hard(self.static[target].tolist()) for target in self._draws}

    def _solve(self, order: Iterable[str], known: dict[str, Value]) -> None:
        """Compute variables one after another, and stop where one is impossible.

        A mechanism never meets values that its parents cannot have.
        """
        impossible: set[str] = set()
        earlier, unchanged = self._earlier, self._unchanged
        drawn = {} if self._together is None else self._together.at(self._key)
        for name in order:
            if earlier is not None and name in unchanged:
                known[name] = self.static[name] = earlier.static[name]
                continue
            variable = self._task.model.declared(name)
            if impossible and not impossible.isdisjoint(p.name for p in variable.all_parents):
                impossible.add(name)
                continue
            if name in drawn:
                known[name] = self.static[name] = drawn[name]
                continue
            follows = variable.bounds is not None and variable.bounds.parents()
            try:
                known[name] = value = self.model.evaluate(name, known, self._key)
                if value.shape != variable.shape:  # of a mechanism that a user gave
                    raise WrongValue(name, value, variable.shape, np.shape(value))
                check_bounds(variable, value, self._context() if follows else {})
            except InterventionError as problem:
                self.problems.append(problem)
                impossible.add(name)
            else:
                self.static[name] = value
        self._impossible |= impossible

    def _coordinates(self, name: str) -> Value:
        """Give the value that something has which was asked for, such as other coordinates."""
        targets = self._task.model.targets(name)
        values = [self._value(target) for target in targets]
        if targets == (name,):
            return np.asarray(values[0])
        return self._task.in_coordinates(name, *values)

    def _value(self, target: str) -> Value:
        if target == CONTROL_INDEX:
            return np.asarray(self.index)
        if target in self._task.slices:
            return self._task.view(target, self.state)
        return self.static[target]

    def _set_states(self) -> None:
        """Set states, and carry along those whose parents were set.

        States that others follow come first; a shift or scale starts from where its state was
        carried to.
        """
        self.state = self.base.state.copy()
        followed = {variable.name for variable in self._task.carried}
        acts = [t for t in self.acts if self._is_state(t)]
        for target in sorted(acts, key=lambda name: name in followed):
            if target not in followed:
                self._set(target)
        for variable in self._task.carried:
            name, act = self.acts.get(variable.name, (None, None))
            if name is None or isinstance(act, SOFT):
                self._carry(variable)
            if name is not None:
                self._set(variable.name)

    def _set(self, target: str) -> None:
        variable, where = self._task.model.declared(target), self._task.slices.get(target)
        try:
            value = self._wish(target, *self.acts[target])
            if where is not None and same(value, self._task.view(target, self.base.state)):
                self.state.vector[where] = self.base.state.vector[where]
                return
            if variable.bounds is None or self._impossible.isdisjoint(variable.bounds.parents()):
                check_bounds(variable, value, self.static)
        except InterventionError as problem:
            if problem.variable not in {p.variable for p in self.problems}:  # of a bundle's parts
                self.problems.append(problem)
            return
        if where is None:
            self.index = int(value)
        else:
            self.state.vector[where] = np.ravel(self._exact(target, value))

    def _exact(self, target: str, value: Value) -> Value:
        """Make a quaternion one of norm 1; other values are as exact as they were given."""
        bounds = self._task.model.declared(target).bounds
        return bounds.nearest(value) if isinstance(bounds, Rotations) else value

    def _wish(self, target: str, name: str, act: Intervention) -> Value:
        """Give the value that a state is to have."""
        whole = whole_of(act, name)
        requested: Any = self._task.model.declared(whole)
        if whole == name:
            value = self._wanted(name, act)
            if name == target:
                return value
            if np.array_equal(value, self._coordinates(name)):
                return self._value(target)
            return np.asarray(requested.inverse.bind()(value))
        if whole not in self._whole:
            self._whole[whole] = self._wanted(whole, act)
        return np.asarray(
            requested.mechanism.split(self._whole[whole])[requested.parts.index(name)]
        )

    def _wanted(self, name: str, act: Intervention) -> Value:
        """Give the value that is asked of a state, of other coordinates or of a bundle."""
        requested: Any = self._task.model.declared(name)
        if isinstance(act, Hard):
            value = requested.array(act.value)
        elif isinstance(act, Mechanism):
            values = {**self.static, **self._task.states(self.base.state)}
            value = _followed(requested, act, values, self._key)
        elif isinstance(act, Natural | Null):
            value = self._coordinates(name)
        elif isinstance(act, Draw):
            source = requested.space(act.source) if isinstance(act.source, str) else act.source
            values = {**self.static, **self._task.states(self.state)}
            value = self._key.draw(source, name, requested.shape, values, act.stream)
        else:
            present = self._coordinates(name)
            by = np.asarray(act.by)
            value = present + by if isinstance(act, Shift) else present * by
        return np.asarray(value)

    def _carry(self, variable: Measured) -> None:
        """Move a state with the parents that act on it when set (a block that grows)."""
        parents = self._task.set_parents[variable.name]
        new = [self._value(parent) for parent in parents]
        where = self._task.slices[variable.name]
        if variable.name in self.base.fresh:
            if variable.start is not None:
                self.state.vector[where] = np.ravel(variable.start.bind()(*new))
            return
        old = [self.before(parent) for parent in parents]
        moved = {p for p, a, b in zip(parents, old, new, strict=True) if not same(a, b)}
        if moved:
            again = self.base.at_start or not moved.isdisjoint(variable.restart)
            self.state.vector[where] = np.ravel(self.moved(variable, old, new, again=again))

    def moved(
        self, variable: Measured, old: list[Value], new: list[Value], *, again: bool
    ) -> Value:
        """Give a state after what it follows was set; ``again``: as at the start."""
        if again and variable.start is not None:
            return np.asarray(variable.start.bind()(*new))
        present = self._task.view(variable.name, self.base.state)
        if variable.carry is None:
            return present
        return np.asarray(variable.carry.bind()(present, *old, *new))

    def before(self, name: str) -> Value:
        """Give the value that a parameter or a state has before the intervention."""
        if name in self._task.slices:
            return self._task.view(name, self.base.state)
        return self.base.static[name]

    def _check(self, space: AnyRegion | None) -> None:
        """Check the asked space, where the value and what the space follows are known."""
        if space is None:
            return
        context = self._context()
        unknown = self._impossible | {problem.variable for problem in self.problems}
        for name in self.asked:
            requested = self._task.model.declared(name)
            spaces = (s.parents() for s in (requested.bounds, requested.a, requested.b) if s)
            if not unknown.isdisjoint({name, *self._task.model.targets(name), *chain(*spaces)}):
                continue
            try:
                value = self._held(name) if self._is_action(name) else self._coordinates(name)
                check_space(requested, value, space, context)
            except InterventionError as problem:
                if not self._asked_within(requested, space, context):
                    self.problems.append(problem)

    def _asked_within(self, requested: Variable, space: AnyRegion, context: Values) -> bool:
        """Tell whether an intervention on other coordinates always lies in a space."""
        if getattr(requested, "inverse", None) is None:
            return False
        _, act = self.pending[self._task.model.target(requested.name)]
        if not isinstance(act, Hard):
            return isinstance(act, Draw) and act.source == space
        try:
            check_space(requested, requested.array(act.value), space, context)
        except InterventionError:
            return False
        return True

    def as_asked(self, problems: list[InterventionError]) -> list[InterventionError]:
        """Say of a bundle, if that was asked for, what is wrong with its parts."""
        found = list(problems)
        for name in self.asked:
            bundle = self._task.model.declared(name)
            wrong = {p.variable: p for p in found if isinstance(p, OutOfBounds | WrongValue)}
            if wrong.keys().isdisjoint(bundle.parts):
                continue
            parts = [
                np.asarray(wrong[p].value) if p in wrong else self._value(p) for p in bundle.parts
            ]
            try:
                check_bounds(bundle, self._task.in_coordinates(name, *parts), self.static)
            except InterventionError as problem:
                found = [p for p in found if p not in [wrong.get(part) for part in bundle.parts]]
                found.append(problem)
        return found

    def _context(self) -> Values:
        return {**self.static, **self._task.states(self.state)}

    def _is_action(self, name: str) -> bool:
        return self._task.model.target(name) in self._task.actions

    def _held(self, name: str) -> Value:
        """Give the action that is to be taken from now on."""
        acts = [self.acts[target][1] for target in self._task.model.targets(name)]
        if all(isinstance(act, Hard) for act in acts):
            values = [np.asarray(act.value) for act in acts if isinstance(act, Hard)]
            return values[0] if len(values) == 1 else np.concatenate([v.ravel() for v in values])
        raise InterventionError(
            f"do({name}): {acts[0]!r} is another action at every step, so it cannot be compared "
            "with a space; leave out `space`, or give one action as numbers",
            variable=name,
        )

    def frozen(self, target: str, name: str, act: Intervention) -> tuple[str, Intervention]:
        """Replace a draw, or a change of a state, by the value that came out."""
        keeps = isinstance(act, (*SOFT, Mechanism, Natural)) and not self._is_state(target)
        if isinstance(act, Hard) or target in self._task.actions or keeps:
            return name, act
        if target in self.fixed:
            return target, self.fixed[target]
        return target, Hard(self._value(target).tolist())


def _moving(
    acts: Mapping[str, tuple[str, Intervention]],
    static: Mapping[str, Value],
    actions: Iterable[str],
) -> dict[str, InterventionError]:
    """Return an error for each parameter that should follow what moves.

    Parameters change at interventions only; actions follow the present, not what was earlier.
    """
    found: dict[str, InterventionError] = {}
    for target, (name, act) in acts.items():
        if not isinstance(act, Mechanism):
            continue
        moving = [p.name for p in act.parents if p.lag or p.name not in static]
        who, what = "a parameter", "parameters of the same instant"
        if target in actions:
            moving, who, what = [p.name for p in act.parents if p.lag], "an action", "the present"
        if moving:
            asked = whole_of(act, name)
            found[target] = InterventionError(
                f"do({asked}): {who} can follow {what} only, not {', '.join(moving)}; let a plan "
                "set it step by step instead",
                variable=asked,
                value=act,
            )
    return found


def _followed(requested: Variable, act: Mechanism, values: Values, key: NoiseKey) -> Value:
    """Compute the value that a state is set to.

    Raises:
        InterventionError: It should follow what is neither a parameter nor a state, or the
            function gives something of another shape or type.
    """
    unknown = [p.name for p in act.parents if p.lag or p.name not in values]
    if unknown:
        raise InterventionError(
            f"do({requested.name}): a state can be set to a function of parameters and states, "
            f"not of {', '.join(unknown)}",
            variable=requested.name,
            value=act,
        )
    given = (np.array(values[p.name]) for p in act.parents)
    found: Any = act.equation.bind()(*given, **noise_of(requested, act, key, values))
    return coerce(requested, found)
