"""Coverage of the intervals of counterfactuals of fitted recordings, on four models.

Each run records a true system with noise, fits the world of the file to it, and asks what would
have been measured if a parameter had changed at control step 40. The true system answers the same
question with the same noise. Printed is how many of its measurements 5 to 75 control steps later
are within the intervals of 95 %.

Run ``python benchmarks/fit_counterfactuals.py --runs 20``.
"""

from __future__ import annotations

import argparse
import warnings
from typing import NamedTuple

import numpy as np

import scm_world as sw

STEPS, AT, LATER, HELD = 120, 40, (5, 10, 25, 50, 75), 8
HEAD = '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
ROD = '<geom type="capsule" size=".02" contype="0" conaffinity="0"'
TAIL = "</worldbody><actuator>{}</actuator></mujoco>"


class Case(NamedTuple):
    """A model, the true values of what is fitted, the noise of positions, and an intervention."""

    xml: str
    truth: dict[str, float]
    noise: float
    do: dict[str, float]


CASES = {
    "pendulum": Case(
        f'{HEAD}<body name="pole"><joint name="hinge" axis="0 1 0" damping=".02"/>'
        f'{ROD} fromto="0 0 0 0 0 -.5" mass=".2"/></body>'
        + TAIL.format('<motor name="motor" joint="hinge" ctrlrange="-.4 .4"/>'),
        {"hinge.damping": 0.05, "pole.mass": 0.25},
        0.01,
        {"pole.mass": 0.4},
    ),
    "servo": Case(
        f'{HEAD}<body name="arm"><joint name="j" axis="0 1 0" damping=".1" armature=".01"/>'
        f'{ROD} fromto="0 0 0 .4 0 0" mass=".6"/></body>'
        + TAIL.format('<position name="s" joint="j" kp="30" kv="1" ctrlrange="-2 2"/>'),
        {"s.kp": 38.0, "j.damping": 0.3},
        0.002,
        {"s.kp": 20.0},
    ),
    "cartpole": Case(
        f'{HEAD}<body name="cart"><joint name="slider" type="slide" axis="1 0 0" damping=".5"/>'
        '<geom type="box" size=".1 .1 .05" mass="1" contype="0" conaffinity="0"/>'
        '<body name="pole"><joint name="hinge" axis="0 1 0" damping=".01"/>'
        f'{ROD} fromto="0 0 0 0 0 -.6" mass=".2"/></body></body>'
        + TAIL.format('<motor name="motor" joint="slider" gear="5" ctrlrange="-1 1"/>'),
        {"slider.damping": 1.0, "cart.mass": 1.3, "hinge.damping": 0.02},
        0.005,
        {"pole.mass": 0.5},
    ),
    "two links": Case(
        f'{HEAD}<body name="upper"><joint name="shoulder" axis="0 1 0" damping=".05"/>'
        f'{ROD} fromto="0 0 0 0 0 -.3" mass=".4"/><body name="lower" pos="0 0 -.3">'
        '<joint name="elbow" axis="0 1 0" damping=".03"/>'
        f'{ROD} fromto="0 0 0 0 0 -.3" mass=".2"/></body></body>'
        + TAIL.format(
            '<motor name="m" joint="shoulder" ctrlrange="-1 1"/>'
            '<motor name="n" joint="elbow" ctrlrange="-.3 .3"/>'
        ),
        {"shoulder.damping": 0.1, "elbow.damping": 0.05, "lower.mass": 0.3},
        0.01,
        {"lower.mass": 0.5},
    ),
}


def covered(case: Case, seed: int) -> list[bool]:
    """Return which measurements after the intervention are within the intervals."""
    rng = np.random.default_rng(seed)
    true, world = (sw.World(case.xml, control_dt=0.02) for _ in range(2))
    true = true.given(case.truth)
    low, high = np.asarray(true.action_low), np.asarray(true.action_high)
    sent = np.repeat(rng.uniform(low, high, (STEPS // HELD, len(low))), HELD, axis=0)
    episode = true.rollout(sent, seed=0, steps=STEPS)
    other, found = episode.counterfactual(case.do, at=AT), list[bool]()
    columns = [name for name in true.compiled.slices if name.endswith(".position")]
    errors = {name: case.noise * rng.normal(size=STEPS + 1) for name in columns}
    data = {"time": 0.02 * np.arange(STEPS + 1)}
    data |= {name: np.append(sent[:, at], np.nan) for name, at in true.compiled.actions.items()}
    data |= {name: episode[name] + errors[name] for name in columns}
    frame = world.fit(data, [*case.truth]).counterfactual(case.do, at=AT, seed=seed)
    for name in columns:
        rows, measured = frame[frame.column == name], other[name] + errors[name]
        inside = (rows.low <= measured) & (measured <= rows.high)
        found += inside.to_numpy()[AT + np.array(LATER)].tolist()
    return found


def main() -> None:
    """Print a table in Markdown, a row for each model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| model | covered |\n|---|---|")
    for name, case in CASES.items():
        seeds = range(given.first, given.first + given.runs)
        found = [one for seed in seeds for one in covered(case, seed)]
        print(f"| {name} | {np.mean(found):.3f} |", flush=True)


if __name__ == "__main__":
    main()
