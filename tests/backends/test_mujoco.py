"""What is special about MuJoCo."""

import subprocess
import sys
from importlib import metadata

import mujoco
import numpy as np
import pytest
from robot_scenes import busy_scene, other_value, play

from scm_world.backends import BACKENDS, EngineSnapshot, make_backend
from scm_world.backends.mujoco import MujocoBackend, check_installation
from scm_world.backends.mujoco.reading import compiled
from scm_world.errors import MissingEngine, SnapshotMismatch, UnknownOption
from scm_world.geometry.hulls import hull_of
from scm_world.models import Difference
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.tasks.trifinger.system import trifinger

REST = np.array(hardware.REST)


@pytest.fixture
def backend() -> MujocoBackend:
    """Provide MuJoCo with the busy scene."""
    backend = MujocoBackend()
    backend.build(busy_scene())
    return backend


def fields(model: mujoco.MjModel) -> dict[str, bytes]:
    """Copy every number of a model."""
    found = {}
    for name, part in (("", model), ("opt.", model.opt), ("stat.", model.stat)):
        for key in dir(part):
            value = getattr(part, key)
            if not key.startswith("_") and isinstance(value, (np.ndarray, float, int)):
                found[name + key] = np.asarray(value).tobytes()
    return found


def test_no_engine_is_imported_before_it_is_used() -> None:
    """Importing the backends imports neither MuJoCo nor Bullet."""
    code = (
        "import sys, scm_world, scm_world.backends;print({'mujoco', 'pybullet'} & set(sys.modules))"
    )
    child = subprocess.run(  # noqa: S603 # our own interpreter, our own code
        [sys.executable, "-c", code], capture_output=True, check=True, text=True
    )
    assert child.stdout.strip() == "set()"


def test_unknown_backends_are_named() -> None:
    """The error lists the backends and suggests one."""
    with pytest.raises(UnknownOption, match=r"did you mean 'mujoco'\?") as caught:
        make_backend("mujcoo")
    assert {*BACKENDS} <= {*caught.value.choices}  # tests of other files add their own


def installed(versions: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let these distributions be installed, and check them."""

    def version(name: str) -> str:
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(metadata, "version", version)
    check_installation()


@pytest.mark.parametrize(
    "versions",
    [{"mujoco": "3.17.0"}, {"mujoco-core": "4.0.1"}, {"mujoco": "4.0.0", "mujoco-core": "4.0.0"}],
)
def test_whole_installations_are_accepted(
    versions: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One version in all distributions is fine."""
    installed(versions, monkeypatch)


def test_mixed_installations_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two versions in one folder are an error that names them and the repair."""
    versions = {"mujoco": "3.17.0", "mujoco-core": "4.0.1"}
    with pytest.raises(
        MissingEngine, match=r"mixed: mujoco 3\.17\.0, mujoco-core 4\.0\.1"
    ) as found:
        installed(versions, monkeypatch)
    assert "pip uninstall -y mujoco mujoco-core" in found.value.install


def test_any_path_ends_in_the_same_model(backend: MujocoBackend) -> None:
    """Edits one by one, with detours, give every number of a model that was built so."""
    scene = busy_scene()
    final = {key: other_value(key, value) for key, value in scene.parameters.items()}
    for key in sorted(final):
        backend.apply(Difference(parameters={key: other_value(key, final[key])}))
        play(backend, 1)
        backend.apply(Difference(parameters={key: final[key]}))
    fresh = MujocoBackend()
    fresh.build(scene.with_(parameters=final))
    edited, built = fields(backend.realization.model), fields(fresh.realization.model)
    assert [name for name in edited if edited[name] != built[name]] == []


def test_the_cached_model_is_never_changed(backend: MujocoBackend) -> None:
    """Whatever a backend does, it does to its own copy of the compiled model."""
    cached = compiled(busy_scene().structure)
    before = fields(cached)
    for key, value in busy_scene().parameters.items():
        backend.apply(Difference(parameters={key: other_value(key, value)}))
    play(backend, 2, torques=True)
    assert fields(cached) == before


def test_unknown_parameters_change_nothing(backend: MujocoBackend) -> None:
    """An unknown parameter is named, and the known ones beside it are not applied."""
    before = fields(backend.realization.model)
    changes = {("near", "mass"): np.array(0.05), ("nobody", "mass"): np.array(0.05)}
    with pytest.raises(UnknownOption, match=r"nobody\.mass"):
        backend.apply(Difference(parameters=changes))
    assert fields(backend.realization.model) == before


def test_corners_of_a_hull_are_where_the_hull_says() -> None:
    """MuJoCo turns meshes into a frame of its own, and the shape of the body back again."""
    pytest.importorskip("scipy")
    points = np.random.default_rng(2).normal(size=(12, 3), scale=0.02)
    hull = hull_of(points)
    backend = MujocoBackend()
    backend.build(trifinger(("stone",), hulls=(("stone", hull),)).default_scene())
    model = backend.realization.model
    shape = model.geom("stone").id
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[shape])
    corners = model.geom_pos[shape] + model.mesh_vert @ rotation.reshape(3, 3).T
    np.testing.assert_allclose(corners, hull.vertices, rtol=0, atol=1e-8)
    reach = np.linalg.norm(model.mesh_vert, axis=1).max()
    assert model.geom_rbound[shape] >= reach


def test_obstacles_cost_few_pairs() -> None:
    """An obstacle can meet the blocks and nine shapes of the robot, and nothing else."""
    alone = compiled(trifinger(("a", "b")))
    with_two = compiled(trifinger(("a", "b"), obstacles=("wall", "post")))
    assert with_two.npair - alone.npair == 2 * (2 + 9)


def test_an_obstacle_that_grew_is_found(backend: MujocoBackend) -> None:
    """The radius within which MuJoCo looks for contacts follows the size of an obstacle."""
    backend.apply(Difference(parameters={("ledge", "size"): np.array([0.6, 0.02, 0.1])}))
    model = backend.realization.model
    assert model.geom_rbound[model.geom("ledge").id] == pytest.approx(
        np.linalg.norm([0.3, 0.01, 0.05])
    )


def test_restitution_of_zero_is_critical_damping(backend: MujocoBackend) -> None:
    """Without restitution all pairs have the numbers they were compiled with, bit for bit."""
    before = backend.realization.model.pair_solref.copy()
    for restitution in (0.5, 0.0):
        value = np.array(restitution)
        backend.apply(Difference(parameters={("world", "restitution"): value}))
    assert np.array_equal(backend.realization.model.pair_solref, before)
    assert np.array_equal(before, compiled(busy_scene().structure).pair_solref)


@pytest.mark.parametrize("restitution", [0.0, 1e-9, 0.05, 0.5, 0.9])
def test_restitution_keeps_the_frequency(backend: MujocoBackend, restitution: float) -> None:
    """Time constant times damping ratio stays, and the value is read back."""
    key = ("world", "restitution")
    model = backend.realization.model
    before = model.pair_solref.prod(axis=1)
    backend.apply(Difference(parameters={key: np.array(restitution)}))
    np.testing.assert_allclose(model.pair_solref.prod(axis=1), before, rtol=1e-14)
    np.testing.assert_allclose(backend.parameters([key])[key], restitution, rtol=0, atol=1e-13)


def test_other_versions_are_refused(backend: MujocoBackend) -> None:
    """A snapshot of another MuJoCo is refused, because it would not continue bit for bit."""
    snapshot = backend.snapshot()
    with pytest.raises(SnapshotMismatch, match=r"mujoco 2\.0\.0"):
        backend.restore(EngineSnapshot("mujoco 2.0.0", snapshot.payload))


def test_fingertips_are_where_kinematics_says(backend: MujocoBackend) -> None:
    """The tips of the model are those of the closed form, in any pose and at any height."""
    generator = np.random.default_rng(0)
    for height in (0.3, 0.37):
        backend.apply(Difference(parameters={("robot", "height"): np.array(height)}))
        state = backend.read()
        state.joint_positions[:] = generator.uniform(hardware.JOINT_LOW, hardware.JOINT_HIGH)
        backend.apply(Difference(state=state))
        data = backend.realization.data
        mujoco.mj_kinematics(backend.realization.model, data)
        tips = [data.body(f"robot_finger_{f}_tip").xpos for f in hardware.FINGERS]
        expected = forward(state.joint_positions, height)
        np.testing.assert_allclose(np.ravel(tips), np.ravel(expected), rtol=0, atol=1e-12)


def test_nothing_intersects_in_the_published_poses() -> None:
    """Neither the rest pose nor the raised pose makes fingers touch."""
    for pose in (hardware.REST, hardware.RAISED):
        scene = trifinger().default_scene()
        scene.state.joint_positions[:] = pose
        backend = MujocoBackend()
        backend.build(scene)
        backend.step(np.array(pose), 1)
        assert backend.contacts() == ()
