"""Pictures and windows."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from envs import BACKENDS, REACHING, make
from model_tasks import Balance

from scm_world.env import MODEL_ID
from scm_world.env.pictures import has_screen
from scm_world.errors import EngineError, UnknownOption
from scm_world.tasks.trifinger.cameras import CAMERAS


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Pretend that there is a screen; give the windows that were opened."""
    import mujoco.viewer

    windows: list[Any] = []

    class Handle:
        def __init__(self, model: Any, data: Any, **_: Any) -> None:
            self.model, self.data, self.synced, self.open = model, data, 0, True
            self.user_scn = mujoco.MjvScene(model, maxgeom=50)
            windows.append(self)

        def is_running(self) -> bool:
            return self.open

        def lock(self) -> Any:
            return np.errstate()  # any context will do

        def sync(self) -> None:
            self.synced += 1

        def close(self) -> None:
            self.open = False

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(mujoco.viewer, "launch_passive", Handle)
    return windows


def test_without_a_screen_a_window_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no screen, the error says so when the environment is made."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert not has_screen()
    with pytest.raises(EngineError, match="rgb_array"):
        make(render_mode="human")
    assert make().unwrapped.metadata["render_modes"] == ["rgb_array"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_window_shows_every_step(backend: str, screen: list[Any]) -> None:
    """Whatever the engine, MuJoCo's window shows where things are, goals included."""
    env = make(backend=backend, render_mode="human")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.ones(9))
    env.unwrapped.do({"block.size": [0.08, 0.08, 0.08]})
    assert env.render() is None
    (window,) = screen
    assert window.synced == 5
    world = env.unwrapped.world
    np.testing.assert_allclose(window.data.qpos[:9], world["joint_positions"], atol=1e-6)
    np.testing.assert_allclose(window.model.geom("tool_block").size, 0.04)
    goal = window.user_scn.geoms[0]
    np.testing.assert_allclose(goal.pos, world["goal_block.cartesian_position"], atol=1e-6)
    np.testing.assert_allclose(goal.size, 0.04, atol=1e-6)
    env.close()
    assert not window.open


def test_a_window_for_other_bodies_is_a_new_one(screen: list[Any]) -> None:
    """When bodies come, another window opens; what someone has closed stays closed."""
    env = make(REACHING, render_mode="human")
    env.reset(seed=0)
    env.unwrapped.do({"number_of_obstacles": 1})
    env.render()
    first, second = screen
    assert (first.open, second.open) == (False, True)
    second.open = False
    env.render()
    assert second.synced == 1


def test_depth_and_segmentation_agree() -> None:
    """What shows the block is nearer than the floor behind it."""
    env = make().unwrapped
    env.reset(seed=0)
    image = env.image(CAMERAS[1])
    numbers, names, depth = image.segmentation, image.names, image.depth
    assert numbers.shape == depth.shape == (128, 128)
    assert {"floor", "tool_block"} <= {names[i] for i in np.unique(numbers[numbers >= 0])}
    assert 0.2 < depth[numbers == names.index("tool_block")].mean() < 0.8


@pytest.mark.skipif(importlib.util.find_spec("moviepy") is None, reason="needs moviepy")
def test_videos_are_recorded(tmp_path: Path) -> None:
    """Gymnasium's wrapper records an episode."""
    env = gymnasium.wrappers.RecordVideo(make(render_mode="rgb_array"), str(tmp_path / "new"))
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
    assert list(tmp_path.glob("new/*.mp4"))


def test_frames_can_be_collected() -> None:
    """Gymnasium's wrapper collects a picture of every step."""
    env = gymnasium.wrappers.RenderCollection(make(render_mode="rgb_array"))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    frames = env.render()
    assert [frame.shape for frame in frames] == [(480, 640, 3)] * 2
    assert SimpleNamespace(**env.metadata).render_fps == 25


@pytest.mark.parametrize("size", [(30, 40), 24])
def test_pictures_for_people_have_the_camera_and_the_size_that_were_asked_for(size: Any) -> None:
    """Of the robot's tasks and of models; what does not exist is refused at once."""
    given = {"render_mode": "rgb_array", "render_size": size}
    shape = np.broadcast_to(size, 2).tolist()
    pictures = []
    for camera in ("60", "120", None, CAMERAS[1]):
        env = make(render_camera=camera, **given)
        env.reset(seed=0)
        pictures.append(env.render())
        assert [*pictures[-1].shape] == [*shape, 3]
    assert not np.array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[1], pictures[3])
    for camera in ("side", "automatic", None):
        model = gymnasium.make(MODEL_ID, model=Balance(), render_camera=camera, **given)
        model.reset(seed=0)
        assert [*model.render().shape] == [*shape, 3]
    with pytest.raises(UnknownOption, match="camera"):
        make(render_camera="61")
    with pytest.raises(UnknownOption, match="render_size"):
        make(render_size=(10.5, 4))
    with pytest.raises(UnknownOption, match="render_size"):
        make(render_size=0)
