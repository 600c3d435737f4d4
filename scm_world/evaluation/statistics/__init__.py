"""The statistics of evaluations: functions of arrays, with intervals.

Every draw comes from a seed, so the same numbers give the same intervals.
"""

from scm_world.evaluation.statistics.causes import Cause, Causes, ColumnEffect, find_causes
from scm_world.evaluation.statistics.intervals import (
    LEVEL,
    METRICS,
    Interval,
    Profile,
    aggregate,
    difference_interval,
    is_binary,
    mean_interval,
    performance_profile,
    probability_of_improvement,
    unpaired_interval,
)

__all__ = [
    "LEVEL",
    "METRICS",
    "Cause",
    "Causes",
    "ColumnEffect",
    "Interval",
    "Profile",
    "aggregate",
    "difference_interval",
    "find_causes",
    "is_binary",
    "mean_interval",
    "performance_profile",
    "probability_of_improvement",
    "unpaired_interval",
]
