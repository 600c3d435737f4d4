"""Count which recordings of foreign models are refused as in degrees, or with quaternions (w, …).

::

    python benchmarks/recordings.py --runs 6

Robots that deviate from their models in every mass, damping, gear and friction (by factors with a
standard deviation of e^0.7) are recorded with noise, half of them with velocities, under random
commands. Honest recordings should pass. Then they are written in degrees, and with w first.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from fit import CASES, OTHERS, Case, record, world_of

import scm_world as sw
from scm_world.errors import EngineFailure, InterventionError, ModelError
from scm_world.fit.recordings import read_recording
from scm_world.fit.units import check_units

HERE = Path(__file__).parent
POSES = {"*.position": 2e-3, "*.orientation": 2e-3, "*.cartesian_position": 2e-3}
GYMNASIUM = "ant humanoid hopper walker2d swimmer inverted_double_pendulum inverted_pendulum"
SUITE = "humanoid cartpole pendulum point_mass swimmer"
FACTORS = (".mass", ".damping", ".gear", ".kp", ".frictionloss", ".friction", ".armature")


def cases() -> dict[str, Case]:
    """Return the models of ``benchmarks/fit.py``, and some whose root is free."""
    files = {n: ("gymnasium", f"envs/mujoco/assets/{n}.xml") for n in GYMNASIUM.split()}
    files |= {f"dm_control {n}": ("dm_control", f"suite/{n}.xml") for n in SUITE.split()}
    more = {name: Case(*file, {}, noise=POSES) for name, file in files.items()}
    return {name: replace(one, delay=0.0) for name, one in {**CASES, **OTHERS, **more}.items()}


def verdict(world: sw.World, recording: dict[str, Any]) -> str:
    """Return how a recording is taken: as it is, in degrees, with w first, or beyond limits."""
    world.reset(seed=0)
    try:
        found = read_recording(world, recording)
    except ModelError:
        return "beyond limits"
    try:
        check_units(world, found)
    except ModelError as error:
        return "degrees" if "in degrees" in str(error) else "w first"
    return "as it is"


def main() -> None:
    """Try all models."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=6, help="recordings of each model")
    asked = parser.parse_args()
    table: dict[str, Counter[str]] = {}
    for name, case in cases().items():
        world, rng = world_of(case), np.random.default_rng(0)
        world.reset(seed=0)
        for run in range(asked.runs):
            names = [
                n
                for n in world.compiled.static_names
                if n.endswith(FACTORS) and np.ndim(world[n]) == 0 and float(world[n]) > 0.0
            ]
            factors = np.exp(0.7 * rng.normal(size=len(names)))
            values = {n: float(world[n]) * f for n, f in zip(names, factors, strict=True)}
            share, steps = float(rng.uniform(0.02, 1.0)), int(rng.integers(15, 90))
            noise = case.noise | ({"*velocity": 0.02} if run % 2 else {})
            mine = replace(case, share=share, steps=steps, noise=noise)
            try:
                honest = record(world, world.given(values), mine, run)
            except (EngineFailure, InterventionError):
                continue
            slices = world.compiled.slices
            units = {n: world.model.declared(n).unit for n in honest if n in slices}
            faults = {"honest": honest}
            angles = [n for n, unit in units.items() if unit == "rad"]
            rates = [n for n, unit in units.items() if unit == "rad/s"]
            turns = [n for n in units if n.endswith("orientation")]
            if angles:
                faults["angles in degrees"] = {n: np.degrees(honest[n]) for n in angles}
                faults["and rates"] = {n: np.degrees(honest[n]) for n in angles + rates}
                faults["one angle in degrees"] = {angles[-1]: np.degrees(honest[angles[-1]])}
            if turns:
                faults["w first"] = {n: np.roll(honest[n], 1, axis=1) for n in turns}
            for fault, changed in faults.items():
                table.setdefault(fault, Counter())[verdict(world, honest | changed)] += 1
        print(name, {fault: dict(counts) for fault, counts in table.items()}, flush=True)
    (HERE / "recordings.json").write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
