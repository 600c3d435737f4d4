"""Local causal graphs: which body acts on which in one control step, and how sure that is.

``local_graph`` predicts it from what touches (``local_graphs``), ``paired_truth`` finds it by
experiment (``local_truth``), and ``local_report`` holds one against the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any, final

from scm_world.queries.local_graphs import (
    RULES,
    LocalEpisode,
    LocalGraph,
    Policy,
    Touching,
    action_of,
    local_episode,
    local_graph,
    predicted,
    save_json,
)
from scm_world.queries.local_truth import LocalTruth, listening, movers, paired_truth
from scm_world.world import World

__all__ = [
    "RULES",
    "LocalEpisode",
    "LocalGraph",
    "LocalReport",
    "LocalTruth",
    "RuleScore",
    "local_episode",
    "local_graph",
    "local_report",
    "paired_truth",
]

REPORT_FORMAT = "scm_world/local_report/1"


@final
@dataclass(frozen=True)
class RuleScore:
    """How often a rule is right, counted over all ordered pairs of bodies and all steps.

    Attributes:
        right: Predicted and true.
        extra: Predicted but not true.
        missed: True but not predicted.
    """

    right: int = 0
    extra: int = 0
    missed: int = 0

    @property
    def precision(self) -> float:
        """Predicted edges that are true, as a fraction; 1 if none was predicted."""
        return self.right / (self.right + self.extra) if self.right + self.extra else 1.0

    @property
    def recall(self) -> float:
        """True edges that were predicted, as a fraction; 1 if there is none."""
        return self.right / (self.right + self.missed) if self.right + self.missed else 1.0

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; 1 if nothing was predicted and nothing is true."""
        wrong = self.extra + self.missed
        return 2 * self.right / (2 * self.right + wrong) if self.right + wrong else 1.0

    def __add__(self, other: RuleScore) -> RuleScore:
        return RuleScore(
            self.right + other.right, self.extra + other.extra, self.missed + other.missed
        )


@final
@dataclass(frozen=True)
class LocalReport:
    """What contacts predict, held against paired experiments, over an episode.

    Attributes:
        task: Name of the task.
        backend: Name and version of the engine.
        steps: Control steps that were compared.
        pairs: Ordered pairs of bodies that were compared.
        scores: By the name of the rule, with the contacts of the very step that the experiments
            vary: the one from the scene built anew.
        own_scores: The same with the contacts of the world itself, as ``local_graph`` sees them.
            They differ where an engine remembers more than the scene.
        floor: Largest change where nothing was changed; 0.0.
        rollouts: Control steps simulated in an experiment of their own.
        seconds: Wall time.
        errors: Where rule ``pressing`` or ``listed`` is wrong in ``scores``: rule, control step,
            cause, effect and size of the effect.
    """

    task: str
    backend: str
    steps: int
    pairs: int
    scores: dict[str, RuleScore]
    own_scores: dict[str, RuleScore]
    floor: float
    rollouts: int
    seconds: float
    errors: tuple[tuple[str, int, str, str, float], ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Write the report as plain data."""
        return {
            "format": REPORT_FORMAT,
            **asdict(self),
            "scores": _plain(self.scores),
            "own_scores": _plain(self.own_scores),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LocalReport:
        """Read what ``as_dict`` wrote, also after it has been JSON."""
        fields = {name: data[name] for name in cls.__dataclass_fields__}
        counts = ("right", "extra", "missed")
        for kind in ("scores", "own_scores"):
            fields[kind] = {
                name: RuleScore(*(score[count] for count in counts))
                for name, score in data[kind].items()
            }
        fields["errors"] = tuple(tuple(error) for error in data["errors"])
        return cls(**fields)

    def save(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all."""
        save_json(path, self.as_dict())

    def __str__(self) -> str:
        found = ", ".join(f"{name} {score.f1:.3f}" for name, score in self.scores.items())
        return f"{self.task} on {self.backend}, {self.steps} steps, F1: {found}"


def _plain(scores: Mapping[str, RuleScore]) -> dict[str, Any]:
    rates = ("precision", "recall", "f1")
    return {
        name: {**asdict(score), **{rate: getattr(score, rate) for rate in rates}}
        for name, score in scores.items()
    }


@final
@dataclass(frozen=True)
class _Compared:
    """One control step: what the world itself touched, and what experiments found."""

    index: int
    contacts: Touching
    truth: LocalTruth


def local_report(world: World, policy: Policy, steps: int, *, every: int = 1) -> LocalReport:
    """Compare local graphs with paired experiments over an episode, and go back.

    Args:
        world: It is left as it is, bit for bit.
        policy: A function of the world, or at least ``steps`` actions.
        steps: How many control steps are played.
        every: One of how many is compared.
    """
    began, before, bodies = perf_counter(), world.snapshot(), movers(world)
    compared: list[_Compared] = []
    try:
        for step in range(steps):
            action, index = action_of(policy, world, step), world.index
            truth = paired_truth(world, action) if step % every == 0 else None
            with listening(world) as heard:
                world.step(action)
            if truth is not None:
                compared.append(_Compared(index, heard.contacts, truth))
    finally:
        world.restore(before)
    truths = [one.truth for one in compared]
    return LocalReport(
        task=world.task.name,
        backend=f"{world.backend.name} {world.backend.version}",
        steps=len(compared),
        pairs=len(compared) * len(bodies) * (len(bodies) - 1),
        scores=_scores(bodies, [(truth.contacts, truth) for truth in truths]),
        own_scores=_scores(bodies, [(one.contacts, one.truth) for one in compared]),
        floor=max((truth.floor for truth in truths), default=0.0),
        rollouts=sum(truth.rollouts for truth in truths),
        seconds=perf_counter() - began,
        errors=tuple(_errors(bodies, compared)),
    )


def _scores(
    bodies: Sequence[str], steps: Sequence[tuple[Touching, LocalTruth]]
) -> dict[str, RuleScore]:
    scores = dict.fromkeys(RULES, RuleScore())
    for (contacts, truth), (rule, choose) in product(steps, RULES.items()):
        said, true = set(predicted(bodies, choose(contacts))), set(truth.edges)
        scores[rule] += RuleScore(len(said & true), len(said - true), len(true - said))
    return scores


def _errors(
    bodies: Sequence[str], compared: Sequence[_Compared]
) -> Iterator[tuple[str, int, str, str, float]]:
    for one, rule in product(compared, ("pressing", "listed")):
        truth = one.truth
        said = set(predicted(bodies, RULES[rule](truth.contacts)))
        for pair in sorted(said ^ set(truth.edges)):
            yield (rule, one.index, *pair, truth.effects[pair])
