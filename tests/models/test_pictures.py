"""Facts about pictures of models."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from scm_world.backends import read_model
from scm_world.backends.renderer import (
    automatic_camera,
    camera_pixels,
    following_camera,
    picture,
    render,
    scene_camera,
    shapes_of,
)
from scm_world.backends.step import StepModel
from scm_world.errors import ModelError, UnknownOption
from scm_world.models import GoalRegion, Model, Scene
from scm_world.models.camera import Camera
from scm_world.tasks.trifinger.cameras import CAMERAS, OVERVIEW
from scm_world.tasks.trifinger.system import trifinger

XML = """
<mujoco model="everything">
  <asset>
    <mesh name="wedge" vertex="0 0 0  .3 0 0  0 .3 0  0 0 .3"/>
    <hfield name="hills" nrow="3" ncol="3" size="1 1 .1 .1" elevation="0 1 0 1 0 1 0 1 0"/>
    <texture name="checks" type="2d" builtin="checker" rgb1="0 .5 0" rgb2="0 1 0"
             width="64" height="64"/>
    <material name="checks" texture="checks" texuniform="true" texrepeat="2 2"/>
    <material name="blue" rgba="0 0 1 1"/>
  </asset>
  <worldbody>
    <light pos="0 0 5"/>
    <camera name="front" pos="0 -4 1" xyaxes="1 0 0 0 0 1" fovy="50"/>
    <camera name="flat" pos="0 -4 1" xyaxes="1 0 0 0 0 1" fovy="3" {flat}/>
    <geom name="floor" type="plane" size="0 0 1" material="checks"/>
    <geom name="ground" type="hfield" hfield="hills" pos="3 3 0"/>
    <body name="ball" pos="0 0 1">
      <freejoint/>
      <geom name="ball" size=".2" rgba="1 0 0 1"/>
      <camera name="rider" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
    </body>
    <body name="arm" pos="1 0 .5">
      <joint name="hinge" axis="0 1 0"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 .6" size=".05" material="blue"/>
      <geom name="drum" type="cylinder" size=".1 .05" pos="0 0 .7"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .1" pos="0 0 .9"/>
      <geom name="brick" type="box" size=".1 .1 .1" pos="0 0 0"/>
      <geom name="wedge" type="mesh" mesh="wedge" pos=".2 0 0"/>
      <site name="tip" pos="0 0 1.2" size=".05"/>
    </body>
    <body name="pin" pos="-1 0 .5">
      <joint name="pin" type="slide" axis="0 0 1"/>
      <geom name="hull" size=".3" group="0" rgba="0 1 1 1"/>
      <geom name="skin" type="box" size=".1 .1 .1" group="1" contype="0" conaffinity="0"/>
      <geom name="hidden" size=".5" group="3"/>
      <site name="end" pos="0 0 .2"/>
    </body>
    <site name="hook" pos="-1 0 1.5"/>
  </worldbody>
  <tendon>
    <spatial name="string" width=".02" rgba="1 0 1 1">
      <site site="hook"/>
      <site site="end"/>
    </spatial>
  </tendon>
</mujoco>
"""
SIZE = (60, 80)
COLORFUL = 200


def read(xml: str = XML) -> Model:
    """Read the model, or a variant of it."""
    return read_model(xml.replace("{flat}", 'projection="orthographic"'))


@pytest.fixture(scope="module")
def model() -> Model:
    """A model with a shape of each kind."""
    return read()


@pytest.fixture
def scene(model: Model) -> Scene:
    """The model as its file says."""
    return model.default_scene()


def moved(scene: Scene, **states: object) -> Scene:
    """Set states; underscores stand for the dots in their names."""
    state = scene.state.copy()
    for name, value in states.items():
        state.vector[state.layout.slices[name.replace("_", ".", 1)]] = value
    return scene.with_(state=state)


def colored(scene: Scene, element: str, attribute: str, value: object) -> Scene:
    """Set a parameter."""
    (key,) = (row.key for row in scene.structure.parameters if row.name == f"{element}.{attribute}")
    return scene.with_(parameters={**scene.parameters, key: np.array(value, dtype=np.float64)})


def software(scene: Scene, camera: Camera | str | None = None) -> np.ndarray:
    """Draw with the software renderer."""
    return picture(scene, camera, SIZE)


def test_every_body_is_seen(scene: Scene) -> None:
    """The automatic camera sees every body that moves, and the floor."""
    image = render(scene, automatic_camera(shapes_of(scene), (120, 160)))

    assert image.names == ("world", "ball", "arm", "pin")
    for name in image.names:
        assert image.shows(name).sum() > 50


def test_a_body_appears_where_its_state_says(scene: Scene) -> None:
    """The pixel of the ball's center is red, wherever the ball is, and before the center."""
    front = scene_camera(scene, "front", (120, 160))
    for at in ((0.0, 0.0, 1.0), (0.5, 1.0, 0.7), (-0.3, -1.0, 1.4)):
        image = render(moved(scene, ball_cartesian_position=at), front)
        column, row, depth = front.project(at)
        pixel = int(row), int(column)

        assert image.names[image.segmentation[pixel]] == "ball"
        assert image.rgb[pixel][0] > COLORFUL / 2 > image.rgb[pixel][1] * 10
        assert depth - image.depth[pixel] == pytest.approx(0.2, abs=0.01)


def test_a_joint_moves_what_hangs_on_it(scene: Scene) -> None:
    """A quarter turn of the hinge moves the end of the arm from above to the side."""
    front = scene_camera(scene, "front", (120, 160))
    turned = moved(scene, hinge_position=np.pi / 2)
    above, beside = ((1.0, 0.0, 1.4), (1.9, 0.0, 0.5))
    for one, there, away in ((scene, above, beside), (turned, beside, above)):
        image = render(one, front)
        shown = [
            int(image.segmentation[tuple(front.project(at)[1::-1].astype(int))])
            for at in (there, away)
        ]
        assert image.names[shown[0]] == "arm"
        assert shown[1] != shown[0]


def test_color_and_size_are_those_of_the_scene(scene: Scene) -> None:
    """Parameters that were set are seen, and only where the body is."""
    front = scene_camera(scene, "front", SIZE)
    before = render(scene, front)
    green = render(colored(scene, "ball", "color", [0, 1, 0, 1]), front)
    large = render(colored(scene, "ball", "size", [0.4]), front)
    ball = before.shows("ball")

    assert (green.rgb[ball][:, 0] == 0).all()
    np.testing.assert_array_equal(green.segmentation, before.segmentation)
    assert large.shows("ball").sum() == pytest.approx(4 * ball.sum(), rel=0.15)


def test_pictures_leave_nothing_behind(scene: Scene) -> None:
    """A picture of a scene is the same after pictures of others."""
    before = software(scene)
    software(colored(scene, "ball", "color", [0, 1, 0, 1]))
    software(moved(scene, hinge_position=1.0))

    np.testing.assert_array_equal(software(scene), before)


def test_looks_count_and_not_collisions(scene: Scene) -> None:
    """A body with a group of shapes for the eye only does not show those that collide."""
    front = scene_camera(scene, "front", (120, 160))
    image = render(scene, front)
    pin = image.shows("pin")
    edge = 0.2 / 3.9 * 60.0 / np.tan(np.radians(25.0))

    assert edge**2 < pin.sum() < 2 * edge**2
    assert not ((image.rgb[:, :, 0] == 0) & (image.rgb[:, :, 1:] > 100).all(axis=2)).any()


def test_tendons_and_sites_are_seen(scene: Scene) -> None:
    """A string hangs between its sites; it belongs to no body."""
    front = scene_camera(scene, "front", (240, 320))
    image = render(scene, front)
    row, column = front.project([-1.0, -0.01, 1.1])[1::-1].astype(int)
    strip = image.rgb[row, column - 2 : column + 3].astype(int)

    assert (strip[:, 0] - strip[:, 1]).max() > 100
    assert image.segmentation[tuple(front.project([1.0, 0.0, 1.7])[1::-1].astype(int))] == 2


def test_a_camera_of_the_model_moves_with_its_body(scene: Scene) -> None:
    """A camera on a body keeps it where it is in the picture."""
    for at in ((0.0, 0.0, 1.0), (0.5, 1.0, 0.7)):
        there = moved(scene, ball_cartesian_position=at)
        rider = scene_camera(there, "rider", SIZE)

        np.testing.assert_allclose(rider.project(at), [40.0, 30.0, 2.0], atol=1e-4)
        assert render(there, rider).shows("ball")[30, 40]


def test_an_orthographic_camera(scene: Scene) -> None:
    """It shows things as large from far as from near."""
    flat = scene_camera(scene, "flat", (300, 300))
    near, far = (
        render(moved(scene, ball_cartesian_position=(0.0, y, 1.0)), flat).shows("ball").sum()
        for y in (-2.0, 2.0)
    )
    radius = 0.2 * 100.0

    assert near == pytest.approx(np.pi * radius**2, rel=0.05)
    assert far == pytest.approx(near, rel=0.05)


def test_named_cameras_and_their_errors(scene: Scene) -> None:
    """An unknown camera is named with those that there are."""
    assert scene_camera(scene).name == scene_camera(scene, "automatic").name == "automatic"
    with pytest.raises(UnknownOption, match=r"'frnt'.*automatic, front, flat, rider"):
        scene_camera(scene, "frnt")
    with pytest.raises(UnknownOption, match=r"there are: overview, 60, 120, 300"):
        picture(trifinger().default_scene(), "fron")


def test_the_size_of_a_picture(scene: Scene) -> None:
    """It is what is asked for, or that of the camera, or 480 by 640."""
    camera = automatic_camera(shapes_of(scene), (30, 50))

    assert picture(scene, camera).shape == (30, 50, 3)
    assert picture(scene, camera, SIZE).shape == (*SIZE, 3)
    assert picture(scene).shape == (480, 640, 3)
    assert picture(scene, camera, samples=2).shape == (30, 50, 3)
    with pytest.raises(ValueError, match="samples"):
        picture(scene, camera, samples=0)


def test_one_camera_for_two_scenes(scene: Scene) -> None:
    """A camera for several scenes sees what moves in each of them."""
    away = moved(scene, ball_cartesian_position=(6.0, 0.0, 1.0))
    camera = automatic_camera(shapes_of(scene).joined(shapes_of(away)), SIZE)

    for one in (scene, away):
        column, row, _ = camera.project(
            one.state.vector[one.state.layout.slices["ball.cartesian_position"]]
        )
        assert 0 < column < SIZE[1]
        assert 0 < row < SIZE[0]
    assert following_camera(camera, shapes_of(scene)).eye != camera.eye


def test_pictures_of_the_trifinger_are_those_of_render() -> None:
    """They are taken from the overview."""
    scene = trifinger(blocks=("tool_block",)).default_scene()

    np.testing.assert_array_equal(picture(scene), render(scene, OVERVIEW).rgb)
    fine = render(scene, CAMERAS[0], samples=2).rgb
    np.testing.assert_array_equal(picture(scene, "60", (128, 128), samples=2), fine)


def test_what_has_no_shapes_has_no_picture() -> None:
    """A system of equations cannot be drawn, and the error says so."""
    equations = StepModel("still", lambda *given: {}, 0.1, (), ())
    with pytest.raises(ModelError, match="StepModel says nothing about shapes"):
        picture(Scene(structure=equations, parameters={}, state=None))


def test_threads_draw_for_themselves(scene: Scene) -> None:
    """Pictures drawn by several threads at once are those drawn one after another."""
    scenes = [moved(scene, hinge_position=angle) for angle in np.linspace(0.0, 3.0, 8)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(software, scenes))

    for one, other in zip(together, map(software, scenes), strict=True):
        np.testing.assert_array_equal(one, other)


def test_pictures_are_equal_in_other_processes(scene: Scene, tmp_path: Path) -> None:
    """Another process draws the same bits."""
    file = tmp_path / "model.xml"
    file.write_text(XML.replace("{flat}", 'projection="orthographic"'))
    code = (
        "import sys, hashlib\n"
        "from scm_world.backends import read_model\n"
        "from scm_world.backends.renderer import picture\n"
        "scene = read_model(sys.argv[1]).default_scene()\n"
        "rgb = picture(scene, None, (60, 80))\n"
        "print(hashlib.sha256(rgb.tobytes()).hexdigest())"
    )
    there = subprocess.run(  # noqa: S603 # our own interpreter, our own code
        [sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True
    ).stdout.strip()

    assert there == hashlib.sha256(software(scene).tobytes()).hexdigest()


def test_pixels_for_policies(scene: Scene) -> None:
    """Pixels are those of a picture without shadows and goals; goals have pixels of their own."""
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    goal = GoalRegion(
        "goal", "box", np.full(3, 0.4), np.array([0.0, 0.0, 1.0]), upright, np.ones(3)
    )
    wanted = scene.with_(goals=(goal,))
    camera = scene_camera(scene, "front", SIZE)
    now, then, image = (
        np.empty((1, 3, *SIZE), np.uint8), np.empty((1, 3, *SIZE), np.uint8), render(scene, camera)
    )  # fmt: skip
    camera_pixels(wanted, (camera,), now)
    camera_pixels(wanted, (camera,), then, goals=True)
    ball = image.shows("ball")
    plain = render(wanted, camera, colors=False)

    np.testing.assert_array_equal(now[0].transpose(1, 2, 0)[ball], image.rgb[ball])
    assert (then[0, 1][ball] > 100).all()
    other = np.empty((1, *SIZE, 3), np.uint8)
    camera_pixels(wanted, (camera,), other, published=True)
    np.testing.assert_array_equal(other[0][::-1], now[0].transpose(1, 2, 0))
    np.testing.assert_array_equal(plain.depth, image.depth)
    np.testing.assert_array_equal(plain.segmentation, image.segmentation)


# --- models that nobody here wrote -------------------------------------------------------------


def inside(package: str, *path: str) -> str:
    """Find a file of a package that is installed."""
    module: ModuleType = pytest.importorskip(package)
    file = Path(module.__path__[0]).joinpath(*path)
    if not file.exists():
        pytest.skip(f"this version of {package} has no {file.name}")
    return str(file)


FILES = [
    *(("gymnasium", "envs", "mujoco", "assets", f"{name}.xml")
      for name in ("half_cheetah", "ant", "humanoid", "pusher", "reacher")),
    *(("dm_control", "suite", f"{name}.xml") for name in ("cartpole", "ball_in_cup", "finger")),
    *(("pybullet_data", name) for name in ("r2d2.urdf", "cartpole.urdf", "kuka_iiwa/model.urdf")),
]  # fmt: skip


@pytest.mark.parametrize("path", FILES, ids=lambda path: path[-1])
def test_models_of_others_are_framed(path: tuple[str, ...]) -> None:
    """Everything that moves is in the picture, away from its edges, and large enough to be seen."""
    model = read_model(inside(*path))
    scene = model.default_scene()
    image = render(scene, automatic_camera(shapes_of(scene), (120, 160)))
    rows, columns = np.nonzero(image.segmentation > 0)

    assert rows.min() > 2
    assert columns.min() > 2
    assert rows.max() < 117
    assert columns.max() < 157
    assert max(np.ptp(rows) / 120, np.ptp(columns) / 160) > 0.5


def test_a_robot_of_meshes_is_drawn_quickly() -> None:
    """A Panda of 10^5 triangles takes well under a second, and its looks hide what collides."""
    model = read_model(inside("robosuite", "models", "assets", "robots", "panda", "robot.xml"))
    scene = model.default_scene()
    camera = automatic_camera(shapes_of(scene), (240, 320))
    picture(scene, camera)  # compiles
    start = perf_counter()
    rgb = picture(scene, camera).astype(int)
    seconds = perf_counter() - start
    robot = render(scene, camera).segmentation > 0

    assert seconds < 1.0
    assert robot.sum() > 2_000
    # What collides is gray, and the Panda is white.
    assert np.median(rgb[robot].mean(axis=1)) > 150


def test_the_camera_of_a_film_follows() -> None:
    """A half cheetah that runs for twenty meters stays in the picture."""
    model = read_model(inside("gymnasium", "envs", "mujoco", "assets", "half_cheetah.xml"))
    scene = model.default_scene()
    camera = automatic_camera(shapes_of(scene), SIZE)
    for x in np.linspace(0.0, 20.0, 41):
        there = moved(scene, rootx_position=x)
        camera = following_camera(camera, shapes_of(there))
        columns = np.nonzero(render(there, replace(camera)).segmentation > 0)[1]

        assert columns.min() > 0
        assert columns.max() < SIZE[1] - 1


def test_a_window_shows_a_model(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The window shows states, colors and goals; a change of colors keeps it open."""
    import mujoco.viewer

    from scm_world.backends.mujoco.viewer import Viewer

    windows: list[SimpleNamespace] = []

    def launch(model: mujoco.MjModel, data: mujoco.MjData, **_: object) -> SimpleNamespace:
        canvas = mujoco.MjvScene(model, maxgeom=3)
        handle = SimpleNamespace(model=model, data=data, user_scn=canvas, is_running=lambda: True)
        handle.lock, handle.sync, handle.close = nullcontext, lambda: None, lambda: None
        windows.append(handle)
        return handle

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    goal = GoalRegion(
        "goal", "sphere", np.full(3, 0.4), np.array([0.0, 0.0, 2.0]), upright, np.ones(3)
    )
    viewer = Viewer()
    viewer.show(scene)
    later = moved(colored(scene, "ball", "color", [0, 1, 0, 1]), hinge_position=0.5)
    viewer.show(later.with_(goals=(goal,)))
    viewer.close()

    (window,) = windows
    assert window.data.joint("hinge").qpos == 0.5
    assert window.model.geom("ball").rgba.tolist() == [0, 1, 0, 1]
    assert window.user_scn.ngeom == 1
    assert window.user_scn.geoms[0].pos[2] == 2.0


def test_what_bends_is_seen() -> None:
    """Cables, cloths and solids that bend are drawn, and lie in the picture."""
    for dim, count in ((1, "6 1 1"), (2, "6 6 1"), (3, "3 3 3")):
        model = read_model(
            f"""<mujoco><worldbody><geom type="plane" size="0 0 1"/>
            <flexcomp name="flex" type="grid" count="{count}" spacing=".1 .1 .1" pos="0 0 .5"
                      dim="{dim}" radius=".02" rgba="1 0 0 1" mass="1">
              <edge equality="true"/></flexcomp></worldbody></mujoco>"""
        )
        rgb = software(model.default_scene())
        red = (rgb[:, :, 0] > COLORFUL / 2) & (rgb[:, :, 1] == 0)

        assert red.sum() > 50
        assert red[1:-1, 1:-1].sum() == red.sum()
