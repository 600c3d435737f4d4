"""Facts about pictures of obstacles, hulls and light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robot_scenes import box_hull, link_frames

from scm_world._types import Floats
from scm_world.backends.renderer import render
from scm_world.geometry.hulls import Hull, hull_of
from scm_world.geometry.rotations import from_rotation_vector, rotation_matrix
from scm_world.models import GoalRegion, Light, Scene
from scm_world.models.camera import Camera
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.cameras import CAMERAS, OVERVIEW
from scm_world.tasks.trifinger.system import MOUNT, tip_name, trifinger

TOP = Camera("top", eye=(0.0, 0.0, 0.25), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
SMALL = replace(OVERVIEW, width=160, height=120)

SIZE = np.array([0.06, 0.04, 0.05])
TURN = np.array([0.1, 0.2, 0.3, 0.9]) / np.sqrt(0.95)
TETRAHEDRON = hull_of(0.08 * np.vstack([np.zeros(3), np.eye(3)]))


def scene_with(
    hull: Hull | None = None, position: tuple[float, float, float] = (0, 0, 0.1)
) -> Scene:
    """Hold up one block, a box or a hull, in red."""
    hulls = () if hull is None else (("tool_block", hull),)
    scene = trifinger(blocks=("tool_block",), hulls=hulls).default_scene()
    scene.state.positions[0] = position
    scene.state.orientations[0] = TURN
    if hull is not None:
        return scene
    return scene.with_(parameters={**scene.parameters, ("tool_block", "size"): SIZE})


def with_obstacle(**properties: Floats) -> Scene:
    """Stand an obstacle, and one block, into the arena."""
    scene = trifinger(blocks=("tool_block",), obstacles=("barrier",)).default_scene()
    changes = {("barrier", name): np.asarray(value) for name, value in properties.items()}
    return scene.with_(parameters={**scene.parameters, **changes})


def goal(shape: str, hull: Hull | None = None, size: Floats = SIZE) -> GoalRegion:
    """Make a green goal that floats above the table."""
    green = np.array([0.0, 1.0, 0.0])
    return GoalRegion("goal", shape, size, np.array([0.0, 0.0, 0.1]), TURN, green, hull)


def differing(one: Scene, other: Scene, camera: Camera = OVERVIEW) -> int:
    """Count the pixels in which two scenes look unlike, by more than rounding."""
    first, second = (render(scene, camera).rgb.astype(int) for scene in (one, other))
    return int((np.abs(first - second) > 2).any(axis=2).sum())


def test_every_body_has_a_number() -> None:
    """Floor, stage, robot, links, blocks and obstacles have names, pixels their numbers."""
    scene = with_obstacle(size=[0.06, 0.06, 0.06], position=[0.08, 0.0, 0.03])
    image = render(scene, TOP)
    column, row, _ = TOP.project([0.08, 0.0, 0.06])

    expected = {"floor", "stage", "robot", *hardware.LINK_NAMES, "tool_block", "barrier"}
    assert expected <= set(image.names)
    assert scene.structure.body_names == image.names
    assert image.names[image.segmentation[int(row), int(column)]] == "barrier"
    assert image.shows("tool_block").any()


@pytest.mark.parametrize("turned", [False, True])
def test_obstacle_looks_like_a_block(*, turned: bool) -> None:
    """A box looks the same but for rounding, shadow included, whether it can move or not."""
    position, color = np.array([0.05, 0.02, 0.08]), np.array([0.2, 0.5, 0.9])
    orientation = TURN if turned else np.array([0.0, 0.0, 0.0, 1.0])
    block = trifinger(blocks=("it",)).default_scene()
    block.state.positions[0], block.state.orientations[0] = position, orientation
    block = block.with_(
        parameters={**block.parameters, ("it", "size"): SIZE, ("it", "color"): color}
    )
    still = trifinger(obstacles=("it",)).default_scene()
    pose = {("it", "position"): position, ("it", "orientation"): orientation}
    look = {("it", "size"): SIZE, ("it", "color"): color}
    still = still.with_(parameters={**still.parameters, **pose, **look})

    for camera in (TOP, OVERVIEW):
        one, other = render(block, camera), render(still, camera)
        assert differing(block, still, camera) <= 5
        assert (one.shows("it") != other.shows("it")).sum() <= 2


def test_friction_of_an_obstacle_is_not_seen() -> None:
    """What has no look changes no pixel; size, color and pose do."""
    standing = {"size": np.array([0.05, 0.05, 0.05]), "position": np.array([0.08, 0.08, 0.025])}
    before = with_obstacle(**standing)

    assert differing(before, with_obstacle(**standing, friction=np.array(0.9))) == 0
    for name, value in (
        ("size", [0.03, 0.05, 0.05]),
        ("color", [1.0, 1.0, 0.0]),
        ("position", [0.08, 0.05, 0.025]),
        ("orientation", [0.0, 0.0, 0.3, 0.9]),
    ):
        assert differing(before, with_obstacle(**{**standing, name: np.array(value)})) > 20


@pytest.mark.parametrize("camera", [TOP, OVERVIEW], ids=lambda camera: camera.name)
def test_box_as_a_hull_looks_like_a_box(camera: Camera) -> None:
    """Colors, depth, numbers and shadow are the same but for rounding at the edges."""
    box, hull = (render(scene_with(it), camera) for it in (None, box_hull(SIZE)))
    same = box.segmentation == hull.segmentation

    assert (~same).sum() <= 2
    np.testing.assert_allclose(box.depth[same], hull.depth[same], rtol=1e-5)
    assert differing(scene_with(), scene_with(box_hull(SIZE)), camera) <= 5


def test_box_goal_as_a_hull_looks_like_a_box_goal() -> None:
    """Silhouettes of hulls are as translucent; only boxes have visible edges."""
    empty = trifinger().default_scene()
    box, hull = (empty.with_(goals=(it,)) for it in (goal("box"), goal("hull", box_hull(SIZE))))

    assert differing(box, empty) > 500
    assert differing(box, hull) < 0.25 * differing(box, empty)
    assert abs(differing(hull, empty) - differing(box, empty)) <= 5


def test_hull_covers_the_pixels_between_its_corners() -> None:
    """A tetrahedron is seen exactly where a ray passes on the inner side of all its planes."""
    image = render(scene_with(TETRAHEDRON), TOP)

    turn, center = rotation_matrix(TURN), np.array([0.0, 0.0, 0.1])
    rows, columns = np.nonzero(image.shows("tool_block"))
    depth = image.depth[rows, columns].astype(float)
    focal = 64.0 / np.tan(np.radians(26.0))
    points = np.column_stack(
        [(columns + 0.5 - 64.0) * depth / focal, (64.0 - rows - 0.5) * depth / focal, 0.25 - depth]
    )
    planes = np.array(TETRAHEDRON.planes)
    heights = (points - center) @ turn @ planes[:, :3].T - planes[:, 3]
    corners = TOP.project(np.array(TETRAHEDRON.vertices) @ turn.T + center)[:, :2]

    np.testing.assert_allclose(heights.max(axis=1), 0.0, atol=1e-6)
    assert np.ptp(columns) + 1 == pytest.approx(np.ptp(corners[:, 0]), abs=1.5)
    assert np.ptp(rows) + 1 == pytest.approx(np.ptp(corners[:, 1]), abs=1.5)


def test_a_hull_in_its_goal_does_not_flicker() -> None:
    """A block exactly in its goal hides it."""
    scene = scene_with(TETRAHEDRON)
    fulfilled = scene.with_(goals=(goal("hull", TETRAHEDRON),))

    assert differing(fulfilled, scene) <= 5


def test_camera_inside_a_hull() -> None:
    """A camera inside a hull sees nothing but the inside of the hull."""
    scene = scene_with(TETRAHEDRON)
    eye = scene.state.positions[0] + 0.001
    camera = replace(TOP, eye=tuple(eye.tolist()), target=(0.3, 0.2, 0.1), up=(0.0, 0.0, 1.0))
    image = render(scene, camera)

    assert image.shows("tool_block").all()
    assert 0.0 < image.depth.min() < image.depth.max() < 0.2


def test_hulls_and_boxes_side_by_side() -> None:
    """Each block keeps its own shape, whichever comes first."""
    ball = np.random.default_rng(0).normal(size=(20, 3))
    stone = hull_of(0.03 * ball / np.linalg.norm(ball, axis=1, keepdims=True))
    names = ("first", "second", "third")
    hulls = (("first", TETRAHEDRON), ("third", stone))
    scene = trifinger(blocks=names, hulls=hulls).default_scene()
    image = render(scene, TOP)
    alone = trifinger(blocks=names[:1], hulls=(("first", stone),)).default_scene()
    alone.state.positions[:] = scene.state.positions[2]

    assert all(image.shows(name).any() for name in names)
    np.testing.assert_array_equal(render(alone, TOP).shows("first"), image.shows("third"))


def test_block_beneath_the_floor_is_hidden() -> None:
    """What lies below the table top is not seen through it."""
    assert not render(scene_with(position=(0.0, 0.0, -0.05)), TOP).shows("tool_block").any()


def test_shadows_fall_away_from_the_light() -> None:
    """The floor is darker on the side of a block that is turned away from the light."""
    lit, dark = [], []
    empty = trifinger().default_scene()
    for direction in ((1.0, 0.0, 1.0), (-1.0, 0.0, 1.0)):
        light = Light(direction=direction)
        scene = scene_with(position=(0.0, 0.0, 0.06)).with_(light=light)
        now, without = render(scene, TOP), render(empty.with_(light=light), TOP)
        drop = without.rgb.astype(int).sum(axis=2) - now.rgb.astype(int).sum(axis=2)
        drop[~now.shows("floor") | ~without.shows("floor")] = 0
        left, right = drop[:, :64].sum(), drop[:, 64:].sum()
        dark.append(left if direction[0] > 0.0 else right)
        lit.append(right if direction[0] > 0.0 else left)

    assert min(dark) > 1000
    assert max(lit) < 0.2 * min(dark)


def test_length_of_the_direction_does_not_matter() -> None:
    """Light is as bright from afar."""
    one, other = (scene_with().with_(light=Light((0.2 * k, 0.4 * k, 1.0 * k))) for k in (1.0, 4.0))

    assert differing(one, other, SMALL) == 0


def test_default_light_is_the_published_look() -> None:
    """Without a word about light, surfaces turned away from it keep 30 % of their color."""
    below = Light(direction=(0.0, 0.0, -1.0))
    scene = trifinger().default_scene().with_(light=below)
    image = render(scene, TOP)
    floor = image.rgb[image.shows("floor")]

    assert scene_with().light.ambient == 0.3
    expected = np.rint(255.0 * 0.3 * scene.parameters["floor", "color"])
    np.testing.assert_array_equal(floor, np.tile(expected, (len(floor), 1)))


def test_full_ambient_light_has_no_shade() -> None:
    """Everything shows its full color, and no shadow falls."""
    scene = scene_with().with_(light=Light(ambient=1.0))
    image = render(scene, TOP)

    assert (image.rgb[image.shows("tool_block")] == [255, 0, 0]).all()
    assert len(np.unique(image.rgb[image.shows("floor")], axis=0)) == 1


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.3, 0.2, -1.0)])
def test_light_from_the_side_or_below_throws_no_shadow(
    direction: tuple[float, float, float],
) -> None:
    """No light falls on the floor, so nothing can stand in its way."""
    image = render(scene_with().with_(light=Light(direction=direction)), TOP)

    assert len(np.unique(image.rgb[image.shows("floor")], axis=0)) == 1


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)])
def test_light_from_nowhere_is_refused(direction: tuple[float, float, float]) -> None:
    """A direction needs a length."""
    with pytest.raises(ValueError, match="light: the direction"):
        render(scene_with().with_(light=Light(direction=direction)), TOP)


def test_a_turned_hull_turns_in_the_picture() -> None:
    """Half a turn about the optical axis mirrors where a hull is seen."""
    scene = scene_with(TETRAHEDRON, position=(0.0, 0.0, 0.15))
    scene.state.orientations[0] = (0.0, 0.0, 0.0, 1.0)
    straight = render(scene, TOP).shows("tool_block")
    scene.state.orientations[0] = from_rotation_vector([0.0, 0.0, np.pi])
    turned = render(scene, TOP).shows("tool_block")

    assert (straight[::-1, ::-1] != turned).sum() <= 4
    assert (straight != turned).sum() > 20


@pytest.mark.parametrize("camera", [OVERVIEW, *CAMERAS], ids=lambda camera: camera.name)
def test_fingers_cover_the_pixels_whose_rays_pass_them(camera: Camera) -> None:
    """The robot is seen where a ray comes closer to the axis of a capsule than its radius."""
    camera = replace(camera, width=80, height=60)
    scene = trifinger().default_scene()
    image = render(scene, camera)
    frames = link_frames(scene.state.joint_positions)
    step = 2.0 * np.tan(np.radians(camera.field_of_view) / 2.0) / 60
    v, u = np.mgrid[:60, :80]
    seen = np.stack([(u - 39.5) * step, (29.5 - v) * step, np.full(u.shape, -1.0)], axis=-1)
    rays = (seen / np.linalg.norm(seen, axis=-1, keepdims=True)).reshape(-1, 3) @ camera.axes()
    expected = np.zeros(60 * 80, dtype=bool)
    capsules = (MOUNT, *hardware.COLLISION.values()) * 3
    for position, turn, capsule in zip(*frames, capsules, strict=True):
        along = np.linspace(capsule.start, capsule.end, 80)
        points = along @ rotation_matrix(turn).T + position - camera.eye
        squared = (points**2).sum(axis=1) - (rays @ points.T) ** 2
        expected |= (squared < capsule.radius**2).any(axis=1)
    names = (*hardware.LINK_NAMES, *map(tip_name, hardware.FINGERS))
    robot = np.any([image.shows(name) for name in names], axis=0)
    unlike = (robot != expected.reshape(60, 80)) & ~image.shows("robot")

    assert robot.sum() > 200
    assert unlike.sum() <= 5
