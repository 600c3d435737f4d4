"""Finding causal graphs from interventional experiments, and scoring the graphs.

``learners`` is the package of learners; its function ``learners()`` lists them.
"""

from scm_world.discovery import learners
from scm_world.discovery.benchmarks import BenchmarkResult, benchmark
from scm_world.discovery.data import Dataset, Design, Levels, collect, sweep
from scm_world.discovery.learners import EstimatedGraph, Learner, learn, register
from scm_world.discovery.metrics import Scores, evaluate
from scm_world.discovery.problems import TaskView, problem
from scm_world.discovery.run import DiscoveryReport, discover

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
