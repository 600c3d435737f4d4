"""Finding causal graphs from interventional experiments, and scoring what was found.

What is named below is loaded when it is first used. ``learners`` is the package of learners; its
function ``learners()`` lists them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scm_world.discovery import learners
    from scm_world.discovery.data import Dataset, Design, Levels, collect, sweep
    from scm_world.discovery.exam.study import Study, examine
    from scm_world.discovery.exam.subjects import TaskView, subject
    from scm_world.discovery.learners import Found, Learner, learn, register
    from scm_world.discovery.metrics import evaluate
    from scm_world.discovery.report import DiscoveryReport
    from scm_world.discovery.run import discover
    from scm_world.discovery.scores import Score, score

_HOMES = {
    **dict.fromkeys(("Dataset", "Design", "Levels", "collect", "sweep"), "data"),
    "DiscoveryReport": "report",
    **dict.fromkeys(("Found", "Learner", "learn", "register"), "learners"),
    **dict.fromkeys(("Score", "score"), "scores"),
    **dict.fromkeys(("Study", "examine"), "exam.study"),
    **dict.fromkeys(("TaskView", "subject"), "exam.subjects"),
    "discover": "run",
    "evaluate": "metrics",
}

__all__ = [
    "Dataset",
    "Design",
    "DiscoveryReport",
    "Found",
    "Learner",
    "Levels",
    "Score",
    "Study",
    "TaskView",
    "collect",
    "discover",
    "evaluate",
    "examine",
    "learn",
    "learners",
    "register",
    "score",
    "subject",
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
