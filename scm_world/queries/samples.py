"""Outcomes of episodes, tables of them, and effects with confidence intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeGuard, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scm_world._arguments import one_of, typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats, Integers, Value
from scm_world.errors import UnknownOption, UnknownVariable, blamed
from scm_world.graph import SCM, flatten
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.plans import Plan
from scm_world.variables.spaces import Frozen
from scm_world.world import CausalSystem

if TYPE_CHECKING:
    import pandas as pd

    from scm_world.policies.scripted import AnyPolicy
    from scm_world.queries.together import EpisodeBatch
    from scm_world.world.compiled_task import Vectors

CONFIDENCE = 0.95
FEW = 20  # fewer units do not reveal the skewness of their distribution

STEPS = 25
"""Default number of control steps of an episode: one second at 25 Hz."""


ORDERLESS = ("final", "first", "path")
"""The summaries that are defined for categories."""
HOWS = ("final", "mean", "max", "min", "sum", "first", "change", "path")


@final
class Outcome(Frozen):
    """A number, or an array of numbers, computed from a variable of an episode.

    Attributes:
        name: Name of the variable.
        how: Summary over the instants after the first action: the ``"final"`` value, ``"mean"``,
            ``"max"``, ``"min"`` or ``"sum"``; or the ``"first"`` value at the beginning, the
            ``"change"`` from the beginning to the end, or the ``"path"``: the values at all
            instants, as the rows of ``Episode``. Summaries of a command are over all commands. In
            episodes of one instant, all summaries use that instant.
        component: Index of a component; all components if None.

    Example:
        >>> Outcome("reward", "sum")
        Outcome(name='reward', how='sum', component=None)
    """

    name: str
    how: Literal["final", "mean", "max", "min", "sum", "first", "change", "path"] = "final"
    component: int | None = None

    def __init__(self, name: str, how: str = "final", component: int | None = None) -> None:
        one_of("outcome", how, HOWS)
        super().__init__(name=name, how=how, component=component)

    def of(self, episode: Episode) -> Floats:
        """Compute the outcome of an episode."""
        if not isinstance(episode, Episode):
            raise UnknownOption("episode", episode, ("an Episode, such as that of a rollout",))
        decided = self.name in episode.eras[0].compiled.decided
        return np.asarray(self._of_many(np.asarray(episode[self.name])[None], decided)[0])

    def of_each(self, episodes: EpisodeBatch) -> Floats:
        """Compute the outcome of episodes that are read together, shape (n, ...)."""
        compiled = episodes.compiled
        return self._of_many(episodes.read(self.name), self.name in compiled.decided)

    def _of_many(self, values: Value, decided: bool = False) -> Floats:
        """Compute the outcome from values of shape (n, instants, *shape); return shape (n, ...).

        Values that are ``decided`` belong to control steps, of which the last instant has none.
        """
        values = np.asarray(values, dtype=np.float64)
        n, instants = values.shape[:2]
        if self.component is not None:
            flat = values.reshape(n, instants, -1)
            if not 0 <= self.component < flat.shape[2]:
                allowed = (f"0 to {flat.shape[2] - 1}",)
                raise UnknownOption(f"component of {self.name}", self.component, allowed)
            values = np.ascontiguousarray(flat[..., self.component])
        if not instants:
            raise UnknownOption("outcome", self.name, ("a variable that is there",))
        if instants > 1 and decided and self.how != "path":
            values = values[:, :-1]
        if self.how in ("mean", "max", "min", "sum"):
            later = np.ascontiguousarray(values[:, 1:] if instants > 1 and not decided else values)
            return np.asarray(getattr(later, self.how)(axis=1))
        first, last = values[:, 0], values[:, -1]
        found = {"final": last, "first": first, "change": last - first, "path": values}
        return np.asarray(found[self.how])

    def __str__(self) -> str:
        part = "" if self.component is None else f"[{self.component}]"
        return f"{self.how} {self.name}{part}"


def as_outcome(given: object) -> Outcome | Function:
    """Return an outcome; the name of a variable stands for its final value."""
    if isinstance(given, str):
        return Outcome(given)
    if isinstance(given, Outcome) or callable(given):
        return given
    allowed = ("the name of a variable", "Outcome(name, how)", "a function of the episode")
    raise UnknownOption("outcome", given, allowed)


def as_outcomes(given: object) -> list[Outcome | Function]:
    """Return a list of outcomes, also for a single one; see ``as_outcome``."""
    if isinstance(given, Iterable) and not isinstance(given, str | Outcome):
        return [as_outcome(outcome) for outcome in given]
    return [as_outcome(given)]


def named_outcomes(given: object, option: str) -> tuple[Outcome, ...]:
    """Return the different outcomes, which are those of variables; refuse functions."""
    found = dict.fromkeys(as_outcomes(given))
    for outcome in found:
        if not isinstance(outcome, Outcome):
            allowed = ("the name of a variable", "Outcome(name, how)")
            raise UnknownOption(option, outcome, allowed)
    return tuple(outcome for outcome in found if isinstance(outcome, Outcome))


def is_category(outcome: object, system: Vectors | CausalSystem) -> TypeGuard[Outcome]:
    """Return whether an outcome has categories, whose numbers have no order or mean."""
    if not isinstance(outcome, Outcome) or outcome.name not in system.model:
        return False
    return system.model.declared(outcome.name).dtype == "categorical"


def usual_outcomes(world: CausalSystem) -> tuple[str, ...]:
    """Return the names of the default outcomes.

    These are the fractional success for the robot's tasks; for other worlds all variables that are
    computed from states: readouts, outcomes, reward and success; for equations all variables.
    """
    found = world.usual_outcomes()
    if not found:
        allowed = ("names of variables, such as " + repr(next(iter(world.compiled.slices))),)
        raise UnknownOption("outcomes", None, allowed)
    return found


def read(outcome: Outcome | Function, episode: Episode) -> Floats:
    """Compute an outcome of an episode, as finite numbers."""
    if isinstance(outcome, Outcome):
        return as_numbers(outcome.of(episode), outcome)
    with blamed(f"the outcome {label(outcome)!r}"):
        value = outcome(episode)
    return as_numbers(value, outcome)


def read_each(outcome: Outcome | Function, episodes: EpisodeBatch) -> Iterable[Floats]:
    """Compute an outcome of episodes that are read together, as finite numbers of each."""
    if not isinstance(outcome, Outcome):
        return [read(outcome, episode) for episode in episodes]
    found = outcome.of_each(episodes)
    return found if np.isfinite(found).all() else [as_numbers(one, outcome) for one in found]


def as_numbers(value: object, outcome: object) -> Floats:
    """Return the value of an outcome as finite numbers; refuse other values."""
    try:
        number = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        number = np.asarray(np.nan)
    if not np.isfinite(number).all():
        wrong = value if number.size < 10 else number[~np.isfinite(number)][0]
        raise UnknownOption(f"value of the outcome {label(outcome)!r}", wrong, ("finite numbers",))
    return number


def column(outcome: object) -> str:
    """Return the name of an outcome's column; the variable's name for its final value."""
    return label(outcome).removeprefix("final ")


def label(outcome: object) -> str:
    """Return a short text for an outcome."""
    return str(outcome) if isinstance(outcome, Outcome) else getattr(outcome, "__name__", "outcome")


Function = Callable[[Episode], ArrayLike]
"""An outcome that is computed from an episode by a function of the user."""

AnyOutcome = str | Outcome | Function
"""An outcome as it may be given: the name of a variable stands for its final value."""


# --- samples ------------------------------------------------------------------------------------


@typed
@final
@dataclass(frozen=True)
class Setting:
    """Settings of episodes.

    Attributes:
        policy: The policy; see ``rollout``.
        nature: The context distribution: interventions that are drawn at the beginning of each
            episode, such as ``{"tool_block.mass": "A"}``. Interventions of a query lie above.
        steps: Number of control steps; the task's default if None.
        seed: Seed of the noise; episode i of one seed is the same unit in every query.
        workers: Number of threads, which does not change the result. If the backend steps many
            worlds in one call and the policy is open-loop (``"random"``, ``"sweep"``,
            ``"across"``, given actions, None), these are threads of the backend, and None is the
            number of cores, or one in a worker process. Otherwise None is one.
    """

    policy: AnyPolicy = "random"
    nature: Mapping[str, Any] | None = None
    steps: int | None = STEPS
    seed: int = 0
    workers: int | None = None

    def __post_init__(self) -> None:
        """Refuse a seed below 0."""
        whole_number("seed", self.seed, least=0)

    @classmethod
    def of(cls, system: CausalSystem, given: Mapping[str, Any]) -> Setting:
        """Return a checked setting; the default policy is random for worlds, idle for equations."""
        for name in given:
            one_of("setting", name, [field.name for field in fields(cls)])
        found = cls(**{**system.usual_setting(), **given}).named(system.model)
        system.length(found.steps)
        if found.workers is not None:
            whole_number("workers", found.workers, least=1)
        return found

    def named(self, model: SCM) -> Setting:
        """Return the setting with the variables that the patterns of its ``nature`` fit."""
        if self.nature is None:
            return self
        return replace(self, nature=model.named(flatten(self.nature)))

    def unit(
        self,
        world: CausalSystem,
        do: Mapping[str, Any] | None,
        number: int,
        names: Iterable[str] = (),
    ) -> Unit:
        """Return an episode to run, with an intervention and the context distribution."""
        plan, steps = Plan(do).over(self.nature, "nature"), world.length(self.steps)
        return Unit(self.seed, number, plan, self.policy, steps, as_names(names))


@final
@dataclass(frozen=True)
class Samples(Mapping[str, Floats]):
    """Outcomes of episodes, one row for each.

    Attributes:
        columns: Values by outcome, shape (n, ...).
        numbers: Numbers of the episodes.
        seed: Seed of the noise.
        plan: The intervention.
        floors: Run-to-run floors: how far apart the same outcome of equal runs was, at most, in its
            unit; by outcome, with its shape. Empty if the engine is exact: equal runs are equal.
    """

    columns: dict[str, Floats]
    numbers: tuple[int, ...]
    seed: int
    plan: Plan
    floors: Mapping[str, Floats] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Floats:
        if not isinstance(name, str) or name not in self.columns:
            raise UnknownVariable(name, self.columns)
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def frame(self) -> pd.DataFrame:
        """Return a data frame with a row for each episode, indexed by its number."""
        import pandas as pd

        found: dict[str, Floats] = {}
        for name, values in self.columns.items():
            parts = values.reshape(len(self.numbers), -1).T
            found |= {f"{name}[{i}]" if len(parts) > 1 else name: p for i, p in enumerate(parts)}
        return pd.DataFrame(found, index=pd.Index(self.numbers, name="episode"))

    def __str__(self) -> str:
        table = (
            self.frame()
            .agg(["mean", "std", "min", "max"])
            .T.to_string(max_rows=60, float_format="{:.4g}".format)
        )
        return f"{len(self.numbers):,} episodes of seed {self.seed}, {self.plan}\n{table}"


def refuse_late(plan: Plan, steps: int) -> None:
    """Refuse interventions that are later than the end of the episode."""
    for name, act in Plan(dict(plan)).timed():
        if (act.time.start or 0) >= max(steps, 1):
            allowed = (f"a control step before {steps}, where episodes end",)
            raise UnknownOption(f"time of an intervention on {name}", act, allowed)


# --- effects ------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Effect:
    """The mean difference of an outcome between two interventions.

    Attributes:
        outcome: Label of the outcome.
        mean: Mean difference, with the shape of the outcome.
        low: Lower end of the confidence interval; NaN for components that do not vary.
        high: Upper end.
        caution: Warning about an interval that is too short, judged from the sample; empty if
            there is none.
        n: Number of units; if paired, each is simulated twice.
        paired: Whether both interventions had the same noise.
        variance_ratio: Variance of an unpaired difference over that of a paired one: the factor
            by which pairing reduces the number of units for an interval of the same length.
        treated: Mean under ``do``.
        control: Mean under ``versus``.
        seed: Seed of the noise.
        engine: Name of the physics engine, or ``"equations"``.
        do: The intervention.
        versus: The intervention of the control group.
        floor: How far apart the outcome of equal runs was, at most, with its shape and in its unit;
            0 if the engine is exact. A mean up to it is no effect.
    """

    outcome: str
    mean: Floats
    low: Floats
    high: Floats
    caution: str
    n: int
    paired: bool
    variance_ratio: Floats
    treated: Floats
    control: Floats
    seed: int
    engine: str
    do: Plan
    versus: Plan
    floor: Floats = field(default_factory=lambda: np.zeros(()))

    @property
    def excludes_zero(self) -> bool:
        """Whether an effect is seen.

        That is a mean above the floor whose interval excludes zero, or by which all units differ.
        """
        clear = np.isnan(self.low) | (self.low > 0.0) | (self.high < 0.0)
        return bool(np.any(clear & (np.abs(self.mean) > self.floor)))

    @property
    def is_below_floor(self) -> bool:
        """Whether equal runs are as far apart as both interventions: the effect is not seen."""
        return bool(np.any(self.floor > 0.0) and np.all(np.abs(self.mean) <= self.floor))

    def to_json(self) -> str:
        """Return the result as JSON; plans with functions are an error, see ``Plan``."""

        def plain(value: Any) -> Any:
            if isinstance(value, Plan):
                return value.as_dict()
            if isinstance(value, str | int):
                return value
            return np.asarray(np.where(np.isfinite(value), value, None)).tolist()

        found = {one.name: plain(getattr(self, one.name)) for one in fields(self)}
        found["not_seen"] = self.is_below_floor
        about = {"format": "scm_world/effect/1", "confidence": CONFIDENCE, **found}
        return json.dumps(about, indent=1, allow_nan=False)

    def __str__(self) -> str:
        names = ("mean", "low", "high", "variance_ratio", "floor")
        mean, low, high, ratio, floor = (
            np.array2string(np.asarray(getattr(self, name)), precision=4, separator=", ")
            for name in names
        )
        ends = "" if np.isnan(self.low).all() else f" [{low}, {high}]"
        how = "paired" if self.paired else "unpaired"
        return (
            f"{self.outcome}: {mean}{ends} under {self.do} versus {self.versus}, "
            f"n = {self.n} {how}, ratio of variances unpaired : paired {ratio}"
            + (f"; equal runs are up to {floor} apart" if np.any(self.floor > 0.0) else "")
            + (": not seen" if self.is_below_floor else "")
            + (f"; {self.caution}" if self.caution else "")
        )


def difference(
    treated: Floats, control: Floats, *, paired: bool
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the mean difference of two samples, shape (n, ...), with its interval.

    The results are the mean, the ends of the interval of Student's t (NaN for components that
    vary by rounding only), and the ratio of the variances unpaired : paired. Unpaired samples may
    have different variances.

    Source:
        Welch, *The generalization of "Student's" problem when several different population
        variances are involved*, Biometrika 1947, for the degrees of freedom.
    """
    from scipy.special import stdtrit

    n = len(treated)
    first, second = treated.var(axis=0, ddof=1), control.var(axis=0, ddof=1)
    apart = first + second
    together = (treated - control).var(axis=0, ddof=1)
    mean = treated.mean(axis=0) - control.mean(axis=0)
    spread = together if paired else apart
    with np.errstate(divide="ignore", invalid="ignore"):
        degrees = (n - 1) * (1.0 if paired else apart**2 / (first**2 + second**2))
    reach = stdtrit(degrees, 0.5 + 0.5 * CONFIDENCE) * np.sqrt(spread / n)
    rounding = 1e-14 * np.maximum(np.abs(treated).max(axis=0), np.abs(control).max(axis=0))
    reach = np.where(np.sqrt(spread) > rounding, reach, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        varies = np.sqrt(together) > rounding
        ratio = np.where(varies, apart / together, np.where(apart > rounding**2, np.inf, 1.0))
    return mean, mean - reach, mean + reach, ratio


def caution(treated: Floats, control: Floats, *, paired: bool) -> str:
    """Return a warning if the interval of ``difference`` is too short, judged from the samples.

    An interval of Student's t needs about 25 g² units, where g is the skewness. Few units do not
    reveal the skewness of their distribution, so fewer than 20 always cause a warning.

    Source:
        Cochran, *Sampling Techniques*, 3rd edition, 1977, 2.15.
    """
    from scipy.stats import skew

    n = len(treated)
    low = np.ravel(difference(treated, control, paired=paired)[1])
    constant, samples = np.isnan(low), [treated - control] if paired else [treated, control]
    if constant.all():
        return f"nothing varies in {n} units, so there is no interval"
    tables = [np.reshape(sample, (n, -1))[:, ~constant] for sample in samples]
    varied = np.hstack([table[:, np.ptp(table, axis=0) > 0.0] for table in tables])
    skewness = float(np.abs(skew(varied, axis=0)).max())
    needed = math.ceil(25.0 * skewness**2)
    words = []
    if n < FEW:
        words.append(f"{n} units: the interval holds for approximately normal distributions")
    elif n < needed:
        words.append(f"a skewness of {skewness:.1f} needs {needed} units for such an interval")
    if constant.any():
        words.append(f"{int(constant.sum())} components do not vary and have no interval")
    return "; ".join(words)


def effect_of(
    system: CausalSystem,
    outcome: object,
    treated: Samples,
    control: Samples,
    *,
    paired: bool = True,
    rows: slice | NDArray[np.intp] = slice(None),
) -> Effect:
    """Return the effect on the first outcome of two samples, in selected units."""
    one, other = (next(iter(samples.values()))[rows] for samples in (treated, control))
    floors = [next(iter(s.floors.values()), np.zeros(one.shape[1:])) for s in (treated, control)]
    mean, low, high, ratio = difference(one, other, paired=paired)
    return Effect(
        outcome=label(as_outcome(outcome)),
        mean=mean,
        low=low,
        high=high,
        caution=caution(one, other, paired=paired),
        n=len(one),
        paired=paired,
        variance_ratio=ratio if paired else np.ones_like(np.asarray(mean)),
        treated=one.mean(axis=0),
        control=other.mean(axis=0),
        seed=treated.seed,
        engine=system.engine if system.backend is None else system.backend.name,
        do=treated.plan,
        versus=control.plan,
        floor=np.maximum(*floors),
    )


def alike(place: Floats, bins: int) -> list[Integers]:
    """Group units by mid-rank; a single unit joins the previous group."""
    values, which, counts = np.unique(place, return_inverse=True, return_counts=True)
    middle = np.cumsum(counts) - 0.5 * counts
    number = np.arange(len(values)) if len(values) <= bins else middle * bins // len(place)
    groups: list[Integers] = []
    for each in np.unique(number):
        units = np.flatnonzero(number[which.reshape(-1)] == each)
        if groups and min(len(units), len(groups[-1])) < 2:
            units = np.concatenate([groups.pop(), units])
        groups.append(units)
    return groups
