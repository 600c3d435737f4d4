"""Data of the real TriFinger: the layout of ``trifinger_rl_datasets`` as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._arguments import load
from scm_world._types import Floats
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.tasks.trifinger.platform import turned, turned_orientations

if TYPE_CHECKING:
    import pandas as pd

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
"""Columns of the table, and their sources; vectors are ``NAME[0]``, ``NAME[1]``, …"""

_LAST = "robot_observation.velocity"
_PLACE = "camera_observation.object_position"
_FACING = "camera_observation.object_orientation"


def _layout(goal: str) -> dict[str, slice]:
    """Return the slices of a flat observation: as Gymnasium flattens, by names in order."""
    length = {"object_position": 3, "object_keypoints": 24}[goal]
    sizes = {
        f"achieved_goal.{goal}": length,
        "action": 9,
        "camera_observation.confidence": 1,
        "camera_observation.delay": 1,
        "camera_observation.object_keypoints": 24,
        _FACING: 4,
        _PLACE: 3,
        f"desired_goal.{goal}": length,
        "robot_observation.fingertip_force": 3,
        "robot_observation.fingertip_position": 9,
        "robot_observation.fingertip_velocity": 9,
        "robot_observation.position": 9,
        "robot_observation.robot_id": 1,
        "robot_observation.torque": 9,
        _LAST: 9,
    }
    found, end = dict[str, slice](), 0
    for name, size in sizes.items():
        found[name], end = slice(end, end + size), end + size
    return found


_LAYOUTS = {goal: _layout(goal) for goal in ("object_position", "object_keypoints")}
"""Of flat observations: 97 numbers of pushing, 139 of lifting."""


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
            ``rewards``, shape (n,); and ``timeouts`` or ``terminals``, shape (n,), true at the
            last step of each episode. Rows have to follow one another, as they do without
            ``indices``. An episode that is cut off is kept; its steps count from its first row.

    Returns:
        Rows with ``episode``, ``step``, the columns ``COLUMNS`` and ``intervention_targets``.

    Raises:
        MissingExtra: pandas is not installed.
        UnreadableFile: Something is missing.
        UnknownOption: Something has another shape, is filtered or scaled, or is not finite.

    Source:
        Gürtler et al., *Benchmarking Offline Reinforcement Learning on Real-Robot Hardware*, ICLR
        2023; ``trifinger_rl_datasets`` 1.0.3.

    Example:
        >>> ends = np.array([False, True, False])
        >>> rows = np.zeros((3, 97))
        >>> rows[:, 41] = 1.0  # of the quaternion of the cube
        >>> given = {"observations": rows, "actions": np.zeros((3, 9))}
        >>> found = from_trifinger_rl({**given, "rewards": np.zeros(3), "timeouts": ends})
        >>> found["episode"].tolist(), found["step"].tolist(), "action[8]" in found
        ([0, 0, 1], [0, 1, 0], True)
    """
    pandas: Any = load("pandas", "pandas", "data")
    missing = sorted({"observations", "actions", "rewards"} - set(data))
    if not {"timeouts", "terminals"} & set(data):
        missing.append("timeouts")
    if missing:
        advice = "give what get_dataset() of trifinger_rl_datasets gives"
        raise UnreadableFile("the data", f"they lack {', '.join(missing)}", advice)
    parts = _parts(data["observations"])
    n = len(parts["desired_goal"])
    parts |= {"actions": _array(data, "actions", (n, 9)), "rewards": _array(data, "rewards", (n,))}
    ends = np.zeros(n, dtype=bool)
    for name in {"timeouts", "terminals"} & set(data):
        ends |= _array(data, name, (n,)) != 0.0
    episode = np.cumsum(ends) - ends
    first = np.flatnonzero(np.diff(episode, prepend=-1))
    step = np.arange(n) - np.repeat(first, np.diff(first, append=n))
    columns: dict[str, Any] = {"episode": episode.astype(np.int64), "step": step}
    for name, source in COLUMNS.items():
        value = parts[source].reshape(n, -1)
        size = value.shape[1]
        columns |= {f"{name}[{i}]" if size > 1 else name: value[:, i] for i in range(size)}
    found: pd.DataFrame = pandas.DataFrame(columns).assign(intervention_targets=None)
    return found


def _array(data: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Floats:
    """Return numbers of a shape, all finite."""
    allowed = (f"finite numbers of shape {shape}, as there are {shape[0]} observations",)
    try:
        found = np.asarray(data[name], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UnknownOption(name, f"what is no array of numbers ({error})", allowed) from None
    if found.shape != shape or not np.isfinite(found).all():
        given = f"of shape {found.shape}" if found.shape != shape else "not finite"
        raise UnknownOption(name, given, allowed)
    return found


def _parts(observations: Any) -> dict[str, Floats]:
    """Return the parts of observations, each of shape (n, k), in this package's frame."""
    nested = isinstance(observations, Sequence) and bool(observations)
    if nested and all(isinstance(row, Mapping) for row in observations):
        goal = next(iter(observations[0].get("desired_goal", ())), "")
        flat = _flattened(observations, _LAYOUTS.get(goal, _LAYOUTS["object_position"]))
    else:
        flat = np.asarray(observations)
    layouts = {layout[_LAST].stop: goal for goal, layout in _LAYOUTS.items()}
    if flat.ndim != 2 or flat.shape[1] not in layouts or flat.dtype.kind != "f" or not len(flat):
        allowed = (*(f"shape (n, {width})" for width in layouts), "a list of whole dictionaries")
        raise UnknownOption("observations", f"{flat.dtype} of shape {flat.shape}", allowed)
    goal = layouts[flat.shape[1]]
    flat = _array({"observations": flat}, "observations", flat.shape)
    found = {name: flat[:, where] for name, where in _LAYOUTS[goal].items()}
    if not np.allclose(np.linalg.norm(found[_FACING], axis=1), 1.0, atol=0.05):
        allowed = ("observations in SI units: make the environment with scale_obs=False",)
        raise UnknownOption("orientation of the cube", "no unit quaternion", allowed)
    place = found[f"desired_goal.{goal}"]
    found["desired_goal"] = place.reshape(len(place), -1, 3).mean(axis=1)
    for name in ("robot_observation.fingertip_position", _PLACE, "desired_goal"):
        points = found[name]
        found[name] = turned(points.reshape(len(points), -1, 3), -1).reshape(points.shape)
    found[_FACING] = turned_orientations(found[_FACING], -1)
    return found


def _flattened(rows: Sequence[Mapping[str, Any]], layout: Mapping[str, slice]) -> Floats:
    """Return dictionaries as flat observations."""
    flat = np.empty((len(rows), layout[_LAST].stop))
    for name, where in layout.items():
        first, _, second = name.partition(".")
        for number, row in enumerate(rows):
            part = row.get(first, {})
            part = np.ravel(part.get(second, ()) if second else part)
            if part.shape != (size := where.stop - where.start,):
                given = f"{len(part)} numbers in observation {number}"
                raise UnknownOption(name, given, (f"{size}, as flatten_obs=False gives",))
            flat[number, where] = part
    return flat
