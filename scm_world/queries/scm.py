"""The causal model that can be asked: equations alone, without a backend."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Self, final

from scm_world.graph import scm as graph
from scm_world.queries.equations import Equations, System
from scm_world.queries.plans import Plan
from scm_world.queries.questions import Questions
from scm_world.queries.samples import STEPS, Setting
from scm_world.queries.stages import AnyStage, EquationStage
from scm_world.variables import Variable


@final
class SCM(Questions, graph.SCM):
    """A structural causal model over typed variables, which answers the questions of a ``World``.

    It is immutable: ``do`` returns another model. Edges of lag 0 act within an instant and form
    a directed acyclic graph; edges of lag 1 reach from one control step into the next.

    A model without lagged edges has episodes of one instant. One with lagged edges begins where
    its variables have their ``start`` or default, and takes as many control steps as it is told; a
    variable with noise, or a distribution, is drawn anew in each of them.

    Args:
        variables: The declarations, or a model of ``scm_world.graph``.

    Raises:
        ModelError: With every problem: duplicate names, unknown parents, cycles.

    Example:
        >>> from scm_world.variables import Box, Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="mass", unit="kg", default=0.02, distribution=Box(0.015, 0.045)),
        ...     Derived(name="weight", unit="N", parents=("mass",),
        ...             mechanism=Linear(weights=(9.81,))),
        ... ])
        >>> model.sample(1000, seed=0)["weight"].shape
        (1000,)
        >>> heavy = model.rollout(seed=1).counterfactual({"mass": 0.1})
        >>> round(float(heavy.final("weight")), 3)
        0.981
        >>> model.effect("weight", do={"mass": 0.1}, versus={"mass": 0.0}, n=10).mean.round(3)
        np.float64(0.981)
    """

    __slots__ = ("_stage",)
    _stage: EquationStage

    def __init__(self, variables: Iterable[Variable] | graph.SCM) -> None:
        if isinstance(variables, graph.SCM):
            self._copy(variables)
        else:
            super().__init__(variables)

    @property
    def graph(self) -> Self:
        """The causal model, which is this one; of a ``World`` it is told from the backend."""
        return self

    def given(self, do: Mapping[str, Any]) -> Self:
        """Give the model in which this is done too: the same as ``do``."""
        return self.do(do)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def _asked(self) -> tuple[AnyStage, System]:
        if not hasattr(self, "_stage"):
            self._stage = EquationStage(self)
        return self._stage, Equations(self._stage.layout)

    def _with(self, do: Mapping[str, Any] | None) -> Plan:
        return Plan(do)

    def _setting(self, given: Mapping[str, Any]) -> Setting:
        return Setting(**{"steps": STEPS if self.is_temporal else 0, "policy": None, **given})
