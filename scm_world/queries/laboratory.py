"""A world with permissions, a budget and a log, for discovery algorithms and agents."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._fingerprint import changes, fingerprint
from scm_world._types import Floats
from scm_world.errors import (
    DAMAGED,
    BudgetExhausted,
    Forbidden,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.output.reading import read_text, regular
from scm_world.queries.outcomes import Outcome, column
from scm_world.queries.plans import Plan
from scm_world.queries.samples import Samples, Setting, sample
from scm_world.queries.twins import Twins, twins_of
from scm_world.variables import Contact, Fixed, Reaches
from scm_world.world import Simulation
from scm_world.world.plan import merged

FORMAT = "scm_world/laboratory/1"


@final
@dataclass(frozen=True)
class Experiment:
    """One experiment.

    Attributes:
        kind: ``"see"``, ``"do"`` or ``"counterfactual"``, after ``"refused "`` where it failed.
        samples: Interventions, units and outcomes.
        at: From which control step a counterfactual differs.
        row: Of a protocol, if it belongs to one.
    """

    kind: str
    samples: Samples
    at: int = 0
    row: int | None = None

    @property
    def episodes(self) -> int:
        """How many episodes it cost."""
        return len(self.samples.numbers)


@final
class Journal:
    """A log of experiments, in a file if there is one.

    Args:
        path: Of the file; what is in it is read.
        terms: What has to be the same in the file.
        trusted: Packages whose functions may be mechanisms of its plans.

    Raises:
        UnreadableFile: The file is no log, or one on other terms.
        UnwritableFolder: It cannot be written.
    """

    def __init__(
        self, path: Path | str | None, terms: dict[str, Any], trusted: Sequence[str] = ()
    ) -> None:
        self.path = None if path is None else Path(path)
        self._trusted = tuple(trusted)
        self._size = 0
        self.records: list[Experiment] = []
        head = json.loads(json.dumps({"format": FORMAT, **terms}))
        if self.path is None:
            return
        try:
            regular(self.path)
            written = self.path.stat().st_size
        except FileNotFoundError:
            written = 0
        except OSError as error:
            advice = "give the laboratory a file"
            raise UnreadableFile(str(path), error.strerror or str(error), advice) from None
        if written:
            self._read(self.path, head)
        else:
            self._append(head)

    @property
    def next_unit(self) -> int:
        """Number of the first episode that has not been run yet."""
        return sum(r.episodes for r in self.records if not r.kind.endswith("counterfactual"))

    def write(self, kind: str, samples: Samples, *, at: int = 0, row: int | None = None) -> None:
        """Add an experiment; it is on the disk when this returns."""
        record = Experiment(kind, samples, at, row)
        if self.path is not None:
            self._append(
                {
                    "kind": kind,
                    "at": at,
                    "row": row,
                    "units": list(samples.numbers),
                    "seed": samples.seed,
                    "plan": samples.plan.as_dict(),
                    "values": {name: values.tolist() for name, values in samples.items()},
                }
            )
        self.records.append(record)

    def refuse_others(self) -> None:
        """Refuse to continue if another laboratory has written to the file.

        Raises:
            UnreadableFile: The file is not as it was left.
        """
        if self.path is None:
            return
        size = self.path.stat().st_size if self.path.exists() else 0
        if size != self._size:
            reason = "another laboratory has written to it"
            raise UnreadableFile(str(self.path), reason, "open it again to go on with all of it")

    def _append(self, line: dict[str, Any]) -> None:
        if self.path is None:
            return
        self.refuse_others()
        try:
            with self.path.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line, allow_nan=False) + "\n")
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            said = f"{self.path.name}: {error.strerror or error}"
            raise UnwritableFolder(str(self.path.parent), said) from None
        self._size = self.path.stat().st_size

    def _read(self, path: Path, head: dict[str, Any]) -> None:
        text = read_text(path)
        whole = text[: text.rfind("\n") + 1]
        try:
            first, *lines = (json.loads(line) for line in whole.splitlines())
            other = changes(first, head)
            if other:
                reason = f"it is the log of other experiments: {', '.join(other)} differ"
                raise UnreadableFile(str(path), reason, "give the laboratory another log")
            for line in lines:
                columns = {n: np.array(values, float) for n, values in line["values"].items()}
                plan = Plan.from_dict(line["plan"], trusted=self._trusted)
                samples = Samples(columns, tuple(line["units"]), line["seed"], plan)
                self.records.append(Experiment(line["kind"], samples, line["at"], line["row"]))
        except DAMAGED as error:
            if isinstance(error, UnreadableFile):
                raise
            advice = "give the laboratory another log"
            raise UnreadableFile(str(path), f"it is no log: {error}", advice) from None
        if whole != text:  # the process was killed while it wrote
            path.write_text(whole, encoding="utf-8")
        self._size = path.stat().st_size


QUESTIONS = ("see", "do", "counterfactual")


@final
class Laboratory:
    """Experiments on a world whose graph is hidden.

    Every experiment is checked before it begins, and written to the log when it has ended; a
    laboratory that is opened with the log of an earlier one continues it.

    Args:
        world: Is not touched.
        allow: Which questions may be asked: ``"see"``, ``"do"``, ``"counterfactual"``.
        visible: Patterns of the variables that may be seen, such as ``"tool_block.*"``.
        settable: Patterns of those that may be set.
        budget: How many episodes there are in all; without end if None.
        outcomes: What an experiment reports: names of visible variables (their final values) or
            ``Outcome``; the final values of all that is visible if None.
        log: File to write to; a line of JSON for each experiment. One laboratory at a time.
        trusted: Packages whose functions may be mechanisms of a log that is continued.
        setting: ``policy``, ``nature``, ``steps``, ``seed`` and ``workers``; see ``Setting``. A
            policy that is a function has to be the same one for a log; that cannot be checked.

    Raises:
        UnknownOption: A pattern matches nothing, or a question does not exist.
        UnreadableFile: The log is one of another laboratory.

    Example:
        >>> from scm_world.queries.world import World
        >>> world = World("pushing", backend="fake")
        >>> lab = Laboratory(world, settable=["*.mass"], visible=["tool_block.*"], budget=10)
        >>> found = lab.do({"tool_block.mass": 0.05}, n=4)
        >>> found["tool_block.mass"].shape, lab.remaining
        ((4,), 6)
    """

    def __init__(
        self,
        world: Simulation,
        *,
        allow: Iterable[str] = QUESTIONS,
        visible: Iterable[str] = ("*",),
        settable: Iterable[str] = ("*",),
        budget: int | None = None,
        outcomes: Iterable[Any] | None = None,
        log: Path | str | None = None,
        trusted: Sequence[str] = (),
        **setting: Any,
    ) -> None:
        self.allow = tuple(allow)
        for question in self.allow:
            if question not in QUESTIONS:
                raise UnknownOption("question", question, QUESTIONS)
        self._world: Simulation = world
        self._twins: Twins = twins_of(world)
        self._setting = Setting(**setting)
        self._given: Plan = getattr(world, "plan", Plan())
        model = world.model
        everything = tuple(n for n in model if not isinstance(model.declared(n), Fixed))
        can_be_set = tuple(n for n in model if model.declared(model.target(n)).settable)
        self.visible = _matching("visible", visible, everything)
        self.settable = _matching("settable", settable, can_be_set)
        self.budget = None if budget is None else whole_number("budget", budget, least=0)
        wanted = self.visible if outcomes is None else tuple(outcomes)
        found = (o if isinstance(o, Outcome) else Outcome(o) for o in wanted)
        self.outcomes = tuple(dict.fromkeys(found))
        for outcome in self.outcomes:
            if outcome.name not in self.visible:
                raise Forbidden(f"see {outcome.name}", self.visible)
        self._lock = threading.Lock()
        self._journal = Journal(log, self.terms(), trusted)

    def terms(self) -> dict[str, Any]:
        """Return what has to be the same for a log to be continued."""
        setting = self._setting
        return {
            "task": self._world.task.name,
            "fingerprint": fingerprint(
                {
                    **self._world.__fingerprint__(),
                    "given": list(self._given.acts()),
                    "policy": setting.policy,
                    "nature": list(Plan(setting.nature).acts()),
                }
            ),
            "options": self._twins.options,
            "given": repr(self._given),
            "seed": setting.seed,
            "steps": setting.steps,
            "policy": setting.policy if isinstance(setting.policy, str) else "given",
            "nature": Plan(setting.nature).as_dict()["do"],
            "outcomes": [outcome.model_dump() for outcome in self.outcomes],
        }

    # --- budget and log -------------------------------------------------------------------

    @property
    def spent(self) -> int:
        """How many episodes were used."""
        return sum(record.episodes for record in self._journal.records)

    @property
    def remaining(self) -> int | None:
        """How many are left; None if there is no end."""
        return None if self.budget is None else self.budget - self.spent

    @property
    def records(self) -> tuple[Experiment, ...]:
        """All experiments, in their order."""
        return tuple(self._journal.records)

    # --- experiments --------------------------------------------------------------------------

    def see(self, n: int) -> Samples:
        """Observe new episodes.

        Raises:
            Forbidden: This question is not allowed.
            BudgetExhausted: There are fewer episodes left.
        """
        return self._experiment("see", {}, n)

    def do(self, request: Mapping[str, Any], n: int = 1, *, row: int | None = None) -> Samples:
        """Intervene in new episodes.

        Args:
            request: Interventions, with or without a time.
            n: How many episodes.
            row: Of a protocol, for the log.

        Raises:
            Forbidden: This question is not allowed, or something may not be set.
            BudgetExhausted: There are fewer episodes left.
            InterventionError: The intervention was refused. That costs nothing if it could be seen
                beforehand, else all the episodes: how far they came is information.
            ModelError: With a log: a mechanism has no name under which it can be found again.
        """
        return self._experiment("do", request, n, row=row)

    def counterfactual(
        self, unit: int, request: Mapping[str, Any], *, at: int = 0
    ) -> dict[str, Floats]:
        """Run the counterfactual of a unit under another intervention.

        Args:
            unit: Number of an episode of an earlier experiment.
            request: What is done.
            at: From which control step on.

        Returns:
            The reported outcomes of that unit under the intervention.

        Raises:
            Forbidden: As in ``do``, or the unit was never seen.
            BudgetExhausted: No episode is left.
        """
        names = tuple(dict.fromkeys(outcome.name for outcome in self.outcomes))
        with self._lock:
            self._permit("counterfactual", request, 1)
            done = (r for r in self._journal.records if r.kind in ("see", "do"))
            known = next((r for r in done if unit in r.samples.numbers), None)
            if known is None:
                last = self._journal.next_unit
                there = f"units 0 to {last - 1}" if last else "none yet: see or do something first"
                raise Forbidden(f"imagine unit {unit}, which was never seen", (there,))
            plan = self._with(known.samples.plan)
            episode = self._setting.episode(self._twins, self._world, plan, unit, ())
            try:
                other = episode.counterfactual(request, at=at, record=names)
            except Exception:
                held = self._samples({}, (unit,), request)
                self._journal.write("refused counterfactual", held, at=at)
                raise
            columns = {column(outcome): outcome.of(other) for outcome in self.outcomes}
            held = self._samples({k: v[None] for k, v in columns.items()}, (unit,), request)
            self._journal.write("counterfactual", held, at=at)
        return {name: values.copy() for name, values in columns.items()}

    def _with(self, request: Mapping[str, Any]) -> Plan:
        return Plan(merged(self._world.model, self._given, Plan(request)))

    def _samples(
        self, columns: dict[str, Floats], units: Iterable[int], request: Mapping[str, Any]
    ) -> Samples:
        return Samples(columns, tuple(units), self._setting.seed, Plan(request))

    def run(self, protocol: Path | str | Iterable[Mapping[str, Any]]) -> tuple[Samples, ...]:
        """Run a protocol: a table of settings in, a data set out.

        Args:
            protocol: A CSV file whose columns are variables (``name[i]`` for a component) and,
                if wanted, ``n``, or rows of the same kind; an empty cell leaves a variable alone.
                Rows that the log has already are not carried out again.

        Raises:
            UnknownOption: A cell is no number.
            Forbidden: As in ``do``; before anything is carried out.
            BudgetExhausted: Likewise, for the whole table.
        """
        from scm_world.queries.tables import read_protocol

        rows = read_protocol(protocol, self._world.model)
        done = {r.row: r for r in self._journal.records if r.row is not None and r.samples}
        for index, (request, n) in enumerate(rows):
            known = done.get(index)
            same = known is None or (
                known.samples.plan == Plan(request) and len(known.samples.numbers) == n
            )
            if not same:
                raise UnknownOption(
                    "protocol", f"row {index}", ("the one that the log began with",)
                )
        todo = [(i, *row) for i, row in enumerate(rows) if i not in done]
        for _, request, n in todo:
            self._permit("do" if request else "see", request, n)
        self._afford(sum(n for _, _, n in todo))
        for index, request, n in todo:
            self._experiment("do" if request else "see", request, n, row=index)
        found = {
            r.row: r.samples.copy()
            for r in self._journal.records
            if r.row is not None and r.samples
        }
        return tuple(found[index] for index in range(len(rows)))

    def _experiment(
        self, kind: str, request: Mapping[str, Any], n: int, *, row: int | None = None
    ) -> Samples:
        count = whole_number("n", n, least=1)
        with self._lock:
            self._permit(kind, request, count)
            units = range(self._journal.next_unit, self._journal.next_unit + count)
            try:
                found = sample(
                    self._twins,
                    self._world,
                    self._with(request),
                    count,
                    outcomes=self.outcomes,
                    setting=self._setting,
                    first=units.start,
                )
            except Exception:  # how far it came is information: it costs an episode
                held = self._samples({}, units, request)
                self._journal.write(f"refused {kind}", held, row=row)
                raise
            named = replace(found, plan=Plan(request))
            self._journal.write(kind, named, row=row)
            return named.copy()

    # --- permissions --------------------------------------------------------------------------

    def _permit(self, kind: str, request: Mapping[str, Any], n: int) -> None:
        if kind not in self.allow:
            raise Forbidden(kind, self.allow)
        plan = Plan(request)
        self._journal.refuse_others()
        if self._journal.path is not None:
            plan.as_dict()  # or it could not be written down afterwards
        for name in plan:
            if name not in self.settable:
                raise Forbidden(f"set {name}", self.settable)
        self._permit_looks(plan)
        self._afford(n)

    def _permit_looks(self, plan: Plan) -> None:
        """Check what a plan looks at: events, and causes of mechanisms."""

        def sees(body: str) -> bool:  # the ground, or a body with visible variables
            return body in ("floor", "twins") or any(n.startswith(body) for n in self.visible)

        for name, timed in plan.timed():
            event = timed.time.when
            if isinstance(event, Reaches) and event.name not in self.visible:
                raise Forbidden(f"wait with {name} for {event.name}", self.visible)
            if isinstance(event, Contact) and not all(map(sees, event.bodies)):
                raise Forbidden(f"wait with {name} for contacts", self.visible)
        for name, act in plan.acts():
            self._world.model.accept(name, act)
            for parent in getattr(act, "parents", ()):
                if parent.name not in self.visible:
                    raise Forbidden(f"let {name} follow {parent.name}", self.visible)

    def _afford(self, n: int) -> None:
        left = self.remaining
        if left is not None and n > left:
            raise BudgetExhausted(n, left)


def _matching(option: str, patterns: Iterable[str], names: Sequence[str]) -> tuple[str, ...]:
    given = (patterns,) if isinstance(patterns, str) else tuple(patterns)
    for pattern in given:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise UnknownOption(option, pattern, names)
    return tuple(n for n in names if any(fnmatchcase(n, pattern) for pattern in given))
