"""Evaluations that nobody played, for pictures and pages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas

from scm_world.evaluation.episodes import METRICS
from scm_world.evaluation.protocols import protocols_of
from scm_world.evaluation.results import Evaluation

NAMES = ("ppo", "sac", "td3", "random", "sweep", "still", "bc", "cql", "iql")
LONG = "an agent whose name $somebody$ has thought about for a very long time, number {}"


def made(
    agents: int | Sequence[str] = 1,
    protocols: int = 12,
    *,
    engines: Sequence[str] = ("mujoco",),
    runs: int = 1,
    n: int = 12,
    score: float | None = None,
    kept: Callable[[dict[str, Any]], bool] = lambda row: True,
) -> Evaluation:
    """Make an evaluation in which heavy blocks are pushed badly from P7 on.

    After the twelve protocols come those that do the same within the episodes. Agents get worse by
    0.05 one after another, and all are better by 0.1 on the second engine.
    """
    rng = np.random.default_rng(0)
    names = NAMES[:agents] if isinstance(agents, int) else agents
    every = protocols_of("pushing")
    within = [protocol.at(step) for step in (100, 200) for protocol in every]
    known = [*every, *within][:protocols]
    masses = rng.random((len(known), n))
    rows = []
    for p, protocol in enumerate(known):
        for a, agent in enumerate(names):
            for e, engine in enumerate(engines):
                for run in range(runs):
                    for i in range(n):
                        mass, noise = masses[p, i], 0.03 * rng.standard_normal()
                        found = 0.9 - 0.05 * a + 0.1 * e - 0.6 * mass * (p > 6) + noise
                        value = float(np.clip(found, 0.0, 1.0)) if score is None else score
                        row = {"agent": agent, "run": run, "engine": engine}
                        row |= {"protocol": protocol.name, "seed": 0, "episode": i, "steps": 10}
                        row |= dict.fromkeys(METRICS[:4], value) | {"return": 40 * value - 100}
                        row["hash"] = f"{agent} {engine} {run} {protocol.name} {i}"
                        drawn = {"tool_block.mass": mass, "floor_friction": float(rng.random())}
                        row |= {f"drawn {name}": v for name, v in drawn.items() if p}
                        rows.append(row)
    about = {
        "task": "pushing",
        "env": {"max_episode_length": 10},
        "agents": [
            {"agent": name, "run": run, "policy": {"kind": "onnx", "sha256": f"5ha256 of {name}"}}
            for name in names
            for run in range(runs)
        ],
        "protocols": [protocol.as_dict() for protocol in known],
        "engines": list(engines),
        "seeds": [0],
        "n": n,
        "versions": {engine: {"scm-world": "0.1.0"} for engine in engines},
    }
    return Evaluation(about, pandas.DataFrame([row for row in rows if kept(row)]))
