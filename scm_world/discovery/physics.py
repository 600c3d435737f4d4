"""Problem families of physics: systems drawn by seed, with a sparse graph that the engine realises.

``servo:N`` is a random graph of N arms: the servo of each follows the sensors of its causes, so
that any acyclic graph becomes physics. A row is an episode, and holds where the arms come to rest.
``springs:N`` are N masses on a random network of springs, under random forces. A row is a
control step, and the graph has lag 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import Floats
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.probes import rounds_at
from scm_world.queries.samples import Outcome, Setting, read
from scm_world.queries.twins import twins_of
from scm_world.tasks import ModelTask
from scm_world.tasks.base import Options
from scm_world.tasks.composition import Composition
from scm_world.variables import Box, Exogenous, Linear, Mechanism, Variable
from scm_world.variables.distributions import Normal
from scm_world.variables.kinds import Measured
from scm_world.world import Simulation

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
        mechanisms: What the commands follow: the intervention that makes it the network.
        holds: Their mechanisms while an arm is held.
        arms: The angle of the arm of each command.
        edges: Which arm each arm follows, by number, and which hidden force moves it.
        steps: Control steps until the last arm is at rest.
    """

    task: ModelTask
    mechanisms: Mapping[str, Mechanism]
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


@final
class ServoSimulator:
    """Paired experiments on a network of servos.

    A unit is an episode. All arms are held but one, where they are at rest in the episode as it is;
    then one of them is held elsewhere. What the free arm does then is a direct effect.

    Attributes:
        names: Names of the arms.
    """

    def __init__(self, world: Simulation, made: Servos, seed: int) -> None:
        self._world, self._twins, self._servos = world, twins_of(world), tuple(made.arms)
        self.names = tuple(made.arms.values())
        self._setting = Setting(None, made.mechanisms, made.steps, seed)

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
        rng = np.random.default_rng([seed, n, 13])
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


# --- by name --------------------------------------------------------------------------------------

PHYSICS: Mapping[str, str] = {
    "servo": "where N arms rest whose servos follow one another; servo:N:K: with K hidden forces",
    "springs": "N masses on a random network of springs, step by step",
}
"""The families by name, each with a sentence."""
