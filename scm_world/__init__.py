"""Structural causal models of physical systems: any MJCF, URDF or step function.

Importing this registers the environments with Gymnasium; a name is loaded when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from scm_world import lab as lab
    from scm_world.discovery import discover as discover
    from scm_world.env import ScmWorldEnv as ScmWorldEnv
    from scm_world.env import check as check
    from scm_world.errors import ScmWorldError as ScmWorldError
    from scm_world.fit import Deviation as Deviation
    from scm_world.fit import Diagnosis as Diagnosis
    from scm_world.fit import Fit as Fit
    from scm_world.geometry.hulls import load_hull as load_hull
    from scm_world.queries import SCM as SCM
    from scm_world.queries import Laboratory as Laboratory
    from scm_world.queries import Outcome as Outcome
    from scm_world.queries import Plan as Plan
    from scm_world.queries import World as World
    from scm_world.queries import do as do
    from scm_world.queries import verify as verify
    from scm_world.tasks import ModelTask as ModelTask
    from scm_world.tasks import StepTask as StepTask
    from scm_world.tasks import Task as Task
    from scm_world.tasks import TriFingerTask as TriFingerTask
    from scm_world.tasks import make_task as make_task
    from scm_world.variables import Action as Action
    from scm_world.variables import Box as Box
    from scm_world.variables import Contact as Contact
    from scm_world.variables import Derived as Derived
    from scm_world.variables import Draw as Draw
    from scm_world.variables import Exogenous as Exogenous
    from scm_world.variables import Fixed as Fixed
    from scm_world.variables import Hard as Hard
    from scm_world.variables import Linear as Linear
    from scm_world.variables import Measured as Measured
    from scm_world.variables import Mechanism as Mechanism
    from scm_world.variables import Natural as Natural
    from scm_world.variables import Null as Null
    from scm_world.variables import Parent as Parent
    from scm_world.variables import Reaches as Reaches
    from scm_world.variables import Scale as Scale
    from scm_world.variables import Shift as Shift

__version__ = "0.3.0"

_NAMES = {
    "discovery": "discover",
    "env": "ScmWorldEnv check",
    "errors": "ScmWorldError",
    "fit": "Deviation Diagnosis Fit",
    "geometry.hulls": "load_hull",
    "queries": "SCM Laboratory Outcome Plan World do verify",
    "tasks": "ModelTask StepTask Task TriFingerTask make_task",
    "variables": "Action Box Contact Derived Draw Exogenous Fixed Hard Linear Measured Mechanism "
    "Natural Null Parent Reaches Scale Shift",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}
_HOMES["lab"] = "lab"  # the module itself

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'scm_world' has no attribute {name!r}")
    home = importlib.import_module(f"scm_world.{_HOMES[name]}")
    return home if name == _HOMES[name] else getattr(home, name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])


_BLOCKS = "pushing picking pick_and_place stacking2 towers stacked_blocks creative_stacked_blocks"
for _task in ("reaching", *_BLOCKS.split(), "general", "model"):  # the last one is any file
    _id = f"scm_world/{_task.title().replace('_', '')}-v0"
    if _id not in gymnasium.registry:
        _model = _task == "model"
        gymnasium.register(
            id=_id,
            entry_point=f"scm_world.env:{'make_env' if _model else 'ScmWorldEnv'}",
            vector_entry_point="scm_world.env:vector_env",
            kwargs={"task": None if _model else _task},  # a model takes its place
            order_enforce=False,  # it refuses steps before a reset itself
            disable_env_checker=True,  # tests check it; wrappers would hide compute_reward
        )
if "scm_world/Lab-v0" not in gymnasium.registry:
    gymnasium.register("scm_world/Lab-v0", "scm_world.lab.environment:LabEnv", order_enforce=False)
