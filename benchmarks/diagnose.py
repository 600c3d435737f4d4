"""Diagnose simulated machines that have a term which their model lacks, and count right answers.

::

    python -m benchmarks.diagnose --seeds 5
    python -m benchmarks.diagnose --recordings RECORDINGS

The machines are plain MuJoCo, or equations of motion by Runge-Kutta (two inertias with a spring or
a backlash between them): none of them uses the terms of ``scm_world.fit.diagnosis``. A seed decides
commands and noise, which the fit estimates. ``right`` means that the term is the best one or tied
with it, and that the recording is not ``explained`` without it; ``clean`` machines are right if no
term is named. Real recordings are those of ``benchmarks.real``. The file ``diagnose.json`` is
written after every run.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd

import scm_world as sw
from benchmarks import as_json
from benchmarks.real import MACHINES, PAIRS
from scm_world.queries.experiments.versions import versions

HERE = Path(__file__).parent
DT, STEPS, SUBSTEPS, FINE = 0.01, 250, 5, 40
NOISE = 5e-4, 5e-3  # [rad], [rad/s]
MODEL = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
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
FRICTION = "Coulomb friction"
TERMS = {
    "clean": "",
    "gain": "gain of the sensor",
    "offset": "offset of the sensor",
    "lag": "lag of the sensor",
    "delay": "delay of the command",
    "coulomb": FRICTION,
    "viscous": "viscous damping",
    "stribeck": f"{FRICTION} that falls with speed",
    "load": "friction that grows with the torque",
    "torque": "torque offset",
    "spring": "spring",
    "saturation": "saturation",
    "backlash": "backlash",
    "flexible": "flexible joint",
}


def commands(rng: np.random.Generator) -> Any:
    """Return torques [N m] that last ten control steps each."""
    return np.repeat(rng.uniform(-1.0, 1.0, STEPS // 10), 10)


def one_body(kind: str, u: Any) -> Any:
    """Simulate plain MuJoCo with a term; return positions and velocities, shape (2, rows)."""
    model, found = mujoco.MjModel.from_xml_string(MODEL), []
    data, dof = mujoco.MjData(model), 0
    model.dof_damping[dof] = 0.06 if kind == "viscous" else 0.015
    model.dof_frictionloss[dof] = usual = 0.03
    for step in range(STEPS + 1):
        found.append((data.qpos[0], data.qvel[0]))
        for _ in range(SUBSTEPS if step < STEPS else 0):
            q, v = data.qpos[0], data.qvel[0]
            data.ctrl[0] = u[max(step - 2 * (kind == "delay"), 0)]
            if kind == "stribeck":
                model.dof_frictionloss[dof] = usual + 0.06 * np.exp(-((v / 0.5) ** 2))
            elif kind == "load":
                model.dof_frictionloss[dof] = usual + 0.15 * abs(u[step])
            elif kind == "torque":
                data.qfrc_applied[dof] = 0.05
            elif kind == "spring":
                data.qfrc_applied[dof] = -0.3 * (q - 0.4)
            elif kind == "saturation":
                data.ctrl[0] = np.clip(u[step], -0.6, 0.6)
            mujoco.mj_step(model, data)
    q, v = np.array(found).T
    if kind == "lag":
        q = np.append(q[[0, 0]], q[:-2])
    return q + 0.1 * (kind == "offset"), v * (1.0 + 0.1 * (kind == "gain"))


def two_bodies(kind: str, u: Any) -> Any:
    """Simulate a rotor and a link with a spring or a backlash between them."""
    inertia, rotor, weight = 0.2 * 0.5**2 / 3.0, 0.01, 0.2 * 9.81 * 0.25

    def change(x: Any, torque: float) -> Any:
        apart, speed = x[0] - x[2], x[1] - x[3]
        if kind == "flexible":
            between = 8.0 * apart + 0.02 * speed
        else:
            over = np.sign(apart) * max(abs(apart) - 0.015, 0.0)
            between = 400.0 * over + speed * (over != 0.0)
        gravity = weight * np.sin(x[2])
        return np.array(
            [x[1], (torque - between) / rotor, x[3], (between - gravity - 0.03 * x[3]) / inertia]
        )

    x, h, found = np.zeros(4), DT / FINE, []
    for step in range(STEPS + 1):
        found.append(x[2:])
        for _ in range(FINE if step < STEPS else 0):
            a = change(x, u[step])
            b = change(x + 0.5 * h * a, u[step])
            c = change(x + 0.5 * h * b, u[step])
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + change(x + h * c, u[step]))
    return np.array(found).T


def described(found: sw.Diagnosis) -> dict[str, Any]:
    """Return what a diagnosis says."""
    return {
        "best": found.best,
        "misfit": found.plain.misfit,
        "explained": found.plain.explains,
        "claimed by the criterion alone": bool(found.table.tied.any()),
        "table": found.table.head(5).to_dict("records"),
        "untried": found.untried,
    }


def simulated(kind: str, seed: int) -> dict[str, Any]:
    """Fit and diagnose one simulated machine."""
    rng = np.random.default_rng(seed)
    u = commands(rng)
    measured = (two_bodies if kind in ("backlash", "flexible") else one_body)(kind, u)
    recording = {"time": DT * np.arange(STEPS + 1), "motor.control": np.append(u, u[-1])}
    for name, values, noise in zip(("position", "velocity"), measured, NOISE, strict=True):
        recording[f"hinge.{name}"] = values + noise * rng.normal(size=STEPS + 1)
    fitted = ["pole.mass"] if kind in ("coulomb", "viscous") else FITTED
    world, begin = sw.World(MODEL, control_dt=DT), time.process_time()
    fit = world.fit(recording, fitted)
    middle = time.process_time()
    found, seconds = described(fit.diagnose()), time.process_time() - middle
    named = [term for term, _ in found["best"]]
    right = TERMS[kind] in named and not found["explained"] if kind != "clean" else not named
    about = {"kind": kind, "seed": seed, "right": right, "tied": len(named) > 1}
    return about | found | {"CPU seconds of the fit": middle - begin, "CPU seconds": seconds}


def real(folder: Path) -> Iterator[tuple[str, Any]]:
    """Fit and diagnose recordings of real machines, by the parameters of ``benchmarks.real``."""
    pairs = {pair.fitted: pair for pair in PAIRS.values()}
    for name, pair in pairs.items():
        machine, table = MACHINES[pair.machine], pd.read_csv(folder / f"{name}.csv")
        table = table.rename(columns=machine.columns)[["time", *machine.columns.values()]]
        table["time"] -= table.time[0]
        table = table[table.time < pair.until]
        world = machine.open(float(np.round(np.median(np.diff(table.time)), 6)))
        fit = world.given(pair.before).fit(table, machine.fitted)
        yield name, described(fit.diagnose())


def main() -> None:
    """Diagnose simulated machines, or real ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="recordings of each machine")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", nargs="*", default=[*TERMS], help="kinds of machines")
    parser.add_argument("--recordings", type=Path, help="a folder with those of benchmarks.real")
    parser.add_argument("--out", type=Path, default=HERE / "diagnose.json")
    asked = parser.parse_args()
    known = json.loads(asked.out.read_text()) if asked.out.exists() else {}
    runs = {(run["kind"], run["seed"]): run for run in known.get("runs", [])}
    machines = known.get("real", {})

    def write() -> None:
        rows = [runs[key] for key in sorted(runs)]
        count = {kind: [run["right"] for run in rows if run["kind"] == kind] for kind in TERMS}
        rates = {kind: [sum(each), len(each)] for kind, each in count.items()}
        about = {"versions": versions(), "right": rates, "runs": rows, "real": machines}
        asked.out.write_text(as_json(about))

    if asked.recordings is not None:
        for name, found in real(asked.recordings):
            machines[name] = found
            write()
            print(name, found["best"], flush=True)
        return
    for seed in range(asked.first, asked.first + asked.seeds):
        for kind in asked.only:
            runs[kind, seed] = run = simulated(kind, seed)
            write()
            print(kind, seed, "right" if run["right"] else "wrong", run["best"], flush=True)


if __name__ == "__main__":
    main()
