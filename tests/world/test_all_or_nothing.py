"""Facts about copies of what is in a world, and about going back: all of it, or nothing."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds import PUSHING, REST, begin, play, same

from scm_world.env import ScmWorldEnv
from scm_world.errors import SnapshotMismatch, WrongType
from scm_world.tasks import ModelTask, StepTask
from scm_world.variables import Exogenous, Measured, Mechanism
from scm_world.world import World


def test_the_log_keeps_what_was_asked_for() -> None:
    """A buffer that the caller uses again, and writing into the log, change no recording."""
    env = ScmWorldEnv("pushing", backend="fake")
    buffer, spare = np.array([0.06, 0.06, 0.06]), [0.0, 0.0, -5.0]
    env.reset(seed=0, options={"do": {"block.size": buffer}})
    audit = env.do({"gravity": spare})
    buffer[:], spare[2] = 0.07, 1.0
    env.interventions[0][1]["block.size"][:] = 0.08
    assert [step for step, _ in env.interventions] == [0, 0]
    np.testing.assert_array_equal(env.interventions[0][1]["block.size"], 0.06)
    assert env.interventions[1][1]["gravity"] == [0.0, 0.0, -5.0]
    assert audit.targets["gravity"].requested == [0.0, 0.0, -5.0]


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_what_a_world_hands_out_can_be_written_into(backend: str, task: str) -> None:
    """Audits, scenes and snapshots are copies: the world and its future stay as they are."""
    world = begin(backend, task)
    audit = world.do({"block.size": [0.06, 0.06, 0.06]})
    snapshot, values = world.snapshot(), world.values()
    scene = world.scene()
    changed = [value for pair in audit.followed.values() for value in pair]
    changed += [*scene.parameters.values(), *snapshot.static.values(), scene.state.vector]
    for entry in audit.targets.values():
        changed += [v for v in (entry.applied, entry.read_back) if v is not None]
    for value in changed:
        np.multiply(value, 3, out=value)
    assert same(world.values(), values)
    play(world, [REST] * 2)
    world.restore(snapshot)
    assert same(world.values(), values)


def _grow(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    return {"x": state["x"] + parameters["rate"]}


def _growing(default: float) -> World:
    rate = Exogenous(name="rate", default=default)
    x = Measured(name="x", settable_state=True, default=0.0, parents=("rate",))
    return World(StepTask(_grow, parameters=[rate], states=[x], control_dt=0.1))


_POLE = (
    "<mujoco model='pole'><worldbody><body name='pole'><joint name='hinge' axis='0 1 0'/><geom "
    "type='capsule' size='{}' fromto='0 0 0 0 0 1'/></body></worldbody></mujoco>"
)


def test_a_snapshot_of_other_arguments_is_refused() -> None:
    """Tasks of one name with other arguments, or of another model, are not the same world."""
    pairs = [(_growing(0.1), _growing(0.2))]
    pairs.append((World(ModelTask(_POLE.format(0.02))), World(ModelTask(_POLE.format(0.03)))))
    for first, second in pairs:
        first.reset(seed=0)
        second.reset(seed=1)
        values = second.values()
        with pytest.raises(SnapshotMismatch, match="other arguments"):
            second.restore(first.snapshot())
        assert same(second.values(), values)


@pytest.mark.parametrize(("backend", "task"), PUSHING)
def test_a_damaged_snapshot_leaves_the_world_as_it_was(backend: str, task: str) -> None:
    """Whatever part of it is wrong, the world goes on bit for bit."""
    world = begin(backend, task)
    world.do({"tool_block.mass": 0.1})
    good = world.snapshot()
    play(world, [REST] * 2)
    there, values = world.snapshot(), world.values()
    future = play(world, [REST] * 5)
    world.restore(there)
    other = {**good.kept, "tool_block.mass": np.zeros(2)}
    few = {name: value for name, value in good.kept.items() if name != "tool_block.mass"}
    assert good.base is not None
    damaged = [
        replace(good, **field)
        for field in (
            {"kept": other},
            {"kept": few},
            {"previous": {}},
            {"action": np.zeros(2)},
            {"index": -1},
            {"plan": None},
            {"engine": b"no pickle"},
            {"engine": None},
            {"engine": replace(good.engine, payload=None)},
            {"engine": replace(good.engine, engine="another engine")},
            {"base": replace(good.base, kept=few)},
            {"base": replace(good.base, vector=np.zeros(2))},
        )
    ]
    for snapshot in damaged:
        with pytest.raises(SnapshotMismatch):
            world.restore(snapshot)
        assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, [REST] * 5), future)


def test_a_pickled_snapshot_has_a_checksum() -> None:
    """A number that was changed in the file is noticed."""
    world = begin("fake", "pushing")
    written = pickle.dumps(world.snapshot())
    number = world.snapshot().static["gravity"].tobytes()
    assert number in written
    with pytest.raises(SnapshotMismatch, match="checksum"):
        pickle.loads(  # noqa: S301 # our own
            written.replace(number, np.array([0.0, 0.0, -1.0]).tobytes())
        )


def test_masked_arrays_are_refused() -> None:
    """What lies under a mask is not applied."""
    world = begin("fake", "pushing")
    with pytest.raises(WrongType):
        world.do({"gravity": np.ma.masked_array([0.0, 0.0, -5.0], mask=[0, 0, 1])})


@pytest.mark.parametrize("given", [np.array([1j, 0.5, 0.5]), np.array([True] * 3), "red", None])
def test_mechanisms_give_numbers(given: Any) -> None:
    """What a mechanism of a user gives is checked like a value, and named."""
    world = begin("fake", "pushing")
    values = world.values()
    with pytest.raises(WrongType, match="floor_color"):
        world.do({"floor_color": Mechanism(lambda friction: given, ["floor_friction"])})
    assert same(world.values(), values)
