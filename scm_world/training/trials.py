"""Evaluations while an agent is trained."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from scm_world.evaluation import evaluate
from scm_world.evaluation.policies.cards import OPTIONS
from scm_world.evaluation.policies.weights import NetworkPolicy
from scm_world.output.durable import made, write_whole
from scm_world.training.recipe import Recipe

SEED = 7_001
"""Of the noise; one that evaluations by hand hardly have, so that they meet other episodes."""


@final
@dataclass(frozen=True)
class Trial:
    """What an evaluation gave.

    Attributes:
        steps: Control steps of training until then.
        scores: Means of the metric, by protocol.
        metric: The first one of the task; see ``Evaluation.metric``.
    """

    steps: int
    scores: dict[str, float]
    metric: str = "last_fractional_success"

    @property
    def mean(self) -> float:
        """Mean over the protocols."""
        return sum(self.scores.values()) / len(self.scores)

    def write(self, folder: Path) -> None:
        """Write it as JSON."""
        data = {
            "steps": self.steps,
            "metric": self.metric,
            "mean": self.mean,
            "scores": self.scores,
        }
        write_whole(json.dumps(data, indent=2), made(folder) / f"{self.steps}.json")


def tried(policy: NetworkPolicy, recipe: Recipe, *, backend: str, steps: int) -> Trial:
    """Evaluate a policy in the protocols of a recipe.

    Args:
        policy: What was learned so far.
        recipe: How it is trained.
        backend: Name of the engine.
        steps: Control steps of training until now.
    """
    kept: dict[str, Any] = {**recipe.options}
    form = {name: value for name, value in kept.items() if name in (*OPTIONS, "task_options")}
    found = evaluate(
        policy,
        list(recipe.trials.protocols),
        task=recipe.task,
        n=recipe.trials.episodes,
        seeds=SEED,
        backend=backend,
        env=form,
    )
    scores = {name: float(found.score(name).value) for name in found.protocols}
    return Trial(steps, scores, found.metric())
