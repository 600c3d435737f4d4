"""Rows from a laboratory: what one gets who may not look at the world itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Column, Dataset, Regime
from scm_world.discovery.data.designs import Design
from scm_world.discovery.data.recorded import columns_of_outcome, first_label, reached
from scm_world.discovery.data.sources import FORMAT, SourceRows, Tell, plain_options
from scm_world.errors import BudgetExhausted, InterventionError
from scm_world.graph.structure import Edge
from scm_world.queries.laboratory import Laboratory


@final
class Experiments:
    """Experiments of one episode each, through ``see`` and ``do`` of a laboratory.

    Its permissions and its budget hold, and its errors are raised. A row has its outcomes as it
    reports them; its number of the unit is the number of the episode.

    Args:
        laboratory: Says who acts, what varies, and what is measured.
        design: What is done.
        n: How many experiments there will be.
        seed: Of what the design draws by lot.

    Raises:
        BudgetExhausted: Fewer episodes are left.
    """

    at_once = False
    uneven = False
    edges: tuple[Edge, ...] | None = None

    def __init__(self, laboratory: Laboratory, design: Design, n: int, *, seed: int) -> None:
        left = laboratory.remaining
        if left is not None and n > left:
            raise BudgetExhausted(n, left)
        self._laboratory, self._design, self._seed = laboratory, design, seed
        # For units and shapes only; it is private, since it would show the graph.
        self._model = laboratory._world.model
        declared = self._model.declared
        self.columns: tuple[Column, ...] = tuple(
            c for o in laboratory.outcomes for c in columns_of_outcome(declared(o.name), o)
        )
        terms = laboratory.terms()
        self.about: dict[str, Any] = {
            "format": FORMAT,
            "system": "laboratory",
            "terms": {**terms, "options": plain_options(terms["options"])},
            "seed": seed,
            "design": design.as_dict(),
        }

    def part(self, numbers: range, tell: Tell) -> SourceRows:
        """Carry out some experiments; those that are refused cost their episode."""
        rows: list[Floats] = []
        regimes: list[Regime] = []
        units: list[int] = []
        refused: list[tuple[int, str]] = []
        for number in numbers:
            regime = self._design.regime(number, seed=self._seed)
            try:
                found = (
                    self._laboratory.do(regime.plan) if regime.targets else self._laboratory.see(1)
                )
            except InterventionError as problem:
                refused.append((number, str(problem)))
            else:
                rows.append(found.matrix()[0])
                regimes.append(self._named(regime))
                units += found.numbers
            tell(1)
        kinds = tuple(dict.fromkeys(regimes))
        table = Dataset(
            values=np.concatenate([np.empty((0, len(self.columns))), *rows]),
            columns=self.columns,
            regimes=kinds,
            regime=np.array([kinds.index(regime) for regime in regimes], dtype=np.int64),
            episode=np.array(units, dtype=np.int64),
            step=np.zeros(len(rows), dtype=np.int64),
            about=self.about,
        )
        return SourceRows(table, tuple(refused))

    def _named(self, regime: Regime) -> Regime:
        model = self._model
        names = (f"{first_label(model, n)} {n}".strip() for n in reached(model, regime.targets))
        return replace(regime, targets=tuple(names))
