"""Experiments in which everything that should not matter is changed together.

A declared graph says of each variable that, given its parents and its own noise, nothing else acts
on it. So all else may be changed together, by much, and it has to stay as it is. That one question
covers effects without an edge, effects that need two causes, thresholds and rare values. Asked of
what was before and has been put back, it finds memory that no state holds. What answers is found by
leaving out causes as long as the difference remains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping
from functools import partial
from typing import final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import EngineFailure, InterventionError, SeveralProblems
from scm_world.policies.planning import action_range
from scm_world.queries.experiments.effects import RESOLUTION, Effects, ProbeSetting, gap
from scm_world.queries.experiments.noise import shared_noise
from scm_world.queries.experiments.probes import Probe, ProbeGenerator, anywhere, drawn
from scm_world.variables import Measured, Noise, Rotations
from scm_world.world import Simulation

DRAWS = 3
"""How often all else gets other values, in each probe state."""

MOST_GROUPS = 6
"""For how many sets of parents, in each probe state."""

LATER = 3
"""For how many control steps memory is looked for, after everything has been put back."""

REMAINS = 1e-7
"""What putting back may leave, as a share of the value: engines round orientations."""

PLACES = 4
"""How many states are tried that both runs are put into."""

FAR = 0.75
"""How far, as a fraction, what has no ends is moved."""

GEOMETRY = "m", "rad"
"""Units of what decides whether bodies overlap; orientations do as well."""

BLAMED = 3
"""For how many variables, and how often of each, the causes of a difference are looked for."""

ATTEMPTS = 4
"""How often a request is tried, each time without what was refused."""

Differing = dict[str, tuple[int, float]]
"""Of each variable that differs: after how many control steps first, and by how much."""


@final
class JointExperiments:
    """Experiments with one world in which many variables are changed together.

    Args:
        world: It is restored to the probe before every experiment.
        seed: Of the values.
        effects: What is seen is noted there.
    """

    def __init__(self, world: Simulation, seed: int, effects: Effects) -> None:
        self._world, self._noise, self.effects = world, Noise(seed), effects
        model, deciding = world.model, frozenset(world.task.decided_by)
        self._targets = tuple(
            v.name
            for v in model.variables
            if v.settable and v.role != "action" and model.target(v.name) == v.name
            if not deciding or deciding.isdisjoint({v.name, *world.static_order((v.name,))})
        )
        self._geometry = {
            v.name for v in model.variables if v.unit in GEOMETRY or isinstance(v.bounds, Rotations)
        }
        self._actions, self._compiled = world.compiled.actions, world.compiled
        self._states = tuple(
            v.name for v in model.variables if isinstance(v, Measured) and v.mechanism is None
        )
        self._own = tuple(
            v.name
            for v in model.variables
            if getattr(v, "mechanism", None) is not None and getattr(v, "noise", None) is None
        )
        groups: dict[frozenset[str], list[str]] = {}
        for name in self._states:
            parents = {p.name for p in model.declared(name).all_parents}
            groups.setdefault(frozenset({*parents, name}), []).append(name)
        self._groups = list(groups.items())
        self._blamed: Counter[tuple[str, int]] = Counter()

    def run(self, number: int, probe: Probe) -> None:
        """Do all experiments of one probe state."""
        self._number, self._probe = number, probe
        world, rng = self._world, ProbeGenerator(self._noise, number)
        world.restore(probe.snapshot)
        self._first, self._earlier = world.values(), world.previous()
        world.step(probe.action)
        self._memory, self._later = world.previous(), world.values()
        self._see_repeated()
        turn = number * MOST_GROUPS
        groups = [
            self._groups[(turn + k) % len(self._groups)]
            for k in range(min(MOST_GROUPS, len(self._groups)))
        ]
        for draw in range(DRAWS):
            wish = self._wish(rng, draw)
            self._see(wish, wish, 0, self._alone)
            for parents, children in groups:
                context, base = self._context(wish, parents) if draw else ({}, self._later)
                self._see(
                    wish, wish.keys() - parents, 1, partial(self._step, children, context, base)
                )
        self._see_memory(self._wish(rng, DRAWS), rng)
        self._restored()
        world.step(probe.action)
        self._unlike(world.values(), self._later)
        if number == 0:
            self.effects.shared_noise |= shared_noise(
                world.graph, self._later, self._memory, partial(world.command, probe.action)
            )
        self.effects.end_of_probe()

    def _wish(self, rng: ProbeGenerator, draw: int) -> dict[str, Value]:
        """Draw another value of everything that can be set, the action too."""
        world, now = self._world, self._first
        self._restored()
        wish = {}
        for name in self._targets:
            if draw and name in self._geometry:  # what is refused costs time
                continue
            value = drawn(world.model.declared(name), now[name], now, rng, f"together {draw}", FAR)
            if value is not None and gap(value, now[name]) > 0.0:
                wish[name] = value
        low, high = action_range(world)
        action = low + rng.random(f"action {draw}", len(low)) * (high - low)
        return wish | {name: action[where] for name, where in self._actions.items()}

    def _restored(self) -> None:
        self._world.restore(self._probe.snapshot)

    def _act(self, changed: Mapping[str, Value]) -> Floats:
        """Give the action of the probe, with those actions that are changed."""
        action = np.array(self._probe.action)
        for name, where in self._actions.items():
            if name in changed:
                action[where] = changed[name]
        return action

    def _set(self, changed: Mapping[str, Value], kept: Container[str] = ()) -> None:
        """Set some variables, with what follows from them kept as it was.

        Raises:
            InterventionError: That is impossible.
        """
        self._restored()
        request = {name: v for name, v in changed.items() if name not in self._actions}
        if not request:
            return
        self._world.do(request)
        now = self._world.current()[0]
        self._world.evaluate(self._world.computed)
        held = {
            name: self._first[name]
            for name in self._targets
            if name not in request and name not in kept and gap(now[name], self._first[name]) > 0.0
        }
        if held:
            self._restored()
            self._world.do({**request, **held})

    def _see(
        self,
        wish: dict[str, Value],
        names: Container[str],
        lag: int,
        differing: Callable[[dict[str, Value]], Differing],
    ) -> None:
        """Change what a wish says of some variables; find and note the causes of what differs."""
        feasible = self._feasible(wish, names, differing)
        if feasible is None:
            return
        changed, found = feasible
        for effect in sorted(found, key=lambda name: -found[name][1])[:BLAMED]:
            if self._blamed[effect, lag] >= BLAMED:  # it is known by now
                continue
            self._blamed[effect, lag] += 1

            seen = [found[effect]]

            def differs(
                some: Iterable[str], effect: str = effect, seen: list[tuple[int, float]] = seen
            ) -> bool:
                try:
                    again = differing({name: changed[name] for name in some})
                except (InterventionError, EngineFailure):
                    return False
                if effect in again:
                    seen.append(again[effect])
                return effect in again

            causes = fewest(list(changed), differs)
            if differs(causes):
                values = {name: changed[name] for name in causes}
                self._note(values, effect, seen[-1][0] + lag, seen[-1][1])
            else:  # the same experiment gives something else
                self.effects.see_unstable(effect, seen[-1][1])

    def _note(self, causes: Mapping[str, Value], effect: str, lag: int, size: float) -> None:
        """Keep an effect of some values."""
        base = {name: self._probe.action[where] for name, where in self._actions.items()}
        moved = [np.ravel(v) - np.ravel(base.get(n, self._first[n])) for n, v in causes.items()]
        kind = f"{self._probe.kind}, together"
        self.effects.setting = ProbeSetting(self._number, kind, np.concatenate(moved))
        self.effects.see(" & ".join(causes), effect, lag, np.array(size), np.array(0.0))

    def _feasible(
        self,
        wish: dict[str, Value],
        names: Container[str],
        differing: Callable[[dict[str, Value]], Differing],
    ) -> tuple[dict[str, Value], Differing] | None:
        """Try a wish, and take what is refused out of it; None if too little is left.

        Where two bodies would overlap, one target is blamed, and it takes long to say which. So
        places and sizes are left out where leaving out one of them does not suffice.
        """
        changed = {name: value for name, value in wish.items() if name in names}
        for attempt in range(ATTEMPTS):
            try:
                return changed, differing(changed)
            except EngineFailure:
                return None
            except InterventionError as error:
                problems = error.problems if isinstance(error, SeveralProblems) else (error,)
                refused = {problem.variable for problem in problems}
                if attempt or not refused & changed.keys():
                    refused |= self._geometry
                for name in refused & changed.keys():
                    del changed[name], wish[name]
        return None

    # --- effects within the instant, and one step later ------------------------------------------

    def _context(
        self, wish: Mapping[str, Value], parents: Container[str]
    ) -> tuple[dict[str, Value], Values]:
        """Change the parents, too: some effects show under other circumstances only.

        Returns:
            Values of parents that are no states, and all values one step later.
        """
        context = {
            name: value
            for name, value in wish.items()
            if name in parents and name not in self._actions and name not in self._states
        }
        try:
            self._set(context)
            self._world.step(self._probe.action)
        except (InterventionError, EngineFailure):
            return {}, self._later
        return context, self._world.values()

    def _step(
        self,
        children: Iterable[str],
        context: Mapping[str, Value],
        base: Values,
        changed: Mapping[str, Value],
    ) -> Differing:
        """Take a control step with changes; tell which children differ from those without."""
        self._set({**context, **changed})
        if self._world.compiled is not self._compiled:
            return {}
        self._world.step(self._act(changed))
        self.effects.rollouts += 1
        now = self._world.current()[0]
        least = 0.0 if self.effects.exact else RESOLUTION
        sizes = {name: gap(now[name], base[name]) for name in children}
        return {name: (0, size) for name, size in sizes.items() if size > least}

    def _alone(self, changed: dict[str, Value]) -> Differing:
        """Evaluate every mechanism with its parents as they were, in a world that is changed.

        What differs reads something else than its parents.
        """
        self._set(changed, kept=self._targets)
        if self._world.compiled is not self._compiled:
            return {}
        sizes = self._evaluated(self._instants[0])
        self._world.step(self._act(changed))
        self.effects.rollouts += 1
        later = self._evaluated(self._instants[1])
        found = {name: (1, size) for name, size in later.items() if size > RESOLUTION}
        return found | {name: (0, size) for name, size in sizes.items() if size > RESOLUTION}

    def _evaluated(self, instant: tuple[Values, Values, Values]) -> dict[str, float]:
        """Evaluate each mechanism by itself, last ones first; tell how far it is from before."""
        solve, (known, previous, solved) = self._world.model.solve, instant
        return {
            name: gap(solve(known, previous=previous, only=(name,))[name], solved[name])
            for name in reversed(self._own)
        }

    def _see_repeated(self) -> None:
        """Evaluate each mechanism twice: the same has to come out, and what the world has."""
        model, world = self._world.model, self._world
        instants = ((self._first, self._earlier), (self._later, self._memory))
        self._instants = []
        for known, previous in instants:
            solved = {
                name: model.solve(known, previous=previous, only=(name,))[name]
                for name in self._own
            }
            self._instants.append((known, previous, solved))
            for name, size in self._evaluated(self._instants[-1]).items():
                self.effects.see_unstable(name, size)
            self._unlike({name: known[name] for name in world.computed}, solved, RESOLUTION)

    def _unlike(self, now: Values, before: Values, least: float = 0.0) -> None:
        """Note what is not as it was though everything was the same."""
        for name, value in now.items():
            size = gap(value, before[name])
            if size > least:
                self.effects.see_unstable(name, size)

    # --- memory ----------------------------------------------------------------------------------

    def _see_memory(self, wish: dict[str, Value], rng: ProbeGenerator) -> None:
        """Change everything for a step, put both runs into one state, and let them go on."""
        low, high = action_range(self._world)
        shares = rng.random("memory", LATER * len(low)).reshape(LATER, -1)
        actions = [low + share * (high - low) for share in shares]
        parameters = {n: self._first[n] for n in self._targets if n not in self._states}
        for place in range(PLACES):
            base: list[dict[str, Value]] | None = None
            self._restored()
            states, _ = anywhere(self._world, ProbeGenerator(self._noise, self._number, place))
            try:
                base = self._afterwards({}, states, parameters, actions)
            except (InterventionError, EngineFailure):
                continue
            break
        if base is None:
            return
        told = base

        def differing(changed: dict[str, Value]) -> Differing:
            runs = self._afterwards(changed, states, parameters, actions)
            return self._differing_from(told, runs)

        self._see(wish, wish, 2, differing)

    def _afterwards(
        self,
        changed: Mapping[str, Value],
        states: Mapping[str, Value],
        parameters: Mapping[str, Value],
        actions: Iterable[Floats],
    ) -> list[dict[str, Value]]:
        """Take a step with changes, put parameters back and states elsewhere, and go on."""
        world = self._world
        self._set(changed, kept=self._targets)
        world.step(self._act(changed))
        now = world.values()
        back = {n: v for n, v in parameters.items() if gap(now[n], v) > 0.0}
        clock = {name: self._later[name] for name in ("control_index",) if name in self._targets}
        world.do({**back, **states, **clock})
        found = [world.values()]
        for action in actions:
            world.step(action)
            self.effects.rollouts += 1
            found.append(world.values())
        return found

    def _differing_from(
        self, base: list[dict[str, Value]], runs: list[dict[str, Value]]
    ) -> Differing:
        """Tell what differs first, beyond what declared variables remember that cannot be set."""
        if base[0].keys() != runs[0].keys():
            return {}
        lagged, instant = set[str](), self._world.model
        may = {name for name in base[0] if gap(runs[0][name], base[0][name]) > 0.0}
        found: Differing = {}
        for after in range(1, len(base)):
            lagged = {
                e.effect
                for e in instant.edges
                if e.lag and e.cause in may
                # states follow from the action that is taken next; rewards know the last one, too
                if e.cause not in self._actions or e.effect in self._world.computed
            }
            may = lagged.union(*(instant.structure.instant_descendants((n,)) for n in lagged))
            for name in base[0].keys() - may - found.keys():
                value, other = base[after][name], runs[after][name]
                least = REMAINS * (1.0 + float(np.max(np.abs(value), initial=0.0)))
                if gap(other, value) > least:
                    found[name] = (after - 1, gap(other, value))
            if found:
                break
        return found


def fewest(names: list[str], differs: Callable[[list[str]], bool]) -> list[str]:
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
