"""A causal model without an engine as a task: what acts in it, and what counts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from scm_world._arguments import finite_numbers, typed
from scm_world._patterns import as_names, fitting
from scm_world.backends import EQUATIONS
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import SCM
from scm_world.tasks.base import Conventions, Observation, Observed, Options, Task
from scm_world.tasks.composition import Composition
from scm_world.tasks.model import REWARD, DeclaredTask
from scm_world.tasks.rewards import SUCCESS, TERMINATED, declared
from scm_world.variables import Action, Box, Fixed, Integers, Variable

STEPS = 100
"""Control steps of an episode of a model with lagged edges, where no length is asked for."""


@typed
class EquationTask(DeclaredTask):
    """A causal model without an engine, what acts in it, and what counts in it.

    An action takes the place of the mechanism of its variable, as ``do`` would, at each instant. In
    a model without lagged edges an episode is one control step. In one with lagged edges an action
    acts on what follows one or more control steps later, and within its instant on variables
    without lagged causes and effects, such as a reward.

    After a control step, the action and what follows from it within the instant have the values
    of that control step; all others are those of the instant that it led to. Before the first one
    those are zero, or nearest to it in their bounds.

    Args:
        model: The model. Its ``Action`` variables are actions in any case.
        actions: Names of further variables that are actions, or a dictionary with the space of
            each: a ``Box`` or a pair of ends; ``Integers`` for one of several; None for the bounds
            that it declares.
        reward, success, terminated: What counts; see ``DeclaredTask``. The reward may be the name
            of a variable, too.
        observe: Names or patterns of the observed variables. If None all that an action does not
            decide within its instant, without reward, success and the end; the actions themselves
            if there is no such variable. Leave out the variables that are hidden from an agent.
        goal: See ``DeclaredTask``.
        outcomes: Further variables with a function.
        name: The name of the task.

    Raises:
        UnknownOption: An argument does not exist, or a variable cannot be an action.
        ModelError: Nothing acts in the model, or an action acts within its instant on a
            variable with lagged causes or effects, which begins at its start value and not with
            an action.
    """

    choices = Task.choices | {
        "action_mode": ("values",),
        "preset": ("model",),
        "conventions": {"scm_world": Conventions()},
    }
    kinds = (("outcomes", Variable), ("observe", str))
    backend = EQUATIONS
    generated_graph = False
    time_unit = 1.0
    frame_skip = 1

    model: SCM
    actions: Mapping[str, Any] | Iterable[str] = ()

    def __init__(self, model: SCM, **settings: Any) -> None:
        super().__init__(EquationTask, settings)
        self.name = getattr(self, "name", "equations")
        spaces = self._spaces(model)
        if not (spaces or any(v.role == "action" for v in model.variables)):
            advice = "say which variables are actions, actions={'x': Box(-1.0, 1.0)}, and what "
            advice += "counts, reward='y'"
            raise ModelError([f"nothing acts in the model of {', '.join(model)}: {advice}"])
        counted = {name: getattr(self, name) for name in (REWARD, SUCCESS, TERMINATED)}
        if not model.is_temporal:
            if self.terminated is not None or TERMINATED in model:
                allowed = ("left out: without lagged edges an episode is one control step",)
                raise UnknownOption(TERMINATED, self.terminated, allowed)
            counted[TERMINATED] = Fixed(
                name=TERMINATED, value=1, dtype="integer", doc="An episode is one control step."
            )
        variables = [_action(v, spaces[v.name]) if v.name in spaces else v for v in model.variables]
        variables += self.outcomes
        for name, given in counted.items():
            if isinstance(given, Fixed):
                variables.append(given)
            elif given is not None:
                variables.append(declared(name, given))
        self.model = SCM(variables).given(model.context).do(dict(model.done().values()))
        self.weights = {REWARD: 1.0} if REWARD in self.model else {}
        self.seconds = float(STEPS if self.model.is_temporal else 1)
        self._check()

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """Return the names of the options, without the first argument."""
        return tuple(name for name in super().options() if name != "start")

    def _spaces(self, model: SCM) -> dict[str, Any]:
        """Return the space of each variable that becomes an action."""
        given: Any = () if self.actions is None else self.actions
        if not isinstance(given, Mapping):
            given = {model.declared(name).name: None for name in as_names(given)}
        found: dict[str, Any] = {}
        for name, wanted in given.items():
            variable = model.declared(name)
            if name in model.interventions or variable.parts:
                allowed = ("a variable without an intervention that is no bundle of others",)
                raise UnknownOption("actions", name, allowed)
            ends = finite_numbers(wanted) if isinstance(wanted, list | tuple) else None
            space = (variable.bounds or variable.a) if wanted is None else wanted
            if ends is not None and len(ends) == 2:
                space = Box(ends[0].tolist(), ends[1].tolist())
            if not isinstance(space, Box | Integers):
                known = ("a Box or a pair of ends", "Integers for one of several")
                raise UnknownOption(f"actions[{name!r}]", space, known)
            found[name] = space
        return found

    def _check(self) -> None:
        model = self.model
        actions = [v.name for v in model.variables if v.role == "action"]
        known = [*model]
        if self.observe is not None:
            each = (fitting(one, known, "observe") for one in self.observe)
            self.observe = tuple(dict.fromkeys(name for names in each for name in names))
        lagged = {name for edge in model.edges if edge.lag for name in (edge.cause, edge.effect)}
        decided = {*model.structure.instant_descendants(actions)}.difference(actions)
        inert = sorted(lagged & decided)
        if inert:
            advice = "give the action a lag of 1 there, since episodes begin at start values"
            raise ModelError(
                [f"an action acts within its instant on {', '.join(inert)}, with lags: {advice}"]
            )

    def _observed(self) -> tuple[str, ...]:
        model = self.model
        actions = [v.name for v in model.variables if v.role == "action"]
        late = {*actions, *model.structure.instant_descendants(actions)}
        late |= {REWARD, SUCCESS, TERMINATED}
        return tuple(name for name in model if name not in late) or tuple(actions)

    def __fingerprint__(self) -> dict[str, Any]:
        """Return what decides the task: its class, its arguments and the model."""
        return {**super().__fingerprint__(), **self.model.__fingerprint__()}

    @property
    def observation(self) -> Observation:
        """The variables of ``observe``, or those that an action does not decide."""
        names = self._observed() if self.observe is None else tuple(self.observe)
        return Observation(tuple(Observed(name) for name in names))

    def quantities(self) -> Iterable[Variable]:
        """Declare the variables of the model."""
        return self.model.variables

    def compose(self, options: Options) -> tuple[Composition, list[Variable]]:
        """Refuse to be simulated by an engine.

        Raises:
            ModelError: Equations have no engine.
        """
        raise ModelError(["equations have no engine: make World(task), or an environment of it"])


def _action(variable: Variable, space: Box | Integers) -> Action:
    """Return a variable as an action."""
    kept = {field: getattr(variable, field) for field in ("name", "shape", "unit", "doc")}
    whole = isinstance(space, Integers)
    return Action(**kept, bounds=space, dtype="integer" if whole else "real")
