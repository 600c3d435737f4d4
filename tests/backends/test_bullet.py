"""Facts about canonical states, snapshots and failures in the Bullet backend alone.

What engines have in common is in the conformance suite.
"""

from __future__ import annotations

import importlib.util
import pickle
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from robot_scenes import busy_scene, changed_states, other_value, play

from scm_world._types import Floats
from scm_world.backends.base import Backend
from scm_world.backends.bullet import BulletBackend
from scm_world.errors import EngineFailure, SnapshotMismatch
from scm_world.models import Difference, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import inverse
from scm_world.tasks.trifinger.system import trifinger

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)

LONG = 250  # control steps


class Watched:
    """The engine, with its calls counted, one of which can be made to fail."""

    def __init__(self, engine: Any) -> None:
        self.engine = engine
        self.calls: Counter[str] = Counter()
        self.fatal = ("", 0)

    def fail(self, name: str, call: int) -> None:
        """Let the ``call``-th call of a function from now on fail, once."""
        self.fatal = (name, self.calls[name] + call)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.engine, name)
        return self.watch(name, value) if callable(value) and name != "error" else value

    def watch(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Count the calls of a function."""

        def watched(*arguments: Any, **named: Any) -> Any:
            self.calls[name] += 1
            if (name, self.calls[name]) == self.fatal:
                raise self.engine.error("this call was made to fail")
            return function(*arguments, **named)

        return watched


def watch(backend: BulletBackend) -> Watched:
    """Watch all engine calls of a backend that has no scene yet."""
    watched = Watched(backend._engine)
    backend._engine = watched
    return watched


@pytest.fixture
def backend() -> Iterator[BulletBackend]:
    """Provide a backend without a scene."""
    backend = BulletBackend()
    yield backend
    backend.close()


def fresh(scene: Scene, after: Callable[[Backend], Floats]) -> Floats:
    """Do something with a scene in a backend that has seen nothing else."""
    backend = BulletBackend()
    backend.build(scene)
    result = after(backend)
    backend.close()
    return result


# --- canonical states -----------------------------------------------------------------------------


def reach(radius: float, z: float) -> Floats:
    """Find joint positions that bring all tips to a circle [m]."""
    angles = np.deg2rad([110.0, -10.0, -130.0])  # where the fingers hang
    points = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(3, z)], axis=1)
    return inverse(points.ravel(), hardware.NOMINAL_HEIGHT, hardware.REST).joint_positions


TOUCHES = {
    "floor": reach(0.08, -0.05),
    "link": reach(0.0, 0.1),
    "stage": reach(0.27, 0.1),
    "block": reach(0.02, 0.03),
}
"""Commands that press the fingers on something: the floor, each other, the wall, a block."""


@pytest.mark.parametrize("touching", TOUCHES)
@pytest.mark.parametrize("way", ["build", "apply", "remake"])
def test_a_canonical_world_equals_a_new_one(
    backend: BulletBackend, touching: str, way: str
) -> None:
    """Whatever the fingers touched before, setting a state gives the bits of a new world."""
    blocks, command = ("block",) if touching == "block" else (), TOUCHES[touching]
    scene = trifinger(blocks).default_scene()
    backend.build(scene)
    backend.step(command, 400)
    assert fingers_touch(backend, touching)
    target = scene.with_(state=backend.read())  # in the very contact that must be forgotten

    if way == "remake":
        backend.build(trifinger(("other", "another")).default_scene())
        play(backend, 1)
    if way == "apply":
        backend.step(command, 1)
        backend.apply(Difference(state=target.state))
    else:
        backend.build(target)

    hold = held(command)
    np.testing.assert_array_equal(hold(backend), fresh(target, hold))


def fingers_touch(backend: Backend, what: str) -> bool:
    """Tell whether a finger touches something of this name."""
    pairs = [contact.bodies for contact in backend.contacts()]
    robot = [pair for pair in pairs if any("finger" in name for name in pair)]
    if what == "link":
        return any("finger" in first and "finger" in second for first, second in robot)
    return any(what in name for pair in robot for name in pair)


def held(command: Floats) -> Callable[[Backend], Floats]:
    """Hold a command, then move at random; return all states."""

    def go(backend: Backend) -> Floats:
        rows = []
        for _ in range(20):
            backend.step(command, 10)
            rows.append(backend.read().vector)
        return np.concatenate([np.array(rows), play(backend, 20)])

    return go


def test_sizes_there_and_back_leave_no_trace_for_long(backend: BulletBackend) -> None:
    """A block that is resized in mid-episode and put back has the exact same future."""
    scene = busy_scene()
    backend.build(scene)
    play(backend, 30)
    start = backend.snapshot()
    expected = play(backend, LONG, seed=7)
    assert backend.contacts()
    backend.restore(start)

    state = backend.read()
    for key in (("near", "size"), ("robot", "height"), ("falling", "mass")):
        value = scene.parameters[key]
        backend.apply(Difference(parameters={key: other_value(key, value)}))
    for _, changed in changed_states(state):
        backend.apply(Difference(state=changed))
    backend.apply(Difference(parameters=scene.parameters))
    backend.apply(Difference(state=state))

    assert float(np.abs(play(backend, LONG, seed=7) - expected).max()) == 0.0


# --- snapshots ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("quantity", "steps"),
    [
        ("", LONG),
        *((name, 80) for name in ("friction", "mass", "restitution", "joint_damping")),
    ],
)
def test_replay_and_saved_state_agree_for_long(
    backend: BulletBackend, quantity: str, steps: int
) -> None:
    """A long episode goes on alike from the engine's memory and from its past, changed or not."""
    watched, scene = watch(backend), busy_scene()
    backend.build(scene)
    play(backend, 40)
    light = {k: other_value(k, v) for k, v in scene.parameters.items() if k[1] == quantity}
    backend.apply(Difference(parameters=light))
    snapshot = backend.snapshot()
    expected = play(backend, steps, seed=7)

    calls = watched.calls["stepSimulation"]
    backend.restore(snapshot)
    assert watched.calls["stepSimulation"] == calls
    np.testing.assert_array_equal(play(backend, steps, seed=7), expected)
    backend.restore(pickle.loads(pickle.dumps(snapshot)))  # noqa: S301
    np.testing.assert_array_equal(play(backend, steps, seed=7), expected)


def test_a_saved_state_brings_its_parameters(backend: BulletBackend) -> None:
    """The engine's memory has no parameters; the adapter brings them back."""
    scene = busy_scene()
    backend.build(scene)
    play(backend, 40)
    snapshot, keys = backend.snapshot(), tuple(scene.parameters)
    before = backend.parameters(keys)
    expected = play(backend, 5)
    light = {key: other_value(key, scene.parameters[key]) for key in keys if key[1] == "mass"}
    backend.apply(Difference(parameters=light))
    play(backend, 1)

    backend.restore(snapshot)
    assert all(np.array_equal(backend.parameters([key])[key], before[key]) for key in keys)
    np.testing.assert_array_equal(play(backend, 5), expected)


def test_forgotten_snapshots_are_freed(backend: BulletBackend) -> None:
    """The engine drops its memory of a snapshot that nobody holds, and of a past world."""
    watched = watch(backend)
    backend.build(busy_scene())
    play(backend, 40)
    for _ in range(5):
        backend.snapshot()
        play(backend, 1)
    assert watched.calls["saveState"] == 5
    assert watched.calls["removeState"] == 4
    kept = backend.snapshot()
    backend.build(busy_scene())
    backend.build(busy_scene())
    assert watched.calls["removeState"] == watched.calls["saveState"]
    assert kept.payload.saved is not None
    backend.restore(kept)


def test_a_new_episode_forgets_the_last(backend: BulletBackend) -> None:
    """After ``build`` a snapshot does not carry the commands of earlier episodes."""
    scene = busy_scene()
    backend.build(scene)
    size = len(pickle.dumps(backend.snapshot()))
    play(backend, 50)
    assert len(pickle.dumps(backend.snapshot())) > size + 50 * 80
    backend.build(scene)
    assert len(pickle.dumps(backend.snapshot())) == size


def test_a_snapshot_does_not_grow(backend: BulletBackend) -> None:
    """What happens after a snapshot is no part of it, though both share their memory."""
    backend.build(busy_scene())
    play(backend, 3)
    snapshot = backend.snapshot()
    bytes_ = pickle.dumps(snapshot)
    backend.apply(Difference(parameters={("near", "mass"): np.array(0.05)}))
    play(backend, 3)
    assert pickle.dumps(snapshot) == bytes_


def test_a_snapshot_of_another_version_is_refused(backend: BulletBackend) -> None:
    """Bits are promised within one version of the engine."""
    backend.build(busy_scene())
    snapshot = backend.snapshot()
    backend.version = "0"
    with pytest.raises(SnapshotMismatch, match="cannot be restored by bullet 0"):
        backend.restore(snapshot)


# --- the engine is asked once and told once -------------------------------------------------------


def test_one_query_and_one_torque_call_per_physics_step(backend: BulletBackend) -> None:
    """A physics step costs three engine calls; the state is read once after the last one."""
    watched, scene = watch(backend), busy_scene()
    backend.build(scene)
    watched.calls.clear()
    backend.step(np.zeros(9), 10)
    n_blocks = len(scene.structure.blocks)
    assert watched.calls == {
        "getJointStates": 11,
        "setJointMotorControlArray": 10,
        "stepSimulation": 10,
        "getBasePositionAndOrientation": n_blocks,
        "getBaseVelocity": n_blocks,
    }


# --- failures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("begun", [False, True], ids=["from the last step", "from a change"])
@pytest.mark.parametrize(
    "call",
    [
        ("changeDynamics", 3),
        ("createMultiBody", 2),
        ("removeBody", 1),
        ("resetJointState", 5),
        ("setCollisionFilterGroupMask", 4),
        ("resetBaseVelocity", 2),
    ],
)
def test_a_change_that_fails_changes_nothing(
    backend: BulletBackend, call: tuple[str, int], begun: bool
) -> None:
    """If any engine call of a change fails, the world is as it was, bit for bit."""
    scene = busy_scene()
    watched = watch(backend)
    backend.build(scene)
    play(backend, 5)
    resize(backend, 0.9)  # so that the other client has blocks to remove
    if not begun:
        play(backend, 1)
        resize(backend, 1.0)
        play(backend, 1)
    state, keys = backend.read(), tuple(scene.parameters)
    parameters, snapshot = backend.parameters(keys), backend.snapshot()

    other = {key: other_value(key, scene.parameters[key]) for key in keys}
    *_, (_, changed) = changed_states(state)
    watched.fail(*call)
    with pytest.raises(EngineFailure, match="made to fail"):
        backend.apply(Difference(parameters=other, state=changed))

    assert backend.read() == state
    now = backend.parameters(keys)
    assert all(np.array_equal(now[key], parameters[key]) for key in keys)
    after = play(backend, 10)
    backend.restore(snapshot)
    np.testing.assert_array_equal(play(backend, 10), after)


def resize(backend: Backend, scale: float) -> None:
    """Give all blocks another size."""
    sizes = {(name, "size"): np.full(3, 0.065 * scale) for name in ("near", "falling", "sliding")}
    backend.apply(Difference(parameters=sizes))


def test_a_light_change_that_fails_changes_nothing(backend: BulletBackend) -> None:
    """A change of masses and frictions that stops half way is taken back."""
    watched = watch(backend)
    scene = busy_scene()
    backend.build(scene)
    play(backend, 5)
    snapshot = backend.snapshot()
    expected = play(backend, 10)
    backend.restore(snapshot)
    keys = tuple(scene.parameters)
    light = {k: other_value(k, scene.parameters[k]) for k in keys if k[1] in ("mass", "friction")}
    watched.fail("changeDynamics", 9)
    with pytest.raises(EngineFailure):
        backend.apply(Difference(parameters=light))
    np.testing.assert_array_equal(play(backend, 10), expected)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_must_be_finite(backend: BulletBackend, value: float) -> None:
    """NaN and infinity never reach the engine."""
    backend.build(busy_scene())
    state = backend.read()
    with pytest.raises(EngineFailure, match=r"near\.mass must be finite"):
        backend.apply(Difference(parameters={("near", "mass"): np.array(value)}))
    moved = state.copy()
    moved.joint_velocities[3] = value
    with pytest.raises(EngineFailure, match="a state must be finite"):
        backend.apply(Difference(state=moved))
    assert backend.read() == state


def test_a_step_that_fails_did_not_happen(backend: BulletBackend) -> None:
    """When the engine fails amid a step, the world is the one before the step."""
    watched = watch(backend)
    backend.build(busy_scene())
    play(backend, 5)
    state = backend.read()
    watched.fail("stepSimulation", 4)
    with pytest.raises(EngineFailure, match="could not step"):
        play(backend, 1)
    assert backend.read() == state
