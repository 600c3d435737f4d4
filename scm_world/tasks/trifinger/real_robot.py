"""Data of the real TriFinger: the layout of ``trifinger_rl_datasets`` as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption
from scm_world.tasks.trifinger.platform import facing_there, turned

if TYPE_CHECKING:
    import pandas as pd

_CAMERA = {"confidence": 1, "delay": 1, "object_keypoints": 24} | {
    "object_orientation": 4,
    "object_position": 3,
}
_ROBOT = {"fingertip_force": 3, "fingertip_position": 9, "fingertip_velocity": 9} | {
    "position": 9,
    "robot_id": 1,
    "torque": 9,
    "velocity": 9,
}

COLUMNS: Mapping[str, str] = {
    "joint_positions": "robot_observation.position",
    "joint_velocities": "robot_observation.velocity",
    "joint_torques": "robot_observation.torque",
    "end_effector_positions": "robot_observation.fingertip_position",
    "fingertip_forces": "robot_observation.fingertip_force",
    "tool_block.cartesian_position": "camera_observation.object_position",
    "tool_block.orientation": "camera_observation.object_orientation",
    "goal_block.cartesian_position": "desired_goal",
    "camera.delay": "camera_observation.delay",
    "camera.confidence": "camera_observation.confidence",
    "robot_id": "robot_observation.robot_id",
    "action": "actions",
    "reward": "rewards",
}
"""Of the table, and what each is there; vectors are ``NAME[0]``, ``NAME[1]``, …"""

_PLACE = "camera_observation.object_position"
_FACING = "camera_observation.object_orientation"


def _layout(goal: str) -> dict[str, slice]:
    """Say where things stand in a flat observation: as Gymnasium flattens, by names in order."""
    length = {"object_position": 3, "object_keypoints": 24}[goal]
    sizes = {f"achieved_goal.{goal}": length, "action": 9}
    sizes |= {f"camera_observation.{name}": size for name, size in _CAMERA.items()}
    sizes |= {f"desired_goal.{goal}": length}
    sizes |= {f"robot_observation.{name}": size for name, size in _ROBOT.items()}
    ends = np.cumsum([*sizes.values()]).tolist()
    return {
        name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }


_FLAT = {
    layout["robot_observation.velocity"].stop: layout
    for layout in map(_layout, ("object_position", "object_keypoints"))
}
"""By the width of a flat observation: 97 of pushing, 139 of lifting."""


def from_trifinger_rl(data: Mapping[str, Any]) -> pd.DataFrame:
    """Make a table of a dataset of ``trifinger_rl_datasets``, recorded on real robots or simulated.

    Rows are control steps of 20 ms. Columns have the names of this package, in SI units (forces of
    fingertips are uncalibrated). Positions and orientations are turned about the vertical, as for
    the backend ``trifinger_platform``, so that fingers stand as in the tasks of this package.
    Joints are those of the TriFinger Pro, whose links are others, and actions are its torques [N
    m]. The pose of the cube is as late as ``camera.delay`` [s] says. Of the goal of lifting the
    table has the place, not the orientation.

    ``scm_world.discovery.data.from_frame`` makes a ``Dataset`` of it. Nothing was intervened on,
    and no true graph is known; actions follow from observations by the policy that was recorded.

    Args:
        data: What ``env.get_dataset()`` gave: ``observations``, shape (n, 97) or (n, 139), or a
            list of dictionaries (``flatten_obs=False``); ``actions``, shape (n, 9) [N m];
            ``rewards``, shape (n,); and ``timeouts`` or ``terminals``, true at the last step of
            each episode. An episode that is cut off at the end is kept.

    Returns:
        Rows with ``episode``, ``step``, the columns ``COLUMNS`` and ``intervention_targets``.

    Raises:
        UnknownOption: Flat observations have another width: they are filtered, or of other data.
        ModelError: Something is missing, or numbers of rows differ.

    Source:
        Gürtler et al., *Benchmarking Offline Reinforcement Learning on Real-Robot Hardware*, ICLR
        2023; ``trifinger_rl_datasets`` 1.0.3.

    Example:
        >>> ends = np.array([False, True, False])
        >>> given = {"observations": np.zeros((3, 97)), "actions": np.zeros((3, 9))}
        >>> found = from_trifinger_rl({**given, "rewards": np.zeros(3), "timeouts": ends})
        >>> found["episode"].tolist(), found["step"].tolist(), "action[8]" in found
        ([0, 0, 1], [0, 1, 0], True)
    """
    import pandas as pd

    missing = sorted({"observations", "actions", "rewards"} - set(data))
    if missing:
        advice = "give what get_dataset() of trifinger_rl_datasets gives"
        raise ModelError([f"the data lack {', '.join(missing)}: {advice}"])
    parts = _parts(data["observations"])
    parts |= {name: np.asarray(data[name], float) for name in ("actions", "rewards")}
    lengths = {"observations": len(parts["desired_goal"])}
    lengths |= {name: len(parts[name]) for name in ("actions", "rewards")}
    n = lengths["rewards"]
    if {*lengths.values()} != {n} or parts["actions"].shape[1:] != (9,):
        raise ModelError([f"rows differ: {lengths}, and actions have {parts['actions'].shape[1:]}"])
    ends = np.zeros(n, dtype=bool)
    for name in ("timeouts", "terminals"):
        ends |= np.asarray(data.get(name, ends), dtype=bool)
    episode = np.cumsum(ends) - ends
    first = np.flatnonzero(np.diff(episode, prepend=-1))
    step = np.arange(n) - np.repeat(first, np.diff(first, append=n))
    columns: dict[str, Any] = {"episode": episode.astype(np.int64), "step": step}
    for name, source in COLUMNS.items():
        value = parts[source].reshape(n, -1)
        size = value.shape[1]
        columns |= {f"{name}[{i}]" if size > 1 else name: value[:, i] for i in range(size)}
    return pd.DataFrame(columns).assign(intervention_targets=None)


def _parts(observations: Any) -> dict[str, Floats]:
    """Take observations apart, each of shape (n, k), in this package's frame."""
    goal = "object_position"
    if isinstance(observations, np.ndarray):
        width = observations.shape[-1] if observations.ndim == 2 else None
        if width not in _FLAT:
            allowed = [f"shape (n, {known})" for known in _FLAT]
            advice = "all observations, neither filtered nor scaled"
            raise UnknownOption("observations", observations.shape, (*allowed, advice))
        found = {name: observations[:, where].astype(float) for name, where in _FLAT[width].items()}
        goal = next(name for name in found if name.startswith("desired")).partition(".")[2]
    else:
        try:
            goal = next(iter(observations[0]["desired_goal"]))
            found = {
                name: np.array([np.ravel(_within(row, name)) for row in observations], float)
                for name in _layout(goal)
            }
        except (KeyError, IndexError, TypeError, StopIteration) as error:
            problem = f"an observation lacks {error}: give whole ones, as flatten_obs=False does"
            raise ModelError([problem]) from None
    place = found[f"desired_goal.{goal}"]
    found["desired_goal"] = place.reshape(len(place), -1, 3).mean(axis=1)
    for name in ("robot_observation.fingertip_position", _PLACE, "desired_goal"):
        points = found[name]
        found[name] = turned(points.reshape(len(points), -1, 3), -1).reshape(points.shape)
    found[_FACING] = facing_there(found[_FACING], -1)
    return found


def _within(row: Mapping[str, Any], name: str) -> Any:
    for part in name.split("."):
        row = row[part]
    return row
