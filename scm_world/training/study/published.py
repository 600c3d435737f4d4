"""What was published: scores with their sources, budgets, and the actors one can download.

The numbers lie in ``published.json``. The figures of the paper are pictures without numbers, so
most of its scores are not known, and are left out rather than guessed.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import final

from scm_world.errors import UnknownOption
from scm_world.variables.spaces import Frozen


@final
class Source(Frozen):
    """Where scores were read.

    Attributes:
        what: In a sentence.
        metric: Which score it is.
        how: How it was read.
        tolerance: By how much it may be wrong for that reason.
        policies: How many trained policies stand behind a score.
    """

    what: str
    metric: str
    how: str
    tolerance: float
    policies: int


class _Scores(Frozen):
    task: str
    algo: str
    curriculum: int
    source: str
    values: Mapping[str, float]

    @property
    def key(self) -> tuple[str, str, int]:
        """Task, algorithm and curriculum."""
        return self.task, self.algo, self.curriculum


@final
class Scores(_Scores):
    """Published scores of one training, by protocol."""


@final
class Actor(_Scores):
    """A published policy.

    Attributes:
        file: Name of the archive.
        sha256: Of the archive.
    """

    file: str
    sha256: str


@final
class Budget(Frozen):
    """How much was trained and evaluated for the paper.

    Attributes:
        steps: Of a training, by algorithm [control steps].
        seeds: Trainings of one kind.
        episodes: Of each protocol.
    """

    steps: Mapping[str, int]
    seeds: int
    episodes: int


@final
class Difference(Frozen):
    """A protocol that is another one there than here."""

    task: str
    protocol: str
    what: str


@final
class Published(Frozen):
    """All that is known of the published results.

    Attributes:
        format: Of the file.
        work: What was published.
        budget: Of the paper.
        sources: By name.
        scores: Of trainings.
        actors: Policies one can download.
        differences: Protocols that are not the same.
        remarks: In sentences.
    """

    format: str
    work: str
    budget: Budget
    sources: Mapping[str, Source]
    scores: tuple[Scores, ...]
    actors: tuple[Actor, ...]
    differences: tuple[Difference, ...]
    remarks: tuple[str, ...]

    def of(self, task: str, algo: str, curriculum: int) -> Scores | None:
        """Give the scores of one training; None if they are not known."""
        found = (one for one in self.scores if one.key == (task, algo, curriculum))
        return next(found, None)

    def actor(self, task: str, algo: str, curriculum: int) -> Actor | None:
        """Give the published policy of one training; None if there is none."""
        found = (one for one in self.actors if one.key == (task, algo, curriculum))
        return next(found, None)

    def difference(self, task: str, protocol: str) -> str:
        """Say what is different in a protocol; nothing if it is the same."""
        found = (d.what for d in self.differences if (d.task, d.protocol) == (task, protocol))
        return next(found, "")


@cache
def published() -> Published:
    """Read what was published.

    Example:
        >>> known = published()
        >>> known.of("pushing", "ppo", 1).values["P5"], known.of("picking", "ppo", 1)
        (0.99, None)
        >>> known.budget.steps["ppo"], known.actor("picking", "ppo", 1).file
        (100000000, 'picking_ppo_curr1.zip')
    """
    text = files("scm_world.training.study").joinpath("published.json").read_text("utf-8")
    return Published.model_validate_json(text)


FIGURES: Mapping[str, tuple[str, ...]] = {
    "pushing": ("pushing",),
    "picking": ("picking",),
    "pick_and_place": ("pick_and_place",),
    "stacking2": ("stacking2",),
    "all": ("pushing", "picking", "pick_and_place", "stacking2"),
}
"""The tasks in each evaluation figure of the paper."""


def figure(name: str) -> tuple[str, ...]:
    """List the tasks of a published figure.

    Raises:
        UnknownOption: There is no such figure.
    """
    if name not in FIGURES:
        raise UnknownOption("table", name, FIGURES)
    return FIGURES[name]
