"""Learners on interventional data, scored against the true graph: a model, then physics.

Run it with ``python examples/learners.py [mujoco|bullet|fake [EPISODES]]``.
"""

from __future__ import annotations

import sys

from scm_world.discovery import Design, EstimatedGraph, TaskView, collect, evaluate, learn, problem
from scm_world.discovery.problems import Problem
from scm_world.tasks.families import random_model
from scm_world.variables import Normal

CAUSES = ("block.size", "gravity", "*friction", "tool_block.mass", "tool_block.color")


def shown(title: str, found: EstimatedGraph, given: Problem) -> None:
    """Print how near a graph comes to the true one."""
    truth = given.truth
    scores = evaluate(found, truth.edges, names=truth.names, pairs=truth.pairs)
    print(f"  {title:<34} SHD {scores.shd:>3}  precision {scores.precision:.2f}", end="  ")
    print(f"recall {scores.recall:.2f}  {found.experiments} experiments, {found.seconds:.2f} s")


def on_a_model(name: str = "er2:20", rows: int = 2000) -> None:
    """Learn a random linear model from rows with known targets, then by paired experiments."""
    scm, given = random_model(name, seed=0), problem(name, seed=0)
    print(f"{name}: {len(scm.edges)} edges")
    design = Design(
        "single", tuple(scm), values=Normal(mean=2.0, std=1.0), observational_fraction=0.1
    )
    table = collect(scm, design, rows, seed=0)
    shown("do_order", learn("do_order", table), given)
    shown("do_order, a tenth of the rows", learn("do_order", table.first(rows // 10)), given)
    shown("paired", learn("paired", given.simulator(0), budget=200), given)


def on_a_task(backend: str, episodes: int) -> None:
    """Learn what episodes of pushing end with from episodes, then by paired experiments."""
    view = TaskView(causes=CAUSES, options={"backend": backend})
    given = problem("pushing", view=view)
    print(f"pushing on {backend}: {len(given.truth.edges)} edges")
    shown("do_order", learn("do_order", given.data("interventional", episodes, seed=0)), given)
    shown("paired", learn("paired", given.simulator(0), budget=episodes), given)
    given.close()


def main(backend: str = "mujoco", episodes: str = "400") -> None:
    """Compare learners with and without pairing."""
    on_a_model()
    on_a_task(backend, int(episodes))


if __name__ == "__main__":
    main(*sys.argv[1:])
