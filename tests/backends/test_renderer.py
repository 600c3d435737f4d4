"""Facts about pictures."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from robot_scenes import link_frames

from scm_world._types import Floats
from scm_world.backends.renderer import RenderedImage, png, render
from scm_world.backends.renderer.shapes import NOTHING
from scm_world.errors import UnknownOption
from scm_world.models import GoalRegion, ParameterKey, Scene
from scm_world.models.camera import Camera
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.cameras import CAMERAS, OVERVIEW
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.tasks.trifinger.system import tip_name, trifinger

TOP = Camera("top", eye=(0.0, 0.0, 0.25), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
"""Below the robot's hub, looking down."""

SMALL = replace(OVERVIEW, width=160, height=120)


def goal(
    position: tuple[float, float, float], *, size: float = 0.065, shape: str = "box"
) -> GoalRegion:
    """Make a green goal that is not turned."""
    return GoalRegion(
        "goal", shape, np.full(3, size), np.array(position),
        np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]),
    )  # fmt: skip


@pytest.fixture
def scene() -> Scene:
    """One red block in the middle of the table."""
    return trifinger(blocks=("tool_block",)).default_scene()


def painted(scene: Scene, body: str, color: tuple[float, float, float]) -> Scene:
    """Give a body another color."""
    return scene.with_(parameters={**scene.parameters, (body, "color"): np.array(color)})


def pixel(image: RenderedImage, camera: Camera, point: Floats) -> tuple[int, int]:
    """Find the pixel of a point, row first."""
    column, row, _ = camera.project(point)
    assert 0 <= row < image.depth.shape[0]
    assert 0 <= column < image.depth.shape[1]
    return int(row), int(column)


@pytest.mark.parametrize("camera", [*CAMERAS, OVERVIEW, TOP], ids=lambda camera: camera.name)
def test_block_appears_where_its_center_projects(scene: Scene, camera: Camera) -> None:
    """The pixel of the block's center shows the block, in red, in front of its center."""
    scene.state.positions[0] = (0.03, 0.02, 0.0325)
    image = render(scene, camera)
    at = pixel(image, camera, scene.state.positions[0])
    red, green, blue = image.rgb[at]

    assert image.names[image.segmentation[at]] == "tool_block"
    assert red > 100
    assert green == blue == 0
    assert 0.02 < camera.project(scene.state.positions[0])[2] - image.depth[at] < 0.06


def test_depth_is_measured_along_the_axis(scene: Scene) -> None:
    """From above, every pixel of a block's top face has one depth, and so has the floor."""
    image = render(scene, TOP)

    np.testing.assert_allclose(image.depth[image.shows("tool_block")].min(), 0.25 - 0.065)
    np.testing.assert_allclose(image.depth[image.shows("floor")], 0.25, rtol=1e-6)


def test_size_of_a_block_in_pixels(scene: Scene) -> None:
    """The top face covers as many pixels as the pinhole formula says."""
    image = render(scene, TOP)
    top_face = image.shows("tool_block") & (image.depth < 0.25 - 0.065 + 1e-5)
    edge = 0.065 / 0.185 * 64.0 / np.tan(np.radians(26.0))

    assert top_face.sum() == pytest.approx(edge**2, rel=0.06)


def test_turned_block_is_turned_in_the_picture(scene: Scene) -> None:
    """A block turned by 45° shows its corners where its edges were."""
    corner = np.array([0.0, 0.044, 0.06])
    straight = render(scene, TOP)
    scene.state.orientations[0] = (0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8))
    turned = render(scene, TOP)

    at = pixel(straight, TOP, corner)
    assert straight.names[straight.segmentation[at]] != "tool_block"
    assert turned.names[turned.segmentation[at]] == "tool_block"


def test_fingertips_appear_where_kinematics_puts_them(scene: Scene) -> None:
    """Seen from a side, the pixel of every tip shows it."""
    tips = forward(scene.state.joint_positions, hardware.NOMINAL_HEIGHT).reshape(3, 3)
    for finger, tip in zip(hardware.FINGERS, tips, strict=True):
        outward = np.array([tip[0], tip[1], 0.0]) / np.hypot(tip[0], tip[1])
        eye = tip + 0.3 * outward + [0.0, 0.0, 0.02]
        camera = Camera("side", tuple(eye.tolist()), tuple(tip.tolist()))
        image = render(scene, camera)
        owner = image.segmentation[pixel(image, camera, tip)]
        assert image.names[owner] == tip_name(finger)


def test_capsules_follow_their_links(scene: Scene) -> None:
    """The middle of every link's capsule, seen from above the robot, shows a link nearby."""
    positions, _ = link_frames(scene.state.joint_positions)
    knees = positions[3::5]
    camera = replace(TOP, eye=(0.0, 0.0, 1.5), field_of_view=30.0, width=300, height=300)
    image = render(scene, camera)
    for finger, knee in zip(hardware.FINGERS, knees, strict=True):
        name = image.names[image.segmentation[pixel(image, camera, knee)]]
        assert name.startswith(f"robot_finger_{finger}")


def test_higher_robot_is_drawn_higher(scene: Scene) -> None:
    """The robot's height moves the robot and leaves the block alone."""
    raised = {**scene.parameters, ("robot", "height"): np.array(0.4)}
    low, high = render(scene, OVERVIEW), render(scene.with_(parameters=raised), OVERVIEW)

    def top_row(image: RenderedImage) -> int:
        return int(np.flatnonzero(image.shows("robot").any(axis=1))[0])

    assert top_row(high) < top_row(low) - 10


COLORED = ["floor", "stage", "tool_block", *hardware.LINK_NAMES]


@pytest.mark.parametrize("body", COLORED)
def test_every_color_can_be_seen(scene: Scene, body: str) -> None:
    """Each color parameter changes the pixels of its own body, in some published view, only."""
    before = [render(scene, camera) for camera in CAMERAS]
    after = [render(painted(scene, body, (0.2, 0.9, 0.9)), camera) for camera in CAMERAS]
    seen = 0
    for was, now in zip(before, after, strict=True):
        changed = (was.rgb != now.rgb).any(axis=2)
        own = was.shows(body)
        for finger in hardware.FINGERS:
            if body == hardware.link_name(finger, 3):  # a tip has the color of its link
                own = own | was.shows(tip_name(finger))
        np.testing.assert_array_equal(changed, own)
        seen += int(changed.sum())
    assert seen > 0


@pytest.mark.parametrize(
    "key", [("tool_block", "mass"), ("world", "gravity"), ("floor", "friction")]
)
def test_what_has_no_look_is_not_seen(scene: Scene, key: ParameterKey) -> None:
    """Mass, gravity and friction change no pixel."""
    other = scene.with_(parameters={**scene.parameters, key: scene.parameters[key] * 2.0})

    np.testing.assert_array_equal(render(scene, SMALL).rgb, render(other, SMALL).rgb)


def test_goal_tints_what_lies_behind(scene: Scene) -> None:
    """A silhouette lets 70 % of the floor through, and has neither depth nor number."""
    without = render(scene, TOP)
    image = render(scene.with_(goals=(goal((0.06, 0.06, 0.0325)),)), TOP)
    at = pixel(image, TOP, np.array([0.06, 0.06, 0.065]))

    expected = 0.7 * without.rgb[at] + 0.3 * np.array([0.0, image.rgb[at][1], 0.0])
    np.testing.assert_allclose(image.rgb[at][[0, 2]], expected[[0, 2]], atol=1)
    assert image.rgb[at][1] > without.rgb[at][1] + 20
    np.testing.assert_array_equal(image.depth, without.depth)
    np.testing.assert_array_equal(image.segmentation, without.segmentation)


def test_goal_never_hides_a_block_in_front(scene: Scene) -> None:
    """Behind the block, a silhouette changes no pixel of it."""
    block = scene.state.positions[0]
    away = block - 0.08 * OVERVIEW.axes()[2]
    hidden = goal((float(away[0]), float(away[1]), float(away[2])))
    without, image = render(scene, OVERVIEW), render(scene.with_(goals=(hidden,)), OVERVIEW)
    mask = without.shows("tool_block")

    np.testing.assert_array_equal(image.rgb[mask], without.rgb[mask])


def test_goal_shows_in_front_of_a_block(scene: Scene) -> None:
    """Before the block, a silhouette tints it."""
    without = render(scene, TOP)
    image = render(scene.with_(goals=(goal((0.0, 0.0, 0.1)),)), TOP)
    at = pixel(image, TOP, scene.state.positions[0])

    assert image.rgb[at][1] > without.rgb[at][1]
    assert 0 < image.rgb[at][0] < without.rgb[at][0]


def test_block_in_its_goal_does_not_flicker(scene: Scene) -> None:
    """A block exactly in its goal hides it."""
    fulfilled = scene.with_(goals=(goal((0.0, 0.0, 0.0325)),))

    np.testing.assert_array_equal(render(fulfilled, SMALL).rgb, render(scene, SMALL).rgb)


def test_nearer_goal_is_blended_last(scene: Scene) -> None:
    """The order in which goals are listed does not matter."""
    goals = (goal((0.05, 0.05, 0.03)), goal((0.05, 0.05, 0.12), size=0.04, shape="sphere"))
    one, other = (render(scene.with_(goals=g), SMALL) for g in (goals, goals[::-1]))

    np.testing.assert_array_equal(one.rgb, other.rgb)


def test_sphere_is_round(scene: Scene) -> None:
    """A sphere goal covers the disc that it should."""
    sphere = goal((0.0, 0.0, 0.1), size=0.05, shape="sphere")
    with_goal = render(scene.with_(goals=(sphere,)), TOP)
    changed = (with_goal.rgb != render(scene, TOP).rgb).any(axis=2)
    tangent = 0.025 / np.sqrt(0.15**2 - 0.025**2) * 64.0 / np.tan(np.radians(26.0))

    assert changed.sum() == pytest.approx(np.pi * tangent**2, rel=0.06)


def test_shadow_lies_on_the_floor(scene: Scene) -> None:
    """A floating block darkens the floor beside it; without the block there is light."""
    scene.state.positions[0] = (0.05, 0.05, 0.05)
    dark, light = render(scene, TOP), render(trifinger().default_scene(), TOP)
    floor = dark.shows("floor") & light.shows("floor")

    darker = dark.rgb.astype(int).sum(axis=2) < light.rgb.astype(int).sum(axis=2) - 20
    assert (darker & floor).sum() > 100


@pytest.mark.parametrize("near", [0.001, 0.05, 0.1, 0.15])
def test_body_across_the_near_plane(scene: Scene, near: float) -> None:
    """What is cut by the near plane is cut cleanly: finite depths, none nearer than allowed."""
    scene.state.positions[0] = (0.0, 0.02, 0.19)
    image = render(scene.with_(goals=(goal((0.0, -0.03, 0.2)),)), replace(TOP, near=near))

    assert np.isfinite(image.depth).all()
    assert image.depth.min() >= np.float32(near)
    assert image.shows("tool_block").any() == (near < 0.09)


def test_camera_inside_a_body(scene: Scene) -> None:
    """A camera inside a block sees nothing but the inside of the block."""
    camera = replace(TOP, eye=(0.001, 0.002, 0.03), target=(0.0, 0.1, 0.04), up=(0.0, 0.0, 1.0))
    image = render(scene, camera)

    assert image.shows("tool_block").all()
    assert 0.0 < image.depth.min() < image.depth.max() < 0.065


def test_camera_beside_everything(scene: Scene) -> None:
    """A camera that looks away sees the background, at the far plane."""
    image = render(scene, replace(TOP, eye=(0.0, 0.0, 2.0), target=(0.0, 0.0, 3.0)))

    assert (image.segmentation == NOTHING).all()
    assert (image.depth == TOP.far).all()
    assert len(np.unique(image.rgb.reshape(-1, 3), axis=0)) == 1


def test_wall_does_not_hide_the_arena(scene: Scene) -> None:
    """Through the near wall the floor is seen, and the far wall from within."""
    low = replace(OVERVIEW, eye=(0.0, -1.0, 0.1), target=(0.0, 0.0, 0.1))
    image = render(scene, low)

    assert image.shows("tool_block").any()
    assert image.shows("floor").any()
    assert image.depth[image.shows("stage")].min() > 0.9


def test_segmentation_names(scene: Scene) -> None:
    """Every number of a segmentation has a name; the overview shows them all but the hidden."""
    image = render(scene, OVERVIEW)
    shown = {image.names[i] for i in np.unique(image.segmentation) if i != NOTHING}

    assert image.names == scene.structure.body_names
    assert {"floor", "stage", "robot", "tool_block"} <= shown
    assert {hardware.link_name(finger, 3) for finger in hardware.FINGERS} <= shown


def test_unknown_body_is_refused(scene: Scene) -> None:
    """A misspelled body is answered with the nearest name."""
    with pytest.raises(UnknownOption, match="did you mean 'tool_block'"):
        render(scene, SMALL).shows("tool_blok")


def test_many_blocks(scene: Scene) -> None:
    """Each block has its own number."""
    names = tuple(f"tool_{i}" for i in range(3))
    image = render(trifinger(blocks=names).default_scene(), OVERVIEW)

    assert all(image.shows(name).any() for name in names)


def test_one_call_equals_several(scene: Scene) -> None:
    """Several cameras at once take the pictures each would take."""
    for image, camera in zip([render(scene, camera) for camera in CAMERAS], CAMERAS, strict=True):
        np.testing.assert_array_equal(image.rgb, render(scene, camera).rgb)


def test_samples_smooth_the_colors_only(scene: Scene) -> None:
    """Averaging leaves depth and segmentation, and mixes colors at edges."""
    rough, smooth = render(scene, SMALL), render(scene, SMALL, samples=2)

    np.testing.assert_array_equal(smooth.depth, rough.depth)
    np.testing.assert_array_equal(smooth.segmentation, rough.segmentation)
    assert len(np.unique(smooth.rgb.reshape(-1, 3), axis=0)) > len(
        np.unique(rough.rgb.reshape(-1, 3), axis=0)
    )


def test_no_samples_are_refused(scene: Scene) -> None:
    """A picture needs at least one sample per pixel."""
    with pytest.raises(ValueError, match="samples"):
        render(scene, SMALL, samples=0)


def test_colors_beyond_one_are_cut_off(scene: Scene) -> None:
    """A color out of range saturates instead of wrapping around."""
    image = render(painted(scene, "tool_block", (9.0, -1.0, 0.0)), TOP)

    assert (image.rgb[image.shows("tool_block")] == [255, 0, 0]).all()


def test_scene_is_left_alone(scene: Scene) -> None:
    """Taking a picture changes nothing."""
    state = scene.state.copy()
    render(scene, SMALL)

    assert scene.state == state


SNIPPET = """
import hashlib
from dataclasses import replace
from scm_world.backends.renderer import render
from scm_world.tasks.trifinger.system import trifinger
from scm_world.tasks.trifinger.cameras import OVERVIEW
image = render(trifinger(blocks=("tool_block",)).default_scene(), OVERVIEW)
print(hashlib.sha256(image.rgb.tobytes() + image.depth.tobytes()).hexdigest())
"""


def test_pictures_are_equal_between_processes(scene: Scene) -> None:
    """Another process takes the same picture, bit for bit."""
    image = render(scene, OVERVIEW)
    ours = hashlib.sha256(image.rgb.tobytes() + image.depth.tobytes()).hexdigest()
    theirs = subprocess.run(  # noqa: S603 (our own interpreter and our own program)
        [sys.executable, "-c", SNIPPET], capture_output=True, text=True, check=True
    )

    assert theirs.stdout.strip() == ours


def test_png_keeps_every_pixel(scene: Scene, tmp_path: Path) -> None:
    """A written picture reads back as it was."""
    image = render(scene, SMALL)
    (tmp_path / "picture.png").write_bytes(png(image.rgb))

    read = np.rint(imread(tmp_path / "picture.png")[..., :3] * 255.0).astype(np.uint8)
    np.testing.assert_array_equal(read, image.rgb)
