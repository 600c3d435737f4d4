"""What has rows: a source, the rows of some episodes, and models without physics as sources."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, final

import numpy as np

from scm_world._fingerprint import fingerprint
from scm_world.discovery.data.dataset import Column, Dataset, columns_of
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.recorded import reached
from scm_world.discovery.data.truth import truth_of_model
from scm_world.graph import SCM
from scm_world.graph.structure import Edge
from scm_world.queries.episodes import Unit
from scm_world.queries.equations import length
from scm_world.queries.experiments.versions import versions
from scm_world.queries.twins import asked

FORMAT = "scm_world/dataset/1"

Tell = Callable[[int], None]
"""Called with how many further episodes are done."""


@final
@dataclass(frozen=True)
class SourceRows:
    """The rows of some episodes.

    Attributes:
        table: The rows.
        refused: Numbers of the episodes that could not be, and why.
        pictures: The file with the pictures beside the rows, if there are any.
        touching: Which bodies touched, by number of the episode, where that is recorded: ``pairs``,
            and ``runs`` of control steps: how many, and the numbers of the pairs that touch.
    """

    table: Dataset
    refused: tuple[tuple[int, str], ...] = ()
    pictures: bytes = b""
    touching: dict[str, Any] = field(default_factory=dict)


class DataSource(Protocol):
    """Something that has episodes; the rows of episode i depend on the seed and on i only.

    Attributes:
        columns: What stands in a row.
        about: Everything that decides the rows, as plain data.
        edges: The declared graph; None where it may not be known.
        at_once: Whether any number of episodes takes one piece of work.
        uneven: Whether some episodes say little of the others: that most of them are refused is
            known only when all are done.
    """

    columns: tuple[Column, ...]
    about: dict[str, Any]
    edges: tuple[Edge, ...] | None
    at_once: bool
    uneven: bool

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Run some episodes."""


# --- models ---------------------------------------------------------------------------------------


@final
class ModelSource:
    """Episodes of a causal model without a backend, every variable of which is written down.

    Row i of a model without lagged edges is that of
    ``model.do(regime(i).plan.at_start()).draw(1, seed=seed, first=i)``.

    Args:
        model: To run.
        design: What is done.
        seed: Of the noise.
        steps: Control steps of an episode, each of them a row; None where nothing is lagged.

    Raises:
        ModelError: The model has lagged edges and ``steps`` is None.
        InterventionError: A target cannot be set to its values.
    """

    at_once = True
    uneven = False

    def __init__(self, model: SCM, design: Design, *, seed: int, steps: int | None) -> None:
        self._model, self._design, self._seed = model, design, seed
        self._twins, system = asked(model)
        self._length = length(system, steps)
        for name, act in design.acts.items():
            model.do({name: act})
        self.columns: tuple[Column, ...] = tuple(c for v in model.variables for c in columns_of(v))
        self.edges: tuple[Edge, ...] | None = model.edges
        self.about: dict[str, Any] = {
            "format": FORMAT,
            "system": "model",
            "fingerprint": fingerprint({**model.__fingerprint__(), "design": design.acts}),
            "seed": seed,
            "steps": 1 if steps is None else steps,
            "design": design.as_dict(),
            "truth": truth_of_model(model),
            "versions": versions(),
        }

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Run some episodes."""
        chosen = self._design.chosen(self._seed, numbers.start, len(numbers))
        kinds, where = np.unique(chosen, axis=0, return_inverse=True)
        kind_of = np.asarray(where, dtype=np.int64).reshape(len(chosen))
        regimes = [self._design.regime_of(kind) for kind in kinds]
        units = [
            Unit(self._seed, number, regimes[kind].plan, None, self._length)
            for number, kind in zip(numbers, kind_of.tolist(), strict=True)
        ]
        vectors = self._twins.paths(units)[:, min(self._length, 1) :]
        n, length, size = vectors.shape
        tell(n)
        return SourceRows(
            Dataset(
                values=vectors.reshape(n * length, size),
                columns=self.columns,
                regimes=tuple(
                    replace(regime, targets=reached(self._model, regime.targets, self.columns))
                    for regime in regimes
                ),
                regime=np.repeat(kind_of, length),
                episode=np.repeat(np.arange(numbers.start, numbers.stop), length),
                step=np.tile(np.arange(length), n),
                about=self.about,
            )
        )
