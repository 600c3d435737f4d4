"""The worlds of questions: what can be set and read in each, and its true graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, final

import numpy as np

from scm_world._arguments import one_of, real_number, whole_number
from scm_world._types import Floats
from scm_world.errors import ModelError
from scm_world.queries import SCM, Outcome, World
from scm_world.queries.questions import Questions
from scm_world.tasks import ModelTask
from scm_world.tasks.families import Springs, servo
from scm_world.variables import (
    Box,
    Derived,
    Draw,
    Exogenous,
    Function,
    Linear,
    Mechanism,
    Normal,
    Shift,
)

Edge = tuple[str, str]


@final
@dataclass(frozen=True)
class LabVariable:
    """Something that an agent can read, or set, or both.

    Attributes:
        name: Its name in the levels L1 and L2.
        unit: Its unit.
        doc: A sentence.
        reads: How it is read in an episode; None if it is not read.
        sets: The variable of the world that an experiment sets; None if it cannot be set.
        low: Lower end of the values that may be set.
        high: Upper end.
        factor: What is set, over the value that is asked for.
        aim: What a randomised experiment follows, drawn between the ends once in an episode; None
            if what is set stays by itself as it was drawn.
    """

    name: str
    unit: str = "1"
    doc: str = ""
    reads: Outcome | None = None
    sets: str | None = None
    low: float = 0.0
    high: float = 0.0
    factor: float = 1.0
    aim: str | None = None


@final
@dataclass(frozen=True)
class Testbed:
    """A world, and what may be set and read in it.

    Attributes:
        world: The world; its context lets the settable quantities vary by themselves.
        quantities: What an agent can set and read.
        setting: Further arguments of ``sample``.
        budget: Episodes that an agent may run.
        truth: How many units answers are means of.
        independent: Whether the settable quantities do not act on one another.
        edges: True edges between quantities, and pairs with a hidden common cause.
        confounded: Pairs with a hidden common cause.
        own: Edges that the question states.
        local: Whether the graph is that of a given run, with edges that act only by contact.
        doc: What the world is, for the level L1.
    """

    world: Questions
    quantities: tuple[LabVariable, ...]
    setting: Mapping[str, Any]
    budget: int
    doc: str
    truth: int = 48
    independent: bool = True
    edges: tuple[Edge, ...] = ()
    confounded: tuple[Edge, ...] = ()
    own: tuple[Edge, ...] = ()
    local: bool = False

    @property
    def settable(self) -> tuple[LabVariable, ...]:
        """The quantities that may be set."""
        return tuple(one for one in self.quantities if one.sets)

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of the settable quantities that act on something."""
        acting = {cause for cause, _ in (*self.edges, *self.own)}
        return tuple(one.name for one in self.settable if one.name in acting)

    @property
    def outcomes(self) -> tuple[LabVariable, ...]:
        """The quantities that are read; those alone that cannot be set, if there are any."""
        read = tuple(one for one in self.quantities if one.reads)
        return tuple(one for one in read if not one.sets) or read


LAWS: Mapping[str, str] = {
    "plain": "springs and drag are linear",
    "cubic": "the force of a spring grows with the third power",
    "square": "drag grows with the square of the speed",
    "dead zone": "nothing happens below a threshold (dry friction)",
}


@dataclass(frozen=True)
class Knobs:
    """What makes a question harder.

    Attributes:
        noise: Standard deviation of the noise of a reading, as a share of its spread.
        hidden: Whether a hidden common cause acts on what varies by itself.
        selection: Whether observations are kept only where one reading is high.
        law: A name of ``LAWS``.
        variables: How many variables equations, and networks, have.
        distractors: How many variables there are in addition that act on nothing.

    Raises:
        UnknownOption: A value is not allowed.
    """

    noise: float = 0.02
    hidden: bool = True
    selection: bool = False
    law: str = "plain"
    variables: int = 5
    distractors: int = 1

    def __post_init__(self) -> None:
        """Check the values."""
        real_number("noise", self.noise, least=0.0, most=1.0)
        one_of("hidden", self.hidden, (True, False))
        one_of("selection", self.selection, (True, False))
        one_of("law", self.law, tuple(LAWS))
        whole_number("variables", self.variables, least=3, most=12)
        whole_number("distractors", self.distractors, least=0, most=6)


# --- equations ------------------------------------------------------------------------------------


def bent(*parents: Any, noise: Any = 0.0, weights: Sequence[float], law: float) -> Any:
    """Return a weighted sum of causes under a law: 1 cubic, 2 square with sign, 3 dead zone."""
    total = noise
    for weight, x in zip(weights, parents, strict=True):
        match law:
            case 1.0:
                of = 0.25 * x**3
            case 2.0:
                of = 0.5 * x * np.abs(x)
            case _:
                of = np.sign(x) * np.maximum(np.abs(x) - 0.5, 0.0)
        total = total + weight * of
    return total


def equations(rng: np.random.Generator, knobs: Knobs) -> Testbed:
    """Draw a random acyclic model; a hidden variable acts on two of the others."""
    n, extra = knobs.variables, knobs.distractors
    names = [f"x{i}" for i in rng.permutation(n + extra)]
    order, upper = names[:n], np.triu(rng.random((n, n)) < 0.5, 1)
    upper[np.arange(n - 1), np.arange(1, n)] |= ~upper[:-1].any(axis=1)  # all act on something
    low, high = -1.5, 2.0  # not symmetric, so that even laws have a mean effect
    pairs = [sorted(rng.choice(n, 2, replace=False).tolist()) for _ in range(2 * knobs.hidden)]
    hidden = {f"h{k}": (order[i], order[j]) for k, (i, j) in enumerate(pairs)}
    made: list[Any] = [Exogenous(name=name, distribution=Normal(0.0, 1.2)) for name in hidden]
    law = float(tuple(LAWS).index(knobs.law))
    for j, name in enumerate(order):
        causes = [order[i] for i in np.flatnonzero(upper[:, j])]
        weights = rng.uniform(0.6, 1.3, len(causes)) * rng.choice([-1.0, 1.0], len(causes))
        noise = Normal(0.0, 0.5)
        unseen = [h for h, pair in hidden.items() if name in pair]
        signs = rng.choice([-1.0, 1.0], len(unseen))
        causes, weights = [*causes, *unseen], np.append(weights, signs)
        of: Any = Linear(weights=tuple(weights.tolist()))
        if law:
            of = Function(bent, constants={"weights": tuple(weights.tolist()), "law": law})
        if causes:
            made.append(Derived(name=name, parents=tuple(causes), mechanism=of, noise=noise))
        else:
            made.append(Exogenous(name=name, distribution=Normal()))
    made += [Exogenous(name=name, distribution=Normal()) for name in names[n:]]
    quantities = tuple(
        LabVariable(name, "1", "A variable of the model.", Outcome(name), name, low, high)
        for name in sorted(names)
    )
    return Testbed(
        SCM(made),
        quantities,
        {},
        2000,
        f"A causal model of {len(names)} variables without cycles; {LAWS[knobs.law]}.",
        truth=4000,
        independent=False,
        edges=tuple((order[i], order[j]) for i, j in np.argwhere(upper).tolist()),
        confounded=tuple({tuple(sorted(pair)): pair for pair in hidden.values()}),
    )


def servos(rng: np.random.Generator, knobs: Knobs) -> Testbed:
    """Draw a network of arms whose servos follow one another's angles."""
    n = max(5, knobs.variables)
    made = servo(n, int(rng.integers(2**31)), int(knobs.hidden))
    drawn: dict[str, Any] = {one.name: one for one in made.task.ties}
    quantities = []
    for command, arm in made.arms.items():
        held: Any = made.holds[command]
        box = drawn[f"{command.partition('.')[0]}.hold"].distribution
        quantities.append(
            LabVariable(
                arm.partition(".")[0],
                "rad",
                "The angle at which an arm comes to rest; an experiment holds it.",
                Outcome(arm),
                command,
                float(box.low),
                float(box.high),
                float(held.function.weights[0]),
                f"{command.partition('.')[0]}.hold",
            )
        )
    short = {arm: arm.partition(".")[0] for arm in made.arms.values()}
    forces = sorted({cause for cause, _ in made.edges} - {*short})
    pairs = [tuple(short[e] for c, e in made.edges if c == force) for force in forces]
    return Testbed(
        World(made.task).given(made.plan),
        tuple(quantities),
        {"policy": None, "steps": made.steps},
        300,
        f"{n} arms with servos; each follows its own set point and the angles of other arms.",
        independent=False,
        edges=tuple((short[c], short[e]) for c, e in made.edges if c in short),
        confounded=tuple((one, other) for one, other in pairs),
    )


def network(rng: np.random.Generator, knobs: Knobs) -> Testbed:
    """Draw masses on a random network of springs; an episode is one physics step."""
    task = Springs(max(6, knobs.variables), int(rng.integers(2**31)))
    names = sorted(task.masses)
    near = {(task.masses[i], task.masses[j]) for i, j in task.pairs}
    places, speeds = [], []
    for name in names:
        at, speed = f"{name}.position", f"{name}.velocity"
        doc = "Where it begins; an experiment puts it there."
        places.append(LabVariable(at, "m", doc, Outcome(at, "first"), at, -0.5, 0.5))
        speeds.append(LabVariable(speed, "m/s", "After 0.02 s, from rest.", Outcome(speed)))
    given = {one.name: Draw(Box(-0.3, 0.3)) for one in places}
    together = {"*.position": Shift(Draw(Box(-0.3, 0.3)), shared=True)} if knobs.hidden else None
    return Testbed(
        World(task).given(given),
        (*places, *speeds),
        {"policy": None, "steps": 1, "nature": together},
        120,
        f"{len(names)} masses on rails, with springs between some of them.",
        edges=tuple(
            (f"{a}.position", f"{b}.velocity") for a, b in sorted(near | {(b, a) for a, b in near})
        ),
        own=tuple((f"{n}.position", f"{n}.velocity") for n in names),
    )


# --- physics with causes that do not act on one another -------------------------------------------


class Rig(NamedTuple):
    """A model with causes that vary by themselves.

    Attributes:
        xml: Returns the model, of a law and three numbers that are drawn around 1.
        causes: Unit, lowest and highest value by variable.
        reads: Units of the variables that are read.
        seconds: Length of an episode [s].
        doc: A sentence.
        steps: Control steps of an episode.
        agent: Weights of the states that a command follows, by command.
    """

    xml: Callable[[str, Floats], Any]
    causes: Mapping[str, tuple[str, float, float]]
    reads: Mapping[str, str]
    seconds: float
    doc: str
    steps: int = 4
    agent: Mapping[str, Mapping[str, float]] = MappingProxyType({})


def _model(timestep: float, bodies: str, rest: str = "", gravity: str = "0 0 0") -> str:
    options = f'<option timestep="{timestep}" gravity="{gravity}"/>'
    return f"<mujoco>{options}<worldbody>{bodies}</worldbody>{rest}</mujoco>"


def _laws(law: str, k: Floats, stiffness: float, damping: float) -> str:
    """Return the attributes of a joint with a spring, drag and dry friction under a law."""
    spring, drag = stiffness * k[0], damping * k[1]
    springs = f"{0.1 * spring:.4f} 0 {5 * spring:.4f}" if law == "cubic" else f"{spring:.4f}"
    drags = f"{0.1 * drag:.4f} {2 * drag:.4f}" if law == "square" else f"{drag:.4f}"
    dry = 0.1 * stiffness * k[2] if law == "dead zone" else 0.0
    return f'stiffness="{springs}" damping="{drags}" frictionloss="{dry:.4f}"'


def _body(name: str, at: str, joint: str, geom: str) -> str:
    color = "0.8 0.3 0.2 1" if name in ("left", "first") else "0.2 0.4 0.8 1"
    return (
        f'<body name="{name}" pos="{at}"><joint name="{name}" {joint}/>'
        f'<geom name="{name}" rgba="{color}" {geom}/></body>'
    )


BALL = 'type="sphere" size="0.05" mass="0.5" contype="0" conaffinity="0"'
SLIDE = 'type="slide" axis="1 0 0"'


def _springs(law: str, k: Floats) -> str:
    joint = f"{SLIDE} {_laws(law, k, 6.0, 0.8)}"
    tendon = f"""<tendon><fixed name="spring" stiffness="{4 * k[2]:.4f}">
<joint joint="left" coef="1"/><joint joint="right" coef="-1"/></fixed></tendon>"""
    return _model(
        0.01, _body("left", "0 0 0", joint, BALL) + _body("right", "1 0 0", joint, BALL), tendon
    )


def _lever(law: str, k: Floats) -> str:
    weights = "".join(
        f'<body name="{name}" pos="{at:.4f} 0 0"><geom size="0.04" mass="0.5" contype="0" '
        'conaffinity="0"/></body>'
        for name, at in (("left", -0.4 * k[0]), ("right", 0.4 * k[1]))
    )
    beam = 'type="box" size="0.5 0.02 0.02" mass="0.3" contype="0" conaffinity="0"'
    joint = f'type="hinge" axis="0 1 0" {_laws(law, k, 4.0, 0.4)}'
    body = _body("beam", "0 0 0", joint, beam).replace("</body>", f"{weights}</body>")
    return _model(0.01, body, gravity="0 0 -9.81")


def _boxes(law: str, k: Floats) -> str:
    box = 'type="box" size="0.05 0.05 0.05" mass="0.5" solref="0.01 0.8" friction="0"'
    joint = f"{SLIDE} {_laws(law, k, 0.0, 0.3)}".replace('frictionloss="0.0000"', "")
    dry = f'frictionloss="{0.3 * k[2]:.4f}"' if 'frictionloss="' not in joint else ""
    return _model(
        0.005,
        _body("first", "0 0 0", f"{joint} {dry}", box)
        + _body("second", f"{0.25 * k[0]:.4f} 0 0", f"{joint} {dry}", box),
    )


def _funnel(law: str, k: Floats) -> str:
    walls = "".join(
        f'<geom type="box" size="0.02 0.2 0.4" pos="{side * 0.35} 0 0" euler="0 {side * 35} 0"/>'
        for side in (-1, 1)
    )
    ball = f"""<body name="ball" pos="0 0 0.6">
<joint name="across" {SLIDE} {_laws(law, k, 0.0, 0.1)}/>
<joint name="down" type="slide" axis="0 0 -1" damping="0.1"/>
<geom name="ball" size="0.04" mass="0.2" friction="0.2 0 0" solref="0.02 0.7"/></body>"""
    return _model(0.005, walls + ball, gravity="0 0 -9.81")


def _cartpole(law: str, k: Floats) -> str:
    pole = f"""<body name="pole"><joint name="pole" axis="0 1 0" damping="{0.02 * k[1]:.4f}"/>
<geom type="capsule" fromto="0 0 0 0 0 {0.6 * k[0]:.4f}" size="0.02" mass="0.2" contype="0"
conaffinity="0"/></body>"""
    cart = 'type="box" size="0.1 0.05 0.05" mass="1" contype="0" conaffinity="0"'
    body = _body("cart", "0 0 0", f"{SLIDE} {_laws(law, k, 0.0, 0.5)}", cart)
    motor = '<actuator><motor name="push" joint="cart" ctrlrange="-20 20"/></actuator>'
    return _model(0.01, body.replace("</body>", f"{pole}</body>"), motor, "0 0 -9.81")


def _pushing(law: str, k: Floats) -> str:
    shape, slide = 'type="box" size="0.05 0.05 0.05" mass="0.5"', 'type="slide" axis'
    ways = {"x": f'{slide}="1 0 0"', "y": f'{slide}="0 1 0"', "z": f'{slide}="0 0 1"'}
    ways["turn"] = 'axis="0 0 1"'  # a block on the floor, which cannot tip over
    blocks = "".join(
        f'<body name="{name}" pos="{x:.4f} {y} 0.05"><geom name="{name}" {shape} friction="0.3" '
        f'rgba="{color}"/>'
        + "".join(f'<joint name="{name}_{way}" {joint}/>' for way, joint in ways.items())
        + "</body>"
        for name, x, y, color in (
            ("block", 0.0, 0.0, "0.2 0.4 0.8 1"),
            ("other", 0.3 * k[0], 0.07, "0.2 0.6 0.3 1"),
        )
    )
    pusher = f"""<body name="pusher" pos="-0.3 0 0.05"><joint name="pusher" {SLIDE}
{_laws(law, k, 0.0, 0.5)}/><joint name="offset" axis="0 1 0" type="slide" damping="100"/>
<geom name="pusher" rgba="0.8 0.3 0.2 1" size="0.04" mass="0.5" friction="0.3"/></body>"""
    floor = '<geom name="floor" type="plane" size="3 3 0.1" friction="0"/>'
    return _model(0.005, floor + pusher + blocks, gravity="0 0 -9.81")


MASS, SPEED = ("kg", 0.2, 1.5), ("m/s", 0.3, 2.0)
RIGS: Mapping[str, Rig] = {
    "springs": Rig(
        _springs,
        {
            **{f"{side}.mass": MASS for side in ("left", "right")},
            "spring.stiffness": ("N/m", 1.0, 9.0),
            **{f"{side}.velocity": SPEED for side in ("left", "right")},
            "left.position": ("m", -0.3, 0.3),
        },
        {"left.position": "m", "right.position": "m"},
        1.2,
        "Two masses on springs, coupled by a spring, begin with a speed.",
    ),
    "lever": Rig(
        _lever,
        {
            **{f"{side}.mass": MASS for side in ("left", "right")},
            "beam.stiffness": ("N m/rad", 4.0, 12.0),
            "beam.damping": ("N m s/rad", 0.2, 2.0),
            "beam.velocity": ("rad/s", -2.0, 2.0),
            "beam.position": ("rad", -0.3, 0.3),
        },
        {"beam.position": "rad", "beam.velocity": "rad/s"},
        1.0,
        "A beam on a pivot with a spring, and a weight on either side.",
    ),
    "boxes": Rig(
        _boxes,
        {
            **{f"{box}.mass": MASS for box in ("first", "second")},
            "first.velocity": ("m/s", 0.3, 2.5),
            "second.velocity": ("m/s", -0.5, 0.5),
            **{f"{box}.damping": ("N s/m", 0.1, 1.5) for box in ("first", "second")},
        },
        {"first.position": "m", "second.position": "m"},
        1.2,
        "A box slides towards another one, which it may touch.",
    ),
    "funnel": Rig(
        _funnel,
        {
            "ball.mass": ("kg", 0.05, 0.5),
            "across.position": ("m", -0.12, 0.12),
            "across.velocity": ("m/s", -0.6, 0.6),
            "down.velocity": ("m/s", -1.0, 1.0),
            "across.damping": ("N s/m", 0.0, 1.0),
            "down.damping": ("N s/m", 0.0, 2.0),
        },
        {"across.position": "m", "down.position": "m"},
        0.6,
        "A ball falls into a funnel.",
    ),
    "pushing": Rig(
        _pushing,
        {
            **{f"{body}.mass": ("kg", 0.4, 1.2) for body in ("pusher", "block")},
            "block.friction": ("1", 0.2, 0.6),
            "pusher.velocity": ("m/s", 1.5, 3.0),
            "offset.position": ("m", 0.01, 0.035),
            "pusher.damping": ("N s/m", 0.1, 3.0),
        },
        {"block_x.position": "m", "block_turn.position": "rad"},
        1.2,
        "A pusher strikes a block on the floor, off its middle; it slides, and may hit another.",
    ),
    "cartpole": Rig(
        _cartpole,
        {
            "cart.mass": ("kg", 0.4, 3.0),
            "pole.mass": ("kg", 0.1, 1.0),
            "cart.damping": ("N s/m", 0.1, 4.0),
            "pole.position": ("rad", -0.25, 0.25),
            "cart.velocity": ("m/s", -0.6, 0.6),
            "pole.velocity": ("rad/s", -0.5, 0.5),
        },
        {"cart.position": "m", "pole.position": "rad"},
        1.2,
        "An agent with a linear feedback pushes a cart to balance its pole.",
        12,
        {
            "push.control": {
                "pole.position": 30.0,
                "pole.velocity": 6.0,
                "cart.position": 2.0,
                "cart.velocity": 3.0,
            }
        },
    ),
}


def file_rig(path: str) -> Rig:
    """Return a rig of any model file: its first parameters, and speeds of joints, are causes.

    Raises:
        ModelError: It has fewer than three such parameters, or no joint with one number.
    """
    with World(path, expose=["*.mass", "*.damping", "*.stiffness", "*.frictionloss"]) as world:
        every: list[Any] = [*world.model.variables]
        scalars = [v for v in every if v.shape == () and getattr(v, "default", None) is not None]
        states = [v.name for v in scalars if v.name.endswith(".position") and v.role == "state"]
        parameters = {
            v.name: (v.unit, 0.5 * float(v.default), 2.0 * float(v.default))
            for v in scalars
            if v.role == "parameter" and v.settable and float(v.default) > 0.0
            if v.name.endswith((".mass", ".damping", ".stiffness", ".frictionloss"))
        }
    causes = dict([*parameters.items()][:4])
    speeds = [state.replace(".position", ".velocity") for state in states[:3]]
    causes |= dict.fromkeys(speeds, ("1/s", 0.3, 2.0))
    if len(causes) < 4 or not states:
        raise ModelError([f"{path} has too few parameters, or no joint with one number"])
    return Rig(lambda _law, _k: path, causes, dict.fromkeys(states[-2:], "1"), 1.0, f"{path}.")


def rig(made: Rig, rng: np.random.Generator, knobs: Knobs) -> Testbed:
    """Make a rig; a hidden common cause moves all of its causes."""
    k, quantities = rng.uniform(0.7, 1.4, 3), list[LabVariable]()
    ties, follows = [Exogenous(name="driver", distribution=Box(-1.0, 1.0))], dict[str, Any]()
    for cause, (unit, low, high) in made.causes.items():
        ties.append(Exogenous(name=f"own.{cause}", distribution=Box(-1.0, 1.0)))
        half = 0.5 * (high - low)
        common = 0.7 * float(rng.choice([-1.0, 1.0])) if knobs.hidden else 0.0
        weights = (half * common, half * (1.0 - abs(common)))
        law = Linear(weights=weights, intercept=low + half)
        follows[cause] = Mechanism(law, parents=("driver", f"own.{cause}"))
        doc = "Where it is set, or is by itself, at the beginning."
        quantities.append(LabVariable(cause, unit, doc, Outcome(cause, "first"), cause, low, high))
    for i in range(knobs.distractors):
        lamp = f"lamp{i}.brightness"
        ties.append(Exogenous(name=lamp, unit="cd", distribution=Box(0.0, 1.0)))
        quantities.append(LabVariable(lamp, "cd", "A lamp.", Outcome(lamp), lamp, 0.0, 1.0))
    outcomes = [(what, how) for what in made.reads for how in ("final", "mean", "max")]
    for what, how in outcomes:
        doc = f"The {how} value over the episode."
        quantities.append(LabVariable(f"{what}.{how}", made.reads[what], doc, Outcome(what, how)))
    for command, of in made.agent.items():
        follows[command] = Mechanism(Linear(weights=tuple(of.values())), parents=tuple(of))
    task = ModelTask(
        made.xml(knobs.law, k),
        expose=[c for c in made.causes if not c.endswith((".velocity", ".position"))],
        ties=ties,
        control_dt=made.seconds / made.steps,
        seconds=made.seconds,
    )
    return Testbed(
        World(task).given(follows),
        tuple(quantities),
        {"policy": None, "steps": made.steps},
        128,
        f"{made.doc} {LAWS[knobs.law].capitalize()}.",
        edges=tuple((cause, f"{what}.{how}") for cause in made.causes for what, how in outcomes),
    )


def row(rng: np.random.Generator, knobs: Knobs) -> Testbed:
    """Make boxes on a rail, each with a speed; they act on one another only while they touch."""
    n = max(4, knobs.variables - 1)
    names = [f"box{i}" for i in rng.permutation(n)]
    shape = 'type="box" size="0.05 0.05 0.05" friction="0" solref="0.03 0.5"'
    gaps, masses = rng.uniform(0.15, 0.4, n), rng.uniform(0.4, 0.8, n)
    bodies = "".join(
        _body(name, f"{x:.4f} 0 0", f'{SLIDE} damping="0.3"', f'{shape} mass="{mass:.4f}"')
        for name, x, mass in zip(names, np.cumsum(gaps), masses, strict=True)
    )
    made = Rig(
        lambda _law, _k: _model(0.005, bodies),
        {f"{name}.velocity": ("m/s", -1.2, 1.2) for name in sorted(names)},
        dict.fromkeys((f"{name}.position" for name in sorted(names)), "m"),
        1.2,
        "Boxes slide on a rail; they act on one another only while they touch.",
        24,
    )
    bed = rig(made, rng, replace(knobs, law="plain"))
    kept = tuple(one for one in bed.quantities if not one.name.endswith((".mean", ".max")))
    ends = {f"{name}.velocity": f"{name}.position.final" for name in names}
    return replace(bed, quantities=kept, budget=240, edges=(), own=tuple(ends.items()), local=True)


def acted(bed: Testbed, do: Mapping[str, Any]) -> tuple[Edge, ...]:
    """Return which settable states acted on which outcomes in one run.

    They did if edges of the local graphs of its control steps lead from one to the other, in the
    order of time. An edge by contact is there in steps in which a chain of contacts joins its ends.
    """
    live = bed.world.live(bed.setting["policy"], do=do)
    reached = {cause: {cause} for cause, _ in bed.own}
    for _ in range(bed.setting["steps"]):
        graph = live.world.local_graph(live.world.task.idle(live.world))
        reached = {
            cause: {effect for one in some for effect in graph.successors(one)}
            for cause, some in reached.items()
        }
        live.step()
    live.close()
    return tuple(
        (cause, one.name)
        for cause, some in reached.items()
        for one in bed.outcomes
        if one.reads and one.reads.name in some and (cause, one.name) not in bed.own
    )


WORLDS: Mapping[str, tuple[Callable[[np.random.Generator, Knobs], Testbed], str]] = {
    "equations": (equations, "A random acyclic model of equations."),
    "servo": (servos, "Arms whose servos follow one another."),
    "network": (network, "Masses on a random network of springs, for one step."),
    "row": (row, "Boxes on a rail, which act on one another only while they touch."),
    **{name: (partial(rig, made), made.doc) for name, made in RIGS.items()},
}


def testbed(world: str, rng: np.random.Generator, knobs: Knobs) -> Testbed:
    """Make the testbed of a world of ``WORLDS``, or of a model file."""
    if world in WORLDS:
        return WORLDS[world][0](rng, knobs)
    return rig(file_rig(world), rng, knobs)
