"""Logs of robots as tables: ROS 1 and ROS 2 bags, MCAP files, and LeRobot datasets."""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from scm_world._arguments import load
from scm_world._types import Floats
from scm_world.errors import ModelError
from scm_world.runs.files import Location, read_bytes

if TYPE_CHECKING:
    import pandas as pd

BAGS = (".mcap", ".db3", ".bag")
MOST = 64  # numbers of an array that are columns: those of pictures and clouds of points are not
SHOWN = 12  # columns of a topic that a message lists
NEAR = 0.25  # of a control step: largest distance of a measurement from one
SAME = 0.01  # of a physics step: largest distance of a command that is sent at a control step
APART = 60.0  # [s] between the messages of two topics, whose clocks are not the same
VECTORS = ("Vector3", "Point", "Quaternion")  # x, y, z and w are components of a vector
SKIPPED = ("header", "layout", "time_from_start")
ENDS = {"pos": "position", "vel": "velocity"}  # of names in LeRobot datasets

Chosen: TypeAlias = Callable[[Mapping[str, str], bool], dict[str, tuple[str, float]]]
"""Returns the columns that are read, with a name of the world and a factor, of all columns, with
the name that the world may have for each; and gets whether the format defines their units."""


class Log(NamedTuple):
    """The chosen columns of a log, with ``time`` [s]; names of all columns; what it has, in words.

    Attributes:
        table: The chosen columns.
        names: Names of all columns.
        said: Topics or features with their types and columns, in words.
    """

    table: pd.DataFrame
    names: tuple[str, ...]
    said: str


class Step(NamedTuple):
    """The length of a control step [s], its physics steps, and the names of the commands."""

    control_dt: float
    substeps: int
    commands: frozenset[str]


class Clock(NamedTuple):
    """Times of measurements [s], ascending, the control steps that they are, and its length [s]."""

    time: Floats
    steps: Floats
    control_dt: float

    @classmethod
    def of(cls, time: Floats, control_dt: float) -> Clock:
        """Count the control steps from one time to the next, so a clock may drift."""
        steps = np.concatenate([[0.0], np.cumsum(np.rint(np.diff(time) / control_dt))])
        return cls(time, steps, control_dt)

    def places(self, at: Floats) -> Floats:
        """Return times [s] in control steps from the first one."""
        beyond = at - np.clip(at, self.time[0], self.time[-1])
        return np.interp(at, self.time, self.steps) + beyond / self.control_dt

    def times(self, places: Floats) -> Floats:
        """Return the times [s] of numbers of control steps."""
        beyond = places - np.clip(places, 0.0, self.steps[-1])
        return np.interp(places, self.steps, self.time) + beyond * self.control_dt


def is_log(place: Location) -> bool:
    """Return whether a path is a bag, a file of one, or a LeRobot dataset."""
    parts = (place / "metadata.yaml", place / "meta" / "info.json")
    return place.suffix.lower() in BAGS or any(part.exists() for part in parts)


def read_log(place: Location, chosen: Chosen, step: Step) -> Log:
    """Read the chosen columns of a bag or of a LeRobot dataset.

    Raises:
        MissingExtra: rosbags, which reads bags, is not installed.
        ModelError: Nothing is chosen, or measurements lie between control steps.
        Exception: The library that reads it says that it is damaged.
    """
    if (place / "meta" / "info.json").exists():
        return _dataset(place, chosen)
    if not isinstance(place, Path):
        raise ModelError([f"{place} is a bag behind a URL: copy it to this machine"])
    return _bag(place, chosen, step)


def _wanted(
    chosen: Chosen,
    columns: Mapping[str, str],
    of: Mapping[str, str],
    kinds: Mapping[str, str],
    units: bool,
) -> tuple[dict[str, tuple[str, float]], str]:
    """Return the chosen columns, and all columns by topic or feature in words; some are chosen.

    Args:
        chosen: What chooses.
        columns: All columns, with names that the world may have for them.
        of: The topic or feature of each column.
        kinds: The type of each topic or feature.
        units: Whether the format defines units.
    """
    found, parts = chosen(columns, units), []
    for topic, kind in kinds.items():
        own = [name for name in columns if of[name] == topic]
        more = f" and {len(own) - SHOWN} more" * (len(own) > SHOWN)
        parts.append(f"{topic} ({kind}): {', '.join(own[:SHOWN]) or 'no numbers'}{more}")
    if not found:
        advice = "name some by columns={'/topic.field': 'hinge.position'}"
        said = "; ".join(parts) or "no messages"
        raise ModelError([f"no column is one of this world: {advice}; there are {said}"])
    return found, "; ".join(parts)


# --- bags -----------------------------------------------------------------------------------------


def _bag(place: Path, chosen: Chosen, step: Step) -> Log:
    """Read the chosen columns of a bag."""
    import pandas as pd

    typesys = load("rosbags.typesys", "rosbags", "robots")
    usual = typesys.get_typestore(typesys.Stores.LATEST)
    reader = load("rosbags.highlevel", "rosbags", "robots").AnyReader
    columns, of, kinds = dict[str, str](), dict[str, str](), dict[str, str]()
    with reader([place], default_typestore=usual) as bag:
        for link in sorted(bag.connections, key=lambda one: str(one.topic)):
            kinds[link.topic] = link.msgtype
            if link.msgtype not in bag.typestore.fielddefs:
                kinds[link.topic] += ", a custom type that the bag does not define, is not read"
                continue
            for _, _, data in bag.messages([link]):
                message = bag.deserialize(data, link.msgtype)
                try:
                    first = {raw: own for raw, own, _ in _numbers(message, link.topic)}
                except ModelError as error:
                    kinds[link.topic] += f", {error}"
                    break
                columns |= first
                of |= dict.fromkeys(first, link.topic)
                break
        wanted, said = _wanted(chosen, columns, of, kinds, units=True)
        stamps = dict[str, list[int]]()
        rows = dict[str, list[dict[str, float]]]()
        for topic in dict.fromkeys(of[name] for name in wanted):
            links = [link for link in bag.connections if link.topic == topic]
            logged = stamps[topic] = []
            sent, numbers = list[int](), rows.setdefault(topic, [])
            for link, time, data in bag.messages(links):
                message = bag.deserialize(data, link.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                sent.append(stamp.sec * 10**9 + stamp.nanosec if stamp is not None else 0)
                logged.append(time)
                given = {raw: number for raw, _, number in _numbers(message, topic)}
                pairs = ((raw, wanted[raw]) for raw in given if raw in wanted)
                numbers.append({name: given[raw] * factor for raw, (name, factor) in pairs})
            if any(sent):
                stamps[topic] = sent
    begin = min(min(times) for times in stamps.values())
    tables = {
        topic: pd.DataFrame(rows[topic], index=1e-9 * (np.array(times, np.int64) - begin))
        for topic, times in stamps.items()
    }
    return Log(_laid(tables, step), tuple(columns), said)


def _numbers(message: Any, prefix: str) -> Iterator[tuple[str, str, float]]:
    """Yield the numbers of a message: the column, a name that a world may have for it, the value.

    Raises:
        ModelError: A trajectory has several points: their commands have other times.
    """
    kind = message.__msgtype__.rpartition("/")[2]
    parts = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
    names = next((parts.pop(n) for n in ("name", "joint_names") if n in parts), None)
    if kind == "JointTrajectory":
        if len(parts["points"]) != 1:
            said = f"a message of {prefix} has {len(parts['points'])} points: only trajectories"
            raise ModelError([f"{said} of one point are commands; leave it out by ignore="])
        point = parts["points"][0]
        parts = {field.name: getattr(point, field.name) for field in dataclasses.fields(point)}
    for number, (field, value) in enumerate(parts.items()):
        if field in SKIPPED:
            continue
        several = isinstance(value, list | np.ndarray)
        if several and np.size(value) > MOST:
            continue
        each = np.ravel(value).tolist() if isinstance(value, np.ndarray) else value
        each = each if several else [value]
        joint = names if several and isinstance(names, list) and len(each) == len(names) else ()
        for i, one in enumerate(each):
            label, own = f"{prefix}.{field}" + f"[{i}]" * several, ""
            if joint:
                label, own = f"{prefix}.{joint[i]}.{field}", f"{joint[i]}.{field}"
            elif kind in VECTORS:
                label = f"{prefix}[{number}]"
            if isinstance(one, int | float):
                yield label, own * (kind == "JointState"), float(one)
            elif dataclasses.is_dataclass(one):
                yield from _numbers(one, label)


def _laid(tables: Mapping[str, pd.DataFrame], step: Step) -> pd.DataFrame:
    """Lay the messages of topics on control steps; commands are at their own time, and hold.

    The control steps are those of the measured topic with the most messages.

    Args:
        tables: The numbers of each topic by the time of its messages [s].
        step: The control steps, and which columns are commands.

    Raises:
        ModelError: Nothing was measured, or measurements do not lie on control steps.
    """
    import pandas as pd

    tables = {topic: table.sort_index(kind="stable") for topic, table in tables.items()}
    seen = {t: one.drop(columns=step.commands, errors="ignore") for t, one in tables.items()}
    seen = {topic: one for topic, one in seen.items() if len(one.columns)}
    if not seen:
        raise ModelError(["no column that was chosen is a measurement, such as 'hinge.position'"])
    usual = max(seen, key=lambda topic: len(seen[topic]))
    time, dt = seen[usual].index.to_numpy(float), step.control_dt
    clock = Clock.of(time, dt)
    measured, sent = [], []
    for topic, table in tables.items():
        at = table.index.to_numpy(float)
        if at[0] > time[-1] + APART or at[-1] < time[0] - APART:
            said = f"the messages of {topic} and of {usual} are {abs(at[0] - time[0]):.4g} s apart"
            advice = "record both with stamps of one clock, or the log in simulated time"
            raise ModelError([f"{said}, which is another clock: {advice}"])
        place = clock.places(at)
        whole = np.rint(place)
        if topic in seen:
            twice = np.flatnonzero(np.diff(whole) < 1)
            if len(twice) or np.abs(place - whole).max() > NEAR:
                worst = twice[0] + 1 if len(twice) else np.abs(place - whole).argmax()
                period = float(np.median(np.diff(at))) if len(at) > 1 else dt
                said = f"messages of {topic}, {period:.4g} s apart, do not lie on control steps of "
                said += f"{dt:g} s, those of {usual}, first at {at[worst]:.6g} s"
                shorter = f"control_dt={period:.4g}" if period < dt else "a shorter control_dt="
                advice = f"give the world {shorter}, or leave columns out by ignore="
                raise ModelError([f"{said}: {advice}"])
            measured.append(seen[topic].set_axis(whole))
        at_once = np.abs(place - whole) * step.substeps <= SAME
        commands = [name for name in table if name in step.commands]
        if commands:
            kept = table[commands].set_axis(np.where(at_once, whole, place))
            sent.append(kept.groupby(level=0).last())
    found = pd.concat([*measured, *sent], axis=1).sort_index()
    commands = [name for name in found if name in step.commands]
    found[commands] = found[commands].ffill()
    found.insert(0, "time", clock.times(found.index.to_numpy(float)))
    return found.reset_index(drop=True)


# --- LeRobot --------------------------------------------------------------------------------------


def _dataset(place: Location, chosen: Chosen) -> Log:
    """Read the chosen columns of a LeRobot dataset, in the layouts 2.0, 2.1 and 3.0.

    Source:
        Cadene et al., *LeRobot: State-of-the-art machine learning for real-world robotics in
        PyTorch*, 2024: ``LeRobotDataset``.
    """
    import pandas as pd

    features = json.loads(read_bytes(place / "meta" / "info.json"))["features"]
    columns, of, kinds = dict[str, str](), dict[str, str](), dict[str, str]()
    parts = dict[str, tuple[str, int]]()
    for feature, about in features.items():
        kinds[feature], (size, *more) = about["dtype"], about["shape"]
        if "float" not in about["dtype"] or more or feature == "timestamp":
            continue
        given = about.get("names")
        if isinstance(given, dict):  # {"motors": […]}, or names alone
            lists = [one for one in given.values() if isinstance(one, list)]
            given = [name for one in lists for name in one] or [*given]
        named = isinstance(given, list) and len({*map(str, given)}) == size
        for i in range(size):
            raw = f"{feature}.{given[i]}" if named else f"{feature}[{i}]"
            columns[raw], of[raw], parts[raw] = "", feature, (feature, i)
            if named and feature in ("observation.state", "action"):
                stem, dot, end = str(given[i]).rpartition(".")
                last = ENDS.get(end, end) if dot else "position"
                stem = stem if dot else end
                columns[raw] = f"{stem}.{last if feature != 'action' else 'control'}"
    wanted, said = _wanted(chosen, columns, of, kinds, units=False)
    read = ["timestamp", "episode_index", *dict.fromkeys(parts[raw][0] for raw in wanted)]
    files: list[Any] = sorted((place / "data").glob("*/*.parquet"), key=str)
    frames = [pd.read_parquet(io.BytesIO(read_bytes(one)), columns=read) for one in files]
    if not frames:
        raise ModelError([f"{place} has no file data/chunk-000/….parquet: download the data, too"])
    whole = pd.concat(frames, ignore_index=True)
    arrays = {name: np.array(whole[name].tolist(), float) for name in read[2:]}
    table = pd.DataFrame({"time": whole.timestamp.astype(float), "episode": whole.episode_index})
    for raw, (name, factor) in wanted.items():
        feature, i = parts[raw]
        table[name] = arrays[feature].reshape(len(whole), -1)[:, i] * factor
    return Log(table, tuple(columns), said)
