"""The Markov test: with its parents held, nothing else changes a variable.

A graph says of each variable that, given its parents and its own noise, nothing else acts on it. So
all else may be changed together, by much, and the variable has to stay as it is, bit for bit. That
one question covers effects without an edge, effects that need two causes, thresholds and rare
values. It covers memory, too: in some runs everything is put back after a control step, and what
differs later though its parents do not is remembered by something that is no variable. And a
mechanism is handed its parents as they were: what differs then is read past them. What answers is
found by halving: causes are left out as long as the difference remains.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple, final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import EngineFailure, InterventionError, ModelError
from scm_world.policies.planning import action_range
from scm_world.queries.experiments.effects import RESOLUTION, Effects, gap
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import Random, without_refused
from scm_world.queries.local import contacts_of
from scm_world.variables import Rotations

DRAWS = 5  # how often all else gets other values, in each probe state
MOST_GROUPS = 4  # for how many sets of parents, in each of these draws
LATER = 3  # for how many control steps memory is looked for, after everything has been put back
NEAR = 0.01  # how far towards another value geometry is moved: else bodies would overlap
GEOMETRY = "m", "rad"  # units of what decides whether bodies overlap; orientations do as well
BLAMED = 6  # of how many variables the causes of a difference are looked for

Changed = dict[str, Value]
"""Variables that get other values."""

Effect = tuple[str, int]
"""A variable, and the number of control steps after the change."""


class Run(NamedTuple):
    """What a change is followed by.

    Attributes:
        request: The change, and what was held.
        values: Before and after a control step, after everything was put back, and later.
        solved: Of each mechanism, with its parents as they are in the probe state.
    """

    request: Changed
    values: list[Values]
    solved: dict[Effect, Value]


@final
class Markov:
    """The test of one world, whose backend decides some of its variables."""

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
            v.name
            for v in model.variables
            if getattr(v, "mechanism", None) is not None and getattr(v, "noise", None) is None
        )
        self._known: dict[Effect, set[str]] = {}

    def run(self, effects: Effects) -> None:
        """Do all experiments in the present probe state, and note what is seen."""
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
            if draw == 0:  # writing all parameters anew could hide that one writes another one
                later = actions if len(base.values) > 2 else actions[:0]
                chosen = {name for name in changed if rng.random() < 0.5}
                for half in (chosen, changed.keys() - chosen):
                    some = {name: value for name, value in changed.items() if name in half}
                    self._see(some, partial(self._differing, base, (), [], later))

    def _groups(self, context: Changed) -> list[tuple[Collection[str], list[str]]]:
        """Group the states by their parents; those by contact act only where something touches."""
        groups: dict[frozenset[str], list[str]] = {}
        held, touching = {*self._targets, *self._paired.actions}, self._touches(context)
        for name, parents in self._parents.items():
            here = {p.name for p in parents if p.when != "contact" or touching}
            groups.setdefault(frozenset(here & held), []).append(name)
        return list(groups.items())

    def _touches(self, changed: Changed) -> bool:
        """Check whether any two bodies touch in a physics step of the coming control step."""
        action = self._paired.at(changed)
        try:
            return any(contacts_of(self._world, action))
        except (ModelError, EngineFailure):  # contacts are not all known
            return True

    def _other_values(
        self, rng: Random, *, geometry: bool = False, actions: bool = True
    ) -> Changed:
        """Draw another value of everything that can be set, the action too.

        Of what decides where bodies are, most draws are refused, which takes long. With
        ``geometry``, this is moved a little, and so are velocities: more would make bodies touch.
        """
        paired, found = self._paired, Changed()
        little = {*self._geometry, *paired.states} if geometry else set[str]()
        for name in (*self._targets, *(paired.actions if actions else ())):
            if geometry or name not in self._geometry:
                value = paired.other(name, paired.first, rng, NEAR if name in little else 1.0)
                if value is not None and gap(value, paired.first[name]) > 0.0:
                    found[name] = value
        return found

    def _base(self, context: Changed, later: Floats | None) -> Run:
        """Run in other circumstances, in which some effects show only, and in present ones if not.

        Where bodies that press on each other could not be put back, it does not go on.
        """
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
        """Take a control step after a change, put all back, and go on; ask mechanisms, too."""
        paired, world, solved = self._paired, self._world, dict[Effect, Value]()
        action = paired.at(request)
        gaps = paired.gaps(held, held)
        if any(gaps.values()):  # follows from what was changed
            request = request | {name: held[name] for name, size in gaps.items() if size > 0.0}
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
            moved = (name for name in self._targets if gap(values[1][name], back[name]) > 0.0)
            world.do({name: back[name] for name in moved})
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
        """Compute by how much variables differ whose parents do not when others are changed."""
        before, acts = base.values[0], self._paired.actions
        held = {name: before[name] for name in parents if name not in acts}
        run = self._run({**base.request, **changed}, held, later, before)
        if self._world.compiled is not self._compiled:
            return {}
        found = {key: gap(value, base.solved[key]) for key, value in run.solved.items()}
        now = {name: gap(run.values[1][name], base.values[1][name]) for name in children}
        if any(now.values()) and self._touches(run.request):  # what did not touch may act now
            for name in children:
                if any(p.when == "contact" and p.name in changed for p in self._parents[name]):
                    del now[name]
        found |= {(name, 1): size for name, size in now.items()}
        for lag in range(2, len(run.values) - 1):
            for name, causes in self._parents.items():
                same = (p.name for p in causes if p.name not in acts)
                if all(gap(run.values[lag][p], base.values[lag][p]) == 0.0 for p in same):
                    found[name, lag] = gap(run.values[lag + 1][name], base.values[lag + 1][name])
        least = 0.0 if self._paired.exact else RESOLUTION
        return {key: size for key, size in found.items() if size > least}

    def _see(self, changed: Changed, differing: Callable[[Changed], dict[Effect, float]]) -> None:
        """Find and note the causes of what differs when everything is changed."""
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
    """Leave out names as long as something still differs; no further one can be left out then.

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
