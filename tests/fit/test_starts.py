"""Fits whose recording begins as is known, and their replay from there."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

import scm_world as sw
from scm_world._types import Floats
from scm_world.errors import ModelError, UnknownOption, UnknownVariable

SERVO = """
<mujoco model="servo"><option gravity="0 0 0"/>
  <worldbody><body name="arm">
    <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.01"/>
    <geom name="rod" type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.1"/>
  </body></worldbody>
  <actuator><general name="servo" joint="hinge" dyntype="filterexact" dynprm="0.05" gainprm="2"
    biastype="affine" biasprm="0 -2 0"/></actuator>
</mujoco>
"""
NOISE = 2e-3  # [rad]
NAMES = ["servo.kp", "hinge.damping"]


def with_gain(kp: float) -> str:
    """Return the servo with another gain."""
    return SERVO.replace('gainprm="2"', f'gainprm="{kp}"').replace("0 -2 0", f"0 {-kp} 0")


def moved(
    kp: float,
    steps: int = 40,
    seed: int = 0,
    at: float = 0.4,
    most: float = 0.8,
    friction: float = 0.0,
) -> dict[str, Any]:
    """Return a recording by plain MuJoCo: a servo that stands, and follows commands."""
    model = mujoco.MjModel.from_xml_string(with_gain(kp))
    model.dof_frictionloss[0] = friction
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[0] = data.act[0] = at
    commands = np.repeat([at, *rng.uniform(-most, most, steps // 10 - 1)], 10)
    seen = [at]
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 10)
        seen.append(float(data.qpos[0]))
    noisy = np.array(seen) + NOISE * rng.normal(size=steps + 1)
    names = ("time", "servo.control", "hinge.position")
    arrays = (0.02 * np.arange(steps + 1), np.append(commands, np.nan), noisy)
    return dict(zip(names, arrays, strict=True))


def test_a_fit_begins_at_rest_where_that_is_known() -> None:
    """Velocity 0 and the activation of the first command; after a gap nothing is known."""
    world, recording = sw.World(SERVO), moved(2.6)
    cut = {name: np.delete(values, [17, 18]) for name, values in recording.items()}
    for given, begins in ((recording, "rest"), (cut, "rest"), (recording, {"*.act*": (0.4, 0.01)})):
        fit = world.fit(given, NAMES, begins=begins)
        activation = 0.01 if isinstance(begins, dict) else 1e-3
        assert fit.starts[0, 2] == pytest.approx(0.4, abs=3 * activation)
        assert len(fit.runs) == 1 + (given is cut)
        if begins == "rest":
            assert fit.starts[0, 1] == pytest.approx(0.0, abs=3e-3)
            assert fit.starts[0, 0] == pytest.approx(0.4, abs=NOISE)
        table = fit.table.set_index("parameter")
        for name, true in zip(NAMES, (2.6, 0.05), strict=True):
            assert table.low[name] < true < table.high[name]
        assert fit.explains
        assert "1 measured column" in fit.read
        assert {*fit.counterfactual({}, draws=2).column} == {"hinge.position"}
    (experiment,) = fit.suggest(1, steps=20)
    assert np.isfinite(experiment.after)


def test_a_start_that_contradicts_the_recording_is_said() -> None:
    """It moved when the recording began; what stood there, and is fitted as moving, is said."""
    world, recording = sw.World(SERVO), moved(2.6)
    moving = {name: values[13:] for name, values in recording.items()}
    fit = world.fit(moving, NAMES, begins="rest", window=30)
    assert not fit.explains
    assert "or it did not begin as begins= says" in str(fit)
    free = world.fit(moving, NAMES, window=30)
    assert free.explains
    assert "run 0 begins at hinge.velocity = " in str(free)
    assert "begins='rest'" in str(free)


def test_wrong_starts_are_refused() -> None:
    """What was given, and what can be."""
    world, recording = sw.World(SERVO), moved(2.0)
    for wrong in ("moving", {"hinge.velocity": 0.0}, {"hinge.velocity": (0.0, 0.0)}, ["rest"]):
        with pytest.raises(UnknownOption, match="begins"):
            world.fit(recording, NAMES, begins=wrong)
    with pytest.raises(UnknownVariable, match=r"knee\.velocity"):
        world.fit(recording, NAMES, begins={"knee.velocity": (0.0, 0.1)})


def test_a_start_that_is_known_is_no_motion_that_a_constant_predicts_better() -> None:
    """A fit that replays each motion within its noise is compared by the motions alone."""
    begins = np.append(0.0, np.full(40, np.nan))
    recording = moved(2.6) | {"hinge.velocity": begins}
    noise = {"hinge.position": NOISE, "hinge.velocity": 1e-3}
    with sw.World(SERVO) as world:
        fit = world.fit(recording, NAMES, noise=noise)
    shown = fit.replay.set_index("column")
    assert shown.constant["hinge.velocity"] == 0.0
    assert shown.fit["hinge.position"] < 1.5 * NOISE < 0.1 * shown.constant["hinge.position"]
    assert not any("a constant is nearer" in remark for remark in fit.remarks)


def test_a_fit_that_replays_worse_than_the_file_determines_nothing() -> None:
    """Short windows hide friction that is not modelled; plain MuJoCo has the same replays."""
    world, recording = sw.World(SERVO), moved(2.0, 100, friction=0.1, at=0.0, most=0.3)
    fit = world.fit(recording, NAMES)
    replay = fit.replay.iloc[0]
    for kind, kp, damping in (("fit", *fit.values.values()), ("unfitted", 2.0, 0.05)):
        model = mujoco.MjModel.from_xml_string(with_gain(kp))
        model.dof_damping[0] = damping
        seen = recording["hinge.position"]

        def left(start: Floats, rows: int, model: mujoco.MjModel = model) -> Floats:
            data, played = mujoco.MjData(model), []
            data.qpos[0], data.qvel[0], data.act[0] = start
            for command in recording["servo.control"][:rows]:
                played.append(float(data.qpos[0]))
                data.ctrl[0] = command if np.isfinite(command) else 0.0
                mujoco.mj_step(model, data, 10)
            return np.asarray(recording["hinge.position"][:rows] - played)

        best = least_squares(
            left, [seen[0], 0.0, 0.0], args=(fit.window,), x_scale=(0.01, 0.1, 0.1)
        ).x
        rms = float(np.sqrt((left(best, len(seen)) ** 2).mean()))
        assert replay[kind] == pytest.approx(rms, rel=0.01)
    assert replay.constant == pytest.approx(float(np.std(recording["hinge.position"])))
    assert replay.fit > 2.0 * replay.unfitted
    assert fit.table.high[0] < 2.0  # the true gain is excluded
    assert fit.worse
    assert not fit.table.determined.any()
    assert "the unfitted world is nearer to the recording than the fit" in str(fit)


def test_a_fit_that_follows_no_window_determines_nothing() -> None:
    """A servo whose position was recorded with the other sign: a constant replays it better."""
    text = """<mujoco><option timestep="0.002"/><worldbody><body name="pole">
    <joint name="hinge" axis="0 1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/></body></worldbody>
    <actuator><position name="servo" joint="hinge" kp="2" ctrlrange="-1.5 1.5"/></actuator>
    </mujoco>"""
    world, rng = sw.World(text), np.random.default_rng(1)
    commands = np.repeat(rng.uniform(-1.0, 1.0, 11), 10)[:101]
    made = world.rollout(commands[:100, None], steps=100)
    position = 1e-3 * rng.normal(size=101) - made["hinge.position"]
    recording = {"time": 0.02 * np.arange(101), "servo.control": commands}
    fit = world.fit({**recording, "hinge.position": position}, ["pole.mass"])
    assert fit.replay.fit[0] > 1.1 * fit.replay.constant[0]
    left = 0.0
    for first in range(0, 101, fit.window):
        rows = slice(first, first + fit.window)
        left += ((position[rows] - position[rows].mean()) ** 2).sum()
    assert ((fit.residual * fit.noise[0]) ** 2).sum() > 0.5 * left
    assert fit.aimless
    assert not fit.table.determined.any()
    assert "windows do not follow it either" in str(fit)


def test_a_right_fit_replays_with_the_noise() -> None:
    """Its start velocity, which nobody measured, is no reason to doubt a fit of noise alone."""
    text = """<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/></body></worldbody>
    <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
    world, rng = sw.World(text), np.random.default_rng(0)
    episode = world.rollout("random", seed=0, steps=100, do={"hinge.damping": 0.0115})
    recording = {
        "time": 0.02 * np.arange(101),
        "motor.control": np.append(episode.actions[:, 0], np.nan),
        "hinge.position": episode["hinge.position"] + 0.001 * rng.normal(size=101),
    }
    fit = world.fit(recording, ["hinge.damping"])
    assert fit.replay.fit[0] < 0.0015
    assert fit.replay.unfitted[0] > 0.01
    assert fit.table.determined.all()
    assert "from the first row, the unfitted" not in str(fit)
    turned = {**recording, "hinge.position": np.rad2deg(recording["hinge.position"])}
    with pytest.raises(ModelError, match="are in degrees"):
        fit.predict(turned)


def test_what_was_held_out_is_predicted() -> None:
    """The skill is that of the errors of windows, and a fit of nothing is no better."""
    world, recording = sw.World(SERVO), moved(2.6, 400)
    fit = world.fit(recording, NAMES, held_out=0.6)
    assert fit.read.startswith("a run of 160 rows")
    found = fit.held_out
    assert found is not None
    assert len(found.windows) == 5  # of 50 rows
    assert found.windows.time[0] == pytest.approx(0.02 * 170)
    rows = found.windows
    squares = [float((rows[kind] ** 2 * rows.rows).sum()) for kind in ("fit", "unfitted")]
    assert found.table.skill[0] == pytest.approx(1.0 - squares[0] / squares[1])
    assert found.table.low[0] > 0.99
    assert found.table.fit[0] < 2.0 * NOISE
    assert found.better
    assert "held out: 5 windows that do not overlap, predicted up to 0.8 s ahead" in str(fit)
    last = recording["hinge.position"]
    known = np.concatenate([last[i + 10 : i + 50] - last[i + 9] for i in range(160, 360, 50)])
    assert rows.constant[:4].pow(2).mean() == pytest.approx(float((known**2).mean()))
    other = fit.predict(moved(2.6, 200, seed=5), ahead=0.2)
    assert len(other.windows) == 10  # of 20 rows, of which 10 are known
    assert other.better
    same = fit.predict(moved(2.0, 200, seed=5))
    assert not same.better
    assert "no better than the unfitted world" in str(same)
    assert world.fit(recording, NAMES, window=40).held_out is None
    for wrong in (0.0, 1.0, 0.01):
        with pytest.raises(UnknownOption, match="held_out"):
            world.fit(recording, NAMES, held_out=wrong)
    with pytest.raises(UnknownOption, match="more than 10 rows"):
        fit.predict({name: values[:10] for name, values in recording.items()})


PUSHED = """
<mujoco model="cart"><option timestep="0.01"/><worldbody><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" damping="1"/>
  <geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="slider" gear="10" ctrlrange="-1 1"/></actuator></mujoco>
"""


def pushed(commands: Floats, force: float, place: float, speed: float) -> Floats:
    """Return the positions of a plain simulation."""
    model = mujoco.MjModel.from_xml_string(PUSHED)
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.xfrc_applied[1, 0] = place, speed, force
    found = [place]
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data, nstep=5)
        found.append(float(data.qpos[0]))
    return np.array(found)


@pytest.mark.parametrize("column", ["slider.position_reading", "slider.position"])
def test_readings_of_noisy_sensors_are_fitted(column: str) -> None:
    """As what they measure: the world that has noise predicts without it. It is a linear model."""
    noise, names = {"slider.position": 0.02, "motor.control": 0.02}, ["cart.external_force"]
    world = sw.World(PUSHED, control_dt=0.05, noise=noise, expose=["*", "*.external_force"])
    run = world.rollout("random", seed=1, steps=40, do={names[0]: [3.0, 0.0, 0.0]})
    commands, seen = run.actions[:, 0], run["slider.position_reading"]
    table = {"time": 0.05 * np.arange(41), "motor.control": np.append(commands, np.nan)}
    found = world.fit({**table, column: seen}, names, noise={column: 0.02})
    base = pushed(commands, 0.0, 0.0, 0.0)
    basis = [pushed(commands, *unit) - base for unit in np.eye(3)]
    best, *_ = np.linalg.lstsq(np.stack(basis, axis=1), seen - base, rcond=None)
    first = found.table.iloc[0]
    assert first["value"] == pytest.approx(best[0], abs=1e-3)
    assert first["low"] < best[0] < first["high"]
    assert best[0] == pytest.approx(3.0, abs=0.2)
