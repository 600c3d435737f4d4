"""``check``: whether declared ranges of parameters are real in many environments."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, final, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from scm_world._arguments import finite_numbers, typed, whole_number
from scm_world._types import ArrayLike, Floats, Value
from scm_world.env.batch import ScmWorldVectorEnv
from scm_world.errors import InterventionError, ScmWorldError, UnknownOption
from scm_world.queries.experiments.effects import FACTOR
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.queries.verification import Report, Row
from scm_world.queries.worlds import EngineWorlds, EquationWorlds
from scm_world.runs.canvas import FAINT, PALETTE, blank, styled
from scm_world.variables import Box, Draw, Scale, Shift
from scm_world.variables.distributions import Distribution
from scm_world.world.batch import Mask
from scm_world.world.simulation import READ_BACK

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

QUESTIONS: Mapping[str, str] = {
    "applied": "The engine has the value that was set; or values differ after resets.",
    "in range": "Both ends are taken over; or no value lies outside, or is cut to an end.",
    "responds": "The state differs from that of an equal run with another value.",
    "at once": "It differs in this episode, not only after the next reset.",
    "neighbours": "Values and states of the other worlds do not change.",
    "second reset": "Doing it again gives the same; values do not drift from reset to reset.",
    "undo": "The old value gives the old states.",
    "partial reset": "A reset of one world leaves the others as they are.",
    "constants": "Constants derived from the value are those of a fresh compilation.",
}
"""The questions about each range, and what it means that one is passed."""

TARGETS = (1.0 - 1e-12, 0.0, 0.75, 0.25, 0.5, 0.9, 0.1)  # places in a range, tried in this order
NEAR = 0.05  # share of a range: a value nearer than this is not another one
UNDONE = 1e-6  # share of an effect that an undo may leave: rounding
ROUNDING = 1e-9  # share of the spread of a number that an effect in rounding has
DRIFT = 0.5  # correlation of values of consecutive resets from which on they depend on one another
OTHER = 1_000  # offset of the seed of a partial reset
Status = Literal["passed", "fault", "not asked"]
COLORS: Mapping[Status, str] = {"passed": PALETTE[2], "fault": PALETTE[1], "not asked": FAINT}


@runtime_checkable
class Checkable(Protocol):
    """What ``check`` asks of many environments: five methods and two numbers.

    Masks have shape (n,), bool. Actions lie in [-1, 1], shape (n, n_actions). There may be more:
    ``set(name, values, mask)`` writes values of shape (n, …) in the worlds of a mask, now;
    ``reference(name)``: values without randomisation, shape (n, …); ``columns()``: name and unit of
    each number of ``observe``; ``unit(name)``; ``stale(name)``: derived constants that are not those
    of a fresh compilation, each with its relative difference; ``refresh()``: derives them anew, and
    returns a function that undoes this. A question that needs a missing one is not asked.

    Attributes:
        num_envs: Number of worlds n.
        n_actions: Number of actions.
    """

    num_envs: int
    n_actions: int

    def get(self, name: str) -> ArrayLike:
        """Read a parameter in the engine of each world, shape (n, …)."""

    def reset(self, seed: int, mask: Mask) -> object:
        """Begin episodes in the worlds of a mask; world i has the seed ``seed + i``."""

    def step(self, actions: Floats) -> ArrayLike | None:
        """Advance all worlds; return which ended an episode, shape (n,), or None."""

    def observe(self) -> ArrayLike:
        """Return the states of all worlds, shape (n, k)."""


@final
class Answer(BaseModel):
    """The answer to one question about one range.

    Attributes:
        status: ``"passed"``, ``"fault"``, or ``"not asked"``.
        said: What was found, or why it was not asked.
        size: The largest difference in the state, in ``unit``, if it was measured.
        unit: Its unit.
        share: The same in spreads of this number in a run without a change.
    """

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

    status: Status
    said: str = ""
    size: float | None = None
    unit: str = ""
    share: float | None = None


@final
class RangeReport(BaseModel):
    """What was found about one range.

    Attributes:
        name: The parameter.
        low: Lowest value that was tried or declared, flattened.
        high: Highest value.
        unit: Its unit.
        answers: By question; see ``QUESTIONS``.
    """

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    unit: str = ""
    answers: dict[str, Answer]


@final
class Check(Report):
    """Whether declared ranges are real.

    Attributes:
        format: Format of the file.
        worlds: What was checked.
        num_worlds: Number of worlds.
        by: ``"set"``: values are set from outside; ``"reset"``: the environments draw them.
        steps: Control steps of a run.
        resets: Number of resets after which values are read, of environments that draw them.
        seed: Seed of episodes and actions.
        floor: Largest difference between two equal runs, in spreads; 0 where they are bit-identical.
        ranges: What was found about each range.
        seconds: Wall time.
        versions: Versions that determine the result.
    """

    format: Literal["scm_world/check/1"] = "scm_world/check/1"
    worlds: str
    num_worlds: int
    by: Literal["set", "reset"]
    steps: int
    resets: int
    seed: int
    floor: float
    ranges: tuple[RangeReport, ...]
    seconds: float
    versions: dict[str, str]

    @property
    def faults(self) -> tuple[tuple[str, str, str], ...]:
        """Range, question and finding of each fault."""
        return self._with("fault")

    def _with(self, status: Status) -> tuple[tuple[str, str, str], ...]:
        each = ((one.name, q, answer) for one in self.ranges for q, answer in one.answers.items())
        return tuple((n, q, answer.said) for n, q, answer in each if answer.status == status)

    @property
    def title(self) -> str:
        """The first line of the report."""
        names = [*dict.fromkeys(name for name, _, _ in self.faults)]
        found = f"no fault in {len(self.ranges)} ranges"
        if names:
            found = f"{len(self.faults)} faults in {len(names)} of {len(self.ranges)} ranges"
        return f"Check of {self.num_worlds} worlds of {self.worlds}: {found}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers with their meanings."""
        missing: dict[tuple[str, str], list[str]] = {}
        for name, question, said in self._with("not asked"):
            missing.setdefault((question, said), []).append(name)
        remarks = [(n, q, said) for n, q, said in self._with("passed") if said and q != "responds"]
        how = "values are set from outside" if self.by == "set" else "their resets draw values"
        return (
            ("how", f"{how}; {self.steps} control steps, seed {self.seed}"),
            ("floor, two equal runs", f"{self.floor:g} spreads"),
            ("faults", "\n".join(f"{n}, {q}: {said}" for n, q, said in self.faults) or "none"),
            ("remarks", "\n".join(f"{n}, {q}: {said}" for n, q, said in remarks) or "none"),
            (
                "not asked",
                "\n".join(f"{q}: {said}: {', '.join(n)}" for (q, said), n in missing.items())
                or "none",
            ),
            ("seconds", f"{self.seconds:.1f}"),
        )

    @property
    def table(self) -> pd.DataFrame:
        """A row for each range: the status of each question, and the size of the response."""
        import pandas as pd

        rows = []
        for one in self.ranges:
            size = one.answers["responds"]
            shown = "" if size.size is None else f"{size.size:.3g} {size.unit}".strip()
            ends = f"{_numbers(one.low)} to {_numbers(one.high)} {one.unit}".strip()
            words = {question: answer.status for question, answer in one.answers.items()}
            rows.append({"range": one.name, "values": ends, **words, "response": shown})
        return pd.DataFrame(rows, columns=["range", "values", *QUESTIONS, "response"])

    @styled
    def picture(self) -> Figure:
        """Draw a cell for each question about each range, and bars of the responses."""
        from matplotlib.patches import Patch

        height = 0.24 * len(self.ranges) + 1.7
        figure = blank(11.0, height, layout="constrained")
        cells, bars = figure.subplots(1, 2, width_ratios=(2.2, 1.0), sharey=True)
        for row, one in enumerate(self.ranges):
            for column, question in enumerate(QUESTIONS):
                color = COLORS[one.answers[question].status]
                cells.bar(column, 0.86, 0.9, row - 0.43, color=color)
            share = one.answers["responds"].share
            if share:
                bars.barh(row, share, 0.6, color=PALETTE[0])
        cells.set_yticks(range(len(self.ranges)), [one.name for one in self.ranges])
        cells.set_xticks(range(len(QUESTIONS)), [*QUESTIONS], rotation=30, ha="right")
        cells.grid(visible=False)
        cells.set_ylim(len(self.ranges) - 0.5, -0.5)
        bars.set_xscale("log")
        bars.set_xlabel("response, in spreads of the state that responds most")
        figure.suptitle(self.title, size=11, weight="bold")
        handles = [Patch(color=color, label=status) for status, color in COLORS.items()]
        figure.legend(handles=handles, ncols=3, loc="outside lower left")
        return figure


@typed
def check(
    envs: object,
    ranges: Mapping[str, Any] | None = None,
    *,
    by: Literal["set", "reset"] | None = None,
    steps: int = 25,
    resets: int = 50,
    seed: int = 0,
    progress: Progress | None = None,
) -> Check:
    """Check whether declared ranges of parameters are real in many environments.

    Each range is changed in one world, in runs with equal noise and equal actions. Differences
    count above the floor, which is measured first: two equal runs. Where that is zero, numbers are
    compared bit for bit. A question that cannot be asked is reported as not asked.

    Args:
        envs: Worlds, ``World(…, num_worlds=n)``; our vector environments in one process;
            Gymnasium's ``SyncVectorEnv`` of MuJoCo environments; models of ``mujoco.rollout``: a
            list of ``MjModel``, or a pair of it and an ``MjData`` or initial states; or any object
            with the methods of ``Checkable``.
        ranges: By name: ``(low, high)``, a space or a ``Draw``; or, by the value without
            randomisation, ``Scale(Draw(0.5, 1.5))`` or ``Shift(Draw(-0.1, 0.1))``. If None, the
            spaces A of our worlds, and 0.8 to 1.2 times the usual fields of others' MuJoCo models.
        by: ``"set"`` if ranges are set from outside, ``"reset"`` if the environments themselves
            draw from them at a reset. If None, ``"reset"`` for others' MuJoCo models with declared
            ranges, and for what has no ``set``.
        steps: Control steps of a run.
        resets: Number of resets after which values are read, if environments draw them.
        seed: Seed of episodes and actions.
        progress: Called with (finished, planned) after each range.

    Returns:
        The report; it has ``faults``, a ``table``, a ``picture()`` and ``to_json()``. The worlds
        are reset; their values are those from before, as far as they can be set.

    Raises:
        UnknownOption: These are no environments that can be asked, a range does not exist, or an
            option has a wrong value.

    Example:
        >>> import scm_world as sw
        >>> worlds = sw.World("pushing", backend="fake", num_worlds=2)
        >>> found = check(worlds, {"tool_block.mass": (0.02, 0.04)}, steps=2)
        >>> found.faults[0]  # without physics nothing moves
        ('tool_block.mass', 'responds', 'no number of the state differs in 2 control steps')
    """
    begun, steps = time.perf_counter(), whole_number("steps", steps, least=1)
    resets, seed = whole_number("resets", resets, least=4), whole_number("seed", seed, least=0)
    worlds = _adapted(envs, given=ranges is not None)
    usual = "set" if hasattr(worlds, "set") else "reset"
    how = by or getattr(worlds, "by", usual)
    if how == "set" and usual == "reset":
        raise UnknownOption("by", by, ("'reset': these environments have no method set",))
    asked = _Asking(worlds, seed, steps, resets)
    spaces = asked.spaces(ranges)
    found = []
    for number, (name, space) in enumerate(spaces.items()):
        answers = asked.set_from_outside(name, space) if how == "set" else asked.drawn(name, space)
        low, high = (np.ravel(asked.value(space, name, u)) for u in (0.0, TARGETS[0]))
        found.append(
            RangeReport(
                name=name,
                low=tuple(low.tolist()),
                high=tuple(high.tolist()),
                unit=asked.unit(name),
                answers={question: answers[question] for question in QUESTIONS},
            )
        )
        if progress is not None:
            progress(number + 1, len(spaces))
    return Check(
        worlds=getattr(worlds, "title", type(getattr(worlds, "envs", envs)).__name__),
        num_worlds=worlds.num_envs,
        by=how,
        steps=steps,
        resets=resets if how == "reset" else 0,
        seed=seed,
        floor=asked.floor,
        ranges=tuple(found),
        seconds=time.perf_counter() - begun,
        versions=versions(),
    )


# --- questions ------------------------------------------------------------------------------------


class _Run(NamedTuple):
    """States of a run, shape (steps + 1, n, k), and in which episodes had not ended."""

    states: Floats
    alive: NDArray[np.bool_]


class _Gap(NamedTuple):
    """The largest difference between runs: in spreads, and in the unit of a column."""

    share: float = 0.0
    size: float = 0.0
    column: int = 0
    step: int = 0


class _Asking:
    """Asks worlds all questions about one range after another."""

    def __init__(self, worlds: Any, seed: int, steps: int, resets: int) -> None:
        self.worlds, self.seed, self.resets, self.n = worlds, seed, resets, worlds.num_envs
        self.all, self.only = np.ones(self.n, bool), np.arange(self.n) == 0
        rng = np.random.default_rng(seed)
        self.actions = rng.uniform(-1.0, 1.0, (steps, self.n, worlds.n_actions))
        self.can_set, self.floor = hasattr(worlds, "set"), 0.0
        self.limit: Any = None
        self.spread: Floats = np.ones(0)
        if not getattr(worlds, "has_steps", True):
            self.actions = self.actions[:0]
        self.names: tuple[str, ...] = ()

    def spaces(self, given: Mapping[str, Any] | None) -> dict[str, Distribution]:
        """Return the declared ranges as spaces; all values are read once."""
        if given is None and not hasattr(self.worlds, "usual"):
            raise UnknownOption("ranges", None, ("a range for each name: there are no usual ones",))
        if given is not None and not given:
            raise UnknownOption("ranges", given, ("one range or more",))
        self.worlds.reset(self.seed, self.all)
        expanded = self.worlds.usual() if given is None else given
        if hasattr(self.worlds, "named"):
            expanded = self.worlds.named(expanded)
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
        relative = isinstance(given, Scale | Shift)
        ends = given.by if relative else given
        if isinstance(ends, Draw):
            ends = self.worlds.space(name, ends) if hasattr(self.worlds, "space") else ends.source
        if hasattr(ends, "transform") and not relative:
            return ends
        if isinstance(ends, Box):
            ends = ends.low, ends.high
        pair = [finite_numbers(end) for end in ends] if _is_pair(ends) else []
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
        return _at(space, u, shape, values)

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

    def run(self, first: Callable[[], object] = int, middle: Callable[[], object] = int) -> _Run:
        """Run equal episodes, with what is done after their reset, and in the middle of them."""
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
        return _Run(np.array(states), np.array(alive))

    def _observed(self) -> Floats:
        return np.array(self.worlds.observe(), dtype=np.float64).reshape(self.n, -1)

    def base(self, first: Callable[[], object] = int) -> _Run:
        """Run without a change; the first time twice, to measure the floor."""
        one = self.run(first)
        if self.limit is None:
            with np.errstate(invalid="ignore"):
                kept = one.states[one.alive]
                spread = kept.std(axis=0)
                size = np.abs(kept).max(axis=0)
            self.spread = np.where(spread > 0.0, spread, np.where(size > 0.0, size, 1.0))
            other = self.run(first)
            far = np.where(
                (one.alive & other.alive)[..., None], _far(one.states, other.states), 0.0
            )
            self.limit = FACTOR * far.max(axis=(0, 1))
            self.floor = float((self.limit / self.spread).max(initial=0.0)) / FACTOR
        return one

    def gap(self, one: _Run, other: _Run, rows: Mask, name: str = "") -> _Gap | None:
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
        return _Gap(float(share.max()), float(sizes[column]), column, step)

    @property
    def columns(self) -> list[tuple[str, str]]:
        """Name and unit of each number of a state."""
        given = getattr(self.worlds, "columns", None)
        return (
            [(f"observation[{i}]", "") for i in range(self.spread.size)]
            if given is None
            else given()
        )

    def said(self, gap: _Gap | None, words: str) -> dict[str, Any]:
        """Return the text and the numbers of a difference in the state."""
        if gap is None:
            return {"said": words}
        name, unit = self.columns[gap.column]
        found = f"{words}: {gap.size:.3g} {unit} of {name}, from step {gap.step} on"
        found = found.replace("  ", " ")
        return {"said": found, "size": gap.size, "unit": unit, "share": gap.share}

    # --- values that are set from outside -----------------------------------------------------

    def set_from_outside(self, name: str, space: Distribution) -> dict[str, Answer]:
        """Answer all questions by setting a value in world 0."""
        base, worlds = self.base(), self.worlds
        worlds.reset(self.seed, self.all)
        before, values, why = self.read(name), self.read(name), ""
        for u in TARGETS:
            values[0] = self.value(space, name, u)
            if _near(values[0], before[0], NEAR * self._width(space, name)):
                continue
            try:
                self.write(name, values, self.only)
                self.write(name, before, self.only)
                worlds.reset(self.seed, self.all)  # where values act after a reset alone
                break
            except InterventionError as error:
                why = f"every value that was tried was refused, the last one because {error}"
            except ScmWorldError as error:
                return {
                    **_none("it is not applied"),
                    "applied": Answer(status="fault", said=str(error)),
                }
        else:
            return _none(why or "no other value lies in the range")
        got: list[Floats] = []

        def act() -> None:
            self.write(name, values, self.only)
            got.append(self.read(name))

        one = self.run(act)
        wanted, found = values[0], dict[str, Answer]()
        worlds.reset(self.seed, self.all)
        later, late = self.read(name), False
        if not np.array_equal(got[0][0], before[0]):
            found["applied"] = Answer(status="passed")
        elif _near(later[0], wanted):
            late, found["applied"] = True, Answer(status="passed", said="after the next reset")
        else:
            said = f"{_numbers(wanted)} was set, and the engine still has {_numbers(before[0])}"
            found["applied"] = Answer(status="fault", said=said)
        found["in range"] = self._taken(name, space, before, late)
        gap = self.gap(one, base, self.only, name)
        if gap is None:
            again = self.run()
            gap = self.gap(again, base, self.only, name)
            late = late or gap is not None
        found |= self._responses(name, gap, late)
        found["neighbours"] = self._neighbours(one, base, got[0], before)
        if not (_near(later[0], before[0]) or _near(later[0], wanted)):
            said = f"after the next reset it is {_numbers(later[0])}"
            found["second reset"] = Answer(status="fault", said=said)
        else:
            found["second reset"] = self._repeated(act, one, got, late)
        found["partial reset"] = self._partial(one, act)

        def undone() -> None:
            self.write(name, values, self.only)
            self.write(name, before, self.only)

        left = None if late else self.gap(self.run(undone), base, self.all, name)
        found["undo"] = Answer(status="passed")
        if late:
            found["undo"] = Answer(status="not asked", said="it acts only after the next reset")
        elif left is not None and gap is not None and left.share <= UNDONE * gap.share:
            found["undo"] = Answer(status="passed", **self.said(left, "rounding is left"))
        elif left is not None:
            found["undo"] = Answer(
                status="fault", **self.said(left, "the old value leaves an effect")
            )
        found["constants"] = self._constants(name, one, act)
        worlds.reset(self.seed, self.all)
        self.write(name, before)
        worlds.reset(self.seed, self.all)
        return found

    def _width(self, space: Distribution, name: str) -> Floats:
        ends = (self.value(space, name, u) for u in (0.0, TARGETS[0]))
        low, high = ends
        return np.abs(high - low)

    def _taken(self, name: str, space: Distribution, before: Floats, late: bool) -> Answer:
        """Set both ends of a range, and read them back.

        What is not read back is tried again beside the end: polar coordinates of a centre, for
        example, have no angle.
        """
        tried, values = 0, before.copy()
        for end, beside in ((0.0, 0.02), (TARGETS[0], 0.98)):
            for u in (end, beside):
                self.worlds.reset(self.seed, self.all)
                values[0] = self.value(space, name, u)
                try:
                    self.write(name, values, self.only)
                except ScmWorldError:  # such as an overlap
                    break
                if late:
                    self.worlds.reset(self.seed, self.all)
                tried, got = tried + 1, self.read(name)[0]
                if _near(got, values[0]) or np.array_equal(got, before[0]):
                    break
            else:
                said = f"{_numbers(values[0])} was set, and the engine has {_numbers(got)}"
                return Answer(status="fault", said=said)
        return Answer(status="passed") if tried else _not("both ends were refused")

    def _responses(self, name: str, gap: _Gap | None, late: bool) -> dict[str, Answer]:
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
        why = self.worlds.why(name) if hasattr(self.worlds, "why") else ""
        if self.floor > 0.0:
            why = f"two equal runs differ by {self.floor:.3g} spreads, and no difference is larger"
        said = f"no number of the state differs in {len(self.actions)} control steps"
        answer = _not(why) if why else Answer(status="fault", said=said)
        return {"responds": answer, "at once": _not("nothing responds")}

    def _neighbours(self, one: _Run, base: _Run, got: Floats, before: Floats) -> Answer:
        if self.n == 1:
            return _not("there is one world")
        changed = [i for i in range(1, self.n) if not _equal(got[i], before[i])]
        if changed:
            said = f"the value of world {changed[0]} became {_numbers(got[changed[0]])}, too"
            return Answer(status="fault", said=said)
        gap = self.gap(one, base, ~self.only)
        if gap is None:
            return Answer(status="passed")
        return Answer(status="fault", **self.said(gap, "the states of other worlds differ"))

    def _repeated(
        self, act: Callable[[], None], one: _Run, got: list[Floats], late: bool
    ) -> Answer:
        for _ in range(1 + late):
            before, one = one, self.run(act)
        if not _equal(got[-1], got[-2]) and not late:
            words = f"{_numbers(got[-2][0])} became {_numbers(got[-1][0])} when it was set again"
            return Answer(status="fault", said=words)
        gap = self.gap(one, before, self.all)
        if gap is None:
            return Answer(status="passed")
        return Answer(status="fault", **self.said(gap, "the same again gives other states"))

    def _partial(self, one: _Run, first: Callable[[], object]) -> Answer:
        """Reset the last world in the middle of a run."""
        if self.n == 1:
            return _not("there is one world")
        last, kept = np.arange(self.n) == self.n - 1, dict[str, tuple[Floats, Floats]]()

        def reset() -> None:
            old = {name: self.read(name) for name in self.names}
            self.worlds.reset(self.seed + OTHER, last)
            kept.update({name: (old[name], self.read(name)) for name in self.names})

        gap = self.gap(self.run(first, reset), one, ~last)
        for name, (old, new) in kept.items():
            if not _equal(old[:-1], new[:-1]):
                return Answer(status="fault", said=f"{name} changed in worlds that were not reset")
        if gap is None:
            return Answer(status="passed")
        return Answer(status="fault", **self.said(gap, "the states of other worlds differ"))

    def _constants(self, name: str, one: _Run, act: Callable[[], object]) -> Answer:
        """Compare derived constants with a fresh compilation; measure what they do."""
        if not hasattr(self.worlds, "stale"):
            return _not("no model of these worlds can be compiled afresh")
        self.worlds.reset(self.seed, self.all)
        act()
        found = self.worlds.stale(name)
        if found is None:
            return _not("this engine has no model that can be compiled afresh")
        remark = self.worlds.remark(name) if hasattr(self.worlds, "remark") else ""
        if not found:
            return Answer(status="passed", said=remark)
        worst = sorted(found.items(), key=lambda item: -item[1])
        words = f"stale: {', '.join(f'{field} ({far:.2g})' for field, far in worst)}"
        back: list[Callable[[], None]] = []
        gap = None
        if hasattr(self.worlds, "refresh"):
            fresh = self.run(lambda: (act(), back.append(self.worlds.refresh())))
            gap = self.gap(fresh, one, self.all)
            back[0]()
        said = (
            {"said": words}
            if gap is None
            else self.said(gap, f"{words}; fresh ones move the state")
        )
        said["said"] += f"; {remark}" * bool(remark)
        return Answer(status="fault", **said)

    # --- values that the environments draw at a reset -----------------------------------------

    def drawn(self, name: str, space: Distribution) -> dict[str, Answer]:
        """Answer all questions about values that are drawn at resets."""
        draws, seeds = getattr(self.worlds, "draws", True), range(1, self.resets + 1)
        values = np.array([self._after(self.seed + OTHER * i, name) for i in seeds])
        found = self._varied(name, space, values.reshape(self.resets, self.n, -1), draws=draws)
        found["undo"] = _not("the environments draw their values themselves")
        again = [self._after(self.seed, name) for _ in range(2)]
        if found["second reset"].status == "passed" and not _equal(*again):
            said = "the same seed gives other values"
            found["second reset"] = Answer(status="passed", said=said)
        kept = {one: self.read(one) for one in self.names}

        def fix() -> None:
            for one, value in kept.items() if self.can_set else ():
                self.write(one, value)

        base, before = self.base(fix), kept[name]
        if not self.can_set:
            missing = _not("these environments have no method set")
            found |= dict.fromkeys(("responds", "at once", "neighbours"), missing)
        else:
            ends = [self.value(space, name, u) for u in (0.0, TARGETS[0])]
            width = NEAR * np.abs(ends[1] - ends[0])
            tried = [self._reference(name, before)[0], *ends]
            other = before.copy()
            other[0] = next(one for one in tried if not _near(one, before[0], width))
            got: list[Floats] = []

            def act() -> None:
                fix()
                self.write(name, other, self.only)
                got.append(self.read(name))

            one = self.run(act)
            found |= self._responses(name, self.gap(one, base, self.only, name), late=False)
            found["neighbours"] = self._neighbours(one, base, got[0], before)
            if found["at once"].status == "passed" and hasattr(self.worlds, "outdated"):
                found["at once"] = self._first_observation(name, other)
        found["partial reset"] = self._partial(base, fix) if draws else _not("nothing is reset")
        found["constants"] = self._constants(name, base, fix)
        fix()
        return found

    def _after(self, seed: int, name: str) -> Floats:
        self.worlds.reset(seed, self.all)
        return self.read(name)

    def _varied(
        self, name: str, space: Distribution, values: Floats, *, draws: bool
    ) -> dict[str, Answer]:
        """Judge the values after resets, shape (resets, n, k)."""
        found: dict[str, Answer] = {}
        low, high = (np.ravel(self.value(space, name, u)) for u in (0.0, TARGETS[0]))
        wide = high > low
        resets, worlds = (values != values[:1]).any(axis=(0, 1)), (values != values[:, :1])
        moved = resets | worlds.any(axis=(0, 1))
        first, last = (_numbers(row[0][wide]) for row in (values[0], values[-1]))
        shown = f"{first} after each of {self.resets} resets in every world"
        passed = Answer(status="passed")
        share = np.ptp(values, axis=(0, 1))[wide] / (high - low)[wide]
        found["applied"] = Answer(
            status="passed", said=f"{min(1.0, share.min()):.0%} of the range was seen"
        )
        if not moved[wide].any():
            found["applied"] = Answer(status="fault", said=f"it is {shown}")
        elif not moved[wide].all():
            said = f"{(~moved & wide).sum()} of {wide.sum()} numbers never vary"
            found["applied"] = Answer(status="fault", said=said)
        elif not resets.any():
            found["applied"] = Answer(status="passed", said="drawn once, not at a reset" * draws)
        elif self.n > 1 and not worlds.any():
            said = "all worlds have the same value after each reset"
            found["applied"] = Answer(status="fault", said=said)
        room = ROUNDING * np.maximum(np.abs(low), np.abs(high))
        outside = ((values < low - room) | (values > high + room))[..., wide]
        cut = [c for c in np.flatnonzero(wide).tolist() if _is_cut(values[..., c])]
        found["in range"] = passed
        if outside.any():
            worst = f"{_numbers(values[..., wide].min())} to {_numbers(values[..., wide].max())}"
            said = f"{outside.mean():.0%} of the values lie outside; they go from {worst}"
            found["in range"] = Answer(status="fault", said=said)
        elif cut:
            ends = values[..., cut[0]]
            said = f"values are cut off at {_numbers(ends.min())} and {_numbers(ends.max())}"
            found["in range"] = Answer(status="fault", said=said)
        found["second reset"] = _not("no value is drawn at a reset")
        if resets.any():
            link = max(_link(values[..., c]) for c in np.flatnonzero(wide & resets).tolist() or [0])
            found["second reset"] = passed
            if link > max(DRIFT, 5.0 / np.sqrt(self.n * self.resets)):
                said = f"each value follows from the last one (correlation {link:.2f})"
                said += f": after {self.resets} resets {first} has become {last}"
                found["second reset"] = Answer(status="fault", said=said)
        return found

    def _first_observation(self, name: str, other: Floats) -> Answer:
        self.worlds.reset(self.seed, self.all)
        old, before = self.worlds.outdated(), self.read(name)
        self.write(name, np.where(True, other, before), self.only)
        depends = self.worlds.outdated() != old
        if not (old and depends):
            return Answer(status="passed")
        said = f"the first observation shows the values before: it differs by {old:.3g}"
        return Answer(status="fault", said=said)


def _at(space: Distribution, u: float, shape: tuple[int, ...], values: Mapping[str, Any]) -> Floats:
    """Return the value at a place in a space, from 0 to 1 in each of its numbers."""
    uniforms = np.full((1, space.n_uniforms(shape)), u)
    return np.asarray(space.transform(uniforms, shape, values), dtype=np.float64)[0]


def _far(one: Floats, other: Floats) -> Floats:
    """Return differences; equal infinities and NaN at the same place are equal."""
    with np.errstate(invalid="ignore"):
        far = np.abs(one - other)
    far[(one == other) | (np.isnan(one) & np.isnan(other))] = 0.0
    return np.where(np.isnan(far), np.inf, far)


def _equal(one: Floats, other: Floats) -> bool:
    return np.array_equal(one, other, equal_nan=True)


def _near(one: Floats, other: Floats, room: Floats | float = 0.0) -> bool:
    return bool((np.abs(one - other) <= np.maximum(room, READ_BACK * (1e-9 + np.abs(other)))).all())


def _not(why: str) -> Answer:
    return Answer(status="not asked", said=why)


def _none(why: str) -> dict[str, Answer]:
    return dict.fromkeys(QUESTIONS, _not(why))


def _numbers(values: ArrayLike) -> str:
    flat = np.ravel(values)
    shown = dict.fromkeys(f"{x:.4g}" for x in flat[:3].tolist())
    return ", ".join(shown) + ", …" * (flat.size > 3)


def _is_pair(given: object) -> bool:
    return isinstance(given, tuple | list | np.ndarray) and len(given) == 2


def _is_cut(values: Floats) -> bool:
    """Return whether an end of the values, and no value inside, occurs again and again."""
    kinds, counts = np.unique(values, return_counts=True)
    ends = max(counts[0], counts[-1])
    return len(kinds) > 3 and bool(ends >= max(3, values.size // 50) and (counts[1:-1] == 1).all())


def _link(values: Floats) -> float:
    """Return the rank correlation of the values, shape (resets, n), of consecutive resets."""
    ranks = values.argsort(axis=0, kind="stable").argsort(axis=0).astype(float)
    ranks -= ranks.mean(axis=0)
    return float((ranks[1:] * ranks[:-1]).sum() / ((ranks**2).sum() or 1.0))


# --- our own worlds -------------------------------------------------------------------------------


class _Ours:
    """Our worlds: values are set by ``do``."""

    by = "set"

    def __init__(self, envs: Any) -> None:
        self.envs, self.is_env = envs, isinstance(envs, ScmWorldVectorEnv)
        self.one: Any = envs.envs[0].unwrapped.world if self.is_env else envs.one
        self.model, self.num_envs = self.one.model, envs.num_envs if self.is_env else len(envs)
        has_engine = self.one.backend is not None
        columns = [v for v in self.model.variables if v.name != "control_index"]
        columns = [v for v in columns if (v.is_simulated if has_engine else v.equation is not None)]
        self.read = [v.name for v in columns]
        self.has_steps, space = self.one.has_steps, self.one.action_space
        self.low, self.high = self.one.action_low, self.one.action_high
        if self.is_env:
            space = envs.single_action_space
            self.low, self.high = space.low, space.high
        self.n_actions = self.low.size
        task = getattr(self.one, "task", None)
        self.title = f"{task.name if task else 'equations'} on {self.one.engine.partition(' ')[0]}"

    def _world(self, index: int) -> Any:
        return self.envs.envs[index].unwrapped.world if self.is_env else self.envs.world(index)

    def usual(self) -> dict[str, Distribution]:
        """Return the spaces A of all variables that can be set and vary there."""
        inside = {v.name: v.a for v in self.model.variables if v.settable and v.a is not None}
        inside = {name: one for name, one in inside.items() if self.model[name].role != "action"}
        return {n: one for n, one in inside.items() if len(set(self._ends(n, one))) > 1}

    def _ends(self, name: str, space: Distribution) -> Iterator[bytes]:
        shape, values = self.model[name].shape, self.values() if space.parents() else {}
        for u in TARGETS:
            yield _at(space, u, shape, values).tobytes()

    def named(self, ranges: Mapping[str, Any]) -> dict[str, Any]:
        """Return ranges by the names of variables, which patterns stand for."""
        names = {given: [*self.model.named({given: 0.0})] for given in ranges}
        return {name: one for given, one in ranges.items() for name in names[given]}

    def space(self, name: str, act: Draw) -> Any:
        """Return the space of a draw."""
        return act.distribution(self.model.declared(name))

    def values(self) -> Mapping[str, Value]:
        """Return the present values of world 0."""
        return self._world(0).evaluate()

    def get(self, name: str) -> Floats:
        """Return what worlds have, or what their engine has if that is something else."""
        if not self.is_env:
            found = np.array(self.envs[name], dtype=np.float64)
        else:
            found = np.array([self._world(i)[name] for i in range(self.num_envs)], dtype=np.float64)
        keys = getattr(getattr(self.one, "compiled", None), "parameter_keys", {})
        if self.one.backend is not None and name in keys:
            for index in range(self.num_envs):
                engine = self._world(index).backend.parameters([keys[name]])[keys[name]]
                if not np.allclose(engine, found[index], READ_BACK, READ_BACK):
                    found[index] = engine
        return found

    def set(self, name: str, values: Floats, mask: Mask) -> None:
        """Intervene in some worlds."""
        kind = np.float64 if self.model[name].dtype == "real" else np.int64
        each = np.asarray(values).astype(kind)
        for index in np.flatnonzero(mask).tolist():
            if self.is_env:
                self.envs.do({index: {name: each[index]}})
            else:
                self.envs.do({name: each[index]}, where=np.arange(self.num_envs) == index)

    def reset(self, seed: int, mask: Mask) -> None:
        """Begin episodes in some worlds."""
        seeds = [*range(seed, seed + self.num_envs)]
        if self.is_env:
            self.envs.reset(seed=seeds, options={"reset_mask": mask})
        else:
            self.envs.reset(seed=seeds, where=mask)

    def step(self, actions: Floats) -> ArrayLike | None:
        """Advance all worlds."""
        low, high = np.maximum(self.low, -1e3), np.minimum(self.high, 1e3)
        commands = low + (actions + 1.0) / 2.0 * (high - low)
        found = self.envs.step(commands)
        return None if found is None else found[2] | found[3]

    def observe(self) -> Floats:
        """Return all numbers that the engine, or the equations, compute."""
        if not self.is_env:
            parts = [np.reshape(self.envs[name], (self.num_envs, -1)) for name in self.read]
            return np.concatenate(parts, axis=1)
        worlds = (self._world(index) for index in range(self.num_envs))
        return np.array([np.concatenate([np.ravel(w[n]) for n in self.read]) for w in worlds])

    def columns(self) -> list[tuple[str, str]]:
        """Return names and units of these numbers."""
        found = []
        for name in self.read:
            variable = self.model[name]
            size = int(np.prod(variable.shape))
            places = [f"[{i}]" for i in range(size)] if variable.shape else [""]
            unit = "" if variable.unit == "1" else variable.unit
            found += [(f"{name}{place}", unit) for place in places]
        return found

    def unit(self, name: str) -> str:
        """Return the unit of a variable."""
        unit = self.model[name].unit
        return "" if unit == "1" else unit

    def why(self, name: str) -> str:
        """Return why no response may be seen."""
        targets = self.model.targets(name)
        below = {*targets}.union(*map(self.model.descendants, targets))
        if not below & {*self.read}:
            return "as it is declared, nothing that the engine computes depends on it"
        edges = [edge for edge in self.model.edges if edge.cause == name]
        touching = (self._world(i).contacts() for i in range(self.num_envs))
        if edges and all(edge.when == "contact" for edge in edges) and not any(touching):
            return "it acts in contacts, and nothing touches"
        return ""

    def stale(self, name: str) -> dict[str, float] | None:
        """Return derived constants that are not those of a fresh compilation; None without any."""
        del name
        realization = getattr(self._world(0).backend, "realization", None)
        if realization is None:
            return None
        from scm_world.backends.mujoco.strangers import stale

        return stale(realization.model)


def _adapted(envs: Any, *, given: bool) -> Any:
    """Return what answers the questions of ``check``."""
    if isinstance(envs, ScmWorldVectorEnv | EngineWorlds | EquationWorlds):
        return _Ours(envs)
    members = getattr(getattr(envs, "unwrapped", None), "envs", None)
    if members and all(hasattr(getattr(e, "unwrapped", None), "data") for e in members):
        from scm_world.backends.mujoco.strangers import GymnasiumModels

        return GymnasiumModels(envs, given=given)
    pair = envs if _is_pair(envs) and isinstance(envs[0], list | tuple) else (envs, None)
    kinds = {type(one).__name__ for one in pair[0]} if isinstance(pair[0], list | tuple) else set()
    if kinds == {"MjModel"}:
        from scm_world.backends.mujoco.strangers import RolloutModels

        return RolloutModels(*pair)
    if isinstance(envs, Checkable) and not isinstance(envs, type):
        return envs
    allowed = (
        "World(…, num_worlds=n)",
        "a vector environment of ours in one process (workers=1)",
        "a SyncVectorEnv of MuJoCo environments",
        "a list of MjModel",
        "an object with num_envs, n_actions, get, reset, step and observe",
    )
    raise UnknownOption("envs", type(envs).__name__, allowed)
