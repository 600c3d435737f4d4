"""Causal models without a backend: as a step function, and under what they were given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Values
from scm_world.errors import ModelError
from scm_world.graph import SCM
from scm_world.tasks import StepTask
from scm_world.variables import Measured
from scm_world.world import CausalSystem

if TYPE_CHECKING:
    from scm_world.queries.plans import Plan


@dataclass(frozen=True, eq=False)
class _Steps:
    """The mechanisms of a model as a step function: of all that is no parameter and no action."""

    model: SCM
    moved: tuple[str, ...]

    def __call__(self, parameters: Values, state: Values, action: Values, noise: Values) -> Values:
        """Return all states one step later."""
        known = {**parameters, **action}
        later = self.model.solve(known, previous={**known, **state})
        return {name: later[name] for name in self.moved}


def stepped(model: SCM) -> StepTask:
    """Return a causal model with lags as a step function, for ``World.fit``.

    Roots that are drawn once are its parameters, actions its actions, and all others its states. A
    control step is a step of the model, of 1 s.

    Raises:
        ModelError: A model without lagged edges, or with lags of several steps, an action that acts
            within its instant, or noise that later steps depend on.
    """
    lagged = {edge.cause for edge in model.edges if edge.lag}
    actions = [v for v in model.variables if v.role == "action"]

    def moves(name: str) -> bool:
        return not lagged.isdisjoint({name, *model.structure.instant_descendants([name])})

    problems = [] if lagged else ["a model without lagged edges has no motion to be fitted"]
    problems += [f"a fit takes lags of one step, not {e}" for e in model.edges if e.lag > 1]
    problems += [
        f"{v.name!r} acts within its instant, which a step function does not: give it a lag of 1"
        for v in actions
        if model.structure.instant_descendants([v.name])
    ]
    problems += [
        f"the noise of {v.name!r} moves what comes later, which a fit would take for a deviation: "
        "leave it out of the model that is fitted"
        for v in model.variables
        if v.own_noise is not None and not v.per_episode and moves(v.name)
    ]
    if problems:
        raise ModelError(problems)
    held = [n for n in model if n in _held(model) and n not in model.interventions]
    moved = tuple(n for n in model if n not in {*held, *(v.name for v in actions)})
    first = model.solve({v.name: np.zeros(v.shape) for v in actions}, begins=True)
    kept, states = ("unit", "shape", "dtype", "bounds"), []
    for name in moved:
        fields = {part: getattr(model.declared(name), part) for part in kept}
        states.append(Measured(name=name, default=first[name], **fields))
    return StepTask(
        _Steps(model, moved),
        name="model",
        parameters=[model.declared(name) for name in held],
        actions=actions,
        states=states,
        control_dt=1.0,
    )


def _held(model: SCM) -> set[str]:
    """Name the roots that are drawn once in an episode."""
    return {v.name for v in model.variables if v.per_episode}


def refuse_other_than_parameters(model: SCM, plan: Plan, what: str) -> None:
    """Refuse a plan that replaces mechanisms which a fit computes."""
    names = {name for _, parts in plan.layers() for name in parts}
    other = sorted(names - _held(model))
    if other:
        advice = "fit World(model.do({…})), or leave it out"
        raise ModelError([f"{what} has interventions on {', '.join(other)}: {advice}"])


def as_given(system: object) -> Any:
    """Return equations as a model under the interventions they were given; anything else unchanged.

    Raises:
        ModelError: A given intervention has a time.
    """
    system = system.one if isinstance(system, CausalSystem) else system
    if not isinstance(system, CausalSystem) or system.backend is not None:
        return system
    plan: Any = getattr(system, "plan", None)  # bare equations have none
    if plan and any(plan.timed()):
        text = (
            "interventions with a time, which a world of equations was given, cannot be kept here"
        )
        raise ModelError([f"{text}: leave out given({plan})"])
    return system.model.given(dict(plan.acts())) if plan else system.model
