"""What happens between the rounds of a training: curves, evaluations, checkpoints."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any, final

from scm_world.errors import Diverged
from scm_world.evaluation.policies.weights import save_policy
from scm_world.queries.progress import Progress
from scm_world.training.checkpoints import Checkpoint, checkpoints, write_checkpoint
from scm_world.training.curves import Curve
from scm_world.training.episodes import Ended
from scm_world.training.export import exported
from scm_world.training.instants import taken
from scm_world.training.learners import library, torch
from scm_world.training.memory import Memory
from scm_world.training.runs import Run
from scm_world.training.trials import Trial, tried
from scm_world.training.worlds import Worlds

ROWS = 1_000
"""About how many rows a learning curve has."""


class Stopped(Exception):
    """The training was asked to stop, and has written a checkpoint."""


@final
class Watching:
    """Looks at a training after each round.

    Args:
        run: What is trained, and where it is kept.
        worlds: In which it learns.
        memory: The replay buffer, if there is one.
        card: What is said of the policy.
        progress: Told how many steps are done.
        tell: Told in words what happens.
        every: Seconds between checkpoints.

    Attributes:
        run: As above.
        stop: Whether it has to end after the present round.
        score: The best one so far, if there was an evaluation.
    """

    def __init__(
        self,
        run: Run,
        worlds: Worlds,
        memory: Memory | None,
        card: Mapping[str, Any],
        progress: Progress | None,
        tell: Callable[[str], None],
        every: float,
    ) -> None:
        self.run, self._worlds, self._memory, self._card = run, worlds, memory, dict(card)
        self._progress, self._tell, self._every = progress, tell, every
        self._spent = (0.0, 0.0)  # wall and CPU seconds before this session
        self._began = (time.perf_counter(), time.process_time())
        self._kept = time.perf_counter()
        self._row = self._tries = 0
        self.score: float | None = None
        self.stop = False
        self._curve: Curve | None = None

    # --- called by the algorithm ------------------------------------------------------------------

    def began(self, model: Any) -> None:
        """Open the learning curve, where it goes on."""
        self._curve = Curve(self.run.curve, model.num_timesteps)
        self._warm_up(model)

    def round(self, model: Any) -> None:
        """Look at a training between two rounds."""
        steps = model.num_timesteps
        if steps == 0 or steps == self._row:
            return
        self._check(model)
        self._adapt(model)
        self._warm_up(model)
        self._calm(model)
        if steps - self._row >= self.run.recipe.steps / ROWS:
            self._write_row(model)
        self._say(steps)
        self._try(model)
        if self.stop or time.perf_counter() - self._kept >= self._every:
            self.keep(model)
        if self.stop:
            raise Stopped

    def ended(self, model: Any) -> None:
        """Keep the last instant."""
        self._check(model)
        if model.num_timesteps > self._row:
            self._adapt(model)
            self._calm(model)
            self._write_row(model)
        self._say(model.num_timesteps)
        self._try(model)
        self.keep(model)

    # --- parts of that ----------------------------------------------------------------------------

    def _check(self, model: Any) -> None:
        """Refuse weights that are no numbers, before they are kept."""
        if not is_finite(model.policy):
            raise Diverged(model.num_timesteps)

    def _say(self, steps: int) -> None:
        if self._progress is not None:
            self._progress(min(steps, self.run.recipe.steps), self.run.recipe.steps)

    def _adapt(self, model: Any) -> None:
        """Follow the divergence, unless the policy stayed as it was in the last update."""
        divergence = model.logger.name_to_value.get("train/approx_kl")
        if divergence is not None and model.policy.action_net.bias.requires_grad:
            model.learning_rate.adapt(float(divergence))

    def _warm_up(self, model: Any) -> None:
        """Let PPO's policy stay as it is for as long as only the value is learned."""
        if not self.run.recipe.critic_warmup:
            return
        learns = model.num_timesteps >= self.run.recipe.critic_warmup
        policy = model.policy
        for part in (policy.mlp_extractor.policy_net, policy.action_net):
            part.requires_grad_(learns)
        policy.log_std.requires_grad_(learns)

    def _calm(self, model: Any) -> None:
        """Lower the ceiling of PPO's standard deviations."""
        network = self.run.recipe.network
        if network.log_std_end is None:
            return
        done = min(model.num_timesteps / self.run.recipe.steps, 1.0)
        ceiling = network.log_std + done * (network.log_std_end - network.log_std)
        with torch().no_grad():
            model.policy.log_std.clamp_(max=ceiling)

    def _write_row(self, model: Any) -> None:
        self._row = model.num_timesteps
        said: Mapping[str, float] = model.logger.name_to_value
        ended = self._worlds.episodes.ended
        row = {
            "steps": float(self._row),
            "wall_s": self.spent[0],
            "cpu_s": self.spent[1],
            "episodes": float(len(ended)),
            "learning_rate": model.learning_rate(model._current_progress_remaining),
            "kl": said.get("train/approx_kl", float("nan")),
            "std": said.get("train/std", float("nan")),
        }
        if ended:
            means: dict[str, list[Any]] = {
                "return": [one.total for one in ended],
                "success": [one.success for one in ended],
                "last_fractional_success": [one.fraction for one in ended],
            }
            for name, values in means.items():
                there = [value for value in values if value is not None]
                if there:
                    row[name] = sum(there) / len(there)
        ended.clear()
        if self._curve is not None:
            self._curve.add(row)
        for name in ("return", "success", "last_fractional_success"):
            if name in row:
                model.logger.record(f"episodes/{name}", row[name])

    @property
    def spent(self) -> tuple[float, float]:
        """Wall and CPU seconds so far, those of earlier sessions too."""
        wall, cpu = time.perf_counter() - self._began[0], time.process_time() - self._began[1]
        return self._spent[0] + wall, self._spent[1] + cpu

    def _try(self, model: Any) -> None:
        """Evaluate, if it is time, and keep the policy if none was better."""
        recipe = self.run.recipe
        due = self._due(model.num_timesteps)
        if not recipe.trials.protocols or due <= self._tries:
            return
        self._tries = due
        policy = exported(model, recipe, self._said(model))
        trial = tried(policy, recipe, backend=self.run.backend, steps=model.num_timesteps)
        trial.write(self.run.trials)
        self._tell(_words(trial))
        for name, score in trial.scores.items():
            model.logger.record(f"evaluation/{name}", score)
        if self.score is None or trial.mean > self.score:
            self.score = trial.mean
            card = {"trial": {"steps": trial.steps, "scores": dict(trial.scores)}}
            save_policy(self.run.best, policy, policy.about.with_card(**card))

    def _due(self, steps: int) -> int:
        """Tell how many evaluations there should have been after so many steps."""
        return self.run.recipe.trials.times * steps // self.run.recipe.steps

    def _said(self, model: Any) -> dict[str, Any]:
        wall, cpu = self.spent
        return {**self._card, "steps": model.num_timesteps, "wall_s": wall, "cpu_s": cpu}

    # --- checkpoints ------------------------------------------------------------------------------

    def keep(self, model: Any) -> Path:
        """Write the policy, and a checkpoint: after the last one nothing is left to do."""
        policy = exported(model, self.run.recipe, self._said(model))
        save_policy(self.run.policy, policy)
        tensors, state = taken(model, self._worlds, self._memory)
        mine = {
            "spent": list(self.spent),
            "row": self._row,
            "score": self.score,
            "ended": [astuple(one) for one in self._worlds.episodes.ended],
        }
        checkpoint = Checkpoint(model.num_timesteps, tensors, {**state, "watching": mine})
        place = write_checkpoint(self.run.checkpoints, checkpoint)
        if self._memory is not None:
            oldest = int(checkpoints(self.run.checkpoints)[0].name)
            self._memory.forget(oldest // self.run.recipe.worlds)
        self._kept = time.perf_counter()
        return place

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on where a checkpoint was written, perhaps of a training that has become longer."""
        mine = checkpoint.state["watching"]
        self._spent = (mine["spent"][0], mine["spent"][1])
        self._row, self.score = mine["row"], mine["score"]
        self._tries = self._due(checkpoint.steps)
        self._worlds.episodes.ended[:] = [Ended(*one) for one in mine["ended"]]


def is_finite(policy: Any) -> bool:
    """Tell whether all weights of a policy, and its standard deviations, are finite numbers."""
    parts = list(policy.parameters())
    if hasattr(policy, "log_std"):
        parts += [policy.log_std.exp(), (-policy.log_std).exp()]
    return all(bool(part.isfinite().all()) for part in parts)


def _words(trial: Trial) -> str:
    """Say what an evaluation gave.

    Example:
        >>> _words(Trial(4096, {"P0": 0.5, "P5": 0.25}))
        '4,096 steps: P0 0.500, P5 0.250'
    """
    scores = ", ".join(f"{name} {score:.3f}" for name, score in trial.scores.items())
    return f"{trial.steps:,} steps: {scores}"


def watch(watching: Watching) -> Any:
    """Make the callback that Stable-Baselines3 takes."""
    return _callback()(watching)


@functools.cache
def _callback() -> Any:
    """Make its class, which is one of Stable-Baselines3's, when it is first needed."""
    base = library("common.callbacks").BaseCallback
    return type("WatchingCallback", (_Called, base), {"__doc__": _Called.__doc__})


class _Called:
    """Lets somebody watch a training; see ``Watching``."""

    model: Any

    def __init__(self, watching: Watching) -> None:
        initialize: Any = super().__init__
        initialize()
        self._watching = watching

    def _on_training_start(self) -> None:
        self._watching.began(self.model)

    def _on_rollout_start(self) -> None:
        self._watching.round(self.model)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._watching.ended(self.model)
