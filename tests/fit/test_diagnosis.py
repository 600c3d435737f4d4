"""A diagnosis names the term that a simulated machine has and its model lacks, or none."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest

import scm_world as sw
from scm_world.fit.diagnosis import Term, recorded_for
from scm_world.fit.recordings import MeasuredNumber, Measurements, RecordedRun

DT, STEPS, SUBSTEPS = 0.01, 60, 2
ARM = """
<mujoco model="arm">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-3 3"/></actuator>
</mujoco>
"""
FITTED = ["hinge.damping", "hinge.frictionloss"]
RIVALS = "*friction*", "delay*", "lag*"  # of those terms that the tests plant
Act = Callable[[mujoco.MjModel, mujoco.MjData, Any, int], None]


def commands() -> Any:
    """Return torques [N m] that last ten control steps each."""
    return np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, STEPS // 10), 10)


def recorded(act: Act, late: int = 0) -> dict[str, Any]:
    """Record plain MuJoCo with 0.03 N m of friction, and an act in each physics step."""
    model, u, found = mujoco.MjModel.from_xml_string(ARM), commands(), []
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    model.dof_damping[0], model.dof_frictionloss[0] = 0.015, 0.03
    for step in range(STEPS + 1):
        found.append((data.qpos[0], data.qvel[0]))
        for _ in range(SUBSTEPS if step < STEPS else 0):
            data.ctrl[0] = u[step]
            act(model, data, u, step)
            mujoco.mj_step(model, data)
    q, v = np.array(found).T
    q = q[np.maximum(np.arange(STEPS + 1) - late, 0)]
    return {
        "time": DT * np.arange(STEPS + 1),
        "motor.control": np.append(u, u[-1]),
        "hinge.position": q + 5e-4 * rng.normal(size=STEPS + 1),
        "hinge.velocity": v + 5e-3 * rng.normal(size=STEPS + 1),
    }


def nothing(*_: object) -> None:
    """Do nothing."""


def stribeck(model: mujoco.MjModel, data: mujoco.MjData, *_: object) -> None:
    """Change the friction: 0.09 N m at rest, 0.03 N m at speed."""
    model.dof_frictionloss[0] = 0.03 + 0.06 * np.exp(-((data.qvel[0] / 0.5) ** 2))


def delayed(_: mujoco.MjModel, data: mujoco.MjData, u: Any, step: int) -> None:
    """Let a command act two control steps late."""
    data.ctrl[0] = u[max(step - 2, 0)]


@cache
def world() -> sw.World:
    """Open the model, which has none of these terms."""
    return sw.World(ARM, control_dt=DT)


@pytest.mark.parametrize(
    ("act", "late", "term", "value"),
    [
        (stribeck, 0, "Coulomb friction that falls with speed", ("hinge.stribeck_speed", 0.5)),
        (delayed, 0, "delay of the command", ("motor.control_delay", 2.0)),
        (nothing, 2, "lag of the sensor", ("hinge.position lag", 2.0)),
    ],
)
def test_the_term_that_a_machine_has_is_named(
    act: Act, late: int, term: str, value: tuple[str, float]
) -> None:
    """Plain MuJoCo has the term; it is the best one, with its value, and explains the recording."""
    diagnosis = world().fit(recorded(act, late), FITTED).diagnose(RIVALS)
    assert [key[0] for key in diagnosis.best] == [term]
    fit, (name, true) = diagnosis.fits[diagnosis.best[0]], value
    assert fit.values[name] == pytest.approx(true, rel=0.25)
    assert fit.explains
    assert diagnosis.table.removed[0] > 0.9
    assert f"The residuals are explained best by {term} in " in str(diagnosis)


def test_no_term_is_claimed_where_the_fit_explains_the_recording() -> None:
    """The extended BIC of each term is above that of the fit."""
    seen = list[tuple[int, int]]()
    fit = world().fit(recorded(nothing), FITTED)
    diagnosis = fit.diagnose(progress=lambda done, total: seen.append((done, total)))
    assert diagnosis.best == ()
    assert min(diagnosis.bic.values()) > 0.0
    assert str(diagnosis).startswith("The fit explains the recording: no term is needed.")
    assert seen[-1] == (len(diagnosis.fits),) * 2

    def stop(done: int, _: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    stopped = fit.diagnose(progress=stop)
    assert len(stopped.fits) == 2
    assert "Stopped after 2 of" in str(stopped)


def test_commands_within_control_steps_stay_where_they_were_sent_in_shorter_ones() -> None:
    """What acts in each physics step is the same, and an added motor has no command."""
    times, sent = np.array([0.0, 0.3, 1.5, 3.1]), np.array([[1.0], [-2.0], [0.5], [3.0]])
    coarse = RecordedRun(np.zeros((4, 1)), np.arange(5), np.zeros((5, 1)), sent=(times, sent))
    measured = Measurements((coarse,), (MeasuredNumber("q", "hinge.position", 0, "rad"),), DT)
    more = '<motor name="other" joint="hinge" ctrlrange="-1 1"/></actuator>'
    text = ARM.replace("</actuator>", more)
    fine, steps = recorded_for(measured, Term(("", ""), sw.World(text, control_dt=DT / SUBSTEPS)))
    assert steps == SUBSTEPS
    (run,) = fine.runs
    acting = run.acting(np.zeros(2), np.arange(4 * SUBSTEPS), 1)[:, 0]
    wanted = coarse.acting(np.zeros(1), np.arange(4), SUBSTEPS).ravel()
    np.testing.assert_allclose(acting[:, 0], wanted, atol=1e-12)
    assert not acting[:, 1].any()
    assert run.instants.tolist() == [0, 2, 4, 6, 8]


def test_what_needs_a_file_is_not_tried_on_a_step_function() -> None:
    """A step function has sensors and commands; the other terms are named as not tried."""

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        v = state["v"] + 0.1 * (action["u"] - parameters["drag"] * state["v"])
        return {"x": state["x"] + 0.1 * v, "v": v}

    system = sw.World(
        step,
        parameters=[sw.Exogenous(name="drag", default=0.5, bounds=sw.Box(0.0, 5.0))],
        actions=[sw.Action(name="u", bounds=sw.Box(-1.0, 1.0))],
        states=[
            sw.Measured(name="x", default=0.0, parents=("x", "v")),
            sw.Measured(name="v", default=0.0, parents=("v", "u", "drag")),
        ],
        control_dt=0.1,
    )
    episode = system.rollout("random", seed=0, steps=60)
    rng = np.random.default_rng(0)
    table = {"time": 0.1 * np.arange(61), "u": np.append(episode.actions[:, 0], np.nan)}
    table["x"] = 1.2 * episode["x"] + 1e-3 * rng.normal(size=61)
    table["v"] = episode["v"] + 1e-3 * rng.normal(size=61)
    fit = system.fit(table, "drag")
    with pytest.raises(sw.errors.UnknownOption, match="gain of the sensor"):
        fit.diagnose("backlash")
    diagnosis = fit.diagnose()
    assert ("gain of the sensor", "x") in diagnosis.best
    assert "backlash" in diagnosis.untried[0]
