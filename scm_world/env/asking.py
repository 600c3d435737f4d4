"""The questions of ``check``, and how they are answered."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, final, get_args

import numpy as np

from scm_world._arguments import finite_numbers
from scm_world._types import Floats, Mask
from scm_world.env.answers import (
    ROUNDING,
    TARGETS,
    Answer,
    at,
    is_pair,
    missing,
    near,
    none,
    numbers,
)
from scm_world.env.draws import judge
from scm_world.errors import InterventionError, ScmWorldError, UnknownOption
from scm_world.queries.experiments.effects import FACTOR
from scm_world.variables import Box, Draw, Scale, Shift
from scm_world.variables.distributions import Distribution
from scm_world.variables.spaces import Space
from scm_world.world.simulation import READ_BACK

SPACES: Any = get_args(get_args(Space)[0])
NEAR = 0.05  # share of a range: a value nearer than this is not another one
UNDONE = 1e-6  # share of an effect that an undo may leave: rounding
OTHER = 1_000  # offset of the seed of a partial reset


class PairedRun(NamedTuple):
    """States of a run, shape (steps + 1, n, k), and in which episodes had not ended."""

    states: Floats
    alive: Mask


class Response(NamedTuple):
    """The largest difference between runs: in spreads, and in the unit of a column."""

    share: float = 0.0
    size: float = 0.0
    column: int = 0
    step: int = 0


@final
class Asking:
    """Asks worlds all questions about one range after another."""

    def __init__(self, worlds: Any, seed: int, steps: int, resets: int) -> None:
        self.worlds, self.seed, self.resets, self.n = worlds, seed, resets, worlds.num_envs
        self.all, self.only = np.ones(self.n, bool), np.arange(self.n) == 0
        rng = np.random.default_rng(seed)
        self.actions = rng.uniform(-1.0, 1.0, (steps, self.n, worlds.n_actions))
        self.can_set, self.floor = hasattr(worlds, "set"), 0.0
        self.limit = self.spread = np.ones(0)  # of each number of a state
        if not getattr(worlds, "has_steps", True):
            self.actions = self.actions[:0]
        self.names: tuple[str, ...] = ()
        self.declared = True

    def spaces(self, given: Mapping[str, Any] | None) -> dict[str, Distribution]:
        """Return the declared ranges as spaces; all values are read once."""
        self.worlds.reset(self.seed, self.all)
        self.declared = given is not None or hasattr(self.worlds, "named")
        expanded = getattr(self.worlds, "usual", dict)() if given is None else given
        if hasattr(self.worlds, "named"):
            expanded = self.worlds.named(expanded)
        if not expanded:
            raise UnknownOption(
                "ranges", given, ("a range for each name: there are no usual ones",)
            )
        found = {name: self._space(name, one) for name, one in expanded.items()}
        self.names = tuple(found)
        return found

    def _space(self, name: str, given: Any) -> Distribution:
        if not isinstance(name, str):
            raise UnknownOption("name of a range", name, ("a text",))
        try:
            now = self.read(name)
        except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
            if isinstance(error, ScmWorldError):
                raise
            raise UnknownOption("range", name, (f"a name that get() knows: {error!r}",)) from error
        if now.shape[:1] != (self.n,):
            raise UnknownOption("shape of " + name, now.shape, (f"({self.n}, …), a row a world",))
        relative = isinstance(given, Scale | Shift)
        ends = given.by if relative else given
        if isinstance(ends, Draw):
            ends = self.worlds.space(name, ends) if hasattr(self.worlds, "space") else ends.source
        if isinstance(ends, SPACES) and not (relative and isinstance(ends, Box)):
            space: Distribution = ends
            return space
        if isinstance(ends, Box):
            ends = ends.low, ends.high
        pair = [finite_numbers(end) for end in ends] if is_pair(ends) else []
        shape = now.shape[1:]
        if len(pair) != 2 or any(end is None or end.shape not in ((), shape) for end in pair):
            allowed = (f"(low, high), numbers or of shape {shape}", "a space", "Draw(low, high)")
            raise UnknownOption(f"range of {name}", given, (*allowed, "Scale(Draw(0.5, 1.5))"))
        low, high = (np.broadcast_to(end, shape) for end in pair)  # type: ignore[arg-type] # checked
        if relative:
            base = self._reference(name, now)[0]
            low, high = ((base * e if isinstance(given, Scale) else base + e) for e in (low, high))
            low, high = np.minimum(low, high), np.maximum(low, high)
        if (low > high).any() or not (low < high).any():
            raise UnknownOption(f"range of {name}", given, ("one in which low is below high",))
        return Box(*(end.ravel().tolist() if shape else float(end) for end in (low, high)))

    def _reference(self, name: str, now: Floats) -> Floats:
        given = getattr(self.worlds, "reference", None)
        return now if given is None else np.array(given(name), dtype=np.float64)

    def value(self, space: Distribution, name: str, u: float) -> Floats:
        """Return the value at a place in a range, from 0 to 1, given the values of world 0."""
        shape = self.read(name).shape[1:]
        values = self.worlds.values() if space.parents() else {}
        return at(space, u, shape, values)

    def unit(self, name: str) -> str:
        """Return the unit of a parameter."""
        given = getattr(self.worlds, "unit", None)
        return "" if given is None else str(given(name))

    # --- runs ---------------------------------------------------------------------------------

    def read(self, name: str) -> Floats:
        """Read a parameter in all worlds, shape (n, …), as a copy."""
        return np.array(self.worlds.get(name), dtype=np.float64)

    def write(self, name: str, values: Floats, mask: Mask | None = None) -> None:
        """Set a parameter in some worlds; all have a value in ``values``."""
        self.worlds.set(name, values, self.all if mask is None else mask)

    def run(
        self, first: Callable[[], object] = int, middle: Callable[[], object] = int
    ) -> PairedRun:
        """Run equal episodes, with calls after their reset and in the middle of them."""
        self.worlds.reset(self.seed, self.all)
        first()
        states, alive = [self._observed()], [self.all]
        for step, actions in enumerate(self.actions):
            if step == len(self.actions) // 2:
                middle()
            ended = self.worlds.step(actions)
            alive.append(alive[-1] if ended is None else alive[-1] & ~np.asarray(ended, bool))
            states.append(self._observed())
        if not len(self.actions):
            middle()
            states, alive = [*states, self._observed()], [*alive, self.all]
        return PairedRun(np.array(states), np.array(alive))

    def _observed(self) -> Floats:
        return np.array(self.worlds.observe(), dtype=np.float64).reshape(self.n, -1)

    def measure(self, first: Callable[[], object] = int) -> None:
        """Run twice without a change: the floor, and the spread of each number of a state."""
        one, other = self.run(first), self.run(first)
        kept = one.states[one.alive]
        with np.errstate(invalid="ignore"):
            spread, size = kept.std(axis=0), np.abs(kept).max(axis=0)
        self.spread = np.where(spread > 0.0, spread, np.where(size > 0.0, size, 1.0))
        far = _far(one.states, other.states)
        far[~(one.alive & other.alive)] = 0.0
        self.limit = FACTOR * far.max(axis=(0, 1))
        self.floor = float((self.limit / self.spread).max(initial=0.0)) / FACTOR

    def gap(self, one: PairedRun, other: PairedRun, rows: Mask, name: str = "") -> Response | None:
        """Compare runs in some worlds; None if they are equal. Columns of ``name`` are left out."""
        far = _far(one.states, other.states)
        far[~(one.alive & other.alive & rows)] = 0.0
        far[..., [column.partition("[")[0] == name for column, _ in self.columns]] = 0.0
        far[far <= self.limit] = 0.0
        if not far.any():
            return None
        share = far / self.spread
        column = int(share.max(axis=(0, 1)).argmax())
        step = int(np.flatnonzero(far.any(axis=(1, 2)))[0])
        sizes = far.max(axis=(0, 1))
        return Response(float(share.max()), float(sizes[column]), column, step)

    @property
    def columns(self) -> list[tuple[str, str]]:
        """Name and unit of each number of a state."""
        if hasattr(self.worlds, "columns"):
            given: list[tuple[str, str]] = self.worlds.columns()
            return given
        return [(f"observation[{i}]", "") for i in range(self.spread.size)]

    def said(self, gap: Response | None, words: str) -> dict[str, Any]:
        """Return the text and the numbers of a difference in the state."""
        if gap is None:
            return {"said": words}
        name, unit = self.columns[gap.column]
        found = f"{words}: {gap.size:.3g} {unit} of {name}, from step {gap.step} on"
        found = found.replace("  ", " ")
        return {"said": found, "size": gap.size, "unit": unit, "share": gap.share}

    def _equality(self, gap: Response | None, words: str) -> Answer:
        """Return the answer about runs that have to be equal."""
        if gap is None:
            return Answer(status="passed")
        return Answer(status="fault", **self.said(gap, words))

    # --- values that are set from outside -----------------------------------------------------

    def set_from_outside(self, name: str, space: Distribution) -> dict[str, Answer]:
        """Answer all questions by setting a value in world 0.

        Where nothing that is computed depends on it, by declaration, no steps are needed.
        """
        if self._still(name) and len(self.actions):
            actions, self.actions = self.actions, self.actions[:0]
            try:
                return self.set_from_outside(name, space)
            finally:
                self.actions = actions
        base, worlds = self.run(), self.worlds
        worlds.reset(self.seed, self.all)
        before, values = self.read(name), self.read(name)
        tried, why = self._accepted(name, space, before)
        if not tried:
            return why
        got: list[Floats] = []
        act = partial(self._change, name, values, got)
        late, found = False, dict[str, Answer]()
        for values[0] in tried:
            got.clear()
            one = self.run(act)
            gap = self.gap(one, base, self.only, name)
            if gap is None:
                gap = self.gap(self.run(), base, self.only, name)
                late = gap is not None
            if gap is not None:
                break
            self._write_back(name, before, self.only)
        wanted = values[0]
        worlds.reset(self.seed, self.all)
        later = self.read(name)
        if not np.array_equal(got[0][0], before[0]):
            found["applied"] = Answer(status="passed")
        elif near(later[0], wanted):
            late, found["applied"] = True, Answer(status="passed", said="after the next reset")
        else:
            said = f"{numbers(wanted)} was set, and the engine still has {numbers(before[0])}"
            found["applied"] = Answer(status="fault", said=said)
        found["in range"] = self._taken(name, space, before, late)
        found |= self._responses(name, gap, late)
        if gap is not None and not late and found["in range"].status == "passed":
            found["in range"] = Answer(status="passed", said=self._flat(name, space, before))
        found["neighbours"] = self._neighbours(one, base, got[0], before)
        if not (near(later[0], before[0]) or near(later[0], wanted)):
            said = f"after the next reset it is {numbers(later[0])}"
            found["second reset"] = Answer(status="fault", said=said)
        else:
            found["second reset"] = self._repeated(act, one, got, late)
        found["partial reset"] = self._partial(one, act)
        found["undo"] = missing("it acts only after the next reset")
        if not late:
            found["undo"] = self._undo(name, values, before, base, gap)
        found["constants"] = self._constants(name, one, act)
        worlds.reset(self.seed, self.all)
        self._write_back(name, before, self.all)
        return found

    def _change(
        self, name: str, values: Floats, got: list[Floats], first: Callable[[], object] = int
    ) -> None:
        """Set a value in world 0, after another call; ``got`` receives the values that follow."""
        first()
        self.write(name, values, self.only)
        got.append(self.read(name))

    def _undo(
        self, name: str, values: Floats, before: Floats, base: PairedRun, gap: Response | None
    ) -> Answer:
        def act() -> None:
            self.write(name, values, self.only)
            self.write(name, before, self.only)

        try:
            left = self.gap(self.run(act), base, self.all, name)
        except InterventionError as error:
            return missing(f"the old value is refused: {error}")
        if left is not None and gap is not None and left.share <= UNDONE * gap.share:
            return Answer(status="passed", **self.said(left, "rounding is left"))
        return self._equality(left, "the old value leaves an effect")

    def _write_back(self, name: str, before: Floats, mask: Mask) -> None:
        """Set the old value, and begin episodes: some worlds take values over only then."""
        with suppress(InterventionError):  # of worlds that have it again after a reset
            self.write(name, before, mask)
        self.worlds.reset(self.seed, self.all)

    def _still(self, name: str) -> str:
        """Return why no response is declared, or nothing."""
        return str(self.worlds.why(name)) if hasattr(self.worlds, "why") else ""

    def _accepted(
        self, name: str, space: Distribution, before: Floats
    ) -> tuple[list[Floats], dict[str, Answer]]:
        """Return values that world 0 takes; if there are none, all answers."""
        tried, values, why = list[Floats](), before.copy(), "no other value lies in the range"
        for u in TARGETS:
            values[0] = self.value(space, name, u)
            if near(values[0], before[0], NEAR * self._width(space, name)):
                continue
            try:
                self.write(name, values, self.only)
                tried.append(values[0].copy())
            except InterventionError as error:
                why = f"every value that was tried was refused, the last one because {error}"
            except ScmWorldError as error:
                fault = Answer(status="fault", said=str(error))
                return [], {**none("it is not applied"), "applied": fault}
            self._write_back(name, before, self.only)
        return tried, none(why)

    def _width(self, space: Distribution, name: str) -> Floats:
        low, high = (self.value(space, name, u) for u in (0.0, TARGETS[0]))
        return np.abs(high - low)

    def _taken(self, name: str, space: Distribution, before: Floats, late: bool) -> Answer:
        """Set both ends of a range, and read them back."""
        tried = 0
        for u in (0.0, TARGETS[0]):
            self.worlds.reset(self.seed, self.all)
            wanted = before.copy()
            wanted[0] = self.value(space, name, u)
            try:
                self.write(name, wanted, self.only)
            except ScmWorldError:  # such as an overlap
                continue
            if late:
                self.worlds.reset(self.seed, self.all)
            tried, got = tried + 1, self.read(name)
            same = near(got[0], wanted[0]) or np.array_equal(got[0], before[0])
            if not (same or self._is_alike(name, got)):
                said = f"{numbers(wanted[0])} was set, and the engine has {numbers(got[0])}"
                return Answer(status="fault", said=said)
        return Answer(status="passed") if tried else missing("both ends were refused")

    def _is_alike(self, name: str, got: Floats) -> bool:
        """Return whether other coordinates are of the same pose: a centre has no polar angle."""
        if not hasattr(self.worlds, "target") or self.worlds.target(name) == name:
            return False
        target = self.worlds.target(name)
        pose = self.read(target)[0]
        self.worlds.reset(self.seed, self.all)
        self.write(name, got, self.only)
        return near(self.read(target)[0], pose, READ_BACK)

    def _flat(
        self, name: str, space: Distribution, before: Floats, first: Callable[[], object] = int
    ) -> str:
        """Return between which ends and the middle of a range no state differs, or nothing."""
        values, runs = before.copy(), list[tuple[str, PairedRun]]()
        act = partial(self._change, name, values, [], first)
        for u in (0.0, 0.5, TARGETS[0]):
            self.worlds.reset(self.seed, self.all)
            values[0] = self.value(space, name, u)
            try:
                runs.append((numbers(values[0]), self.run(act)))
            except ScmWorldError:  # such as an overlap
                return ""
        for (low, one), (high, other) in pairwise(runs):
            if self.gap(one, other, self.only, name) is None:
                return f"no state differs from {low} to {high}"
        return ""

    def _responses(self, name: str, gap: Response | None, late: bool) -> dict[str, Answer]:
        """Answer whether the state responds, and when."""
        if gap is not None:
            words = "it differs" if gap.share > ROUNDING else "it differs in rounding alone"
            at_once = Answer(status="passed")
            if late:
                said = "the state differs only after the next reset"
                at_once = Answer(status="fault", said=said)
            return {
                "responds": Answer(status="passed", **self.said(gap, words)),
                "at once": at_once,
            }
        why = self._still(name)
        if not why and hasattr(self.worlds, "untouched"):
            why = self.worlds.untouched(name)
        if self.floor > 0.0:
            why = f"two equal runs differ by {self.floor:.3g} spreads, and no difference is larger"
        said = f"no number of the state differs in {len(self.actions)} control steps"
        why = why or f"{said}, and nobody declared this range" * (not self.declared)
        answer = missing(why) if why else Answer(status="fault", said=said)
        return {"responds": answer, "at once": missing("nothing responds")}

    def _neighbours(self, one: PairedRun, base: PairedRun, got: Floats, before: Floats) -> Answer:
        if self.n == 1:
            return missing("there is one world")
        changed = [i for i in range(1, self.n) if not _equal(got[i], before[i])]
        if changed:
            said = f"the value of world {changed[0]} became {numbers(got[changed[0]])}, too"
            return Answer(status="fault", said=said)
        return self._equality(self.gap(one, base, ~self.only), "the states of other worlds differ")

    def _repeated(
        self, act: Callable[[], None], one: PairedRun, got: list[Floats], late: bool
    ) -> Answer:
        for _ in range(1 + late):
            before, one = one, self.run(act)
        if not _equal(got[-1], got[-2]) and not late:
            words = f"{numbers(got[-2][0])} became {numbers(got[-1][0])} when it was set again"
            return Answer(status="fault", said=words)
        return self._equality(self.gap(one, before, self.all), "the same again gives other states")

    def _partial(self, one: PairedRun, first: Callable[[], object]) -> Answer:
        """Reset the last world in the middle of a run."""
        if self.n == 1:
            return missing("there is one world")
        last, kept = np.arange(self.n) == self.n - 1, dict[str, tuple[Floats, Floats]]()

        def reset() -> None:
            old = {name: self.read(name) for name in self.names}
            self.worlds.reset(self.seed + OTHER, last)
            kept.update({name: (old[name], self.read(name)) for name in self.names})

        gap = self.gap(self.run(first, reset), one, ~last)
        for name, (old, new) in kept.items():
            if not _equal(old[:-1], new[:-1]):
                return Answer(status="fault", said=f"{name} changed in worlds that were not reset")
        return self._equality(gap, "the states of other worlds differ")

    def _constants(self, name: str, one: PairedRun, act: Callable[[], object]) -> Answer:
        """Compare derived constants with a fresh compilation; measure their effect."""
        if not hasattr(self.worlds, "stale"):
            return missing("no model of these worlds can be compiled afresh")
        self.worlds.reset(self.seed, self.all)
        act()
        found = self.worlds.stale(name)
        if found is None:
            return missing("this engine has no model that can be compiled afresh")
        remark = self.worlds.remark(name) if hasattr(self.worlds, "remark") else ""
        if not found:
            return Answer(status="passed", said=remark)
        worst = sorted(found.items(), key=lambda item: -item[1])
        words = f"stale: {', '.join(f'{field} ({far:.2g})' for field, far in worst)}"
        back: list[Callable[[], None]] = []
        gap = None
        if hasattr(self.worlds, "refresh"):

            def anew() -> None:
                act()
                back.append(self.worlds.refresh())

            fresh = self.run(anew)
            gap = self.gap(fresh, one, self.all)
            back[0]()
        verb = "; fresh ones move the state" if gap else "; fresh ones move nothing in this run"
        said = self.said(gap, words + verb)
        said["said"] += f"; {remark}" * bool(remark)
        return Answer(status="fault", **said)

    # --- values that the environments draw at a reset -----------------------------------------

    def drawn(self, name: str, space: Distribution) -> dict[str, Answer]:
        """Answer all questions about values that are drawn at resets."""
        draws, seeds = getattr(self.worlds, "draws", True), range(1, self.resets + 1)
        values = np.array([self._after(self.seed + OTHER * i, name) for i in seeds])
        ends = [self.value(space, name, u) for u in (0.0, TARGETS[0])]
        found = judge(values.reshape(self.resets, self.n, -1), *map(np.ravel, ends), draws=draws)
        found["undo"] = missing("the environments draw their values themselves")
        again = [self._after(self.seed, name) for _ in range(2)]
        if found["second reset"].status == "passed" and not _equal(*again):
            said = "the same seed gives other values"
            found["second reset"] = Answer(status="passed", said=said)
        fix, before = self.kept(), self.read(name)
        base = self.run(fix)
        if not self.can_set:
            absent = missing("these environments have no method set")
            found |= dict.fromkeys(("responds", "at once", "neighbours"), absent)
        else:
            width = NEAR * np.abs(ends[1] - ends[0])
            tried = [self._reference(name, before)[0], *ends]
            tried = [one for one in tried if not near(one, before[0], width)]
            other = before.copy()
            got: list[Floats] = []
            act = partial(self._change, name, other, got, fix)
            for other[0] in tried:
                one = self.run(act)
                gap = self.gap(one, base, self.only, name)
                if gap is not None:
                    break
            found |= self._responses(name, gap, late=False)
            if gap is not None and found["in range"].status == "passed":
                said = self._flat(name, space, before, fix)
                found["in range"] = Answer(status="passed", said=said)
            found["neighbours"] = self._neighbours(one, base, got[0], before)
            if found["at once"].status == "passed" and hasattr(self.worlds, "outdated"):
                found["at once"] = self._first_observation(name, other)
        found["partial reset"] = self._partial(base, fix) if draws else missing("nothing is reset")
        found["constants"] = self._constants(name, base, fix)
        fix()
        return found

    def kept(self) -> Callable[[], None]:
        """Return what writes the present values again, whatever a reset draws."""
        if hasattr(self.worlds, "keep"):
            back: Callable[[], None] = self.worlds.keep()
            return back
        kept = {name: self.read(name) for name in self.names if self.can_set}

        def fix() -> None:
            for name, value in kept.items():
                self.write(name, value)

        return fix

    def _after(self, seed: int, name: str) -> Floats:
        self.worlds.reset(seed, self.all)
        return self.read(name)

    def _first_observation(self, name: str, other: Floats) -> Answer:
        """Answer whether the first observation is of the values that were drawn."""
        self.worlds.reset(self.seed, self.all)
        old = self.worlds.outdated()[0]
        self.write(name, other, self.only)
        if not old or self.worlds.outdated()[0] == old:
            return Answer(status="passed")
        said = f"the first observation shows the values before: it differs by {old:.3g}"
        return Answer(status="fault", said=said)


def _far(one: Floats, other: Floats) -> Floats:
    """Return differences; equal infinities and NaN at the same place are equal."""
    with np.errstate(invalid="ignore"):
        far = np.abs(one - other)
    far[(one == other) | (np.isnan(one) & np.isnan(other))] = 0.0
    return np.where(np.isnan(far), np.inf, far)


def _equal(one: Floats, other: Floats) -> bool:
    return np.array_equal(one, other, equal_nan=True)
