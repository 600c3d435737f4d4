"""Logs of robots: bags of ROS 1 and ROS 2, MCAP files and LeRobot datasets, and their clocks."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
from pendulum import PENDULUM
from typer.testing import CliRunner

import scm_world as sw
from scm_world.cli.app import app
from scm_world.errors import (
    MissingExtra,
    ModelError,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
)
from scm_world.fit.recordings import Reading, RecordedRun, read_recording

BEGIN = 1_700_000_000_123_456_789  # [ns]
DT = 20_000_000  # [ns]
KINDS = ("sqlite3", "mcap", "file.mcap", "ros1")


@pytest.fixture(scope="module")
def world() -> sw.World:
    """A pendulum with a motor, in control steps of 20 ms and physics steps of 2 ms."""
    return sw.World(PENDULUM)


@pytest.fixture(scope="module")
def arrays(world: sw.World) -> dict[str, np.ndarray]:
    """Return a recording of the pendulum with twice the damping."""
    episode = world.rollout("random", seed=1, steps=60, do={"hinge.damping": 0.02})
    return {
        "time": 0.02 * np.arange(61),
        "hinge.position": episode["hinge.position"],
        "motor.control": np.append(episode.actions[:, 0], 0.0),
    }


class Bag:
    """Writes messages into a bag of some kind, by the time of the log."""

    def __init__(self, folder: Path, kind: str) -> None:
        typesys = pytest.importorskip("rosbags.typesys")
        two = kind != "ros1"
        self.store = typesys.get_typestore(
            typesys.Stores.LATEST if two else typesys.Stores.ROS1_NOETIC
        )
        self.two, self.sent = two, list[tuple[int, str, str, Any]]()
        self.place = folder / ("run.bag" if kind == "ros1" else "run")
        self.kind, self.types = kind, self.store.types

    def header(self, stamp: int | None) -> Any:
        """Return a header, without a stamp if None."""
        seconds, rest = divmod(stamp or 0, 10**9)
        time = self.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
        more = {} if self.two else {"seq": 0}
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id="", **more)

    def joints(self, topic: str, log: int, stamp: int | None, **named: Any) -> None:
        """Add the state of a joint beside one that the world does not have."""
        made = self.types["sensor_msgs/msg/JointState"](
            header=self.header(stamp),
            name=["other", "hinge"],
            position=np.array([7.0, named["position"]]),
            velocity=np.array([8.0, named["velocity"]]) if "velocity" in named else np.zeros(0),
            effort=np.array([9.0, named.get("effort", 0.0)]),
        )
        self.sent.append((log, topic, "sensor_msgs/msg/JointState", made))

    def numbers(self, topic: str, log: int, *numbers: float) -> None:
        """Add several numbers without a stamp."""
        layout = self.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        made = self.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(numbers))
        self.sent.append((log, topic, "std_msgs/msg/Float64MultiArray", made))

    def add(self, topic: str, log: int, kind: str, **parts: Any) -> None:
        """Add any message."""
        self.sent.append((log, topic, kind, self.types[kind](**parts)))

    def write(self) -> Path:
        """Write the bag; return the path that is read."""
        if self.two:
            from rosbags.rosbag2 import StoragePlugin, Writer

            plugin = StoragePlugin.MCAP if "mcap" in self.kind else StoragePlugin.SQLITE3
            writer: Any = Writer(self.place, version=9, storage_plugin=plugin)
        else:
            from rosbags.rosbag1 import Writer as Writer1

            writer = Writer1(self.place)
        with writer:
            links = dict[str, Any]()
            for log, topic, kind, made in self.sent:
                if topic not in links:
                    links[topic] = writer.add_connection(topic, kind, typestore=self.store)
                to_bytes = self.store.serialize_cdr if self.two else self.store.serialize_ros1
                writer.write(links[topic], log, to_bytes(made, kind))
        return next(self.place.glob("*.mcap")) if self.kind == "file.mcap" else self.place


CONTROL = {"/motor.data[0]": "motor.control"}


def recorded(folder: Path, kind: str, arrays: Mapping[str, np.ndarray], late: int = 0) -> Path:
    """Write a recording into a bag: stamped states, commands a while later, and a picture."""
    bag = Bag(folder, kind)
    picture = {"height": 9, "width": 9, "encoding": "mono8", "is_bigendian": 0, "step": 9}
    for i, (position, sent) in enumerate(
        zip(arrays["hinge.position"], arrays["motor.control"], strict=True)
    ):
        now = BEGIN + i * DT
        bag.joints("/joint_states", now + 1_234_567, now, position=position)
        bag.numbers("/motor", now + late, sent)
        data = {"data": np.zeros(81, np.uint8), "header": bag.header(now)}
        bag.add("/camera", now, "sensor_msgs/msg/Image", **picture, **data)
    return bag.write()


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_fitted_as_its_arrays_are(
    world: sw.World, arrays: dict[str, np.ndarray], tmp_path: Path, kind: str
) -> None:
    """Equal bits; stamps are the time, not the time of the log, and a picture has no columns."""
    place = recorded(tmp_path, kind, arrays)
    found = world.fit(place, ["hinge.damping"], columns=CONTROL, noise=1e-3)
    same = world.fit(arrays, ["hinge.damping"], noise=1e-3)
    assert [column.name for column in found.columns] == ["hinge.position"]
    assert found.values == same.values
    np.testing.assert_array_equal(found.residual, same.residual)
    assert found.values["hinge.damping"] == pytest.approx(0.02, rel=1e-4)


def played(commands: Iterable[np.ndarray], damping: float) -> np.ndarray:
    """Return the position at the beginning of each control step, by plain MuJoCo.

    Args:
        commands: The command of each physics step of each control step.
        damping: Of the hinge.
    """
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.dof_damping[:] = damping
    data = mujoco.MjData(model)
    found = [0.0]
    for one in commands:
        for value in one:
            data.ctrl[:] = value
            mujoco.mj_step(model, data)
        found.append(float(data.qpos[0]))
    return np.array(found)


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_commands_of_a_bag_act_at_their_own_time(
    world: sw.World, arrays: dict[str, np.ndarray], tmp_path: Path, kind: str
) -> None:
    """Sent 7 ms after the states: in the middle of the fourth physics step, where both act by half.

    The damping that made it is found; with commands at the nearest control step it would not be.
    """
    sent = arrays["motor.control"]
    acting = np.empty((60, 10))
    for i in range(60):
        before = sent[i - 1] if i else sent[0]
        acting[i] = [before] * 3 + [0.5 * (before + sent[i])] + [sent[i]] * 6
    position = played(acting, 0.02)
    place = recorded(tmp_path, kind, {**arrays, "hinge.position": position}, late=7_000_000)
    with pytest.raises(UnknownVariable, match=r"'motr\.control'"):
        world.fit(place, ["hinge.damping"], columns={"/motor.data[0]": "motr.control"})
    run = read_recording(world, place, Reading(None, CONTROL)).runs[0]
    # the command of the first control step is not known: it begins with the first one
    np.testing.assert_allclose(run.acting(np.zeros(1), np.arange(59), 10)[..., 0], acting[1:])
    fit = world.fit(place, ["hinge.damping"], columns=CONTROL, noise=1e-4)
    assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=1e-6)
    assert fit.squares < 1e-6
    assert len(fit.runs[0].part(20, 40, 0.02).commands) == 19
    same = fit.counterfactual({"hinge.damping": fit.values["hinge.damping"]}, at=5, draws=2)
    np.testing.assert_allclose(same["counterfactual"], same["measured"], atol=1e-6)
    told = world.fit(
        {"time": 0.02 * np.arange(61), "motor.control": sent, "hinge.position": position},
        ["hinge.damping", "delay"],
        noise=1e-4,
    )
    assert told.values["delay"] == pytest.approx(0.007, rel=1e-4)  # the same by another way
    tables = pd.DataFrame({"time": 0.02 * np.arange(61), "hinge.position": position})
    others = pd.DataFrame({"time": 0.02 * np.arange(61) + 0.007, "motor.control": sent})
    table = pd.concat([tables, others]).sort_values("time", ignore_index=True)
    table["motor.control"] = table["motor.control"].ffill()
    again = world.fit(table, ["hinge.damping"], noise=1e-4)
    assert again.values["hinge.damping"] == pytest.approx(0.02, rel=1e-6)


def test_means_of_physics_steps_are_those_of_an_integral() -> None:
    """Of random commands at random times, each delayed, by a fine sum."""
    rng = np.random.default_rng(0)
    times = np.concatenate([[0.0], np.sort(rng.uniform(0.0, 6.0, 40))])
    sent = rng.normal(size=(41, 2))
    run = RecordedRun(np.zeros((6, 2)), np.arange(7), np.zeros((7, 1)), sent=(times, sent))
    delays, steps = np.array([0.0, 1.37]), np.array([0, 2, 5])
    found = run.acting(delays, steps, 4)
    fine = (np.arange(20_000) + 0.5) / 20_000
    for (n, j, i), value in np.ndenumerate(found):
        at = steps[n] + (j + fine) / 4 - delays[i]
        last = np.maximum(np.searchsorted(times, at, "right") - 1, 0)
        assert value == pytest.approx(sent[last, i].mean(), abs=1e-3)
    later = run.part(2, 7, 0.02)
    np.testing.assert_allclose(later.acting(delays, np.array([0, 3]), 4), found[1:], atol=1e-12)


def test_topics_of_other_rates(world: sw.World, tmp_path: Path) -> None:
    """A slow sensor is empty in between, commands hold until the next one, vectors have a name."""
    more = "<body name='ball' pos='2 0 0'><freejoint name='free'/><geom size='0.1'/></body>"
    ball = PENDULUM.replace("</worldbody>", f"{more}</worldbody>")
    bag = Bag(tmp_path, "sqlite3")
    point, turn = (bag.types[f"geometry_msgs/msg/{n}"] for n in ("Point", "Quaternion"))
    pose = bag.types["geometry_msgs/msg/Pose"]
    for i in range(12):
        now = BEGIN + i * DT
        bag.joints("/joint_states", now, None, position=0.1 * i, velocity=0.5, effort=3.0)
        if i % 3 == 0:
            bag.add("/motor", now, "std_msgs/msg/Float64", data=0.25 * (i % 2))
            there = pose(
                position=point(x=2.0, y=0.01 * i, z=0.0),
                orientation=turn(x=0.0, y=0.0, z=0.0, w=1.0),
            )
            kind = "geometry_msgs/msg/PoseStamped"
            bag.add("/ball", now + 900_000, kind, header=bag.header(now + 900_000), pose=there)
    place = bag.write()
    columns = {"/motor.data": "motor.control", "/ball.pose.position": "ball.cartesian_position"}
    columns |= {"/ball.pose.orientation": "ball.orientation"}
    measured = read_recording(sw.World(ball), place, Reading(None, columns))
    (run,) = measured.runs
    names = [column.name for column in measured.columns]
    table = dict(zip(names, run.values.T, strict=True))
    assert {"hinge.velocity", "ball.orientation[3]"} <= {*names}
    assert len(names) == 9
    np.testing.assert_array_equal(run.instants, np.arange(12))
    np.testing.assert_array_equal(table["hinge.position"], 0.1 * np.arange(12))
    y = table["ball.cartesian_position[1]"]
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(y)), [0, 3, 6, 9])
    np.testing.assert_array_equal(y[::3], 0.01 * np.arange(0, 12, 3))
    np.testing.assert_array_equal(run.commands[:, 0], np.repeat([0.0, 0.25, 0.0, 0.25], 3)[:11])
    assert run.sent is None


def test_messages_say_what_a_bag_has(
    world: sw.World, arrays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    """Topics, their types and columns; custom types are named; nothing is read twice."""
    place = recorded(tmp_path, "mcap", arrays)
    has = r"/joint_states \(sensor_msgs/msg/JointState\): .*/joint_states\.hinge\.position"
    with pytest.raises(ModelError, match=rf"motor\.control \[N m\] are missing(.|\n)*{has}"):
        world.fit(place, ["hinge.damping"])
    with pytest.raises(UnknownOption, match=rf"'/moto\.data'(.|\n)*{has}"):
        world.fit(place, ["hinge.damping"], columns={"/moto.data": "motor.control"})
    effort = {**CONTROL, "/joint_states.hinge.effort": "motor.control"}
    with pytest.raises(ModelError, match=r"are both motor\.control: leave one out by ignore="):
        world.fit(place, ["hinge.damping"], columns=effort)
    with pytest.raises(ModelError, match=r"no column is one of this world.*/camera \(sensor_msgs"):
        world.fit(place, ["hinge.damping"], ignore=["/joint*"])
    coarse = sw.World(PENDULUM, control_dt=0.05)
    with pytest.raises(
        ModelError, match=r"/joint_states, 0.02 s apart, .*control steps of 0\.05 s"
    ):
        coarse.fit(place, ["hinge.damping"], columns=CONTROL)
    (tmp_path / "x").mkdir()
    bag = Bag(tmp_path / "x", "mcap")
    bag.joints("/joint_states", BEGIN, 5 * 10**9, position=0.0)
    bag.joints("/joint_states", BEGIN + DT, 5 * 10**9 + DT, position=0.0)
    bag.numbers("/motor", BEGIN, 0.0)
    with pytest.raises(ModelError, match="another clock"):
        world.fit(bag.write(), ["hinge.damping"], columns=CONTROL)


def test_a_custom_type_is_read_if_it_is_defined(world: sw.World, tmp_path: Path) -> None:
    """A bag of MCAP defines its types; one without the definition is refused by its type."""
    typesys = pytest.importorskip("rosbags.typesys")
    bag = Bag(tmp_path, "mcap")
    text = "float64 torque\nfloat32[2] currents\nstring note\n"
    bag.store.register(typesys.get_types_from_msg(text, "my_msgs/msg/Drive"))
    for i in range(5):
        now = BEGIN + i * DT
        bag.joints("/joint_states", now, now, position=0.1)
        currents = np.zeros(2, np.float32)
        bag.add("/drive", now, "my_msgs/msg/Drive", torque=0.5, currents=currents, note="a")
    place = bag.write()
    how = Reading(None, {"/drive.torque": "motor.control"})
    (run,) = read_recording(world, place, how).runs
    np.testing.assert_array_equal(run.commands, 0.5)
    (tmp_path / "lost").mkdir()
    other = Bag(tmp_path / "lost", "sqlite3")
    other.store.register(typesys.get_types_from_msg(text, "my_msgs/msg/Drive"))
    other.sent = bag.sent
    place = other.write()
    with_no_text(place)
    said = r"/drive \(my_msgs/msg/Drive, a custom type that the bag does not define"
    with pytest.raises(UnknownOption, match=said):
        read_recording(world, place, how)


def with_no_text(place: Path) -> None:
    """Remove the definitions of types, which older bags do not have."""
    import sqlite3

    with sqlite3.connect(next(place.glob("*.db3"))) as base:
        base.execute("DELETE FROM message_definitions")
    base.close()


def test_trajectories_of_one_point_are_commands(world: sw.World, tmp_path: Path) -> None:
    """Named by their joints; those of several points are refused."""
    bag = Bag(tmp_path, "ros1")
    point = bag.types["trajectory_msgs/msg/JointTrajectoryPoint"]
    none = np.zeros(0)
    wait = bag.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=1)
    for i in range(4):
        now = BEGIN + i * DT
        bag.joints("/joint_states", now, now, position=0.1)
        one = point(
            positions=np.array([0.2]),
            velocities=none,
            accelerations=none,
            effort=np.array([0.5]),
            time_from_start=wait,
        )
        kind = "trajectory_msgs/msg/JointTrajectory"
        for topic, points in (("/go", [one]), ("/plan", [one, one])):
            about = {"joint_names": ["hinge"], "points": points, "header": bag.header(now)}
            bag.add(topic, now, kind, **about)
    place = bag.write()
    how = Reading(None, {"/go.hinge.effort": "motor.control"}, ["/plan*"])
    (run,) = read_recording(world, place, how).runs
    np.testing.assert_array_equal(run.commands, 0.5)
    how = Reading(None, {"/plan.hinge.effort": "motor.control"})
    with pytest.raises(UnknownOption, match=r"/plan .* 2 points"):
        read_recording(world, place, how)


# --- LeRobot --------------------------------------------------------------------------------------

SERVO = PENDULUM.replace(
    '<motor name="motor" joint="hinge" ctrlrange="-1 1"/>',
    '<position name="hinge" joint="hinge" kp="2" ctrlrange="-1.5 1.5"/>',
)


def dataset(folder: Path, version: str, names: Any, factor: float) -> list[dict[str, np.ndarray]]:
    """Write a LeRobot dataset of two episodes; return their arrays, in radians."""
    found, frames = [], []
    with sw.World(SERVO) as world:
        for seed in range(2):
            made = world.rollout("random", seed=seed, steps=30, do={"hinge.damping": 0.02})
            sent = np.append(made.actions[:, 0], 0.0)
            arrays = {"time": 0.02 * np.arange(31), "hinge.control": np.float32(sent * factor)}
            arrays["hinge.position"] = np.float32(made["hinge.position"] * factor)
            frame = {"timestamp": np.float32(arrays["time"]), "episode_index": seed}
            states = zip(np.zeros(31, np.float32), arrays["hinge.position"], strict=True)
            rows = {"observation.state": [np.array(one) for one in states]}
            rows["action"] = [np.array([0.0, one]) for one in arrays["hinge.control"]]
            frames.append(pd.DataFrame({**rows, **frame, "task_index": 0}))
            for name in ("hinge.control", "hinge.position"):
                arrays[name] = arrays[name].astype(float) * (np.pi / 180.0 if factor > 1.0 else 1.0)
            found.append(arrays)
    vector = {"dtype": "float32", "shape": [2], "names": names}
    features = {"observation.state": vector, "action": vector}
    features |= {"timestamp": {"dtype": "float32", "shape": [1], "names": None}}
    features |= {"observation.images.top": {"dtype": "video", "shape": [8, 8, 3], "names": None}}
    (folder / "meta").mkdir(parents=True)
    info = {"codebase_version": version, "fps": 50, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    place = folder / "data" / "chunk-000"
    place.mkdir(parents=True)
    if version == "v2.1":
        for i, frame in enumerate(frames):
            frame.to_parquet(place / f"episode_{i:06d}.parquet")
    else:
        pd.concat(frames).to_parquet(place / "file-000.parquet")
    return found


LAYOUTS = {
    "v2.1": ("v2.1", {"motors": ["other", "hinge"]}),
    "v3.0": ("v3.0", ["other.pos", "hinge.pos"]),
}


@pytest.mark.parametrize(("version", "names"), LAYOUTS.values(), ids=LAYOUTS)
def test_a_lerobot_dataset_is_fitted_as_its_arrays_are(
    tmp_path: Path, version: str, names: Any
) -> None:
    """Episodes are runs, in degrees; the unit must be given, as the dataset does not say it."""
    world, folder = sw.World(SERVO), tmp_path / "set"
    arrays = dataset(folder, version, names, 180.0 / np.pi)
    with pytest.raises(ModelError, match=r"does not say the unit of .*hinge.*'\[deg\]'"):
        world.fit(folder, ["hinge.damping"])
    with pytest.raises(ModelError, match="from degrees"):
        world.fit(
            folder, ["hinge.damping"], columns={"observation.*": "[rad]", "action.*": "[rad]"}
        )
    columns = {"observation.state.*": "[deg]", "action.*": "[deg]"}
    found = world.fit(folder, ["hinge.damping"], columns=columns, noise=1e-3)
    same = world.fit(arrays, ["hinge.damping"], noise=1e-3)
    assert len(found.runs) == 2
    assert found.values == same.values
    np.testing.assert_array_equal(found.residual, same.residual)
    assert found.values["hinge.damping"] == pytest.approx(0.02, rel=1e-3)


def test_columns_of_a_dataset_without_names(tmp_path: Path, monkeypatch: Any) -> None:
    """They are numbered, and named by the command."""
    monkeypatch.chdir(tmp_path)
    dataset(Path("set"), "v3.0", None, 1.0)
    Path("arm.xml").write_text(SERVO)
    world = sw.World("arm.xml")
    with pytest.raises(
        ModelError, match=r"observation\.state \(float32\): observation\.state\[0\]"
    ):
        world.fit("set", ["hinge.damping"])
    words = ["fit", "arm.xml", "set", "--parameters", "hinge.damping", "--out", "out"]
    words += ["--noise", "hinge.position=0.001", "--column", "action[1]=hinge.control [rad]"]
    words += ["--column", "observation.state[1]=hinge.position [rad]"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "2 runs of 62 rows" in done.output


# --- units of the time, and several files ---------------------------------------------------------


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_other_units_are_refused_by_name(
    world: sw.World, arrays: dict[str, np.ndarray], unit: str, factor: float
) -> None:
    """Stamps since 1970 too; with the unit that the message names they are read."""
    stamps = np.rint((arrays["time"] + 1.7e9) * factor).astype(np.int64)
    for time in (stamps, stamps - stamps[0]):
        table = pd.DataFrame({**arrays, "time": time}).rename(columns={"time": "stamp"})
        with pytest.raises(ModelError, match=rf"columns=\{{'time': 'time \[{unit}\]'\}}"):
            read_recording(world, table, Reading(None, {"stamp": "time"}))
        (run,) = read_recording(world, table, Reading(None, {"stamp": f"time [{unit}]"})).runs
        np.testing.assert_array_equal(run.instants, np.arange(61))
        np.testing.assert_array_equal(run.values[:, 0], arrays["hinge.position"])
    with pytest.raises(UnknownOption, match=r"'fortnight'.*ns"):
        read_recording(world, table, Reading(None, {"stamp": "time [fortnight]"}))


def test_milliseconds_of_a_fast_clock_are_not_seconds(world: sw.World) -> None:
    """Rows of 5 ms, which would be 250 whole control steps of 20 ms apart."""
    table = pd.DataFrame({"time": 5 * np.arange(20), "motor.control": 0.0, "hinge.position": 0.1})
    with pytest.raises(ModelError, match=r"'time \[ms\]'"):
        read_recording(world, table)


def test_a_column_of_one_of_several_files_is_renamed(
    world: sw.World, arrays: dict[str, np.ndarray], tmp_path: Path, monkeypatch: Any
) -> None:
    """A name that no file has is refused; other units are converted."""
    monkeypatch.chdir(tmp_path)
    frame = pd.DataFrame(arrays)
    frame.to_csv("one.csv", index=False)
    other = frame.assign(**{"hinge.position": np.rad2deg(frame["hinge.position"])})
    other.rename(columns={"motor.control": "torque", "hinge.position": "q"}).to_csv("two.csv")
    names = {"torque": "motor.control", "q": "hinge.position [deg]"}
    how = Reading(None, names, ["Unnamed*"])
    one, two = read_recording(world, ["one.csv", "two.csv"], how).runs
    np.testing.assert_allclose(one.values, two.values, rtol=1e-12)
    np.testing.assert_array_equal(one.commands, two.commands)
    with pytest.raises(UnknownOption, match=r"column of the table .*'qq'"):
        read_recording(
            world, ["one.csv", "two.csv"], Reading(None, {**names, "qq": "time"}, how[2])
        )


def test_what_cannot_be_read_is_refused(
    world: sw.World, arrays: dict[str, np.ndarray], tmp_path: Path, monkeypatch: Any
) -> None:
    """A damaged bag, an empty one, one behind a URL, a dataset without data, and no rosbags."""
    place = recorded(tmp_path, "file.mcap", arrays)
    (tmp_path / "cut.mcap").write_bytes(place.read_bytes()[:100])
    with pytest.raises(UnreadableFile, match=r"cut\.mcap"):
        world.fit(tmp_path / "cut.mcap", ["hinge.damping"])
    (tmp_path / "none").mkdir()
    empty = Bag(tmp_path / "none", "mcap")
    with pytest.raises(ModelError, match="there are no messages"):
        world.fit(empty.write(), ["hinge.damping"])
    dataset(tmp_path / "set", "v3.0", ["other", "hinge"], 1.0)
    next((tmp_path / "set" / "data").glob("*/*.parquet")).unlink()
    with pytest.raises(ModelError, match=r"no file data/chunk-000/.*download the data"):
        sw.World(SERVO).fit(tmp_path / "set", ["hinge.damping"], columns={"*[ne]*": "[rad]"})
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for name in [name for name in sys.modules if name.startswith("rosbags.")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(MissingExtra, match=r"pip install 'scm-world\[robots\]'"):
        world.fit(place, ["hinge.damping"])


def test_the_command_fits_a_bag(
    arrays: dict[str, np.ndarray], tmp_path: Path, monkeypatch: Any
) -> None:
    """A folder, with the column of the command named; topics are listed where it is not."""
    monkeypatch.chdir(tmp_path)
    Path("arm.xml").write_text(PENDULUM)
    recorded(tmp_path, "sqlite3", arrays)
    words = ["fit", "arm.xml", "run", "--parameters", "hinge.damping", "--out", "out"]
    words += ["--noise", "hinge.position=0.001"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code != 0
    assert "/motor (std_msgs/msg/Float64MultiArray)" in " ".join(done.output.split())
    done = CliRunner().invoke(app, [*words, "--column", "/motor.data[0]=motor.control"])
    assert done.exit_code == 0, done.output
    assert "a run of 61 rows, 1.2 s, 1 measured column" in done.output
