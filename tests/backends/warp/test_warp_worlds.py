"""Worlds on Warp's CPU device: what is read back, memory that grows, worlds that are lost."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco_warp")

from warp._src.logger import get_logger, log_warning

import scm_world as sw
from scm_world.backends import make_backend, read_model
from scm_world.backends.warp import WarpBackend
from scm_world.backends.warp.device import quiet
from scm_world.errors import EngineFailure, ModelError, UnknownOption
from scm_world.testing.backend import MODEL

N = 3


@pytest.fixture
def worlds() -> Iterator[Any]:
    """Provide a few worlds in the middle of an episode."""
    many = sw.World(MODEL, backend="warp", device="cpu", num_worlds=N)
    many.reset(seed=0)
    many.step(np.zeros((N, 2)))
    yield many
    many.close()


def _group(many: Any) -> Any:
    """Return the scenes of the only structure."""
    return many._engine._at(0)[0]


def test_a_device_is_part_of_the_name() -> None:
    """It travels with the name of the backend; engines without devices refuse it."""
    world = sw.World(MODEL, backend="warp", device="cpu")
    assert world.backend.name == world.made_with["backend"] == "warp:cpu"
    assert make_backend("warp:cpu").capabilities.floor == 0.0
    with pytest.raises(UnknownOption, match="left out"):
        make_backend("mujoco:cpu")
    with pytest.raises(UnknownOption, match="left out"):
        sw.World(MODEL, device="cpu")
    with pytest.raises(UnknownOption, match="device"):
        make_backend("warp:nowhere")
    with pytest.raises(UnknownOption, match="device"):
        sw.World(MODEL, backend=WarpBackend("cpu"), device="cpu")


def test_each_world_has_its_own_constants(worlds: Any) -> None:
    """All arrays that follow from a mass are those of C, in the row of its world."""
    masses = np.array([0.1, 0.4, 0.9])
    audits = worlds.do({"crate.mass": masses})
    assert [audit.targets["crate.mass"].read_back for audit in audits.values()] == masses.tolist()
    group, mujoco = _group(worlds), sw.World(MODEL)
    mujoco.reset(seed=0)
    engine = group.synced()
    for row, mass in enumerate(masses.tolist()):
        mujoco.do({"crate.mass": mass})
        model = mujoco.backend.realization.model
        for name in ("body_mass", "body_inertia", "body_invweight0", "dof_invweight0"):
            device = engine.field(name).array.numpy()[row].ravel()
            assert np.array_equal(device, getattr(model, name).astype(np.float32).ravel()), name


def test_what_is_read_back_is_on_the_device(worlds: Any) -> None:
    """A number that the device lost is not reported as if it were there."""
    worlds.do({"crate.mass": [0.1, 0.4, 0.9]})
    key = [("crate", "mass")]
    found = worlds._engine.parameters(np.arange(N), key)[key[0]]
    assert found.tolist() == [0.1, 0.4, 0.9]
    _group(worlds)._engine.field("body_mass").host[1] += 0.01
    with pytest.raises(EngineFailure, match="body_mass"):
        worlds._engine.parameters(np.arange(N), key)


def test_a_state_on_the_device(worlds: Any) -> None:
    """It is a view: what a step makes of it is there without a copy, and what ``do`` set."""
    name = "falling.cartesian_position"
    tensor = np.from_dlpack(worlds.tensor(name))
    assert tensor.shape == (N, 3)
    assert tensor.dtype == np.float32
    np.testing.assert_array_equal(tensor, worlds[name].astype(np.float32))
    worlds.step(np.zeros((N, 2)), where=np.array([True, False, True]))
    np.testing.assert_array_equal(tensor, worlds[name].astype(np.float32))
    worlds.do({"elbow.position": [0.1, 0.2, 0.3]})
    assert worlds.tensor("elbow.position").tolist() == [[np.float32(x)] for x in (0.1, 0.2, 0.3)]
    assert worlds.world(1).tensor("elbow.position").tolist() == [np.float32(0.2)]
    with pytest.raises(EngineFailure, match="not a state"):
        worlds.tensor("falling.orientation")
    with sw.World(MODEL, num_worlds=2) as others:
        others.reset(seed=0)
        with pytest.raises(EngineFailure, match="device"):
            others.tensor(name)


def test_memory_grows_without_a_trace(worlds: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a step needs more memory it is taken again, and gives the same bits."""
    usual = sw.World(MODEL, backend="warp:cpu", num_worlds=N)
    usual.reset(seed=0)
    usual.step(np.zeros((N, 2)))
    group = _group(worlds)
    group._engine._sizes = 1, 1
    group._engine._allocate()
    for _ in range(5):
        for each in (worlds, usual):
            each.step(np.zeros((N, 2)))
    assert min(group._engine._sizes) > 1
    for name, values in usual.values().items():
        assert np.array_equal(worlds[name], values), name
    contacts = [[c.bodies for c in w.world(1).backend.contacts()] for w in (worlds, usual)]
    assert contacts[0] == contacts[1]
    assert contacts[0]


def test_a_world_that_needs_too_much_is_lost_alone(
    worlds: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is named; the others go on."""
    monkeypatch.setattr("scm_world.backends.warp.device.MOST_ROWS", 12)
    group = _group(worlds)
    group._engine._sizes = 16, 8
    group._engine._allocate()
    usual = sw.World(MODEL, backend="warp:cpu", num_worlds=N)
    usual.reset(seed=0)
    usual.step(np.zeros((N, 2)))
    for each in (worlds, usual):  # two worlds without most of the contacts
        where = np.array([True, False, True])
        each.do({"crate.cartesian_position": [0.0, 0.0, 1.0]}, where=where)
        each.do({"falling.cartesian_position": [1.0, 0.0, 1.0]}, where=where)
        each.do({"apart.cartesian_position": [2.0, 0.0, 1.0]}, where=where)
    with pytest.raises(EngineFailure, match=r"world 1: .*memory") as failed:
        worlds.step(np.zeros((N, 2)))
    assert failed.value.lost == (1,)
    usual.step(np.zeros((N, 2)))
    for row in (0, 2):
        name = "falling.cartesian_position"
        assert np.array_equal(worlds.world(row)[name], usual.world(row)[name])
    worlds.reset(seed=0, where=np.array([False, True, False]))


def test_all_refusals_at_once() -> None:
    """Before anything is compiled, with what to do instead."""
    text = """
      <mujoco><option solver="PGS" integrator="discrete" noslip_iterations="3" jacobian="dense"/>
      <worldbody>{}</worldbody></mujoco>
    """
    body = "<body name='b{0}' pos='{0} 0 1'><freejoint/><geom size='.1'/></body>"
    model = read_model(text.format("".join(body.format(i) for i in range(11))), exact=False)
    with pytest.raises(ModelError) as refused:
        make_backend("warp:cpu").build(model.default_scene())
    for what in ("mjSOL_PGS", "noslip", "dense Jacobian of 66"):
        assert what in str(refused.value)


def test_what_was_zero_everywhere_is_computed_where_it_is_not() -> None:
    """A medium that the model lacks acts in the scene that has one, and nowhere else."""
    model = read_model(MODEL, expose=("density",))
    scenes = WarpBackend("cpu").batch(3, 1)
    plain = WarpBackend("cpu")
    scenes.build(np.arange(3), model.default_scene())
    plain.build(model.default_scene())
    scenes.apply(np.array([1]), {("", "density"): np.array([800.0])})
    into = np.zeros((3, model.layout.size))
    for _ in range(4):
        scenes.step(np.arange(3), np.zeros((3, 2)), 5, into)
        plain.step(np.zeros(2), 5)
    alone, at = plain.read().vector, model.layout.slices["elbow.velocity"]
    assert np.array_equal(into[[0, 2]], [alone, alone])
    assert np.abs(into[1, at] - alone[at]).max() > 1e-3


def test_undo_is_exact(worlds: Any) -> None:
    """Set and set back, parameters and states: the same bits as if nothing had been done."""
    plain = sw.World(MODEL, backend="warp:cpu", num_worlds=N)
    plain.reset(seed=0)
    plain.step(np.zeros((N, 2)))
    names = "crate.mass", "gravity", "falling.orientation", "crate.angular_velocity"
    before = {name: worlds[name] for name in names}
    worlds.do({"crate.mass": [0.1, 0.2, 0.3], "gravity": [0.0, 0.1, -3.0]})
    worlds.do(
        {"falling.orientation": [0.0, 0.6, 0.0, 0.8], "crate.angular_velocity": [1.0, 2.0, 3.0]}
    )
    worlds.do(before)
    for _ in range(20):
        for each in (worlds, plain):
            each.step(np.zeros((N, 2)))
    for name, values in plain.values().items():
        assert np.array_equal(worlds[name], values), name


def test_a_warning_of_warp_while_it_compiles_stops_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Warp gives a category and a level of the stack with it; kernels are counted."""
    with quiet("cpu", compiles=True):
        log_warning("a kernel is large", category=UserWarning)
        for _ in range(11):
            get_logger().info("Module x load on device 'cpu' took 1 ms (compiled)")
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("mujoco-warp compiles kernels for 'cpu'; they are kept in ")
    assert [line.split()[0] for line in said[1:]] == ["1", "11", "11"]
