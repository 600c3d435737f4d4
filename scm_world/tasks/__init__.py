"""Tasks: goal families of the robot, models from files, and step functions."""

from __future__ import annotations

from scm_world.tasks.base import TIME, Conventions, Goal, Observation, Observed, Options, Task
from scm_world.tasks.equations import EquationTask
from scm_world.tasks.model import ModelTask
from scm_world.tasks.rewards import Common, term
from scm_world.tasks.sources import (
    TASKS,
    AnySource,
    WorldSource,
    make_task,
    models,
    read_source,
    register,
    tasks,
)
from scm_world.tasks.step import StepTask
from scm_world.tasks.trifinger.base import HEAD, TriFingerTask
from scm_world.tasks.trifinger.building import Building, Towers
from scm_world.tasks.trifinger.conventions import CONVENTIONS
from scm_world.tasks.trifinger.general import General
from scm_world.tasks.trifinger.reaching import Reaching
from scm_world.tasks.trifinger.single import PickAndPlace, Picking, Pushing
from scm_world.tasks.trifinger.stacking2 import Stacking2
from scm_world.tasks.trifinger.walls import CreativeStackedBlocks, StackedBlocks

__all__ = [
    "CONVENTIONS",
    "HEAD",
    "TASKS",
    "TIME",
    "AnySource",
    "Building",
    "Common",
    "Conventions",
    "CreativeStackedBlocks",
    "EquationTask",
    "General",
    "Goal",
    "ModelTask",
    "Observation",
    "Observed",
    "Options",
    "PickAndPlace",
    "Picking",
    "Pushing",
    "Reaching",
    "StackedBlocks",
    "Stacking2",
    "StepTask",
    "Task",
    "Towers",
    "TriFingerTask",
    "WorldSource",
    "make_task",
    "models",
    "read_source",
    "register",
    "tasks",
    "term",
]
