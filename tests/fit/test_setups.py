"""Recordings that carry their do: several set-ups of one machine, fitted together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import scm_world as sw
from scm_world.cli.app import app
from scm_world.errors import InterventionError, ModelError, UnknownOption, UnknownVariable

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.005"/>
  <worldbody>
    <body name="weight">
      <joint name="hinge" axis="0 1 0" damping="0.04" armature="0"/>
      <inertial pos="0 0 -0.5" mass="0.5" diaginertia="1e-5 1e-5 1e-5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="1" ctrlrange="-3 3"/></actuator>
</mujoco>
"""
TRUE = {"motor.gear": 1.2, "hinge.damping": 0.06}
NOISE = 1e-3  # [rad]


def swung(mass: float, seed: int) -> dict[str, Any]:
    """Return a recording by plain MuJoCo, of a motor that is stronger than its file."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.body_mass[1] = mass
    model.actuator_gear[0, 0], model.dof_damping[0] = TRUE.values()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    commands, seen = np.repeat(rng.uniform(-2.0, 2.0, 6), 10), [0.0]
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 4)
        seen.append(float(data.qpos[0]))
    return {
        "time": 0.02 * np.arange(61),
        "motor.control": np.append(commands, np.nan),
        "hinge.position": np.array(seen) + NOISE * rng.normal(size=61),
    }


def test_two_set_ups_tell_mass_from_gear() -> None:
    """One weight alone leaves a ridge: mass, gear and damping scale together; two weights do not.

    A parameter that is unknown in one run is known in the other one.
    """
    world, names = sw.World(PENDULUM), ["weight.mass", *TRUE]
    half, one = swung(0.5, 0), swung(1.0, 1)
    alone = world.fit(half, names, noise=NOISE)
    assert not alone.table.determined.any()
    assert any({"weight.mass", "motor.gear"} <= {*group} for group in alone.confounded)
    recordings = [half, {**one, "do": {"weight.mass": 1.0}}]
    both = world.fit(recordings, names, noise=NOISE)
    table = both.table.set_index("parameter")
    assert table.determined.all()
    for name, true in {**TRUE, "weight.mass": 0.5}.items():
        assert table.low[name] < true < table.high[name]
    assert both.explains
    assert both.replay.fit[0] < 0.3 * both.replay.unfitted[0]
    column = [half, pd.DataFrame(one).assign(**{"do.weight.mass": 1.0})]
    assert world.fit(column, names, noise=NOISE).values == both.values
    listed = world.fit([half, one], names, noise=NOISE, setups=[{}, {"weight.mass": 1.0}])
    assert listed.values == both.values
    episodes = pd.concat(
        [column[1].assign(episode=1), pd.DataFrame(half).assign(episode=0)], ignore_index=True
    )
    mixed = world.fit(episodes, names, noise=NOISE)
    assert mixed.values == pytest.approx(both.values, rel=1e-4)
    without = world.fit([half, one], ["motor.gear", "hinge.damping"], noise=NOISE)
    assert not without.explains


def test_a_prediction_under_do() -> None:
    """Fitted with one weight, another one is predicted, and only with its do."""
    world = sw.World(PENDULUM)
    fit = world.fit(swung(0.5, 0), [*TRUE], noise=NOISE)
    other = {**swung(1.0, 1), "do": {"weight.mass": 1.0}}
    right, wrong = fit.predict(other), fit.predict(swung(1.0, 1))
    assert right.table.fit[0] < 2.0 * NOISE
    assert wrong.table.fit[0] > 20.0 * NOISE
    same = fit.counterfactual({}, draws=2)
    carried = world.fit(other, [*TRUE], noise=NOISE).counterfactual({"weight.mass": 0.5}, draws=2)
    np.testing.assert_allclose(same.counterfactual, same.measured, atol=1e-9)
    assert np.abs(carried.counterfactual - carried.measured).max() > 20.0 * NOISE


def test_an_experiment_may_be_in_another_set_up() -> None:
    """Where only a known weight tells mass from gear, it is proposed, and its frame has it."""
    world = sw.World(PENDULUM)
    fit = world.fit(swung(0.5, 0), ["weight.mass", *TRUE], noise=NOISE)
    (found,) = fit.suggest(1, steps=40, setups=[{"weight.mass": 1.0}])
    assert found.do == {"weight.mass": 1.0}
    assert str(found).startswith("with weight.mass = 1: 40 control steps")
    assert (found.frame()["do.weight.mass"] == 1.0).all()
    (own,) = fit.suggest(1, steps=40)
    assert not own.do
    assert found.errors["motor.gear"][1] < 0.1 * own.errors["motor.gear"][1]
    with pytest.raises(InterventionError):
        fit.suggest(1, setups=[{"weight.mass": -1.0}])


def test_set_ups_are_checked(tmp_path: Path, monkeypatch: Any) -> None:
    """Unknown names, values that change within a run, and other numbers of set-ups."""
    world, one = sw.World(PENDULUM), swung(0.5, 0)
    frame = pd.DataFrame(one)
    for column, told in (
        (frame.assign(**{"do.knee.mass": 1.0}), r"do\.knee\.mass"),
        (frame.assign(**{"do.weight.mass": frame.time}), "has several values"),
        (frame.assign(**{"weight.mass": 1.0}), r"name them do\.weight\.mass"),
    ):
        with pytest.raises(ModelError, match=told):
            world.fit(column, ["motor.gear"])
    with pytest.raises(UnknownVariable, match=r"knee\.mass"):
        world.fit({**one, "do": {"knee.mass": 1.0}}, ["motor.gear"])
    for wrong in ({"weight.mass": "heavy"}, {"gravity": 1.0}, 3.0):
        with pytest.raises(UnknownOption, match="set-up"):
            world.fit({**one, "do": wrong}, ["motor.gear"])
    with pytest.raises(UnknownOption, match="1 set-ups"):
        world.fit([one, one], ["motor.gear"], setups=[{}])
    with pytest.raises(InterventionError):
        world.fit({**one, "do": {"weight.mass": -1.0}}, ["motor.gear"])
    monkeypatch.chdir(tmp_path)
    Path("pendulum.xml").write_text(PENDULUM)
    for name, (mass, seed) in {"half.csv": (0.5, 0), "one.csv": (1.0, 1)}.items():
        pd.DataFrame(swung(mass, seed)).to_csv(name, index=False)
    words = ["fit", "pendulum.xml", "half.csv", "one.csv", "--parameters", "motor.gear"]
    words += ["--parameters", "hinge.damping", "--out", "out"]
    done = CliRunner().invoke(app, [*words, "--setup", "1:weight.mass=1.0"])
    assert done.exit_code == 0, done.output
    for wrong in ("one.csv:weight.mass=1", "2:weight.mass=1", "weight.mass=1"):
        done = CliRunner().invoke(app, [*words, "--setup", wrong])
        assert done.exit_code == 2
        assert "--setup" in done.output
