"""Data of the real TriFinger. ``trifinger_rl.npz`` was recorded by trifinger_rl_datasets 1.0.3.

It has two episodes of six steps with random torques, in its simulations of pushing and lifting.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import Dataset, from_frame, load, save
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.geometry.rotations import rotation_matrix
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import forward
from scm_world.tasks.trifinger.platform import turned
from scm_world.tasks.trifinger.real_robot import from_trifinger_rl

SAMPLE = Path(__file__).parent / "trifinger_rl.npz"


def given(task: str = "push") -> dict[str, Any]:
    """Return what their ``get_dataset`` gives."""
    with np.load(SAMPLE) as file:
        names = ("observations", "actions", "rewards", "timeouts")
        return {name: file[f"{task}_{name}"] for name in names}


def table(data: dict[str, Any]) -> Dataset:
    """Make a table for discovery."""
    return from_frame(from_trifinger_rl(data))


def numbers(found: Dataset, name: str) -> Any:
    """Return all columns of a vector."""
    return np.array([found[column] for column in found.names if column.startswith(f"{name}[")]).T


def nested(flat: Any) -> list[dict[str, Any]]:
    """Return flat observations of pushing as dictionaries."""
    rows, at = [dict[str, Any]() for _ in flat], 0
    camera = {"confidence": 1, "delay": 1, "object_keypoints": (8, 3)}
    camera |= {"object_orientation": 4, "object_position": 3}
    robot = {"fingertip_force": 3, "fingertip_position": (3, 3), "fingertip_velocity": (3, 3)}
    robot |= {"position": 9, "robot_id": 1, "torque": 9, "velocity": 9}
    goal = {"object_position": 3}
    whole: dict[str, Any] = {"achieved_goal": goal, "action": 9, "camera_observation": camera}
    for name, parts in {**whole, "desired_goal": goal, "robot_observation": robot}.items():
        for part, shape in parts.items() if isinstance(parts, dict) else [(None, parts)]:
            size = int(np.prod(shape))
            for row, numbers in zip(rows, flat[:, at : at + size], strict=True):
                into = row if part is None else row.setdefault(name, {})
                into[part or name] = numbers.reshape(shape)
            at += size
    return rows


@pytest.mark.parametrize("task", ["push", "lift"])
def test_a_table_has_the_episodes_and_their_numbers(task: str) -> None:
    """Rows are split where episodes end; what needs no turning is there as it was."""
    data = given(task)
    found = table(data)
    assert found.episode.tolist() == [0] * 6 + [1] * 6
    assert found.step.tolist() == [*range(6)] * 2
    np.testing.assert_array_equal(numbers(found, "action"), data["actions"])
    np.testing.assert_array_equal(found["reward"], data["rewards"])
    np.testing.assert_array_equal(numbers(found, "joint_velocities"), data["observations"][:, -9:])
    assert found.truth is None


@pytest.mark.parametrize("task", ["push", "lift"])
def test_places_and_turns_are_those_of_this_package(task: str) -> None:
    """The corners that the cameras say are those of the cube where the table has it."""
    data = given(task)
    found = table(data)
    at = {"push": 3 + 9 + 2, "lift": 24 + 9 + 2}[task]
    corners = turned(data["observations"][:, at : at + 24].reshape(-1, 8, 3), -1)
    place = numbers(found, "tool_block.cartesian_position")
    facing = numbers(found, "tool_block.orientation")
    np.testing.assert_allclose(corners.mean(axis=1), place, atol=1e-6)
    for points, middle, quaternion in zip(corners, place, facing, strict=True):
        own = (points - middle) @ rotation_matrix(quaternion)
        np.testing.assert_allclose(np.abs(own), 0.0325, atol=1e-6)
    assert (facing[:, 3] >= 0.0).all()
    tips = numbers(found, "end_effector_positions").reshape(-1, 3, 3)
    ours = forward(np.array(hardware.REST), hardware.NOMINAL_HEIGHT).reshape(3, 3)
    apart = [np.arctan2(points[:, 1], points[:, 0]) for points in (tips[0], ours)]
    assert np.abs(np.degrees(np.angle(np.exp(1j * (apart[0] - apart[1]))))).max() < 30.0


def test_dictionaries_give_the_same_table() -> None:
    """Flat observations and dictionaries are two forms of one thing."""
    data = given()
    other = {**data, "observations": nested(data["observations"])}
    assert table(other) == table(data)


def test_a_table_survives_its_file(tmp_path: Path) -> None:
    """It is saved and loaded like any other table, with the terminals in place of timeouts."""
    data = given("lift")
    data["terminals"] = data.pop("timeouts")
    found = table(data)
    save(found, tmp_path / "real")
    assert load(tmp_path / "real") == found


def without(data: dict[str, Any], name: str) -> dict[str, Any]:
    """Leave something out."""
    return {other: value for other, value in data.items() if other != name}


def test_other_layouts_are_refused() -> None:
    """What is missing, filtered, scaled, of another shape or not finite is named."""
    data = given()
    rows = nested(data["observations"])
    del rows[3]["camera_observation"]["delay"]
    for other, message in (
        ({"observations": data["observations"][:, :90]}, r"\(12, 90\).*\(n, 97\)"),
        ({"observations": data["observations"][:0]}, r"\(0, 97\).*\(n, 97\)"),
        ({"observations": 0.1 * data["observations"]}, "scale_obs=False"),
        ({"observations": rows}, "delay cannot be '0 numbers in observation 3'"),
        ({"observations": [{}] * 12}, "cannot be '0 numbers in observation 0'"),
        ({"actions": data["actions"][:5]}, r"actions.*\(5, 9\).*\(12, 9\)"),
        ({"rewards": np.full(12, np.nan)}, "rewards.*not finite"),
        ({"rewards": ["much"] * 12}, "rewards.*not an array of numbers"),
        ({"timeouts": True}, r"timeouts.*\(12,\)"),
    ):
        with pytest.raises(UnknownOption, match=message):
            from_trifinger_rl({**data, **other})
    for name in ("actions", "timeouts"):
        with pytest.raises(UnreadableFile, match=f"lack {name}"):
            from_trifinger_rl(without(data, name))
