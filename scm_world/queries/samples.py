"""Settings of episodes, and tables of their outcomes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, final

from scm_world._arguments import one_of, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.graph import SCM, flatten
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.equations import Equations, System, length
from scm_world.queries.plans import Plan
from scm_world.queries.twins import Twins
from scm_world.world.interventions import merged

if TYPE_CHECKING:
    import pandas as pd

STEPS = 25
"""Default number of control steps of an episode: one second at 25 Hz."""


@final
@dataclass(frozen=True)
class Setting:
    """Settings of episodes.

    Attributes:
        policy: The policy; see ``rollout``.
        nature: The context distribution: interventions that are drawn at the beginning of each
            episode, such as ``{"tool_block.mass": "A"}``. Interventions of a query replace them.
        steps: Number of control steps; the task's default if None.
        seed: Seed of the noise; episode i of one seed is the same unit in every query.
        workers: Number of threads, which does not change the result. If the backend steps many
            worlds in one call and the policy is open-loop (``"random"``, ``"sweep"``,
            ``"across"``, given actions, None), these are threads of the backend, and None is the
            number of cores, or one in a worker process. Otherwise None is one.
    """

    policy: Any = "random"
    nature: Mapping[str, Any] | None = None
    steps: int | None = STEPS
    seed: int = 0
    workers: int | None = None

    @classmethod
    def of(cls, system: System, given: Mapping[str, Any]) -> Setting:
        """Return a checked setting; the default policy is random for worlds, idle for equations."""
        for name in given:
            one_of("setting", name, [field.name for field in fields(cls)])
        defaults: dict[str, Any] = {}
        if isinstance(system, Equations):
            defaults = {"steps": None if system.model.is_temporal else 0, "policy": None}
        found = cls(**{**defaults, **given}).named(system.model)
        length(system, found.steps)
        if found.workers is not None:
            whole_number("workers", found.workers, least=1)
        return found

    def named(self, model: SCM) -> Setting:
        """Return the setting with the variables that the patterns of its ``nature`` fit."""
        nature = None if self.nature is None else model.named(flatten(self.nature))
        return self if nature == self.nature else replace(self, nature=nature)

    def unit(
        self, world: System, do: Mapping[str, Any] | None, number: int, names: Iterable[str] = ()
    ) -> Unit:
        """Return an episode to run, with an intervention and the context distribution."""
        nature, acts = Plan(self.nature), Plan(do)
        for name in acts:
            if name in nature and name not in acts.at_start():
                acts = acts.do({name: (*nature[name], *acts[name])})  # nature holds until then
        plan, steps = Plan(merged(world.model, nature, acts)), length(world, self.steps)
        return Unit(self.seed, number, plan, self.policy, steps, as_names(names))

    def episode(
        self, twins: Twins, world: System, do: Mapping[str, Any] | None, number: int, names: Any
    ) -> Episode:
        """Run the episode of ``unit``."""
        unit = self.unit(world, do, number, names)
        with twins.twin() as twin:
            return unit.run(twin, twins)


@final
@dataclass(frozen=True)
class Samples(Mapping[str, Floats]):
    """Outcomes of episodes, one row for each.

    Attributes:
        columns: Values by outcome, shape (n, ...).
        numbers: Numbers of the episodes.
        seed: Seed of the noise.
        plan: The intervention.
    """

    columns: dict[str, Floats]
    numbers: tuple[int, ...]
    seed: int
    plan: Plan

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def frame(self) -> pd.DataFrame:
        """Return a data frame with a row for each episode, indexed by its number."""
        import pandas as pd

        found: dict[str, Floats] = {}
        for name, values in self.columns.items():
            parts = values.reshape(len(self.numbers), -1).T
            found |= {f"{name}[{i}]" if len(parts) > 1 else name: p for i, p in enumerate(parts)}
        return pd.DataFrame(found, index=pd.Index(self.numbers, name="episode"))


def refuse_late(plan: Plan, steps: int) -> None:
    """Refuse interventions that are later than the end of the episode."""
    for name, act in plan.timed():
        if (act.time.start or 0) >= max(steps, 1):
            allowed = (f"a control step before {steps}, where episodes end",)
            raise UnknownOption(f"time of an intervention on {name}", act, allowed)
