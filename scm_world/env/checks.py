"""``check``: whether declared ranges of parameters are real in many environments."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from pydantic import BaseModel, ConfigDict

from scm_world._arguments import typed, whole_number
from scm_world.backends.checkable import Checkable
from scm_world.env.answers import QUESTIONS, Answer, Status, is_pair, numbers
from scm_world.env.asking import AskedRange, Asking
from scm_world.env.batch import ScmWorldVectorEnv
from scm_world.env.ours import OurWorlds
from scm_world.errors import UnknownOption
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.queries.verification import Report, Row
from scm_world.queries.worlds import EngineWorlds, EquationWorlds
from scm_world.runs.canvas import FAINT, PALETTE, blank, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SHOWN = 3  # names in a row of a report
COLORS: Mapping[Status, str] = {"passed": PALETTE[2], "fault": PALETTE[1], "not asked": FAINT}


@final
class RangeReport(BaseModel):
    """The answers about one range.

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
        worlds: The worlds, in words.
        num_worlds: Number of worlds.
        by: ``"set"``: values are set from outside; ``"reset"``: the environments draw them.
        steps: Control steps of a run.
        resets: Number of resets after which values are read, of environments that draw them.
        seed: Seed of episodes and actions.
        floor: Noise floor, the largest difference between two equal runs, in spreads; 0 if they
            are bit-identical.
        ranges: The answers about each range.
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
        ranges = f"{len(self.ranges)} range" + "s" * (len(self.ranges) != 1)
        faults = f"{len(self.faults)} fault" + "s" * (len(self.faults) != 1)
        found = f"{faults} in {len(names)} of {ranges}" if names else f"no fault in {ranges}"
        return f"Check of {self.num_worlds} worlds of {self.worlds}: {found}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers with their meanings."""
        missing: dict[tuple[str, str], list[str]] = {}
        for name, question, said in self._with("not asked"):
            missing.setdefault((question, said), []).append(name)
        for names in missing.values():
            names[SHOWN:] = [f"and {len(names) - SHOWN} more"] if len(names) > SHOWN else []
        remarks = [(n, q, said) for n, q, said in self._with("passed") if said and q != "responds"]
        how = "values are set from outside" if self.by == "set" else "their resets draw values"
        return (
            ("how", f"{how}; {self.steps} control steps, seed {self.seed}"),
            ("noise floor, two equal runs", f"{self.floor:g} spreads"),
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
            ends = f"{numbers(one.low)} to {numbers(one.high)} {one.unit}".strip()
            words = {question: answer.status for question, answer in one.answers.items()}
            rows.append({"range": one.name, "values": ends, **words, "response": shown})
        return pd.DataFrame(rows, columns=["range", "values", *QUESTIONS, "response"])

    @styled
    def picture(self) -> Figure:
        """Draw a cell for each question about each range, and bars of the responses."""
        from matplotlib.patches import Patch
        from matplotlib.ticker import LogFormatter

        height = 0.24 * len(self.ranges) + 1.7
        figure = blank(11.0, height, layout="constrained")
        cells, bars = figure.subplots(1, 2, width_ratios=(2.2, 1.0), sharey=True)
        for row, one in enumerate(self.ranges):
            for column, question in enumerate(QUESTIONS):
                color = COLORS[one.answers[question].status]
                cells.bar(column, 0.86, 0.9, row - 0.43, color=color)
            share = one.answers["responds"].share
            if share and np.isfinite(share):
                bars.barh(row, share, 0.6, color=PALETTE[0])
        cells.set_yticks(range(len(self.ranges)), [one.name for one in self.ranges])
        cells.set_xticks(range(len(QUESTIONS)), [*QUESTIONS], rotation=30, ha="right")
        cells.grid(visible=False)
        cells.set_ylim(len(self.ranges) - 0.5, -0.5)
        bars.set_xscale("log")
        bars.xaxis.set_major_formatter("{x:g}")
        bars.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.0, 0.4)))
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

    Each range is changed in one world, in runs with equal noise and equal actions; at most one
    range less than there are worlds is changed in one run. Where anything of it is not as it should
    be, each is asked about alone. Differences
    count above the floor, which is measured first: two equal runs. Where that is zero, numbers are
    compared bit for bit. A question that cannot be asked is reported as not asked.

    Args:
        envs: Worlds, ``World(…, num_worlds=n)``; our vector environments in one process;
            Gymnasium's ``SyncVectorEnv`` of MuJoCo environments; models of ``mujoco.rollout``: a
            list of ``MjModel``, or a pair of it and an ``MjData`` or initial states; or an
            object of a subclass of ``Checkable``.
        ranges: By name: ``(low, high)``, a space or a ``Draw``; or, by the value without
            randomisation, ``Scale(Draw(0.5, 1.5))`` or ``Shift(Draw(-0.1, 0.1))``. If None, the
            spaces A of our worlds, and 0.8 to 1.2 times the usual fields of others' MuJoCo models.
        by: ``"set"`` if ranges are set from outside, ``"reset"`` if the environments themselves
            draw from them at a reset. If None, ``"reset"`` for others' MuJoCo models with declared
            ranges, and for worlds without ``set``.
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
        >>> found.title
        'Check of 2 worlds of pushing on fake: no fault in 1 range'
        >>> found.ranges[0].answers["responds"].said  # without physics
        'it acts in contacts, and on none of this run'
    """
    begun, steps = time.perf_counter(), whole_number("steps", steps, least=1)
    resets, seed = whole_number("resets", resets, least=4), whole_number("seed", seed, least=0)
    worlds = adapted_to(envs, given=ranges is not None)
    asked = Asking(worlds, seed, steps, resets)
    if by == "set" and not asked.can_set:
        raise UnknownOption("by", by, ("'reset': these environments have no method set",))
    how = by or (worlds.by if asked.can_set else "reset")
    spaces = asked.spaces(ranges)
    worlds.follows = how == "set"
    asked.measure(worlds.keep(asked.names) if how == "reset" else int)

    def tell(count: int) -> None:
        if progress is not None:
            progress(count, len(spaces))

    answers: dict[str, dict[str, Answer]] = {}
    if how == "set":
        answers = asked.set_from_outside(spaces, tell)
    else:
        for name, space in spaces.items():
            answers[name] = asked.drawn(name, space)
            tell(len(answers))
    found = []
    for name, space in spaces.items():
        low, high = (tuple(np.ravel(end).tolist()) for end in asked.ends(AskedRange(name, space)))
        here = {question: answers[name][question] for question in QUESTIONS}
        unit = worlds.unit(name)
        found.append(RangeReport(name=name, low=low, high=high, unit=unit, answers=here))
    return Check(
        worlds=worlds.title or type(worlds).__name__,
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


def adapted_to(envs: Any, *, given: bool) -> Checkable:
    """Return what answers the questions of ``check``."""
    if isinstance(envs, ScmWorldVectorEnv | EngineWorlds | EquationWorlds):
        return OurWorlds(envs)
    members = getattr(getattr(envs, "unwrapped", None), "envs", None)
    if members and all(hasattr(getattr(e, "unwrapped", None), "data") for e in members):
        from scm_world.backends.mujoco.adapters import GymnasiumModels

        return GymnasiumModels(envs, given=given)
    pair = envs if is_pair(envs) and isinstance(envs[0], list | tuple) else (envs, None)
    kinds = {type(one).__name__ for one in pair[0]} if isinstance(pair[0], list | tuple) else set()
    if kinds == {"MjModel"}:
        from scm_world.backends.mujoco.adapters import RolloutModels

        return RolloutModels(*pair)
    if isinstance(envs, Checkable):
        return envs
    allowed = (
        "World(…, num_worlds=n)",
        "a vector environment of ours in one process (workers=1)",
        "a SyncVectorEnv of MuJoCo environments",
        "a list of MjModel",
        "an object of a subclass of Checkable",
    )
    raise UnknownOption("envs", type(envs).__name__, allowed)
