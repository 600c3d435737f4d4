"""Any function as a task: ``step(parameters, state, action, noise)`` is the physics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, Self, final

import numpy as np

from scm_world._arguments import real_number
from scm_world._types import Floats, Values
from scm_world.backends import Backend
from scm_world.backends.step import Quantity, StepModel
from scm_world.errors import ModelError, UnknownOption
from scm_world.graph import NoiseKey
from scm_world.tasks.base import Options
from scm_world.tasks.composition import Commands, Composition
from scm_world.tasks.model import DeclaredTask, ModelTask, _numbers, beginning
from scm_world.variables import (
    Action,
    Derived,
    Distribution,
    Exogenous,
    Fixed,
    Measured,
    Parent,
    Variable,
)


@final
class ProcessNoise(Commands):
    """Draws the noise of each control step, which the step function is given.

    A draw depends on seed, episode, control step and name only: interventions on other
    variables do not change it.
    """

    def __init__(
        self,
        sources: Mapping[str, Distribution],
        shapes: Mapping[str, tuple[int, ...]],
        n_actions: int,
    ) -> None:
        self._drawn = [(name, source, shapes[name]) for name, source in sources.items()]
        ends = [n_actions, *(int(np.prod(shapes[name])) for name in sources)]
        places = pairwise(np.cumsum(ends).tolist())
        self.noisy = {name: slice(*ends) for name, ends in zip(sources, places, strict=True)}

    def command(
        self, action: Floats, values: Values, vector: Floats, key: NoiseKey, substeps: int
    ) -> Floats:
        """Return the action and the noise of a control step, shape (n_commands,)."""
        drawn = [
            np.ravel(key.draw(source, name, shape, values, "process noise"))
            for name, source, shape in self._drawn
        ]
        return np.concatenate([action, *drawn])


class StepTask(DeclaredTask):
    """A system that a function moves, and what counts in it.

    Every argument can also be an attribute of a class of your own::

        class Growth(StepTask):
            parameters = (Exogenous(name="rate", default=0.1, bounds=Box(0.0, 1.0)),)
            states = (Measured(name="size", default=1.0, parents=("rate", "size")),)
            control_dt = 0.1

            @staticmethod
            def step(parameters, state, action, noise):
                return {"size": state["size"] * (1.0 + 0.1 * parameters["rate"])}

    The causes of a state are the parents that it declares, all of them one control step before;
    of one that declares none, every parameter, state and action is a cause. ``discover`` and
    ``verify`` hold the function against that.

    Args:
        step: The function; see ``StepModel`` for its arguments and results.
        name: The name of the task; that of the function if None.
        parameters: ``Exogenous`` variables, or ``Derived`` and ``Fixed`` ones.
        states: ``Measured`` variables without a mechanism. ``do`` may set each of them.
        actions: ``Action`` variables. The command is one after another.
        control_dt: What one call of the function advances [s]: a control step.
        noise: Distributions of the noise that the function gets in every step, by name. Noise
            named like a state has its shape; else it is a number, or has the shape of the ends
            of its box.
        outcomes: ``Measured`` or ``Derived`` variables that are computed from others.
        reward, success, terminated, start, observe, goal: What counts, and where episodes begin;
            see ``DeclaredTask``.
        seconds: Length of an episode [s]; 100 control steps if None.
        vectorized: Whether the function takes many systems together, with a leading axis.
        signature: ``"dicts"``, or ``"arrays"`` for flat arrays in the order of declaration.

    Raises:
        ModelError: With everything that is wrong with the declaration.
        UnknownOption: An argument does not exist.
    """

    choices = DeclaredTask.choices | {"action_mode": ("actions",), "preset": ("default",)}
    kinds = (
        ("outcomes", Variable),
        ("observe", str),
        ("parameters", Exogenous, Derived, Fixed),
        ("states", Measured),
        ("actions", Action),
    )
    backend = "step"
    if TYPE_CHECKING:
        system: StepModel
    frame_skip = 1

    step: Callable[..., Any] | None = None
    parameters: Iterable[Variable] = ()
    states: Iterable[Measured] = ()
    actions: Iterable[Action] = ()
    control_dt: float = 0.1
    noise: Mapping[str, Distribution] = {}  # a constant
    seconds: float = None  # type: ignore[assignment] # a property of the base; filled in below
    vectorized: bool = False
    signature: Literal["dicts", "arrays"] = "dicts"

    def __init__(self, step: Callable[..., Any] | None = None, **settings: object) -> None:
        super().__init__(StepTask, settings)
        allowed, own = StepTask.options(), type(self)
        for option in {*ModelTask.options()}.difference(allowed):
            if getattr(own, option, None) is not getattr(StepTask, option, None):
                raise UnknownOption(f"option of {own.__name__}", option, allowed)
        function = type(self).step if step is None else step
        problems = [*self._of_another_kind(function)] or [*self._not_fitting()]
        if problems:
            raise ModelError(problems)
        named = "step" if type(self) is StepTask else type(self).__name__
        self.name = getattr(self, "name", getattr(step, "__name__", named))
        self.time_unit = float(self.control_dt)
        if self.seconds is None:
            self.seconds = 100 * self.time_unit
        shapes = {n: np.shape(getattr(given, "low", 0.0)) for n, given in self.noise.items()}
        shapes |= {state.name: state.shape for state in self.states if state.name in shapes}
        n_actions = sum(int(np.prod(action.shape)) for action in self.actions)
        self.commands = ProcessNoise(self.noise, shapes, n_actions) if self.noise else None
        self.generated_graph = any(not _lagged(state) for state in self.states)
        self.system = StepModel(
            self.name,
            function,  # type: ignore[arg-type] # it is callable, see above
            self.time_unit,
            tuple(map(_quantity, self.parameters)),
            tuple(map(_quantity, self.states)),
            tuple(map(_quantity, self.actions)),
            tuple(
                Quantity(name, shapes[name], integer=given.kind in ("integers", "categories"))
                for name, given in self.noise.items()
            ),
            self.vectorized,
            self.signature,
        )

    def _of_another_kind(self, function: object) -> Iterable[str]:
        """List arguments of which the type or the number is wrong."""
        if not callable(function):
            yield f"step={function!r} is not a function"
        elif hasattr(function, "py_func") and self.signature == "dicts":
            yield 'a compiled function takes no dicts: set signature="arrays"'
        if str(self.signature) not in ("dicts", "arrays"):
            yield f'signature={self.signature!r} must be "dicts" or "arrays"'
        if real_number("control_dt", self.control_dt) <= 0.0:
            yield f"control_dt={self.control_dt!r} must be a positive number [s]"
        if not isinstance(self.noise, Mapping):
            yield f"noise={self.noise!r} is not a dict of distributions by name"
        if not self.states:
            yield "a state is missing: give states=[sw.Measured(name=…, parents=…)]"

    def _not_fitting(self) -> Iterable[str]:
        """List states, actions and distributions that do not fit to the step function."""
        given = {variable.name for variable in (*self.parameters, *self.states, *self.actions)}
        for state in self.states:
            if state.mechanism is not None:
                yield (
                    f"{state.name!r} has a mechanism, but the step function moves it; "
                    "variables computed from states belong into outcomes="
                )
            for parent in state.parents:
                if parent.name not in given and parent.when != "set":
                    yield (
                        f"{parent.name!r}, a parent of {state.name!r}, is not a parameter, state "
                        "or action: the step function is not given it"
                    )
        for action in self.actions:
            if action.dtype != "real":
                yield f"{action.name!r}: actions are real numbers; round it in the step function"
        for name, source in self.noise.items():
            if not hasattr(source, "n_uniforms"):
                yield f"noise: {name!r} is not a distribution: {source!r}"
            elif source.parents():
                yield f"noise: {name!r} must not follow variables; scale it in the step function"

    def on(self, backend: Backend) -> Self:
        """Return the task as it is.

        Raises:
            UnknownOption: The backend is one of bodies, or the fake, which would call no function.
        """
        if backend.name in ("mujoco", "bullet", "fake"):
            raise UnknownOption("backend of a step function", backend.name, ("step",))
        return self

    def compose(self, options: Options) -> tuple[Composition, list[Variable]]:
        """Declare all variables; a control step is one call, of which the declared edges are.

        Raises:
            UnknownOption: A control step is to be several calls.
        """
        calls = round(options.control_period / self.time_unit)
        if calls != 1:
            raise UnknownOption("frame_skip", calls, ("1: a control step is one call of step",))
        return super().compose(options)

    def quantities(self) -> Iterable[Variable]:
        """Declare parameters, actions and states; of these the causes and the beginning, too."""
        yield from (*self.parameters, *self.actions)
        every = [Parent(v.name, 1) for v in (*self.parameters, *self.states, *self.actions)]
        for state in self.states:
            default = 0.0 if state.default is None else state.default
            initial = (parent for parent in state.parents if parent.when == "set")
            fields = {
                "parents": (*(_lagged(state) or every), *initial),
                "settable_state": True,
                "default": _numbers(state.name, default, state.shape),
            }
            yield from beginning(state.model_copy(update=fields), self.start.get(state.name))


def _lagged(state: Measured) -> tuple[Parent, ...]:
    """List the declared causes of a state in the step before."""
    return tuple(Parent(p.name, 1, p.when) for p in state.parents if p.when != "set")


def _quantity(variable: Variable) -> Quantity:
    """Return the row of a variable in the tables of the function."""
    default = getattr(variable, "value", getattr(variable, "default", None))
    default = 0.0 if default is None else default
    return Quantity(variable.name, variable.shape, default, integer=variable.dtype != "real")
