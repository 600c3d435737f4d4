"""A world or model with permissions and a budget, for discovery algorithms and agents."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, final

from scm_world._arguments import one_of, whole_number
from scm_world._patterns import as_names, fitting
from scm_world._types import Floats
from scm_world.errors import Forbidden, UnknownOption
from scm_world.queries.plans import Plan
from scm_world.queries.questions import Questions
from scm_world.queries.samples import Samples, Setting, column, named_outcomes, refuse_late
from scm_world.queries.twins import asked
from scm_world.variables import Contact, Reaches

QUESTIONS = ("see", "do", "counterfactual")


@final
class Laboratory:
    """Experiments on a world, or on a causal model, whose graph is hidden.

    Every experiment is checked before it begins. Episodes that fail while they run count against
    the budget, since the failure is information.

    Args:
        world: A ``World`` or an ``SCM``; it is not changed.
        allow: The permitted queries: ``"see"``, ``"do"``, ``"counterfactual"``.
        visible: Patterns of the observable variables, such as ``"tool_block.*"``.
        settable: Patterns of the variables that may be set.
        budget: Total number of episodes; unlimited if None.
        outcomes: Reported outcomes: names of visible variables (their final values) or
            ``Outcome``; the final values of all visible variables if None.
        setting: ``policy``, ``nature``, ``steps``, ``seed`` and ``workers``; see ``Setting``.

    Attributes:
        spent: Number of episodes used.

    Raises:
        UnknownOption: A pattern matches no variable, or a query or a setting does not exist.
        Forbidden: An outcome is not visible.

    Example:
        >>> from scm_world.queries.world import World
        >>> world = World("pushing", backend="fake")
        >>> lab = Laboratory(world, settable=["*.mass"], visible=["tool_block.*"], budget=10)
        >>> found = lab.do({"tool_block.mass": 0.05}, n=4)
        >>> found["tool_block.mass"].shape, lab.remaining
        ((4,), 6)
    """

    def __init__(
        self,
        world: Questions,
        *,
        allow: Iterable[str] = QUESTIONS,
        visible: Iterable[str] = ("*",),
        settable: Iterable[str] = ("*",),
        budget: int | None = None,
        outcomes: Iterable[Any] | None = None,
        **setting: object,
    ) -> None:
        if not isinstance(world, Questions):
            raise UnknownOption("world", world, ("a World", "an SCM"))
        self._world, (self._twins, self._system) = world, asked(world)
        self._setting = Setting.of(self._system, setting)
        self._steps = self._system.length(self._setting.steps)
        self.allow = as_names(allow)
        for question in self.allow:
            one_of("question", question, QUESTIONS)
        model = self._system.model
        everything = tuple(n for n in model if not model.declared(n).is_constant)
        can_be_set = tuple(n for n in model if model.declared(model.target(n)).settable)
        self.visible = fitting(visible, everything, "visible")
        self.settable = fitting(settable, can_be_set, "settable")
        self.budget = None if budget is None else whole_number("budget", budget, least=0)
        wanted = self.visible if outcomes is None else outcomes
        self.outcomes = named_outcomes(wanted, "outcome of a laboratory")
        for outcome in self.outcomes:
            if outcome.name not in self.visible:
                raise Forbidden(f"see {outcome.name}", self.visible)
        self._lock = threading.Lock()
        self._units: list[Plan] = []  # interventions of each new episode, refused ones included
        self.spent = 0

    @property
    def remaining(self) -> int | None:
        """Number of episodes left; None if unlimited."""
        return None if self.budget is None else self.budget - self.spent

    # --- experiments --------------------------------------------------------------------------

    def see(self, n: int) -> Samples:
        """Observe new episodes.

        Raises:
            Forbidden: The query is not permitted, or the budget is too small.
        """
        return self._experiment("see", {}, n)

    def do(self, request: Mapping[str, Any], n: int = 1) -> Samples:
        """Intervene in new episodes.

        Args:
            request: Interventions, with or without a time.
            n: Number of episodes.

        Raises:
            Forbidden: The query is not permitted, a target may not be set, or the budget is too
                small.
            InterventionError: The intervention was refused: before the experiment, without cost,
                or while it ran, at the cost of all episodes.
        """
        return self._experiment("do", request, n)

    def counterfactual(
        self, unit: int, request: Mapping[str, Any], *, at: int = 0
    ) -> dict[str, Floats]:
        """Run the counterfactual of a unit under another intervention.

        Args:
            unit: Number of an episode of an earlier experiment.
            request: The intervention.
            at: The control step of the intervention.

        Returns:
            The reported outcomes of that unit under the intervention.

        Raises:
            Forbidden: As in ``do``, or the unit does not exist.
        """
        unit, at = whole_number("unit", unit, least=0), whole_number("at", at, least=0)
        with self._lock:
            request = self._permit("counterfactual", request, 1)
            self._twins.require_exact("a counterfactual")
            if at >= max(self._steps, 1):
                raise UnknownOption("at", at, (f"a control step from 0 to {self._steps - 1}",))
            if unit >= len(self._units):
                last = len(self._units) - 1
                there = f"units 0 to {last}" if last >= 0 else "none yet: see or do first"
                raise Forbidden(f"imagine unit {unit}, which was never seen", (there,))
            plan = self._world.planned(self._units[unit])
            episode = self._twins.episode(self._setting.unit(self._system, plan, unit))
            self.spent += 1
            names = dict.fromkeys(one.name for one in self.outcomes)
            other = episode.counterfactual(request, at=at, record=names)
        return {column(outcome): outcome.of(other) for outcome in self.outcomes}

    def _experiment(self, kind: str, request: Mapping[str, Any], n: int) -> Samples:
        n = whole_number("n", n, least=1)
        with self._lock:
            plan = self._permit(kind, request, n)
            first, setting = len(self._units), vars(self._setting)
            self._units += [plan] * n
            self.spent += n
            found = self._world.sample(n, plan, outcomes=self.outcomes, first=first, **setting)
        return replace(found, plan=plan)

    # --- permissions --------------------------------------------------------------------------

    def _permit(self, kind: str, request: Mapping[str, Any], n: int) -> Plan:
        """Refuse requests that are not permitted, also in events and parents of mechanisms.

        Return the plan; patterns mean what may be set.
        """
        if kind not in self.allow:
            raise Forbidden(kind, self.allow)
        plan = Plan(request).named(self._system.model, self.settable)
        refuse_late(plan, self._steps)
        for name in plan:
            if name not in self.settable:
                raise Forbidden(f"set {name}", self.settable)

        def sees(body: str) -> bool:  # the ground, or a body with visible variables
            return body in ("floor", "twins") or any(n.startswith(body) for n in self.visible)

        for name, timed in plan.timed():
            event = timed.time.when
            if isinstance(event, Reaches) and event.name not in self.visible:
                raise Forbidden(f"wait with {name} for {event.name}", self.visible)
            if isinstance(event, Contact) and not all(map(sees, (event.first, event.second))):
                raise Forbidden(f"wait with {name} for contacts", self.visible)
        for name, act in plan.acts():
            done = self._system.model.accept(name, act)
            asked = self._system.model.declared(done.whole(name))
            for parent in done.follows(asked) if done.computes else ():
                if parent.name not in self.visible:
                    raise Forbidden(f"let {name} follow {parent.name}", self.visible)
        left = self.remaining
        if left is not None and n > left:
            raise Forbidden(f"run {n} more episodes", [f"{left} episodes"])
        return plan
