"""The Markov test: with its parents held, nothing else changes a variable.

A graph says of each variable that, given its parents and its own noise, nothing else acts on it. So
all else may be changed together, by much, and the variable has to stay as it is, bit for bit. That
one question covers effects without an edge, effects that need two causes, thresholds and rare
values, and memory that no variable holds. What answers is found by halving: causes are left out as
long as the difference remains.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import final

import numpy as np

from scm_world._types import Floats, Value, Values
from scm_world.errors import EngineFailure, InterventionError, ModelError, SeveralProblems
from scm_world.policies.planning import action_range
from scm_world.queries.experiments.effects import RESOLUTION, Effects, ProbeSetting, gap
from scm_world.queries.experiments.paired import another, engine_decided, settable
from scm_world.queries.experiments.probes import Probe, ProbeGenerator, anywhere
from scm_world.queries.local import contacts_of
from scm_world.variables import Noise, Rotations
from scm_world.world import Simulation

DRAWS = 5
"""How often all else gets other values, in each probe state."""

MOST_GROUPS = 4
"""For how many sets of parents, in each of these draws."""

LATER = 3
"""For how many control steps memory is looked for, after everything has been put back."""

PLACES = 4
"""How many states are tried that both runs are put into."""

NEAR = 0.01
"""How far towards another value of its spaces geometry is moved: else bodies would overlap."""

GEOMETRY = "m", "rad"
"""Units of what decides whether bodies overlap; orientations do as well."""

BLAMED = 6
"""For how many variables, and how often of each, the causes of a difference are looked for."""

ATTEMPTS = 4
"""How often a request is tried, each time without what was refused."""

Differing = dict[tuple[str, int], float]
"""By how much each variable differs, by name and number of control steps after the change."""


@final
class Markov:
    """The test of one world, whose backend decides some of its variables.

    Args:
        world: It is restored to the probe state before every experiment.
        seed: Of the values that variables are given.
    """

    def __init__(self, world: Simulation, seed: int) -> None:
        self._world, self._noise = world, Noise(seed)
        model, deciding = world.model, frozenset(world.task.decided_by)
        self._targets = tuple(
            name
            for name in settable(model)
            if not deciding or deciding.isdisjoint({name, *world.compiled.static_order((name,))})
        )
        self._geometry = {
            v.name for v in model.variables if v.unit in GEOMETRY or isinstance(v.bounds, Rotations)
        }
        self._actions, self._compiled = world.compiled.actions, world.compiled
        self._states = engine_decided(model)
        self._alone = tuple(
            v.name
            for v in model.variables
            if getattr(v, "mechanism", None) is not None and getattr(v, "noise", None) is None
        )
        self._parents = {
            name: tuple(p for p in model.declared(name).all_parents if p.lag)
            for name in self._states
        }
        self._least = 0.0 if world.task.generated_graph else RESOLUTION
        self._blamed: Counter[tuple[str, int]] = Counter()

    def run(self, number: int, probe: Probe, effects: Effects) -> None:
        """Do all experiments of one probe state, and note what is seen."""
        self._number, self._probe, self.effects = number, probe, effects
        world, rng = self._world, ProbeGenerator(self._noise, number)
        world.restore(probe.snapshot)
        self._first, self._earlier = world.values(), world.previous()
        for draw in range(DRAWS):
            context = self._wish(rng, f"context {draw}", actions=False) if draw else {}
            base = self._held(context)
            groups = self._groups(context)
            wish = self._wish(rng, f"together {draw}", geometry=draw == 0)
            for turn in range(min(MOST_GROUPS, len(groups))):
                parents, children = groups[(number + draw * MOST_GROUPS + turn) % len(groups)]
                changed = {name: v for name, v in wish.items() if name not in parents}
                self._see(changed, partial(self._now, context, base, parents, children))
        self._see_memory(rng)

    # --- the pieces -------------------------------------------------------------------------------

    def _groups(self, context: Mapping[str, Value]) -> list[tuple[Collection[str], list[str]]]:
        """Group the states by their parents; those by contact act only where something touches."""
        groups: dict[frozenset[str], list[str]] = {}
        held, touching = {*self._targets, *self._actions}, self._touches(context)
        for name, parents in self._parents.items():
            here = {p.name for p in parents if p.when != "contact" or touching}
            groups.setdefault(frozenset(here & held), []).append(name)
        return list(groups.items())

    def _touches(self, request: Mapping[str, Value]) -> bool:
        """Check whether any two bodies touch in a physics step of the coming control step."""
        action = self._set(request)
        try:
            return any(contacts_of(self._world, action))
        except ModelError:  # contacts are not all known
            return True

    def _wish(
        self, rng: ProbeGenerator, stream: str, *, geometry: bool = False, actions: bool = True
    ) -> dict[str, Value]:
        """Draw another value of everything that can be set, the action too.

        Of what decides where bodies are, most draws are refused, which takes long. With
        ``geometry``, this is moved a little, and so are velocities: more would make bodies touch.
        """
        model, now, wish = self._world.model, self._first, dict[str, Value]()
        for name in self._targets:
            if geometry or name not in self._geometry:
                little = name in self._geometry or (geometry and name in self._states)
                scale = NEAR if little else 1.0
                value = another(model, name, now, rng, stream, scale)
                if value is not None and gap(value, now[name]) > 0.0:
                    wish[name] = value
        low, high = action_range(self._world)
        action = low + rng.random(f"action {stream}", len(low)) * (high - low)
        return wish | {name: action[where] for name, where in self._actions.items() if actions}

    def _set(self, changed: Mapping[str, Value]) -> Floats:
        """Go to the probe state and change some variables; return the action, changed likewise.

        Raises:
            InterventionError: That is impossible.
        """
        self._world.restore(self._probe.snapshot)
        request = {name: value for name, value in changed.items() if name not in self._actions}
        if request:
            self._world.do(request)
        action = np.array(self._probe.action)
        for name in self._actions.keys() & changed.keys():
            action[self._actions[name]] = changed[name]
        return action

    def _held(self, context: dict[str, Value]) -> tuple[Values, Values]:
        """Take a control step under other circumstances, in which some effects show only.

        Returns:
            All values before and after it. Where the circumstances are refused, they are cleared.
        """
        try:
            action = self._set(context)
            before = self._world.values()
            self._world.step(action)
        except (InterventionError, EngineFailure):
            context.clear()
            return self._held(context)
        return before, self._world.values()

    def _now(
        self,
        context: Mapping[str, Value],
        base: tuple[Values, Values],
        parents: Collection[str],
        children: Iterable[str],
        changed: Mapping[str, Value],
    ) -> Differing:
        """Take a control step with other values of what is no parent; compare the children."""
        request = {**context, **changed}
        action = self._set(request)
        now = self._world.row
        moved = {n: base[0][n] for n in parents if n not in self._actions}
        moved = {n: value for n, value in moved.items() if gap(now[n], value) > 0.0}
        if moved:  # follows from what was changed
            request |= moved
            action = self._set(request)
        if self._world.compiled is not self._compiled:
            return {}
        self._world.step(action)
        self.effects.rollouts += 1
        now = self._world.row
        found = {(name, 1): gap(now[name], base[1][name]) for name in children}
        found = {key: size for key, size in found.items() if size > self._least}
        if not found:
            return {}
        touching = self._touches(request)  # what did not touch before may act now
        return {
            (name, lag): size
            for (name, lag), size in found.items()
            if not touching
            or not any(p.when == "contact" and p.name in changed for p in self._parents[name])
        }

    # --- the past ---------------------------------------------------------------------------------

    def _see_memory(self, rng: ProbeGenerator) -> None:
        """Change one half of everything for a control step, put it back, and go on; then the other.

        What differs from a run without the change is remembered by something that is no variable.
        To write all parameters anew could hide that one of them writes another one, too.
        """
        low, high = action_range(self._world)
        shares = rng.random("memory", LATER * len(low)).reshape(LATER, -1)
        actions = low + shares * (high - low)
        for place in range(PLACES):
            self._set({})
            back = {name: self._first[name] for name in self._targets}
            if place:
                back |= anywhere(self._world, ProbeGenerator(self._noise, self._number, place))[0]
            try:
                base = self._after({}, back, actions)
            except (InterventionError, EngineFailure):
                continue
            break
        else:
            return
        wish = self._wish(rng, "memory", geometry=True)
        chosen = rng.random("half", len(wish)) < 0.5
        for half in (chosen, ~chosen):
            some = {name: wish[name] for name, one in zip(wish, half, strict=True) if one}
            self._see(some, lambda changed: self._since(base, self._after(changed, back, actions)))

    def _after(
        self, changed: Mapping[str, Value], back: Mapping[str, Value], actions: Floats
    ) -> tuple[dict[tuple[str, int], Value], list[dict[str, Value]]]:
        """Change something for a control step, put it back, and go on.

        Returns:
            What each mechanism gives at the two instants, whose parents are handed to it as they
            were: what differs is read past them. And all values from then on.
        """
        world, solve = self._world, self._world.model.solve
        action = self._set(changed)
        mechanisms: dict[tuple[str, int], Value] = {}
        for lag in (0, 1):
            for name in reversed(self._alone):
                found = solve(self._first, previous=self._earlier, only=(name,))
                mechanisms[name, lag] = found[name]
            if lag == 0:
                world.step(action)
        now = world.row
        world.do({name: value for name, value in back.items() if gap(now[name], value) > 0.0})
        values = [world.values()]
        for action in actions:
            world.step(action)
            self.effects.rollouts += 1
            values.append(world.values())
        return mechanisms, values

    def _since(
        self,
        base: tuple[dict[tuple[str, int], Value], list[dict[str, Value]]],
        other: tuple[dict[tuple[str, int], Value], list[dict[str, Value]]],
    ) -> Differing:
        """Tell what differs from a run without the change though its parents do not."""
        found = {key: gap(other[0][key], value) for key, value in base[0].items()}
        for step in range(LATER):
            (before, now), (its, then) = base[1][step : step + 2], other[1][step : step + 2]
            for name, parents in self._parents.items():
                held = (p.name for p in parents if p.name not in self._actions)
                if all(gap(its[parent], before[parent]) == 0.0 for parent in held):
                    found[name, step + 2] = gap(then[name], now[name])
        return {key: size for key, size in found.items() if size > self._least}

    # --- the causes -------------------------------------------------------------------------------

    def _see(
        self, wish: dict[str, Value], differing: Callable[[Mapping[str, Value]], Differing]
    ) -> None:
        """Find and note the causes of what differs when everything is changed."""
        found = self._feasible(wish, differing)
        for effect in sorted(found, key=lambda one: -found[one])[:BLAMED]:
            if self._blamed[effect] >= BLAMED:  # it is known by now
                continue
            self._blamed[effect] += 1
            sizes = [found[effect]]

            def differs(
                names: list[str], effect: tuple[str, int] = effect, sizes: list[float] = sizes
            ) -> bool:
                try:
                    again = differing({name: wish[name] for name in names})
                except (InterventionError, EngineFailure):
                    return False
                sizes.append(again.get(effect, sizes[-1]))
                return effect in again

            if differs([]) or not differs([*wish]):  # it differs by itself
                self.effects.see_unstable(effect[0], sizes[-1])
                continue
            causes = fewest([*wish], differs)
            now = {name: self._probe.action[where] for name, where in self._actions.items()}
            now |= {name: self._first[name] for name in causes if name not in now}
            change = np.concatenate([np.ravel(wish[n]) - np.ravel(now[n]) for n in causes])
            setting = ProbeSetting(self._number, f"{self._probe.kind}, together", change)
            self.effects.see_violation((" & ".join(causes), *effect), sizes[-1], setting)

    def _feasible(
        self, wish: dict[str, Value], differing: Callable[[Mapping[str, Value]], Differing]
    ) -> Differing:
        """Try a wish, and take what is refused out of it.

        Where two bodies would overlap, one target is named, and it takes long to say which. So
        places and sizes are left out where leaving out one of them does not suffice.
        """
        for attempt in range(ATTEMPTS):
            try:
                return differing(wish)
            except EngineFailure:
                break
            except InterventionError as error:
                problems = error.problems if isinstance(error, SeveralProblems) else (error,)
                refused = {problem.variable for problem in problems}
                if attempt or not refused & wish.keys():
                    refused |= self._geometry
                for name in refused & wish.keys():
                    del wish[name]
        return {}


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
