"""What a study costs, and how much of it is done, before it is run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from scm_world.env import ScmWorldEnv
from scm_world.training.recipe import Recipe
from scm_world.training.study.cells import Cell, Study
from scm_world.training.study.records import is_evaluated, read_record, run_of

ON_POLICY = 3850.0
"""Control steps of PPO per CPU-second: 64 worlds, 2 x 256 units, 4 epochs (measured)."""
UPDATES: Mapping[str, float] = {"sac": 53.0, "td3": 104.0}
"""Updates per CPU-second: 2 x 256 units, batches of ``BATCH`` (measured)."""
BATCH: Mapping[str, float] = {"sac": 256.0, "td3": 128.0}
SLOWER: Mapping[str, float] = {"sac": 0.67, "td3": 0.27}
"""How the time of an update goes with its batch, as a power: 53 and 21 a second with 256 and 1024
(SAC), 104 and 86 with 128 and 256 (TD3) (measured)."""
SIMULATED = 5900.0
"""Control steps per CPU-second of 64 worlds in a batch (measured)."""
HOUR = 3600.0  # [s]


@final
@dataclass(frozen=True)
class Plan:
    """What is to be done for a cell.

    Attributes:
        cell: Which one.
        steps: Control steps that are trained.
        training: Estimated time of the processor [h].
        evaluation: Likewise.
        trained: Whether it is trained.
        evaluated: Whether it is evaluated, in all protocols and episodes of the study.
        begun: Whether there is a part of the training.
    """

    cell: Cell
    steps: int
    training: float
    evaluation: float
    trained: bool
    evaluated: bool
    begun: bool

    @property
    def left(self) -> float:
        """Estimated time of the processor for what is not done [h]."""
        training = 0.0 if self.trained else self.training
        return training + (0.0 if self.evaluated else self.evaluation)

    @property
    def state(self) -> str:
        """How far it is, in words."""
        if self.trained:
            return "done" if self.evaluated else "trained"
        return "begun" if self.begun else ""


def planned(study: Study, out: Path | str | None = None) -> tuple[Plan, ...]:
    """List what a study consists of, with estimates of its cost.

    Args:
        study: What is trained and evaluated.
        out: Folder in which some of it may be done already.

    Example:
        >>> plans = planned(Study(tasks=("pushing",), algos=("ppo", "sac"), seeds=(0,)))
        >>> [(plan.cell.name, round(plan.training)) for plan in plans[2:4]]
        [('pushing-ppo-c2-0', 7), ('pushing-sac-c0-0', 53)]
    """
    folder = None if out is None else Path(out)
    lengths: dict[Any, int] = {}
    return tuple(_plan(study, cell, folder, lengths) for cell in study.cells())


def _plan(study: Study, cell: Cell, folder: Path | None, lengths: dict[Any, int]) -> Plan:
    made = study.recipe(cell)
    steps = study.steps(made)
    if cell.task not in lengths:
        lengths[cell.task] = _length(made, cell.task)
    played = len(study.protocols) * study.episodes * lengths[cell.task]
    record = None if folder is None else read_record(folder, cell)
    return Plan(
        cell,
        record.steps if record is not None else steps,
        training=seconds(made, steps) / HOUR,
        evaluation=played / SIMULATED / HOUR,
        trained=record is not None,
        evaluated=folder is not None and is_evaluated(study, folder, record),
        begun=folder is not None and run_of(folder, cell).exists(),
    )


def seconds(made: Recipe, steps: int) -> float:
    """Estimate the time of the processor that a training takes [s].

    Example:
        >>> from scm_world.training.recipe import recipe
        >>> round(seconds(recipe("pushing", "ppo"), 385_000))
        100
    """
    if made.algo == "ppo":
        return steps / ON_POLICY
    settings: Any = made.settings
    each = settings.train_freq * made.worlds  # control steps
    updates = steps * (1.0 if settings.gradient_steps == -1 else settings.gradient_steps / each)
    slower = float((settings.batch_size / BATCH[made.algo]) ** SLOWER[made.algo])
    return updates * slower / UPDATES[made.algo] + steps / SIMULATED


def _length(made: Recipe, task: str) -> int:
    """Ask how many control steps an episode has."""
    env = ScmWorldEnv(task, backend="fake", **made.options)
    try:
        return int(env.world.max_episode_length)
    finally:
        env.close()
