"""Draws of an intervention that bodies rule out, found without planning each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._types import Integers, Value
from scm_world.graph import NoiseKey
from scm_world.models import ParameterKey, Scene
from scm_world.models.scene import SURFACES, Overlap
from scm_world.variables import Draw, Hard, Natural, Rotations, Variable, whole_of
from scm_world.variables.noise import word_of
from scm_world.world.compiled_task import Plan, StepBase
from scm_world.world.philox import philox
from scm_world.world.plan import InterventionPlan
from scm_world.world.solver import Solver, same

ROUNDING = 1e-6
"""How much deeper than before is no deeper [m]."""
FIRST, CHUNK = 8, 64
"""How many draws are looked at together: at first, and later."""


class Unknown(Exception):  # no error: such draws are planned one after another
    """The result of a draw is unknown before it is planned."""


@final
class Candidates:
    """Values of variables in several draws of one intervention, computed when they are asked for.

    The first axis of a value is that of the draws; it has length 1 where all have the same value.

    Args:
        solver: Of an earlier draw.
        key: Where to draw.
        attempts: Numbers of the draws, shape (n,).
    """

    def __init__(self, solver: Solver, key: NoiseKey, attempts: Integers) -> None:
        self.attempts = attempts
        self._solver, self._key, self._task = solver, key, solver.base.compiled
        self._known = solver.same_at(key)
        self._carried = {variable.name: variable for variable in self._task.carried}
        self._keys = {key: name for name, key in self._task.parameter_keys.items()}
        self._found: dict[str, Value] = {}
        self._varying: set[str] = set()

    def keep(self, which: Value) -> None:
        """Leave out draws; ``which`` tells of each whether it stays, shape (n,)."""
        self.attempts = self.attempts[which]
        for name in self._varying:
            self._found[name] = self._found[name][which]

    def parameter(self, key: ParameterKey) -> Value:
        """Compute a physical parameter, shape (n or 1, *shape); it must be a variable."""
        return self._value(self._keys[key])

    def state(self, where: slice) -> Value:
        """Compute some numbers of the state vector, shape (n or 1, size)."""
        bundles, parts = self._task.bundles, []
        for name, own in self._task.slices.items():
            if where.start <= own.start and own.stop <= where.stop and name not in bundles:
                value = self._value(name)
                parts.append(value.reshape(len(value), -1))
        n = max(map(len, parts))
        return np.hstack([np.broadcast_to(part, (n, part.shape[1])) for part in parts])

    def scenes(self) -> Iterator[Scene]:
        """Yield the scene of each draw, as far as it says where surfaces are."""
        task, scene = self._task, self._task.describe(self._solver.static, self._solver.state)
        keys = {name: key for key, name in self._keys.items() if key[1] in SURFACES}
        names = (*keys, *(name for name in task.places if name not in task.bundles))
        values = {name: self._value(name) for name in names}
        varying = self._varying.intersection(values)
        vector, parameters = scene.state.vector.copy(), {**scene.parameters}
        for row in range(len(self.attempts)):
            for name in varying if row else values:
                value = values[name][row if name in varying else 0]
                if name in keys:
                    parameters[keys[name]] = value
                else:
                    vector[task.places[name]] = value.ravel()
            yield Scene(scene.structure, parameters, scene.state.with_vector(vector))

    def _value(self, name: str) -> Value:
        if name not in self._found:
            is_state = name in self._task.slices
            value, varies = self._state(name) if is_state else self._static(name)
            self._found[name] = value
            self._varying |= {name} if varies else set()
        return self._found[name]

    def _static(self, name: str) -> tuple[Value, bool]:
        """Give the values of a parameter, and whether they differ."""
        solver = self._solver
        if name in self._known or name not in solver.order:
            return np.asarray(solver.static[name])[None], False
        asked, act = solver.acts.get(name, (name, None))
        if isinstance(act, Draw):
            if whole_of(act, asked) != name:
                raise Unknown
            return self._drawn(self._task.model.declared(name), act), True
        model, declared = solver.model, self._task.model.declared
        parents = model.structure.parents(name)
        shape = declared(name).shape
        values = [*map(self._value, parents)]

        def computed(*given: Value) -> Value:
            return model.evaluate(name, dict(zip(parents, given, strict=True)), self._key)

        varies = not self._varying.isdisjoint(parents)
        return self._rows(computed, values, shape, varies=varies), varies

    def _state(self, name: str) -> tuple[Value, bool]:
        """Give the values of a state, and whether they differ."""
        solver, declared = self._solver, self._task.model.declared
        asked, act = solver.acts.get(name, (name, None))
        if act is None and name in self._carried:
            return self._moved(name)
        if act is None or isinstance(act, Hard | Natural):
            return self._as_planned(name), False
        if not isinstance(act, Draw):
            raise Unknown
        whole: Any = declared(whole_of(act, asked))
        value = self._drawn(whole, act)
        if whole.name != asked:
            value = whole.mechanism.split(value)[whole.parts.index(asked)]
        elif asked != name:
            value = self._rows(whole.inverse.bind(), [value], declared(name).shape, varies=True)
        bounds = declared(name).bounds
        return np.asarray(bounds.nearest(value) if isinstance(bounds, Rotations) else value), True

    def _moved(self, name: str) -> tuple[Value, bool]:
        """Carry a state along with what acts on it when set, as the solver does."""
        solver, parents = self._solver, self._task.set_parents[name]
        new = [*map(self._value, parents)]
        if self._varying.isdisjoint(parents):
            return self._as_planned(name), False
        variable, old = self._carried[name], [solver.before(parent) for parent in parents]
        present = self._task.view(name, solver.base.state)
        if name in solver.base.fresh:
            if variable.start is None:
                return present[None], False
            return self._rows(variable.start.bind(), new, present.shape, varies=True), True

        def moved(*given: Value) -> Value:
            both = zip(parents, old, given, strict=True)
            which = {parent for parent, a, b in both if not same(a, b)}
            again = solver.base.at_start or not which.isdisjoint(variable.restart)
            return solver.moved(variable, old, [*given], again=again) if which else present

        return self._rows(moved, new, present.shape, varies=True), True

    def _as_planned(self, name: str) -> Value:
        """Give a state that no draw moves."""
        return self._task.view(name, self._solver.state)[None]

    def _drawn(self, variable: Variable, act: Draw) -> Value:
        source: Any = variable.space(act.source) if isinstance(act.source, str) else act.source
        parents = source.parents()
        if not parents.isdisjoint(self._task.slices):
            raise Unknown
        values = {parent: self._value(parent) for parent in parents}
        own = variable.name if act.stream is None else f"{act.stream}/{variable.name}"
        kept = variable.name in self._key.kept
        numbers = self.attempts.tolist()
        keys = [word_of(f"{own}#{n}" if n and not kept else own) for n in numbers]
        uniforms = np.empty((len(keys), source.n_uniforms(variable.shape)))
        where = np.array([self._key.noise.key, self._key.episode, self._key.step], dtype=np.uint64)
        philox(where, np.array(keys, dtype=np.uint64), uniforms)
        drawn: Value = source.transform(uniforms, variable.shape, values)
        return drawn

    def _rows(
        self,
        function: Callable[..., Any],
        values: list[Value],
        shape: tuple[int, ...],
        *,
        varies: bool,
    ) -> Value:
        """Compute a function for each draw; functions of users need not take many together."""
        found = np.empty((len(self.attempts) if varies else 1, *shape))
        for i in range(len(found)):
            found[i] = function(*(value[i if len(value) > 1 else 0] for value in values))
        return found


def overlaps_before(base: StepBase) -> tuple[Overlap, ...]:
    """List what lies in one another as physics left it, however little."""
    scene = base.compiled.describe(base.static, base.state)
    return base.compiled.composition.overlaps(scene, 0.0)


def deeper(found: Iterable[Overlap], before: Iterable[Overlap]) -> list[Overlap]:
    """List those that are deeper than before."""
    depths = {overlap.bodies: overlap.depth for overlap in before}
    return [one for one in found if one.depth > depths.get(one.bodies, 0.0) + ROUNDING]


def promising(
    base: StepBase,
    made: Mapping[Plan | None, InterventionPlan],
    structure: Callable[[NoiseKey], Plan | None] | None,
    key: NoiseKey,
    draws: range,
) -> Iterator[tuple[int, Plan | None]]:
    """Yield the further draws that may be feasible, and the last one.

    A draw that is left out puts two bodies in one place. Where that is unknown, it is yielded.

    Args:
        base: The world as physics left it.
        made: Plans of earlier draws by their structure, one at least. Where it is drawn which
            bodies there are, a structure is looked at from the draw on after which it is in here.
        structure: Gives the structure of a draw, or None where that is refused; None where all
            draws have the same.
        key: Where to draw.
        draws: Their numbers.

    Yields:
        The number of a draw, and its structure.
    """
    before = overlaps_before(base)
    here, plan = next(iter(made.items()))
    # What is asked of a body is refused where the body is not there.
    asked = {name.partition(".")[0] for name in (*plan.asked, *plan.removals)}
    alike_everywhere = asked.isdisjoint(plan.compiled.entity_names)
    left = list(draws[:-1])
    while left:
        size = FIRST if left[0] == draws[0] else CHUNK
        attempts, left = left[:size], left[size:]
        if structure is None:
            places: dict[int, Plan | None] = dict.fromkeys(attempts, here)
        else:
            if alike_everywhere:
                attempts = _thinned(plan, before, key, attempts, whole=False)
            places = {attempt: structure(replace(key, attempt=attempt)) for attempt in attempts}
        thinned: dict[Plan | None, frozenset[int]] = {}
        for attempt, where in places.items():
            if where in made and where not in thinned:
                alike = [a for a, other in places.items() if other == where and a >= attempt]
                thinned[where] = frozenset(_thinned(made[where], before, key, alike))
            if where not in thinned or attempt in thinned[where]:
                yield attempt, where
    if draws:
        yield draws[-1], None


def _thinned(
    plan: InterventionPlan,
    before: Iterable[Overlap],
    key: NoiseKey,
    attempts: list[int],
    *,
    whole: bool = True,
) -> list[int]:
    """List the draws that may be feasible.

    Args:
        plan: Of an earlier draw.
        before: The bodies that lie in one another already.
        key: Where to draw.
        attempts: Numbers of draws.
        whole: Whether all of them have the bodies of the plan.
    """
    if plan.solver is None:
        return attempts
    enough = max((overlap.depth for overlap in before), default=0.0) + ROUNDING
    composition = plan.compiled.composition
    candidates = Candidates(plan.solver, replace(key, attempt=1), np.array(attempts))
    try:
        with np.errstate(all="ignore"):
            composition.thin(candidates, enough)
            if whole and len(candidates.attempts):
                scenes = candidates.scenes()
                found = (composition.overlaps(scene, None, plan.asked, enough) for scene in scenes)
                candidates.keep(np.array([not deeper(overlaps, before) for overlaps in found]))
    except Exception:  # planning says what is wrong
        return attempts
    left: list[int] = candidates.attempts.tolist()
    return left
