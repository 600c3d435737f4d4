"""What a discovery run found, as data."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, final

from scm_world.discovery.scores import Score
from scm_world.output.durable import write_whole
from scm_world.output.locations import Location
from scm_world.queries.experiments.effects import EdgeKey

FORMAT = "scm_world/discovery/1"


@final
@dataclass(frozen=True)
class DiscoveryReport:
    """A graph recovered from interventional experiments, held against the declared one.

    Attributes:
        task: Name of the task or model.
        backend: Name of the engine; ``"none"`` for a model without physics.
        preset: Numerical settings of the engine.
        seed: Of the experiments.
        probes: Probe states that were used.
        planned: Probe states that were asked for; more than ``probes`` if it was interrupted.
        rollouts: Control steps simulated in an experiment of their own.
        bound: Fewest of them that find a graph without prior knowledge: one for each variable that
            can be set, in each probe state; see ``design.bounds.paired_single_target``.
        floor: Largest difference after something was done and undone.
        threshold: An effect must exceed it.
        inert: Largest effect among the pairs that are no edge in the found graph.
        score: The comparison.
        found: Edges of the recovered graph.
        declared: Edges of the declared graph.
        effects: Largest effect of each found edge, in the unit of the child.
        refused: Targets that found no feasible value in some probes, with how often.
        seconds: Wall time.
        versions: Of everything that decides the result.
        arguments: What the task was made with, each as ``name=value``, where that is known.
    """

    task: str
    backend: str
    preset: str
    seed: int
    probes: int
    planned: int
    rollouts: int
    bound: int
    floor: float
    threshold: float
    inert: float
    score: Score
    found: tuple[EdgeKey, ...]
    declared: tuple[EdgeKey, ...]
    effects: dict[EdgeKey, float]
    refused: dict[str, int]
    seconds: float
    versions: dict[str, str]
    arguments: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Write the report as plain data."""
        return {
            "format": FORMAT,
            "task": self.task,
            "arguments": list(self.arguments),
            "backend": self.backend,
            "preset": self.preset,
            "seed": self.seed,
            "probes": self.probes,
            "planned_probes": self.planned,
            "complete": self.probes == self.planned,
            "rollouts": self.rollouts,
            "fewest_rollouts": self.bound,
            "floor": self.floor,
            "threshold": self.threshold,
            "largest_effect_without_edge": self.inert,
            **self.score.as_dict(),
            "edges": [
                {"cause": c, "effect": e, "lag": lag, "largest": self.effects[c, e, lag]}
                for c, e, lag in self.found
            ],
            "declared": [list(edge) for edge in self.declared],
            "refused": self.refused,
            "seconds": self.seconds,
            "versions": self.versions,
        }

    def save(self, path: Location | str) -> None:
        """Write the report as JSON, whole or not at all.

        Raises:
            UnwritableFolder: There is no such folder, no room, or no permission.
        """
        write_whole(json.dumps(self.as_dict(), indent=1) + "\n", path)

    def __str__(self) -> str:
        s = self.score
        return (
            f"{self.task} on {self.backend}: {len(self.found)} edges found, "
            f"{len(self.declared)} declared, SHD {s.shd}, precision {s.precision:.3f}, "
            f"recall {s.recall:.3f}, F1 {s.f1:.3f}; {self.probes} probe states, "
            f"{self.rollouts} rollouts, floor {self.floor:g}"
        )
