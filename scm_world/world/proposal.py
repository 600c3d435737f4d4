"""The first half of a do(): what would the world be, and may it be so? Nothing changes here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Value, Values
from scm_world.entities import CONTROL_INDEX
from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    OutOfBounds,
    WrongShape,
    raise_all,
)
from scm_world.graph import SCM, Moment, flatten
from scm_world.scene import PhysicalState
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
)
from scm_world.variables.checks import check_bounds, check_space
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.compare import same
from scm_world.world.following import followed, refuse_continuous, what_follows
from scm_world.world.restructure import restructured

if TYPE_CHECKING:
    from scm_world.world.declaration import Declaration
    from scm_world.world.world import World

Requests = dict[str, tuple[str, Intervention]]
"""By target: the name that was asked for (the target, or coordinates of it) and the act."""


@final
@dataclass(frozen=True)
class Instant:
    """The world as physics left it, before anyone intervened at this instant.

    Interventions at one instant are one intervention: they are always computed from here, so
    that taking one back leaves no trace, and the order does not matter.

    Attributes:
        declaration: Of the structure that there is.
        model: With the interventions of earlier instants.
        static: Values of everything that physics does not move.
        state: Where everything is.
        index: The control step.
        requests: What has been asked for at this instant so far.
        at_start: Whether an episode is just beginning.
        fresh: States of bodies that come into being.
    """

    declaration: Declaration
    model: SCM
    static: Mapping[str, Value]
    state: PhysicalState
    index: int
    requests: Requests = field(default_factory=dict)
    at_start: bool = False
    fresh: frozenset[str] = frozenset()


@final
@dataclass(frozen=True)
class Proposal:
    """What the world would be after the intervention."""

    declaration: Declaration
    model: SCM
    static: dict[str, Value]
    state: PhysicalState
    index: int
    requests: Requests
    asked: tuple[str, ...]


def accept(
    instant: Instant, request: Mapping[str, Any]
) -> tuple[Requests, list[InterventionError]]:
    """Check names, types and shapes; keep what is right and list what is wrong."""
    model = instant.declaration.model
    accepted: Requests = {}
    problems: list[InterventionError] = []
    for name, value in flatten(request).items():
        if isinstance(value, Null):  # of an entity, not of a variable; see ``restructured``
            continue
        if isinstance(value, Natural) and name in instant.declaration.entity_names:
            continue  # it is there
        try:
            act = _accept(instant, name, value)
            target = model.target(name)
            if target in accepted:
                raise ConflictingTargets((accepted[target][0], name), target)
            accepted[target] = (name, act)
        except InterventionError as problem:
            problems.append(problem)
    return accepted, problems


def _accept(instant: Instant, name: str, value: Any) -> Intervention:
    declaration = instant.declaration
    try:
        return declaration.model.accept(name, value)
    except OutOfBounds as problem:
        # What physics did is possible: a state can always be put back to where it is.
        if name in declaration.slices and np.array_equal(
            problem.value, instant.state.vector[declaration.slices[name]]
        ):
            return Hard(problem.value)
        raise


def propose(
    world: World,
    instant: Instant,
    request: Mapping[str, Any],
    space: AnyRegion | None,
    *,
    attempt: int = 0,
    kept: frozenset[str] = frozenset(),
) -> Proposal:
    """Work out an intervention without touching the world.

    Args:
        world: That is asked.
        instant: From where.
        request: The intervention.
        space: Every target has to lie in, if any.
        attempt: How many draws were rejected before.
        kept: Variables that are not drawn anew for that.

    Raises:
        InterventionError: With every problem of the request.
        UnknownOption: There is no such space.
    """
    space = as_region("space", space)
    moment = replace(world.moment(instant.index), attempt=attempt, kept=kept)
    instant = restructured(world.family, instant, request, moment)
    accepted, problems = accept(instant, request)
    requests: Requests = {**instant.requests, **accepted}
    model = instant.declaration.model
    # What was asked of bodies that are gone waits for them, should they come back at once.
    draft = _Draft(instant, {t: act for t, act in requests.items() if t in model}, moment)
    with np.errstate(all="ignore"):  # what is not finite is refused by name
        draft.solve_parameters()
        if not (draft.is_impossible and len(world.family.head)):
            problems += draft.set_states()  # else bodies and layouts may not go together
        problems += draft.check(accepted, space)
    raise_all(problems)
    asked = tuple(name for name, _ in accepted.values())
    nulls = {n: (n, act) for n, act in flatten(request).items() if isinstance(act, Null)}
    frozen: Requests = {
        target: draft.frozen(target, *named) if target in model else named
        for target, named in {**requests, **nulls}.items()
    }
    return Proposal(
        instant.declaration, draft.model, draft.static, draft.state, draft.index, frozen, asked
    )


@final
class _Draft:
    """A world on paper."""

    def __init__(self, instant: Instant, requests: Requests, moment: Moment) -> None:
        self._world, self._instant, self._requests = instant.declaration, instant, requests
        self.static: dict[str, Value] = dict(instant.static)
        self.model = instant.model
        self.state = instant.state
        self.index = instant.index
        self._moment = moment
        self._problems: list[InterventionError] = []

    def _is_state(self, target: str) -> bool:
        return self._world.model.declared(target).role == "state"

    @property
    def is_impossible(self) -> bool:
        """Whether a parameter cannot have the value that it would get."""
        return bool(self._problems)

    def solve_parameters(self) -> None:
        """Mutilate the model and recompute the descendants of the targets."""
        acts = {t: na for t, na in self._requests.items() if not self._is_state(t)}
        if not acts:
            return
        refuse_continuous(acts, self.static)
        self.model = self._instant.model.with_interventions(dict(acts.values()))
        targets = tuple(target for target in acts if target in self.static)
        draws = [t for t in targets if isinstance(acts[t][1], Draw)]
        order: Iterable[str] = what_follows(self._world, self.model, self.static, targets)
        known = dict(self.static)
        for target in targets:
            del known[target]
        if draws:  # what they are drawn from may follow other variables, states among them
            follow = frozenset(order)
            order = [name for name in self.model.structure.order if name in follow]
            known |= self._world.states(self._instant.state)
        self._solve(order, known)
        if draws:
            held = {target: Hard(self.static[target].tolist()) for target in draws}
            self.model = self.model.with_interventions(held)

    def _solve(self, order: Iterable[str], known: dict[str, Value]) -> None:
        """Compute variables one after another, and stop where one is impossible.

        A mechanism never meets values that its parents cannot have.
        """
        impossible: set[str] = set()
        for name in order:
            variable = self._world.model.declared(name)
            if impossible and not impossible.isdisjoint(p.name for p in variable.all_parents):
                impossible.add(name)
                continue
            known[name] = value = self.model.evaluate(name, known, self._moment)
            if np.shape(value) != variable.shape:  # of a mechanism that a user gave
                raise WrongShape(name, value, variable.shape, np.shape(value))
            follows = variable.bounds is not None and variable.bounds.parents()
            try:
                check_bounds(variable, value, self._context() if follows else {})
            except InterventionError as problem:
                self._problems.append(problem)
                impossible.add(name)
            else:
                self.static[name] = value

    def _coordinates(self, target: str, name: str) -> Value:
        """Give the value of a target in the coordinates that were asked for."""
        value = self._value(target)
        if name == target:
            return np.asarray(value)
        return self._world.in_coordinates(name, value)

    def _value(self, target: str) -> Value:
        if target == CONTROL_INDEX:
            return np.asarray(self.index)
        where = self._world.slices.get(target)
        return self.static[target] if where is None else self.state.vector[where]

    def set_states(self) -> list[InterventionError]:
        """Set states, and carry along those whose parents were set.

        States that others follow come first; a shift or scale starts from where its state was
        carried to.
        """
        self.state = self._instant.state.copy()
        problems: list[InterventionError] = []
        followed = {variable.name for variable in self._world.carried}
        acts = [t for t in self._requests if self._is_state(t)]
        for target in sorted(acts, key=lambda name: name in followed):
            if target not in followed:
                problems += self._set(target)
        for variable in self._world.carried:
            name, act = self._requests.get(variable.name, (None, None))
            if name is None or isinstance(act, SOFT):
                self._carry(variable)
            if name is not None:
                problems += self._set(variable.name)
        return problems

    def _set(self, target: str) -> list[InterventionError]:
        value = self._wish(target, *self._requests[target])
        where = self._world.slices.get(target)
        if where is not None and same(value, self._instant.state.vector[where]):
            self.state.vector[where] = value
            return []
        try:
            check_bounds(self._world.model.declared(target), value, self.static)
        except InterventionError as problem:
            return [problem]
        if where is None:
            self.index = int(value)
        else:
            self.state.vector[where] = self._exact(target, value)
        return []

    def _exact(self, target: str, value: Value) -> Value:
        """Make a quaternion one of norm 1; other values are as exact as they were given."""
        bounds = self._world.model.declared(target).bounds
        return bounds.nearest(value) if isinstance(bounds, Rotations) else value

    def _wish(self, target: str, name: str, act: Intervention) -> Value:
        requested: Any = self._world.model.declared(name)
        if isinstance(act, Hard):
            value = requested.array(act.value)
        elif isinstance(act, Mechanism):
            values = {**self.static, **self._world.states(self._instant.state)}
            value = followed(requested, act, values)
        elif isinstance(act, Natural | Null):
            value = self._coordinates(target, name)
        elif isinstance(act, Draw):
            source = requested.space(act.source) if isinstance(act.source, str) else act.source
            values = {**self.static, **self._world.states(self.state)}
            value = self._moment.draw(source, name, requested.shape, values, act.stream)
        else:
            present = self._coordinates(target, name)
            by = np.asarray(act.by)
            value = present + by if isinstance(act, Shift) else present * by
        return np.asarray(value if name == target else requested.inverse.bind()(value))

    def _carry(self, variable: Measured) -> None:
        """Let a state follow the parents that act on it when set (a block that grows)."""
        parents = variable.set_parents()
        new = [self._value(parent) for parent in parents]
        where = self._world.slices[variable.name]
        if variable.name in self._instant.fresh:
            if variable.start is not None:
                self.state.vector[where] = variable.start.bind()(*new)
            return
        old = [self._before(parent) for parent in parents]
        moved = {p for p, a, b in zip(parents, old, new, strict=True) if not same(a, b)}
        if moved:
            again = self._instant.at_start or not moved.isdisjoint(variable.restart)
            self.state.vector[where] = self._moved(variable, where, old, new, again=again)

    def _moved(
        self, variable: Measured, where: slice, old: list[Value], new: list[Value], *, again: bool
    ) -> Value:
        if again and variable.start is not None:
            return np.asarray(variable.start.bind()(*new))
        if variable.carry is None:
            return self._instant.state.vector[where]
        present = self._instant.state.vector[where]
        return np.asarray(variable.carry.bind()(present, *old, *new))

    def _before(self, name: str) -> Value:
        where = self._world.slices.get(name)
        return self._instant.static[name] if where is None else self._instant.state.vector[where]

    def check(self, accepted: Requests, space: AnyRegion | None) -> list[InterventionError]:
        """Check bounds and the asked space, now that all other values are known."""
        problems = self._problems
        if space is None or problems:
            return problems
        context = self._context()
        for target, (name, act) in accepted.items():
            requested = self._world.model.declared(name)
            try:
                value = self._held(act) if target == "action" else self._coordinates(target, name)
                check_space(requested, value, space, context)
            except InterventionError as problem:
                problems.append(problem)
        return problems

    def _context(self) -> Values:
        return {**self.static, **self._world.states(self.state)}

    def _held(self, act: Intervention) -> Value:
        if isinstance(act, Hard):
            return np.array(act.value)
        raise InterventionError(
            f"do(action): {act!r} is another action at every step, so it cannot be held against a "
            "space; leave out `space`, or give one action as nine numbers",
            variable="action",
        )

    def frozen(self, target: str, name: str, act: Intervention) -> tuple[str, Intervention]:
        """Replace a draw, or a change of a state, by the value that came out."""
        keeps = isinstance(act, (*SOFT, Mechanism, Natural)) and not self._is_state(target)
        if isinstance(act, Hard) or target == "action" or keeps:
            return name, act
        return target, Hard(self._value(target).tolist())
