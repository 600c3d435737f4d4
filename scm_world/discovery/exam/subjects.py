"""What learners are examined on: models, and views of tasks, each with its declared graph."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, final

import numpy as np

from scm_world.backends import make_backend
from scm_world.discovery.data import Dataset, Design, collect, default_causes, default_outcomes
from scm_world.discovery.data.recorded import first_label, settable
from scm_world.discovery.exam.families import DONE, FAMILIES, check_family, is_family, model
from scm_world.discovery.exam.results import Truth
from scm_world.discovery.exam.views import VIEWS, TaskView, place, projected
from scm_world.discovery.learners.apparatus import Apparatus, Model
from scm_world.discovery.learners.worlds import Outcomes, Steps
from scm_world.errors import UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import SCM, from_json, to_json
from scm_world.queries.face import World
from scm_world.queries.identification import nature_graph
from scm_world.queries.outcomes import as_outcome
from scm_world.queries.samples import Setting
from scm_world.tasks import TASKS, make_task
from scm_world.variables import Box, Derived, Exogenous

FEW = 10  # control steps of an episode of a model through time
START, HEIGHT = ".cartesian_position", ".cylindrical_position"
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
        values = {v.name: _values_of(v) for v in scm.variables if v.settable}
        self._values = {name: act for name, act in values.items() if act is not None}
        self._targets = tuple(self._values)

    def data(self, source: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect rows; under ``"do"``, twice as many are watched as are set for one target.

        The shares are those of 1,000 watched rows beside 500 for each variable.
        """
        seen = 2.0 / (len(self._targets) + 2.0)
        done = source != "see" and self._targets
        design = Design("single", self._targets, self._values, seen) if done else Design()
        episodes = budget if self._steps is None else -(-budget // self._steps)
        circumstances: Any = {} if self._steps is None else {"steps": self._steps}
        return collect(self._scm, design, episodes, seed=seed, **circumstances, **options)

    def test(self, seed: int) -> Dataset | None:
        """Set each variable in turn to 2, where no one has seen it; None if one cannot be 2."""
        if self._steps is not None or any(act != DONE for act in self._values.values()):
            return None
        design = Design("single", self._targets, 2.0, seen=0.0)
        return collect(self._scm, design, 200 * len(self._targets), seed=seed + 1_000_000)

    def apparatus(self, seed: int) -> Apparatus:
        """Do paired experiments on the mechanisms."""
        return Model(self._scm, seed)

    def close(self) -> None:
        """There is nothing to give back."""


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
            drawn[name] = place(standing.low[2], number, len(starts))
        noise = {"sensor_noise": self._view.sensor_noise} if self._view.sensor_noise else {}
        return {**drawn, **noise}

    def _outcome_truth(self, task: str) -> Truth:
        model = self._world.model
        outcomes = [outcome.name for outcome in self._outcomes]
        graph = nature_graph(model, self._nature, outcomes)
        named = {n: f"{first_label(model, n)} {n}".strip() for n in self._causes}
        node = {f"{model.target(n)}@0" if first_label(model, n) else n: f for n, f in named.items()}
        node |= {outcome: outcome for outcome in outcomes}
        edges = tuple((node[c], node[e], 0) for c, e in projected(graph, node))
        ends = tuple(dict.fromkeys(outcomes))
        pairs = tuple((a, b) for i, a in enumerate(ends) for b in ends[i + 1 :])
        names = (*named.values(), *ends)
        return Truth(name=task, names=names, edges=edges, left_out=pairs, about=self._about())

    def _step_truth(self, task: str) -> Truth:
        actions, bundles = self._world.declaration.actions, self._world.declaration.bundles
        outcomes = (outcome.name for outcome in self._outcomes)
        names = tuple(dict.fromkeys((*self._causes, *outcomes, *actions)))
        known = set(names)
        whole = {part: n for n, parts in bundles.items() if n in known for part in parts}
        found = (e.key for e in self._world.model.edges)
        named = ((whole.get(c, c), whole.get(e, e), lag) for c, e, lag in found)
        edges = tuple(
            dict.fromkeys((c, e, lag) for c, e, lag in named if {c, e} <= known and (lag or c != e))
        )
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


def _values_of(variable: Any) -> Any:
    """Say what a variable of a model is set to: its space A, its bounds, or N(2, 1).

    None if it is a whole number or bounded on one side, and says nothing of what it can be.
    """
    if variable.space("A") is not None:
        return "A"
    if variable.bounds is None:
        return DONE if variable.dtype == "real" else None
    if isinstance(variable.bounds, Box):
        low, high = variable.bounds.low, variable.bounds.high
        ends = np.ravel([low, high]) if not variable.bounds.parents() else np.zeros(2)
        return variable.bounds if np.isfinite(ends.astype(float)).all() else None
    return variable.bounds


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


def subject_mark(name: str, view: TaskView) -> str:
    """Give something that changes with a subject: the file of a model, the engine of a task."""
    if name in TASKS:
        backend = make_backend(view.options.get("backend", "mujoco"))
        try:
            return f"{backend.name} {backend.version}"
        finally:
            backend.close()
    if not name.endswith(".json"):
        return ""  # of a family, which follows from its name
    return hashlib.sha256(to_json(_read(Path(name))).encode()).hexdigest()[:16]


def _read(path: Path) -> SCM:
    try:
        return from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        advice = "give a file that scm_world.graph.to_json wrote"
        raise UnreadableFile(str(path), " ".join(str(error).split()), advice) from None


__all__ = ["VIEWS", "ModelSubject", "Subject", "TaskSubject", "TaskView", "subject"]
