"""Delays of commands that end within a control step, fitted to recordings of plain MuJoCo."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

import scm_world as sw
from scm_world.errors import ModelError
from scm_world.fit import Fit

STEPS, SUBSTEPS = 60, 10
KEPT = {"s": 2, "m": 4}  # past commands, in control steps
ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="j" axis="0 1 0" damping="0.1" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="0.6"/>
    </body>
  </worldbody>
  <actuator>
    <position name="s" joint="j" kp="30" kv="1" ctrlrange="-2 2"/>
    <motor name="m" joint="j" ctrlrange="-3 3"/>
  </actuator>
</mujoco>
"""


def recorded(seed: int, delays: tuple[int, int], shift: int = 0) -> dict[str, np.ndarray]:
    """Record MuJoCo with another gain and with delays in physics steps, by hand.

    ``shift`` is the delay of the sensor.
    """
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(ARM)
    model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1] = 38.0, -38.0
    data, seen, places = mujoco.MjData(model), [], [0.0]
    sent = np.repeat(rng.uniform([-1, -2], [1, 2], (10, 2)), STEPS // 10, axis=0)
    for step in range(STEPS):
        seen.append(places[max(0, SUBSTEPS * step - shift)] + 1e-3 * rng.normal())
        for i in range(SUBSTEPS):
            late = [(SUBSTEPS * step + i - delay) // SUBSTEPS for delay in delays]
            data.ctrl[:] = [sent[max(0, int(at)), which] for which, at in enumerate(late)]
            mujoco.mj_step(model, data)
            places.append(data.qpos[0])
    columns = {"s.control": sent[:, 0], "m.control": sent[:, 1], "j.position": np.array(seen)}
    return {"time": 0.02 * np.arange(STEPS), **columns}


def covers(fit: Fit, truth: dict[str, float]) -> int:
    """Return how many intervals have their true value; all values are determined and near."""
    rows = fit.table.set_index("parameter")
    assert rows.determined.all()
    for name, value in truth.items():
        assert rows.value[name] == pytest.approx(value, rel=0.01)
    return sum(bool(rows.low[n] <= value <= rows.high[n]) for n, value in truth.items())


def test_a_delay_that_ends_within_a_control_step_is_recovered() -> None:
    """So is the gain, which a mean of two commands over the control step would change."""
    with sw.World(ARM, control_dt=0.02) as world:
        found = 0
        for seed in (1, 3, 5):
            fit = world.fit(recorded(seed, (14, 14)), ["s.kp", "delay"])
            found += covers(fit, {"s.kp": 38.0, "delay": 0.028})
    assert found >= 5


def test_rows_that_were_held_out_know_the_commands_before_them() -> None:
    """The commands that act after the cut were sent before it; what is left is the noise."""
    with sw.World(ARM, control_dt=0.02) as world:
        fit = world.fit(recorded(1, (120, 120)), ["s.kp", "delay"], held_out=0.5)
        assert fit.held_out is not None
        assert fit.held_out.table.fit[0] < 1.5e-3


def test_each_command_has_its_own_delay() -> None:
    """The fitted world has them, and replays the recording."""
    run = recorded(2, (14, 33))
    names = ["s.kp", "s.control_delay", "m.control_delay"]
    with sw.World(ARM, control_dt=0.02) as world:
        fit = world.fit(run, ["s.kp", "*.control_delay"])
        assert [*fit.values] == names
        assert covers(fit, dict(zip(names, (38.0, 1.4, 3.3), strict=True))) >= 2
        assert [*fit.table.unit[1:]] == ["1", "1"]
        sent = np.stack([run["s.control"], run["m.control"]], axis=1)[:-1]
        past = {f"{n}.control_past": np.full(k, run[f"{n}.control"][0]) for n, k in KEPT.items()}
        again = fit.world.rollout(sent, seed=0, steps=STEPS - 1, do=past)
        assert again["m.control_delay"][0] == fit.values["m.control_delay"]
        assert np.abs(again["j.position"] - run["j.position"]).max() < 6e-3


def decayed(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Return the warmth of a heated room one control step later."""
    return {
        "warmth": state["warmth"] + 0.1 * (action["heat"] - parameters["rate"] * state["warmth"])
    }


def test_the_delay_of_a_step_function_is_a_mean_and_says_so() -> None:
    """It takes one command in each control step, and no delay can be put before it."""
    declared: dict[str, Any] = {
        "parameters": [sw.Exogenous(name="rate", default=0.5, bounds=sw.Box(0.0, 5.0))],
        "states": [sw.Measured(name="warmth", default=1.0)],
        "actions": [sw.Action(name="heat", bounds=sw.Box(0.0, 1.0))],
        "control_dt": 0.1,
    }
    heat = np.repeat(np.random.default_rng(0).uniform(size=12), 4)
    late = 0.7 * np.append(heat[:1], heat[:-1]) + 0.3 * np.append(heat[[0, 0]], heat[:-2])
    with sw.World(decayed, **declared) as world:
        episode = world.rollout(late[:, None], seed=0, steps=len(heat))
        columns = {"time": 0.1 * np.arange(len(heat) + 1), "warmth": episode["warmth"]}
        fit = world.fit({**columns, "heat": np.append(heat, np.nan)}, ["rate", "heat_delay"])
        assert fit.values["heat_delay"] == pytest.approx(1.3, abs=1e-6)
        assert "the mean of two commands" in str(fit)
        with pytest.raises(ModelError, match="delay them in the step function"):
            _ = fit.world


def read(position: float, gain: float, offset: float) -> float:
    """Return what an encoder reads."""
    return gain * position + offset


def test_sensors_are_fitted_by_name() -> None:
    """Gain and offset of an encoder, and the delay of another sensor, are ordinary parameters."""
    gain = sw.Exogenous(name="encoder.gain", default=1.0, bounds=sw.Box(0.1, 10.0))
    offset = sw.Exogenous(name="encoder.offset", default=0.0, unit="rad")
    parents = ("j.position", gain.name, offset.name)
    encoder = sw.Measured(name="encoder", unit="rad", parents=parents, mechanism=read)
    sensed: dict[str, Any] = {"ties": [gain, offset], "outcomes": [encoder]}
    run, names = recorded(4, (0, 0)), ["s.kp", "encoder.gain", "encoder.offset"]
    run["encoder"] = read(run.pop("j.position"), 1.1, 0.2)
    with sw.World(ARM, control_dt=0.02, **sensed) as world:
        found = covers(world.fit(run, names), dict(zip(names, (38.0, 1.1, 0.2), strict=True)))
    run = recorded(4, (0, 0), shift=14)
    run["j.position_reading"] = run.pop("j.position")
    with sw.World(ARM, control_dt=0.02, delay={"j.position": sw.Box(0.0, 3.0)}) as world:
        early = world.given({"j.position_delay": 0.5})
        fit = early.fit(run, ["s.kp", "j.position_delay"])
        found += covers(fit, {"s.kp": 38.0, "j.position_delay": 1.4})
    assert found >= 4


def test_commands_before_the_first_row_are_assumed_and_that_is_said() -> None:
    """Another command acted there: with its measurements left empty, the model is right again."""
    text = """<mujoco><option timestep="0.005"/><worldbody><body name="pole">
    <joint name="hinge" axis="0 1 0" damping="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/></body></worldbody>
    <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    rng, model = np.random.default_rng(0), mujoco.MjModel.from_xml_string(text)
    data, seen, sent = mujoco.MjData(model), list[float](), rng.uniform(-1.0, 1.0, 60)
    for step in range(60):
        seen.append(float(data.qpos[0]) + 1e-3 * rng.normal())
        data.ctrl[0] = sent[step - 8] if step >= 8 else -0.5
        mujoco.mj_step(model, data, 4)
    world, position = sw.World(text), np.array(seen)
    recording = {"time": 0.02 * np.arange(60), "motor.control": sent, "hinge.position": position}
    wrong = world.fit(recording, ["delay", "hinge.damping"])
    late = wrong.values["delay"]
    assert f"if another one acted in the first {late:.3g} s of a run" in str(wrong)
    assert not wrong.explains or "such as commands before the first row" in str(wrong)
    position[:9] = np.nan
    right = world.fit(recording, ["delay", "hinge.damping"])
    assert right.explains
    assert not right.shortened
    assert covers(right, {"delay": 0.16, "hinge.damping": 0.01}) == 2
