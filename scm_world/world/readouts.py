"""Evaluating the computed variables of the present, quickly and in causal order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

import numpy as np

from scm_world._types import Value
from scm_world.graph import SCM
from scm_world.variables import Derived, Measured, Parent
from scm_world.world.bound import Bound, key


@final
class Readouts:
    """Mechanisms bound to two dictionaries of values: now, and one control step ago.

    The dictionaries are the world's own; binding them once makes a control step cheap.

    Args:
        model: The declared model.
        now: Present values, which this object completes.
        before: Values of one control step ago, of the parents of lag 1.
        order: What is computed, causes before effects.
    """

    def __init__(
        self,
        model: SCM,
        now: dict[str, Value],
        before: dict[str, Value],
        order: tuple[str, ...],
    ) -> None:
        self._now, self._before = now, before
        self._model = model
        self._plans: dict[tuple[str, ...], Bound] = {}
        self._sure: Bound | None = None  # whose arguments are those of the present
        self._fresh = False
        self.order = order
        self._computed = frozenset(order)
        self.lagged = tuple(
            dict.fromkeys(
                parent.name
                for name in self.order
                for parent in model.declared(name).all_parents
                if parent.lag == 1
            )
        )

    def needed(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """List what has to be computed for some variables and for the memory, causes first."""
        wanted: set[str] = set()
        stack = [name for name in (*names, *self.lagged) if name in self._computed]
        while stack:
            name = stack.pop()
            if name not in wanted:
                wanted.add(name)
                parents = self._model.declared(name).all_parents
                stack.extend(p.name for p in parents if p.lag == 0 and p.name in self._computed)
        return tuple(name for name in self.order if name in wanted)

    def evaluate(self, names: tuple[str, ...] | None = None) -> None:
        """Compute variables and whatever they need, into the present values.

        Args:
            names: What is needed; everything if None.
        """
        wanted = self.order if names is None else names
        plan = self._plans.get(wanted)
        if plan is None:
            plan = self._plans[wanted] = Bound(self._model, self._now, self.needed(wanted))
        if plan is not self._sure:
            plan.check()
            self._sure = plan
        plan.run()
        self._fresh = True

    def stale(self) -> None:
        """Say that the present has changed, whatever has."""
        self._fresh = False
        self._sure = None

    def moved(self) -> None:
        """Say that physics has moved the states, and that nothing else has changed."""
        self._fresh = False

    def remember(self) -> None:
        """Let the present values become those of one control step ago."""
        if not self._fresh:
            self.evaluate(self.lagged)
        now, before = self._now, self._before
        for name in self.lagged:
            before[name][...] = now[name]

    def recall(self, earlier: Mapping[str, Value]) -> None:
        """Take over what is remembered of another structure; the present stands in for the rest."""
        self.forget()
        for name in self.lagged:
            if name in earlier:
                self._keep(name, earlier[name])

    def forget(self) -> None:
        """Begin an episode: there is no earlier step, so the present stands in for it."""
        self.evaluate(self.lagged)
        for name in self.lagged:
            self._keep(name, self._now[name])

    def _keep(self, name: str, value: Value) -> None:
        """Keep a value of one step ago, beside the present ones so that one look-up finds all."""
        real = self._model.declared(name).dtype == "real"  # also where the first one is whole
        kept, found = self._before.get(name), np.asarray(value, dtype=np.float64 if real else None)
        if kept is None or (kept.shape, kept.dtype) != (found.shape, found.dtype):
            self._before[name] = self._now[key(Parent(name, 1))] = found.copy()
            self._sure = None
        else:  # the same array, so that nothing has to be bound anew
            kept[...] = found


def computed_order(model: SCM) -> tuple[str, ...]:
    """List the variables that are computed from what moves, causes before effects."""
    moving = {v.name for v in model.variables if isinstance(v, Measured)}
    follow = set(model.structure.instant_descendants(moving))
    # Other coordinates of a quantity have no effects: computing them can wait until asked.
    follow |= {v.name for v in model.variables if isinstance(v, Derived) and v.inverse}
    return tuple(
        name
        for name in model.structure.order
        if (name in follow or name in moving) and _is_computed(model, name)
    )


def _is_computed(model: SCM, name: str) -> bool:
    variable = model.declared(name)
    if isinstance(variable, Measured):
        return variable.mechanism is not None
    return isinstance(variable, Derived)


def static_order(model: SCM, dynamic: Iterable[str]) -> tuple[str, ...]:
    """List what is decided by interventions alone, causes before effects."""
    excluded = {*dynamic, *(v.name for v in model.variables if v.role in {"state", "action"})}
    excluded |= {v.name for v in model.variables if isinstance(v, Measured)}
    return tuple(name for name in model.structure.order if name not in excluded)
