"""What an exam of learners leaves behind: one cell per run, one truth per subject."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from scm_world.discovery.learners.found import Found
from scm_world.discovery.learners.registry import SOURCES
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location, located
from scm_world.queries.experiments.effects import EdgeKey

CELL, TRUTH, EXAM = "scm_world/exam-cell/1", "scm_world/exam-truth/1", "scm_world/exam/1"
STATUSES = ("done", "timeout", "failed")
Number = float | int | None
_T = TypeVar("_T")
_BROKEN = (KeyError, TypeError, ValueError, IndexError, AttributeError, RecursionError)


@final
@dataclass(frozen=True, kw_only=True)
class Cell:
    """One learner on one subject with one budget and one seed.

    Attributes:
        subject: Name of the subject.
        learner: Name of the learner.
        data: What it was given: ``"see"``, ``"do"`` or ``"paired"``.
        budget: How many episodes or control steps it might use.
        seed: Of data and learner.
        standardised: Whether every column had mean 0 and deviation 1.
        status: ``"done"``, ``"timeout"`` or ``"failed"``.
        message: Why it was not done.
        found: The graph; None unless it was done.
        scores: By name; None for one that does not exist here.
        seconds: Wall time [s].
        experiments: How many it used.
        bound: Fewest that can do in theory, if known.
        declared: The declared edges, where this seed has another graph than the subject shows:
            each seed draws its own model of a family.

    Raises:
        UnknownOption: ``data`` or ``status`` is none of the above.
        ModelError: It is done without a graph, or a score is not finite.
    """

    subject: str
    learner: str
    data: str
    budget: int
    seed: int
    standardised: bool = False
    status: str = "done"
    message: str = ""
    found: Found | None = None
    scores: dict[str, Number] = field(default_factory=dict)
    seconds: float = 0.0
    experiments: int = 0
    bound: int | None = None
    declared: tuple[EdgeKey, ...] | None = None

    def __post_init__(self) -> None:
        """Check what cannot be shown."""
        if self.status not in STATUSES:
            raise UnknownOption("status of a cell", self.status, STATUSES)
        if self.data not in SOURCES:
            raise UnknownOption("kind of data", self.data, SOURCES)
        where = f"{self.learner!r} on {self.subject!r}"
        problems = [
            f"the score {name!r} of {where} is {value}; write None for one that does not exist"
            for name, value in self.scores.items()
            if value is not None and not math.isfinite(value)
        ]
        if self.is_done and self.found is None:
            problems.append(f"{where} is done, but there is no graph")
        if problems:
            raise ModelError(problems)

    @property
    def is_done(self) -> bool:
        """Whether it has a graph and scores."""
        return self.status == "done"

    @property
    def key(self) -> tuple[str, str, str, bool, int, int]:
        """What it is a run of, and its place among the others."""
        return (
            self.subject,
            self.learner,
            self.data,
            self.standardised,
            self.budget,
            self.seed,
        )

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        found = None if self.found is None else self.found.as_dict()
        return {"format": CELL, **_flat(self), "found": found}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Cell:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is no such cell.
        """
        return _made("a cell of an exam", CELL, data, _cell)


@final
@dataclass(frozen=True, kw_only=True)
class Truth:
    """A subject: its declared graph.

    Attributes:
        name: Of the subject.
        names: Of its variables, in order.
        edges: Cause, effect and lag [control steps].
        left_out: Pairs that are not scored, in either direction and with any lag.
        about: What else one should know.

    Raises:
        ModelError: A name is not printable or there twice, or an edge leads nowhere.
    """

    name: str
    names: tuple[str, ...]
    edges: tuple[EdgeKey, ...]
    left_out: tuple[tuple[str, str], ...] = ()
    about: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that it can be drawn."""
        known = set(self.names)
        problems = [
            f"{name!r} is not printable" for name in self.names if not (name and name.isprintable())
        ]
        if len(known) < len(self.names):
            problems.append("a variable is there twice")
        ends = [(cause, effect) for cause, effect, _ in self.edges]
        problems += [
            f"{cause!r} → {effect!r} is no pair of variables"
            for cause, effect in (*ends, *self.left_out)
            if not {cause, effect} <= known
        ]
        if any(lag < 0 or (lag == 0 and c == e) for c, e, lag in self.edges):
            problems.append("an edge has a negative lag, or leads from a variable to itself")
        if problems:
            raise ModelError([f"subject {self.name!r}: {problem}" for problem in problems])

    @property
    def pairs(self) -> NDArray[np.bool_]:
        """Say which pairs are scored, shape (p, p)."""
        at = {name: i for i, name in enumerate(self.names)}
        mask = np.ones((len(at), len(at)), dtype=bool)
        for one, other in self.left_out:
            mask[at[one], at[other]] = mask[at[other], at[one]] = False
        return mask

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {"format": TRUTH, **_flat(self)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Truth:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is no such subject.
        """
        return _made("a subject of an exam", TRUTH, data, _truth)


@final
@dataclass(frozen=True)
class Exam:
    """Everything that is shown.

    Attributes:
        subjects: By name, in the order to be shown.
        cells: In any order.
        about: Versions, command: what does not depend on the machine.

    Raises:
        ModelError: A cell has no subject, or there are two of one kind.
    """

    subjects: dict[str, Truth]
    cells: tuple[Cell, ...]
    about: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the cells belong to the subjects."""
        lost = sorted({cell.subject for cell in self.cells} - set(self.subjects))
        problems = [f"there are cells of {name!r}, which is no subject" for name in lost]
        if len({cell.key for cell in self.cells}) < len(self.cells):
            problems.append("two cells are of one subject, learner, data, budget and seed")
        if problems:
            raise ModelError(problems)

    @cached_property
    def ordered(self) -> tuple[Cell, ...]:
        """The cells by subject, learner, data, budget and seed: no matter which ended first."""
        place = {name: number for number, name in enumerate(self.subjects)}
        return tuple(sorted(self.cells, key=lambda cell: (place[cell.subject], cell.key)))

    def truth_of(self, cell: Cell) -> Truth:
        """Give the graph that a cell is held against."""
        truth = self.subjects[cell.subject]
        return truth if cell.declared is None else replace(truth, edges=cell.declared)

    def cells_of(self, subject: str) -> tuple[Cell, ...]:
        """Give the cells of one subject."""
        return tuple(cell for cell in self.ordered if cell.subject == subject)

    @property
    def counted(self) -> str:
        """How many cells there are and how they ended, in words."""
        ends = [cell.status for cell in self.cells]
        return (
            f"{len(self.subjects)} subject{'s' * (len(self.subjects) != 1)}, "
            f"{len({cell.learner for cell in self.cells})} learners, "
            f"{len(ends)} runs: {ends.count('done')} done, "
            f"{ends.count('timeout')} timed out, {ends.count('failed')} failed"
        )

    def as_dict(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {
            "format": EXAM,
            "subjects": [truth.as_dict() for truth in self.subjects.values()],
            "cells": [cell.as_dict() for cell in self.ordered],
            "about": self.about,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Exam:
        """Read what ``as_dict`` wrote.

        Raises:
            ModelError: It is no such exam.
        """
        return _made("an exam", EXAM, data, _exam)


# --- files ----------------------------------------------------------------------------------------


def read_cell(path: Location | str) -> Cell:
    """Read the file of a cell.

    Raises:
        UnreadableFile: It is not there, damaged, or something else.
    """
    return _read(path, Cell.from_dict, "delete it, and this cell is run again")


def read_truth(path: Location | str) -> Truth:
    """Read the file of a subject.

    Raises:
        UnreadableFile: It is not there, damaged, or something else.
    """
    return _read(path, Truth.from_dict, "delete it, and the exam writes it again")


def write_json(thing: Cell | Truth | Exam, path: Location | str) -> None:
    """Write a cell, a subject or an exam as JSON, whole or not at all."""
    write_whole(as_text(thing), path)


def as_text(thing: Cell | Truth | Exam) -> str:
    """Write a cell, a subject or an exam as JSON.

    Raises:
        TypeError: A setting or a note is something that JSON cannot hold.
        ValueError: A number is not finite.
    """
    return json.dumps(thing.as_dict(), indent=1, allow_nan=False, default=_plain) + "\n"


def _read(path: Location | str, make: Callable[[Mapping[str, Any]], _T], advice: str) -> _T:
    try:
        return make(json.loads(located(path).read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        raise UnreadableFile(str(path), " ".join(str(error).split()), advice) from error


def _flat(thing: Cell | Truth) -> dict[str, Any]:
    return {f.name: getattr(thing, f.name) for f in fields(thing)}


def _plain(value: Any) -> Any:
    """Write numbers of numpy as numbers."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON: {value!r}")


def _made(
    what: str, format_: str, data: Mapping[str, Any], make: Callable[[Mapping[str, Any]], _T]
) -> _T:
    try:
        if data["format"] != format_:
            raise ValueError(f"expected the format {format_!r}, got {data['format']!r}")
        return make(data)
    except _BROKEN as error:
        raise ModelError([f"not {what}: {error!r}"]) from error


def _cell(data: Mapping[str, Any]) -> Cell:
    return Cell(
        subject=str(data["subject"]),
        learner=str(data["learner"]),
        data=data["data"],
        budget=int(data["budget"]),
        seed=int(data["seed"]),
        standardised=bool(data["standardised"]),
        status=data["status"],
        message=str(data["message"]),
        found=None if data["found"] is None else Found.from_dict(data["found"]),
        scores={str(name): _number(value) for name, value in data["scores"].items()},
        seconds=float(data["seconds"]),
        experiments=int(data["experiments"]),
        bound=None if data["bound"] is None else int(data["bound"]),
        declared=None if data["declared"] is None else _edges(data["declared"]),
    )


def _edges(data: Iterable[Any]) -> tuple[EdgeKey, ...]:
    return tuple((str(cause), str(effect), int(lag)) for cause, effect, lag in data)


def _number(value: Any) -> Number:
    if value is not None and not isinstance(value, int | float):
        raise ValueError(f"{value!r} is no number")
    return value


def _truth(data: Mapping[str, Any]) -> Truth:
    return Truth(
        name=str(data["name"]),
        names=_texts(data["names"]),
        edges=_edges(data["edges"]),
        left_out=tuple((str(one), str(other)) for one, other in data["left_out"]),
        about=dict(data["about"]),
    )


def _texts(values: Iterable[Any]) -> tuple[str, ...]:
    return tuple(str(value) for value in values)


def _exam(data: Mapping[str, Any]) -> Exam:
    truths = [Truth.from_dict(truth) for truth in data["subjects"]]
    return Exam(
        subjects={truth.name: truth for truth in truths},
        cells=tuple(Cell.from_dict(cell) for cell in data["cells"]),
        about=dict(data["about"]),
    )
