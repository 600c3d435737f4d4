"""Benchmark problems for learners: causal models and worlds, each with its true graph."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, final, runtime_checkable

import networkx as nx
import numpy as np

from scm_world import queries
from scm_world._arguments import one_of, typed, whole_number
from scm_world._fingerprint import digest, fingerprint
from scm_world._types import Floats, Value
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
from scm_world.discovery.physics import PHYSICS, ServoProblem, Springs, numbers_of, servo
from scm_world.errors import ModelError, UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import SCM, from_json
from scm_world.policies.scripted import as_policy
from scm_world.queries.equations import Equations
from scm_world.queries.outcomes import as_outcome
from scm_world.queries.samples import STEPS, Setting
from scm_world.runs.files import read_text
from scm_world.tasks import TASKS, Task, TriFingerTask, make_task
from scm_world.tasks.factories import FILES, load_factory
from scm_world.variables import Box, Derived, Draw, Exogenous, Function, Linear, Parent
from scm_world.variables.distributions import Normal
from scm_world.world import Simulation

# --- random models --------------------------------------------------------------------------------

WEAKEST, STRONGEST = 0.5, 2.0  # absolute weights, uniform between them; the sign is drawn
PER_NODE = 2  # edges per node of the static families
MOST = 1000  # variables
DONE = Normal(mean=2.0, std=1.0)
"""What interventions draw in random models by default: another mean, the same spread."""


class Family(NamedTuple):
    """Random models: how the graph and the mechanisms are drawn, the number in the seed, words."""

    graph: Literal["random", "hubs first", "hubs last", "step"]
    mechanism: str
    number: int
    doc: str


ER = "Erdős–Rényi DAG"
SF = "Scale-free DAG"
FAMILIES: Mapping[str, Family] = {
    "er2": Family("random", "linear", 1, f"{ER}, 2 edges per node, linear Gaussian"),
    "sf2": Family(
        "hubs first",
        "linear",
        2,
        f"{SF} (Barabási–Albert, 2 per node), linear Gaussian; hubs are causes",
    ),
    "sf2in": Family("hubs last", "linear", 2, f"{SF}, linear Gaussian; hubs are effects"),
    "mlp2": Family(
        "random", "network", 4, f"{ER}, a random network of ten tanh units for each variable"
    ),
    "gp2": Family(
        "random",
        "process",
        5,
        f"{ER}, a function of a Gaussian process (length 1) for each variable",
    ),
    "sine2": Family("random", "sine", 6, f"{ER}, a weighted sum of a sine of each cause"),
    "iscm2": Family(
        "random", "standardised", 7, f"{ER}, linear Gaussian, every variable with variance 1 (iSCM)"
    ),
    "uneven2": Family(
        "random", "uneven", 8, f"{ER}, linear, the spread of the noise depends on the causes"
    ),
    "heavy2": Family("random", "heavy", 9, f"{ER}, linear, noise with heavy tails (kurtosis 11.7)"),
    "tanh4": Family("step", "tanh", 3, "One control step, at most 4 causes each, tanh of a sum"),
}
"""By name. Weights are uniform in ±[0.5, 2], noise has standard deviation 1 (0.1 for ``tanh4``).

In ``mlp2`` both layers have such weights, the second one times 2 / √10; functions of ``gp2`` have
standard deviation 2; in ``sine2`` frequencies are uniform in [1, 3].
"""


@typed
def random_model(name: str, seed: int = 0) -> SCM:
    """Draw model number ``seed`` of a family, ``"er2:20"`` for 20 variables.

    Raises:
        UnknownOption: There is no such family or size.

    Source:
        Zheng et al., *DAGs with NO TEARS*, NeurIPS 2018, section 5.1, for weights and densities;
        Barabási and Albert, *Emergence of scaling in random networks*, Science 1999; Ormaniec et
        al., *Standardizing structural causal models*, ICLR 2025, for variables of variance 1;
        Rahimi and Recht, *Random features for large-scale kernel machines*, NeurIPS 2007, for
        Gaussian processes as sums of cosines.

    Example:
        >>> len(random_model("er2:20", seed=0))
        20
    """
    whole_number("seed", seed, least=0)
    family, _, size = name.partition(":")
    if family not in FAMILIES or not re.fullmatch(r"[0-9]+", size) or not 2 <= int(size) <= MOST:
        shown = tuple(f"{known}:N" for known in FAMILIES)
        raise UnknownOption("family of models", name, (*shown, f"with N from 2 to {MOST}"))
    n, (graph, kind, number, _) = int(size), FAMILIES[family]
    rng = np.random.default_rng([int(seed), n, number])
    names = [f"x{i:0{len(str(n - 1))}d}" for i in range(n)]
    made: list[Derived] = []
    if graph == "step":
        for each in names:
            causes = rng.choice(n, size=int(rng.integers(1, min(4, n) + 1)), replace=False)
            lagged = tuple(Parent(names[i], 1) for i in causes)
            weights = tuple(_signed(rng, len(causes)).tolist())
            mechanism: Any = Function(tanh_of_sum, constants={"weights": weights})
            noise = Normal(mean=0.0, std=0.1)
            made.append(Derived(name=each, parents=lagged, mechanism=mechanism, noise=noise))
        return SCM(made)
    upper = np.zeros((n, n), bool)
    if graph == "random":
        upper = np.triu(rng.random((n, n)) < min(1.0, 2.0 * PER_NODE / (n - 1)), 1)
    else:
        drawn = nx.barabasi_albert_graph(n, min(PER_NODE, n - 1), seed=int(rng.integers(2**31)))
        for one, other in drawn.edges:
            upper[min(one, other), max(one, other)] = True  # hubs come early: they cause much
        upper = upper[::-1, ::-1].T if graph == "hubs last" else upper
    size_of = _signed(rng, (n, n))
    places = rng.permutation(n)  # of the causal order among the names
    upper_weights, stds = np.where(upper, size_of, 0.0), np.ones(n)
    if kind == "standardised":
        totals = np.zeros((n, n))  # of each variable, the weights of all noise
        for j in range(n):
            totals[j] = upper_weights[:, j] @ totals + np.eye(n)[j]
            stds[j] = 1.0 / np.linalg.norm(totals[j])
            totals[j] *= stds[j]
            upper_weights[:, j] *= stds[j]
    all_weights, noise_of = np.zeros((n, n)), np.ones(n)
    all_weights[np.ix_(places, places)], noise_of[places] = upper_weights, stds
    for j, each in enumerate(names):
        ids = np.flatnonzero(all_weights[:, j]).tolist()
        mechanism = _mechanism(kind, all_weights[ids, j], rng)
        parents = tuple(names[i] for i in ids)
        noise = Normal(mean=0.0, std=float(noise_of[j]))
        made.append(Derived(name=each, parents=parents, mechanism=mechanism, noise=noise))
    return SCM(made)


def _signed(rng: np.random.Generator, shape: Any) -> Floats:
    return np.asarray(rng.uniform(WEAKEST, STRONGEST, shape) * rng.choice([-1.0, 1.0], shape))


def _mechanism(kind: str, weights: Floats, rng: np.random.Generator) -> Any:
    """Draw the mechanism of a variable with these weights of its causes."""
    w, k = tuple(weights.tolist()), len(weights)
    if kind in ("linear", "standardised"):
        return Linear(weights=w)
    if kind == "uneven":
        spread = tuple((rng.normal(size=k) / max(k, 1)).tolist())
        return Function(uneven, constants={"weights": w, "spread": spread})
    if kind == "heavy":
        return Function(heavy, constants={"weights": w})
    if kind == "network":
        inner, outer = _signed(rng, (k, 10)), 2.0 * _signed(rng, 10) / math.sqrt(10)
        phase = rng.normal(size=10)
    elif kind == "process":
        inner, phase = rng.normal(size=(k, 200)), rng.uniform(0.0, 2.0 * np.pi, 200)
        outer = 0.2 * rng.normal(size=200)
    else:
        inner, phase = np.diag(rng.uniform(1.0, 3.0, k)), rng.uniform(0.0, 2.0 * np.pi, k)
        outer = weights
    given = {"inner": inner, "phase": phase, "outer": outer}
    constants: dict[str, Any] = {n: tuple(np.ravel(v).tolist()) for n, v in given.items()}
    return Function(layer, constants={**constants, "wave": float(kind != "network")})


def tanh_of_sum(*parents: Value, noise: Value | float = 0.0, weights: Floats) -> Any:
    """Return the hyperbolic tangent of a weighted sum, plus noise."""
    total = sum(w * parent for w, parent in zip(weights, parents, strict=True))
    return np.tanh(total) + noise


def layer(
    *parents: Value,
    noise: Value | float = 0.0,
    inner: Floats,
    phase: Floats,
    outer: Floats,
    wave: float,
) -> Any:
    """Return a network with one layer of tanh, or of cosines, plus noise."""
    if not parents:
        return noise
    x = np.stack(np.broadcast_arrays(*parents), axis=-1)
    bent = x @ np.reshape(inner, (len(parents), -1)) + np.asarray(phase)
    return (np.cos(bent) if wave else np.tanh(bent)) @ np.asarray(outer) + noise


def uneven(*parents: Value, noise: Value | float = 0.0, weights: Floats, spread: Floats) -> Any:
    """Return a weighted sum, plus noise whose spread depends on another weighted sum."""
    total = sum((w * x for w, x in zip(weights, parents, strict=True)), np.zeros(()))
    size = sum((w * x for w, x in zip(spread, parents, strict=True)), np.zeros(()))
    return total + noise * np.exp(np.tanh(size))


def heavy(*parents: Value, noise: Value | float = 0.0, weights: Floats) -> Any:
    """Return a weighted sum, plus noise squared with its sign, of variance 1."""
    total = sum((w * x for w, x in zip(weights, parents, strict=True)), np.zeros(()))
    return total + noise * np.abs(noise) / math.sqrt(3.0)


# --- problems -------------------------------------------------------------------------------------


@runtime_checkable
class Problem(Protocol):
    """A system with a true graph, which learners do not see.

    Attributes:
        truth: The true graph.
    """

    truth: GroundTruth

    def __fingerprint__(self) -> dict[str, Any]:
        """Return everything that decides its data and its true graph, by name."""

    def data(self, kind: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect ``"observational"`` or ``"interventional"`` rows.

        The first rows are the same for any budget. Options are those of ``collect``.
        """

    def held_out(self, seed: int) -> Dataset | None:
        """Collect rows under interventions that no learner is given; None where there are none."""

    def simulator(self, seed: int) -> PairedSimulator:
        """Return the paired simulator of the problem."""

    def close(self) -> None:
        """Close the backend."""


@final
class SCMProblem:
    """A causal model without physics. The budget counts rows.

    Args:
        name: To show.
        scm: The model.
        hidden: Variables that are in no table and are never set.
    """

    EPISODE = 10  # control steps of an episode of a model with lags

    def __init__(self, name: str, scm: SCM, hidden: Sequence[str] = ()) -> None:
        self._scm, self._hidden = scm, tuple(hidden)
        self._steps = self.EPISODE if any(edge.lag for edge in scm.edges) else None
        names, edges = tuple(n for n in scm if n not in hidden), tuple(e.key for e in scm.edges)
        about: dict[str, Any] = {"kind": "model", "budget": "rows"}
        self.truth = GroundTruth(name=name, names=names, edges=edges, about=about)
        if hidden:
            about["hidden"] = len(hidden)
            projected = observed_part(name, truth_of_model(scm), names)
            self.truth = replace(projected, weights={}, about=about)
        values = {name: _values_of(scm[name]) for name in names if scm[name].settable}
        self._values = {name: act for name, act in values.items() if act is not None}

    def __fingerprint__(self) -> dict[str, Any]:
        return {**self._scm.__fingerprint__(), "hidden": self._hidden, "values": self._values}

    def data(self, kind: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect rows; each target gets half as many rows as are observational.

        The shares are those of 1,000 observational rows beside 500 for each variable.
        """
        observed = 2.0 / (len(self._values) + 2.0)
        acts = kind != "observational" and self._values
        design = Design("single", tuple(self._values), self._values, observed) if acts else Design()
        episodes = budget if self._steps is None else -(-budget // self._steps)
        return self._collected(design, episodes, seed, **options)

    def held_out(self, seed: int) -> Dataset | None:
        """Set each variable in turn to 2, which no learner is given; None if one cannot be 2."""
        if self._steps is not None or any(act != DONE for act in self._values.values()):
            return None
        design = Design("single", tuple(self._values), 2.0, 0.0)
        return self._collected(design, 200 * len(self._values), seed + 1_000_000)

    def _collected(self, design: Design, episodes: int, seed: int, **options: Any) -> Dataset:
        steps: Any = {} if self._steps is None else {"steps": self._steps}
        whole = collect(self._scm, design, episodes, seed=seed, **steps, **options)
        return whole.hide(self._hidden) if self._hidden else whole

    def simulator(self, seed: int) -> PairedSimulator:
        """Return paired experiments on the mechanisms.

        Raises:
            ModelError: Variables are hidden: the experiments would read and set them.
        """
        if self._hidden:
            what = f"{self.truth.name} hides variables, which paired experiments would set"
            raise ModelError([f"{what}; take data='observational' or 'interventional'"])
        return SystemSimulator(self._scm, seed)

    def close(self) -> None:
        """Do nothing: there is no backend."""


def _values_of(variable: Any) -> Any:
    """Return what a variable of a model is set to: its space A, its bounds, or N(2, 1).

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
        causes: Patterns of what varies, as far as it has a space A; the physical parameters if
            None, and in the view of outcomes where the blocks begin.
        outcomes: Names of variables; the states of joints and blocks, and success, if None.
        policy: As ``rollout`` takes it; ``"usual"`` is ``"sweep"`` for outcomes of the TriFinger's
            tasks and ``"random"`` otherwise, so that actions have no causes.
        steps: Control steps of an episode.
        sensor_noise: Standard deviation, as a fraction of half the range of the measured variable;
            only worlds that declare sensor noise have it.
        options: Options of the world: backend, preset.
        arguments: Arguments of the task.

    Raises:
        UnknownOption: There is no such view.
    """

    view: str = "outcome"
    causes: tuple[str, ...] | None = None
    outcomes: tuple[str, ...] | None = None
    policy: str | None = "usual"
    steps: int = STEPS
    sensor_noise: float = SENSED
    options: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        one_of("view", self.view, VIEWS)
        known = [*inspect.signature(Simulation).parameters][1:]
        for name in self.options:
            one_of("option of a world", name, known)


@final
class WorldProblem:
    """A task or a model with its physics. The budget counts episodes, or control steps.

    Args:
        name: Name of a task, a model file, or ``"module:function"``, as ``make_task`` takes.
        view: Causes, outcomes and episodes.
        task: Instead of the one that is named.

    Raises:
        UnknownOption: There is no such task.
        UnknownVariable: A pattern names nothing that can be set.
    """

    def __init__(self, name: str, view: TaskView, task: Task | None = None) -> None:
        self._view, self._by_step = view, view.view == "step"
        self._world = Simulation(task or make_task(name, **view.arguments), **view.options)
        try:
            self._robot = isinstance(self._world.task, TriFingerTask)
            usual = "sweep" if self._robot and not self._by_step else "random"
            self._policy = usual if view.policy == "usual" else view.policy
            as_policy(self._policy)
            self._causes = self._chosen()
            self._starts = [name for name in self._causes if self._is_start(name)]
            self._contexts = self._varying()
            found = default_outcomes(self._world, every_step=True)
            self._outcomes = tuple(map(as_outcome, view.outcomes or found))
            self.truth = self._truth(problem_label(name, view))
        except BaseException:
            self._world.close()
            raise

    def __fingerprint__(self) -> dict[str, Any]:
        world = self._world
        return {**world.__fingerprint__(), "policy": self._policy, "engine": world.engine}

    def _chosen(self) -> tuple[str, ...]:
        """Return the varied variables, and those computed from them, since they can be set, too."""
        world, model = self._world, self._world.model
        varying = [name for name in settable(world, ("*",)) if self._varies(name)]
        if self._view.causes is not None:
            named = settable(world, self._view.causes)
            if not {*named} & {*varying}:
                raise UnknownVariable(", ".join(self._view.causes), varying)
            return tuple(name for name in named if name in varying)
        chosen = default_causes(world)
        if not (chosen or self._by_step):
            advice = "give variables a space A (spaces= of ModelTask), or take the view 'step'"
            raise ModelError([f"nothing of {world.task.name} varies between episodes: {advice}"])
        starts = [name for name in varying if self._is_start(name)]
        follow = [
            name
            for name, variable in ((name, model.declared(name)) for name in varying)
            if isinstance(variable, Derived)
            and any(parent.name in chosen for parent in variable.all_parents)
        ]
        return (*chosen, *follow, *(starts if len(starts) <= MOST_STARTS else ()))

    def _varies(self, name: str) -> bool:
        """Return whether values can be drawn for a variable that is not another name of one."""
        model = self._world.model
        if self._is_start(name):
            return not self._by_step
        return model.target(name) == name and model.declared(name).space("A") is not None

    def _is_start(self, name: str) -> bool:
        """Return whether a variable is where a block begins."""
        model = self._world.model
        is_place = name.endswith(START) and name.removesuffix(START) + HEIGHT in model
        return is_place and model.declared(name).role == "state"

    def _varying(self) -> dict[str, Any]:
        """Vary every variable that has its own space.

        Blocks begin near the middle, each in a sector of its own, so that no draw has to be
        rejected: rejection would make everything that is drawn depend on everything else.
        """
        model, count = self._world.model, len(self._starts)
        drawn: dict[str, Any] = {
            n: "A" for n in self._causes if isinstance(model.declared(n), Exogenous)
        }
        far, half = (0.0, HALF) if count == 1 else (0.075, 0.2 * HALF)
        for number, name in enumerate(self._starts):
            standing: Any = model.declared(name.removesuffix(START) + HEIGHT).a
            angle, z = 2.0 * math.pi * number / count, standing.low[2]
            x, y = far * math.cos(angle), far * math.sin(angle)
            drawn[name] = Draw(Box((x - half, y - half, z), (x + half, y + half, z)))
        if self._view.sensor_noise and "sensor_noise" in model:
            drawn["sensor_noise"] = self._view.sensor_noise
        return drawn

    def _truth(self, shown: str) -> GroundTruth:
        view, backend, model = self._view, self._world.backend, self._world.model
        rows = EpisodeRows(
            self._world,
            Design(),
            Setting(self._policy, self._contexts, view.steps),
            causes=self._causes,
            outcomes=self._outcomes,
            every_step=self._by_step,
        )
        place = {first_name(model, name): i for i, name in enumerate(self._causes)}
        there = dict.fromkeys(column.variable for column in rows.columns)
        names = sorted(there, key=lambda name: place.get(name, len(place)))
        about = {
            "kind": f"task, view by {view.view}",
            "budget": "control steps" if self._by_step else "episodes",
            "backend": f"{backend.name} {backend.version}",
            "policy": self._policy,
            "steps": view.steps,
            "sensor_noise": view.sensor_noise,
            "options": {k: str(v) for k, v in view.options.items()},
            "arguments": {k: str(v) for k, v in view.arguments.items()},
        }
        return replace(observed_part(shown, rows.about["truth"], names), about=about)

    def data(self, kind: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect episodes; seven of ten interventional ones set half of the causes, in A|B."""
        contexts, declared = self._contexts, self._world.model.declared
        values = {name: contexts.get(name, "A") for name in self._causes}
        values |= {n: "A|B" for n in self._causes if declared(n).space("B") is not None}
        acts = kind != "observational" and self._causes
        return collect(
            self._world,
            Design("half", self._causes, values) if acts else Design(),
            -(-budget // self._view.steps) if self._by_step else budget,
            seed=seed,
            steps=self._view.steps,
            policy=self._policy,
            nature=contexts,
            causes=self._causes,
            outcomes=self._outcomes,
            every_step=self._by_step,
            **options,
        )

    def held_out(self, seed: int) -> Dataset | None:
        """Return None: the effects of single values of a world are not linear."""
        return None

    def simulator(self, seed: int) -> PairedSimulator:
        """Return the paired simulator, without sensor noise, under several circumstances in turn.

        On the TriFinger these are the policy of the view, a finger that pushes across, and blocks
        that are thrown at the wall: past the fingers, and so hard that they come back and hit one.
        """
        if self._by_step:
            return SystemSimulator(self._world, seed)
        contexts = {n: act for n, act in self._contexts.items() if n != "sensor_noise"}
        kinds: list[tuple[Any, dict[str, Any]]] = [(self._policy, {})]
        if self._robot:
            speeds = [f"{name.removesuffix(START)}.linear_velocity" for name in self._starts]
            kinds += [("across", {}), *((None, dict.fromkeys(speeds, fast)) for fast in THROWN)]
        length = self._view.steps
        settings = [Setting(who, {**contexts, **more}, length, seed) for who, more in kinds]
        return EpisodeSimulator(self._world, self._causes, self._outcomes, settings)

    def close(self) -> None:
        """Close the backend."""
        self._world.close()


# --- by name --------------------------------------------------------------------------------------


@typed
def problem(name: str | SCM | Equations, *, seed: int = 0, view: TaskView | None = None) -> Problem:
    """Return a benchmark problem.

    Args:
        name: A model, a world of its equations, or the name of a problem: a family with a size
            (``"er2:20"``; with three hidden variables besides ``"er2:20:3"``; ``"servo:10"`` for
            one of physics), a task, the file of a model (.xml, .urdf), the JSON file of an ``SCM``,
            or ``"module:function"`` for a function that gives a task, a world, an ``SCM`` or a
            ``Problem``.
        seed: Which model of the family.
        view: View of a task or a world.

    Raises:
        UnknownOption: There is nothing of this name.
        UnreadableFile: The file holds no model.

    Example:
        >>> problem("er2:5").truth.names
        ('x0', 'x1', 'x2', 'x3', 'x4')
    """
    view, seed = view or TaskView(), whole_number("seed", seed, least=0)
    name = name.model if isinstance(name, Equations) else name
    if isinstance(name, SCM):
        return SCMProblem(problem_label(name, view), name)
    family, _, size = name.partition(":")
    if family in FAMILIES:
        seen, _, unseen = size.partition(":")
        if not unseen:
            return SCMProblem(name, random_model(name, seed))
        if not (seen.isdecimal() and unseen.isdecimal() and 1 <= int(unseen) <= int(seen)):
            shown = (f"{family}:N:K with N variables and 1 to N hidden ones besides",)
            raise UnknownOption("family of models", name, shown)
        model = random_model(f"{family}:{int(seen) + int(unseen)}", seed)
        ranked = sorted(model, key=lambda n: (-len(model.children(n)), n))  # by how much it acts on
        return SCMProblem(name, model, ranked[: int(unseen)])
    if family in PHYSICS:
        family, n, hidden = numbers_of(name)
        if family == "servo":
            return ServoProblem(name, servo(n, seed, hidden), view.options)
        return WorldProblem(name, replace(view, view="step"), Springs(n, seed))
    if name.endswith(".json"):
        return SCMProblem(Path(name).stem, model_of_file(name))
    if ":" in name:
        made = load_factory(name)(**view.arguments)
        made = made.model if isinstance(made, Equations) else made
        if isinstance(made, SCM | Problem):
            return SCMProblem(problem_label(name, view), made) if isinstance(made, SCM) else made
    elif name not in TASKS and not name.endswith(FILES):
        families = (f"{family}:N" for family in (*FAMILIES, *PHYSICS))
        files = ("FILE.json", "FILE.xml", "FILE.urdf")
        raise UnknownOption("problem", name, (*TASKS, *families, *files))
    return WorldProblem(name, view)


def model_of_file(path: str) -> queries.SCM:
    """Read a causal model that ``to_json`` wrote.

    Raises:
        UnreadableFile: The file does not exist, or holds no model.
    """
    try:
        return queries.SCM(from_json(read_text(Path(path))))
    except (OSError, ValueError) as error:
        advice = "give a file that scm_world.graph.to_json wrote"
        raise UnreadableFile(path, " ".join(str(error).split()), advice) from None


def system_of(name: str, **arguments: Any) -> Task | queries.SCM:
    """Make a task, or the causal model of a JSON file or of ``module:function``.

    Raises:
        UnknownOption: There is no such system, or arguments do not fit; a JSON file has none.
        UnreadableFile: The JSON file does not exist, or holds no model.
    """
    if name.endswith(".json"):
        if arguments:
            allowed = ("left out: a JSON file has no arguments",)
            raise UnknownOption("argument of a file", next(iter(arguments)), allowed)
        return model_of_file(name)
    if ":" in name:
        with suppress(Exception):  # ``make_task`` raises it again, and says what is wrong
            made = load_factory(name)(**arguments)
            if isinstance(made, SCM):
                return queries.SCM(made)
    return make_task(name, **arguments)


def problem_label(name: str | SCM, view: TaskView) -> str:
    """Return the name of a problem as it is shown; of a model it tells models apart."""
    if isinstance(name, SCM):
        return f"model {digest(fingerprint(name, libraries=False))[:8]}"
    if name.partition(":")[0] in (*FAMILIES, *PHYSICS) or name.endswith(".json"):
        return Path(name).stem if name.endswith(".json") else name
    home, colon, function = name.rpartition(":")
    short = f"{Path(home).stem if home.endswith('.py') else home}:{function}" if colon else name
    short = Path(name).stem if name.endswith(FILES) else short
    return f"{short}/step" if view.view == "step" else short
