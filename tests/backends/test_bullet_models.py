"""Models on Bullet, against formulas and MuJoCo; and that nothing leaves a trace."""

from __future__ import annotations

import copy
import importlib.util
import math
import pickle
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from robot_scenes import busy_scene
from robot_scenes import play as play_robot

from scm_world import World
from scm_world.backends import Backend, make_backend, read_model
from scm_world.backends.bullet import BulletBackend
from scm_world.backends.bullet.client import shares, usual_friction
from scm_world.backends.bullet.honoured import supports, unsupported
from scm_world.backends.mujoco.fields import element_names
from scm_world.backends.mujoco.reading import compiled
from scm_world.backends.mujoco.trees import Couplings
from scm_world.errors import EngineFailure, ModelError, NotIntervenable, UnknownOption
from scm_world.models import Difference, Model, Parameter
from scm_world.tasks.trifinger.system import trifinger

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)

Floats = NDArray[np.float64]
ENGINES = ("mujoco", "bullet")

FILES = {
    "inverted_pendulum": ("gymnasium", "envs/mujoco/assets/inverted_pendulum.xml"),
    "inverted_double_pendulum": ("gymnasium", "envs/mujoco/assets/inverted_double_pendulum.xml"),
    "half_cheetah": ("gymnasium", "envs/mujoco/assets/half_cheetah.xml"),
    "cartpole": ("pybullet_data", "cartpole.urdf"),
    "kuka": ("pybullet_data", "kuka_iiwa/model.urdf"),
    "panda": ("pybullet_data", "franka_panda/panda.urdf"),
    "humanoid": ("pybullet_data", "humanoid/humanoid.urdf"),
}

PILE = """
<mujoco model="pile">
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" friction="0.8"/>
    <body name="box" pos="0 0 0.1">
      <freejoint/>
      <geom name="cube" type="box" size="0.1 0.08 0.06" mass="1" friction="0.5"/>
    </body>
    <body name="ball" pos="0.02 0 0.3">
      <freejoint/>
      <geom name="sphere" type="sphere" size="0.1" mass="0.5"/>
    </body>
    <body name="tool" pos="3 0.03 0.2" euler="20 30 0">
      <freejoint/>
      <geom name="handle" type="capsule" size="0.06 0.1" mass="0.7"/>
      <geom name="head" type="box" pos="0 0.1 0" size="0.05 0.05 0.05" mass="0.2"/>
    </body>
    <body name="upper" pos="-3 0 0.3">
      <joint name="shoulder" axis="0 1 0" damping="0.1" stiffness="1" frictionloss="0.05"
             range="-2 2" limited="true" actuatorfrclimited="true" actuatorfrcrange="-3 3"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="0.4"/>
      <body name="fore" pos="0.4 0 0">
        <joint name="elbow" type="ball" damping="0.05"/>
        <geom name="fore" type="cylinder" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="shoulder" kp="20" kv="1" ctrlrange="-1 1" ctrllimited="true"/>
    <motor name="twist" joint="elbow" gear="0.1 0.2 0.3"/>
  </actuator>
</mujoco>
"""

CHAIN = """
<mujoco model="chain">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="trunk" pos="0 0 1" euler="10 20 30">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.05" mass="2"/>
      <body name="left" pos="0.1 0.2 0">
        <joint name="left_1" axis="1 0 0" pos="0 -0.05 0" damping="0.3" ref="20"/>
        <joint name="left_2" axis="0 1 1" pos="0.02 0 0" stiffness="2" springref="30"/>
        <joint name="left_3" type="slide" axis="0 0 1" damping="3"/>
        <geom type="capsule" fromto="0 0 0 0.1 0.2 0.3" size="0.03"/>
        <body name="knob" pos="0.1 0.2 0.3">
          <joint name="knob_1" type="ball" pos="0 0.01 0"/>
          <joint name="knob_2" type="slide" axis="0 0 1"/>
          <geom type="box" size="0.05 0.04 0.03" pos="0.02 0.01 0" euler="10 20 30"/>
          <body name="end" pos="0.1 0 0"><geom size="0.03"/></body>
        </body>
      </body>
      <body name="right" pos="0.1 -0.2 0">
        <joint name="right" type="ball" pos="0 0.05 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0.1 -0.2 0.3" size="0.03"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="left_1" gear="3"/>
    <position joint="left_2" kp="5" kv="0.4" forcerange="-4 4"/>
    <velocity joint="left_3" kv="6" gear="2"/>
    <damper joint="left_1" kv="2" ctrlrange="0 1"/>
    <motor joint="right" gear="0.1 -0.2 0.3"/>
  </actuator>
</mujoco>
"""

SMOOTH = """
<mujoco model="smooth">
  <option timestep="0.002" integrator="implicitfast" density="1000" viscosity="0.5" wind="1 2 3"/>
  <worldbody>
    <body name="trunk" pos="0 0 1" euler="10 20 30" gravcomp="0.4">
      <freejoint/>
      <geom type="box" size="0.1 0.2 0.05" mass="2"/>
      <site name="thruster" pos="0.1 0.2 0" euler="20 10 0"/>
      <body name="arm" pos="0.1 0.2 0" gravcomp="1">
        <joint name="first" axis="1 0 0" stiffness="2" range="-2 2" limited="true"/>
        <geom name="arm" type="capsule" fromto="0 0 0 0.1 0.2 0.3" size="0.03"/>
        <site name="end" pos="0.1 0.2 0.3"/>
        <body name="hand" pos="0.1 0.2 0.3">
          <joint name="second" type="ball" stiffness="0.5" damping="0.1"/>
          <geom type="box" size="0.05 0.04 0.03" pos="0.02 0.01 0" euler="10 20 30"/>
        </body>
      </body>
    </body>
    <body name="drop" pos="1 1 1">
      <joint name="drop" type="free" damping="0.3"/>
      <geom type="box" size="0.1 0.2 0.3" mass="3"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="string" stiffness="3" damping="0.2"><joint joint="first" coef="2"/></fixed>
    <spatial name="rope" stiffness="4"><site site="thruster"/><site site="end"/></spatial>
  </tendon>
  <actuator>
    <motor name="thrust" site="thruster" gear="1 2 3 0.1 0.2 0.3"/>
    <motor name="pull" tendon="string"/>
    <muscle name="muscle" joint="first" lengthrange="-2 2"/>
    <general name="lag" joint="first" dyntype="filter" dynprm="0.1"/>
  </actuator>
</mujoco>
"""


@cache
def described(name: str) -> Model:
    """Read one of our texts, or a file of another package."""
    texts = {"pile": PILE, "chain": CHAIN, "smooth": SMOOTH}
    if name in texts:
        return everything(texts[name])
    package, path = FILES[name]
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        pytest.skip(f"needs {package}")
    return everything(str(Path(found.origin).parent / path))


def everything(source: str) -> Model:
    """Expose all that can be set."""
    usual = read_model(source)
    hidden = [name for name, reason in usual.refused.items() if reason.startswith("is not exposed")]
    return read_model(source, expose=[*(row.name for row in usual.parameters), *hidden])


@pytest.fixture
def backend() -> Iterator[BulletBackend]:
    """Provide a backend without a scene."""
    backend = BulletBackend()
    yield backend
    backend.close()


def play(backend: Backend, steps: int, *, seed: int = 0, substeps: int = 3) -> Floats:
    """Give random commands; return the states, one to a row."""
    generator, rows = np.random.default_rng(seed), []
    for _ in range(steps):
        command = generator.uniform(-1.0, 1.0, backend.structure.n_commands)
        backend.step(command, substeps)
        rows.append(backend.read().vector)
    return np.array(rows)


def other_value(row: Parameter, value: Floats) -> Floats:
    """Give another value that a parameter may have."""
    if row.kind == "rotation" or row.key[1] == "axis":
        turned = value + np.linspace(0.05, 0.1, value.size)
        return np.asarray(turned / np.linalg.norm(turned))
    if row.key[1] in ("range", "ctrlrange", "forcerange", "actuatorfrcrange"):
        return 0.8 * value
    shift = np.where(value == 0.0, 0.01, 0.1 * np.abs(value))
    return np.where(value + shift <= row.high, value + shift, np.maximum(value - shift, row.low))


def settable(model: Model) -> list[Parameter]:
    """List the parameters that Bullet has."""
    return [row for row in model.parameters if supports(model, row.key)]


# --- against MuJoCo -------------------------------------------------------------------------------


def moved(model: Model, seed: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Give MuJoCo's model, without contacts and limits, in a random state with random controls."""
    mj = compiled(model)
    mj = mujoco.MjModel.from_binary_path("m.mjb", {"m.mjb": saved(mj)})
    mj.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data, generator = mujoco.MjData(mj), np.random.default_rng(seed)
    mujoco.mj_integratePos(mj, data.qpos, generator.normal(size=mj.nv), 0.2)
    for joint in np.flatnonzero(mj.jnt_limited):
        data.qpos[mj.jnt_qposadr[joint]] = mj.jnt_range[joint].mean()
    data.qvel[:] = generator.normal(size=mj.nv)
    data.ctrl[:] = generator.uniform(-1.0, 1.0, mj.nu)
    return mj, data


def saved(mj: mujoco.MjModel) -> bytes:
    """Copy a compiled model as bytes."""
    buffer = np.empty(mujoco.mj_sizeModel(mj), np.uint8)
    mujoco.mj_saveModel(mj, None, buffer)
    return buffer.tobytes()


def touching(model: Model) -> list[tuple[int, int]]:
    """List the shapes that may touch."""
    pairs = np.argwhere(np.triu(Couplings(compiled(model)).touches)).tolist()
    return [(first, second) for first, second in pairs]


def placed(backend: BulletBackend, model: Model, data: mujoco.MjData) -> Any:
    """Put a model into MuJoCo's state, with contacts switched off; return the client."""
    state = model.empty_state()
    state.vector[model.places("qpos")[1]] = data.qpos
    state.vector[model.places("qvel")[1]] = data.qvel
    backend.build(model.default_scene().with_(state=state))
    client = backend.client()
    for first, second in touching(model):
        one, other = client.geoms[first], client.geoms[second]
        client.engine.setCollisionFilterPair(
            one[0], other[0], one[1], other[1], 0, physicsClientId=client.engine.handle
        )
    return client


@pytest.mark.parametrize(
    "name",
    [
        "chain",
        "smooth",
        "inverted_double_pendulum",
        "inverted_pendulum",
        "cartpole",
        "kuka",
        "humanoid",
    ],
)
def test_one_step_is_that_of_mujoco(backend: BulletBackend, name: str) -> None:
    """Joints, springs, dampers and actuators of all kinds accelerate as in MuJoCo."""
    model = described(name)
    velocities = model.places("qvel")[1]
    for seed in range(3):
        mj, data = moved(model, seed)
        before, h = data.qvel.copy(), mj.opt.timestep
        placed(backend, model, data)
        backend.step(data.ctrl, 1)
        mujoco.mj_step(mj, data)
        expected = (data.qvel - before) / h
        found = (backend.read().vector[velocities] - before) / h
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["chain", "pile", "kuka", "panda", "humanoid"])
def test_bodies_are_where_mujoco_has_them(backend: BulletBackend, name: str) -> None:
    """Centers of mass agree in random states, for all kinds of joints."""
    model = described(name)
    mj, data = moved(model, 0)
    client = placed(backend, model, data)
    mujoco.mj_kinematics(mj, data)
    for body, (multibody, link) in client.bodies.items():
        if link < 0:
            pose = client.engine.getBasePositionAndOrientation(
                multibody, physicsClientId=client.engine.handle
            )
        else:
            pose = client.engine.getLinkState(
                multibody, link, computeForwardKinematics=1, physicsClientId=client.engine.handle
            )
        # The engine keeps the frames of links in single precision.
        np.testing.assert_allclose(pose[0], data.xipos[body], atol=1e-6)


HINGED = """
<mujoco><option integrator="implicitfast"/><worldbody><body pos="0 0 1">
  <joint name="hinge" axis="0.6 0.8 0" damping="{damping}"/>
  <inertial pos="0.1 0 -0.2" mass="0.1" diaginertia="0.001 0.002 0.0025" quat="1 0.2 0.3 0.4"/>
  <body pos="0 0 -0.3">
    <joint name="end" axis="0 1 0" damping="{damping}"/>
    <inertial pos="0 0 -0.1" mass="0.01" diaginertia="0.0001 0.0001 0.0001"/>
  </body>
</body></worldbody></mujoco>
"""


def test_strong_damping_stays_with_mujoco() -> None:
    """A damper that an explicit step could not bear."""
    model = read_model(HINGED.format(damping=5.0))
    runs = []
    for engine in ENGINES:
        backend, scene = make_backend(engine), model.default_scene()
        scene.state["hinge.velocity"][...], scene.state["end.velocity"][...] = 2.0, -3.0
        backend.build(scene)
        runs.append(play(backend, 100, substeps=1))
        backend.close()
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_a_joint_that_follows_another_does(backend: BulletBackend) -> None:
    """The fingers of the Panda stay together, whoever is pushed."""
    model = described("panda")
    scene = model.default_scene()
    scene.state["panda_finger_joint1.velocity"][...] = 0.1
    scene.state["panda_finger_joint2.velocity"][...] = 0.1
    backend.build(scene)
    states = play(backend, 40)
    one, other = (model.layout.slices[f"panda_finger_joint{k}.position"] for k in (1, 2))
    assert states[:, one].max() > 0.01
    np.testing.assert_allclose(states[:, one], states[:, other], atol=1e-6)


# --- against formulas -----------------------------------------------------------------------------

PENDULUM = """
<mujoco><option timestep="{h}"/><worldbody><body name="bob" pos="0 0 1">
  <joint name="hinge" axis="0 1 0"/>
  <inertial pos="0 0 -0.5" mass="2" diaginertia="0.03 0.03 0.01"/>
</body></worldbody></mujoco>
"""
SLIDER = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="9 9 1" friction="{floor}"/>
  <body name="box" pos="0 0 0.05"><freejoint/>
    <geom name="box" type="box" size="0.1 0.1 0.05" mass="1" friction="{box}"/>
  </body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("h", [0.01, 0.002])
def test_the_period_of_a_pendulum(engine: str, h: float) -> None:
    """It is that of the formula within 0.1 %."""
    backend, model = make_backend(engine), read_model(PENDULUM.format(h=h))
    scene = model.default_scene()
    scene.state["hinge.position"][...] = 0.05
    backend.build(scene)
    angle = play(backend, round(5.0 / h), substeps=1)[:, 0]
    down = np.flatnonzero((angle[:-1] > 0.0) & (angle[1:] <= 0.0))
    times = h * (down + angle[down] / (angle[down] - angle[down + 1]))
    period = 2 * math.pi * math.sqrt((0.03 + 2 * 0.25) / (2 * 9.81 * 0.5)) * (1 + 0.05**2 / 16)
    assert np.diff(times).mean() == pytest.approx(period, rel=1e-3)
    backend.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_free_fall(engine: str) -> None:
    """It is the sum of semi-implicit Euler steps, to rounding; a turning body keeps its spin."""
    backend, model = make_backend(engine), described("pile")
    scene, n, h = model.default_scene(), 100, model.timestep
    scene.state["ball.cartesian_position"][:] = [0.0, 0.0, 9.0]
    scene.state["ball.linear_velocity"][:] = [1.0, 2.0, 3.0]
    scene.state["ball.angular_velocity"][:] = [4.0, 5.0, 6.0]
    backend.build(scene)
    backend.step(np.zeros(model.n_commands), n)
    after = backend.read()
    height = 9.0 + 3.0 * n * h - 9.81 * h * h * n * (n + 1) / 2
    np.testing.assert_allclose(
        after["ball.cartesian_position"], [n * h, 2 * n * h, height], rtol=1e-12
    )
    np.testing.assert_allclose(after["ball.linear_velocity"], [1.0, 2.0, 3.0 - 9.81 * n * h])
    np.testing.assert_allclose(after["ball.angular_velocity"], [4.0, 5.0, 6.0], rtol=1e-9)
    backend.close()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("floor", "box"), [(0.5, 0.5), (0.8, 0.3), (0.2, 0.6), (0.0, 0.5)])
def test_a_sliding_box(engine: str, floor: float, box: float) -> None:
    """It slides v²/(2µg) far within 2 %, with the larger of two coefficients."""
    backend, model = make_backend(engine), read_model(SLIDER.format(floor=floor, box=box))
    backend.build(model.default_scene())
    backend.step(np.zeros(0), 100)
    state = backend.read()
    state["box.linear_velocity"][:] = [2.0, 0.0, 0.0]
    start = state["box.cartesian_position"][0]
    backend.apply(Difference(state=state))
    backend.step(np.zeros(0), 600)
    distance = backend.read()["box.cartesian_position"][0] - start
    assert distance == pytest.approx(2.0**2 / (2 * max(floor, box) * 9.81), rel=0.02)
    backend.close()


def test_contacts_carry_the_weight(backend: BulletBackend) -> None:
    """A resting box touches the world only, from above, and the forces add up to its weight."""
    model = read_model(SLIDER.format(floor=0.5, box=0.5))
    backend.build(model.default_scene())
    assert backend.contacts() == ()
    backend.step(np.zeros(0), 300)
    contacts = backend.contacts()
    assert {frozenset(contact.bodies) for contact in contacts} == {frozenset({"world", "box"})}
    assert sum(contact.force for contact in contacts) == pytest.approx(9.81, rel=0.01)
    for contact in contacts:
        upwards = 1.0 if contact.bodies[0] == "world" else -1.0
        np.testing.assert_allclose(contact.normal, [0.0, 0.0, upwards], atol=1e-6)
        assert contact.depth == pytest.approx(0.0, abs=1e-3)


def test_limits_and_dry_friction_hold(backend: BulletBackend) -> None:
    """A joint stops at its limits, and does not begin to move against too much friction."""
    model = everything(PENDULUM.format(h=0.002).replace('0 1 0"/>', '0 1 0" range="-20 20"/>'))
    scene = model.default_scene()
    scene.state["hinge.velocity"][...] = 5.0
    backend.build(scene)
    assert play(backend, 200)[:, 0].max() == pytest.approx(math.radians(20), abs=0.03)
    narrow = {("hinge", "range"): np.array([-0.2, 0.2])}
    backend.build(scene.with_(parameters={**scene.parameters, **narrow}))
    assert play(backend, 200)[:, 0].max() == pytest.approx(0.2, abs=0.03)

    scene.state["hinge.position"][...], scene.state["hinge.velocity"][...] = 0.3, 0.0
    torque = 2 * 9.81 * 0.5 * math.sin(0.3)
    for loss, moves in ((1.05 * torque, False), (0.95 * torque, True)):
        held = {("hinge", "frictionloss"): np.array(loss)}
        backend.build(scene.with_(parameters={**scene.parameters, **held}))
        assert (abs(play(backend, 50)[-1, 0] - 0.3) > 0.001) == moves


def test_a_size_is_rebuilt_into_the_body(backend: BulletBackend) -> None:
    """A taller box rests higher; the smaller one comes back."""
    model = read_model(SLIDER.format(floor=0.5, box=0.5))
    backend.build(model.default_scene())
    state = backend.read()
    state["box.cartesian_position"][2] = 0.21
    size = model.defaults["box", "size"]
    taller = {("box", "size"): size + np.array([0.0, 0.0, 0.15])}
    backend.apply(Difference(parameters=taller, state=state))
    backend.step(np.zeros(0), 300)
    assert backend.read()["box.cartesian_position"][2] == pytest.approx(0.2, abs=1e-3)
    backend.apply(Difference(parameters={("box", "size"): size}))
    backend.step(np.zeros(0), 300)
    assert backend.read()["box.cartesian_position"][2] == pytest.approx(0.05, abs=1e-3)


def test_friction_of_pairs() -> None:
    """Products are the larger coefficient where moving shapes have the usual one, or floor's."""
    mj, pairs = copy.copy(compiled(described("pile"))), touching(described("pile"))
    names, geoms = element_names(mj)["geom"], {geom for pair in pairs for geom in pair}
    usual = usual_friction(mj)
    numbers = dict(zip(geoms, shares(mj, [*geoms], usual), strict=True))
    for first, second in pairs:
        if "cube" in (names[first], names[second]) and names[first] != "floor":
            continue  # softer than usual: the floor's coefficient stands in for its own
        wanted = max(mj.geom_friction[first, 0], mj.geom_friction[second, 0])
        assert numbers[first] * numbers[second] == pytest.approx(wanted)
    mj.geom_friction[names.index("sphere"), 0] = 1.5
    changed = dict(zip(geoms, shares(mj, [*geoms], usual), strict=True))
    assert [names[geom] for geom in geoms if changed[geom] != numbers[geom]] == ["sphere"]


# --- no trace -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pile", "smooth", "inverted_double_pendulum", "kuka", "panda"])
def test_equal_scenes_continue_alike(backend: BulletBackend, name: str) -> None:
    """New backends, used ones, snapshots here and elsewhere: the future is the same to the bit."""
    scene = described(name).default_scene()
    backend.build(scene)
    expected = play(backend, 40)
    assert np.isfinite(expected).all()
    snapshot = backend.snapshot()
    future = play(backend, 100, seed=1)
    backend.restore(snapshot)
    np.testing.assert_array_equal(play(backend, 100, seed=1), future)
    again = backend.snapshot()  # long enough for the engine's own saved state
    beyond = play(backend, 10, seed=2)
    backend.restore(again)
    np.testing.assert_array_equal(play(backend, 10, seed=2), beyond)
    backend.build(scene)
    np.testing.assert_array_equal(play(backend, 40), expected)

    other = BulletBackend()
    other.build(scene)
    np.testing.assert_array_equal(play(other, 40), expected)
    other.restore(pickle.loads(pickle.dumps(again)))  # noqa: S301 # our own
    np.testing.assert_array_equal(play(other, 10, seed=2), beyond)
    other.close()


@pytest.mark.parametrize("name", ["pile", "chain", "smooth", "inverted_double_pendulum", "panda"])
def test_do_and_undo_leaves_no_trace(backend: BulletBackend, name: str) -> None:
    """Every parameter can be set, read back and put back: the future differs by exactly 0.0."""
    model = described(name)
    scene = model.default_scene()
    backend.build(scene)
    play(backend, 5)
    snapshot = backend.snapshot()
    expected = play(backend, 50, seed=1)
    rows = settable(model)
    for number, row in enumerate(rows[:: 4 if name == "panda" else 1]):
        value = scene.parameters[row.key]
        changed = other_value(row, value)
        assert not np.array_equal(changed, value)
        backend.restore(snapshot)
        backend.apply(Difference(parameters={row.key: changed}))
        np.testing.assert_allclose(backend.parameters([row.key])[row.key], changed, rtol=1e-12)
        backend.apply(Difference(parameters={row.key: value}))
        horizon = 50 if number % 10 == 0 else 1
        np.testing.assert_array_equal(play(backend, horizon, seed=1), expected[:horizon])
    backend.restore(snapshot)
    everything_else = {row.key: other_value(row, scene.parameters[row.key]) for row in rows}
    backend.apply(Difference(parameters=everything_else))
    backend.apply(Difference(parameters={row.key: scene.parameters[row.key] for row in rows}))
    np.testing.assert_array_equal(play(backend, 50, seed=1), expected)


@pytest.mark.parametrize("name", ["pile", "chain", "smooth", "panda"])
def test_a_live_change_equals_a_new_build(backend: BulletBackend, name: str) -> None:
    """What live bodies take on is what new bodies are built with; afterwards nothing is left."""
    model, fresh = described(name), BulletBackend()
    scene = model.default_scene()
    backend.build(scene)
    expected = play(backend, 5)
    rows = [row for row in settable(model) if not row.visual]
    for row in rows[:: 9 if name == "panda" else 2]:
        change = {row.key: other_value(row, scene.parameters[row.key])}
        backend.build(scene)
        backend.apply(Difference(parameters=change))
        states = play(backend, 5)
        fresh.build(scene.with_(parameters={**scene.parameters, **change}))
        np.testing.assert_array_equal(play(fresh, 5), states)
        backend.apply(Difference(parameters=scene.parameters, state=scene.state))
        np.testing.assert_array_equal(play(backend, 5), expected)
    fresh.close()


def test_trees_apart_leave_one_another_alone(backend: BulletBackend) -> None:
    """What acts on one tree changes no bit of those that it does not touch."""
    model = described("pile")
    scene, slices = model.default_scene(), model.layout.slices
    backend.build(scene)
    expected = play(backend, 20)
    groups = (("box", "ball", "cube", "sphere"), ("tool", "handle", "head"))
    moved = 0
    for row in settable(model):
        group = next((names for names in groups if row.key[0].split(":")[-1] in names), None)
        if group is None or row.visual:
            continue
        change = {row.key: other_value(row, scene.parameters[row.key])}
        backend.build(scene.with_(parameters={**scene.parameters, **change}))
        states = play(backend, 20)
        for name, where in slices.items():
            same = np.array_equal(states[:, where], expected[:, where])
            assert same or name.split(".")[0] in group, (row.name, name)
            moved += not same
    assert moved > 50


def test_a_structure_after_another(backend: BulletBackend) -> None:
    """Models and the TriFinger follow one another in a backend; snapshots lead back to each."""
    pile, robot = described("pile").default_scene(), busy_scene()
    backend.build(pile)
    first = play(backend, 5)
    snapshot = backend.snapshot()
    after = play(backend, 3, seed=1)
    backend.build(robot)
    second = play_robot(backend, 3)
    back = backend.snapshot()
    later = play_robot(backend, 2)
    backend.build(described("panda").default_scene())
    play(backend, 2)
    backend.restore(snapshot)
    np.testing.assert_array_equal(play(backend, 3, seed=1), after)
    backend.restore(back)
    np.testing.assert_array_equal(play_robot(backend, 2), later)
    backend.build(pile)
    np.testing.assert_array_equal(play(backend, 5), first)
    backend.build(robot)
    np.testing.assert_array_equal(play_robot(backend, 3), second)


def test_a_batch_is_its_members(backend: BulletBackend) -> None:
    """Stepping in a batch is stepping one after another, with rows of any width."""
    model = described("pile")
    members = [BulletBackend() for _ in range(2)]
    for member in members:
        member.build(model.default_scene())
    backend.build(model.default_scene())
    commands = np.random.default_rng(0).uniform(-1.0, 1.0, (2, model.n_commands + 1))
    into = np.full((2, model.layout.size + 2), np.nan)
    batch = BulletBackend.batch.of(members, 1)
    batch.step(np.arange(2), commands, 20, into)
    for row, command in zip(into, commands, strict=True):
        backend.build(model.default_scene())
        backend.step(command[:-1], 20)
        np.testing.assert_array_equal(row[:-2], backend.read().vector)
    for member in members:
        member.close()


def test_a_shape_that_only_pictures_show_has_no_effect(backend: BulletBackend) -> None:
    """Resizing it in mid-episode leaves contacts as they are."""
    label = '<geom name="label" size="0.02" contype="0" conaffinity="0" mass="0"/></body>'
    model = everything(SLIDER.format(floor=0.5, box=0.5).replace("</body>", label))
    scene = model.default_scene()
    scene.state["box.linear_velocity"][:] = [1.0, 0.5, 0.0]
    backend.build(scene)
    play(backend, 10)
    start = backend.snapshot()
    expected = play(backend, 20)
    backend.restore(start)
    backend.apply(Difference(parameters={("label", "size"): np.array([0.05])}))
    np.testing.assert_array_equal(play(backend, 20), expected)


# --- what there is not ----------------------------------------------------------------------------

ODD = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="a" pos="0 0 1"><freejoint/>
      <geom type="ellipsoid" size="0.1 0.2 0.3"/><site name="s"/>
      <body name="b"><joint name="j" armature="0.1"/><geom size="0.1"/>
        <body name="c"><joint name="k" type="ball" limited="true" range="0 20"/>
          <geom size="0.1"/></body></body>
    </body>
    <body name="d"><joint name="l" type="slide" armature="0.1"/><geom size="0.1"/></body>
  </worldbody>
  <tendon><fixed name="t" range="-1 1" limited="true"><joint joint="j" coef="1"/></fixed></tendon>
  <equality><weld name="w" body1="a" body2="d"/></equality>
  <actuator><adhesion name="m" body="a" ctrlrange="0 1"/></actuator>
</mujoco>
"""


def test_all_that_cannot_be_honoured_is_said_at_once(backend: BulletBackend) -> None:
    """One error lists everything, before anything is made."""
    model = read_model(ODD)
    with pytest.raises(ModelError) as caught:
        backend.build(model.default_scene())
    said = str(caught.value)
    for what in (
        "which is not a box", "armature of the joint 'j'", "limits of the ball joint 'k'",
        "armature of the joint 'l'", "limits of the tendon 't'", "equality constraint 'w'",
        "actuator 'm', which acts by contact",
    ):  # fmt: skip
        assert what in said, what
    assert len(unsupported(model)) == said.count("Bullet cannot honour")
    assert not backend._clients
    backend.build(described("cartpole").default_scene())


@pytest.mark.parametrize("name", ["cartpole", "kuka", "panda", "humanoid"])
def test_robots_of_pybullet_are_honoured(name: str) -> None:
    """Nothing in these files is refused."""
    assert unsupported(described(name)) == ()


LINK = """
  <link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="0.2"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="{0}_joint" type="revolute"><parent link="base"/><child link="{0}"/>
    <origin xyz="0 {1} 0"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>{2}</joint>
"""
MIMIC = '<mimic joint="left_joint" multiplier="-0.5" offset="0.1"/>'
GRIPPER = (
    '<robot name="gripper"><link name="base"/>'
    + LINK.format("left", "0.1", "")
    + LINK.format("right", "-0.1", MIMIC)
    + "</robot>"
)


def test_fingers_of_a_fixed_gripper_mimic_one_another() -> None:
    """They are two trees that hang on the world, and follow as they do on MuJoCo."""
    paths = []
    for engine in ENGINES:
        world = World(GRIPPER, backend=engine)
        pushes = 0.05 * np.sin(np.linspace(0.0, 9.0, 40))[:, None]
        episode = world.rollout(pushes, steps=40)
        paths.append([episode[f"{side}_joint.position"] for side in ("left", "right")])
        assert episode.counterfactual({}) == episode
    (_, (left, right)) = paths
    assert np.ptp(left) > 0.3
    np.testing.assert_allclose(right[10:], 0.1 - 0.5 * left[10:], atol=2e-3)
    np.testing.assert_allclose(*(np.array(path)[:, 10:] for path in paths), atol=0.02)


def test_armature_is_refused(backend: BulletBackend) -> None:
    """Most of Gymnasium's models have it in every joint."""
    with pytest.raises(ModelError, match=r"armature of the joint 'bthigh'.*backend='mujoco'"):
        backend.build(described("half_cheetah").default_scene())


def test_parameters_that_bullet_lacks(backend: BulletBackend) -> None:
    """They keep their defaults; setting one is an error that changes nothing."""
    model = described("pile")
    lacking = {row.key for row in model.parameters if not supports(model, row.key)}
    assert {("cube", "solref"), ("", "impratio"), ("elbow", "frictionloss")} <= lacking
    assert not {("box", "mass"), ("cube", "color"), ("", "gravity")} & lacking
    scene = model.default_scene()
    backend.build(scene)
    expected = play(backend, 3)
    backend.build(scene)
    heavier = {("box", "mass"): np.array(2.0), ("", "impratio"): np.array(3.0)}
    with pytest.raises(NotIntervenable, match=r"'impratio' is not a parameter on Bullet"):
        backend.apply(Difference(parameters=heavier))
    np.testing.assert_array_equal(play(backend, 3), expected)
    with pytest.raises(NotIntervenable, match="keeps its default"):
        backend.build(scene.with_(parameters={**scene.parameters, **heavier}))
    assert not backend.capabilities.supports(model, ("elbow", "frictionloss"))
    assert backend.capabilities.supports(trifinger(), ("robot", "height"))


def test_names_that_do_not_exist(backend: BulletBackend) -> None:
    """Errors list what there is."""
    model = described("pile")
    backend.build(model.default_scene())
    with pytest.raises(UnknownOption, match=r"no parameter is named 'boxx\.inertia'"):
        backend.parameters([("boxx", "inertia")])
    np.testing.assert_allclose(
        backend.parameters([("box", "inertia")])["box", "inertia"],
        model.defaults["box", "inertia"],
        rtol=1e-12,
    )


def test_a_world_leaves_out_what_bullet_lacks() -> None:
    """Its variables are those that can be set; the others are named as refused."""
    world = World(described("cartpole"), backend="bullet")
    world.reset(seed=0)
    names = {variable.name for variable in world.graph.variables}
    assert "cart_to_pole.damping" in names
    assert "cart_to_pole.armature" not in names
    world.do({"pole.mass": 0.3})
    assert world.backend.parameters([("pole", "mass")])["pole", "mass"] == 0.3
    with pytest.raises(NotIntervenable, match="not a parameter of bullet"):
        world.do({"cart_to_pole.armature": 0.3})


def test_a_state_that_is_not_finite_is_an_error(backend: BulletBackend) -> None:
    """A speed that overflows is an error, and not a NaN."""
    model = described("cartpole")
    scene = model.default_scene()
    scene.state["cart_to_pole.velocity"][...] = 1e200
    backend.build(scene)
    with pytest.raises(EngineFailure, match="not finite"):
        play(backend, 3)


MOTORS = """
<mujoco model="motors">
  <option timestep="0.002"/>
  <custom><numeric name="bullet_explicit_servos" data="1"/></custom>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" stiffness="0.4" springref="20" pos="0 0 0.01"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.4"/>
      <body name="fore" pos="0.2 0 0">
        <joint name="elbow" axis="0 1 0" actuatorfrcrange="-0.3 0.3" actuatorfrclimited="true"/>
        <geom name="fore" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.2"/>
      </body>
    </body>
    <body name="apart" pos="0 2 1">
      <joint name="apart" axis="0 1 0"/>
      <geom name="apart" type="sphere" size="0.05" pos="0.1 0 0" mass="0.1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" gear="2" forcerange="-0.5 0.5" forcelimited="true"/>
    <position name="elbow" joint="elbow" kp="3" kv="0.05"/>
    <general name="apart" joint="apart" dyntype="DYNAMICS" dynprm="0.1"/>
  </actuator>
</mujoco>
"""


def test_forces_of_joints_alone_are_those_of_the_whole_model() -> None:
    """A filter elsewhere needs all of MuJoCo's step; the arm moves the same, but for rounding."""
    runs = []
    for dynamics in ("none", "filter"):
        backend, model = make_backend("bullet"), read_model(MOTORS.replace("DYNAMICS", dynamics))
        backend.build(model.default_scene())
        rows = []
        for angle in np.linspace(0.0, 6.0, 40):
            backend.step(np.array([0.4 * np.sin(angle), np.cos(angle), 0.0]), 5)
            state = backend.read()
            names = [
                f"{joint}.{what}"
                for joint in ("shoulder", "elbow")
                for what in ("position", "velocity")
            ]
            rows.append(np.concatenate([state[name] for name in names]))
        runs.append(np.array(rows))
        backend.close()
    assert abs(runs[0]).max() > 1.0
    np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=1e-9)
