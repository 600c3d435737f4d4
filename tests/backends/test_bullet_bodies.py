"""Facts about obstacles, hulls and contact parameters in the Bullet backend alone."""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import pytest
from robot_scenes import box_hull, busy_scene, named, octahedron, other_value, play

from scm_world._types import ArrayLike, Floats
from scm_world.backends.base import Backend
from scm_world.backends.bullet import BulletBackend
from scm_world.backends.mujoco.reading import compiled
from scm_world.errors import EngineFailure
from scm_world.geometry.hulls import Hull
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix
from scm_world.models import Difference, Scene
from scm_world.models.scene import ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.system import PhysicalState, trifinger

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="needs pybullet"
)

FAR_UP = {("robot", "height"): np.array(1.5)}  # [m] where the robot touches nothing
WALL = named("wall", {"size": [0.5, 0.015, 0.065], "position": [0.0, 0.0, 0.0325]})
HALF = 0.0325  # [m] of the default cube


@pytest.fixture
def backend() -> Iterator[BulletBackend]:
    """Provide a backend without a scene."""
    backend = BulletBackend()
    yield backend
    backend.close()


def rest(backend: Backend, substeps: int) -> None:
    """Hold the rest pose."""
    backend.step(np.array(hardware.REST), substeps)


def fresh(scene: Scene, after: Callable[[Backend], Floats]) -> Floats:
    """Do something with a scene in a backend that has seen nothing else."""
    backend = BulletBackend()
    backend.build(scene)
    result = after(backend)
    backend.close()
    return result


# --- obstacles ------------------------------------------------------------------------------------


def leaning(**wall: ArrayLike) -> Scene:
    """Pull a block sideways against a wall."""
    scene = trifinger(("block",), obstacles=("wall",)).default_scene()
    scene.state.positions[0] = [0.0, 0.06, HALF]
    tilt = {("world", "gravity"): np.array([0.0, -8.0, -9.81])}
    return scene.with_(
        parameters={**scene.parameters, **FAR_UP, **tilt, **WALL, **named("wall", wall)}
    )


def test_an_obstacle_holds_a_block(backend: BulletBackend) -> None:
    """A block that is pulled against a wall comes to rest on its face and touches it."""
    backend.build(leaning())
    rest(backend, 400)
    assert backend.read().positions[0, 1] == pytest.approx(0.0075 + HALF, abs=1e-4)
    assert {frozenset(contact.bodies) for contact in backend.contacts()} == {
        frozenset(("block", "floor")),
        frozenset(("block", "wall")),
    }
    turned = from_rotation_vector([0.0, 0.0, np.pi / 2])
    aside = [0.2, 0.0, HALF]  # the wall is long: it must be turned, too
    backend.apply(Difference(parameters=named("wall", {"orientation": turned, "position": aside})))
    rest(backend, 100)
    assert backend.read().positions[0, 1] < -0.05


def test_a_slippery_obstacle(backend: BulletBackend) -> None:
    """A light block is carried by the friction of a wall, and slides down it without."""
    for friction, low, high in ((0.9, 0.049, 0.051), (0.1, 0.03, 0.034)):
        scene = leaning(friction=friction, position=[0.0, 0.0, 0.0475])
        scene.state.positions[0] = [0.0, 0.0075 + HALF, 0.05]
        gravity = {("world", "gravity"): np.array([0.0, -20.0, -9.81])}
        backend.build(scene.with_(parameters={**scene.parameters, **gravity}))
        rest(backend, 200)
        assert low < backend.read().positions[0, 2] < high


@pytest.mark.parametrize("quantity", ["size", "position", "orientation"])
def test_an_obstacle_that_is_touched_moves_there_and_back(
    backend: BulletBackend, quantity: str
) -> None:
    """A change of a wall that a block leans on, taken back, has exactly no effect."""
    scene = leaning()
    backend.build(scene)
    rest(backend, 100)
    start = backend.snapshot()
    expected = play(backend, 50)
    backend.restore(start)
    key = ("wall", quantity)
    changed = {key: other_value(key, scene.parameters[key])}
    backend.apply(Difference(parameters=changed))
    backend.apply(Difference(parameters={key: scene.parameters[key]}))
    np.testing.assert_array_equal(play(backend, 50), expected)
    backend.restore(start)
    backend.apply(Difference(parameters=changed))
    assert float(np.abs(play(backend, 50) - expected).max()) > 1e-6


@pytest.mark.parametrize("quantity", ["size", "position", "orientation", "friction"])
def test_a_changed_obstacle_is_one_that_was_built_so(backend: BulletBackend, quantity: str) -> None:
    """A world whose wall was changed continues like a new one of that description."""
    backend.build(leaning())
    rest(backend, 100)
    key = ("wall", quantity)
    state, value = backend.read(), other_value(key, leaning().parameters[key])
    state.positions[0, 1] += 0.02
    backend.apply(Difference(parameters={key: value}, state=state))
    scene = leaning().with_(state=state)
    scene = scene.with_(parameters={**scene.parameters, key: value})
    np.testing.assert_array_equal(play(backend, 50), fresh(scene, lambda b: play(b, 50)))


def test_obstacles_come_and_go(backend: BulletBackend) -> None:
    """Obstacles that come, change their order or go, and all of it back, leave no trace."""
    scene = leaning()
    backend.build(scene)
    rest(backend, 100)
    start, now = backend.snapshot(), backend.read()
    expected = play(backend, 50)
    for obstacles in ((), ("other", "wall"), ("wall", "other"), ("other",)):
        backend.restore(start)
        backend.apply(Difference(structure=scene.structure.with_(obstacles=obstacles)))
        backend.apply(Difference(scene.structure, scene.parameters, now))
        np.testing.assert_array_equal(play(backend, 50), expected)


def test_an_orientation_must_be_one(backend: BulletBackend) -> None:
    """A quaternion of zeros is refused, and the world is as it was."""
    backend.build(leaning())
    rest(backend, 10)
    start = backend.snapshot()
    expected = play(backend, 5)
    backend.restore(start)
    with pytest.raises(EngineFailure, match=r"wall\.orientation must be a quaternion"):
        backend.apply(Difference(parameters={("wall", "orientation"): np.zeros(4)}))
    np.testing.assert_array_equal(play(backend, 5), expected)


# --- hulls ----------------------------------------------------------------------------------------

HULLS = {
    "cube": box_hull([0.065, 0.065, 0.065]),
    "plate": box_hull([0.08, 0.05, 0.02]),
    "octahedron": octahedron(0.03, 0.035, 0.025),
    "needle": octahedron(0.02, 0.02, 0.06),
}


def lowest(hull: Hull, backend: Backend) -> float:
    """Find how high the lowest corner of the first block lies [m]."""
    state = backend.read()
    corners = np.array(hull.vertices) @ rotation_matrix(state.orientations[0]).T
    return float(corners[:, 2].min() + state.positions[0, 2])


@pytest.mark.parametrize("name", HULLS)
def test_a_hull_rests_on_the_floor(backend: BulletBackend, name: str) -> None:
    """A dropped hull comes to rest with its lowest corner on the floor, in spite of margins."""
    hull = HULLS[name]
    scene = trifinger(("block",), hulls=(("block", hull),)).default_scene()
    scene.state.positions[0] = [0.0, 0.0, 0.09]
    scene.state.orientations[0] = from_rotation_vector([0.3, 0.2, 0.1])
    backend.build(scene.with_(parameters={**scene.parameters, **FAR_UP}))
    rest(backend, 1000)
    assert float(np.abs(backend.read().blocks[0, 7:]).max()) < 0.01
    assert lowest(hull, backend) == pytest.approx(0.0, abs=5e-5)
    mass = scene.parameters["block", "mass"]
    np.testing.assert_allclose(
        backend.parameters([("block", "inertia")])["block", "inertia"],
        mass * np.array(hull.moments),
        rtol=1e-12,
    )


def test_hulls_and_boxes_stack(backend: BulletBackend) -> None:
    """A tower of cubes, of which some are hulls, stands as high as its edges say."""
    blocks = ("a", "b", "c", "d")
    hulls = (("b", HULLS["cube"]), ("c", HULLS["cube"]))
    scene = trifinger(blocks, hulls=hulls).default_scene()
    scene.state.positions[:] = [[0.0, 0.0, HALF + 0.065 * k] for k in range(4)]
    backend.build(scene.with_(parameters={**scene.parameters, **FAR_UP}))
    rest(backend, 500)
    heights = HALF + 0.065 * np.arange(4)
    np.testing.assert_allclose(backend.read().positions[:, 2], heights, atol=3e-4)
    np.testing.assert_allclose(backend.read().positions[:, :2], 0.0, atol=2e-3)


def test_a_block_changes_its_shape_and_back(backend: BulletBackend) -> None:
    """A hull that becomes a box or another hull, and itself again, leaves no trace."""
    scene = busy_scene()
    backend.build(scene)
    play(backend, 20)
    start, now = backend.snapshot(), backend.read()
    expected = play(backend, 50)
    for hulls in ((), (("stone", HULLS["needle"]),), (("near", HULLS["cube"]),)):
        backend.restore(start)
        backend.apply(Difference(structure=scene.structure.with_(hulls=hulls)))
        play(backend, 2)
        backend.apply(Difference(scene.structure, scene.parameters, now))
        again = play(backend, 50)
        backend.restore(start)
        backend.apply(Difference(state=moved(backend)))
        backend.apply(Difference(state=now))
        np.testing.assert_array_equal(play(backend, 50), expected)
        canonical = scene.with_(state=now)
        np.testing.assert_array_equal(again, fresh(canonical, lambda b: play(b, 50)))


def moved(backend: Backend) -> PhysicalState:
    """Give the state with all blocks a little higher."""
    state = backend.read()
    state.positions[:, 2] += 0.01
    return state


# --- parameters of contacts, joints and the controller --------------------------------------------

NEW = [
    key
    for key in busy_scene().parameters
    if key[0] in ("controller", "ledge")
    or key[1] in ("restitution", "spinning_friction", "joint_damping")
]


@pytest.mark.parametrize("key", NEW, ids=".".join)
def test_a_parameter_there_and_back(backend: BulletBackend, key: ParameterKey) -> None:
    """A change that is taken back has exactly no effect; one that stays has, but for colors."""
    scene = busy_scene()
    backend.build(scene)
    play(backend, 2)
    start = backend.snapshot()
    expected = play(backend, 50)
    backend.restore(start)
    other = {key: other_value(key, scene.parameters[key])}
    backend.apply(Difference(parameters=other))
    backend.apply(Difference(parameters={key: scene.parameters[key]}))
    np.testing.assert_array_equal(play(backend, 50), expected)

    backend.restore(start)
    backend.apply(Difference(parameters=other))
    there = pickle.loads(pickle.dumps(backend.snapshot()))  # noqa: S301
    changed = play(backend, 50)
    assert np.array_equal(changed, expected) == (key[1] == "color")
    backend.restore(there)
    np.testing.assert_array_equal(play(backend, 50), changed)


@pytest.mark.parametrize("early", [True, False], ids=["before", "after"])
def test_every_body_takes_part_in_contacts(backend: BulletBackend, early: bool) -> None:
    """Restitution and spinning friction of every pair have the value set, for new bodies, too."""
    values = {("world", "restitution"): 0.3, ("world", "spinning_friction"): 0.004}
    changes: list[Difference] = [
        Difference(parameters={key: np.array(value) for key, value in values.items()}),
        Difference(structure=busy_scene().structure),
    ]
    backend.build(trifinger(("other",)).default_scene())
    for change in changes if early else reversed(changes):
        backend.apply(change)
    client = backend.client()

    def info(body: int, link: int) -> Sequence[float]:
        found: Sequence[float] = backend._engine.getDynamicsInfo(
            body, link, physicsClientId=client.engine.handle
        )
        return found

    mj = compiled(backend.structure)
    moves = mj.body_treeid[mj.geom_bodyid] >= 0
    free = mj.geom_bodyid >= mj.nbody - len(busy_scene().structure.blocks)
    found = {geom: info(*place) for geom, place in client.geoms.items()}
    for geom, one in found.items():
        if moves[geom]:  # the engine does not tell it of the others
            assert one[5] == pytest.approx(0.3**0.5)
    for block in (one for geom, one in found.items() if free[geom]):
        for other in (one for geom, one in found.items() if not free[geom]):
            assert block[7] * other[1] + other[7] * block[1] == pytest.approx(0.004)


def effective(backend: BulletBackend, restitution: float) -> float:
    """Drop a block from several heights; measure speed after an impact over speed before it."""
    ratios = []
    for drop in np.linspace(0.1, 0.12, 11):
        scene = trifinger(("block",)).default_scene()
        scene.state.positions[0] = [0.0, 0.0, HALF + drop]
        values: Mapping[ParameterKey, Floats] = {
            **FAR_UP,
            ("world", "restitution"): np.array(restitution),
        }
        backend.build(scene.with_(parameters={**scene.parameters, **values}))
        speeds = []
        for _ in range(60):
            rest(backend, 1)
            speeds.append(backend.read().linear_velocities[0, 2])
        ratios.append(max(speeds) / -min(speeds))
    return float(np.mean(ratios))


@pytest.mark.parametrize("restitution", [0.1, 0.3, 0.6])
def test_restitution_is_the_ratio_of_speeds(backend: BulletBackend, restitution: float) -> None:
    """On the average over heights, the step being long for an impact, a block bounces as told."""
    assert effective(backend, restitution) == pytest.approx(restitution, abs=0.06)
