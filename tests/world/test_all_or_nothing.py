"""Facts about copies of what is in a world, and about going back: all of it, or nothing."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
from worlds import PUSHING, REST, begin, play, same

from scm_world.backends import make_backend
from scm_world.backends.base import BackendWrapper
from scm_world.env import ScmWorldEnv
from scm_world.errors import (
    EngineFailure,
    FunctionFailure,
    InterventionError,
    SeveralProblems,
    SnapshotMismatch,
    WrongValue,
)
from scm_world.tasks import ModelTask, StepTask
from scm_world.variables import Exogenous, Measured, Mechanism
from scm_world.world import Simulation


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
    """Audits and scenes are copies: the world and its future stay as they are."""
    world = begin(backend, task)
    audit = world.do({"block.size": [0.06, 0.06, 0.06]})
    snapshot, values = world.snapshot(), world.values()
    scene = world.scene()
    changed = [value for pair in audit.followed.values() for value in pair]
    changed += [*scene.parameters.values(), scene.state.vector]
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


def _shrink(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    return {"x": state["x"] - parameters["rate"]}


def _scaled(factor: float) -> Any:
    def move(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        return {"x": _grow(parameters, state, action, noise)["x"] * factor}

    return move


def _growing(default: float, step: Any = _grow) -> Simulation:
    rate = Exogenous(name="rate", default=default)
    x = Measured(name="x", settable_state=True, default=0.0, parents=("rate",))
    return Simulation(StepTask(step, name="grow", parameters=[rate], states=[x], control_dt=0.1))


_POLE = (
    "<mujoco model='pole'><worldbody><body name='pole'><joint name='hinge' axis='0 1 0'/><geom "
    "type='capsule' size='{}' fromto='0 0 0 0 0 1'/></body></worldbody></mujoco>"
)


def test_a_snapshot_of_other_arguments_is_refused() -> None:
    """Tasks of one name with other arguments, model or step function are not the same world."""
    pairs = [(_growing(0.1), _growing(0.2))]
    pairs.append((_growing(0.1), _growing(0.1, _shrink)))
    pairs.append((_growing(0.1, _scaled(1.0)), _growing(0.1, _scaled(2.0))))
    pairs.append(
        (Simulation(ModelTask(_POLE.format(0.02))), Simulation(ModelTask(_POLE.format(0.03))))
    )
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
    good = pickle.loads(pickle.dumps(world.snapshot()))  # noqa: S301 # our own
    play(world, [REST] * 2)
    there, values = world.snapshot(), world.values()
    future = play(world, [REST] * 5)
    world.restore(there)
    changes: list[dict[str, Any]] = [
        {"world": ()},
        *({"content": content} for content in (b"no pickle", good.content[:-20])),
        *({"content": pickle.dumps(content)} for content in (None, "x", values)),
    ]
    engine = replace(there.engine, engine="another engine") if there.engine else None
    damaged: list[Any] = [replace(good, **change) for change in changes]
    damaged += [replace(there, engine=engine), replace(there, engine=None)]
    damaged.append(pickle.loads(pickle.dumps(damaged[-2])))  # noqa: S301 # our own
    for snapshot in damaged:
        with pytest.raises(SnapshotMismatch):
            world.restore(snapshot)
        assert same(world.values(), values)
    np.testing.assert_array_equal(play(world, [REST] * 5), future)


class _Failing(BackendWrapper):
    """Fails once, in the middle of going to a snapshot."""

    name: ClassVar[str] = "failing"
    fails: type[BaseException] | None = None

    def restore(self, snapshot: Any) -> None:
        super().restore(snapshot)
        error, self.fails = self.fails, None
        if error is not None:
            raise error("no luck")


def test_a_world_that_was_left_between_two_instants_says_so() -> None:
    """Where an engine fails on the way to a snapshot, the world is lost until the next one."""
    backend = _Failing(make_backend("fake"))
    world = Simulation("pushing", backend=backend)
    world.reset(seed=0)
    start, values = world.snapshot(), world.values()
    world.step(REST)
    backend.fails = KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt):
        world.restore(start)
    for goes_on in (lambda: world.step(REST), world.snapshot, lambda: world.do({})):
        with pytest.raises(EngineFailure, match="restored in part"):
            goes_on()
    world.restore(start)
    assert same(world.values(), values)
    world.step(REST)


def test_masked_arrays_are_refused() -> None:
    """What lies under a mask is not applied."""
    world = begin("fake", "pushing")
    with pytest.raises(WrongValue):
        world.do({"gravity": np.ma.masked_array([0.0, 0.0, -5.0], mask=[0, 0, 1])})


@pytest.mark.parametrize("given", [np.array([1j, 0.5, 0.5]), np.array([True] * 3), "red", None])
def test_mechanisms_give_numbers(given: Any) -> None:
    """What a mechanism of a user gives is checked like a value, and named."""
    world = begin("fake", "pushing")
    values = world.values()
    with pytest.raises(WrongValue, match="floor_color"):
        world.do({"floor_color": Mechanism(lambda friction: given, ["floor_friction"])})
    assert same(world.values(), values)
    with pytest.raises(FunctionFailure, match="function of 'floor_color' raised ZeroDivisionError"):
        world.do({"floor_color": Mechanism(lambda friction: 1 / 0, ["floor_friction"])})
    assert same(world.values(), values)


@pytest.mark.parametrize("given", [np.zeros(8), np.zeros((2, 9)), np.full(9, np.nan), "x", None])
@pytest.mark.parametrize("resolution", ["vector", "joint"])
def test_mechanisms_of_actions_give_actions(given: Any, resolution: str) -> None:
    """What would fail at every step is refused, with the other problems of the request."""
    world = Simulation("pushing", backend="fake", resolution=resolution)
    world.reset(seed=0)
    wrong = Mechanism(lambda joints: given, ["joint_positions"])
    with pytest.raises(SeveralProblems, match=r"(?s)2 problems(?=.*do\(action\)).*do\(gravity\)"):
        world.do({"action": wrong, "gravity": [0.0, 0.0, 1e9]})
    fails = Mechanism(lambda joints: joints[11], ["joint_positions"])
    with pytest.raises(InterventionError, match="raised IndexError"):
        world.do({"action": fails})
    world.do({"action": Mechanism(lambda joints: 0.9 * joints, ["joint_positions"])})
    world.step(REST)
