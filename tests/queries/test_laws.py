"""Laws of parameters: they hold on every engine, and what breaks one is seen."""

import importlib.util

import numpy as np
import pytest

from scm_world.backends import make_backend
from scm_world.backends.base import BackendWrapper
from scm_world.models import Difference
from scm_world.queries.laws import check_laws
from scm_world.tasks.model import ModelTask
from scm_world.world import Simulation

ENGINES = [
    name
    for name in ("mujoco", "bullet")
    if importlib.util.find_spec(name.replace("bullet", "pybullet"))
]
ARM = """
<mujoco model="arm">
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1" friction="0.6"/>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="1 0 0" damping="0.05"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25"/>
      </body>
    </body>
    <body name="box" pos="1 0 0.1">
      <freejoint/>
      <geom name="crate" type="box" size="0.1 0.12 0.1" friction="0.5"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder" ctrlrange="-2 2"/>
    <position name="servo" joint="elbow" kp="5" kv="0.2"/>
  </actuator>
</mujoco>
"""


class Twisted(BackendWrapper):
    """Writes other values of parameters to an engine than it was given, and reports those given."""

    name = "twisted"

    def __init__(self, engine, twist):
        super().__init__(engine)
        self.twist, self.given = twist, {}

    def written(self, parameters):
        """Twist parameters, and keep what was given."""
        self.given.update(parameters)
        return {key: self.twist(key, value, self.given) for key, value in parameters.items()}

    def build(self, scene):
        """Build another scene."""
        super().build(scene.with_(parameters=self.written(scene.parameters)))

    def apply(self, difference):
        """Apply another difference."""
        parameters = self.written(difference.parameters)
        super().apply(Difference(difference.structure, parameters, difference.state))

    def parameters(self, keys):
        """Report what was given."""
        return {key: np.array(self.given[key]) for key in keys}

    def supports(self, structure, key):
        """Ask the engine."""
        return self.engine.supports(structure, key)


def world(system, engine, twist=None):
    """Make a world, of an honest engine or a twisted one."""
    backend = make_backend(engine)
    task = ModelTask(ARM) if system == "arm" else system
    return Simulation(task, backend=backend if twist is None else Twisted(backend, twist))


def broken(system, engine, twist):
    """Name the variables whose laws a twist breaks."""
    return {law.variable for law in check_laws(world(system, engine, twist)) if law.passed is False}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("system", ["pushing", "arm"])
def test_laws_hold_and_leave_no_trace(system: str, engine: str) -> None:
    """An honest engine passes, and steps afterwards as if nothing had been measured."""
    one, other = world(system, engine), world(system, engine)
    rest = np.zeros(one.compiled.n_actions)
    for each in (one, other):
        each.reset(seed=3)
        each.step(rest)
    laws = check_laws(one)
    assert not [str(law) for law in laws if law.passed is False]
    assert sum(law.passed is True for law in laws) >= 10
    for _ in range(3):
        one.step(rest)
        other.step(rest)
        np.testing.assert_array_equal(one.vector, other.vector)
    assert all(law.reason for law in laws if law.passed is None)


CRATE = 'name="crate" type="box" size="0.1 0.12 0.1"'
ODD = {
    "lighter": ('<body name="box"', '<body name="box" gravcomp="0.5"'),
    "airy": ("<worldbody>", '<option density="1.2" viscosity="2"/><worldbody>'),
    "soft": (CRATE, f'{CRATE} solref="0.2 0.5" solimp="0.5 0.6 0.05"'),
    "wide": (CRATE, f'{CRATE} margin="0.02"'),
    "first": (CRATE, f'{CRATE} priority="1"'),
    "bouncing": (CRATE, f'{CRATE} solref="-1000 -2"'),
    "slippery": (CRATE, f'{CRATE} condim="1"'),
}


@pytest.mark.parametrize("what", ODD)
def test_contacts_of_their_own_break_no_law(what: str) -> None:
    """What has other contacts than an engine's usual ones, or floats, has no law of contact."""
    pytest.importorskip("mujoco")
    odd = Simulation(ModelTask(ARM.replace(*ODD[what])), backend="mujoco")
    laws = check_laws(odd)
    assert not [str(law) for law in laws if law.passed is False]
    assert "sliding" not in {law.law for law in laws}


HARD = {
    "clutter": '<worldbody><geom type="box" pos="5 5 .5" size="1 1 1"/></worldbody>',
    "coarse": '<option timestep="0.02"/>',
    "heavy": '<option gravity="0 0 -80"/>',
}
BOX = """
<worldbody>
  <geom type="plane" size="9 9 1"/>
  <body pos="0 0 1"><freejoint/><geom type="box" size=".1 .15 .2" mass="1"/></body>
</worldbody>
"""


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("what", HARD)
def test_an_honest_engine_keeps_laws_where_they_are_hard_to_measure(what: str, engine: str) -> None:
    """Something stands where bodies are laid; sliding lasts a few long steps; gravity is strong."""
    model = f"<mujoco>{BOX}{HARD[what]}</mujoco>"
    laws = check_laws(Simulation(ModelTask(model), backend=engine))
    assert not [str(law) for law in laws if law.passed is False]
    assert "lying" in {law.law for law in laws}


def scaled(element, attribute, factor):
    """Multiply one parameter."""
    return lambda key, value, _: (
        value * np.asarray(factor) if key == (element, attribute) else value
    )


def inverted(element):
    """Take one mass for its inverse."""
    return lambda key, value, _: 1.0 / value if key == (element, "mass") else value


def kept(attribute, value):
    """Give parameters of one kind always the same value."""
    return lambda key, given, _: value + 0.0 * given if key[1] == attribute else given


LINK = "robot_finger_60_link_{}"
TWISTS = {
    "heavy": ("pushing", "tool_block.mass", scaled("tool_block", "mass", 10.0)),
    "inverse": ("pushing", "tool_block.mass", inverted("tool_block")),
    "up": ("pushing", "gravity", scaled("world", "gravity", -1.0)),
    "weak": ("pushing", "position_gains", scaled("controller", "position_gains", 0.5)),
    "undamped": ("pushing", "safety_damping", kept("safety_damping", 0.0)),
    "loose": ("pushing", "equations of motion", kept("joint_damping", 0.2)),
    "heavy box": ("arm", "box.mass", scaled("box", "mass", 10.0)),
    "light box": ("arm", "box.mass", inverted("box")),
    "round box": ("arm", "box.inertia", scaled("box", "inertia", 2.0)),
    "heavy link": ("arm", "lower.inertia", scaled("lower", "inertia", 3.0)),
    "up arm": ("arm", "gravity", scaled("", "gravity", -1.0)),
    "undamped arm": ("arm", "shoulder.damping", kept("damping", 0.0)),
    "weak motor": ("arm", "motor.gear", scaled("motor", "gear", 0.5)),
    "weak servo": ("arm", "servo.kp", scaled("servo", "kp", 0.5)),
    "slippery floor": ("pushing", "floor_friction", scaled("floor", "friction", 0.5)),
    "rough floor": ("pushing", "floor_friction", scaled("floor", "friction", 1.5)),
    "rough block": ("pushing", "tool_block.friction", scaled("tool_block", "friction", 2.0)),
    "ice": ("pushing", "floor_friction", kept("friction", 0.01)),
    "rough crate": ("arm", "crate.friction", scaled("crate", "friction", 2.0)),
    "slippery ground": ("arm", "ground.friction", scaled("ground", "friction", 0.5)),
    "rubber": ("pushing", "restitution", scaled("world", "restitution", 2.0)),
    "clay": ("pushing", "restitution", kept("restitution", 0.0)),
    "large block": ("pushing", "tool_block.size", scaled("tool_block", "size", 1.2)),
    "flat crate": ("arm", "crate.size", scaled("crate", "size", [1.0, 1.0, 0.8])),
}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("twist", TWISTS)
def test_a_wrong_value_breaks_its_law(twist: str, engine: str) -> None:
    """What is written to the engine is not what was declared, though the engine says it is."""
    system, variable, change = TWISTS[twist]
    assert variable in broken(system, engine, change)


@pytest.mark.parametrize("engine", ENGINES)
def test_permuted_masses_break_laws(engine: str) -> None:
    """Two links of a finger, and two fingers, with each other's mass are seen."""

    def swapped(*links):
        def twist(key, value, given):
            other = dict(zip(links, reversed(links), strict=True)).get(key[0])
            return given.get((other, "mass"), value) if key[1] == "mass" and other else value

        return twist

    middle, upper = LINK.format(2), LINK.format(1)
    assert broken("pushing", engine, swapped(upper, middle)) & {
        f"{upper}.mass", f"{middle}.mass"
    }  # fmt: skip
    assert broken("pushing", engine, swapped(middle, "robot_finger_120_link_2"))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("system", "body"), [("pushing", "tool_block"), ("arm", "lower")])
def test_restoring_takes_back_a_push(system: str, body: str, engine: str) -> None:
    """A push that was not stepped does not act after a snapshot from before it is restored."""
    one, other = world(system, engine), world(system, engine)
    rest = np.zeros(one.compiled.n_actions)
    for each in (one, other):
        each.reset(seed=1)
        each.step(rest)
    before = one.snapshot()
    one.backend.push(body, np.array([5.0, 3.0, 2.0]), np.array([0.1, 0.2, 0.3]))
    one.restore(before)
    for each in (one, other):
        each.step(rest)
    np.testing.assert_array_equal(one.vector, other.vector)
