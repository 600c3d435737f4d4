"""Hold local causal graphs, as contacts predict them, against paired experiments.

``python benchmarks/local_graph.py`` plays every scene of every task on every engine, prints one
table and the errors, and with ``--out DIR`` keeps every report as JSON. It takes a few minutes.

``python benchmarks/local_graph.py --seeds 3``, MuJoCo 4.0.0, pybullet 3.2.7, all tasks and scenes:

======  =====  =====  =====  =========  ===========  ==========  ===========  ===============
engine  steps  edges  floor  listed F1  pressing P   pressing R  pressing F1  own pressing F1
======  =====  =====  =====  =========  ===========  ==========  ===========  ===============
mujoco  2250   14061  0.0    0.9826     1.0000       0.9937      0.9968       0.9968
bullet  2250   16048  0.0    0.9688     1.0000       0.9874      0.9937       0.9913
======  =====  =====  =====  =========  ===========  ==========  ===========  ===============

``own`` takes the contacts of the world itself, not of the scene built anew; see
``docs/local_graphs.md``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scm_world import World, make_task
from scm_world.queries.local import RULES, LocalReport, RuleScore, local_report
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.kinematics import inverse

TASKS: Mapping[str, dict[str, Any]] = {
    "pushing": {},
    "picking": {},
    "stacking2": {},
    "towers": {"number_of_blocks_in_tower": (1, 1, 3)},
    "general": {"nums_objects": 3},
}
TIP = hardware.COLLISION["tip"].radius  # [m]
ANGLES = np.array([0.5, -1.6, 2.6])  # [rad] where the fingers stand around a block

Policy = Callable[[World], Any]


def _ring(center: Any, radius: float, height: float, turn: float = 0.0) -> Any:
    """Give fingertip positions around a place, shape (9,) [m]."""
    x, y = np.cos(ANGLES + turn), np.sin(ANGLES + turn)
    points = np.stack([center[0] + radius * x, center[1] + radius * y, np.full(3, height)], axis=-1)
    return points.ravel()


def _joints(world: World, tips: Any) -> Any:
    return inverse(tips, float(world["robot_height"]), np.array(hardware.REST)).joint_positions


def _stack(world: World, dice: np.random.Generator, slide: float = 0.0) -> dict[str, Any]:
    """Stand the blocks on one another in the middle."""
    states: dict[str, Any] = {}
    bottom = 0.0
    velocity = slide * dice.uniform(-1.0, 1.0, 3) * [1.0, 1.0, 0.0]
    for name in world.composition.blocks:
        height = float(world[f"{name}.size"][2])
        place = dice.uniform(-0.002, 0.002, 2)
        states[f"{name}.cartesian_position"] = np.array([*place, bottom + height / 2])
        states[f"{name}.linear_velocity"] = velocity
        bottom += height
    return states


def _squeezing(world: World, dice: np.random.Generator) -> Policy:
    """Let three fingers close on a block, drag it about and let go of it again."""
    block = world.composition.blocks[0]
    phase = dice.uniform(0.0, 6.0)

    def policy(world: World) -> Any:
        t = world.index
        center = np.array(world[f"{block}.cartesian_position"])
        drag = 0.03 * np.array([np.cos(t / 9 + phase), np.sin(t / 9 + phase), 0.0])
        closed = 0.02 if t % 30 < 22 else 0.08
        return _ring(center + drag, closed, float(center[2]), 0.1 * np.sin(t / 5))

    return policy


def wandering(world: World, dice: np.random.Generator) -> Policy:
    """Move the fingertips at random over the table."""
    goal = np.zeros(9)

    def policy(world: World) -> Any:
        if world.index % 8 == 0:
            low, high = [-0.12, -0.12, 0.01], [0.12, 0.12, 0.12]
            goal[:] = np.concatenate([dice.uniform(low, high) for _ in range(3)])
        return goal

    return policy


def squeezed(world: World, dice: np.random.Generator) -> Policy:
    """Squeeze the first block, in the midst of the fingers; the others stand on it."""
    states = _stack(world, dice)
    size = world[f"{world.composition.blocks[0]}.size"]
    radius = float(np.hypot(*size[:2])) / 2 + TIP + 2e-3
    states["joint_positions"] = _joints(world, _ring(np.zeros(3), radius, 0.6 * float(size[2])))
    world.do(states)
    return _squeezing(world, dice)


def stacked(world: World, dice: np.random.Generator) -> Policy:
    """Let a stack slide over the floor and topple, while fingers come and go."""
    world.do(_stack(world, dice, slide=0.4))
    return wandering(world, dice)


def herded(world: World, dice: np.random.Generator) -> Policy:
    """Stand the blocks in a row, moving towards one another, and sweep them together."""
    states: dict[str, Any] = {}
    blocks = world.composition.blocks
    for i, name in enumerate(blocks):
        size = world[f"{name}.size"]
        place = (i - (len(blocks) - 1) / 2) * (float(size[0]) + 0.002)
        states[f"{name}.cartesian_position"] = np.array([place, 0.0, float(size[2]) / 2])
        speed = -np.sign(place) * dice.uniform(0.05, 0.4)
        states[f"{name}.linear_velocity"] = np.array([speed, dice.uniform(-0.1, 0.1), 0.0])
    world.do(states)
    height = float(world[f"{blocks[0]}.size"][2]) / 2

    def policy(world: World) -> Any:
        radius = 0.13 - 0.11 * (world.index % 25) / 25
        return _ring(np.zeros(3), radius, height, 0.3 * np.sin(world.index / 7))

    return policy


def dropped(world: World, dice: np.random.Generator) -> Policy:
    """Let tumbling blocks fall on one another."""
    states: dict[str, Any] = {}
    for i, name in enumerate(world.composition.blocks):
        place = [*dice.uniform(-0.02, 0.02, 2), 0.06 + 0.085 * i]
        states[f"{name}.cartesian_position"] = np.array(place)
        states[f"{name}.angular_velocity"] = dice.uniform(-8.0, 8.0, 3)
    world.do(states)
    return _squeezing(world, dice)


SCENES = (wandering, squeezed, stacked, herded, dropped)


def run(task: str, engine: str, scene: Any, seed: int, steps: int, every: int) -> LocalReport:
    """Play one scene, and compare."""
    made = make_task(task, **TASKS[task])
    world = World(made, backend=engine, action_mode="end_effector_positions")
    world.reset(seed=seed)
    policy = scene(world, np.random.default_rng([seed, list(TASKS).index(task)]))
    report = local_report(world, policy, steps, every=every)
    world.close()
    return report


def _row(name: str, report: LocalReport) -> str:
    true = report.scores["pressing"].right + report.scores["pressing"].missed
    cells = [name, str(report.steps), str(true), f"{report.floor:g}"]
    for rule in ("listed", "pressing"):
        score = report.scores[rule]
        cells += [f"{score.precision:.4f}", f"{score.recall:.4f}", f"{score.f1:.4f}"]
    cells += [f"{report.scores[rule].f1:.3f}" for rule in list(RULES)[2:]]
    cells += [f"{report.own_scores[rule].f1:.4f}" for rule in ("listed", "pressing")]
    return "| " + " | ".join([*cells, f"{report.seconds:.0f}"]) + " |"


def _sum(reports: list[LocalReport]) -> LocalReport:
    first = reports[0]
    total = {rule: sum((r.scores[rule] for r in reports), RuleScore()) for rule in RULES}
    own = {rule: sum((r.own_scores[rule] for r in reports), RuleScore()) for rule in RULES}
    return replace(
        first,
        scores=total,
        own_scores=own,
        steps=sum(r.steps for r in reports),
        floor=max(r.floor for r in reports),
        seconds=sum(r.seconds for r in reports),
        errors=tuple(error for r in reports for error in r.errors),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--engines", nargs="+", default=["mujoco", "bullet"])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--errors", type=int, default=0, help="how many errors to print")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    if asked.out:
        asked.out.mkdir(parents=True, exist_ok=True)
    names = ["scene", "steps", "edges", "floor"]
    names += [f"{rule} {rate}" for rule in ("listed", "pressing") for rate in ("P", "R", "F1")]
    names += [f"{rule} F1" for rule in list(RULES)[2:]]
    names += ["own listed F1", "own pressing F1", "s"]
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    for engine in asked.engines:
        everything = []
        for task in asked.tasks:
            for scene in SCENES:
                reports = []
                for seed in range(asked.seeds):
                    reports.append(run(task, engine, scene, seed, asked.steps, asked.every))
                    if asked.out:
                        name = f"{task}-{engine}-{scene.__name__}-{seed}.json"
                        reports[-1].save(asked.out / name)
                print(_row(f"{engine} {task} {scene.__name__}", _sum(reports)), flush=True)
                everything += reports
        total = _sum(everything)
        print(_row(f"**{engine}, all**", total), flush=True)
        kinds = Counter((e[0], "extra" if e[4] <= 1e-10 else "missed") for e in total.errors)
        print(f"\nerrors on {engine}: {dict(kinds)}")
        for error in total.errors[: asked.errors]:
            print("  ", *error)
        print()


if __name__ == "__main__":
    main()
