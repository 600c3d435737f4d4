"""A study: which trainings there are, and how they are evaluated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, final

from scm_world.backends import backends
from scm_world.errors import UnknownOption
from scm_world.evaluation import protocols_of
from scm_world.evaluation.protocols import chosen
from scm_world.tasks import CONVENTIONS
from scm_world.training.recipe import Recipe, recipe
from scm_world.training.study.published import FIGURES, published
from scm_world.world.start import whole_number

FORMAT = "scm_world/reproduction/1"
TASKS = FIGURES["all"]
ALGOS = ("ppo", "sac", "td3")
CURRICULA = (0, 1, 2)
PROTOCOLS = tuple(protocol.name for protocol in protocols_of("pushing"))
PRESETS = {"paper": "causal_world", "tuned": "scm_world"}
"""Presets of recipes, each with its usual conventions: those of what it is compared with."""
POLICIES = {"last": "policy.safetensors", "best": "best.safetensors"}
"""Which policy of a training is evaluated; the paper evaluates the last one."""


@final
@dataclass(frozen=True, order=True)
class Cell:
    """A training: what a number of the published figures is a mean over seeds of.

    Attributes:
        task: Name of the task.
        algo: ``"ppo"``, ``"sac"`` or ``"td3"``.
        curriculum: 0: nothing varies; 1: goals; 2: everything.
        seed: Of the training.
    """

    task: str
    algo: str
    curriculum: int
    seed: int

    @property
    def name(self) -> str:
        """Name of its folders.

        Example:
            >>> Cell("pushing", "ppo", 1, 0).name
            'pushing-ppo-c1-0'
        """
        return f"{self.task}-{self.algo}-c{self.curriculum}-{self.seed}"

    @property
    def group(self) -> tuple[str, str, int]:
        """What is trained, whatever the seed."""
        return self.task, self.algo, self.curriculum


@final
@dataclass(frozen=True)
class Study:
    """What is trained and evaluated.

    Attributes:
        tasks: Names of tasks.
        algos: Names of algorithms.
        curricula: Numbers of curricula.
        seeds: Of the trainings; with none, nothing is trained.
        protocols: In which every policy is evaluated.
        episodes: Of each protocol.
        preset: Of the recipes: ``"paper"`` or ``"tuned"``.
        scale: Share of a recipe's control steps that is trained.
        backend: Name of the engine.
        policy: ``"last"``, as published, or ``"best"`` of the evaluations while training.
        conventions: Of training and evaluation; None: the predecessor's with ``"paper"``, so that
            the scores are measured as the published ones are, else ours.

    Raises:
        UnknownOption: Something does not exist, or is given twice.

    Example:
        >>> study = Study(tasks=("pushing",), algos=("ppo",), seeds=(0, 1))
        >>> [cell.name for cell in study.cells()][:2], len(list(study.cells()))
        (['pushing-ppo-c0-0', 'pushing-ppo-c1-0'], 6)
    """

    tasks: tuple[str, ...] = TASKS
    algos: tuple[str, ...] = ALGOS
    curricula: tuple[int, ...] = CURRICULA
    seeds: tuple[int, ...] = field(default=tuple(range(published().budget.seeds)))
    protocols: tuple[str, ...] = PROTOCOLS
    episodes: int = published().budget.episodes
    preset: str = "paper"
    scale: float = 1.0
    backend: str = "mujoco"
    policy: str = "last"
    conventions: str | None = None

    def __post_init__(self) -> None:
        """Check everything that can be seen beforehand."""
        _each_of("task", self.tasks, TASKS)
        _each_of("algorithm", self.algos, ALGOS)
        _each_of("curriculum", self.curricula, CURRICULA)
        if len(set(self.seeds)) < len(self.seeds):
            raise UnknownOption("seeds", ", ".join(map(str, self.seeds)), ("each of them once",))
        for seed in self.seeds:
            whole_number("seed", seed, least=0)
        for task in self.tasks:
            chosen(self.protocols, protocols_of(task))
        whole_number("episodes", self.episodes, least=1)
        for what, value, known in (
            ("preset", self.preset, PRESETS),
            ("backend", self.backend, backends()),
            ("policy", self.policy, POLICIES),
            ("conventions", self.conventions, (None, *CONVENTIONS)),
        ):
            if value not in known:
                raise UnknownOption(what, value, [one for one in known if one is not None])
        if not (isinstance(self.scale, int | float) and 0.0 < self.scale <= 1.0):
            raise UnknownOption("scale", self.scale, ("more than 0, at most 1",))

    def cells(self) -> Iterator[Cell]:
        """List the trainings: first one seed of everything, then the next one."""
        for seed in self.seeds:
            for task in self.tasks:
                for algo in self.algos:
                    for curriculum in self.curricula:
                        yield Cell(task, algo, curriculum, seed)

    @property
    def rules(self) -> str:
        """Name of the conventions."""
        return self.conventions or PRESETS[self.preset]

    def recipe(self, cell: Cell) -> Recipe:
        """Say how a cell is trained; its steps are those of the whole training.

        Without evaluations in between where the last policy counts: they change nothing of it.
        """
        changes: dict[str, Any] = {} if self.policy == "best" else {"trials.protocols": ()}
        return recipe(
            cell.task,
            cell.algo,
            preset=self.preset,
            curriculum=cell.curriculum,
            env={"conventions": self.rules},
            **changes,
        )

    def steps(self, made: Recipe) -> int:
        """Say how many of a recipe's control steps are trained, in whole rounds.

        Example:
            >>> study = Study(scale=0.01)
            >>> study.steps(study.recipe(Cell("pushing", "ppo", 0, 0)))
            1080000
        """
        return math.ceil(made.steps * self.scale / made.round) * made.round

    @property
    def head(self) -> dict[str, Any]:
        """What is the same for everything in one folder; more of the rest may be added later."""
        same = {name: getattr(self, name) for name in ("preset", "scale", "backend", "policy")}
        return {"format": FORMAT, **same, "conventions": self.rules}


def _each_of(what: str, given: Sequence[Any], known: Sequence[Any]) -> None:
    """Check that something is given, exists, and is given once."""
    if not given:
        raise UnknownOption(what, "none", tuple(map(str, known)))
    for one in given:
        if one not in known:
            raise UnknownOption(what, one, tuple(map(str, known)))
    if len(set(given)) < len(given):
        raise UnknownOption(what, ", ".join(map(str, given)), ("each of them once",))
