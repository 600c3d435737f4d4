"""The questions of ``check``, and how they are answered.

Values are set in several worlds of a run at once, those of one range in each. Where anything of
this is not as it should be, each of these ranges is asked alone, and the answer says what it is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, final, get_args

import numpy as np

from scm_world._arguments import finite_numbers
from scm_world._types import Floats, Mask
from scm_world.backends.checkable import Checkable
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
MOST = 3  # values of a range to which a state may not respond: then it does not


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


@dataclass(eq=False)
class AskedRange:
    """A range that is asked about, in one world.

    Attributes:
        name: The parameter.
        space: Its values.
        alone: Whether no other range is asked about in the same runs.
        attempt: How many values the state did not respond to.
        world: Number of the world.
        before: Values without a change, shape (n, …).
        values: The same with the value that is tried in its world.
        at: The place of this value in the range, from 0 to 1.
        seen: Values before and after each setting, both of shape (n, …).
        later: The value of its world after the next reset.
        late: Whether the state responds only then.
        stuck: Why the old value is refused, or nothing.
        gap: The response.
    """

    name: str
    space: Distribution
    alone: bool = False
    attempt: int = 0
    world: int = 0
    before: Floats = field(default_factory=lambda: np.empty(0))
    values: Floats = field(default_factory=lambda: np.empty(0))
    at: float = 0.0
    seen: list[tuple[Floats, Floats]] = field(default_factory=list)
    later: Floats = field(default_factory=lambda: np.empty(0))
    late: bool = False
    stuck: str = ""
    gap: Response | None = None


@final
class Asking:
    """Asks worlds all questions."""

    def __init__(self, worlds: Checkable, seed: int, steps: int, resets: int) -> None:
        self.worlds, self.seed, self.resets, self.n = worlds, seed, resets, worlds.num_envs
        self.all = np.ones(self.n, bool)
        rng = np.random.default_rng(seed)
        self.actions = rng.uniform(-1.0, 1.0, (steps * worlds.steps, self.n, worlds.n_actions))
        self.can_set, self.floor = type(worlds).set is not Checkable.set, 0.0
        self.limit = self.spread = np.ones(0)  # of each number of a state
        self.columns: list[tuple[str, str]] = []  # name and unit of each of them
        self.owners = np.empty(0, dtype=object)  # name of the variable of each of them
        self.coupling = np.zeros(0)  # what is no response after a step, by values or one
        self.names: tuple[str, ...] = ()
        self._base: PairedRun | None = None  # a run without a change
        self._turn = 0
        self._changed: list[str] = []  # names of values that a reset of another world changed

    def spaces(self, given: Mapping[str, Any] | None) -> dict[str, Distribution]:
        """Return the declared ranges as spaces; all values are read once."""
        self.worlds.reset(self.seed, self.all)
        expanded = self.worlds.declared(given)
        if not expanded:
            raise UnknownOption(
                "ranges", given, ("a range for each name: there are no usual ones",)
            )
        found = {name: self._space(name, one) for name, one in expanded.items()}
        self.names, self.columns = tuple(found), self.worlds.columns()
        self.coupling = np.broadcast_to(self.worlds.rounding(), (len(self.columns),))
        self.owners = np.array([column.partition("[")[0] for column, _ in self.columns])
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
        ends = ends.source if isinstance(ends, Draw) else ends
        if isinstance(ends, SPACES) and not relative:
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
            base = np.asarray(self.worlds.reference(name), dtype=np.float64)[0]
            low, high = ((base * e if isinstance(given, Scale) else base + e) for e in (low, high))
            low, high = np.minimum(low, high), np.maximum(low, high)
        if (low > high).any() or not (low < high).any():
            raise UnknownOption(f"range of {name}", given, ("one in which low is below high",))
        return Box(*(end.ravel().tolist() if shape else float(end) for end in (low, high)))

    def value(self, one: AskedRange, u: float) -> Floats:
        """Return the value at a place in a range, from 0 to 1, given the values of its world."""
        values = self.worlds.values(one.world) if one.space.parents() else {}
        return at(one.space, u, self.read(one.name).shape[1:], values)

    def ends(self, one: AskedRange) -> tuple[Floats, Floats]:
        """Return both ends of a range."""
        return self.value(one, 0.0), self.value(one, TARGETS[0])

    # --- runs ---------------------------------------------------------------------------------

    def read(self, name: str) -> Floats:
        """Read a parameter in all worlds, shape (n, …), as a copy."""
        return np.array(self.worlds.get(name), dtype=np.float64)

    def write(self, name: str, values: Floats, mask: Mask | None = None) -> None:
        """Set a parameter in some worlds; all have a value in ``values``."""
        self.worlds.set(name, values, self.all if mask is None else mask)

    def only(self, one: AskedRange) -> Mask:
        """Return the mask of the world of a range."""
        return np.asarray(np.arange(self.n) == one.world)

    def run(
        self,
        first: Callable[[], object] = int,
        middle: Callable[[], object] = int,
        until: Callable[[int, Floats], bool] = lambda step, states: False,
    ) -> PairedRun:
        """Run equal episodes.

        Args:
            first: Called after their reset.
            middle: Called in the middle of them.
            until: Whether a run may end at a step with such states.
        """
        self.worlds.reset(self.seed, self.all)
        first()
        states, alive = [self._observed()], [self.all]
        for step, actions in enumerate(self.actions):
            if until(step, states[-1]):
                break
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
        self._base = one
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
        n = min(len(one.states), len(other.states))
        far = _far(one.states[:n], other.states[:n])
        far[~(one.alive[:n] & other.alive[:n] & rows)] = 0.0
        far[..., self.owners == name] = 0.0
        far[far <= self.limit] = 0.0
        if not far.any():
            return None
        share = far / self.spread
        column = int(share.max(axis=(0, 1)).argmax())
        step = int(np.flatnonzero(far.any(axis=(1, 2)))[0])
        sizes = far.max(axis=(0, 1))
        return Response(float(share.max()), float(sizes[column]), column, step)

    def response(self, run: PairedRun, base: PairedRun, one: AskedRange) -> Response | None:
        """Compare runs in the world of a range.

        Where bodies that do not touch move one another, only the first step can tell.
        """
        if not self.coupling.any():
            return self.gap(run, base, self.only(one), one.name)
        here, there = (PairedRun(r.states[:2].copy(), r.alive[:2]) for r in (run, base))
        room = self.coupling * np.maximum(
            1.0, np.maximum(np.abs(here.states), np.abs(there.states))
        )
        np.copyto(here.states, there.states, where=_far(here.states, there.states) <= room)
        return self.gap(here, there, self.only(one), one.name)

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

    def set_from_outside(
        self, spaces: Mapping[str, Distribution], tell: Callable[[int], object]
    ) -> dict[str, dict[str, Answer]]:
        """Answer all questions by setting values.

        Where nothing that is computed depends on them, by declaration, no steps are needed.

        Args:
            spaces: The ranges.
            tell: Called with the number of ranges that are answered.
        """
        found: dict[str, dict[str, Answer]] = {}
        idle, actions = {n for n in spaces if self.worlds.idle(n, ran=False)}, self.actions
        for names in (spaces.keys() - idle, idle):
            if names is idle:
                self.actions, self._base = actions[:0], None
            waiting = [AskedRange(name, space) for name, space in spaces.items() if name in names]
            while waiting:
                alone = waiting[0].alone
                group = waiting[: 1 if alone else max(1, self.n - 1)]
                group = [one for one in group if one.alone == alone]
                found |= self._ask(group, tries=1 if names is idle else MOST)
                waiting = [one for one in waiting if one.name not in found]
                waiting.sort(key=lambda one: (one.alone, one.attempt))
                tell(len(found))
        return found

    def _ask(self, group: list[AskedRange], tries: int) -> dict[str, dict[str, Answer]]:
        """Ask about ranges, each in a world of its own. Those without an answer are asked again."""
        alone, base = len(group) == 1, self._base or self.run()
        found, last = self._choose(group, tries)
        asked = [one for one in group if one.name not in found]
        if not asked:
            return found
        first = self.run(partial(self._act, asked))
        self.worlds.reset(self.seed, self.all)
        for one in asked:
            one.gap = self.response(first, base, one)
            one.later = self.read(one.name)[one.world]
        quiet = {one for one in asked if one.gap is None and one not in last}
        loud = [one for one in asked if one not in quiet]
        # About half of them are set back while the others are set again; then the other way round.
        # In the middle the last world is reset.
        self._turn += 1
        bit = self._turn % max(1, (self.n - 2).bit_length())
        back = {one for one in loud if one.world >> bit & 1}
        self._changed = []
        again = first
        if loud or not all(one.attempt for one in quiet):  # values act late in the first attempt
            again = self.run(partial(self._act, loud, back), int if alone else self._reset_last)
        for one in quiet:
            one.gap = None if one.attempt else self.response(again, base, one)
            if one.gap is None:
                one.attempt += 1
            elif alone:  # the value is in the engine from now on
                one.late, loud = True, [one]
                first, again = (self.run(partial(self._act, loud)) for _ in range(2))
            else:
                one.alone = True
        answers = self._answers(group, loud, back, base, first, again) if loud else {}
        self._set_back(group)
        faulty = any(a.status == "fault" for given in answers.values() for a in given.values())
        self._base = None if faulty else base
        for one in group:
            one.alone |= faulty
        return found | ({} if faulty and not alone else answers)

    def _choose(
        self, group: list[AskedRange], tries: int
    ) -> tuple[dict[str, dict[str, Answer]], set[AskedRange]]:
        """Choose a value of each range: one that its world takes, and another one each time.

        Returned are all answers about ranges without such a value, and those of which no other one
        is tried.
        """
        found: dict[str, dict[str, Answer]] = {}
        taken, why = dict.fromkeys(group, 0), dict[AskedRange, str]()
        self.worlds.reset(self.seed, self.all)
        for world, one in enumerate(group):
            one.world, one.before, one.seen = world, self.read(one.name), []
        for u in TARGETS:
            looking = [one for one in group if taken[one] <= one.attempt and one.name not in found]
            for one in looking:
                (low, high), values, now = self.ends(one), one.before.copy(), one.before[one.world]
                values[one.world] = self.value(one, u)
                if near(values[one.world], now, NEAR * np.abs(high - low)):
                    continue
                try:
                    self.write(one.name, values, self.only(one))
                except InterventionError as error:
                    why[one] = f"the last one because {error}"
                except ScmWorldError as error:
                    fault = Answer(status="fault", said=str(error))
                    found[one.name] = {**none("it is not applied"), "applied": fault}
                else:
                    one.values, one.at, taken[one] = values, u, taken[one] + 1
            if looking:
                self._set_back(looking)
        for one in group:
            if not taken[one] and one.name not in found:
                refused = f"every value that was tried was refused, {why.get(one)}"
                found[one.name] = none(
                    refused if one in why else "no other value lies in the range"
                )
        last = {one for one in group if one.attempt and taken[one] <= one.attempt}
        return found, last | {one for one in group if one.attempt + 1 >= tries}

    def _act(self, ranges: Iterable[AskedRange], back: Collection[AskedRange] = ()) -> None:
        """Set the value of each range in its world; set some back again."""
        for one in ranges:
            before = self.read(one.name)
            self.write(one.name, one.values, self.only(one))
            one.seen.append((before, self.read(one.name)))
            if one in back:
                try:
                    self.write(one.name, one.before, self.only(one))
                except InterventionError as error:
                    one.stuck = f"the old value is refused: {error}"

    def _set_back(self, ranges: Iterable[AskedRange]) -> None:
        """Set the old values, and begin episodes: some worlds take values over only then."""
        self.worlds.reset(self.seed, self.all)
        for one in ranges:
            with suppress(InterventionError):  # of worlds that have it again after a reset
                self.write(one.name, one.before)
        self.worlds.reset(self.seed, self.all)

    def _answers(
        self,
        group: list[AskedRange],
        asked: list[AskedRange],
        back: Collection[AskedRange],
        base: PairedRun,
        first: PairedRun,
        again: PairedRun,
    ) -> dict[str, dict[str, Answer]]:
        """Answer all questions about ranges. If several are asked, a fault may be of another one.

        Args:
            group: All that were set.
            asked: Those to be answered.
            back: Those of them that were set back in ``again``.
            base: A run without a change.
            first: With it.
            again: With it again.
        """
        alone, act = len(group) == 1, partial(self._act, asked)
        others = np.arange(self.n) >= len(group)
        middle: Any = int if alone else self._reset_last
        late = any(one.late for one in asked)
        undone = {one for one in asked if one not in back}
        final = again if late else self.run(partial(self._act, asked, undone), middle)
        partly = self._partial(first, act) if alone else self._unchanged()
        taken, flat = self._taken(asked), dict[str, str]()
        clear = [one for one in asked if one.gap and taken[one].status == "passed" and not late]
        if clear and not self.coupling.any():
            flat = self._flat(clear, first if all(one.at == TARGETS[0] for one in clear) else None)
        self.worlds.reset(self.seed, self.all)
        act()
        stale = {one: (self.worlds.stale(one.name), self.worlds.remark(one.name)) for one in asked}
        found = {}
        for one in asked:
            rows = self.only(one) | (others & alone)
            twice, undo = (final, again) if one in back else (again, final)
            here = found[one.name] = self._responses(one)
            here["applied"] = self._applied(one)
            here["in range"] = taken[one]
            if flat.get(one.name):
                here["in range"] = Answer(status="passed", said=flat[one.name])
            here["neighbours"] = self._neighbours(one, first, base, others)
            here["second reset"] = self._repeated(one, self.gap(twice, first, rows))
            here["undo"] = self._undone(one, self.gap(undo, base, rows))
            here["partial reset"] = partly
            here["constants"] = self._constants(*stale[one], first, act)
        return found

    def _applied(self, one: AskedRange) -> Answer:
        got, before, wanted = (x[one.world] for x in (one.seen[0][1], one.before, one.values))
        if not np.array_equal(got, before):
            return Answer(status="passed")
        if near(one.later, wanted):
            return Answer(status="passed", said="after the next reset")
        said = f"{numbers(wanted)} was set, and the engine still has {numbers(before)}"
        return Answer(status="fault", said=said)

    def _undone(self, one: AskedRange, left: Response | None) -> Answer:
        if one.late or one.stuck:
            return missing(one.stuck or "it acts only after the next reset")
        if left is not None and one.gap is not None and left.share <= UNDONE * one.gap.share:
            return Answer(status="passed", **self.said(left, "rounding is left"))
        return self._equality(left, "the old value leaves an effect")

    def _taken(self, asked: list[AskedRange]) -> dict[AskedRange, Answer]:
        """Set both ends of ranges, and read them back."""
        found = dict.fromkeys(asked, missing("both ends were refused"))
        for u in (0.0, TARGETS[0]):
            self.worlds.reset(self.seed, self.all)
            wanted = {}
            for one in asked:
                values = one.before.copy()
                values[one.world] = self.value(one, u)
                with suppress(ScmWorldError):  # such as an overlap
                    self.write(one.name, values, self.only(one))
                    wanted[one] = values[one.world]
            if any(one.late for one in asked):
                self.worlds.reset(self.seed, self.all)
            got = {one: self.read(one.name) for one in wanted}
            poses = {one: self.read(self.worlds.target(one.name)) for one in wanted}
            for one, value in wanted.items():
                now = got[one][one.world]
                same = near(now, value) or np.array_equal(now, one.before[one.world])
                if not (same or self._is_alike(one, got[one], poses[one])):
                    said = f"{numbers(value)} was set, and the engine has {numbers(now)}"
                    found[one] = Answer(status="fault", said=said)
                elif found[one].status == "not asked":
                    found[one] = Answer(status="passed")
        return found

    def _is_alike(self, one: AskedRange, got: Floats, pose: Floats) -> bool:
        """Return whether other coordinates are of the same pose: a centre has no polar angle."""
        target = self.worlds.target(one.name)
        if target == one.name:
            return False
        self.worlds.reset(self.seed, self.all)
        self.write(one.name, got, self.only(one))
        return near(self.read(target)[one.world], pose[one.world], READ_BACK)

    def _flat(
        self, asked: list[AskedRange], high: PairedRun | None, first: Callable[[], object] = int
    ) -> dict[str, str]:
        """Return between which ends and the middle of ranges no state differs, by name.

        A run ends as soon as all states have differed.

        Args:
            asked: The ranges.
            high: The run with their upper ends, if there was one.
            first: Called before values are set.
        """
        left = [*asked]

        def run(u: float, other: PairedRun | None) -> PairedRun:
            def act() -> None:
                first()
                for one in asked:
                    given = one.before.copy()
                    given[one.world] = self.value(one, u)
                    try:
                        self.write(one.name, given, self.only(one))
                    except ScmWorldError:  # such as an overlap
                        if one in left:
                            left.remove(one)

            seen = set[AskedRange]()

            def until(step: int, states: Floats) -> bool:
                if other is None:
                    return False
                far = _far(states, other.states[step]) > self.limit
                seen.update(one for one in left if far[one.world, self.owners != one.name].any())
                return seen.issuperset(left) or step + 1 >= len(other.states)

            return self.run(act, until=until)

        high = high or run(TARGETS[0], None)
        for whole in (False, True):
            found: dict[str, str] = {}
            middle = run(0.5, None if whole else high)
            runs = {TARGETS[0]: high, 0.5: middle, 0.0: run(0.0, middle)}
            for low, above in ((0.5, TARGETS[0]), (0.0, 0.5)):
                for one in left:
                    ends = self.value(one, low), self.value(one, above)
                    same = self.gap(runs[low], runs[above], self.only(one), one.name) is None
                    if same and not np.array_equal(*ends):
                        found[one.name] = "no state differs from {} to {}".format(
                            *map(numbers, ends)
                        )
            if not found:
                break
        return found

    def _responses(self, one: AskedRange) -> dict[str, Answer]:
        """Answer whether the state responds, and when."""
        gap = one.gap
        if gap is not None:
            words = "it differs" if gap.share > ROUNDING else "it differs in rounding alone"
            at_once = Answer(status="passed")
            if one.late:
                said = "the state differs only after the next reset"
                at_once = Answer(status="fault", said=said)
            return {
                "responds": Answer(status="passed", **self.said(gap, words)),
                "at once": at_once,
            }
        why = self.worlds.idle(one.name, ran=True)
        if self.floor > 0.0:
            why = f"two equal runs differ by {self.floor:.3g} spreads, and no difference is larger"
        if self.coupling.any() and not why:
            why = "no difference after a step is larger than those of bodies that do not touch"
        said = f"no number of the state differs in {len(self.actions)} control steps"
        answer = missing(why) if why else Answer(status="fault", said=said)
        return {"responds": answer, "at once": missing("nothing responds")}

    def _neighbours(self, one: AskedRange, run: PairedRun, base: PairedRun, others: Mask) -> Answer:
        if self.n == 1:
            return missing("there is one world")
        before, got = one.seen[0]
        changed = [i for i in range(self.n) if i != one.world and not _equal(got[i], before[i])]
        if changed:
            said = f"the value of world {changed[0]} became {numbers(got[changed[0]])}, too"
            return Answer(status="fault", said=said)
        return self._equality(self.gap(run, base, others), "the states of other worlds differ")

    def _repeated(self, one: AskedRange, gap: Response | None) -> Answer:
        before, wanted = one.before[one.world], one.values[one.world]
        if not (near(one.later, before) or near(one.later, wanted)):
            return Answer(status="fault", said=f"after the next reset it is {numbers(one.later)}")
        got = [after[one.world] for _, after in one.seen]
        drift = [] if one.late else [pair for pair in pairwise(got) if not _equal(*pair)]
        if drift:
            words = "{} became {} when it was set again".format(*map(numbers, drift[0]))
            return Answer(status="fault", said=words)
        return self._equality(gap, "the same again gives other states")

    def _partial(self, run: PairedRun, first: Callable[[], object]) -> Answer:
        """Reset the last world in the middle of a run."""
        if self.n == 1:
            return missing("there is one world")
        self._changed = []
        gap, found = (
            self.gap(self.run(first, self._reset_last), run, ~self._last),
            self._unchanged(),
        )
        return (
            found
            if found.status == "fault"
            else self._equality(gap, "the states of other worlds differ")
        )

    @property
    def _last(self) -> Mask:
        return np.asarray(np.arange(self.n) == self.n - 1)

    def _reset_last(self) -> None:
        """Reset the last world; values that change in others are kept."""
        old = {name: self.read(name)[:-1] for name in self.names}
        self.worlds.reset(self.seed + OTHER, self._last)
        self._changed += [n for n in self.names if not _equal(old[n], self.read(n)[:-1])]

    def _unchanged(self) -> Answer:
        """Answer whether resets of the last world left the values of the others."""
        if self._changed:
            said = f"{self._changed[0]} changed in worlds that were not reset"
            return Answer(status="fault", said=said)
        return Answer(status="passed")

    def _constants(
        self,
        found: Mapping[str, float] | None,
        remark: str,
        run: PairedRun,
        act: Callable[[], object],
    ) -> Answer:
        """Judge derived constants, by those of a fresh compilation; measure their effect."""
        if found is None:
            return missing("no model of these worlds can be compiled afresh")
        if not found:
            return Answer(status="passed", said=remark)
        worst = sorted(found.items(), key=lambda item: -item[1])
        words = f"stale: {', '.join(f'{name} ({far:.2g})' for name, far in worst)}"
        back: list[Callable[[], object] | None] = []

        def anew() -> None:
            act()
            back.append(self.worlds.refresh())

        gap = self.gap(self.run(anew), run, self.all)
        if back[0] is not None:
            back[0]()
            words += (
                "; fresh ones move the state" if gap else "; fresh ones move nothing in this run"
            )
        said = self.said(gap, words)
        said["said"] += f"; {remark}" * bool(remark)
        return Answer(status="fault", **said)

    # --- values that the environments draw at a reset -----------------------------------------

    def drawn(self, name: str, space: Distribution) -> dict[str, Answer]:
        """Answer all questions about values that are drawn at resets."""
        one, draws, seeds = AskedRange(name, space), self.worlds.draws, range(1, self.resets + 1)
        values = np.array([self._after(self.seed + OTHER * i, name) for i in seeds])
        ends = self.ends(one)
        found = judge(values.reshape(self.resets, self.n, -1), *map(np.ravel, ends), draws=draws)
        found["undo"] = missing("the environments draw their values themselves")
        again = [self._after(self.seed, name) for _ in range(2)]
        if found["second reset"].status == "passed" and not _equal(*again):
            said = "the same seed gives other values"
            found["second reset"] = Answer(status="passed", said=said)
        fix, one.before = self.worlds.keep(self.names), self.read(name)
        base, before = self.run(fix), one.before[0]

        def act() -> None:
            fix()
            self._act([one])

        if not self.can_set:
            absent = missing("these environments have no method set")
            found |= dict.fromkeys(("responds", "at once", "neighbours"), absent)
        else:
            width = NEAR * np.abs(ends[1] - ends[0])
            tried = [np.asarray(self.worlds.reference(name), dtype=np.float64)[0], *ends]
            tried = [value for value in tried if not near(value, before, width)]
            one.values = one.before.copy()
            for one.values[0] in tried:
                one.seen = []
                run = self.run(act)
                one.gap = self.response(run, base, one)
                if one.gap is not None:
                    break
            found |= self._responses(one)
            if one.gap is not None and found["in range"].status == "passed":
                said = self._flat([one], None, fix).get(name, "")
                found["in range"] = Answer(status="passed", said=said)
            found["neighbours"] = self._neighbours(one, run, base, ~self.only(one))
            if found["at once"].status == "passed":
                found["at once"] = self._first_observation(one)
        found["partial reset"] = self._partial(base, fix) if draws else missing("nothing is reset")
        self.worlds.reset(self.seed, self.all)
        fix()
        stale = self.worlds.stale(name), self.worlds.remark(name)
        found["constants"] = self._constants(*stale, base, fix)
        fix()
        return found

    def _after(self, seed: int, name: str) -> Floats:
        self.worlds.reset(seed, self.all)
        return self.read(name)

    def _first_observation(self, one: AskedRange) -> Answer:
        """Answer whether the first observation is of the values that were drawn."""
        self.worlds.reset(self.seed, self.all)
        old = self.worlds.outdated()
        self._act([one])
        new = self.worlds.outdated()
        if old is None or new is None or not old[0] or new[0] == old[0]:
            return Answer(status="passed")
        said = f"the first observation shows the values before: it differs by {old[0]:.3g}"
        return Answer(status="fault", said=said)


def _far(one: Floats, other: Floats) -> Floats:
    """Return differences; equal infinities and NaN at the same place are equal."""
    with np.errstate(invalid="ignore"):
        far = np.abs(one - other)
    far[(one == other) | (np.isnan(one) & np.isnan(other))] = 0.0
    return np.where(np.isnan(far), np.inf, far)


def _equal(one: Floats, other: Floats) -> bool:
    return np.array_equal(one, other, equal_nan=True)
