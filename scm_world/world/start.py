"""How an episode begins, and the options that a world accepts."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._types import Value, Values
from scm_world.backends import Backend, backends, make_backend
from scm_world.errors import InterventionError, ModelError, UnknownOption
from scm_world.graph import Moment
from scm_world.models import Model, State
from scm_world.models.scene import TOLERANCE
from scm_world.tasks import ModelTask, Task, make_task, tasks
from scm_world.variables import Measured, Subset
from scm_world.variables.checks import check_bounds, check_subset, coerce
from scm_world.variables.subsets import AnyRegion
from scm_world.world.mechanisms import wrong_value

if TYPE_CHECKING:
    from scm_world.world.declaration import Declaration
    from scm_world.world.family import Family


def beginning(declaration: Declaration, moment: Moment | None) -> tuple[dict[str, Value], State]:
    """Compute where an episode begins when nobody intervenes.

    Args:
        declaration: Of the world.
        moment: Where to draw what is random by declaration; its default if None.

    Returns:
        The values of everything that physics does not move, and the state of the rest.
    """
    static = declaration.model.solve(only=declaration.static_names, moment=moment)
    state = declaration.empty_state()
    for variable in declaration.model.variables:
        where = declaration.slices.get(variable.name)
        if where is not None and isinstance(variable, Measured) and not variable.parts:
            state.vector[where] = np.ravel(_first(declaration, variable, static))
    return static, state


def _first(declaration: Declaration, variable: Measured, static: Values) -> Value:
    if variable.start is None:
        return variable.array(variable.default)
    known = {**static}
    for name in variable.set_parents():
        parent = declaration.model.declared(name)
        if isinstance(parent, Measured):
            known[name] = parent.array(parent.default)
    parents = [known[name] for name in variable.set_parents()]
    return np.asarray(variable.start.bind()(*parents))


def refuse_impossible(declaration: Declaration) -> None:
    """Refuse a world that cannot begin.

    Raises:
        ModelError: A default is out of bounds, or two bodies are in one place.
    """
    static, state = beginning(declaration, None)
    values = {**static, **declaration.states(state)}
    problems = []
    for variable in declaration.model.variables:
        if variable.name in values:
            try:
                coerce(variable, values[variable.name])
                check_bounds(variable, values[variable.name], values)
            except InterventionError as problem:
                problems.append(str(problem).replace(f"do({variable.name}):", variable.name + " ="))
    found = declaration.composition.overlaps(declaration.describe(static, state), TOLERANCE)
    problems += map(str, found)
    if problems:
        advice = f"choose other arguments of the task {declaration.task.name!r}"
        raise ModelError([f"it cannot begin: {problem}; {advice}" for problem in problems])


def the_task(task: Any) -> Task:
    """Take a task, or make the one of a name.

    Raises:
        UnknownOption: There is none of this name, or it is neither.
    """
    if isinstance(task, Task):
        return task
    if isinstance(task, str):
        return make_task(task)
    if isinstance(task, Model | PathLike) or type(task).__name__ in ("MjSpec", "MjModel"):
        return ModelTask(task)
    made = f"{task.__name__}()" if isinstance(task, type) else "Pushing()"
    raise UnknownOption("task", task, (*tasks(), f"a task that is made, such as {made}"))


def the_backend(backend: Any, usual: str) -> Backend:
    """Take a backend, or make the one of a name; that of the task if None.

    Raises:
        UnknownOption: There is none of this name, or it is neither.
    """
    if isinstance(backend, Backend):
        return backend
    if backend is None or isinstance(backend, str):
        return make_backend(usual if backend is None else backend)
    raise UnknownOption("backend", backend, (*backends(), "a backend that is made"))


def check_held(region: AnyRegion | None, family: Family) -> None:
    """Refuse what no intervention can be held against: names and regions that do not exist.

    Where variables decide which bodies there are, a pattern may name some that are not there.

    Raises:
        InterventionError: With the name.
    """
    if isinstance(region, Subset):
        variables = family.natural(None).model.variables
        check_subset(region, variables, may_come=len(family.head) > 0)


def whole_number(option: str, value: Any, *, least: int) -> int:
    """Check an option that is a whole number.

    Raises:
        UnknownOption: It is none, or too small.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise UnknownOption(option, value, (f"any whole number from {least} on",))
    return int(value)


def check_functions(declaration: Declaration, values: Values) -> None:
    """Check what the functions of readouts give at the beginning.

    Raises:
        ModelError: One gives no finite numbers of the declared shape, or is out of bounds.
    """
    problems = []
    for variable in declaration.model.variables:
        given = isinstance(variable, Measured) and variable.mechanism is not None
        if not given or variable.name in declaration.bundles:
            continue
        value = values[variable.name]
        problem = wrong_value(variable, value)
        if problem:
            problems.append(f"the function of {variable.name!r} {problem}")
        elif variable.bounds is not None and not variable.bounds.contains(value, values):
            allowed = variable.bounds.describe(variable.shape, values)
            problems.append(f"the function of {variable.name!r} gives {value!r}, not in {allowed}")
    if problems:
        raise ModelError(problems)
