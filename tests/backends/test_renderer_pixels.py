"""Facts about the pixels that a policy sees."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from robot_scenes import box_hull

from scm_world.backends.renderer import camera_pixels, render, shape_of_pixels
from scm_world.models import GoalRegion, Light, Scene
from scm_world.models.camera import Camera
from scm_world.tasks.trifinger.cameras import CAMERAS, ORIGINAL_CAMERAS
from scm_world.tasks.trifinger.hardware import JOINT_LOW
from scm_world.tasks.trifinger.system import trifinger


def pixels(
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    goals: Scene | None = None,
    size: tuple[int, int] | None = None,
    published: bool = False,
) -> NDArray[np.uint8]:
    """Draw what cameras see now, and then what they should see."""
    if size is not None:
        cameras = [replace(camera, height=size[0], width=size[1]) for camera in cameras]
    out = np.empty(
        (2 * len(cameras), *shape_of_pixels(cameras[0], published=published)), dtype=np.uint8
    )
    camera_pixels(scene, cameras, out[: len(cameras)], published=published)
    camera_pixels(goals or scene, cameras, out[len(cameras) :], goals=True, published=published)
    return out


STRUCTURE = trifinger(
    blocks=("tool_block", "stone"),
    obstacles=("barrier",),
    hulls=(("stone", box_hull([0.05, 0.03, 0.04])),),
)


@pytest.fixture
def scene() -> Scene:
    """A box, a hull, an obstacle that can be seen, and a goal."""
    scene = STRUCTURE.default_scene()
    barrier = {"size": [0.1, 0.02, 0.05], "position": [0.0, -0.08, 0.025], "color": [1, 1, 0]}
    changes = {("barrier", name): np.array(value, float) for name, value in barrier.items()}
    green, upright = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    goal = GoalRegion(
        "goal", "box", np.full(3, 0.065), np.array([0.0, 0.08, 0.0325]), upright, green
    )
    return scene.with_(parameters={**scene.parameters, **changes}, goals=(goal,))


def parked(scene: Scene, *, obstacles: bool = True) -> Scene:
    """Leave the goals and the obstacles, and a robot at the lower limits of its joints."""
    state: Any = trifinger().empty_state()
    state.joint_positions[:] = JOINT_LOW
    structure = trifinger(obstacles=scene.structure.obstacles if obstacles else ())
    kept = {key: scene.parameters[key] for key in structure.default_scene().parameters}
    return scene.with_(state=state, structure=structure, parameters=kept)


def now(scene: Scene) -> np.ndarray:
    """Draw what the three cameras see now."""
    out = np.empty((3, 3, 128, 128), dtype=np.uint8)
    camera_pixels(scene, CAMERAS, out)
    return out


def test_pixels_are_those_of_render_but_for_shadows(scene: Scene) -> None:
    """Colors differ only on the floor, where ``render`` is darker."""
    pictures = now(scene)
    plain = [render(scene.with_(goals=()), camera) for camera in CAMERAS]
    for got, image in zip(pictures, plain, strict=True):
        quick, slow = got.transpose(1, 2, 0), image.rgb
        unlike = (quick != slow).any(axis=2)
        assert unlike.any()
        assert not (unlike & ~image.shows("floor")).any()
        assert (quick >= slow).all()


def test_goal_pixels_are_those_of_render_but_for_shadows(scene: Scene) -> None:
    """A goal picture shows goals, obstacles and a parked robot, and no blocks."""
    out = np.empty((3, 3, 128, 128), dtype=np.uint8)
    camera_pixels(scene, CAMERAS, out, goals=True)
    for got, image in zip(out, [render(parked(scene), camera) for camera in CAMERAS], strict=True):
        unlike = (got.transpose(1, 2, 0) != image.rgb).any(axis=2)
        assert not (unlike & ~image.shows("floor")).any()
        assert image.shows("barrier").any()


def test_without_shadows_pixels_are_those_of_render(scene: Scene) -> None:
    """Under light from everywhere both halves equal what ``render`` makes, bit for bit."""
    scene = scene.with_(light=Light(ambient=1.0))
    expected = [
        image.rgb.transpose(2, 0, 1)
        for shown in (scene.with_(goals=()), parked(scene))
        for image in [render(shown, camera) for camera in CAMERAS]
    ]

    np.testing.assert_array_equal(pixels(scene, CAMERAS), expected)


def test_observation_is_now_and_then_the_goal(scene: Scene) -> None:
    """The first half is what cameras see now, the second half what they should see."""
    both = pixels(scene, CAMERAS)
    then = np.empty((3, 3, 128, 128), dtype=np.uint8)
    camera_pixels(scene, CAMERAS, then, goals=True)

    assert both.shape == (6, 3, 128, 128)
    assert both.dtype == np.uint8
    np.testing.assert_array_equal(both[:3], now(scene))
    np.testing.assert_array_equal(both[3:], then)


def test_goals_are_not_seen_now(scene: Scene) -> None:
    """What cameras see now does not depend on the goals."""
    np.testing.assert_array_equal(now(scene), now(scene.with_(goals=())))


def test_goals_of_another_scene(scene: Scene) -> None:
    """The goal pictures can be those of another scene."""
    other = scene.with_(goals=())
    both = pixels(scene, CAMERAS, goals=other)

    np.testing.assert_array_equal(both[3:], pixels(other, CAMERAS)[3:])
    assert (both[3:] != pixels(scene, CAMERAS)[3:]).any()


def test_goal_pictures_can_be_kept(scene: Scene) -> None:
    """They do not depend on the state, nor on the looks of the blocks."""
    later = scene.with_(
        state=scene.state.copy(),
        parameters={**scene.parameters, ("tool_block", "color"): np.array([0.0, 0.0, 1.0])},
    )
    later.state.vector[:9] += 0.1
    later.state.positions[:] += 0.01
    before, after = pixels(scene, CAMERAS), pixels(later, CAMERAS)

    assert (before[:3] != after[:3]).any()
    np.testing.assert_array_equal(before[3:], after[3:])


@pytest.mark.parametrize(
    "change",
    [
        {("robot", "height"): np.array(0.36)},
        {("floor", "color"): np.array([0.9, 0.9, 0.1])},
        {("stage", "color"): np.array([0.9, 0.1, 0.1])},
        {("barrier", "position"): np.array([0.05, -0.08, 0.025])},
    ],
    ids=lambda change: ".".join(next(iter(change))),
)
def test_what_both_pictures_depend_on(scene: Scene, change: dict) -> None:  # type: ignore[type-arg]
    """Arena, obstacles and robot are the same in both halves."""
    before = pixels(scene, CAMERAS)
    after = pixels(scene.with_(parameters={**scene.parameters, **change}), CAMERAS)

    assert (before[:3] != after[:3]).any()
    assert (before[3:] != after[3:]).any()
    np.testing.assert_array_equal(before, pixels(scene, CAMERAS))  # caches mix up nothing


def test_light_is_seen_in_both_halves(scene: Scene) -> None:
    """Another light changes what is seen now and the goal pictures."""
    before = pixels(scene, CAMERAS)
    after = pixels(scene.with_(light=Light((-1.0, 0.0, 1.0), 0.1)), CAMERAS)

    assert (before[:3] != after[:3]).any()
    assert (before[3:] != after[3:]).any()


@pytest.mark.parametrize("size", [(64, 64), (48, 80), (200, 96)])
def test_any_size(scene: Scene, size: tuple[int, int]) -> None:
    """Pictures of any size are those of cameras of that size."""
    both = pixels(scene, CAMERAS[:2], size=size)
    cameras = [replace(camera, height=size[0], width=size[1]) for camera in CAMERAS[:2]]

    assert both.shape == (4, 3, *size)
    np.testing.assert_array_equal(both, pixels(scene, cameras))
    inside = render(scene.with_(goals=()), cameras[0])
    mask = ~inside.shows("floor")
    np.testing.assert_array_equal(both[0].transpose(1, 2, 0)[mask], inside.rgb[mask])


def test_convention_of_the_predecessor(scene: Scene) -> None:
    """Its pictures are flipped, have their channels last, and no obstacles in the goal half."""
    scene = scene.with_(light=Light(ambient=1.0))  # no shadows
    both = pixels(scene, ORIGINAL_CAMERAS, published=True)

    assert both.shape == (6, 128, 128, 3)
    for got, camera in zip(both[:3], ORIGINAL_CAMERAS, strict=True):
        np.testing.assert_array_equal(got[::-1], render(scene.with_(goals=()), camera).rgb)
    for got, camera in zip(both[3:], ORIGINAL_CAMERAS, strict=True):
        np.testing.assert_array_equal(got[::-1], render(parked(scene, obstacles=False), camera).rgb)


def test_any_array_can_be_written(scene: Scene) -> None:
    """Arrays that are parts of others, or lie in memory in another order, are filled as well."""
    expected = now(scene)
    gaps = np.zeros((6, 3, 128, 128), dtype=np.uint8)
    camera_pixels(scene, CAMERAS, gaps[::2])
    columns = np.zeros((3, 3, 128, 128), dtype=np.uint8, order="F")
    camera_pixels(scene, CAMERAS, columns)

    np.testing.assert_array_equal(gaps[::2], expected)
    np.testing.assert_array_equal(columns, expected)
    assert not gaps[1::2].any()


def test_depth_and_segmentation_are_those_of_render(scene: Scene) -> None:
    """They are equal bit for bit whether pixels are colored or not."""
    for camera in CAMERAS:
        image, plain = render(scene, camera), render(scene, camera, colors=False)
        assert plain.rgb.size == 0
        assert plain.depth.dtype == np.float32
        assert plain.segmentation.dtype == np.int32
        np.testing.assert_array_equal(plain.depth, image.depth)
        np.testing.assert_array_equal(plain.segmentation, image.segmentation)


def test_scene_is_left_alone(scene: Scene) -> None:
    """Drawing changes neither the scene nor what is drawn later."""
    state, first = scene.state.copy(), pixels(scene, CAMERAS)
    first[:] = 7
    parameters = {key: value.copy() for key, value in scene.parameters.items()}
    again = pixels(scene, CAMERAS)
    again[:] = 9

    assert scene.state == state
    assert all((scene.parameters[key] == value).all() for key, value in parameters.items())
    np.testing.assert_array_equal(pixels(scene, CAMERAS), pixels(scene, CAMERAS))
    assert len(np.unique(pixels(scene, CAMERAS))) > 20


SNIPPET = """
import hashlib, numpy
from scm_world.backends.renderer import camera_pixels
from scm_world.tasks.trifinger.system import trifinger
from scm_world.tasks.trifinger.cameras import CAMERAS
pixels = numpy.empty((3, 3, 128, 128), numpy.uint8)
camera_pixels(trifinger(("a", "b")).default_scene(), CAMERAS, pixels)
print(hashlib.sha256(pixels.tobytes()).hexdigest())
"""


def test_pixels_are_equal_between_processes() -> None:
    """Another process sees the same pixels, bit for bit."""
    ours = np.empty((3, 3, 128, 128), np.uint8)
    camera_pixels(trifinger(("a", "b")).default_scene(), CAMERAS, ours)
    theirs = subprocess.run(  # noqa: S603 (our own interpreter and our own program)
        [sys.executable, "-c", SNIPPET], capture_output=True, text=True, check=True
    )

    assert theirs.stdout.strip() == hashlib.sha256(ours.tobytes()).hexdigest()
