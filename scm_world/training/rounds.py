"""What happens between the rounds of a training, whatever library learns."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from datetime import timedelta
from pathlib import Path
from typing import final

from scm_world.policies import MlpPolicy
from scm_world.queries.progress import Progress, Tell
from scm_world.runs.study import Study
from scm_world.training.export import Evaluations
from scm_world.training.recipe import Recipe

CHECKPOINTS = 20  # of a training, evenly spread
LINES = 10.0  # [s] between lines about the training


def is_due(times: int, before: int, now: int, recipe: Recipe) -> bool:
    """Return whether one of so many evenly spread times lies between two numbers of steps."""
    return times * now // recipe.steps > times * before // recipe.steps


@final
class Rounds:
    """Says how the training goes, and writes checkpoints and evaluations when it is time.

    Args:
        recipe: How it is trained.
        study: Where its files are.
        backend: Its engine.
        seed: Its seed.
        progress: Called with how many steps are done, and how many there are.
        tell: Called with a sentence about each event.
        save: Writes a checkpoint and the policy.
        policy: Returns the policy as it is.

    Attributes:
        scores: The evaluations.
    """

    def __init__(
        self,
        recipe: Recipe,
        study: Study,
        *,
        backend: str,
        seed: int,
        progress: Progress | None,
        tell: Tell,
        save: Callable[[], None],
        policy: Callable[[], MlpPolicy],
    ) -> None:
        self._recipe, self._progress, self._tell = recipe, progress, tell
        self._save, self._policy = save, policy
        self.scores = Evaluations(recipe, backend, Path(str(study.folder)), seed)
        self.begin(0)

    def begin(self, steps: int) -> None:
        """Begin after so many control steps."""
        self._seen, self._told = steps, (time.perf_counter(), steps)

    def look(self, steps: int, about: Iterable[str]) -> dict[str, float]:
        """Do what is due after so many control steps; return the scores of an evaluation, if any.

        ``about`` describes the last episodes.
        """
        before, self._seen, recipe = self._seen, steps, self._recipe
        if self._progress is not None:
            self._progress(min(steps, recipe.steps), recipe.steps)
        spent, done = time.perf_counter() - self._told[0], steps - self._told[1]
        if spent >= LINES and done > 0:
            left = timedelta(seconds=round(max(recipe.steps - steps, 0) * spent / done))
            speed = f"{done / spent:,.0f} steps per second, about {left} left"
            self._tell(f"{steps:,} of {recipe.steps:,} steps: {', '.join([*about, speed])}")
            self._told = time.perf_counter(), steps
        if is_due(CHECKPOINTS, before, steps, recipe) and steps < recipe.steps:
            self._save()  # there is one at the end
        if not (recipe.trials.protocols and is_due(recipe.trials.times, before, steps, recipe)):
            return {}
        begun = time.perf_counter()
        self._tell(f"{steps:,} steps: {self.scores.add(self._policy(), steps)}")
        self._told = self._told[0] + time.perf_counter() - begun, self._told[1]
        return self.scores.last


def restore_last(study: Study, restore: Callable[[bytes, int], str], tell: Tell) -> None:
    """Restore the last whole checkpoint.

    Args:
        study: Where the files are.
        restore: Takes a checkpoint and its number of steps; returns what else is to be said.
        tell: Called with a sentence about each event.
    """
    folder = Path(str(study.path("checkpoints")))
    found = {int(path.stem.split("_")[1]): path for path in folder.glob("run_*.zip")}
    for steps, path in sorted(found.items(), reverse=True):
        try:
            more = restore(study.kept(f"checkpoints/{path.name}", bytes), steps)
        except Exception as error:  # of many kinds: torch, pickle, zip, sums
            tell(f"{path} is damaged, and the checkpoint before it is taken: {error}")
            continue
        tell(f"goes on after {steps:,} steps{more}")
        return
