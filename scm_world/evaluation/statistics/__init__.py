"""The statistics of evaluations: functions of arrays, with intervals."""

from scm_world.evaluation.statistics.causes import Cause, Causes, ColumnEffect, find_causes
from scm_world.evaluation.statistics.intervals import (
    LEVEL,
    METRICS,
    Interval,
    Profile,
    aggregate,
    crossed_interval,
    difference_interval,
    mean_interval,
    performance_profile,
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
    "crossed_interval",
    "difference_interval",
    "find_causes",
    "mean_interval",
    "performance_profile",
    "unpaired_interval",
]
