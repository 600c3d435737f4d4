"""Data of the real TriFinger: the layout of ``trifinger_rl_datasets`` as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Floats
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.tasks.trifinger.platform import turned, turned_orientations

if TYPE_CHECKING:
    import pandas as pd

_PARTS = (
    ("achieved_goal", 0, ""),
    ("action", 9, ""),
    ("camera_observation.confidence", 1, "camera.confidence"),
    ("camera_observation.delay", 1, "camera.delay"),
    ("camera_observation.object_keypoints", 24, ""),
    ("camera_observation.object_orientation", 4, "tool_block.orientation"),
    ("camera_observation.object_position", 3, "tool_block.cartesian_position"),
    ("desired_goal", 0, "goal_block.cartesian_position"),
    ("robot_observation.fingertip_force", 3, "fingertip_forces"),
    ("robot_observation.fingertip_position", 9, "end_effector_positions"),
    ("robot_observation.fingertip_velocity", 9, ""),
    ("robot_observation.position", 9, "joint_positions"),
    ("robot_observation.robot_id", 1, "robot_id"),
    ("robot_observation.torque", 9, "joint_torques"),
    ("robot_observation.velocity", 9, "joint_velocities"),
)
"""Parts of an observation in the order in which Gymnasium flattens them, by names: how many numbers
each has (0 stands for those of a goal), and its name in the table, if it is there."""

_GOALS = {"object_position": 3, "object_keypoints": 24}
"""Goals of pushing and of lifting, and their numbers: an observation has 97 or 139."""


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
        Rows with ``episode``, ``step``, observed variables (vectors are ``NAME[0]``, ``NAME[1]``,
        …), ``action``, ``reward`` and ``intervention_targets``.

    Raises:
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
    import pandas

    missing = sorted({"observations", "actions", "rewards"} - set(data))
    if not {"timeouts", "terminals"} & set(data):
        missing.append("timeouts")
    if missing:
        advice = "give what get_dataset() of trifinger_rl_datasets gives"
        raise UnreadableFile("the data", f"they lack {', '.join(missing)}", advice)
    parts = _parts(data["observations"])
    n = len(parts["robot_id"])
    parts |= {"action": _array(data, "actions", (n, 9)), "reward": _array(data, "rewards", (n,))}
    ends = np.zeros(n, dtype=bool)
    for name in {"timeouts", "terminals"} & set(data):
        ends |= _array(data, name, (n,)) != 0.0
    episode = np.cumsum(ends) - ends
    first = np.flatnonzero(np.diff(episode, prepend=-1))
    step = np.arange(n) - np.repeat(first, np.diff(first, append=n))
    columns: dict[str, Any] = {"episode": episode.astype(np.int64), "step": step}
    for name, part in parts.items():
        rows = part.reshape(n, -1).T
        columns |= {f"{name}[{i}]" if len(rows) > 1 else name: row for i, row in enumerate(rows)}
    return pandas.DataFrame(columns).assign(intervention_targets=None)


def _array(data: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Floats:
    """Return numbers of a shape, all finite."""
    allowed = (f"finite numbers of shape {shape}, as there are {shape[0]} observations",)
    try:
        found = np.asarray(data[name], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UnknownOption(name, f"not an array of numbers ({error})", allowed) from None
    if found.shape != shape or not np.isfinite(found).all():
        given = f"of shape {found.shape}" if found.shape != shape else "not finite"
        raise UnknownOption(name, given, allowed)
    return found


def _parts(observations: Any) -> dict[str, Floats]:
    """Return the parts of observations by their names in the table, in this package's frame."""
    nested = isinstance(observations, Sequence) and bool(observations)
    if nested and all(isinstance(row, Mapping) for row in observations):
        observations = _flattened(observations)
    flat = np.asarray(observations)
    widths = {sum(own or size for _, own, _ in _PARTS): size for size in _GOALS.values()}
    if flat.ndim != 2 or flat.shape[1] not in widths or flat.dtype.kind != "f" or not len(flat):
        allowed = (*(f"shape (n, {width})" for width in widths), "a list of whole dictionaries")
        raise UnknownOption("observations", f"{flat.dtype} of shape {flat.shape}", allowed)
    flat = _array({"observations": flat}, "observations", flat.shape)
    ends = np.cumsum([size or widths[flat.shape[1]] for _, size, _ in _PARTS])
    pieces = np.split(flat, ends[:-1], axis=1)
    found = {name: piece for (*_, name), piece in zip(_PARTS, pieces, strict=True) if name}
    facing, goal = "tool_block.orientation", "goal_block.cartesian_position"
    if not np.allclose(np.linalg.norm(found[facing], axis=1), 1.0, atol=0.05):
        allowed = ("observations in SI units: make the environment with scale_obs=False",)
        raise UnknownOption("orientation of the cube", "no unit quaternion", allowed)
    found[goal] = found[goal].reshape(len(flat), -1, 3).mean(axis=1)
    for name in ("end_effector_positions", "tool_block.cartesian_position", goal):
        found[name] = turned(found[name].reshape(len(flat), -1, 3), -1).reshape(len(flat), -1)
    found[facing] = turned_orientations(found[facing], -1)
    return found


def _flattened(rows: Sequence[Mapping[str, Any]]) -> Floats:
    """Return dictionaries as flat observations."""
    goal = next(iter(rows[0].get("desired_goal", ())), "")
    goal, found = goal if goal in _GOALS else "object_position", []
    for number, row in enumerate(rows):
        for name, size, _ in _PARTS:
            first, _, second = name.partition(".")
            part, second = row.get(first, {}), second if size else goal
            part = np.ravel(part.get(second, ()) if second else part)
            if part.shape != (size := size or _GOALS[goal],):
                given = f"{len(part)} numbers in observation {number}"
                raise UnknownOption(name, given, (f"{size}, as flatten_obs=False gives",))
            found.append(part)
    return np.concatenate(found).reshape(len(rows), -1)
