"""What learners are examined on: models, and views of tasks, each with its declared graph."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, final

import networkx as nx

from scm_world.discovery.data import Dataset, Design, collect, default_causes, default_outcomes
from scm_world.discovery.data.recorded import first_label, settable
from scm_world.discovery.exam.families import DONE, FAMILIES, check_family, is_family, model
from scm_world.discovery.exam.results import Truth
from scm_world.discovery.learners.apparatus import Apparatus, Model
from scm_world.discovery.learners.worlds import Outcomes, Steps
from scm_world.errors import UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import SCM, from_json
from scm_world.queries.face import World
from scm_world.queries.identification import nature_graph
from scm_world.queries.outcomes import as_outcome
from scm_world.queries.samples import STEPS, Setting
from scm_world.tasks import TASKS, make_task
from scm_world.variables import Box, Derived, Draw, Exogenous

VIEWS = ("outcome", "step")
FEW = 10  # control steps of an episode of a model through time
SENSED = 0.005  # noise of the sensors, as a fraction of half a range
START, HEIGHT = ".cartesian_position", ".cylindrical_position"
HALF = 0.045  # [m] half the side of the square in which a block begins
THROWN = ((1.5, 1.8, 0.0), (2.6, -1.5, 0.0))
"""How fast blocks are thrown [m/s]: between two fingers to the wall, and so that they come back."""
MOST_STARTS = 3  # blocks that find room, each in a sector of its own


class Subject(Protocol):
    """A system with a declared graph, which learners do not see."""

    @property
    def truth(self) -> Truth:
        """Give the declared graph."""

    def data(self, source: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect rows: ``"see"`` or ``"do"``; the first rows are the same for any budget."""

    def test(self, seed: int) -> Dataset | None:
        """Collect rows under interventions that no learner sees; None where there are none."""

    def apparatus(self, seed: int) -> Apparatus:
        """Give something that does paired experiments."""

    def close(self) -> None:
        """Give engines back."""


@final
class ModelSubject:
    """A model without physics. The budget counts rows.

    Args:
        name: To call it by.
        scm: The model.
    """

    def __init__(self, name: str, scm: SCM) -> None:
        self._scm = scm
        self._steps = FEW if any(edge.lag for edge in scm.edges) else None
        edges = tuple(edge.key for edge in scm.edges)
        about = {"kind": "model", "budget": "rows"}
        self.truth = Truth(name=name, names=tuple(scm), edges=edges, about=about)
        self._targets = tuple(v.name for v in scm.variables if v.settable)

    def data(self, source: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect rows; under ``"do"``, a sixth as many again are watched only as one target has.

        The shares are those of 1,000 watched rows beside 500 for each variable.
        """
        seen = 2.0 / (len(self._targets) + 2.0)
        design = Design() if source == "see" else Design("single", self._targets, DONE, seen)
        episodes = budget if self._steps is None else -(-budget // self._steps)
        circumstances: Any = {} if self._steps is None else {"steps": self._steps}
        return collect(self._scm, design, episodes, seed=seed, **circumstances, **options)

    def test(self, seed: int) -> Dataset | None:
        """Set each variable in turn to 2, where no one has seen it."""
        if self._steps is not None:
            return None
        design = Design("single", self._targets, 2.0, seen=0.0)
        return collect(self._scm, design, 200 * len(self._targets), seed=seed + 1_000_000)

    def apparatus(self, seed: int) -> Apparatus:
        """Do paired experiments on the mechanisms."""
        return Model(self._scm, seed)

    def close(self) -> None:
        """There is nothing to give back."""


@final
@dataclass(frozen=True)
class TaskView:
    """How a task is looked at.

    Attributes:
        view: ``"outcome"``: one row per episode: what it begins with, and what it ends with.
            ``"step"``: one row per control step.
        causes: Patterns of what varies, as far as it has a space A; the physical parameters if
            None, and in the view of outcomes where the blocks begin.
        outcomes: Names of variables; the states of joints and blocks, and success, if None.
        policy: Who acts, as ``rollout`` takes it; ``"usual"`` is ``"sweep"`` in the view of
            outcomes, and ``"random"`` by step, so that actions follow from nothing.
        steps: Control steps of an episode.
        sensor_noise: Standard deviation, as a fraction of half the range of what is measured.
        options: Of the world: backend, preset.
        arguments: Of the task.
    """

    view: str = "outcome"
    causes: tuple[str, ...] | None = None
    outcomes: tuple[str, ...] | None = None
    policy: str | None = "usual"
    steps: int = STEPS
    sensor_noise: float = SENSED
    options: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)

    @property
    def acts(self) -> str | None:
        """Who acts."""
        usual = {"outcome": "sweep", "step": "random"}
        return usual[self.view] if self.policy == "usual" else self.policy


@final
class TaskSubject:
    """A task with its physics. The budget counts episodes, or control steps in the view by step.

    Args:
        task: Its name.
        view: How it is looked at.

    Raises:
        UnknownOption: There is no such task or view.
        UnknownVariable: A pattern names nothing that can be set.
    """

    def __init__(self, task: str, view: TaskView) -> None:
        if view.view not in VIEWS:
            raise UnknownOption("view", view.view, VIEWS)
        self._view = view
        self._world = World(make_task(task, **view.arguments), **view.options)
        self._causes = self._chosen()
        given = view.outcomes
        by_step = view.view == "step"
        found = default_outcomes(self._world, every_step=True) if given is None else given
        self._outcomes = tuple(map(as_outcome, found))
        self.truth = self._step_truth(task) if by_step else self._outcome_truth(task)

    def _chosen(self) -> tuple[str, ...]:
        """Choose what varies: with what is computed from it, since that can be set, too."""
        world, model = self._world, self._world.model
        if self._view.causes is not None:
            named = settable(world, self._view.causes)
            found = tuple(name for name in named if self._varies(name))
            if not found:
                varying = [name for name in settable(world, ("*",)) if self._varies(name)]
                raise UnknownVariable(", ".join(self._view.causes), varying)
            return found
        chosen = default_causes(world)
        starts = tuple(name for name in settable(world, ("*",)) if self._is_start(name))
        if self._view.view == "step" or len(starts) > MOST_STARTS:
            starts = ()
        follow = tuple(
            name
            for name in model
            if isinstance(model.declared(name), Derived)
            and model.target(name) == name
            and model.declared(name).settable
            and model.declared(name).space("A") is not None
            and any(parent.name in chosen for parent in model.declared(name).all_parents)
        )
        return (*chosen, *follow, *starts)

    def _varies(self, name: str) -> bool:
        """Tell whether values can be drawn for a variable, which is no other name of one."""
        model = self._world.model
        if self._is_start(name):
            return self._view.view == "outcome"
        variable = model.declared(name)
        return model.target(name) == name and variable.space("A") is not None

    @property
    def _nature(self) -> dict[str, Any]:
        """Let everything vary by itself that has a space of its own.

        Blocks begin near the middle, each in a sector of its own, so that no draw has to be
        rejected: rejection would make everything that is drawn depend on everything else.
        """
        model = self._world.model
        starts = [n for n in self._causes if self._is_start(n)]
        drawn: dict[str, Any] = {
            n: "A" for n in self._causes if isinstance(model.declared(n), Exogenous)
        }
        for number, name in enumerate(starts):
            standing: Any = model.declared(name.removesuffix(START) + HEIGHT).a
            drawn[name] = _place(standing.low[2], number, len(starts))
        noise = {"sensor_noise": self._view.sensor_noise} if self._view.sensor_noise else {}
        return {**drawn, **noise}

    def _outcome_truth(self, task: str) -> Truth:
        model = self._world.model
        outcomes = [outcome.name for outcome in self._outcomes]
        graph = nature_graph(model, self._nature, outcomes)
        named = {n: f"{first_label(model, n)} {n}".strip() for n in self._causes}
        node = {f"{model.target(n)}@0" if first_label(model, n) else n: f for n, f in named.items()}
        node |= {outcome: outcome for outcome in outcomes}
        edges = tuple((node[c], node[e], 0) for c, e in _projected(graph, node))
        ends = tuple(dict.fromkeys(outcomes))
        pairs = tuple((a, b) for i, a in enumerate(ends) for b in ends[i + 1 :])
        names = (*named.values(), *ends)
        return Truth(name=task, names=names, edges=edges, left_out=pairs, about=self._about())

    def _step_truth(self, task: str) -> Truth:
        names = tuple(dict.fromkeys((*self._causes, *(o.name for o in self._outcomes), "action")))
        known = set(names)
        edges = tuple(e.key for e in self._world.model.edges if {e.cause, e.effect} <= known)
        return Truth(name=f"{task}/step", names=names, edges=edges, about=self._about())

    def _about(self) -> dict[str, Any]:
        view, backend = self._view, self._world.backend
        return {
            "kind": f"task, view by {view.view}",
            "budget": "episodes" if view.view == "outcome" else "control steps",
            "engine": f"{backend.name} {backend.version}",
            "policy": view.acts,
            "steps": view.steps,
            "sensor_noise": view.sensor_noise,
            "options": {k: str(v) for k, v in view.options.items()},
            "arguments": {k: str(v) for k, v in view.arguments.items()},
        }

    def data(self, source: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect episodes; under ``"do"`` half of the causes are set in seven of ten, in A|B."""
        by_step = self._view.view == "step"
        episodes = -(-budget // self._view.steps) if by_step else budget
        return collect(
            self._world,
            Design() if source == "see" else Design("half", self._causes, self._values),
            episodes,
            seed=seed,
            steps=self._view.steps,
            policy=self._view.acts,
            nature=self._nature,
            causes=self._causes,
            outcomes=self._outcomes,
            every_step=by_step,
            **options,
        )

    @property
    def _values(self) -> Mapping[str, Any]:
        nature, declared = self._nature, self._world.model.declared
        wide = {n: "A|B" for n in self._causes if declared(n).space("B") is not None}
        return {**{name: nature.get(name, "A") for name in self._causes}, **wide}

    def test(self, seed: int) -> Dataset | None:
        """There are none: the effects of single values of a world are not linear."""
        return None

    def apparatus(self, seed: int) -> Apparatus:
        """Do paired experiments, without noise of the sensors, in turn under four circumstances.

        These are the policy of the view, a finger that pushes across, and blocks that are thrown
        at the wall: past the fingers, and so hard that they come back and hit one.
        """
        if self._view.view == "step":
            return Steps(self._world, seed)
        nature = {n: act for n, act in self._nature.items() if n != "sensor_noise"}
        length = self._view.steps
        settings = (
            Setting(self._view.acts, nature, length, seed),
            Setting("across", nature, length, seed),
            *(Setting(None, {**nature, **self._thrown(fast)}, length, seed) for fast in THROWN),
        )
        return Outcomes(self._world, self._causes, self._outcomes, settings)

    def _thrown(self, fast: tuple[float, float, float]) -> dict[str, Any]:
        blocks = (n.removesuffix(START) for n in self._causes if self._is_start(n))
        return {f"{block}.linear_velocity": fast for block in blocks}

    def _is_start(self, name: str) -> bool:
        return name.endswith(START) and self._world.model.declared(name).role == "state"

    def close(self) -> None:
        """Give the engine back."""
        self._world.close()


def _projected(graph: nx.DiGraph, kept: Collection[str]) -> list[tuple[str, str]]:
    """Leave out nodes that follow from others without noise: their causes act in their place."""
    found = set()
    for cause in kept:
        ahead = [cause] if cause in graph else []
        while ahead:
            for effect in graph.successors(ahead.pop()):
                if effect in kept:
                    found.add((cause, effect))
                else:
                    ahead.append(effect)
    return sorted(found)


def _place(height: Any, number: int, count: int) -> Draw:
    """Draw where one of several blocks begins: near the middle, at least as high as it has to be.

    Args:
        height: Of its center, as its space A says.
        number: Of the block.
        count: Of the blocks.
    """
    far = 0.0 if count == 1 else 0.075
    angle = 2.0 * math.pi * number / count
    x, y = far * math.cos(angle), far * math.sin(angle)
    half = HALF if count == 1 else 0.2 * HALF
    return Draw(Box((x - half, y - half, height), (x + half, y + half, height)))


def subject(name: str, *, seed: int = 0, view: TaskView | None = None) -> Subject:
    """Find what learners are examined on.

    Args:
        name: A family with a size (``"er2:20"``), a task, or a JSON file of a model.
        seed: Which model of the family.
        view: How a task is looked at.

    Raises:
        UnknownOption: There is nothing of this name.
        UnreadableFile: The file holds no model.
    """
    check_subject(name)
    if name in TASKS:
        return TaskSubject(name, view or TaskView())
    if is_family(name):
        return ModelSubject(name, model(name, seed))
    return ModelSubject(Path(name).stem, _read(Path(name)))


def check_subject(name: str) -> None:
    """Refuse what is no subject, without making one.

    Raises:
        UnknownOption: There is nothing of this name.
        UnreadableFile: The file holds no model.
    """
    if is_family(name):
        check_family(name)
    elif name.endswith(".json"):
        _read(Path(name))
    elif name not in TASKS:
        families = (f"{family}:N" for family in FAMILIES)
        raise UnknownOption("subject", name, (*TASKS, *families, "FILE.json"))


def _read(path: Path) -> SCM:
    try:
        return from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        advice = "give a file that scm_world.graph.to_json wrote"
        raise UnreadableFile(str(path), " ".join(str(error).split()), advice) from None


__all__ = ["VIEWS", "ModelSubject", "Subject", "TaskSubject", "TaskView", "subject"]
