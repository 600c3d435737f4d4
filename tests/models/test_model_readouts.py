"""What follows from states at once: poses, velocities and sensors."""

from __future__ import annotations

import copy
import math
import pickle
import re
import threading
from typing import Any

import mujoco
import numpy as np
import pytest
from model_files import GYMNASIUM, PENDULUM, SUITE, model_file

from scm_world.backends import read_model
from scm_world.backends.mujoco.fields import element_names
from scm_world.backends.mujoco.reading import compiled
from scm_world.errors import ModelError
from scm_world.models import Model, Readout
from scm_world.queries import World

POSES = ("position", "orientation", "linear_velocity", "angular_velocity")


def only(model: Model) -> Readout:
    """Give the readout of a model that has one."""
    (readout,) = model.readouts
    return readout


def test_the_tip_of_a_pendulum_follows_the_formula() -> None:
    """Its place, orientation and velocity are functions of the angle and its speed alone."""
    wanted = [f"tip.{attribute}" for attribute in POSES]
    place, turn, speed, spin = read_model(PENDULUM, readouts=wanted).readouts
    angle, rate = 0.4, 1.5
    assert place.parents == turn.parents == ("hinge.position",)
    assert speed.parents == spin.parents == ("hinge.position", "hinge.velocity")
    assert [readout.unit for readout in (place, turn, speed, spin)] == ["m", "1", "m/s", "rad/s"]
    x, z = -0.5 * math.sin(angle), -0.5 * math.cos(angle)
    np.testing.assert_allclose(place.function(angle), [x, 0.0, 1.0 + z], atol=1e-15)
    half = [0.0, math.sin(angle / 2), 0.0, math.cos(angle / 2)]
    np.testing.assert_allclose(turn.function(angle), half, atol=1e-15)
    np.testing.assert_allclose(speed.function(angle, rate), [rate * z, 0.0, -rate * x], atol=1e-15)
    np.testing.assert_allclose(spin.function(angle, rate), [0.0, rate, 0.0], atol=1e-15)


@pytest.mark.parametrize("name", [f"{SUITE}fish.xml", f"{SUITE}finger.xml", f"{GYMNASIUM}ant.xml"])
def test_readouts_are_what_the_engine_computes(name: str) -> None:
    """In random states they equal the numbers of ``mj_forward``, also after pickling."""
    names = element_names(mujoco.MjModel.from_xml_path(str(model_file(name))))
    wanted = [f"{kind}:{names[kind][-1]}.{a}" for kind in ("body", "geom") for a in POSES]
    sensors = [s for s in names["sensor"] if "touch" not in s]
    model = read_model(model_file(name), readouts=[*wanted, *(f"{s}.value" for s in sensors)])
    model = pickle.loads(pickle.dumps(model))  # noqa: S301 # our own
    mj = compiled(model)
    data, rng = mujoco.MjData(mj), np.random.default_rng(0)
    mujoco.mj_integratePos(mj, data.qpos, rng.normal(size=mj.nv), 0.1)
    data.qvel[:] = rng.normal(size=mj.nv)
    mujoco.mj_forward(mj, data)
    vector = np.empty(model.layout.size)
    vector[model.places("qpos")[1]], vector[model.places("qvel")[1]] = data.qpos, data.qvel
    given: dict[str, Any] = {
        row.name: np.array(row.default).reshape(row.shape) for row in model.parameters
    }
    for row in model.states:
        given[row.name] = vector[model.layout.slices[row.name]].reshape(row.shape)
    for readout in model.readouts:
        found = readout.function(*(given[parent] for parent in readout.parents))
        element, _, attribute = readout.name.rpartition(":")[2].rpartition(".")
        assert np.shape(found) == readout.shape
        if attribute == "value":
            expected = data.sensor(element).data.reshape(readout.shape)
        elif attribute == "position":
            kind = readout.name.partition(":")[0]
            index = names[kind].index(element)
            expected = {"body": data.xpos, "geom": data.geom_xpos}[kind][index]
        else:
            continue
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-14)


def test_velocities_of_a_body_that_is_given_in_the_world() -> None:
    """The angular velocity of its frame is its state, and moves its shapes as a rigid body does."""
    text = """<mujoco><worldbody><body name="cube"><freejoint/><geom size="0.1"/>
    <site name="corner" pos="0.1 0.2 0.3"/></body></worldbody></mujoco>"""
    names = [f"corner.{attribute}" for attribute in ("position", *POSES[2:])]
    model = read_model(text, readouts=names, frame="world")
    spin = np.array([0.3, -0.7, 1.1])
    values: dict[str, Any] = {
        "cube.cartesian_position": np.zeros(3),
        "cube.orientation": np.array([0.5, 0.1, -0.4, 0.7]) / np.sqrt(0.91),
        "cube.linear_velocity": np.zeros(3),
        "cube.angular_velocity": spin,
    }
    place, speed, turning = (
        readout.function(*(values[parent] for parent in readout.parents))
        for readout in model.readouts
    )
    np.testing.assert_allclose(turning, spin, atol=1e-15)
    np.testing.assert_allclose(speed, np.cross(spin, place), atol=1e-15)


def test_a_readout_is_a_function() -> None:
    """The same values give the same bits, in any order of calls and in any thread."""
    place = only(read_model(PENDULUM, readouts=["tip.position"])).function
    first = place(0.4)
    place(1.0)
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(place(0.4)))
    thread.start()
    thread.join()
    assert np.array_equal(first, place(0.4))
    assert np.array_equal(first, found[0])


def test_parameters_that_move_things_are_parents() -> None:
    """An axis, or a place in a parent, that is exposed decides where the tip is."""
    text = PENDULUM.replace('<body name="pole"', '<body name="pole" simple="false"')
    exposed = ["hinge.axis", "hinge.anchor", "hinge.damping", "*.position"]
    model = read_model(text, readouts=["site:tip.position"], expose=exposed)
    assert set(only(model).parents) == {
        "hinge.position",
        "hinge.axis",
        "hinge.anchor",
        "pole.position",
        "tip.position",
    }
    assert model.parameters[-1].name == "tip.position"


def test_the_parameters_of_a_readout_count() -> None:
    """Moving the body moves its site by as much; undoing it gives the same bits as before."""
    model = read_model(PENDULUM, readouts=["site:tip.position"], expose=["pole.position"])
    place = only(model).function
    before = place(0.4, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(place(0.4, np.array([0.0, 2.0, 1.0])) - before, [0.0, 2.0, 0.0])
    assert np.array_equal(place(0.4, np.array([0.0, 0.0, 1.0])), before)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tpi.position", "no site, body or shape is called 'tpi'; did you mean 'tip'?"),
        ("tip.place", "'place' is nothing that can be computed; there are: position, orientation"),
        ("hinge.position", "it is a variable already"),
        ("touch.value", "it measures forces or accelerations"),
        ("angel.value", "no sensor is called 'angel'; did you mean 'angle'?"),
    ],
)
def test_what_cannot_be_computed_is_an_error(name: str, message: str) -> None:
    """The error says why, or what is nearest."""
    with pytest.raises(ModelError, match=re.escape(message)):
        read_model(PENDULUM, readouts=["tip.position", name])


def test_a_name_of_several_elements_needs_their_kind() -> None:
    """The error lists them; with the kind it is one of them."""
    text = (
        "<mujoco><worldbody><body name='hand' pos='0 0 1'><joint name='wrist'/><geom name='hand' "
        "size='.1' pos='0 0 .2'/><site name='hand' pos='0 0 .3'/></body></worldbody></mujoco>"
    )
    choices = "'site:hand.position' or 'body:hand.position' or 'geom:hand.position'"
    with pytest.raises(ModelError, match=f"write {choices}"):
        read_model(text, readouts=["hand.position"])
    heights = {"body": 1.0, "geom": 1.2, "site": 1.3}
    for kind, height in heights.items():
        place = only(read_model(text, readouts=[f"{kind}:hand.position"]))
        assert place.function(0.0)[2] == pytest.approx(height)


def test_a_sensor_of_a_joint_follows_from_that_joint() -> None:
    """Nothing else is its parent."""
    readout = only(read_model(PENDULUM, readouts=["angle.value"]))
    assert (readout.parents, readout.unit, readout.shape) == (("hinge.position",), "rad", ())
    assert readout.function(0.3) == 0.3


def test_readouts_leave_the_compiled_model_alone() -> None:
    """They compute on a copy."""
    model = read_model(PENDULUM, readouts=["tip.position"], expose=["pole.position"])
    mj = compiled(model)
    before = copy.copy(mj)
    only(model).function(0.1, np.array([1.0, 1.0, 1.0]))
    assert np.array_equal(mj.body_pos, before.body_pos)


# --- sensors -----------------------------------------------------------------------------------

SENSED = """
<worldbody>
  <camera name="cam" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <site name="room" type="box" size=".5 .5 .5" pos="0 0 1"/>
  <body name="b" pos="0 0 .8">
    <freejoint/><geom name="gb" type="box" size=".1 .15 .2"/><camera name="eye" pos="0 0 .2"/>
    <site name="s" pos=".1 .2 .1" euler="10 20 30"/>
  </body>
  <body name="arm" pos="1 0 1">
    <joint name="activation" axis="0 1 0" range="-20 20" limited="true" margin=".2"/>
    <geom name="ga" type="capsule" size=".03" mass=".5" fromto="0 0 0 0 0 .4"/>
    <body name="fore" pos="0 0 .5">
      <joint name="ball" type="ball" range="0 30" limited="true"/>
      <geom name="gf" size=".06 .1" type="capsule"/><site name="f" pos="0 .1 .2"/>
    </body>
  </body>
  <body name="car" pos="-1 0 1">
    <joint name="slide" type="slide" axis="1 0 0"/><geom size=".05"/><site name="c"/>
  </body>
</worldbody>
<tendon>
  <spatial name="t" limited="true" range="0 1.2"><site site="s"/><site site="c"/></spatial>
</tendon>
<actuator>
  <position name="m" joint="activation" kp="20" ctrlrange="-1 1"/>
  <general name="n" tendon="t" dyntype="filter" dynprm=".1" ctrlrange="-1 1"/>
</actuator>
"""
SENSORS = {
    "velocimeter": 'site="s"',
    "gyro": 'site="s"',
    "magnetometer": 'site="s"',
    "rangefinder": 'site="s"',
    "camprojection": 'site="s" camera="cam"',
    "jointpos": 'joint="activation"',
    "jointvel": 'joint="activation"',
    "tendonpos": 'tendon="t"',
    "tendonvel": 'tendon="t"',
    "actuatorpos": 'actuator="n"',
    "actuatorvel": 'actuator="n"',
    "ballquat": 'joint="ball"',
    "ballangvel": 'joint="ball"',
    "jointlimitpos": 'joint="activation"',
    "jointlimitvel": 'joint="activation"',
    "tendonlimitpos": 'tendon="t"',
    "tendonlimitvel": 'tendon="t"',
    "framepos": 'objtype="site" objname="f"',
    "framequat": 'objtype="geom" objname="gf"',
    "framexaxis": 'objtype="body" objname="fore"',
    "frameyaxis": 'objtype="xbody" objname="fore"',
    "framezaxis": 'objtype="camera" objname="eye"',
    "framelinvel": 'objtype="site" objname="f" reftype="body" refname="b"',
    "frameangvel": 'objtype="body" objname="fore" reftype="site" refname="s"',
    "subtreecom": 'body="arm"',
    "subtreelinvel": 'body="b"',
    "subtreeangmom": 'body="arm"',
    "insidesite": 'objtype="body" objname="b" site="room"',
    "distance": 'geom1="gb" geom2="gf" cutoff="9"',
    "normal": 'geom1="gb" geom2="gf" cutoff="9"',
    "fromto": 'geom1="gb" geom2="gf" cutoff="9"',
    "e_potential": "",
    "e_kinetic": "",
}
"""All that are functions of state and parameters."""
REFUSED = {
    "touch": 'site="s"',
    "accelerometer": 'site="s"',
    "force": 'site="s"',
    "torque": 'site="s"',
    "actuatorfrc": 'actuator="m"',
    "jointactuatorfrc": 'joint="activation"',
    "tendonactuatorfrc": 'tendon="t"',
    "jointlimitfrc": 'joint="activation"',
    "tendonlimitfrc": 'tendon="t"',
    "framelinacc": 'objtype="site" objname="s"',
    "frameangacc": 'objtype="site" objname="s"',
    "contact": 'body1="b" data="force"',
    "clock": "",
    "user": 'dim="2" needstage="pos"',
}
"""All others, but for tactile sensors and those of plugins."""


def sensed(*kinds: str) -> str:
    """Write a model with sensors of some kinds, each named as its kind."""
    lines = "".join(f'<{kind} name="{kind}" {(SENSORS | REFUSED)[kind]}/>' for kind in kinds)
    return f"<mujoco>{SENSED}<sensor>{lines}</sensor></mujoco>"


def test_every_type_of_sensor_is_tried_or_refused() -> None:
    """MuJoCo has no other types than those that are tried here, but two that need more files."""
    mj = mujoco.MjModel.from_xml_string(sensed(*SENSORS, *REFUSED))
    missing = set(range(len(mujoco.mjtSensor.__members__))) - set(mj.sensor_type.tolist())
    assert missing == {int(mujoco.mjtSensor.mjSENS_TACTILE), int(mujoco.mjtSensor.mjSENS_PLUGIN)}
    for kind in REFUSED:
        with pytest.raises(ModelError, match=f"readouts='{kind}.value': (it|what it) "):
            read_model(sensed(kind), readouts=[f"{kind}.value"])


@pytest.mark.parametrize("kinds", [*((kind,) for kind in SENSORS), tuple(SENSORS)], ids="+".join)
def test_a_sensor_has_the_value_that_mj_forward_gives_it(kinds: tuple[str, ...]) -> None:
    """Also after positions, velocities, parameters and time changed in any order."""
    world = World(sensed(*kinds), outcomes=[f"{kind}.value" for kind in kinds])
    world.reset(seed=0)
    mj, rng = copy.copy(compiled(world.task.system)), np.random.default_rng(3)
    system, layout = world.task.system, world.task.system.layout
    qpos, qvel, act = (system.places(array)[1] for array in ("qpos", "qvel", "act"))
    seen = set()
    for _ in range(48):
        turn = rng.normal(size=4)
        changes: list[Any] = [
            {"activation.position": rng.uniform(-0.34, 0.34)},
            {"slide.position": rng.uniform(-1.0, 1.0)},
            {"b.cartesian_position": rng.uniform([-0.7, -0.7, 0.3], [0.7, 0.7, 1.7])},
            {f"{rng.choice(['b', 'ball'])}.orientation": turn / np.linalg.norm(turn)},
            {f"{rng.choice(['activation', 'slide'])}.velocity": rng.normal()},
            {f"b.{rng.choice(['linear', 'angular'])}_velocity": rng.normal(size=3)},
            {"ball.angular_velocity": rng.normal(size=3)},
            {"fore.mass": rng.uniform(0.1, 2.0)},
            None,
        ]
        change = changes[int(rng.integers(len(changes)))]
        if change is None:
            world.step(rng.uniform(-1.0, 1.0, size=2))
        else:
            world.do(change)
        mj.body("fore").mass[0] = world["fore.mass"]
        mujoco.mj_setConst(mj, mujoco.MjData(mj))
        vector = np.concatenate([np.atleast_1d(world[name]) for name in layout.names])
        data = mujoco.MjData(mj)
        data.qpos[:], data.qvel[:] = vector[qpos], vector[qvel]
        data.act[:] = vector[act]
        mujoco.mj_forward(mj, data)
        for kind in rng.permutation(kinds):
            found = world[f"{kind}.value"]
            expected = data.sensor(str(kind)).data.reshape(found.shape)
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12, err_msg=str(kind))
            seen.add((str(kind), found.tobytes()))
    assert len(seen) >= 2 * len(kinds)
