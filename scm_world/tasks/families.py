"""Families of random systems: causal models without physics, and systems that an engine realises.

``servo:N`` is a random graph of N arms: the servo of each follows the sensors of its causes, so
that any acyclic graph becomes physics. A row is an episode, and holds where the arms come to rest.
``springs:N`` are N masses on a random network of springs, under random forces. A row is a
control step, and the graph has lag 1.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, final

import networkx as nx
import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._types import Floats, Value
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.tasks.base import Options
from scm_world.tasks.composition import Composition
from scm_world.tasks.model import ModelTask
from scm_world.variables import (
    Box,
    Derived,
    Exogenous,
    Function,
    Linear,
    Measured,
    Mechanism,
    Normal,
    Parent,
    Variable,
)

__all__ = ["FAMILIES", "PHYSICS", "Servos", "Springs", "random_model", "servo"]

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


PHYSICS: Mapping[str, str] = {
    "servo": "where N arms rest whose servos follow one another; servo:N:K: with K hidden forces",
    "springs": "N masses on a random network of springs, step by step",
}
"""The families of physics by name, each with a sentence."""


@typed
def random_model(name: str, seed: int = 0) -> SCM:
    """Draw model number ``seed`` of a family, ``"er2:20"`` for 20 variables.

    Raises:
        UnknownOption: The family or its size is unknown.

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
            mechanism: Function | Linear = Function(tanh_of_sum, constants={"weights": weights})
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


def is_family(name: str) -> bool:
    """Return whether a name is one of a family, with or without a size."""
    return name.partition(":")[0] in (*FAMILIES, *PHYSICS)


def family(name: str, seed: int = 0) -> SCM | Servos | Springs:
    """Draw number ``seed`` of a family with a size: ``"er2:20"``, ``"servo:10"``.

    With hidden variables (``"er2:20:3"``, ``"servo:10:2"``) there are that many more.

    Raises:
        UnknownOption: The family or its size is unknown.
    """
    kind, n, hidden = sized(name)
    if kind == "servo":
        return servo(n, seed, hidden)
    if kind == "springs":
        return Springs(n, seed)
    return random_model(f"{kind}:{n + hidden}", seed)


def sized(name: str, families: Sequence[str] = (*FAMILIES, *PHYSICS)) -> tuple[str, int, int]:
    """Return the family, the number of nodes and that of hidden ones that a name has: ``er2:20:3``.

    Raises:
        UnknownOption: The family or its size is unknown.
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


def _signed(rng: np.random.Generator, shape: int | tuple[int, ...]) -> Floats:
    return np.asarray(rng.uniform(WEAKEST, STRONGEST, shape) * rng.choice([-1.0, 1.0], shape))


def _mechanism(kind: str, weights: Floats, rng: np.random.Generator) -> Function | Linear:
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


# --- servo networks -------------------------------------------------------------------------------

SECOND = 0.3  # probability of a second cause, from 8 arms on
BACK = 3  # how far before the nearest cause the second one can be, in the causal order
SHARE = 0.4  # deviation of an arm that is its own, as a share of the whole
SPREAD = 0.25  # [rad] standard deviation of an arm, times 0.6 to 1.4
ARM = (0.2, 0.04)  # [kg], [m] mass and length
CONTROL_DT = 0.2  # [s] of a control step: in this time an arm comes to rest
REACH = 2.0  # standard deviations of an arm, to either side, within which interventions hold it


@final
@dataclass(frozen=True)
class Servos:
    """A network of servos.

    Attributes:
        task: The arms. Every servo follows its own command only.
        plan: What the commands follow: the interventions that make it the network.
        holds: Their mechanisms while an arm is held.
        arms: The angle of the arm of each command.
        edges: Which arm each arm follows, by number, and which hidden force moves it.
        steps: Control steps until the last arm is at rest.
    """

    task: ModelTask
    plan: Mapping[str, Mechanism]
    holds: Mapping[str, Mechanism]
    arms: Mapping[str, str]
    edges: tuple[tuple[str, str], ...]
    steps: int


def servo(n: int, seed: int = 0, hidden: int = 0) -> Servos:
    """Draw a network of servos.

    A chain through all arms in random order, from 8 arms on with further edges, is the graph.
    Each arm is a pendulum; its motor is a position servo. Its command is its own set point, drawn
    for each episode, plus a weighted sum of the measured angles of its causes. Weights are such
    that the share of each angle that is its own is about the same, as in iSCM, and that its spread
    is drawn at random: variances say nothing of the order. Gravity bends the effects a little.

    Args:
        n: Number of arms.
        seed: Of graph and weights.
        hidden: Number of forces that nobody measures; each moves the set points of two arms.

    Source:
        Ormaniec et al., *Standardizing structural causal models*, ICLR 2025, for scaled weights.
    """
    n = whole_number("n", n, least=2, most=50)
    hidden = whole_number("hidden", hidden, least=0, most=n)
    rng = np.random.default_rng([whole_number("seed", seed, least=0), n, hidden, 11])
    upper = np.zeros((hidden + n, hidden + n), dtype=bool)  # forces, then arms in causal order
    upper[hidden:, hidden:] = np.diag(np.ones(n - 1, dtype=bool), 1)
    for j in range(2, n if n >= 8 else 0):
        if rng.random() < SECOND:
            upper[hidden + rng.integers(max(0, j - 1 - BACK), j - 1), hidden + j] = True
    for k in range(hidden):
        upper[k, hidden + rng.choice(n, 2, replace=False)] = True
    sizes = rng.uniform(0.5, 1.0, upper.shape) * rng.choice([-1.0, 1.0], upper.shape)
    weights, totals = np.where(upper, sizes, 0.0), np.zeros(upper.shape)
    for j in range(hidden + n):
        size = np.linalg.norm(weights[:, j] @ totals)
        if size > 0.0:
            size = max(size, np.linalg.norm(weights[:, j]))  # causes that cancel stay small
            weights[:, j] *= math.sqrt(1.0 - SHARE**2) / size
        totals[j] = weights[:, j] @ totals  # of each arm, the weights of all set points and forces
        totals[j, j] = SHARE if size > 0.0 else 1.0
    spread = SPREAD * np.concatenate([np.ones(hidden), rng.uniform(0.6, 1.4, n)])
    own, weights = np.diag(totals) * spread, weights * spread / spread[:, None]
    order = rng.permutation(n)
    named = [f"{at:0{len(str(n - 1))}d}" for at in order]  # in causal order
    mass, length = ARM
    torque = mass * 9.81 * length / 2.0  # [N m] of gravity on a level arm
    stiffness, inertia = 2.0 * torque, mass * length**2 / 3.0
    bend = 1.0 + torque / stiffness  # a servo gives way to gravity: commands are larger by that
    arms, servos, mechanisms, holds, drawn, edges = {}, {}, {}, {}, [], []
    for k in range(hidden):
        name = f"force{k}"
        drawn.append(Exogenous(name=name, unit="rad", default=0.0, distribution=Normal(std=SPREAD)))
    for j, name in enumerate(named, start=hidden):
        arms[name] = (
            f'<body name="arm{name}" pos="{0.2 * int(name):g} 0 0"><joint name="arm{name}" '
            f'axis="0 1 0" damping="{2.0 * math.sqrt((stiffness + torque) * inertia):.9g}"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {-length}" size="0.005" mass="{mass}" '
            'contype="0" conaffinity="0"/></body>'
        )
        servos[name] = (
            f'<position name="servo{name}" joint="arm{name}" kp="{stiffness:.9g}" '
            'ctrlrange="-10 10"/>'
        )
        point = Exogenous(
            name=f"servo{name}.setpoint",
            unit="rad",
            default=0.0,
            distribution=Normal(std=own[j]),
            doc="What the servo would do without the others; drawn for each episode.",
        )
        aim = Exogenous(
            name=f"servo{name}.hold",
            unit="rad",
            default=0.0,
            distribution=Box(-REACH * spread[j], REACH * spread[j]),
            doc="Where an intervention holds the arm; drawn for each episode.",
        )
        drawn += [point, aim]
        holds[f"servo{name}.control"] = Mechanism(Linear(weights=(bend,)), parents=(aim.name,))
        causes = {
            f"force{i}" if i < hidden else f"arm{named[i - hidden]}.position": weights[i, j]
            for i in np.flatnonzero(upper[:, j])
        }
        edges += [(cause, f"arm{name}.position") for cause in causes]
        follows = {point.name: 1.0, **causes}
        mechanisms[f"servo{name}.control"] = Mechanism(
            Linear(weights=tuple(bend * float(weight) for weight in follows.values())),
            parents=tuple(follows),
        )
    xml = (
        f'<mujoco model="servo_{n}"><option timestep="0.01" integrator="implicitfast"/>'
        f"<worldbody>{''.join(arms[name] for name in sorted(arms))}</worldbody>"
        f"<actuator>{''.join(servos[name] for name in sorted(servos))}</actuator></mujoco>"
    )
    task = ModelTask(xml, expose=[], ties=drawn, control_dt=CONTROL_DT, seconds=CONTROL_DT * 2 * n)
    names = sorted(mechanisms)
    return Servos(
        task,
        {name: mechanisms[name] for name in names},
        {name: holds[name] for name in names},
        {f"servo{name}.control": f"arm{name}.position" for name in sorted(named)},
        tuple(edges),
        n + 3,
    )


# --- springs --------------------------------------------------------------------------------------


class Springs(ModelTask):
    """Masses on rails that run side by side, with springs between some of them and a motor each.

    A control step is one physics step, so that a mass feels its neighbors only. The edges that any
    model has, between all that is coupled, are thinned out to these; ``verify`` finds no others.

    Args:
        n: Number of masses.
        seed: Seed of the network, stiffnesses and masses.
    """

    def __init__(self, n: int, seed: int = 0) -> None:
        n = whole_number("n", n, least=4, most=50)
        rng = np.random.default_rng([whole_number("seed", seed, least=0), n, 13])
        self.pairs = {(int(rng.integers(0, j)), j) for j in range(1, n)}
        while len(self.pairs) < round(1.2 * n):
            one, other = sorted(rng.choice(n, 2, replace=False).tolist())
            self.pairs.add((one, other))
        wide = len(str(n - 1))
        self.masses = tuple(f"mass{at:0{wide}d}" for at in rng.permutation(n))
        rails, motors = {}, {}
        for at, name in enumerate(self.masses):
            rails[name] = (
                f'<body name="{name}" pos="0 {0.2 * at:g} 0"><joint name="{name}" type="slide" '
                'axis="1 0 0" stiffness="2" damping="0.2"/><geom type="sphere" size="0.03" '
                f'mass="{rng.uniform(0.05, 0.2):.6g}" contype="0" conaffinity="0"/></body>'
            )
            motors[name] = (
                f'<motor name="force{name[4:]}" joint="{name}" ctrlrange="-1 1" gear="1"/>'
            )
        springs = (
            f'<fixed name="spring{self.masses[i][4:]}_{self.masses[j][4:]}" '
            f'stiffness="{rng.uniform(5.0, 20.0):.6g}"><joint joint="{self.masses[i]}" coef="1"/>'
            f'<joint joint="{self.masses[j]}" coef="-1"/></fixed>'
            for i, j in sorted(self.pairs)
        )
        xml = (
            f'<mujoco model="springs_{n}"><option timestep="0.02" integrator="implicitfast" '
            f'gravity="0 0 0"/><worldbody>{"".join(rails[name] for name in sorted(rails))}'
            f"</worldbody><tendon>{''.join(springs)}</tendon><actuator>"
            f"{''.join(motors[name] for name in sorted(motors))}</actuator></mujoco>"
        )
        spaces = {f"{name}.mass": {"a": (0.05, 0.2), "b": (0.2, 0.4)} for name in self.masses}
        super().__init__(xml, expose="*.mass", frame_skip=1, seconds=1.0, spaces=spaces)

    def compose(self, options: Options) -> tuple[Composition, list[Variable]]:
        """Declare what the tables have, with edges between neighbors only."""
        composition, variables = super().compose(options)
        near: dict[str, set[str]] = {name: {name} for name in self.masses}
        for i, j in self.pairs:
            near[self.masses[i]].add(self.masses[j])
            near[self.masses[j]].add(self.masses[i])

        def acts(cause: str, effect: str) -> bool:
            """Return whether one variable acts on a state within one physics step."""
            there, _, what = cause.replace("force", "mass", 1).partition(".")
            mine = effect.partition(".")[0]
            return there == mine or (what == "position" and there in near[mine])

        for at, variable in enumerate(variables):
            if isinstance(variable, Measured) and variable.name.partition(".")[0] in near:
                parents = tuple(p for p in variable.parents if acts(p.name, variable.name))
                variables[at] = variable.model_copy(update={"parents": parents})
        return composition, variables
