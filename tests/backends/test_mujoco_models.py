"""Foreign models on MuJoCo: every sentence of ``Backend`` for files that nobody here wrote."""

from __future__ import annotations

import importlib.util
import pickle
import subprocess
import sys
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from scm_world.backends import EngineSnapshot, read_model
from scm_world.backends.mujoco import MujocoBackend
from scm_world.discovery.data import Design, collect
from scm_world.errors import EngineFailure, Infeasible, ModelError, UnknownOption
from scm_world.geometry.rotations import from_rotation_vector, quaternion_product
from scm_world.models import (
    Difference,
    Model,
    Parameter,
    ParameterKey,
    Parameters,
    Scene,
)
from scm_world.queries import World
from scm_world.tasks.trifinger.system import trifinger

Floats = NDArray[np.float64]
SUBSTEPS = 3
FILES = {
    "inverted_double_pendulum": ("gymnasium", "envs/mujoco/assets/inverted_double_pendulum.xml"),
    "reacher": ("gymnasium", "envs/mujoco/assets/reacher.xml"),
    "pusher": ("gymnasium", "envs/mujoco/assets/pusher.xml"),
    "half_cheetah": ("gymnasium", "envs/mujoco/assets/half_cheetah.xml"),
    "ant": ("gymnasium", "envs/mujoco/assets/ant.xml"),
    "cartpole": ("dm_control", "suite/cartpole.xml"),
    "ball_in_cup": ("dm_control", "suite/ball_in_cup.xml"),
    "finger": ("dm_control", "suite/finger.xml"),
    "cheetah": ("dm_control", "suite/cheetah.xml"),
    "panda": ("robosuite", "models/assets/robots/panda/robot.xml"),
}
MODELS = [
    pytest.param(name, marks=pytest.mark.slow) if name == "panda" else name
    for name in ("pile", *FILES)
]

PILE = """
<mujoco model="pile">
  <option timestep="0.004" integrator="{integrator}"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="box" pos="0 0 0.11">
      <freejoint/>
      <geom name="cube" type="box" size="0.1 0.1 0.1"/>
    </body>
    <body name="arm" pos="0.5 0 0.4">
      <joint name="shoulder" type="ball"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="wrist" axis="0 1 0" damping="0.1" range="-90 90"/>
        <geom name="palm" type="sphere" size="0.05" pos="0 0 -0.04"/>
      </body>
    </body>
    <body name="target" mocap="true" pos="0 0 1">
      <geom size="0.01" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <equality><weld name="leash" body1="box" body2="target" solref="0.5 1"/></equality>
  <actuator>
    <motor name="twist" joint="wrist" ctrlrange="-1 1"/>
    <general name="slow" joint="wrist" dyntype="filter" dynprm="0.05" gainprm="0.3"/>
  </actuator>
</mujoco>
"""


@cache
def described(name: str) -> Model:
    """Read a file of another package, or a text."""
    if name.startswith("pile"):
        return everything(PILE.format(integrator=name.partition(" ")[2] or "Euler"))
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


def built(name: str) -> MujocoBackend:
    """Realize a model in a state in which things move and touch."""
    model, backend = described(name), MujocoBackend()
    backend.build(model.default_scene())
    play(backend, 5, seed=1)
    return backend


def play(backend: MujocoBackend, steps: int, *, seed: int = 0) -> Floats:
    """Give random commands; return the states, one to a row."""
    generator, state = np.random.default_rng(seed), backend.read()
    states = np.empty((steps, state.vector.size))
    for row in states:
        command = generator.uniform(-1.0, 1.0, backend.structure.n_commands)
        backend.step(command, SUBSTEPS)
        backend.read(state.with_vector(row))
    return states


def other_value(row: Parameter, value: Floats) -> Floats:
    """Give another value that a parameter may have."""
    if row.kind == "rotation":
        return quaternion_product(from_rotation_vector([0.02, -0.03, 0.05]), value)
    if row.kind == "inertia":
        return np.asarray(1.2 * value)
    if row.kind == "switch":
        return 1.0 - value
    if row.key[1] == "axis":
        turned = value + np.array([0.1, -0.05, 0.02])
        return np.asarray(turned / np.linalg.norm(turned))
    shift = np.where(value == 0.0, 0.01, 0.1 * np.abs(value))
    down = value - shift
    return np.where(value + shift <= row.high, value + shift, np.maximum(down, row.low))


def others(model: Model, values: Parameters) -> dict[ParameterKey, Floats]:
    """Give another value for every parameter."""
    return {row.key: other_value(row, values[row.key]) for row in model.parameters}


@cache
def numeric(kind: type) -> tuple[str, ...]:
    """Name the attributes that are properties of a compiled model or of a part of it."""
    names = (name for name in dir(kind) if not name.startswith("_"))
    return tuple(name for name in names if isinstance(getattr(kind, name), property))


def arrays(model: mujoco.MjModel) -> dict[str, bytes]:
    """Copy every number of a compiled model."""
    found = {}
    for part in (model, model.opt, model.stat):
        for key in numeric(type(part)):
            value = getattr(part, key)
            if isinstance(value, np.ndarray | float | int):
                found[f"{type(part).__name__}.{key}"] = np.asarray(value).tobytes()
    return found


def changed(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """Name what differs."""
    return [name for name, value in before.items() if after[name] != value]


@pytest.fixture(params=MODELS)
def name(request: pytest.FixtureRequest) -> str:
    """Name a model."""
    return str(request.param)


# --- doing and undoing -------------------------------------------------------------------------


def test_every_parameter_is_undone_exactly(name: str) -> None:
    """Each is set, read back and set back; the model and 20 steps are as before, bit for bit."""
    backend, model = built(name), described(name)
    start, now = backend.snapshot(), arrays(backend.realization.model)
    expected = play(backend, 20)
    inert = []
    for row in model.parameters:
        backend.restore(start)
        value = backend.parameters([row.key])[row.key]
        other = other_value(row, value)
        backend.apply(Difference(parameters={row.key: other}))
        back = backend.parameters([row.key])[row.key]
        np.testing.assert_allclose(back, other, rtol=1e-6, atol=1e-12, err_msg=row.name)
        if (back == value).all():
            inert.append(row.name)
        backend.apply(Difference(parameters={row.key: value}))
        assert changed(now, arrays(backend.realization.model)) == [], row.name
        assert np.array_equal(play(backend, 20), expected), row.name
    assert inert == []


def test_any_path_ends_in_the_same_model(name: str) -> None:
    """Values set one by one, with detours, in any order, give a model that was built so."""
    backend, model = built(name), described(name)
    scene = model.default_scene()
    final = others(model, scene.parameters)
    order = np.random.default_rng(0).permutation(len(model.parameters))
    for row in [model.parameters[i] for i in order]:
        backend.apply(Difference(parameters={row.key: other_value(row, final[row.key])}))
        backend.apply(Difference(parameters={row.key: final[row.key]}))
    fresh = MujocoBackend()
    fresh.build(scene.with_(parameters=final))
    edited, compiled = backend.realization.model, fresh.realization.model
    assert changed(arrays(compiled), arrays(edited)) == []


def test_a_state_is_written_and_taken_back_exactly(name: str) -> None:
    """Any numbers are read back bit for bit; after the old ones the future is the old one."""
    backend = built(name)
    start, now = backend.snapshot(), backend.read()
    expected = play(backend, 50)
    backend.restore(start)
    generator = np.random.default_rng(3)
    other = now.with_vector(now.vector + generator.normal(scale=0.1, size=now.vector.size))
    backend.apply(Difference(state=other))
    assert backend.read() == other
    backend.apply(Difference(state=now))
    assert backend.read() == now
    assert np.array_equal(play(backend, 50), expected)


def test_a_state_is_all_that_counts() -> None:
    """What was before a state was written does not act: the next steps depend on it alone."""
    one, other = built("pile"), built("pile")
    play(other, 20, seed=7)
    other.apply(Difference(state=one.read()))
    assert np.array_equal(play(other, 50), play(one, 50))


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("attribute", ["mass", "inertia"])
def test_what_cannot_move_is_refused_without_a_trace(
    attribute: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change that breaks the model is taken back, and so is all that came with it."""
    monkeypatch.chdir(tmp_path)
    backend = built("half_cheetah")
    before, start = arrays(backend.realization.model), backend.snapshot()
    expected = play(backend, 50)
    backend.restore(start)
    keys = [("bthigh", attribute), ("", "gravity"), ("torso", "mass")]
    old = backend.parameters(keys)
    new = {key: 1.1 * number for key, number in old.items()}
    new["bthigh", attribute] = np.full_like(old["bthigh", attribute], value)
    with pytest.raises(Infeasible, match=rf"bthigh\.{attribute}"):
        backend.apply(Difference(parameters=new))
    assert changed(before, arrays(backend.realization.model)) == []
    assert np.array_equal(play(backend, 50), expected)
    assert list(tmp_path.iterdir()) == []


# --- snapshots, processes, structures ----------------------------------------------------------

CHILD = """
import pickle, sys
sys.path.insert(0, sys.argv[1])
from test_mujoco_models import futures
found = [futures(*given) for given in pickle.load(sys.stdin.buffer)]
sys.stdout.buffer.write(pickle.dumps(found))
"""


def futures(snapshot: EngineSnapshot, scene: Scene) -> list[Floats]:
    """Go on from a snapshot, and from a scene."""
    backend = MujocoBackend()
    backend.restore(snapshot)
    first = play(backend, 20)
    backend.build(scene)
    return [first, play(backend, 20)]


def test_another_process_continues_alike() -> None:
    """Snapshots with changed parameters, and scenes, go on elsewhere bit for bit."""
    given = []
    for name in ("pile", "ball_in_cup", "reacher"):
        backend, model = built(name), described(name)
        rows = model.parameters[:: max(1, len(model.parameters) // 5)]
        values = backend.parameters([row.key for row in rows])
        new = {row.key: other_value(row, values[row.key]) for row in rows}
        backend.apply(Difference(parameters=new))
        play(backend, 2)
        default = model.default_scene()
        parameters = {**default.parameters, **new}
        given.append(
            (backend.snapshot(), default.with_(parameters=parameters, state=backend.read()))
        )
    child = subprocess.run(  # noqa: S603 # our own interpreter, our own code
        [sys.executable, "-c", CHILD, str(Path(__file__).parent)],
        input=pickle.dumps(given),
        capture_output=True,
        check=True,
    )
    there = pickle.loads(child.stdout)  # noqa: S301 # our own
    for pair, elsewhere in zip(given, there, strict=True):
        for one, other in zip(futures(*pair), elsewhere, strict=True):
            assert np.array_equal(one, other)


def test_a_snapshot_restores_everything(name: str) -> None:
    """After changes of all kinds, a snapshot brings back parameters, state and future."""
    backend, model = built(name), described(name)
    start = pickle.loads(pickle.dumps(backend.snapshot()))  # noqa: S301 # our own
    now, keys = backend.read(), [row.key for row in model.parameters]
    before, expected = backend.parameters(keys), play(backend, 20)
    backend.apply(Difference(parameters=others(model, before)))
    play(backend, 2, seed=5)
    other = MujocoBackend()
    other.build(described("pile").default_scene())
    for restored in (backend, other):
        restored.restore(start)
        after = restored.parameters(keys)
        assert [key for key in keys if after[key].tobytes() != before[key].tobytes()] == []
        assert restored.read() == now
        assert np.array_equal(play(restored, 20), expected)


def test_building_forgets(name: str) -> None:
    """A used backend that is built again, also after another structure, is like a new one."""
    model, backend = described(name), built(name)
    scene = model.default_scene()
    fresh = MujocoBackend()
    fresh.build(scene)
    expected = play(fresh, 10)
    backend.apply(Difference(parameters=others(model, scene.parameters)))
    backend.build(scene)
    assert np.array_equal(play(backend, 10), expected)
    backend.build(trifinger(("block",)).default_scene())
    backend.build(scene)
    assert np.array_equal(play(backend, 10), expected)


def test_another_structure_is_undone_exactly() -> None:
    """A body that comes and goes leaves no trace, and the others stay where they are."""
    text = PILE.format(integrator="Euler")
    new = "<body name='new' pos='1 1 1'><freejoint/><geom size='0.1'/></body>"
    more = text.replace('<body name="arm"', f'{new}<body name="arm"')
    backend = built("pile")
    model, larger = described("pile"), everything(more)
    assert larger.layout.size == model.layout.size + 13
    heavy = {("box", "mass"): np.array(11.0)}
    backend.apply(Difference(parameters=heavy))
    start, now = backend.snapshot(), backend.read()
    parameters = backend.parameters([row.key for row in model.parameters])
    expected = play(backend, 30)
    backend.restore(start)
    backend.apply(Difference(structure=larger))
    assert backend.structure == larger
    there = backend.read()
    assert all(np.array_equal(there[name], now[name]) for name in now)
    assert backend.parameters(heavy) == heavy
    backend.apply(Difference(structure=model, parameters=parameters, state=now))
    assert np.array_equal(play(backend, 30), expected)


# --- batches -----------------------------------------------------------------------------------


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", ["pile", "reacher", "pusher", "half_cheetah"])
def test_sixteen_together_are_sixteen_alone(name: str, threads: int) -> None:
    """With parameters of their own, changed in between, all do what they do alone, bit for bit."""
    model, count = described(name), 16
    alone, many = ([MujocoBackend() for _ in range(count)] for _ in range(2))
    rows = [row for row in model.parameters if not row.visual]
    scene = model.default_scene()
    for i, (one, other) in enumerate(zip(alone, many, strict=True)):
        row = rows[i * len(rows) // count]
        new = {row.key: other_value(row, scene.parameters[row.key])}
        for backend in (one, other):
            backend.build(scene.with_(parameters={**scene.parameters, **new}))
    batch = MujocoBackend.batch.of(many, threads)
    generator = np.random.default_rng(0)
    into = np.full((count, model.layout.size + 2), np.nan)
    for step in range(12):
        which = np.arange(count) if step % 3 else np.array([0, 3, 4, 15])
        commands = generator.uniform(-1.0, 1.0, (count, model.n_commands + 1))
        batch.step(which, commands, 1 + step % 2, into)
        for i in which.tolist():
            alone[i].step(commands[i, :-1], 1 + step % 2)
            assert np.array_equal(into[i, :-2], alone[i].read().vector)
        if step == 5:
            row = rows[-1]
            for backend in (alone[3], many[3]):
                value = backend.parameters([row.key])[row.key]
                state = backend.read()
                state.vector[:] += 0.01
                new = {row.key: other_value(row, value)}
                backend.apply(Difference(parameters=new, state=state))
        pairs = [[c.bodies for c in b.contacts()] for b in (alone[4], many[4])]
        assert pairs[0] == pairs[1]
    assert np.isnan(into[:, -2:]).all()
    assert all(one.read() == other.read() for one, other in zip(alone, many, strict=True))


def test_a_lost_state_in_a_batch_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """It says in which scene; the others went on, and MuJoCo neither prints nor writes a file."""
    monkeypatch.chdir(tmp_path)
    model = described("half_cheetah")
    many = [MujocoBackend() for _ in range(3)]
    for backend in many:
        backend.build(model.default_scene())
    state = many[1].read()
    state.vector[:] = np.inf
    many[1].apply(Difference(state=state))
    batch, into = MujocoBackend.batch.of(many, 2), np.zeros((3, model.layout.size))
    with pytest.raises(EngineFailure) as caught:
        batch.step(np.arange(3), np.zeros((3, 6)), 2, into)
    assert (caught.value.row, caught.value.lost) == (1, (1,))
    assert into[0].any()
    assert np.array_equal(into[0], into[2])
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


# --- failures ----------------------------------------------------------------------------------


def test_a_lost_state_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A state that is not finite is never returned; then a snapshot can be restored."""
    monkeypatch.chdir(tmp_path)
    backend = built("half_cheetah")
    start, state = backend.snapshot(), backend.read()
    expected = play(backend, 10)
    for place, value in ((0, np.inf), (-1, np.nan), (3, 1e200)):
        lost = state.copy()
        lost.vector[place] = value
        backend.apply(Difference(state=lost))
        with pytest.raises(EngineFailure, match="not finite"):
            play(backend, 10)
        backend.restore(start)
        assert np.array_equal(play(backend, 10), expected)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


CROWD = """
<mujoco>
  <size memory="{memory}"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body pos="0.5 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body pos="1 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("memory", ["4K", "8K", "12K", "16K"])
def test_too_little_memory_is_an_error(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Contacts are not left out silently; the backend can be used again afterwards."""
    monkeypatch.chdir(tmp_path)
    model, backend = read_model(CROWD.format(memory=memory)), MujocoBackend()
    for _ in range(2):
        backend.build(model.default_scene())
        with pytest.raises(EngineFailure, match="memory"):
            play(backend, 20)
    batch, into = MujocoBackend.batch.of([backend], 1), np.zeros((1, model.layout.size))
    backend.build(model.default_scene())
    with pytest.raises(EngineFailure, match="memory"):
        batch.step(np.arange(1), np.zeros((1, 0)), 20, into)
    enough = read_model(CROWD.format(memory="1M"))
    backend.build(enough.default_scene())
    assert np.isfinite(play(backend, 20)).all()
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_unknown_names_are_errors_that_list_names() -> None:
    """Parameters, bodies and modes that do not exist; without a scene there is nothing at all."""
    backend = built("pile")
    before = arrays(backend.realization.model)
    with pytest.raises(UnknownOption, match=r"did you mean 'box\.mass'"):
        backend.apply(
            Difference(parameters={("hand", "mass"): np.array(1.0), ("bix", "mass"): np.array(1.0)})
        )
    assert changed(before, arrays(backend.realization.model)) == []
    with pytest.raises(UnknownOption, match=r"no parameter is named 'foot.inertia'"):
        backend.parameters([("foot", "inertia")])
    with pytest.raises(EngineFailure, match=r"call build\(\) first"):
        MujocoBackend().step(np.zeros(2), 1)


# --- reading -----------------------------------------------------------------------------------


def test_moments_of_inertia_of_any_body() -> None:
    """They are those of MuJoCo, and follow an intervention."""
    backend = built("pile")
    edge = 0.2 * 0.2 * 8.0  # m / 6 a², of 8 kg
    np.testing.assert_allclose(
        backend.parameters([("box", "inertia")])["box", "inertia"],
        np.full(3, edge / 6.0),
        rtol=1e-12,
    )
    heavy = {("box", "inertia"): np.array([0.05, 0.06, 0.07])}
    backend.apply(Difference(parameters=heavy))
    assert np.array_equal(
        backend.parameters([("box", "inertia")])["box", "inertia"], heavy["box", "inertia"]
    )


def test_contacts_name_bodies_and_carry_the_weight() -> None:
    """A box at rest on the floor, whose body is the world."""
    text = "<mujoco><worldbody><geom type='plane' size='1 1 1'/><body name='box' pos='0 0 0.1'>"
    text += "<freejoint/><geom type='box' size='0.1 0.1 0.1' mass='2'/></body></worldbody></mujoco>"
    backend = MujocoBackend()
    backend.build(read_model(text).default_scene())
    assert backend.contacts() == ()
    play(backend, 200)
    contacts = backend.contacts()
    assert {contact.bodies for contact in contacts} == {("world", "box")}
    assert sum(contact.force for contact in contacts) == pytest.approx(2.0 * 9.81, rel=1e-3)


BOUNCE = """
<mujoco>
  <option timestep="0.1" integrator="RK4"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="ball" pos="0 0 {height}"><freejoint/><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""


def test_a_model_says_that_it_touches_in_stages() -> None:
    """A ball that meets the floor in an early stage of RK4 alone has moved, without a contact."""
    model, backend = read_model(BOUNCE.format(height=0.11)), MujocoBackend()
    assert model.staged
    assert any("RK4 looks for contacts in four stages" in note for note in model.notes)
    scene = model.default_scene()
    scene.state["ball.linear_velocity"][2] = -0.3
    backend.build(scene)
    free = scene.state["ball.cartesian_position"][2] - 0.03 - 0.5 * 9.81 * 0.1**2
    backend.step(np.zeros(0), 1)
    assert abs(backend.read()["ball.cartesian_position"][2] - free) > 1e-3
    assert backend.contacts() == ()
    for other in (BOUNCE.replace("RK4", "Euler"), BOUNCE.replace("<geom", "<geom contype='0'")):
        assert not read_model(other.format(height=0.11)).staged


def test_what_touches_in_stages_is_not_recorded() -> None:
    """A table of contacts would lack some: none is collected, and any edge by contact may act."""
    ball = '<body name="{}" pos="0 0 {}"><freejoint/><geom size="0.1"/></body>'
    balls = ball.format("low", 0.2) + ball.format("high", 0.5)
    world = World(f'<mujoco><option integrator="RK4"/><worldbody>{balls}</worldbody></mujoco>')
    with pytest.raises(ModelError, match="any edge may act"):
        collect(world, Design(), 1, steps=2, contacts=True)
    assert any(edge.when == "contact" for edge in world.model.edges)
