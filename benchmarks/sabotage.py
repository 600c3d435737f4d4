"""A mutation study of ``verify``: physics and declaration are made to disagree; is it seen?

    python -m benchmarks.sabotage [--seed 0] [--only NAME] [--out benchmarks/sabotage.json]

Each sabotage changes the engine, a mechanism, a readout or the noise of a system whose declaration
stays as it is. ``verify`` then has 40 probe states: at most 32, and 8 held out; of causal models
without a backend 40 units.

Criterion: a sabotage is *caught* if the report does not confirm the graph, and one of its
complaints names what was sabotaged. A complaint is an undeclared effect, something that differs by
itself, or a declared edge that was never seen although the honest system shows it
with the same seed and budget. It names a sabotage if each of the regular expressions in ``names``
matches one of its variables. So a catch for another reason does not count. No honest system may be
refuted with any seed that is used, or it is a false alarm. The mutation score is the share that is
caught of those that change the graph (``visible``); the target is 95 %. What lies beyond what 40
states can show is kept in the list and marked, with the reason in ``why``. So is a parameter with
another meaning, which changes no edge: ``test`` names the test of an adapter that fails then, as
``tests/physics/test_wrong_values.py`` checks.
"""

from __future__ import annotations

import argparse
import copy
import json
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import scm_world as sw
from benchmarks import as_json
from scm_world.backends import make_backend
from scm_world.backends.base import Backend, BackendWrapper, EngineSnapshot
from scm_world.graph import SCM, NoiseKey
from scm_world.models import Difference, Scene
from scm_world.queries import Verification, World, verify
from scm_world.tasks.trifinger.single import Pushing
from scm_world.variables import Box, Derived, Exogenous, Function, Linear, Measured, Normal

PROBES, HELD_OUT = 32, 8
FIRST = 8, 4  # of a first try; edges that were not seen in so few states do not count
HERE = Path(__file__).parent

Memory = dict[str, Any]


@dataclass(frozen=True)
class Sabotage:
    """A way to make physics and declaration disagree.

    Attributes:
        name: Of the sabotage.
        kind: Its class: effect, cut, meaning, readout or time.
        system: The honest system, a key of ``HONEST``.
        names: Regular expressions: a complaint has to have a variable for each.
        make: Makes the sabotaged system.
        visible: Whether it changes the graph in states that can be reached.
        why: What it does, or why it cannot be seen.
        test: Test in ``tests/physics`` that fails with it, where the graph stays as it is.
    """

    name: str
    kind: str
    system: str
    names: tuple[str, ...]
    make: Callable[[], Any]
    visible: bool = True
    why: str = ""
    test: str = ""


class Sabotaged(BackendWrapper):
    """An engine with something wrong in it.

    Args:
        engine: That does the work.
        before: Is given the command, and what is remembered; gives the command that is used.
        after: Is given the state vector after a step; changes it in place.
        write: Is given the parameters that are written; gives those that are used.
        kept: Whether snapshots have what is remembered.

    Attributes:
        world: The world that it belongs to, for what reads there.
    """

    name: ClassVar[str] = "sabotaged"

    def __init__(
        self,
        engine: Backend,
        before: Callable[[Any, Any, Memory], Any] | None = None,
        after: Callable[[Any, Any, Memory], None] | None = None,
        write: Callable[[Any, dict[Any, Any]], dict[Any, Any]] | None = None,
        kept: bool = True,
    ) -> None:
        super().__init__(engine)
        self.before, self.after, self.write, self.kept = before, after, write, kept
        self.memory: Memory = {}
        self.asked: dict[Any, Any] = {}
        self.world: Any = None

    def value(self, name: str) -> Any:
        """Give the present value of a variable of the world."""
        return self.world.row[name]

    def build(self, scene: Scene) -> None:
        """Realise a scene."""
        self.memory, self.asked = {}, dict(scene.parameters)
        if self.write is not None:
            scene = replace(scene, parameters=self.write(self, dict(scene.parameters)))
        self.engine.build(scene)

    def apply(self, difference: Difference) -> None:
        """Change parameters as they are told wrongly."""
        self.asked |= difference.parameters
        if self.write is not None and difference.parameters:
            given = self.write(self, dict(difference.parameters))
            difference = replace(difference, parameters=given)
        self.engine.apply(difference)

    def parameters(self, keys: Iterable[Any]) -> Any:
        """Report what was asked for."""
        found = dict(self.engine.parameters(keys))
        if self.write is None:
            return found
        return {key: np.array(self.asked.get(key, value)) for key, value in found.items()}

    def step(self, command: Any, substeps: int) -> None:
        """Hold a command, and do something wrong before or after it."""
        if self.before is not None:
            command = self.before(self, np.array(command), self.memory)
        self.engine.step(command, substeps)
        if self.after is not None:
            state = self.engine.read()
            old = state.vector.copy()
            self.after(self, state.vector, self.memory)
            if (state.vector != old).any():
                self.engine.apply(Difference(state=state))

    def snapshot(self) -> EngineSnapshot:
        """Save everything, with the memory or without it."""
        memory = copy.deepcopy(self.memory) if self.kept else None
        return EngineSnapshot.of(self, (self.engine.snapshot(), memory, dict(self.asked)))

    def restore(self, snapshot: EngineSnapshot) -> None:
        """Go back."""
        inside, memory, asked = snapshot.opened(self)
        self.engine.restore(inside)
        self.asked = dict(asked)
        if memory is not None:
            self.memory = copy.deepcopy(memory)


# --- honest systems -------------------------------------------------------------------------------

BALLS = """
<mujoco model="two">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="one" pos="0 0 .2"><freejoint/><geom name="one" size=".1" mass="1"/></body>
    <body name="other" pos="0 .4 .2"><freejoint/><geom name="other" size=".1" mass="1"/></body>
  </worldbody>
</mujoco>
"""

CART = """
<mujoco model="cart">
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping=".1"/>
      <geom name="cart" type="box" size=".1 .05 .05" mass="1" contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping=".05"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 .5" size=".02" mass=".1" contype="0"
              conaffinity="0"/>
        <site name="tip" pos="0 0 .5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="slider" gear="10" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def task(name: Any, engine: str = "mujoco", **wrong: Any) -> World:
    """Make a world of a task, with something wrong in its engine."""
    options = {"resolution": "finger"} if wrong.pop("fine", False) else {}
    backend = Sabotaged(make_backend(engine), **wrong)
    backend.world = world = World(name, backend=backend, **options)
    return world


def model(text: str, engine: str = "mujoco", outcomes: Any = (), **wrong: Any) -> World:
    """Make a world of a model, with something wrong in its engine."""
    backend = Sabotaged(make_backend(engine), **wrong)
    backend.world = world = World(text, backend=backend, outcomes=outcomes)
    return world


def honest_step(p: Any, s: Any, a: Any, n: Any) -> dict[str, Any]:
    """Two tanks: one is filled by a pump and empties into the other."""
    flow = p["valve"] * s["upper"]
    return {
        "upper": s["upper"] + 0.1 * (p["pump"] * a["power"] - flow) + 0.01 * n["drops"],
        "lower": s["lower"] + 0.1 * (flow - p["leak"] * s["lower"]) + 0.01 * n["rain"],
        "dirt": 0.9 * s["dirt"] + 0.1 * p["dust"],
    }


def tanks(step: Any = honest_step, noise: Any = None, **more: Any) -> World:
    """Make the world of two tanks, and dirt that concerns neither."""
    box = Box(0.0, 2.0)
    drawn = {"drops": Normal(), "rain": Normal()} if noise is None else noise
    return World(
        step,
        parameters=[
            *(Exogenous(name=name, default=0.8, bounds=box) for name in ("valve", "pump", "leak")),
            *(Exogenous(name=name, default=0.5, bounds=box) for name in ("dust", "paint", "label")),
        ],
        states=[
            Measured(name="upper", default=1.0, parents=("upper", "valve", "pump", "power")),
            Measured(name="lower", default=1.0, parents=("lower", "upper", "valve", "leak")),
            Measured(name="dirt", default=1.0, parents=("dirt", "dust")),
        ],
        actions=[sw.Action(name="power", bounds=Box(0.0, 1.0))],
        noise=drawn,
        control_dt=0.1,
        **more,
    )


def equations(b: Any = None, c: Any = None, noise: Any = None) -> SCM:
    """Make a causal model without a backend."""
    return SCM(
        [
            Exogenous(name="a", distribution=Normal()),
            Exogenous(name="d", distribution=Box(0.0, 1.0)),
            Derived(
                name="b", parents=("a",), mechanism=b or Linear(weights=(2.0,)), noise=Normal()
            ),
            Derived(name="c", parents=("a", "b"), mechanism=c or Linear(weights=(1.0, -1.0))),
        ]
    )


HONEST: dict[str, Callable[[], Any]] = {
    "pushing, mujoco": lambda: task("pushing"),
    "pushing, bullet": lambda: task("pushing", "bullet"),
    "reaching, mujoco": lambda: task("reaching"),
    "reaching by finger, mujoco": lambda: task("reaching", fine=True),
    "picking, mujoco": lambda: task("picking"),
    "balls, mujoco": lambda: model(BALLS),
    "balls, bullet": lambda: model(BALLS, "bullet"),
    "cart, mujoco": lambda: model(CART),
    "cart, bullet": lambda: model(CART, "bullet"),
    "tanks, step": tanks,
    "equations": equations,
}


# --- what goes wrong ------------------------------------------------------------------------------


def kick(where: int | slice, by: Callable[[Sabotaged], Any]) -> Callable[[Any, Any, Memory], None]:
    """Add something to a part of the state after each step."""

    def after(engine: Sabotaged, vector: Any, memory: Memory) -> None:
        vector[where] += by(engine)

    return after


def ignored(*keys: tuple[str, str]) -> Callable[[Any, dict[Any, Any]], dict[Any, Any]]:
    """Never write some parameters after the scene was built."""

    def write(engine: Sabotaged, given: dict[Any, Any]) -> dict[Any, Any]:
        for key in keys:
            if key in given:
                engine.memory.setdefault(key, given[key])
                given[key] = engine.memory[key]
        return given

    return write


def told(key: tuple[str, str], change: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    """Write another number than the one that was asked for."""

    def write(engine: Sabotaged, given: dict[Any, Any]) -> dict[Any, Any]:
        return given | {key: np.asarray(change(given[key]))} if key in given else given

    return write


def exchanged(*keys: tuple[str, str]) -> Callable[[Any, dict[Any, Any]], dict[Any, Any]]:
    """Write the numbers of some parameters to the next of them, in a circle."""

    def write(engine: Sabotaged, given: dict[Any, Any]) -> dict[Any, Any]:
        found = dict(given)
        for key, other in zip(keys, (*keys[1:], keys[0]), strict=True):
            if key in given:
                found[other] = np.array(given[key])
        return found

    return write


def spill(engine: Sabotaged, given: dict[Any, Any]) -> dict[Any, Any]:
    """Change damping of joints with the friction of the floor."""
    if ("floor", "friction") in given:
        damping = engine.asked["robot", "joint_damping"]
        scale = 1.0 + float(given["floor", "friction"])
        given["robot", "joint_damping"] = scale * np.asarray(damping)
    return given


def stepping(**changes: Callable[..., Any]) -> Any:
    """Make a step function of the tanks with other equations for some of its states."""

    def step(p: Any, s: Any, a: Any, n: Any) -> dict[str, Any]:
        found = honest_step(p, s, a, n)
        return found | {name: f(found[name], p, s, a, n) for name, f in changes.items()}

    return step


def delayed(lag: int) -> Callable[[Any, Any, Memory], Any]:
    """Give the engine the command of some steps ago."""

    def before(engine: Sabotaged, command: Any, memory: Memory) -> Any:
        queue = memory.setdefault("queue", [])
        queue.append(command)
        return queue.pop(0) if len(queue) > lag else command

    return before


def echo(lag: int, part: int, size: float) -> Callable[[Any, Any, Memory], Any]:
    """Add a part of the command of some steps ago to the present one."""

    def before(engine: Sabotaged, command: Any, memory: Memory) -> Any:
        queue = memory.setdefault("queue", [])
        queue.append(command.copy())
        if len(queue) > lag:
            command[part] += size * queue.pop(0)[part]
        return command

    return before


def hysteresis(engine: Sabotaged, vector: Any, memory: Memory) -> None:
    """Push back what was once fast."""
    memory["most"] = max(memory.get("most", 0.0), float(np.abs(vector[34:37]).max()))
    vector[34] -= 0.01 * memory["most"]


def remembered(engine: Sabotaged, vector: Any, memory: Memory) -> None:
    """Let the damping of one step ago act."""
    before = memory.get("damping", 0.0)
    memory["damping"] = float(np.mean(engine.value("joint_damping")))
    vector[9] += 0.01 * before


def counted(after: int, size: float = 0.01) -> Callable[[Any, Any, Memory], None]:
    """Let a color act from some control step on."""

    def late(engine: Sabotaged, vector: Any, memory: Memory) -> None:
        memory["steps"] = memory.get("steps", 0) + 1
        if memory["steps"] > after:
            vector[34] += size * float(engine.value("tool_block.color")[0])

    return late


def outcome(text: str, wrong: Callable[[World], float]) -> World:
    """Make a model with an outcome, a function of the hinge that reads something else, too."""
    box: list[World] = []

    def height(angle: Any) -> Any:
        return np.cos(angle) + (wrong(box[0]) if box else 0.0)

    found = Measured(name="height", parents=("hinge.position",), mechanism=Function(height))
    box.append(model(text, outcomes=[found]))
    return box[0]


def rewarded(wrong: Callable[[Any], float]) -> World:
    """Make pushing with a reward term that reads something else, too."""
    box: list[World] = []

    class Liking(Pushing):
        def dense(self) -> Iterable[Any]:
            for variable in super().dense():
                if variable.name == "reward.block_to_goal":
                    inner = variable.mechanism.bind()

                    def function(*given: Any, inner: Any = inner) -> Any:
                        return inner(*given) + (wrong(box[0]) if box else 0.0)

                    yield variable.model_copy(update={"mechanism": Function(function)})
                else:
                    yield variable

    box.append(task(Liking()))
    return box[0]


def counter() -> Callable[..., float]:
    """Give another small number at each call."""
    calls = [0]

    def function(*_: Any) -> float:
        calls[0] += 1
        return 0.01 * calls[0]

    return function


def latest() -> Callable[..., Any]:
    """Make a mechanism that mixes in what it was last asked."""
    last = [0.0]

    def function(a: Any, noise: Any) -> Any:
        before, last[0] = last[0], float(np.mean(a))
        return 2.0 * a + 0.1 * before + noise

    return function


def rng(*_: Any) -> float:
    """Draw from a global generator."""
    return float(np.random.normal())  # noqa: NPY002 # that is what is wrong


class OtherCommands:
    """Commands with other noise than declared.

    Args:
        world: Whose commands are replaced.
        wrong: Is given the honest command, the values and the noise key.
    """

    def __init__(self, world: Any, wrong: Callable[[Any, Any, NoiseKey], Any]) -> None:
        self.world, self.wrong = world, wrong
        self.honest = world._decided
        world._decided = self

    def __call__(self, action: Any) -> Any:
        """Turn an action into a command."""
        action, command, kept = self.honest(action)
        key = self.world.noise_key(self.world.index)
        return action, self.wrong(np.array(command), self.world.row, key), kept


def with_commands(world: Any, wrong: Callable[[Any, Any, NoiseKey], Any]) -> Any:
    """Replace what a world tells its engine."""
    OtherCommands(world, wrong)
    return world


def colored(command: Any, values: Any, key: NoiseKey) -> Any:
    """Draw actuator noise, where there is some, from a stream that a color selects."""
    noise, name = float(values["actuator_noise"]), f"noise {float(values['tool_block.color'][0])}"
    return command + 0.1 * noise * key.draw(Normal(), name, (len(command),), {})


def keyed_by_state(command: Any, values: Any, key: NoiseKey) -> Any:
    """Draw the noise of one tank from a stream that the dirt selects."""
    command[1] = key.draw(Normal(), f"drops {float(values['dirt'])}", (), {})
    return command


def one_stream(command: Any, values: Any, key: NoiseKey) -> Any:
    """Give both tanks one noise."""
    command[2] = command[1]
    return command


def unsaved(command: Any, values: Any, key: NoiseKey) -> Any:
    """Draw the noise anew each time."""
    command[1] = rng()
    return command


class SharedNoise(SCM):
    """Equations where the noise of b is that of a."""

    def solve(self, *given: Any, key: Any = None, **options: Any) -> dict[str, Any]:
        """Solve with the noise of b known: it is drawn from the stream of a."""
        if key is not None:
            b: Any = self.declared("b")
            key = replace(key, given={"b": key.natural(b.noise, "a", b.shape, {})})
        return super().solve(*given, key=key, **options)


def shared_equations() -> SCM:
    """Make equations where the noise of b is that of a."""
    return SharedNoise(equations().variables)


def color(engine: Sabotaged, name: str = "tool_block.color", part: int = 0) -> float:
    """Give a part of a color."""
    return float(engine.value(name)[part])


def xor(engine: Sabotaged) -> float:
    """Act where just one of two colors is bright."""
    return 0.01 * float((color(engine) > 0.5) != (color(engine, "stage_color") > 0.5))


def both(engine: Sabotaged) -> float:
    """Act where both of two colors are much brighter or darker than usual."""
    one, other = color(engine, "floor_color"), color(engine, "goal_block.color", 2)
    return 0.01 * float(one > 0.6 and other > 0.6)


COLOR, LINK = r"tool_block\.color", "robot_finger_{}_link_{}"
MASSES = tuple((LINK.format(60, k), "mass") for k in (1, 2, 3))


WRITES = "both act on the same states; tests/physics/test_writes.py has that a write changes one"
SHARED = "no edge changes; that streams of noise are independent is a test of the noise"


def tank(name: str, names: tuple[str, ...], why: str = "", **changes: Any) -> Sabotage:
    """Sabotage the equations of the tanks."""
    return Sabotage(
        name, "effect", "tanks, step", names, lambda: tanks(stepping(**changes)), why=why
    )


SABOTAGES: tuple[Sabotage, ...] = (
    # --- an undeclared effect of a parameter or a state -------------------------------------------
    Sabotage(
        "a color pushes the block",
        "effect",
        "pushing, mujoco",
        (COLOR, r"tool_block\..*"),
        lambda: task("pushing", after=kick(34, lambda e: 0.01 * color(e))),
    ),
    Sabotage(
        "a color of the goal turns a joint",
        "effect",
        "pushing, bullet",
        (r"goal_block\.color", "joint_.*"),
        lambda: task(
            "pushing", "bullet", after=kick(9, lambda e: 0.01 * color(e, "goal_block.color"))
        ),
    ),
    Sabotage(
        "a color changes the mass",
        "effect",
        "picking, mujoco",
        (COLOR, ".*"),
        lambda: task(
            "picking",
            write=lambda e, g: (
                g
                | (
                    {
                        ("tool_block", "mass"): np.array(
                            0.02 + 0.05 * float(g["tool_block", "color"][0])
                        )
                    }
                    if ("tool_block", "color") in g
                    else {}
                )
            ),
        ),
    ),
    Sabotage(
        "the clock pushes",
        "effect",
        "pushing, mujoco",
        ("control_index", ".*"),
        lambda: task("pushing", after=kick(9, lambda e: 1e-3 * e.world.index)),
    ),
    Sabotage(
        "the goal attracts the block",
        "effect",
        "pushing, bullet",
        (r"goal_block\.(cartesian_position|polar)", r"tool_block\..*"),
        lambda: task(
            "pushing",
            "bullet",
            after=kick(slice(34, 37), lambda e: 0.01 * e.value("goal_block.cartesian_position")),
        ),
    ),
    Sabotage(
        "a camera bends gravity",
        "effect",
        "pushing, mujoco",
        (r"camera_60\.field_of_view", ".*"),
        lambda: task(
            "pushing", after=kick(36, lambda e: 1e-3 * float(e.value("camera_60.field_of_view")))
        ),
    ),
    Sabotage(
        "a finger feels the mass of another",
        "effect",
        "reaching by finger, mujoco",
        (r"robot_finger_60_link_2\.mass", r"finger_120.*"),
        lambda: task(
            "reaching",
            fine=True,
            after=kick(12, lambda e: 0.1 * float(e.value("robot_finger_60_link_2.mass"))),
        ),
        why="the edge is declared, by contact: it acts without",
    ),
    Sabotage(
        "a finger feels the angle of another",
        "effect",
        "reaching by finger, mujoco",
        (r"finger_60.*", r"finger_120.*"),
        lambda: task(
            "reaching",
            fine=True,
            after=kick(12, lambda e: 0.01 * float(e.value("finger_60.joint_positions")[1])),
        ),
        why="the edge is declared, by contact: it acts without",
    ),
    Sabotage(
        "balls attract without contact",
        "effect",
        "balls, mujoco",
        (r"one\..*", r"other\..*"),
        lambda: model(BALLS, after=lambda e, v, m: v.__setitem__(20, v[20] + 1e-3 * v[0])),
        why="the edge is declared, by contact: it acts without",
    ),
    Sabotage(
        "a ball feels the mass of the other",
        "effect",
        "balls, bullet",
        (r"one\.mass", r"other\..*"),
        lambda: model(BALLS, "bullet", after=kick(20, lambda e: 1e-2 * float(e.value("one.mass")))),
        why="the edge is declared, by contact: it acts without",
    ),
    Sabotage(
        "a color of the pole drives the cart",
        "effect",
        "cart, bullet",
        (r".*color", r"(slider|hinge)\..*"),
        lambda: model(CART, "bullet", after=kick(2, lambda e: 0.01 * color(e, "cart.color"))),
    ),
    tank(
        "paint seals the valve",
        ("paint", "upper"),
        upper=lambda new, p, s, a, n: new + 0.01 * p["paint"],
    ),
    tank(
        "dirt reaches the lower tank",
        ("dirt", "lower"),
        lower=lambda new, p, s, a, n: new + 0.01 * s["dirt"],
    ),
    tank(
        "the pump reaches the lower tank",
        ("power", "lower"),
        lower=lambda new, p, s, a, n: new + 0.01 * a["power"],
    ),
    # --- a declared edge that is cut -----------------
    Sabotage(
        "friction of the floor is never written",
        "cut",
        "pushing, mujoco",
        ("floor_friction",),
        lambda: task("pushing", write=ignored(("floor", "friction"))),
    ),
    Sabotage(
        "the mass is never written",
        "cut",
        "pushing, bullet",
        (r"tool_block\.mass",),
        lambda: task("pushing", "bullet", write=ignored(("tool_block", "mass"))),
    ),
    Sabotage(
        "restitution is never written",
        "cut",
        "picking, mujoco",
        ("restitution",),
        lambda: task("picking", write=ignored(("world", "restitution"))),
    ),
    Sabotage(
        "one finger gets no command",
        "cut",
        "reaching by finger, mujoco",
        (r"finger_60\.action",),
        lambda: task(
            "reaching", fine=True, before=lambda e, c, m: np.where(np.arange(len(c)) < 3, 0.0, c)
        ),
    ),
    Sabotage(
        "the motor is not connected",
        "cut",
        "cart, mujoco",
        (r"push\..*",),
        lambda: model(CART, before=lambda e, c, m: 0.0 * c),
    ),
    Sabotage(
        "damping of a hinge is never written",
        "cut",
        "cart, mujoco",
        (r"hinge\.damping",),
        lambda: model(CART, write=ignored(("hinge", "damping"))),
    ),
    Sabotage(
        "gravity is never written",
        "cut",
        "balls, bullet",
        ("gravity",),
        lambda: model(BALLS, "bullet", write=ignored(("", "gravity"))),
    ),
    replace(
        tank(
            "the leak is closed",
            ("leak", "lower"),
            lower=lambda new, p, s, a, n: new + 0.1 * p["leak"] * s["lower"],
        ),
        kind="cut",
    ),
    replace(
        tank(
            "the pump is off",
            ("power|pump", "upper"),
            upper=lambda new, p, s, a, n: new - 0.1 * p["pump"] * a["power"],
        ),
        kind="cut",
    ),
    Sabotage(
        "a mechanism ignores a parent",
        "cut",
        "equations",
        ("b", "c"),
        lambda: equations(c=Function(lambda a, b: a + 0.0 * b)),
    ),
    # --- a parameter with another meaning -----------------
    Sabotage(
        "mass times ten",
        "meaning",
        "balls, mujoco",
        (r"one\.mass",),
        lambda: model(BALLS, write=told(("one", "mass"), lambda v: 10.0 * v)),
        visible=False,
        test="test_balls_rest_on_their_radius_with_their_weight",
    ),
    Sabotage(
        "mass inverted",
        "meaning",
        "cart, bullet",
        (r"cart\.mass",),
        lambda: model(CART, "bullet", write=told(("cart", "mass"), lambda v: 1.0 / v)),
        visible=False,
        test="test_joints_move_as_in_plain_mujoco",
    ),
    Sabotage(
        "mass of the block times ten",
        "meaning",
        "pushing, mujoco",
        (r"tool_block\.mass",),
        lambda: task("pushing", write=told(("tool_block", "mass"), lambda v: 10.0 * v)),
        visible=False,
        test="test_weight",
    ),
    Sabotage(
        "gravity upward",
        "meaning",
        "balls, bullet",
        ("gravity",),
        lambda: model(BALLS, "bullet", write=told(("", "gravity"), lambda v: -v)),
        visible=False,
        test="test_balls_rest_on_their_radius_with_their_weight",
    ),
    Sabotage(
        "gravity of the task doubled",
        "meaning",
        "pushing, bullet",
        ("gravity",),
        lambda: task("pushing", "bullet", write=told(("world", "gravity"), lambda v: 2.0 * v)),
        visible=False,
        test="test_free_fall",
    ),
    Sabotage(
        "floor and wall swapped",
        "meaning",
        "pushing, mujoco",
        ("(floor|stage)_friction",),
        lambda: task("pushing", write=exchanged(("floor", "friction"), ("stage", "friction"))),
        visible=False,
        why=WRITES,
    ),
    Sabotage(
        "link masses permuted",
        "meaning",
        "reaching, mujoco",
        (r"robot_finger_60_link_.\.mass",),
        lambda: task("reaching", write=exchanged(*MASSES)),
    ),
    Sabotage(
        "masses of balls exchanged",
        "meaning",
        "balls, bullet",
        (r"(one|other)\..*",),
        lambda: model(BALLS, "bullet", write=exchanged(("one", "mass"), ("other", "mass"))),
    ),
    Sabotage(
        "the motor turns the other way",
        "meaning",
        "cart, bullet",
        (r"push\..*",),
        lambda: model(CART, "bullet", before=lambda e, c, m: -c),
        visible=False,
        test="test_joints_move_as_in_plain_mujoco",
    ),
    Sabotage(
        "damping times three",
        "meaning",
        "cart, mujoco",
        (r"hinge\.damping",),
        lambda: model(CART, write=told(("hinge", "damping"), lambda v: 3.0 * v)),
        visible=False,
        test="test_joints_move_as_in_plain_mujoco",
    ),
    Sabotage(
        "friction of the floor doubled",
        "meaning",
        "pushing, mujoco",
        ("floor_friction",),
        lambda: task("pushing", write=told(("floor", "friction"), lambda v: 2.0 * v)),
        visible=False,
        test="test_stopping_distance",
    ),
    Sabotage(
        "friction of the block halved",
        "meaning",
        "pushing, bullet",
        (r"tool_block\.friction",),
        lambda: task("pushing", "bullet", write=told(("tool_block", "friction"), lambda v: v / 2)),
        visible=False,
        test="test_stopping_distance",
    ),
    Sabotage(
        "the block is a fifth larger",
        "meaning",
        "picking, mujoco",
        (r"tool_block\.size",),
        lambda: task("picking", write=told(("tool_block", "size"), lambda v: 1.2 * v)),
        visible=False,
        test="test_weight",
    ),
    Sabotage(
        "a ball is a fifth smaller",
        "meaning",
        "balls, bullet",
        (r"one\.size",),
        lambda: model(BALLS, "bullet", write=told(("one", "size"), lambda v: 0.8 * v)),
        visible=False,
        test="test_balls_rest_on_their_radius_with_their_weight",
    ),
    Sabotage(
        "friction of the fingers doubled",
        "meaning",
        "pushing, mujoco",
        ("finger_friction",),
        lambda: task("pushing", write=told(("robot", "friction"), lambda v: 2.0 * v)),
        visible=False,
        why="no edge changes, and no test measures what slides along a finger",
    ),
    Sabotage(
        "restitution doubled",
        "meaning",
        "pushing, bullet",
        ("restitution",),
        lambda: task("pushing", "bullet", write=told(("world", "restitution"), lambda v: 2.0 * v)),
        visible=False,
        test="test_rebound",
    ),
    Sabotage(
        "friction of the floor wears",
        "meaning",
        "pushing, mujoco",
        ("floor_friction",),
        lambda: task(
            "pushing",
            after=lambda e, v, m: e.engine.apply(
                Difference(
                    parameters={
                        ("floor", "friction"): 0.99
                        * e.engine.parameters([("floor", "friction")])["floor", "friction"]
                    }
                )
            ),
        ),
    ),
    Sabotage(
        "one write changes two parameters",
        "meaning",
        "pushing, bullet",
        ("floor_friction", "joint_.*"),
        lambda: task("pushing", "bullet", write=spill),
        visible=False,
        why=WRITES,
    ),
    # --- readouts and definitions -----------------
    Sabotage(
        "the reward likes a color",
        "readout",
        "pushing, mujoco",
        (COLOR, r"reward\.block_to_goal"),
        lambda: rewarded(lambda w: float(w.row["tool_block.color"][0])),
    ),
    Sabotage(
        "the reward reads the friction in the engine",
        "readout",
        "pushing, mujoco",
        ("floor_friction", r"reward\.block_to_goal"),
        lambda: rewarded(
            lambda w: float(w.backend.parameters([("floor", "friction")])["floor", "friction"])
        ),
    ),
    Sabotage(
        "the reward counts its calls",
        "readout",
        "pushing, mujoco",
        (r"reward\.block_to_goal",),
        lambda: rewarded(counter()),
    ),
    Sabotage(
        "an outcome reads another state",
        "readout",
        "cart, mujoco",
        (r"slider\.position", "height"),
        lambda: outcome(CART, lambda w: 0.1 * float(w.row["slider.position"])),
    ),
    Sabotage(
        "an outcome reads the engine",
        "readout",
        "cart, mujoco",
        (r".*\.mass", "height"),
        lambda: outcome(
            CART, lambda w: float(w.backend.parameters([("pole", "mass")])["pole", "mass"])
        ),
    ),
    Sabotage(
        "an outcome reads the clock of the computer",
        "readout",
        "cart, mujoco",
        ("height",),
        lambda: outcome(CART, lambda w: time.perf_counter()),
    ),
    Sabotage(
        "an outcome draws from a global generator",
        "readout",
        "cart, mujoco",
        ("height",),
        lambda: outcome(CART, rng),
    ),
    Sabotage(
        "a mechanism draws from a global generator",
        "readout",
        "equations",
        ("c",),
        lambda: equations(c=Function(lambda a, b: a - b + rng())),
    ),
    Sabotage(
        "a mechanism mixes in what it was last asked",
        "readout",
        "equations",
        ("b",),
        lambda: equations(b=Function(latest())),
    ),
    # --- time, memory and noise -----------------
    Sabotage(
        "the command comes one step late",
        "time",
        "pushing, mujoco",
        ("action", ".*"),
        lambda: task("pushing", before=delayed(1)),
    ),
    Sabotage(
        "the command comes two steps late",
        "time",
        "reaching, mujoco",
        ("action", ".*"),
        lambda: task("reaching", before=delayed(2)),
    ),
    Sabotage(
        "the motor echoes after three steps",
        "time",
        "cart, bullet",
        (r"push\..*", ".*"),
        lambda: model(CART, "bullet", before=echo(3, 0, 0.1)),
    ),
    Sabotage(
        "the command comes late, and snapshots forget it",
        "time",
        "pushing, bullet",
        ("joint_.*",),
        lambda: task("pushing", "bullet", before=delayed(1), kept=False),
    ),
    Sabotage(
        "the block remembers how fast it was",
        "time",
        "pushing, bullet",
        (r"tool_block\.linear_velocity", r"tool_block\..*"),
        lambda: task("pushing", "bullet", after=hysteresis),
    ),
    Sabotage(
        "damping acts one step later, too",
        "time",
        "pushing, mujoco",
        ("joint_damping", "joint_.*"),
        lambda: task("pushing", after=remembered),
    ),
    Sabotage(
        "actuator noise is keyed by a color",
        "time",
        "pushing, mujoco",
        (COLOR, "joint_.*"),
        lambda: with_commands(task("pushing"), colored),
    ),
    Sabotage(
        "noise is keyed by another state",
        "time",
        "tanks, step",
        ("dirt", "upper"),
        lambda: with_commands(tanks(), keyed_by_state),
    ),
    Sabotage(
        "two tanks have one noise",
        "time",
        "tanks, step",
        (r"rain|drops|.*\[.*",),
        lambda: with_commands(tanks(), one_stream),
        visible=False,
        why=SHARED,
    ),
    Sabotage(
        "two variables are drawn from one stream",
        "time",
        "equations",
        ("a", "b"),
        shared_equations,
        visible=False,
        why=SHARED,
    ),
    Sabotage(
        "noise does not come back",
        "time",
        "tanks, step",
        ("upper",),
        lambda: with_commands(tanks(), unsaved),
    ),
    Sabotage(
        "one of two colors is bright, not both",
        "time",
        "pushing, mujoco",
        (rf"{COLOR}|stage_color", r"tool_block\..*"),
        lambda: task("pushing", after=kick(34, xor)),
    ),
    Sabotage(
        "two colors act together only",
        "time",
        "pushing, bullet",
        (r"floor_color|goal_block\.color", r"tool_block\..*"),
        lambda: task("pushing", "bullet", after=kick(34, both)),
    ),
    replace(
        tank(
            "label and paint act together only",
            ("label|paint", "lower"),
            lower=lambda new, p, s, a, n: new + 0.1 * (p["label"] > 1.2) * (p["paint"] > 1.2),
        ),
        kind="time",
    ),
    Sabotage(
        "a color acts beyond a threshold",
        "time",
        "pushing, bullet",
        (COLOR, "joint_.*"),
        lambda: task("pushing", "bullet", after=kick(9, lambda e: 0.01 * float(color(e) > 0.9))),
    ),
    Sabotage(
        "a color acts in a tenth of its range",
        "time",
        "pushing, mujoco",
        (COLOR, ".*"),
        lambda: task("pushing", after=kick(34, lambda e: 0.01 * (0.2 < color(e) < 0.3))),
    ),
    Sabotage(
        "a color acts after five steps",
        "time",
        "pushing, mujoco",
        (COLOR, ".*"),
        lambda: task("pushing", after=counted(5)),
    ),
    Sabotage(
        "a color acts after 300 steps",
        "time",
        "pushing, mujoco",
        (COLOR, ".*"),
        lambda: task("pushing", after=counted(300)),
        visible=False,
        why="probe states lie at most 60 control steps after the beginning",
    ),
    Sabotage(
        "a color acts in a thousandth of its range",
        "time",
        "pushing, mujoco",
        (COLOR, ".*"),
        lambda: task("pushing", after=kick(34, lambda e: 0.01 * (0.2 < color(e) < 0.201))),
        visible=False,
        why="about 120 values of a color are tried in 40 states",
    ),
    Sabotage(
        "an effect below rounding",
        "time",
        "pushing, mujoco",
        (COLOR, ".*"),
        lambda: task("pushing", after=kick(34, lambda e: 1e-14 * color(e))),
        visible=False,
        why="differences up to 1e-12 count as rounding",
    ),
)


def complaints(report: Verification, honest: Verification | None = None) -> Iterable[set[str]]:
    """Give the variables that each complaint of a report names.

    Args:
        report: Of a sabotaged system.
        honest: Of the same one without sabotage: edges that only it has seen are named, too.
    """
    for edge in report.undeclared:
        yield {*edge.cause.split(" & "), edge.effect}
    if honest is not None:
        seen = {edge.key for edge in honest.fired}
        yield from ({cause, effect} for cause, effect, _ in seen.intersection(report.never_fired))
    yield from ({name} for name in report.unstable)


def caught(
    report: Verification, names: tuple[str, ...], honest: Verification | None = None
) -> bool:
    """Tell whether a report does not confirm the graph, and names what was sabotaged."""

    def matches(variables: set[str]) -> bool:
        return all(any(re.fullmatch(n, v) for v in variables) for n in names)

    return report.outcome != "confirmed" and any(map(matches, complaints(report, honest)))


def verified(
    make: Callable[[], Any], seed: int, probes: int = PROBES, held_out: int = HELD_OUT
) -> Verification:
    """Verify a system with the budget of the study."""
    system = make()
    return verify(system, seed=seed, probes=probes, held_out=held_out)


@cache
def verified_honestly(system: str, seed: int) -> Verification:
    """Verify a system without sabotage with the budget of the study."""
    return verified(HONEST[system], seed)


def tried(one: Sabotage, seed: int) -> tuple[Verification, Verification | None, bool]:
    """Verify a sabotaged system: with few states, and with all if that does not suffice."""
    report = verified(one.make, seed, *FIRST)
    if caught(report, one.names):
        return report, None, True
    report, honest = verified(one.make, seed), verified_honestly(one.system, seed)
    return report, honest, caught(report, one.names, honest)


def main() -> None:
    """Run the study; what was measured before and is not measured again stays in the file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--honest-seeds", type=int, default=3, help="of systems without sabotage")
    parser.add_argument("--only", default="", help="regular expression: class, name and system")
    parser.add_argument("--out", type=Path, default=HERE / "sabotage.json")
    given = parser.parse_args()

    def write(kind: str, row: dict[str, Any], *keys: str) -> None:
        told = {"probes": PROBES, "held_out": HELD_OUT, "honest": [], "sabotages": []}
        known = json.loads(given.out.read_text()) if given.out.exists() else told
        rows = {tuple(old[key] for key in keys): old for old in known[kind]}
        rows[tuple(row[key] for key in keys)] = row
        known[kind] = list(rows.values())
        given.out.write_text(as_json(known) + "\n")
        print(row, flush=True)

    for system in HONEST:
        for seed in range(given.seed, given.seed + given.honest_seeds):
            if re.search(given.only, f"honest: {system}"):
                report = verified_honestly(system, seed)
                said = [sorted(names) for names in complaints(report)]
                row = {"system": system, "seed": seed, "outcome": report.outcome}
                row |= {"unseen": len(report.unseen), "complaints": said}
                write("honest", {**row, "seconds": round(report.seconds, 1)}, "system", "seed")
    for one in SABOTAGES:
        if re.search(given.only, f"{one.kind}: {one.name}, {one.system}"):
            report, honest, is_caught = tried(one, given.seed)
            about = {k: v for k, v in asdict(one).items() if k not in ("make", "names")}
            row = {**about, "seed": given.seed, "caught": is_caught}
            row |= {"outcome": report.outcome, "probes": report.probes + report.held_out}
            said = [sorted(names) for names in complaints(report, honest)]
            row |= {"complaints": said[:3], "seconds": round(report.seconds, 1)}
            write("sabotages", row, "name", "seed")


if __name__ == "__main__":
    main()
