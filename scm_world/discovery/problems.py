"""Benchmark problems for learners: causal models and worlds, each with its true graph."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, final

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
from scm_world.discovery.physics import (
    PHYSICS,
    Servos,
    ServoSimulator,
    Springs,
    servo,
)
from scm_world.errors import ModelError, UnknownOption, UnknownVariable, UnreadableFile
from scm_world.graph import SCM, from_json
from scm_world.policies.scripted import as_policy
from scm_world.queries.equations import Equations, as_given
from scm_world.queries.samples import STEPS, Setting, as_outcome
from scm_world.runs.files import read_text
from scm_world.tasks import TASKS, Task, TriFingerTask, make_task
from scm_world.tasks.factories import FILES, load_factory
from scm_world.variables import Box, Derived, Draw, Exogenous, Function, Linear, Parent
from scm_world.variables.distributions import Normal
from scm_world.world import Simulation

__all__ = ["Problem", "TaskView", "problem", "random_model"]

# --- random models --------------------------------------------------------------------------------

WEAKEST, STRONGEST = 0.5, 2.0  # absolute weights, uniform between them; the sign is drawn
PER_NODE = 2  # edges per node of the static families
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
    family, n, _ = sized(name, tuple(FAMILIES))
    graph, kind, number, _ = FAMILIES[family]
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


def sized(name: str, families: Sequence[str]) -> tuple[str, int, int]:
    """Return the family, the number of nodes and that of hidden ones that a name has: ``er2:20:3``.

    Raises:
        UnknownOption: There is no such family or size.
    """
    found = re.fullmatch(r"\w+:([0-9]+)(?::([0-9]+))?", name)
    family = name.partition(":")[0]
    n, hidden = (int(found[1]), int(found[2] or 0)) if found else (0, 0)
    least, most = (5, 50) if family in PHYSICS else (2, 1000)
    unseen = {"servo": n // 2, "springs": 0}.get(family, n)
    if family not in families or not least <= n <= most or hidden > unseen:
        ends = {one: "5 to 50" if one in PHYSICS else "2 to 1000" for one in families}
        shown = [one for one in families if one == family] or families
        more = "N:K with K hidden ones besides: up to N, of servo up to N/2, of springs none"
        sizes = (f"{one}:N with N from {ends[one]}" for one in shown)
        raise UnknownOption("family of problems", name, (*sizes, more))
    return family, n, hidden


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
        terms: What else decides the data and the graph, by name.
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

    def data(self, kind: str, budget: int, seed: int, **options: Any) -> Dataset:
        """Collect ``"observational"`` or ``"interventional"`` rows.

        The first rows are the same for any budget. Options are those of ``collect``.

        Raises:
            ModelError: No row of the interventional ones is targeted.
        """
        n = -(-whole_number("budget", budget, least=1) // self.rows)
        design = Design() if kind == "observational" else self.design
        table = self.tidy(collect(self.system, design, n, seed=seed, **self.setting, **options))
        return refuse_untargeted(table) if kind == "interventional" else table

    def close(self) -> None:
        """Close the backend, if there is one."""
        if isinstance(self.system, Simulation):
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


def servo_problem(name: str, made: Servos, options: Mapping[str, Any]) -> Problem:
    """Return where the arms of a network of servos come to rest. The budget counts episodes.

    An intervention on an arm holds the command of its servo, whatever the others do; each arm is
    held in half as many episodes as there are in which none is.

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
            "nature": made.mechanisms,
            "causes": (),
            "outcomes": arms,
        },
        tidy=tidy,
        terms={"nature": made.mechanisms, "engine": world.engine},
    )


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
        contacts: Whether to record contacts, and to score each context for itself: rows in which
            edges by contact can act, and rows in which none can.
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
    contacts: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    arguments: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        one_of("view", self.view, VIEWS)
        known = [*inspect.signature(Simulation).parameters][1:]
        for name in self.options:
            one_of("option of a world", name, known)


def world_problem(name: str, view: TaskView, task: Task | None = None) -> Problem:
    """Return a task or a model with its physics. The budget counts episodes, or control steps.

    Seven of ten interventional episodes set half of the causes, in A|B. Blocks begin near the
    middle, each in a sector of its own, so that no draw has to be rejected: rejection would make
    everything that is drawn depend on everything else.

    Args:
        name: Name of a task, a model file, or ``"module:function"``, as ``make_task`` takes.
        view: Causes, outcomes and episodes.
        task: Instead of the one that is named.

    Raises:
        UnknownOption: There is no such task.
        UnknownVariable: A pattern names nothing that can be set.
    """
    by_step = view.view == "step"
    world = Simulation(task or make_task(name, **view.arguments), **view.options)
    model, declared = world.model, world.model.declared
    try:
        is_robot = isinstance(world.task, TriFingerTask)
        policy = view.policy
        if policy == "usual":
            policy = "sweep" if is_robot and not by_step else "random"
        as_policy(policy)
        causes = _causes(world, view)
        starts = [cause for cause in causes if _is_start(model, cause)]
        drawn: dict[str, Any] = {n: "A" for n in causes if isinstance(declared(n), Exogenous)}
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
        outcomes = tuple(map(as_outcome, view.outcomes or usual))
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
        truth = observed_part(problem_label(name, view), rows.about["truth"], names)
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
        if isinstance(variable, Derived)
        and any(parent.name in chosen for parent in variable.all_parents)
    ]
    return (*chosen, *follow, *(starts if len(starts) <= MOST_STARTS else ()))


def _is_start(model: SCM, name: str) -> bool:
    """Return whether a variable is where a block begins."""
    is_place = name.endswith(START) and name.removesuffix(START) + HEIGHT in model
    return is_place and model.declared(name).role == "state"


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
    if isinstance(name, Equations):
        return problem(as_given(name), seed=seed, view=view)
    if isinstance(name, SCM):
        return model_problem(problem_label(name, view), name)
    if name.partition(":")[0] in (*FAMILIES, *PHYSICS):
        family, n, hidden = sized(name, (*FAMILIES, *PHYSICS))
        if family == "servo":
            return servo_problem(name, servo(n, seed, hidden), view.options)
        if family == "springs":
            return world_problem(name, replace(view, view="step"), Springs(n, seed))
        model = random_model(f"{family}:{n + hidden}", seed)
        ranked = sorted(model, key=lambda n: (-len(model.children(n)), n))  # by how much it acts on
        return model_problem(name, model, ranked[:hidden])
    if name.endswith(".json"):
        return model_problem(Path(name).stem, model_of_file(name))
    if ":" in name:
        made = as_given(load_factory(name)(**view.arguments))
        if isinstance(made, SCM | Problem):
            return model_problem(problem_label(name, view), made) if isinstance(made, SCM) else made
    elif name not in TASKS and not name.endswith(FILES):
        families = (f"{family}:N" for family in (*FAMILIES, *PHYSICS))
        files = ("FILE.json", "FILE.xml", "FILE.urdf")
        raise UnknownOption("problem", name, (*TASKS, *families, *files))
    return world_problem(name, view)


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
