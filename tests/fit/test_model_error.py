"""Where the model is wrong, intervals contain what parts of the recording say, and say so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from pendulum import PENDULUM
from scipy import stats

import scm_world as sw
from scm_world.fit import fitting
from scm_world.fit.problem import projected

TRUE = {"hinge.damping": 0.02, "pole.mass": 0.25}
BLOCKS = 10

Torque = Callable[[float, float], float]


def cable(angle: float, speed: float) -> float:
    """A cable pulls the pendulum to 0.4 rad."""
    return -0.08 * (angle - 0.4)


def drag(angle: float, speed: float) -> float:
    """Air resists with the square of the speed."""
    return -0.004 * speed * abs(speed)


def recorded(seed: int, more: Torque | None, rows: int = 150) -> dict[str, Any]:
    """Record a pendulum in plain MuJoCo, with a torque that the model lacks."""
    model, rng = mujoco.MjModel.from_xml_string(PENDULUM), np.random.default_rng(seed)
    model.dof_damping[0], model.body_mass[1] = TRUE.values()
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    sent, angles = np.repeat(rng.uniform(-0.5, 0.5, -(-rows // 8)), 8)[: rows - 1], [0.0]
    for command in sent:
        for _ in range(10):
            data.ctrl[0] = command
            if more is not None:
                data.qfrc_applied[0] = more(data.qpos[0], data.qvel[0])
            mujoco.mj_step(model, data)
        angles.append(float(data.qpos[0]))
    measured = np.array(angles) + 1e-3 * rng.normal(size=rows)
    return {"time": 0.02 * np.arange(rows), "motor.control": sent, "hinge.position": measured}


def test_a_fit_with_a_missing_term_is_not_determined() -> None:
    """A cable that the model lacks: the residuals are eight times the noise."""
    fit = sw.World(PENDULUM).fit(recorded(0, cable), [*TRUE])
    assert not fit.explains
    assert not fit.table.determined.any()
    assert any("each half of the recording" in said for said in fit.remarks)
    low, high = fit.table.low.to_numpy(), fit.table.high.to_numpy()
    assert ((low <= [*TRUE.values()]) & (high >= [*TRUE.values()])).all()


def test_intervals_are_at_least_those_of_blocks_in_time() -> None:
    """The sandwich estimator, written out: sums of scores of ten blocks of windows."""
    fit = sw.World(PENDULUM).fit(recorded(2, drag), [*TRUE])
    assert fit.shortened
    residual, along = projected(fit.found)
    sizes = [len(one.residual) for one in fit.found]
    window = np.repeat(np.arange(len(sizes)), sizes)
    bread, meat = np.linalg.inv(along.T @ along), np.zeros((2, 2))
    for block in np.array_split(np.arange(len(sizes)), BLOCKS):
        mine = np.isin(window, block)
        score = along[mine].T @ residual[mine]
        meat += np.outer(score, score)
    errors = np.sqrt(np.diag(bread @ meat @ bread) * BLOCKS / (BLOCKS - 1))
    far = stats.t.ppf(0.975, BLOCKS - 1) * errors
    assert fit.reach is not None
    assert (fit.reach >= 0.99 * far[:, None]).all()


def test_intervals_of_an_explained_recording_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is added where the model is right."""

    def covering(*_: object) -> None:
        raise AssertionError("the model explains this recording")

    monkeypatch.setattr(fitting, "covering", covering)
    fit = sw.World(PENDULUM).fit(recorded(0, None), [*TRUE])
    assert fit.explains
    assert fit.table.determined.all()
