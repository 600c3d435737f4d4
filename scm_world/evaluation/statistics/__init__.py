"""The statistics of evaluations: functions of arrays, with intervals, and nothing else.

Every draw comes from a seed, so the same numbers give the same intervals.
"""

from scm_world.evaluation.statistics.aggregate import METRICS, aggregate
from scm_world.evaluation.statistics.causes import Cause, Causes, Column, find_causes
from scm_world.evaluation.statistics.improvement import probability_of_improvement
from scm_world.evaluation.statistics.intervals import (
    Interval,
    difference_interval,
    mean_interval,
    pairing_gain,
    unpaired_interval,
)
from scm_world.evaluation.statistics.profiles import Profile, performance_profile

__all__ = [
    "METRICS",
    "Cause",
    "Causes",
    "Column",
    "Interval",
    "Profile",
    "aggregate",
    "difference_interval",
    "find_causes",
    "mean_interval",
    "pairing_gain",
    "performance_profile",
    "probability_of_improvement",
    "unpaired_interval",
]
