"""Benchmark problems for learners: causal models and worlds, each with its true graph."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world import queries
from scm_world._arguments import one_of, typed, whole_number
from scm_world._fingerprint import digest, fingerprint
from scm_world._types import Floats
from scm_world.discovery.data import Dataset, Design, collect, default_causes, default_outcomes
from scm_world.discovery.data.recorded import first_name, settable
from scm_world.discovery.data.truth import GroundTruth as GroundTruth
from scm_world.discovery.data.truth import observed_part, truth_of_model
from scm_world.discovery.data.worlds import EpisodeRows
from scm_world.discovery.learners.paired import (
    EpisodeSimulator,
    PairedSimulator,
    SystemSimulator,
)
from scm_world.errors import ModelError, UnknownVariable
from scm_world.graph import SCM
from scm_world.policies.scripted import as_policy
from scm_world.queries.equations import as_given
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.probes import rounds_at
from scm_world.queries.samples import STEPS, Outcome, Setting, named_outcomes, read
from scm_world.queries.twins import twins_of
from scm_world.tasks import AnySource, Task, TriFingerTask, read_source
from scm_world.tasks.families import DONE, Servos, Springs, is_family, sized
from scm_world.tasks.sources import FILES, made_from
from scm_world.variables import Box, Draw, Variable
from scm_world.world import Simulation

__all__ = ["Problem", "TaskView", "problem"]

# --- problems -------------------------------------------------------------------------------------


@final
@dataclass(frozen=True, kw_only=True)
class Problem:
    """A system with a true graph, which learners do not see.

    Attributes:
        truth: The true graph.
        system: The world or the model that is collected from.
        design: The interventions of interventional data.
        simulator: Returns the paired simulator for a seed.
        setting: Further arguments of ``collect``.
        rows: Rows of an episode, where a budget counts rows; it counts episodes if 1.
        tidy: Makes the rows that learners are given of those that were collected.
        terms: Everything else that decides the data and the graph, by name.
    """

    truth: GroundTruth
    system: Simulation | SCM
    design: Design
    simulator: Callable[[int], PairedSimulator]
    setting: Mapping[str, Any] = field(default_factory=dict)
    rows: int = 1
    tidy: Callable[[Dataset], Dataset] = lambda table: table
    terms: Mapping[str, Any] = field(default_factory=dict)

    def __fingerprint__(self) -> dict[str, Any]:
        return {**self.system.__fingerprint__(), **self.terms}

    def data(self, kind: str, budget: int, seed: int, **options: object) -> Dataset:
        """Collect ``"observational"`` or ``"interventional"`` rows.

        The first rows are the same for any budget. Options are those of ``collect``.

        Raises:
            ModelError: No row of the interventional ones is targeted.
        """
        n = -(-whole_number("budget", budget, least=1) // self.rows)
        design = Design() if kind == "observational" else self.design
        given: dict[str, Any] = {**self.setting, **options}
        table = self.tidy(collect(self.system, design, n, seed=seed, **given))
        return refuse_untargeted(table) if kind == "interventional" else table

    def close(self) -> None:
        """Close the backend, if there is one."""
        if not isinstance(self.system, SCM):
            self.system.close()


def refuse_untargeted(table: Dataset) -> Dataset:
    """Return a table of interventional rows, or refuse one in which nothing was set."""
    if not table.intervened.any():
        said = f"none of {len(table)} interventional rows is targeted"
        advice = "raise the budget, let something vary, or take observational data"
        raise ModelError([f"{said}: {advice}"])
    return table


EPISODE = 10  # control steps of an episode of a model with lags


def model_problem(name: str, scm: SCM, hidden: Sequence[str] = ()) -> Problem:
    """Return a causal model without physics as a problem. The budget counts rows.

    Each target gets half as many rows as are observational, as with 1,000 observational rows beside
    500 for each variable.

    Args:
        name: To show.
        scm: The model.
        hidden: Variables that are in no table and are never set.
    """
    names, edges = tuple(n for n in scm if n not in hidden), tuple(e.key for e in scm.edges)
    about: dict[str, Any] = {"kind": "model", "budget": "rows"}
    truth = GroundTruth(name=name, names=names, edges=edges, about=about)
    if hidden:
        about["hidden"] = len(hidden)
        projected = observed_part(name, truth_of_model(scm), names)
        truth = replace(projected, weights={}, about=about)
    found = {name: _values_of(scm[name]) for name in names if scm[name].settable}
    values = {name: act for name, act in found.items() if act is not None}
    targets, lagged = tuple(values), any(edge.lag for edge in scm.edges)

    def simulated(seed: int) -> PairedSimulator:
        if hidden:
            what = f"{name} hides variables, which paired experiments would set"
            raise ModelError([f"{what}; take data='observational' or 'interventional'"])
        return SystemSimulator(scm, seed)

    return Problem(
        truth=truth,
        system=scm,
        design=Design("single", targets, values, 2.0 / (len(values) + 2.0)) if values else Design(),
        simulator=simulated,
        setting={"steps": EPISODE} if lagged else {},
        rows=EPISODE if lagged else 1,
        tidy=lambda table: table.hide(hidden) if hidden else table,
        terms={"hidden": tuple(hidden), "values": values},
    )


def _values_of(variable: Variable) -> Any:
    """Return the values that a variable is set to: its space A, its bounds, or N(2, 1).

    None if it is an integer or bounded on one side, and no space bounds it.
    """
    bounds = variable.bounds
    if variable.space("A") is not None:
        return "A"
    if bounds is None:
        return DONE if variable.dtype == "real" else None
    if isinstance(bounds, Box) and not bounds.parents():
        ends = np.ravel([bounds.low, bounds.high]).astype(float)
        return bounds if np.isfinite(ends).all() else None
    return bounds


def servo_problem(name: str, made: Servos, options: Mapping[str, Any]) -> Problem:
    """Return where the arms of a network of servos come to rest. The budget counts episodes.

    An intervention on an arm holds the command of its servo, however the others move. Each arm is
    held in half as many episodes as there are without an intervention.

    Args:
        name: To show.
        made: The network.
        options: Options of the world, such as its backend.
    """
    world, arms = Simulation(made.task, **options), tuple(made.arms.values())
    forces = sorted({cause for cause, _ in made.edges} - {*arms})
    edges = [[cause, effect, 0, None] for cause, effect in made.edges]
    written = {"edges": edges, "noisy": [*arms, *forces]}
    about = {
        "kind": "servos",
        "budget": "episodes",
        "backend": f"{world.backend.name} {world.backend.version}",
        "steps": made.steps,
        "hidden": len(forces),
    }

    def tidy(table: Dataset) -> Dataset:
        """Name the arms that were held, not their commands."""
        regimes = tuple(
            replace(regime, targets=tuple(sorted(made.arms[one] for one in regime.targets)))
            for regime in table.regimes
        )
        known = {**table.about, "system": name, "truth": written}
        return replace(table.select(arms), regimes=regimes, about=known)

    return Problem(
        truth=replace(observed_part(name, written, arms), about=about),
        system=world,
        design=Design("single", tuple(made.arms), made.holds, 2.0 / (len(arms) + 2.0)),
        simulator=lambda seed: ServoSimulator(world, made, seed),
        setting={
            "steps": made.steps,
            "policy": None,
            "nature": made.plan,
            "causes": (),
            "outcomes": arms,
        },
        tidy=tidy,
        terms={"nature": made.plan, "engine": world.engine},
    )


@final
class ServoSimulator:
    """Paired experiments on a network of servos.

    A unit is an episode. All arms but one are held where they come to rest without an intervention;
    then one of them is held elsewhere. The change of the free arm is a direct effect.

    Attributes:
        names: Names of the arms.
    """

    def __init__(self, world: Simulation, made: Servos, seed: int) -> None:
        world.require_exact("a paired experiment on a network of servos", independent=True)
        self._world, self._twins, self._servos = world, twins_of(world), tuple(made.arms)
        self.names = tuple(made.arms.values())
        self._setting = Setting(None, made.plan, made.steps, seed)

    def effects(self, budget: int) -> Effects:
        """Move one arm at a time, in one unit after another; see ``PairedSimulator``."""
        found, unit = Effects(least=rounds_at(self._world)), 0

        def at_rest(do: Mapping[str, Any]) -> Floats:
            """Return the angles [rad] at the end of an episode, shape (n,)."""
            found.rollouts += 1
            recipe = self._setting.unit(self._world, do, unit, self.names)
            episode = self._twins.episode(recipe)
            return np.array([float(read(Outcome(name), episode)) for name in self.names])

        while found.rollouts < budget:
            held, again = at_rest({}), at_rest({})
            for name, one, other in zip(self.names, held, again, strict=True):
                found.see_unstable(name, abs(float(other - one)))
            elsewhere = np.random.default_rng([self._setting.seed, unit]).uniform(-1, 1, len(held))
            for effect in range(len(held)):
                others = [i for i in range(len(held)) if i != effect]
                do = {self._servos[i]: float(held[i]) for i in others}
                before = at_rest(do)[effect]
                for cause in others:
                    moved = {**do, self._servos[cause]: float(elsewhere[cause])}
                    found.see(
                        (self.names[cause], self.names[effect], 0), at_rest(moved)[effect], before
                    )
            unit += 1
        return found


VIEWS = ("outcome", "step")
SENSED = 0.005  # noise of the sensors, as a fraction of half a range
HALF = 0.045  # [m] half the side of the square in which a block begins
START, HEIGHT = ".cartesian_position", ".cylindrical_position"
THROWN = ((1.5, 1.8, 0.0), (2.6, -1.5, 0.0))
"""How fast blocks are thrown [m/s]: between two fingers to the wall, and so that they come back."""
MOST_STARTS = 3  # blocks that find room, each in a sector of its own


@typed
@final
@dataclass(frozen=True)
class TaskView:
    """Which variables of a task or model are causes and outcomes, and how episodes run.

    Attributes:
        view: ``"outcome"``: one row per episode: its start and its end.
            ``"step"``: one row per control step.
        causes: Patterns of the varied variables with a space A; the physical parameters if
            None, and in the view of outcomes where the blocks begin.
        outcomes: Names of variables; the states of joints and blocks, and success, if None.
        policy: As ``rollout`` takes it; ``"usual"`` is ``"sweep"`` for outcomes of the TriFinger's
            tasks and ``"random"`` otherwise, so that actions have no causes.
        steps: Control steps of an episode.
        sensor_noise: Standard deviation, as a fraction of half the range of the measured variable;
            only worlds that declare sensor noise have it.
        contacts: Whether to record contacts, and to score each context for itself: rows in which
            edges by contact can act, and rows in which none can.
        options: Options of the world: backend, preset.
        arguments: Arguments of the task.

    Raises:
        UnknownOption: The view is unknown.
    """

    view: str = "outcome"
    causes: tuple[str, ...] | None = None
    outcomes: tuple[str, ...] | None = None
    policy: str | None = "usual"
    steps: int = STEPS
    sensor_noise: float = SENSED
    contacts: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        one_of("view", self.view, VIEWS)
        known = [*inspect.signature(Simulation).parameters][1:]
        for name in self.options:
            one_of("option of a world", name, known)


def world_problem(label: str, task: Task, view: TaskView) -> Problem:
    """Return a task or a model with its physics. The budget counts episodes, or control steps.

    Seven of ten interventional episodes set half of the causes, in A|B. Blocks begin near the
    middle, each in a sector of its own, so that no draw has to be rejected: rejection would make
    everything that is drawn depend on everything else.

    Args:
        label: The name of the problem in tables.
        task: The task.
        view: Causes, outcomes and episodes.

    Raises:
        UnknownVariable: A pattern names nothing that can be set.
    """
    by_step = view.view == "step"
    world = Simulation(task, **view.options)
    model, declared = world.model, world.model.declared
    try:
        is_robot = isinstance(world.task, TriFingerTask)
        policy = view.policy
        if policy == "usual":
            policy = "sweep" if is_robot and not by_step else "random"
        as_policy(policy)
        causes = _causes(world, view)
        starts = [cause for cause in causes if _is_start(model, cause)]
        drawn: dict[str, Any] = {n: "A" for n in causes if declared(n).is_root}
        far, half = (0.0, HALF) if len(starts) == 1 else (0.075, 0.2 * HALF)
        for number, start in enumerate(starts):
            standing: Any = declared(start.removesuffix(START) + HEIGHT).a
            angle, z = 2.0 * math.pi * number / len(starts), standing.low[2]
            x, y = far * math.cos(angle), far * math.sin(angle)
            drawn[start] = Draw(Box((x - half, y - half, z), (x + half, y + half, z)))
        contexts = dict(drawn)
        if view.sensor_noise and "sensor_noise" in model:
            contexts["sensor_noise"] = view.sensor_noise
        usual = default_outcomes(world, every_step=True)
        outcomes = named_outcomes(view.outcomes or usual, "outcome of a problem")
        recorded: dict[str, Any] = {
            "causes": causes,
            "outcomes": outcomes,
            "every_step": by_step,
            "contacts": view.contacts,
        }
        rows = EpisodeRows(world, Design(), Setting(policy, contexts, view.steps), **recorded)
        place = {first_name(model, cause): i for i, cause in enumerate(causes)}
        there = dict.fromkeys(column.variable for column in rows.columns)
        names = sorted(there, key=lambda name: place.get(name, len(place)))
        truth = observed_part(label, rows.about["truth"], names)
    except BaseException:
        world.close()
        raise
    about = {
        "kind": f"task, view by {view.view}",
        "budget": "control steps" if by_step else "episodes",
        "backend": f"{world.backend.name} {world.backend.version}",
        "policy": policy,
        "steps": view.steps,
        "sensor_noise": view.sensor_noise,
        "options": {k: str(v) for k, v in view.options.items()},
        "arguments": {k: str(v) for k, v in view.arguments.items()},
    }
    values = {n: contexts.get(n, "A") for n in causes}
    values |= {n: "A|B" for n in causes if declared(n).space("B") is not None}

    def simulated(seed: int) -> PairedSimulator:
        """Return experiments without sensor noise, under several circumstances in turn.

        On the TriFinger these are the policy of the view, a finger that pushes across, and blocks
        that are thrown at the wall: past the fingers, and so hard that they come back and hit one.
        """
        if by_step:
            return SystemSimulator(world, seed)
        kinds: list[tuple[Any, dict[str, Any]]] = [(policy, {})]
        if is_robot:
            speeds = [f"{start.removesuffix(START)}.linear_velocity" for start in starts]
            kinds += [("across", {}), *((None, dict.fromkeys(speeds, fast)) for fast in THROWN)]
        settings = [Setting(who, {**drawn, **more}, view.steps, seed) for who, more in kinds]
        return EpisodeSimulator(world, causes, outcomes, settings)

    return Problem(
        truth=replace(truth, about=about),
        system=world,
        design=Design("half", causes, values) if causes else Design(),
        simulator=simulated,
        setting={"steps": view.steps, "policy": policy, "nature": contexts, **recorded},
        rows=view.steps if by_step else 1,
        terms={"policy": policy, "engine": world.engine},
    )


def _causes(world: Simulation, view: TaskView) -> tuple[str, ...]:
    """Return the varied variables, and those computed from them, since they can be set, too."""
    model, by_step = world.model, view.view == "step"

    def varies(name: str) -> bool:
        if _is_start(model, name):
            return not by_step
        return model.target(name) == name and model.declared(name).space("A") is not None

    varying = [name for name in settable(world, ("*",)) if varies(name)]
    if view.causes is not None:
        found = tuple(name for name in settable(world, view.causes) if name in varying)
        if not found:
            raise UnknownVariable(", ".join(view.causes), varying)
        return found
    chosen = default_causes(world)
    if not (chosen or by_step):
        advice = "give variables a space A (spaces= of ModelTask), or take the view 'step'"
        raise ModelError([f"nothing of {world.task.name} varies between episodes: {advice}"])
    starts = [name for name in varying if _is_start(model, name)]
    follow = [
        name
        for name, variable in ((name, model.declared(name)) for name in varying)
        if variable.role == "parameter"
        and not variable.is_root
        and any(parent.name in chosen for parent in variable.all_parents)
    ]
    return (*chosen, *follow, *(starts if len(starts) <= MOST_STARTS else ()))


def _is_start(model: SCM, name: str) -> bool:
    """Return whether a variable is where a block begins."""
    is_place = name.endswith(START) and name.removesuffix(START) + HEIGHT in model
    return is_place and model.declared(name).role == "state"


# --- by name --------------------------------------------------------------------------------------


@typed
def problem(name: AnySource, *, seed: int = 0, view: TaskView | None = None) -> Problem:
    """Return a benchmark problem.

    Args:
        name: A source (see ``scm_world.tasks.read_source``), or a function that returns a
            ``Problem``. A family with three further, hidden variables is ``"er2:20:3"``.
        seed: Which model of the family.
        view: View of a task or a world.

    Raises:
        Those of ``read_source``.

    Example:
        >>> problem("er2:5").truth.names
        ('x0', 'x1', 'x2', 'x3', 'x4')
    """
    view, seed = view or TaskView(), whole_number("seed", seed, least=0)
    of_family = isinstance(name, str) and is_family(name)
    arguments = {"seed": seed, **view.arguments} if of_family else view.arguments
    made = as_given(made_from(name, arguments))
    if isinstance(made, Problem):
        return made
    label = problem_label(name if isinstance(name, str) else made, view)
    if isinstance(made, Servos):
        return servo_problem(label, made, view.options)
    source = read_source(made)
    if not isinstance(source.made, SCM):
        view = replace(view, view="step") if isinstance(made, Springs) else view
        return world_problem(label, source.task(), view)
    model = queries.SCM(source.made)
    model = model.given(source.plan) if source.plan else model
    hidden = sized(name)[2] if of_family else 0
    ranked = sorted(model, key=lambda n: (-len(model.children(n)), n))  # by how much it acts on
    return model_problem(label, model, ranked[:hidden])


def problem_label(name: AnySource, view: TaskView) -> str:
    """Return the name of a problem in tables; for a model it has a digest."""
    if not isinstance(name, str):
        made = read_source(name).made
        if isinstance(made, SCM):
            return f"model {digest(fingerprint(made, libraries=False))[:8]}"
        name = made.name
    if is_family(name) or name.endswith(".json"):
        return Path(name).stem if name.endswith(".json") else name
    home, colon, function = name.rpartition(":")
    short = f"{Path(home).stem if home.endswith('.py') else home}:{function}" if colon else name
    short = Path(name).stem if name.endswith(FILES) else short
    return f"{short}/step" if view.view == "step" else short
