"""Any model as a task: variables and their graph follow from its tables."""

from __future__ import annotations

import dataclasses
import math
import os
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeAlias

import numpy as np

from scm_world._arguments import one_of, real_number, refuse_other, scalar, true_or_false
from scm_world._patterns import by_name, fits, fitting
from scm_world._types import Floats, Value
from scm_world.backends import Backend, read_model
from scm_world.backends.step import StepModel
from scm_world.errors import UnknownOption
from scm_world.geometry import chains
from scm_world.geometry.numbers import njit
from scm_world.models import Model, ModelRow, Readout
from scm_world.models.model import SCALED, grouped
from scm_world.tasks.base import Goal, Observation, Observed, Options, Task
from scm_world.tasks.channels import Channel, Channels, channels_of, with_held
from scm_world.tasks.composition import Commands, Composition, clock
from scm_world.tasks.rewards import SUCCESS, TERMINATED, Declaration, declared
from scm_world.variables import (
    Action,
    Box,
    Derived,
    Exogenous,
    Function,
    Integers,
    Measured,
    Normal,
    Parent,
    Rotations,
    Variable,
)
from scm_world.variables.bundles import bundle
from scm_world.variables.kinds import coupled, parent_of
from scm_world.variables.mechanisms import Stacked

if TYPE_CHECKING:
    from scm_world.tasks.base import Simulation

CONTROL_DT = 0.02
"""Length of a control step where none is asked for [s], to the next whole physics step."""

AnyModel: TypeAlias = str | os.PathLike[str] | Model | Any | None
"""A path, XML text, or a model; MuJoCo's own classes ship no types."""

REWARD = "reward"
START = "start"
"""The variable drawn for the beginning of an episode is ``"<state>.start"``."""

_OVERRIDES = ("a", "b", "bounds", "default", "distribution", "doc")
_SETS = {"rotation": Rotations(keeps_sign=True), "switch": Integers(0, 1)}
_box = lru_cache(maxsize=1024)(Box)  # most bounds are the same


def same_value(value: Value) -> Value:
    """Return the value itself."""
    return value


class DeclaredTask(Task):
    """What tasks of any model and of any step function have in common: what counts in them.

    Every argument can also be an attribute of a class of your own.

    Args:
        kind: The class whose options there are in addition to those below.
        settings: Values of options.

    Attributes:
        system: The model, or the step function with its tables.
        commands: What draws the noise of a step function.
        outcomes: Names of readouts (``"tip.position"`` of a site, ``"torso.orientation"`` of a
            body, ``"gyro.value"`` of a sensor), or variables that have a function.
        reward: A ``Measured`` variable called ``"reward"``, or a function and the names of its
            parents: ``(upright, "hinge.position")``. A parent may be a ``Parent`` with lag 1.
        success: The same for ``"success"``, 0 or 1.
        terminated: The same for ``"terminated"``: whether the episode ends here.
        start: Where episodes begin: for states, by name or pattern, a value, or a space or
            distribution to draw from. For parameters of a model, the same: a pattern means them if
            it fits no state.
        observe: Names or patterns of the observed variables; all states if None.
        goal: The variables that are achieved and desired, for ``goal_env``, planners and
            ``sample_goal``.

    Raises:
        UnknownOption: An argument does not exist.
    """

    system: Model | StepModel
    commands: Commands | None = None

    outcomes: Iterable[Any] = ()
    reward: Declaration = None
    success: Declaration = None
    terminated: Declaration = None
    start: Mapping[str, Any] = {}  # a constant
    observe: Iterable[str] | None = None
    goal: Goal = Goal()

    kinds: ClassVar[tuple[tuple[Any, ...], ...]]
    """Options that are lists, and the types of their members; a member alone is a list of one."""

    def __init__(self, kind: type[DeclaredTask], settings: Mapping[str, Any]) -> None:
        allowed = kind.options()
        for option, value in settings.items():
            one_of(f"option of {type(self).__name__}", option, allowed)
            if isinstance(getattr(kind, option, None), bool):
                true_or_false(option, value)
            if value is not None:
                setattr(self, option, scalar(value))
        refuse_other("start", self.start, Mapping[str, Any])
        for option, *types in kind.kinds:
            given = getattr(self, option)
            if given is not None:
                single = isinstance(given, (*types, str)) or not isinstance(given, Iterable)
                members = (given,) if single else tuple(given)
                setattr(self, option, members)
                wrong = [getattr(m, "name", m) for m in members if not isinstance(m, tuple(types))]
                if wrong:
                    raise UnknownOption(option, wrong, [one.__name__ for one in types])
        own = [one for one in self.outcomes if isinstance(one, Variable)]
        if wrong := [one.name for one in own if one.equation is None]:
            raise UnknownOption("outcomes", wrong, ("a variable with a function: Measured, …",))
        self.weights = {REWARD: 1.0} if self.reward is not None else {}

    @classmethod
    def options(cls) -> tuple[str, ...]:
        """Return the names of the options, without the first argument."""
        _, *own = cls.__annotations__
        _, _, *shared, _kinds = DeclaredTask.__annotations__
        return (*own, *shared, "name")

    @property
    def observation(self) -> Observation:
        """The states, or what sensors with delays or noise read of them; or ``observe``."""
        names = self._observed() if self.observe is None else tuple(self.observe)
        return Observation(tuple(Observed(name, (-np.inf, np.inf)) for name in names))

    def _observed(self) -> tuple[str, ...]:
        return self.system.layout.names

    @abstractmethod
    def quantities(self) -> Iterable[Variable]:
        """Declare parameters, actions and states."""

    def compose(self, options: Options) -> tuple[Composition, list[Variable]]:
        """Declare the quantities of the system, and what counts.

        Raises:
            UnknownOption: Something that is not a variable is to be observed, or begins.
        """
        system, (index, _) = self.system, clock(options.steps, options.control_period)
        self.start = by_name("start", self.start, system.layout.names)
        if self.commands is not None:  # noise goes by the control step: setting that is not a cause
            index = index.model_copy(update={"settable_state": False, "parents": ()})
        own = (one for one in self.outcomes if not isinstance(one, str))
        counted = {name: getattr(self, name) for name in (REWARD, SUCCESS, TERMINATED)}
        variables = [
            *(*self.quantities(), index, *map(_readout, system.readouts), *own),
            *(declared(name, given) for name, given in counted.items() if given is not None),
        ]
        known = [variable.name for variable in variables]
        if self.observe is not None:
            each = (fitting(one, known, "observe") for one in self.observe)
            self.observe = tuple(dict.fromkeys(name for names in each for name in names))
        return Composition(system, self.commands), variables


class ModelTask(DeclaredTask):
    """A model from a file, and what counts in it.

    Every argument can also be an attribute of a class of your own, so that a task is a short
    declaration::

        class SwingUp(ModelTask):
            model = "cartpole.xml"
            seconds = 10.0
            control_dt = 0.02
            spaces = {"pole.mass": {"a": Box(0.05, 0.1), "b": Box(0.1, 0.3)}}
            reward = (upright, "hinge.position")

    Variables and edges are generated from the tables of the model: parameters, states and inputs
    of a kinematic tree act on the states of that tree one control step later, those of another
    one where the two are coupled, or while they touch.

    Args:
        model: A path to an MJCF or URDF file, XML text, an ``MjSpec``, an ``MjModel``, or a
            ``Model`` that was read before.
        name: The name of the task; that of the model if None.
        expose: Patterns of the parameters that become variables (``"*.mass"``); all that are safe
            to change if None. ``"*.scale"`` adds factors from which mass and inertia of a body
            follow, ``"*.external_force"`` and ``"*.external_torque"`` pushes (see the models page).
        spaces: For variables by name or pattern a dictionary with ``a``, ``b``, ``bounds`` (spaces,
            or a pair of ends), ``default``, ``distribution`` (drawn at every reset) or ``doc``.
        ties: Derived variables that decide parameters, such as a density that decides masses, and
            the variables that they follow. One with the name of a parameter takes its place.
        noise: Standard deviations of the noise of commands (``{"*.control": 0.02}``), and of
            readings of states and outcomes, in their units; see ``Channel``.
        delay: Delays of them in control steps, or ``Integers`` to draw them from at every reset.
        outcomes, reward, success, terminated, start, observe, goal: What counts, and where episodes
            begin; see ``DeclaredTask``.
        seconds: Length of an episode [s].
        control_dt: Length of a control step [s], a multiple of the physics step.
        frame_skip: The same in physics steps.
        timestep: Physics step [s] in place of that of the file.
        fixed_base: Whether the root link of a URDF is fixed to the world.
        keyframe: Name, or number, of a keyframe of the file in which episodes begin. Its controls
            are the idle action, which holds a robot with servos there.
        exact, self_collision, ground, drop, follow: Of ``read_model``: the settings of the file if
            not exact, contacts between bodies of one tree, a plane to stand on, features that are
            left out for Bullet, and states that keep loops closed where others are set.

    Raises:
        ModelError: The file cannot be read as a model, or a variable is declared wrongly.
        UnknownOption: An argument or a name does not exist.
    """

    choices = Task.choices | {"action_mode": ("controls",), "preset": ("model",)}
    kinds = (
        ("outcomes", str, Variable),
        ("observe", str),
        ("expose", str),
        ("ties", Variable),
        ("drop", str),
    )
    generated_graph = True

    if TYPE_CHECKING:
        system: Model

    model: AnyModel = None
    expose: Iterable[str] | str | None = None
    spaces: Mapping[str, Mapping[str, Any]] = {}  # a constant
    ties: Iterable[Variable] = ()
    noise: Mapping[str, Any] = {}  # a constant
    delay: Mapping[str, Any] = {}  # a constant
    seconds: float = 10.0
    control_dt: float | None = None
    frame_skip: int | None = None  # type: ignore[assignment] # filled in below
    timestep: float | None = None
    fixed_base: bool = True
    keyframe: str | int | None = None
    exact: bool = True
    self_collision: bool = True
    ground: bool = False
    drop: Iterable[str] = ()
    follow: bool = False

    def __init__(self, model: AnyModel = None, **settings: object) -> None:
        super().__init__(ModelTask, settings)
        source = self.model if model is None else model
        if source is None:
            raise UnknownOption("model", None, ("a path, XML text, an MjSpec or an MjModel",))
        if isinstance(source, str | os.PathLike):  # else it cannot be made again from a file
            found = os.path.abspath(source) if os.path.exists(source) else str(source)
            self.given, self.is_named = {"model": found, **settings}, True
        own = "expose fixed_base keyframe exact self_collision ground drop follow timestep"
        reading = {option: getattr(self, option) for option in own.split()}
        readouts = tuple(name for name in self.outcomes if isinstance(name, str))
        if isinstance(source, Model):
            for option, value in reading.items():
                if value != getattr(ModelTask, option):
                    allowed = ("left out: the model is read already; give it to read_model",)
                    raise UnknownOption(option, value, allowed)
            known = [row.name for row in source.readouts]
            for name in readouts:
                one_of("outcomes", name, known)
            self.system = source
        else:
            step = reading.pop("timestep")
            about = {} if step is None else {"timestep": real_number("timestep", step)}
            self.system = read_model(source, readouts=readouts, settings=about, **reading)
        self.channels = channels_of(self.system, self.noise, self.delay)
        if self.channels:
            self.system = with_held(self.system, self.channels)
            self.commands = Channels(self.channels, self.system)
        self.name = getattr(self, "name", self.system.name)
        self.time_unit = self.system.timestep
        if not self.system.exact:
            found = self.system.fidelity
            self.noise_floors = {name: found.floors[unit] for name, unit in found.units.items()}
        self.frame_skip = self._steps()
        self._check_names()

    def _steps(self) -> int:
        """Return the length of a control step in physics steps."""
        for option in ("seconds", "control_dt"):
            value = getattr(self, option)
            if value is not None and real_number(option, value) <= 0.0:
                raise UnknownOption(option, value, ("a time above zero [s]",))
        if self.frame_skip is not None:
            if self.control_dt is not None:
                raise UnknownOption("frame_skip", self.frame_skip, ("none, beside control_dt",))
            return self.frame_skip
        wanted = CONTROL_DT if self.control_dt is None else self.control_dt
        steps = wanted / self.time_unit
        if self.control_dt is None:
            return max(1, math.ceil(steps - 1e-9))
        if steps < 1.0 - 1e-9 or abs(steps - round(steps)) > 1e-6:
            allowed = f"a multiple of the physics step, {self.time_unit:g} s"
            other = f"timestep={self.control_dt / max(math.ceil(steps), 1):.6g}"
            advice = f"this one with another physics step, which divides it: {other}"
            raise UnknownOption("control_dt", self.control_dt, (allowed, advice))
        return round(steps)

    def _check_names(self) -> None:
        system = self.system
        rows = (*system.scales, *system.parameters, *system.states, *system.inputs)
        rows += tuple(row for channel in self.channels for row in channel.parameters())
        ties = {variable.name: variable.shape for variable in self.ties}
        known = [*(row.name for row in rows), *ties]
        for row in rows:
            if (shape := ties.get(row.name, row.shape)) != row.shape:
                raise UnknownOption(f"shape of the tie {row.name}", shape, (str(row.shape),))
        self.spaces = by_name("spaces", self.spaces, known)
        for name, given in self.spaces.items():
            if not isinstance(given, Mapping):
                allowed = (f"a dictionary with {', '.join(_OVERRIDES)}",)
                raise UnknownOption(f"spaces[{name!r}]", given, allowed)
            for what in given:
                one_of(f"spaces[{name!r}]", what, _OVERRIDES)
        parameters = {row.name: row.shape for row in (*system.scales, *system.parameters)}
        moving = system.layout.names
        known = [*moving, *parameters]  # a pattern means states, or parameters if it fits none
        for row in system.states:
            if row.follows is not None and row.name in self.start:
                advice = f"left out, or one that it follows: {', '.join(row.follows.names)}"
                raise UnknownOption("start", row.name, (advice,))
        states = [key for key in self.start if any(fits(name, (key,)) for name in moving)]
        rest = by_name("start", {k: v for k, v in self.start.items() if k not in states}, known)
        self.start = rest | {key: self.start[key] for key in states}
        for name in self.start.keys() & parameters.keys():
            value, single = scalar(self.start[name]), parameters[name] == ()
            kinds = (int, float, np.ndarray) if single else (int, float, np.ndarray, list, tuple)
            what = "default" if isinstance(value, kinds) else "distribution"
            self.spaces[name] = {**self.spaces.get(name, {}), what: value}
        self.start = {name: self.start[name] for name in self.start if name not in parameters}

    def delayed(self, steps: Mapping[str, float]) -> Self:
        """Return the same task with other delays of commands, in control steps by name."""
        late = {name: float(value) for name, value in steps.items() if value}
        own = {channel.of.name: channel for channel in self.channels}
        for row in self.system.inputs:
            if row.name in late:
                channel = own.get(row.name, Channel(row, True, None, None))
                own[row.name] = dataclasses.replace(channel, delay=late[row.name])
        other = self.at(self.plan, self.conventions, self.absent)
        other.channels = tuple(own.values())
        other.system = with_held(self.system, other.channels)
        other.commands = Channels(other.channels, other.system)
        other.delay = {**self.delay, **late}
        if self.is_named:
            other.given = {**self.given, "delay": other.delay}
        return other

    def on(self, backend: Backend) -> Self:
        """Return the same task with the parameters that a backend has."""
        supports = backend.capabilities.supports
        gone = {r.name: r.key for r in self.system.parameters if not supports(self.system, r.key)}
        if not gone:
            return self
        other, why = self.at(self.plan, self.conventions, self.absent), "is not a parameter of "
        reasons = grouped((gone[name], f"{why}{backend.name}") for name in sorted(gone))
        kept = tuple(row for row in self.system.parameters if row.name not in gone)
        refusals = (*self.system.refusals, *reasons)
        other.system = dataclasses.replace(self.system, parameters=kept, refusals=refusals)
        other.spaces = {name: given for name, given in self.spaces.items() if name not in gone}
        return other

    def idle(self, world: Simulation) -> Floats:
        """Return the controls of the keyframe, or those nearest to zero."""
        start = [row.default for row in self.system.inputs]
        return np.asarray(np.clip(start, world.action_low, world.action_high))

    def quantities(self) -> Iterable[Variable]:
        """Declare what the tables of the model have."""
        system, ties = self.system, {variable.name: variable for variable in self.ties}
        scales = {row.body: row for row in system.scales}
        parameters: list[Variable] = []
        for row in (*system.scales, *system.parameters):
            if row.body in scales and row.key[1] in SCALED:
                parameters.append(self._scaled(row, scales[row.body].name))
            else:
                parameters.append(Exogenous(**self._fields(row, "default", "distribution")))
        for index, given in enumerate(parameters):
            if given.name in ties:  # it has the bounds of the parameter, if none of its own
                tie = ties.pop(given.name)
                bounds = given.bounds if tie.bounds is None else tie.bounds
                parameters[index] = tie.model_copy(update={"bounds": bounds})
        actions = [self._action(row) for row in system.inputs]
        own = [row for channel in self.channels for row in channel.parameters()]
        parameters += [self._channel(row) for row in own]
        yield from (*ties.values(), *parameters, *actions)
        if actions and "action" not in {action.name for action in actions}:
            yield bundle("action", actions, doc="All controls.")
        acting = (
            *(row for row in system.parameters if not row.visual),
            *(row for row in system.states if not row.reported),
            *system.inputs,
            *own,
        )
        late = {
            channel.of.name for channel in self.channels if channel.acts and channel.ends[0] >= 1
        }
        effects = {row.name: (row.always, row.contact) for row in acting if row.name not in late}
        held = {row.name for channel in self.channels for row in channel.held()}
        moving = [row for row in system.states if row.name not in held]
        causes = causes_of(effects, {row.trees for row in moving})
        parents = {trees: coupled(*own) for trees, own in causes.items()}
        causing = {row.name: parents[row.trees] for row in moving}
        kept = {row.name: c.remembers(row, causing) for c in self.channels for row in c.held()}
        for moved in system.states:
            fields, begin = self._fields(moved, "default"), self.start.get(moved.name)
            if moved.name in kept:
                state = Measured(**fields, parents=kept[moved.name], settable_state=True)
                if begin is None and not kept[moved.name]:
                    begin = Normal()  # an error is drawn
                yield from beginning(state, begin)
                continue
            settable = not moved.reported
            state = Measured(**fields, parents=parents[moved.trees], settable_state=settable)
            if moved.follows is None:
                yield from beginning(state, begin)
                continue
            rule = moved.follows.among({row.name for row in parameters})
            setting = (Parent(name, 0, "set") for name in rule.names)
            rules = {"start": Function(rule), "carry": Function(rule.carry)}
            yield state.model_copy(update={"parents": (*state.parents, *setting), **rules})
        for channel in self.channels:
            yield from channel.readings()

    def _observed(self) -> tuple[str, ...]:
        held = {row.name for channel in self.channels for row in channel.held()}
        read = {c.of.name: c.name("reading") for c in self.channels if not c.acts}
        return tuple(read.get(n, n) for n in super()._observed() if n not in held)

    def _channel(self, row: ModelRow) -> Variable:
        """Declare the noise or the delay of an actuator or sensor."""
        for channel in self.channels:
            if row.name == channel.name("delay"):
                return channel.delays(self.spaces.get(row.name, {}))
        return Exogenous(**self._fields(row, "default", "distribution"))

    def _scaled(self, row: ModelRow, factor: str) -> Derived:
        """Declare a mass, or moments of inertia, that follow the factor of their body."""
        fields = self._fields(row, "default", "distribution")
        if fields.pop("distribution") is not None:
            allowed = (f"left out, as it follows {factor}; give {factor} a distribution",)
            raise UnknownOption("distribution", row.name, allowed)
        constants = {"value": np.asarray(fields.pop("default"))}
        mechanism = Function(multiplied, constants=constants)
        return Derived(**fields, parents=(factor,), mechanism=mechanism)

    def _fields(self, row: ModelRow, *more: str) -> dict[str, Any]:
        """Return fields of a declaration, with the requested ones."""
        given, where = self.spaces.get(row.name, {}), f"spaces[{row.name!r}]"
        kind, shape = getattr(row, "kind", "real"), row.shape
        limited = np.isfinite(row.low).any() or np.isfinite(row.high).any()
        bounds: Any = _SETS[kind] if kind in _SETS else _box(row.low, row.high) if limited else None
        bounds = _space(f"{where}['bounds']", given.get("bounds", bounds), shape, bounds)
        fields = {"doc": row.doc, "default": row.default, **given, "bounds": bounds}
        for name in ("a", "b"):
            fields[name] = _space(f"{where}[{name!r}]", given.get(name), shape, bounds)
        option = f"{where}['distribution']"
        fields["distribution"] = _space(option, given.get("distribution"), shape)
        fields["default"] = _numbers(f"{where}['default']", fields["default"], shape)
        fields |= {"name": row.name, "unit": row.unit, "shape": shape}
        fields["dtype"] = "integer" if kind == "switch" else "real"
        left_out = {"default", "distribution"}.difference(more)
        return {name: value for name, value in fields.items() if name not in left_out}

    def _action(self, row: ModelRow) -> Action:
        fields = self._fields(row)
        if fields["bounds"] is None:  # an actuator without a range
            fields["bounds"] = Box(-1.0, 1.0)
            fields["doc"] += (
                " The model has no limit for it: [-1, 1] is assumed; give another one with "
                f"spaces={{{row.name!r}: {{'bounds': (low, high)}}}}."
            )
        return Action(**fields)


Trees = frozenset[int]
Causes = tuple[tuple[Parent, ...], Mapping[str, Parent]]
"""Causes of lag 1 that act in every step, and those that act while there is contact, by name."""


def causes_of(
    effects: Mapping[str, tuple[Trees, Trees]], groups: Iterable[Trees]
) -> dict[Trees, Causes]:
    """List what acts on the states of each group of trees; they share it.

    Args:
        effects: For each variable the trees that it acts on always, and by contact.
        groups: Of trees that have states together.
    """
    alike: dict[frozenset[tuple[Trees, Trees]], Mapping[str, Parent]] = {}
    found: dict[Trees, Causes] = {}
    places = {name: place for place, name in enumerate(effects)}
    by_pair: dict[tuple[Trees, Trees], list[str]] = {}  # most variables of a tree act alike
    for name, pair in effects.items():
        by_pair.setdefault(pair, []).append(name)
    for own in groups:
        sure = [pair for pair in by_pair if own & pair[0]]
        acting = frozenset([*sure, *(pair for pair in by_pair if own & pair[1])])
        if acting not in alike:
            names = (name for name, pair in effects.items() if pair in acting)
            alike[acting] = {name: parent_of(name, 1, "contact") for name in names}
        always = sorted((name for pair in sure for name in by_pair[pair]), key=places.__getitem__)
        found[own] = tuple(parent_of(name, 1) for name in always), alike[acting]
    return found


def beginning(state: Measured, begin: object) -> tuple[Variable, ...]:
    """Declare a state with its value at the start of an episode, after the variable it is drawn as.

    Args:
        state: Its declaration.
        begin: A value, or a space or distribution to draw from; the default stays if None.
    """
    if begin is None:
        return (state,)
    option, shape = f"start[{state.name!r}]", state.shape
    if shape == () and isinstance(begin, tuple | list):
        begin = _space(option, begin, ())
    if isinstance(begin, int | float | list | tuple | np.ndarray | np.number):
        return (state.model_copy(update={"default": _numbers(option, begin, shape)}),)
    drawn = Exogenous(
        name=f"{state.name}.{START}",
        **{field: getattr(state, field) for field in ("unit", "shape", "dtype", "bounds")},
        default=0.0 if state.default is None else state.default,
        distribution=_space(option, begin, shape, state.bounds),
        doc=f"Where {state.name} is at the beginning of an episode.",
    )
    parents = (*state.parents, Parent(drawn.name, 0, "set"))
    return drawn, state.model_copy(update={"parents": parents, "start": Function(same_value)})


def _numbers(option: str, value: object, shape: tuple[int, ...], wanted: str = "") -> Any:
    """Return a number, or those of all components; ``wanted`` if they may be infinite."""
    try:
        given = np.asarray(value)
        numbers = np.broadcast_to(given, shape).astype(float) if given.dtype.kind in "iuf" else None
    except ValueError:
        numbers = None
    if numbers is None or not (wanted or np.isfinite(numbers).all()):
        many = f"{int(np.prod(shape))} finite numbers" if shape else "a finite number"
        raise UnknownOption(option, value, (wanted or many,)) from None
    return tuple(numbers.ravel().tolist()) if shape else float(numbers)


def _space(option: str, given: object, shape: tuple[int, ...], within: object = None) -> Any:
    """Return a space that lies within bounds; a pair of ends stands for a box."""
    if given is None or given is within:
        return given
    size = int(np.prod(shape))
    wanted = "a space, or its lower and its upper end" + (f", {size} numbers each" if shape else "")
    if isinstance(given, tuple | list):
        if len(given) != 2:
            raise UnknownOption(option, given, (wanted,))
        given = Box(*(_numbers(option, end, shape, wanted) for end in given))
    if isinstance(within, Rotations) and not isinstance(given, Rotations):
        raise UnknownOption(option, given, ("sw.Rotations()",))
    if not isinstance(given, Box) or given.parents():
        return given
    try:
        low, high = given.bounds(shape, {})
    except ValueError:
        raise UnknownOption(option, given, (wanted,)) from None
    if not (low <= high).all():
        raise UnknownOption(option, given, ("the lower end first",))
    if isinstance(within, Box) and not within.parents():
        corners = within.bounds(shape, {})
        if (low < corners[0]).any() or (high > corners[1]).any():
            raise UnknownOption(option, given, (f"a space within {within.describe()}",))
    return given


def multiplied(factor: Value, value: Value) -> Value:
    """Return a number, or those of all components, times a factor, shape (..., *value.shape)."""
    return np.multiply.outer(factor, value)


@Stacked
@njit(cache=True)
def pose(numbers: Floats, links: Floats) -> Floats:
    """Compute where the end of a chain of joints is; see ``scm_world.geometry.chains.Chain``."""
    return chains.end_of_chain(numbers, links)


def _readout(row: Readout) -> Measured:
    mechanism = Function(row.function)
    if isinstance(row.function, chains.Chain):
        mechanism = Function(pose, constants={"links": row.function.links})
    fields = {name: getattr(row, name) for name in ("name", "unit", "shape", "parents", "doc")}
    return Measured(mechanism=mechanism, **fields)
