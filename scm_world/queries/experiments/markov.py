"""The Markov test: with its parents held, nothing else changes a variable.

By the graph, a variable depends on its parents and its own noise only. So everything else may be
changed together, by large amounts, and the variable must stay bit-identical. This test covers
undeclared effects, effects that need two causes, thresholds and rare values. It covers memory, too:
in some runs everything is restored after a control step, and a later difference of a variable whose
parents do not differ shows memory outside of the variables. Mechanisms are also evaluated with
unchanged parents, to find those that read other values. The causes of a difference are found by
bisection: names are left out as long as the difference remains.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import EngineFailure, InterventionError, ModelError
from scm_world.policies.planning import action_range
from scm_world.queries.experiments.effects import Effects, gap
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import Random, without_refused
from scm_world.queries.local import contacts_of
from scm_world.variables import Rotations

DRAWS = 5  # number of changes of everything else, in each probe state
MOST_GROUPS = 4  # number of sets of parents that are tested with each of these changes
LATER = 3  # control steps in the search for memory, after everything is restored
NEAR = 0.01  # fraction by which geometry is moved to another value, so that bodies do not overlap
GEOMETRY = "m", "rad"  # units of variables that determine overlaps, besides orientations
BLAMED = 6  # number of differing variables whose causes are searched

Changed = dict[str, Value]
"""Changed variables with their new values."""

Effect = tuple[str, int]
"""A variable, and the number of control steps after the change."""


class Run(NamedTuple):
    """A run after a change."""

    request: Changed  # the change, and the held values
    values: list[Values]  # before and after a control step, after restoring everything, and later
    solved: dict[Effect, Value]  # of each mechanism, with its parents as in the probe state


@final
class Markov:
    """The Markov test of one world."""

    def __init__(self, paired: Paired) -> None:
        self._paired, self._world, model = paired, paired.world, paired.model
        self._compiled, deciding = self._world.compiled, frozenset(self._world.task.decided_by)
        self._targets = tuple(
            name
            for name in paired.targets
            if not deciding or deciding.isdisjoint({name, *self._compiled.static_order((name,))})
        )
        self._geometry = {
            v.name for v in model.variables if v.unit in GEOMETRY or isinstance(v.bounds, Rotations)
        }
        self._parents = {
            name: tuple(p for p in model.declared(name).all_parents if p.lag)
            for name in paired.states
        }
        self._mechanisms = tuple(
            v.name for v in model.variables if v.equation is not None and v.own_noise is None
        )
        self._known: dict[Effect, set[str]] = {}

    def run(self, effects: Effects) -> None:
        """Run all experiments in the present probe state, and record their effects."""
        self._effects, number = effects, self._paired.setting.probe
        rng = np.random.default_rng((self._paired.seed, number, 1))
        actions = rng.uniform(*action_range(self._world), (LATER, self._compiled.n_actions))
        for draw in range(DRAWS):
            context = self._other_values(rng, actions=False) if draw else {}
            base = self._base(context, None if draw else actions)
            groups = self._groups(base.request)
            changed = self._other_values(rng, geometry=draw == 0)
            for turn in range(min(MOST_GROUPS, len(groups))):
                parents, children = groups[(number + draw * MOST_GROUPS + turn) % len(groups)]
                some = {name: value for name, value in changed.items() if name not in parents}
                self._see(some, partial(self._differing, base, parents, children, None))
            if draw == 0:  # setting all parameters could hide that one overwrites another
                later = actions if len(base.values) > 2 else actions[:0]
                chosen = {name for name in changed if rng.random() < 0.5}
                for half in (chosen, changed.keys() - chosen):
                    some = {name: value for name, value in changed.items() if name in half}
                    self._see(some, partial(self._differing, base, (), [], later))

    def _groups(self, context: Changed) -> list[tuple[Collection[str], list[str]]]:
        """Group the states by their parents; parents by contact act only during contacts."""
        groups: dict[frozenset[str], list[str]] = {}
        held, touching = {*self._targets, *self._paired.actions}, self._touches(context)
        for name, parents in self._parents.items():
            here = {p.name for p in parents if p.when != "contact" or touching}
            groups.setdefault(frozenset(here & held), []).append(name)
        return list(groups.items())

    def _touches(self, changed: Changed) -> bool:
        """Return whether bodies touch in a physics step of the next control step."""
        action = self._paired.at(changed)
        try:
            return any(contacts_of(self._world, action))
        except (ModelError, EngineFailure):  # contacts are not all known
            return True

    def _other_values(
        self, rng: Random, *, geometry: bool = False, actions: bool = True
    ) -> Changed:
        """Draw other values; with ``geometry``, small changes that keep bodies apart."""
        paired, found = self._paired, Changed()
        little = {*self._geometry, *paired.states} if geometry else set[str]()
        for name in (*self._targets, *(paired.actions if actions else ())):
            if geometry or name not in self._geometry:
                value = paired.other(name, paired.first, rng, NEAR if name in little else 1.0)
                if value is not None and gap(value, paired.first[name]) > 0.0:
                    found[name] = value
        return found

    def _base(self, context: Changed, later: Floats | None) -> Run:
        """Run in another context, for fewer steps or in the present one if that is infeasible."""
        shorter = None if later is None else later[:0]
        for request, further in ((context, later), (context, shorter)):
            try:
                return self._run(request, {}, further)
            except (InterventionError, EngineFailure):
                continue
        return self._run({}, {}, shorter)

    def _run(
        self, request: Changed, held: Values, later: Floats | None, back: Values | None = None
    ) -> Run:
        """Take a control step after a change, restore all, and continue; evaluate mechanisms."""
        paired, world, solved = self._paired, self._world, dict[Effect, Value]()
        action = paired.at(request)
        if moved := paired.moved(held, held):  # effects of the change on held variables
            request = request | {name: held[name] for name in moved}
            action = paired.at(request)
        values = [world.values()]
        for lag in (0, 1):
            for name in self._mechanisms if later is not None else ():
                solved[name, lag] = paired.evaluated(name, paired.here)
            if lag == 0:
                world.step(action)
        values.append(world.values())
        self._effects.rollouts += 1
        if later is not None and len(later):
            back = values[0] if back is None else back
            other = (name for name in self._targets if gap(values[1][name], back[name]) > 0.0)
            world.do({name: back[name] for name in other})
            values.append(world.values())
        for action in () if later is None else later:
            world.step(action)
            self._effects.rollouts += 1
            values.append(world.values())
        return Run(request, values, solved)

    def _differing(
        self,
        base: Run,
        parents: Collection[str],
        children: list[str],
        later: Floats | None,
        changed: Changed,
    ) -> dict[Effect, float]:
        """Return the differences of variables with equal parents, when others are changed."""
        before, acts = base.values[0], self._paired.actions
        held = {name: before[name] for name in parents if name not in acts}
        run = self._run({**base.request, **changed}, held, later, before)
        if self._world.compiled is not self._compiled:
            return {}
        size = self._effects.undeclared
        found = {key: size(key[0], value, base.solved[key]) for key, value in run.solved.items()}
        now = {name: size(name, run.values[1][name], base.values[1][name]) for name in children}
        if any(now.values()) and self._touches(run.request):  # new contacts add parents
            for name in children:
                if any(p.when == "contact" and p.name in changed for p in self._parents[name]):
                    del now[name]
        found |= {(name, 1): apart for name, apart in now.items()}
        last = 0 if self._world.task.noise_floors else len(run.values) - 1  # solvers with a memory
        for lag in range(2, last):
            for name, causes in self._parents.items():
                same = (p.name for p in causes if p.name not in acts)
                if all(gap(run.values[lag][p], base.values[lag][p]) == 0.0 for p in same):
                    ends = run.values[lag + 1][name], base.values[lag + 1][name]
                    found[name, lag] = size(name, *ends)
        return {key: apart for key, apart in found.items() if apart > 0.0}

    def _see(self, changed: Changed, differing: Callable[[Changed], dict[Effect, float]]) -> None:
        """Find and record the causes of differences when everything is changed."""
        found = without_refused(changed, differing, self._geometry) or {}
        for effect in sorted(found, key=lambda one: -found[one])[:BLAMED]:

            def size(names: Collection[str], effect: Effect = effect) -> float:
                try:
                    return differing({name: changed[name] for name in names}).get(effect, 0.0)
                except (InterventionError, EngineFailure):
                    return 0.0

            known = self._known.setdefault(effect, set())
            if size([]) or not size(changed):  # it differs by itself
                self._effects.see_unstable(effect[0], found[effect])
                continue
            new = [name for name in changed if name not in known]
            if not new or not size(new):
                continue
            causes = fewest(new, size)
            known.update(causes)
            first, setting = self._paired.first, self._paired.setting
            change = np.concatenate([np.ravel(changed[n]) - np.ravel(first[n]) for n in causes])
            setting = setting._replace(kind=f"{setting.kind}, together", change=change)
            self._effects.violations[" & ".join(causes), *effect] = size(causes), setting


def fewest(names: list[str], differs: Callable[[list[str]], object]) -> list[str]:
    """Return a minimal subset of names that still makes a difference.

    Example:
        >>> fewest(list("abcdefgh"), lambda names: {"b", "g"} <= set(names))
        ['b', 'g']
    """
    size = len(names)
    while size := size // 2:
        start = 0
        while start < len(names) and len(names) > 1:
            fewer = names[:start] + names[start + size :]
            if fewer and differs(fewer):
                names = fewer
            else:
                start += size
    return names
