"""What can go wrong, and what to do about it.

Every error of the package carries its data as attributes and says what was given, what is
allowed and what to do::

    ScmWorldError
    ├── ModelError               a causal model that cannot be built (all its problems at once)
    ├── InterventionError        a do() that was refused; the world is as it was
    │   ├── UnknownVariable      no such name; the nearest one is suggested
    │   ├── NotIntervenable      the variable is measured, not set
    │   ├── WrongType            not a number, or not of the declared dtype
    │   ├── WrongShape
    │   ├── NotFinite            NaN or infinity
    │   ├── OutOfBounds          physically impossible
    │   ├── OutOfSpace           possible, but outside the space that was asked for
    │   ├── ConflictingTargets   two names of one quantity in the same do()
    │   ├── ClosesCycle          a mechanism that makes variables cause one another at once
    │   ├── Infeasible           two bodies in one place, or a body outside the arena
    │   └── SeveralProblems      more than one of the above
    ├── CyclicModel              a causal model with contemporaneous cycles (a ModelError)
    ├── ActionError              an action the robot cannot take
    ├── NotReset                 a world that was never reset
    ├── UnknownOption            a task, backend, preset or mode that does not exist
    ├── EngineError              the physics engine
    │   ├── MissingEngine        it is not installed
    │   ├── MixedInstallation    two versions of it in one folder
    │   └── EngineFailure        it produced a state that is not finite
    ├── SnapshotMismatch         a snapshot of another scene
    ├── UnreadableFile           a file that is not what it should be
    ├── UnwritableFolder         a folder without room or permission
    ├── Forbidden                a question that a laboratory does not allow
    ├── BudgetExhausted          an experiment that costs more than is left
    ├── EvaluationError          an episode that could not be played, with its place
    ├── Diverged                 a training whose weights are no finite numbers any more
    └── MissingExtra             an optional package that is not installed
"""

from scm_world.errors.base import ScmWorldError, in_one_line, nearest
from scm_world.errors.engines import (
    EngineError,
    EngineFailure,
    MissingEngine,
    MixedInstallation,
    SnapshotMismatch,
)
from scm_world.errors.interventions import (
    ClosesCycle,
    ConflictingTargets,
    CyclicModel,
    Infeasible,
    InterventionError,
    ModelError,
    NotFinite,
    NotIntervenable,
    OutOfBounds,
    OutOfSpace,
    SeveralProblems,
    UnknownVariable,
    WrongShape,
    WrongType,
    raise_all,
)
from scm_world.errors.usage import DAMAGED as DAMAGED  # no error, but a tuple of some
from scm_world.errors.usage import (
    ActionError,
    BudgetExhausted,
    Diverged,
    EvaluationError,
    Forbidden,
    MissingExtra,
    NotReset,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)

__all__ = [
    "ActionError",
    "BudgetExhausted",
    "ClosesCycle",
    "ConflictingTargets",
    "CyclicModel",
    "Diverged",
    "EngineError",
    "EngineFailure",
    "EvaluationError",
    "Forbidden",
    "Infeasible",
    "InterventionError",
    "MissingEngine",
    "MissingExtra",
    "MixedInstallation",
    "ModelError",
    "NotFinite",
    "NotIntervenable",
    "NotReset",
    "OutOfBounds",
    "OutOfSpace",
    "ScmWorldError",
    "SeveralProblems",
    "SnapshotMismatch",
    "UnknownOption",
    "UnknownVariable",
    "UnreadableFile",
    "UnwritableFolder",
    "WrongShape",
    "WrongType",
    "in_one_line",
    "nearest",
    "raise_all",
]

for _name in __all__:  # tracebacks and pickles name them as one imports them
    globals()[_name].__module__ = __name__
del _name
