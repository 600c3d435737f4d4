"""Samples: episodes of a world or model, as a table."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of, whole_number
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.queries.episodes import Episode, Unit, as_names
from scm_world.queries.equations import Equations, System, length
from scm_world.queries.outcomes import (
    ORDERLESS,
    Outcome,
    as_numbers,
    as_outcomes,
    column,
    is_category,
    read,
)
from scm_world.queries.plans import Plan
from scm_world.queries.progress import Progress
from scm_world.queries.twins import Result, Twins
from scm_world.world.interventions import merged

STEPS = 25
"""Control steps of an episode by default: one second at 25 steps a second."""


@final
@dataclass(frozen=True)
class Setting:
    """The circumstances of episodes.

    Attributes:
        policy: Who acts; see ``rollout``.
        nature: What varies from episode to episode by itself: interventions that are drawn at the
            beginning, such as ``{"tool_block.mass": "A"}``. What is done counts more.
        steps: Control steps of an episode; as many as the task has if None.
        seed: Of the noise; episode i of one seed is the same unit in every question.
        workers: Threads; the result does not depend on how many. Where the backend steps many
            worlds in one call, and the policy does not look at the world (``"random"``,
            ``"sweep"``, ``"across"``, given actions, None), these are threads of the backend; None
            is as many as there are cores, or one in a worker process. Else None is one. On an
            backend that steps one world at a time, two or more stand for processes as soon as
            these pay; a script needs ``if __name__ == "__main__"`` then.
    """

    policy: Any = "random"
    nature: Mapping[str, Any] | None = None
    steps: int | None = STEPS
    seed: int = 0
    workers: int | None = None

    @classmethod
    def of(cls, system: System, given: Mapping[str, Any]) -> Setting:
        """Complete and check a setting: a world acts at random by default, equations with zeros."""
        for name in given:
            one_of("setting", name, [field.name for field in fields(cls)])
        defaults: dict[str, Any] = {}
        if isinstance(system, Equations):
            defaults = {"steps": STEPS if system.model.is_temporal else 0, "policy": None}
        found = cls(**{**defaults, **given})
        length(system, found.steps)
        if found.workers is not None:
            whole_number("workers", found.workers, least=1)
        return found

    def unit(
        self, world: System, do: Mapping[str, Any] | None, number: int, names: Iterable[str] = ()
    ) -> Unit:
        """Return an episode to run, with an intervention and what varies by itself."""
        nature, acts = Plan(self.nature), Plan(do)
        for name in acts:
            if name in nature and name not in acts.at_start():
                acts = acts.do({name: (*nature[name], *acts[name])})  # until then nature counts
        plan, steps = Plan(merged(world.model, nature, acts)), length(world, self.steps)
        return Unit(self.seed, number, plan, self.policy, steps, as_names(names))

    def episode(
        self, twins: Twins, world: System, do: Mapping[str, Any] | None, number: int, names: Any
    ) -> Episode:
        """Run the episode of ``unit``."""
        unit = self.unit(world, do, number, names)
        with twins.twin() as twin:
            return unit.run(twin, twins)


@final
@dataclass(frozen=True)
class Samples(Mapping[str, Floats]):
    """Outcomes of some episodes, one row for each.

    Attributes:
        columns: Values by outcome, shape (n, ...).
        numbers: Numbers of the episodes.
        seed: Seed of the noise.
        plan: What was done in each.
    """

    columns: dict[str, Floats]
    numbers: tuple[int, ...]
    seed: int
    plan: Plan

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def targets(self) -> tuple[str, ...]:
        """Which variables were intervened on: what learners from interventions ask for."""
        return tuple(self.plan)

    def matrix(self) -> tuple[Floats, tuple[str, ...]]:
        """Give all numbers as one table, shape (n, m), and the names of its columns."""
        parts, names = [], []
        for name, values in self.columns.items():
            flat = values.reshape(len(self.numbers), -1)
            parts.append(flat)
            many = flat.shape[1] > 1
            names += [f"{name}[{i}]" if many else name for i in range(flat.shape[1])]
        table = np.concatenate(parts, axis=1) if parts else np.empty((len(self.numbers), 0))
        return table, tuple(names)

    def to_csv(self, path: Path | str) -> None:
        """Write the table as CSV, and beside it what was done as JSON."""
        table, names = self.matrix()
        target = Path(path)
        with target.open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(("episode", *names))
            writer.writerows(
                (number, *map(repr, row))
                for number, row in zip(self.numbers, table.tolist(), strict=True)
            )
        beside = target.with_name(target.name.removesuffix(".csv") + ".json")
        about = {"seed": self.seed, "plan": self.plan.as_dict(), "targets": list(self.targets)}
        beside.write_text(json.dumps(about, indent=1) + "\n")


def refuse_late(plan: Plan, steps: int) -> None:
    """Refuse an intervention that would begin when the episode has ended."""
    for name, act in plan.timed():
        if (act.time.start or 0) >= max(steps, 1):
            allowed = (f"a control step before {steps}, where episodes end",)
            raise UnknownOption(f"time of an intervention on {name}", act, allowed)


def sample(
    twins: Twins,
    system: System,
    do: Mapping[str, Any] | None,
    n: int,
    outcomes: Iterable[Any],
    setting: Setting,
    *,
    first: int = 0,
    each: Sequence[Mapping[str, Any]] = (),
    progress: Progress | None = None,
) -> Samples:
    """Run episodes on twins of a system, and read outcomes off them; see ``Questions.sample``.

    Each episode may have further interventions of its own (``each``).
    """
    count, first = whole_number("n", n, least=1), whole_number("first", first, least=0)
    wanted = as_outcomes(outcomes)
    for one in wanted:
        if is_category(system, one) and one.how not in ORDERLESS:
            raise UnknownOption(f"summary of the categories of {one.name!r}", one.how, ORDERLESS)
    names = tuple(dict.fromkeys(one.name for one in wanted if isinstance(one, Outcome)))
    unit = setting.unit(system, do, first, names)
    refuse_late(Plan(do), unit.steps)
    units = [replace(unit, number=number) for number in range(first, first + count)]
    if each:
        units = [replace(u, plan=u.plan.do(more)) for u, more in zip(units, each, strict=True)]
    told = 0

    def finish(place: int, result: Result) -> list[Floats]:
        nonlocal told
        if isinstance(result, Exception):
            raise result
        row = [read(outcome, result) for outcome in wanted]
        told += 1
        if progress is not None:
            progress(told, count)
        return row

    if twins.model is not None and all(isinstance(one, Outcome) for one in wanted):
        vectors = twins.paths(units)
        read_off = (one.of_many(twins.model.read(one.name, vectors)) for one in wanted)
        found = [as_numbers(v, one) for v, one in zip(read_off, wanted, strict=True)]
        if progress is not None:
            progress(count, count)
    else:
        rows = twins.run(units, finish, setting.workers)
        try:
            found = [np.array([row[i] for row in rows]) for i in range(len(wanted))]
        except ValueError:
            allowed = ("numbers of one shape in every episode",)
            raise UnknownOption("value of an outcome", "of several shapes", allowed) from None
    columns: dict[str, Floats] = {}
    for outcome, values in zip(wanted, found, strict=True):
        name = text = column(outcome)
        number = 1
        while name in columns:
            number += 1
            name = f"{text} ({number})"
        columns[name] = values
    return Samples(columns, tuple(unit.number for unit in units), setting.seed, Plan(do))
