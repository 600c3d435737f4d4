"""Finding causal graphs from interventional experiments, and scoring the graphs.

The names below are loaded when they are first used. ``learners`` is the package of learners; its
function ``learners()`` lists them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scm_world.discovery import learners
    from scm_world.discovery.benchmarks import BenchmarkResult, benchmark
    from scm_world.discovery.data import Dataset, Design, Levels, collect, sweep
    from scm_world.discovery.learners import EstimatedGraph, Learner, learn, register
    from scm_world.discovery.metrics import Scores, evaluate
    from scm_world.discovery.problems import TaskView, problem
    from scm_world.discovery.run import DiscoveryReport, discover

_HOMES = {
    **dict.fromkeys(("Dataset", "Design", "Levels", "collect", "sweep"), "data"),
    **dict.fromkeys(("EstimatedGraph", "Learner", "learn", "register"), "learners"),
    **dict.fromkeys(("Scores", "evaluate"), "metrics"),
    **dict.fromkeys(("BenchmarkResult", "benchmark"), "benchmarks"),
    **dict.fromkeys(("TaskView", "problem"), "problems"),
    **dict.fromkeys(("DiscoveryReport", "discover"), "run"),
}

__all__ = [
    "BenchmarkResult",
    "Dataset",
    "Design",
    "DiscoveryReport",
    "EstimatedGraph",
    "Learner",
    "Levels",
    "Scores",
    "TaskView",
    "benchmark",
    "collect",
    "discover",
    "evaluate",
    "learn",
    "learners",
    "problem",
    "register",
    "sweep",
]


def __getattr__(name: str) -> Any:
    if name == "learners":
        return importlib.import_module(f"{__name__}.learners")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
