"""Rows that no noise explains, and columns in another unit or with another sign."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest

import scm_world as sw

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.005"/>
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="20"/></actuator>
</mujoco>
"""
NOISE = 1e-3  # [rad]
NAMES = ["hinge.damping", "motor.gear"]


def swung(damping: float = 0.02, steps: int = 120) -> dict[str, Any]:
    """Return a recording by plain MuJoCo, of positions and velocities."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.dof_damping[0] = damping
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    commands, seen = np.repeat(rng.uniform(-0.03, 0.03, steps // 10), 10), [(0.0, 0.0)]
    for command in commands:
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 4)
        seen.append((float(data.qpos[0]), float(data.qvel[0])))
    position, velocity = (np.array(seen) + NOISE * rng.normal(size=(steps + 1, 2))).T
    names = ("time", "motor.control", "hinge.position", "hinge.velocity")
    time = 0.02 * np.arange(steps + 1)
    return dict(zip(names, (time, np.append(commands, np.nan), position, velocity), strict=True))


def test_rows_that_are_far_from_all_others_are_left_out_and_named() -> None:
    """The fit is that of the recording without them; two in a row and the first one count, too."""
    world, clean = sw.World(PENDULUM), swung()
    spoiled, holes = (pd.DataFrame(clean) for _ in range(2))
    rows = [0, 37, 70, 71]
    spoiled.loc[rows, "hinge.position"] += [0.4, -1.0, 0.05, 0.06]
    spoiled.loc[90, "hinge.velocity"] = 0.0
    holes.loc[rows, "hinge.position"] = np.nan
    holes.loc[90, "hinge.velocity"] = np.nan
    fit, other = world.fit(spoiled, NAMES), world.fit(holes, NAMES)
    assert sorted((one.column, one.row) for one in fit.outliers) == [
        *((0, row) for row in rows),
        (1, 90),
    ]
    np.testing.assert_allclose(fit.scaled, other.scaled, atol=0.02 * float(other.errors.min()))
    off = {one.row: one.off for one in fit.outliers if one.column == 0}
    assert off[37] == pytest.approx(-1.0, rel=0.3)
    assert "hinge.position = " in str(fit)
    assert "in row 37 (0.74 s) is" in str(fit)
    assert fit.explains
    assert not other.outliers
    assert not world.fit(clean, NAMES).outliers


def test_what_another_model_would_explain_is_no_outlier() -> None:
    """A jump of the pose, after which all goes on from there, and friction that is not modelled."""
    world, jumped = sw.World(PENDULUM), swung()
    jumped["hinge.position"] = jumped["hinge.position"] + 0.3 * (np.arange(121) > 63)
    fit = world.fit(jumped, NAMES)
    assert not fit.outliers
    assert not fit.explains


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [
        ("motor.control", -1.0, "motor.control times -1 "),
        ("motor.control", 20.0, "motor.control times 1/gear = 0.05 "),
        ("hinge.velocity", -1.0, "hinge.velocity times -1 "),
        ("hinge.velocity", 1e3, "hinge.velocity times 1/1000 "),
    ],
)
def test_a_factor_that_makes_the_world_follow_is_named(
    column: str, factor: float, words: str
) -> None:
    """A sign, a thousand, or the torque of the joint in place of that of the motor."""
    world, recording = sw.World(PENDULUM), swung(0.01)
    assert not world.fit(recording, ["hinge.damping"]).reading
    recording[column] = factor * recording[column]
    fit = world.fit(recording, ["hinge.damping"])
    assert words in fit.reading
    assert fit.reading in str(fit)
    assert not fit.explains
