"""The first half of a do(): what would the world be, and may it be so? Nothing changes here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from scm_world._types import Value
from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    NotIntervenable,
    OutOfBounds,
    UnknownVariable,
    raise_all,
)
from scm_world.graph import SCM, flatten
from scm_world.models import State
from scm_world.variables import Draw, Hard, Intervention, Natural, Null, divided
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.draft import Draft, Requests
from scm_world.world.restructure import restructured

__all__ = ["Accepted", "Instant", "Proposal", "Requests", "accept", "propose"]

if TYPE_CHECKING:
    from scm_world.world.declaration import Declaration
    from scm_world.world.world import World


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
    state: State
    index: int
    requests: Requests = field(default_factory=dict)
    at_start: bool = False
    fresh: frozenset[str] = frozenset()


@final
@dataclass(frozen=True)
class Proposal:
    """What the world would be after the intervention.

    Attributes:
        declaration: Of the structure that there would be.
        model: With the interventions that would hold.
        static: Values of everything that physics does not move.
        state: Where everything would be.
        index: The control step.
        requests: What has been asked for at this instant, draws as values.
        asked: The names that were asked for now.
        draft: How it was worked out, for another attempt.
    """

    declaration: Declaration
    model: SCM
    static: dict[str, Value]
    state: State
    index: int
    requests: Requests
    asked: tuple[str, ...]
    draft: Draft | None = None


@final
@dataclass(frozen=True)
class Accepted:
    """A request that was checked by itself.

    Attributes:
        requests: What is right in it.
        asked: The names that this was asked under.
        problems: What is wrong in it.
    """

    requests: Requests
    asked: tuple[str, ...]
    problems: list[InterventionError]


def accept(instant: Instant, request: Mapping[str, Any]) -> Accepted:
    """Check names, types and shapes; keep what is right and list what is wrong.

    What is asked of a bundle is asked of its parts.
    """
    model = instant.declaration.model
    accepted: Requests = {}
    asked: dict[str, str] = {}
    problems: list[InterventionError] = []
    for name, value in flatten(request).items():
        if isinstance(value, Null):  # of an entity, not of a variable; see ``restructured``
            continue
        if isinstance(value, Natural) and name in instant.declaration.entity_names:
            continue  # it is there
        try:
            act = _accept(instant, name, value)
            targets = model.targets(name)
            twice = next((target for target in targets if target in asked), None)
            if twice is not None:
                raise ConflictingTargets((asked[twice], name), twice)
            asked |= dict.fromkeys(targets, name)
            for part, own in divided(model.declared(name), act).items():
                accepted[model.target(part)] = (part, own)
        except InterventionError as problem:
            reason = instant.declaration.task.refusal(name)
            if reason is not None and isinstance(problem, UnknownVariable):
                problem = NotIntervenable(name, reason)
            problems.append(problem)
    return Accepted(accepted, tuple(dict.fromkeys(asked.values())), problems)


def _accept(instant: Instant, name: str, value: Any) -> Intervention:
    declaration = instant.declaration
    try:
        return declaration.model.accept(name, value)
    except OutOfBounds as problem:
        # What physics did is possible: a state can always be put back to where it is.
        if name in declaration.slices and np.array_equal(
            problem.value, declaration.view(name, instant.state)
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
    last: Proposal | None = None,
) -> Proposal:
    """Work out an intervention without touching the world.

    Args:
        world: That is asked.
        instant: From where.
        request: The intervention.
        space: Every target has to lie in, if any.
        attempt: How many draws were rejected before.
        kept: Variables that are not drawn anew for that.
        last: An earlier attempt at the same. What is the same again is taken from there; nothing
            comes out differently for that.

    Raises:
        InterventionError: With every problem of the request.
        UnknownOption: There is no such space.
    """
    space = as_region("space", space)
    moment = replace(world.moment(instant.index), attempt=attempt, kept=kept)
    earlier = None if last is None or _restructures(world, request) else last.draft
    instant = earlier.instant if earlier else restructured(world.family, instant, request, moment)
    accepted = earlier.accepted if earlier else accept(instant, request)
    problems = [*accepted.problems]
    requests: Requests = {**instant.requests, **accepted.requests}
    model = instant.declaration.model
    # What was asked of bodies that are gone waits for them, should they come back at once.
    mine = {t: act for t, act in requests.items() if t in model}
    draft = Draft(instant, accepted, mine, moment, earlier)
    with np.errstate(all="ignore"):  # what is not finite is refused by name
        draft.solve_parameters()
        if not (draft.is_impossible and len(world.family.head)):
            problems += draft.set_states()  # else bodies and layouts may not go together
        problems += draft.check(space)
    raise_all(draft.as_asked(problems) if problems else problems)
    nulls = {n: (n, act) for n, act in flatten(request).items() if isinstance(act, Null)}
    frozen: Requests = {
        target: draft.frozen(target, *named) if target in model else named
        for target, named in {**requests, **nulls}.items()
    }
    return Proposal(
        instant.declaration,
        draft.model,
        draft.static,
        draft.state,
        draft.index,
        frozen,
        accepted.asked,
        draft,
    )


def _restructures(world: World, request: Mapping[str, Any]) -> bool:
    """Tell whether it is drawn which bodies there are, so that it differs between attempts."""
    head = world.family.head
    return any(isinstance(act, Draw) and name in head for name, act in flatten(request).items())
