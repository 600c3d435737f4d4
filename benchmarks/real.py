"""A real machine, an intervention, a prediction: fits of recordings of hardware.

::

    python -m benchmarks.real RECORDINGS

Each model is fitted to one recording, and predicts others 0.1, 0.5 and 1 s ahead: a later part of
the same run, another controller, and another weight, which the model learns by ``do`` alone. Beside
the prediction stand the model as its file says, the fit without the ``do``, a fit of the very
recording that is predicted (of its first seconds), constant velocity, and an independent multiple
shooting fit of equations of motion by SciPy, with the same parameters.

The recordings are of the DFKI Underactuated Robotics Lab (BSD 3-Clause): their repositories
``torque_limited_simple_pendulum`` (``results``) and ``double_pendulum``
(``data/experiment_records/design_C.1/sys_id``) have them. The folder has ``pendulum_*.csv`` (time,
position, velocity, torque) and ``double_pendulum_*.csv``. It writes ``real.json``, from which
``python -m benchmarks.figures real`` draws the picture of the page.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

import scm_world as sw
from benchmarks import as_json
from scm_world.queries.experiments.versions import versions

HERE = Path(__file__).parent
HORIZONS = (0.1, 0.5, 1.0)  # [s]
SEGMENT = 0.25  # [s] of the independent fit
STEPS = 5  # Runge-Kutta steps of a control step, at most 1 ms
SMOOTH = 0.05  # velocity over which its Coulomb friction rises [rad/s]
GRAVITY = 9.81

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="{timestep}" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 -1 0" damping="0.01" frictionloss="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.01" mass="0.13"/>
      <body name="weight" pos="0 0 -0.5"><geom type="sphere" size="0.03" mass="0.5"/></body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrllimited="true" ctrlrange="-20 20"/></actuator>
</mujoco>
"""
DOUBLE = """
<mujoco model="double_pendulum">
  <option timestep="{timestep}" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 -1 0" damping="0.001" frictionloss="0.1"/>
      <inertial pos="0 0 -0.2" mass="0.6" diaginertia="0.0001 0.0001 0.0001"/>
      <body name="lower" pos="0 0 -0.2">
        <joint name="elbow" axis="0 -1 0" damping="0.001" frictionloss="0.1"/>
        <inertial pos="0 0 -0.25" mass="0.5" diaginertia="0.0001 0.0001 0.0001"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="first" joint="shoulder" ctrllimited="true" ctrlrange="-2 2"/>
    <motor name="second" joint="elbow" ctrllimited="true" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""


def one_link(v: Mapping[str, float], q: Any, u: Any) -> Any:
    """Accelerations of a pendulum; positions and velocities have shape (n, 2), torques (n, 1)."""
    mass, inertia = v["weight.mass"], v["weight.mass"] * 0.25 + 0.13 * 0.25 / 3
    torque = u[:, 0] * v["motor.gear"] - (mass * 0.5 + 0.13 * 0.25) * GRAVITY * np.sin(q[:, 0])
    torque -= v["hinge.damping"] * q[:, 1]
    torque -= v["hinge.frictionloss"] * np.tanh(q[:, 1] / SMOOTH)
    return (torque / inertia)[:, None]


def two_links(v: Mapping[str, float], q: Any, u: Any) -> Any:
    """Accelerations of two links; q has shape (n, 4), angles first, u (n, 2).

    Source:
        Spong, Hutchinson and Vidyasagar, *Robot Modeling and Control*, 2020, section 6.4: the
        planar elbow manipulator, with the second angle relative to the first.
    """
    m1, m2, c1, c2, small = v["upper.mass"], v["lower.mass"], 0.2, 0.25, 0.0001
    both = m2 * 0.2 * c2 * np.cos(q[:, 1])
    a22 = m2 * c2**2 + small
    a12 = a22 + both
    a11 = m1 * c1**2 + m2 * 0.04 + small + a22 + 2.0 * both
    a11, a22 = a11 + v["shoulder.armature"], a22 + v["elbow.armature"]
    fast = m2 * 0.2 * c2 * np.sin(q[:, 1])
    far = m2 * c2 * GRAVITY * np.sin(q[:, 0] + q[:, 1])
    near = (m1 * c1 + m2 * 0.2) * GRAVITY * np.sin(q[:, 0])
    load = np.array([u[:, 0] - near - far, u[:, 1] - far])
    load += fast * np.array([q[:, 3] * (2.0 * q[:, 2] + q[:, 3]), -(q[:, 2] ** 2)])
    for i, joint in enumerate(("shoulder", "elbow")):
        load[i] -= v[f"{joint}.damping"] * q[:, 2 + i]
        load[i] -= v[f"{joint}.frictionloss"] * np.tanh(q[:, 2 + i] / SMOOTH)
    size = a11 * a22 - a12**2
    return (
        np.array([a22 * load[0] - a12 * load[1], a11 * load[1] - a12 * load[0]]).T / size[:, None]
    )


@dataclass(frozen=True)
class Machine:
    """A machine: its model, and the same one as equations.

    Attributes:
        text: MJCF, whose physics step is open.
        joints: Names of the joints.
        columns: Columns of the recordings, by the names of the model.
        fitted: Parameters that are fitted.
        equations: Accelerations, of parameters, states and torques.
    """

    text: str
    joints: tuple[str, ...]
    columns: Mapping[str, str]
    fitted: tuple[str, ...]
    equations: Callable[[Mapping[str, float], Any, Any], Any]

    def open(self, period: float, **options: Any) -> Any:
        """Open the model with the control step of a recording."""
        steps = int(np.ceil(period / 0.001 - 1e-6))
        return sw.World(self.text.format(timestep=period / steps), control_dt=period, **options)


MACHINES = {
    "pendulum": Machine(
        PENDULUM,
        ("hinge",),
        {"position": "hinge.position", "velocity": "hinge.velocity", "torque": "motor.control"},
        ("hinge.frictionloss", "hinge.damping", "motor.gear"),
        one_link,
    ),
    "double pendulum": Machine(
        DOUBLE,
        ("shoulder", "elbow"),
        {
            "pos_meas1": "shoulder.position",
            "pos_meas2": "elbow.position",
            "vel_meas1": "shoulder.velocity",
            "vel_meas2": "elbow.velocity",
            "tau_meas1": "first.control",
            "tau_meas2": "second.control",
        },
        (
            *("upper.mass", "lower.mass", "shoulder.armature", "elbow.armature"),
            *("shoulder.damping", "elbow.damping", "shoulder.frictionloss", "elbow.frictionloss"),
        ),
        two_links,
    ),
}
HEAVY = {"weight.mass": 1.0}
HALF, ONE = "pendulum_half_kilogram", "pendulum_one_kilogram"
FIRST, SECOND = "double_pendulum_1", "double_pendulum_2"


@dataclass(frozen=True)
class Pair:
    """A prediction: of one recording by the fit of another one.

    Attributes:
        machine: The machine.
        fitted: The recording that is fitted, up to ``until``.
        predicted: The recording that is predicted.
        before: What is known of the machine in the first recording.
        do: What was changed on the machine before the second one.
        start: Where the prediction begins [s].
        until: Length of the fitted part [s].
    """

    machine: str
    fitted: str
    predicted: str
    before: Mapping[str, float]
    do: Mapping[str, float]
    start: float = 0.0
    until: float = 6.0


PAIRS = {
    "later in the same run": Pair("pendulum", HALF, HALF, {}, {}, start=6.0),
    "another weight, by do": Pair("pendulum", HALF, ONE, {}, HEAVY),
    "back to the first weight, by do": Pair("pendulum", ONE, HALF, HEAVY, {"weight.mass": 0.5}),
    "another controller and clock": Pair("pendulum", HALF, "pendulum_ilqr", {}, {}),
    "excitation by spikes": Pair("pendulum", HALF, "pendulum_excitation", {}, {}),
    "the other excitation": Pair("double pendulum", FIRST, SECOND, {}, {}, until=3.0),
    "the first excitation": Pair("double pendulum", SECOND, FIRST, {}, {}, until=3.0),
}


def read(machine: Machine, path: Path) -> tuple[pd.DataFrame, float]:
    """Read a recording, and its period [s]; rows that are off the clock at the start are left."""
    frame = pd.read_csv(path)[["time", *machine.columns]].rename(columns=dict(machine.columns))
    period = round(float(np.median(np.diff(frame["time"]))), 6)
    late = np.flatnonzero(np.abs(np.diff(frame["time"]) / period - 1.0) > 0.25)
    begin = int(late[late < 10].max(initial=-1)) + 1
    frame = frame.iloc[begin:].reset_index(drop=True)
    return frame.assign(time=period * np.arange(len(frame))), period


def states(machine: Machine, frame: pd.DataFrame) -> tuple[Any, Any]:
    """Return positions and velocities, shape (rows, 2 joints), and commands."""
    kinds = [f"{joint}.{kind}" for kind in ("position", "velocity") for joint in machine.joints]
    commands = [name for name in machine.columns.values() if name.endswith(".control")]
    return frame[kinds].to_numpy(), frame[commands].to_numpy()


def ahead(
    machine: Machine,
    frame: pd.DataFrame,
    period: float,
    values: Mapping[str, float],
    horizon: float,
) -> Any:
    """Predict windows that do not overlap by the engine; errors of the angles [rad], shape (n,)."""
    measured, commands = states(machine, frame)
    steps, count = round(horizon / period), len(machine.joints)
    begins = np.arange(0, len(frame) - steps, steps)
    with machine.open(period, num_worlds=len(begins)) as world:
        kinds = [f"{joint}.{kind}" for kind in ("position", "velocity") for joint in machine.joints]
        starts = {name: measured[begins, i] for i, name in enumerate(kinds)}
        world.reset(seed=0, do={**dict(values), **starts})
        for step in range(steps):
            world.step(commands[begins + step])
        found = np.array([world.values()[name] for name in kinds[:count]]).T
    return np.linalg.norm(found - measured[begins + steps, :count], axis=1)


def still(machine: Machine, frame: pd.DataFrame, period: float, horizon: float) -> Any:
    """Errors of a prediction by constant velocity [rad]."""
    measured, _ = states(machine, frame)
    steps, count = round(horizon / period), len(machine.joints)
    begins = np.arange(0, len(frame) - steps, steps)
    guess = measured[begins, :count] + steps * period * measured[begins, count:]
    return np.linalg.norm(guess - measured[begins + steps, :count], axis=1)


def independent(
    machine: Machine, frame: pd.DataFrame, period: float, values: Mapping[str, float]
) -> dict[str, float]:
    """Fit the equations of motion to a recording by multiple shooting, with SciPy alone.

    The states at the start of each segment are unknowns, and the gaps between segments are
    residuals of a tenth of the noise. The noise of each column is estimated from second
    differences.
    """
    measured, commands = states(machine, frame)
    names, half = list(machine.fitted), len(machine.joints)
    width = round(SEGMENT / period)
    begins = np.arange(0, len(frame) - width, width)
    noise = np.std(np.diff(measured, n=2, axis=0), axis=0) / 6**0.5 + 1e-3
    rows = begins[:, None] + np.arange(1, width + 1)
    h = period / STEPS
    scale = np.array([abs(values[name]) or 0.01 for name in names])

    def simulated(x: Any) -> Any:
        v = {**dict(values), **dict(zip(names, np.abs(x[: len(names)]) * scale, strict=True))}

        def slope(q: Any, u: Any) -> Any:
            return np.hstack([q[:, half:], machine.equations(v, q, u)])

        q, out = x[len(names) :].reshape(len(begins), -1) * noise + measured[begins], []
        for step in range(width):
            u = commands[begins + step]
            for _ in range(STEPS):
                a = slope(q, u)
                b = slope(q + h / 2 * a, u)
                c = slope(q + h / 2 * b, u)
                q = q + h / 6 * (a + 2 * b + 2 * c + slope(q + h * c, u))
            out.append(q)
        return np.array(out).swapaxes(0, 1)  # (segments, width, states)

    def residual(x: Any) -> Any:
        path = simulated(x)
        begun = x[len(names) :].reshape(len(begins), -1) * noise + measured[begins]
        gaps = (path[:-1, -1] - begun[1:]) / (0.1 * noise)
        return np.concatenate([((path - measured[rows]) / noise).ravel(), gaps.ravel()])

    begin = np.concatenate([np.ones(len(names)), np.zeros(measured[begins].size)])
    found = least_squares(residual, begin, jac=partial(jacobian, residual, len(names), 2 * half),
                          loss="soft_l1", max_nfev=40)  # fmt: skip
    return dict(zip(names, np.abs(found.x[: len(names)]) * scale, strict=True))


def jacobian(residual: Callable[[Any], Any], count: int, width: int, x: Any) -> Any:
    """Differences of the residuals; start states of all segments are moved at the same time.

    A segment's residuals depend on its own start, and on that of the next one through the gap.
    So three colours of segments are enough.
    """
    base, step = residual(x), 1e-6
    out = np.zeros((len(base), len(x)))
    for i in range(count):
        moved = x.copy()
        moved[i] += step
        out[:, i] = (residual(moved) - base) / step
    segments = (len(x) - count) // width
    rows = owner(len(base), segments, width)
    for state in range(width):
        for colour in range(3):
            chosen = np.arange(colour, segments, 3)
            moved = x.copy()
            moved[count + chosen * width + state] += step
            change = (residual(moved) - base) / step
            for one in chosen:
                mine = (rows[:, 0] == one) | (rows[:, 1] == one)
                out[mine, count + one * width + state] = change[mine]
    return out


def owner(size: int, segments: int, width: int) -> Any:
    """Return the two segments on whose start states each residual depends, shape (size, 2)."""
    each = (size - (segments - 1) * width) // segments
    own = np.repeat(np.arange(segments), each)
    gap = np.repeat(np.arange(segments - 1), width)
    return np.concatenate([np.stack([own, own], 1), np.stack([gap, gap + 1], 1)])


def summary(errors: Any) -> dict[str, Any]:
    """Median and 90 % quantile over windows, with a 95 % bootstrap interval of the median."""
    draws = np.random.default_rng(0).choice(errors, (2000, len(errors)))
    low, high = np.quantile(np.median(draws, axis=1), [0.025, 0.975])
    found = {"median": np.median(errors), "low": low, "high": high}
    return {**found, "quantile": np.quantile(errors, 0.9), "windows": len(errors)}


def fitted(
    machine: Machine, frame: pd.DataFrame, period: float, before: Mapping[str, float]
) -> Any:
    """Fit the model to a recording, with what is known of the machine."""
    with machine.open(period) as world:
        given = world.given(dict(before)) if before else world
        return given.fit(frame, machine.fitted)


def predict(pair: Pair, folder: Path) -> dict[str, Any]:
    """Fit a recording, and predict another one in all ways."""
    machine = MACHINES[pair.machine]
    source, clock = read(machine, folder / f"{pair.fitted}.csv")
    target, period = read(machine, folder / f"{pair.predicted}.csv")
    source = source[source["time"] < pair.until]
    target = target[target["time"] >= pair.start].reset_index(drop=True)
    target["time"] -= target["time"].iloc[0]
    begun = time.process_time()
    fit = fitted(machine, source, clock, pair.before)
    seconds = time.process_time() - begun
    with machine.open(clock) as world:
        names = {*machine.fitted, *pair.before, *pair.do, "weight.mass"}
        world.reset(seed=0)
        usual = world.values()
        file = {name: float(usual[name]) for name in names if name in usual}
    known = {**file, **pair.before}
    again = fitted(machine, target[target["time"] < pair.until], period, {**pair.before, **pair.do})
    other = independent(machine, source, clock, known)
    ways = {
        "predicted": {**pair.before, **fit.values, **pair.do},
        "without the do": {**pair.before, **fit.values},
        "file": {**pair.before, **pair.do},
        "refitted": {**pair.before, **again.values, **pair.do},
        "independent fit": {**pair.before, **other, **pair.do},
    }
    found: dict[str, Any] = {
        "fit": fit.table.to_dict("records"),
        "remarks": list(fit.remarks),
        "refit": again.table.to_dict("records"),
        "independent": other,
        "seconds": seconds,
        "errors": {},
    }
    for horizon in HORIZONS:
        errors = {n: ahead(machine, target, period, v, horizon) for n, v in ways.items()}
        errors["constant velocity"] = still(machine, target, period, horizon)
        ratio = np.median(errors["predicted"]) / np.median(errors["refitted"])
        row = {name: summary(each) for name, each in errors.items()}
        found["errors"][str(horizon)] = {**row, "ratio": ratio}
    return found


def show(name: str, pair: Pair, found: Mapping[str, Any]) -> None:
    """Print the predictions of a pair."""
    print(f"\n{pair.machine}: {name} ({pair.fitted} -> {pair.predicted}), {found['seconds']:.0f} s")
    print(pd.DataFrame(found["fit"]).to_string(index=False))
    for remark in found["remarks"]:
        print(f"  {remark}")
    print("  independent:", {k: round(v, 4) for k, v in found["independent"].items()})
    for horizon, row in found["errors"].items():
        cells = (
            f"{k} {v['median']:.3f} ({v['quantile']:.2f})" for k, v in row.items() if k != "ratio"
        )
        print(f"  {horizon:>4} s  {'  '.join(cells)}  ratio {row['ratio']:.2f}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Predict all pairs, and write the results after each."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="pairs whose name has this text")
    parser.add_argument("--out", type=Path, default=HERE / "real.json")
    given = parser.parse_args(arguments)
    results: dict[str, Any] = {"versions": versions(), "pairs": {}}
    for name, pair in PAIRS.items():
        if given.only in name:
            results["pairs"][name] = found = predict(pair, given.folder)
            show(name, pair, found)
            given.out.write_text(as_json(results), encoding="utf-8")


if __name__ == "__main__":
    main()
