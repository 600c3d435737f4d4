"""A task compiled for one structure: its variables and their counterparts in a backend."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from functools import cached_property
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
from numba.extending import is_jitted
from numpy.typing import NDArray

from scm_world._arguments import real_numbers
from scm_world._patterns import as_names
from scm_world._types import ArrayLike, Floats, Integers, Value, Values
from scm_world.errors import ActionError, ModelError, UnknownOption
from scm_world.geometry.numbers import scale_and_clip
from scm_world.graph import SCM, NoiseKey
from scm_world.models import ParameterKey, Scene, State, Structure
from scm_world.models.scene import Overlap
from scm_world.tasks import Options, Task
from scm_world.variables import (
    Box,
    Intervention,
    Linear,
    Variable,
)
from scm_world.variables.mechanisms import Stacked, Unboxed
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world.kernels import NUMBER, VECTOR, WHOLE, addresses
from scm_world.world.mechanisms import (
    CompiledStep,
    PythonStep,
    Rows,
    Step,
    copied,
    places,
    positional,
    program_of,
    wrong_value,
)
from scm_world.world.philox import uniforms, words_of

Plan = tuple[Hashable, frozenset[str]]
"""A structure: the bodies that the task requires, and the names of those that were removed."""

SINGLE, DOUBLE = np.dtype(np.float32), np.dtype(np.float64)

BOXES = 64
"""Number of requests with draws in the cache."""

PendingInterventions = dict[str, tuple[str, Intervention]]
"""By target: the requested name (the target, or coordinates of it), and the intervention."""


def slices_of(model: SCM, names: Iterable[str]) -> dict[str, slice]:
    """Return the place of each variable in one vector of all."""
    found, end = dict[str, slice](), 0
    for name in names:
        start, end = end, end + prod(model.declared(name).shape)
        found[name] = slice(start, end)
    return found


class Vectors:
    """The places of variables of a causal model in vectors of actions and of states.

    Attributes:
        model: The causal model.
    """

    model: SCM

    @cached_property
    def slices(self) -> Mapping[str, Any]:
        """Place of each variable in a vector of all; with a backend, of its states."""
        return slices_of(self.model, self.model)

    @cached_property
    def actions(self) -> Mapping[str, slice]:
        """Place of each action in the vector of all actions."""
        declared = self.model.variables
        return slices_of(self.model, (v.name for v in declared if v.role == "action"))

    @cached_property
    def commanded(self) -> Mapping[str, slice]:
        """Place of each action, and of each bundle of actions."""
        return self.actions

    @cached_property
    def decided(self) -> frozenset[str]:
        """The actions, and what follows from them within the instant."""
        follow = self.model.structure.instant_descendants(self.commanded)
        return frozenset({*self.commanded, *follow})

    @cached_property
    def n_actions(self) -> int:
        """Total number of action components."""
        return max((where.stop for where in self.actions.values()), default=0)

    @cached_property
    def whole(self) -> NDArray[np.bool_]:
        """Which numbers of an action are whole, shape (n_actions,)."""
        found = np.zeros(self.n_actions, dtype=np.bool_)
        for name, where in self.actions.items():
            found[where] = self.model.declared(name).dtype != "real"
        return found

    @cached_property
    def action_bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper end of all actions, shape (n_actions,) each."""
        low, high = np.full(self.n_actions, -np.inf), np.full(self.n_actions, np.inf)
        for name, where in self.actions.items():
            variable: Any = self.model.declared(name)
            if variable.bounds is not None:
                ends = variable.bounds.bounds(variable.shape, {})
                low[where], high[where] = (np.ravel(end) for end in ends)
        return low, high

    @cached_property
    def _in_si(self) -> Floats:
        # The sum of -0.0 and any number is that number, also of 0.0 and -0.0.
        return np.stack(
            [np.full(self.n_actions, -0.0), np.ones(self.n_actions), *self.action_bounds]
        )

    def split(self, action: Floats) -> dict[str, Value]:
        """Return the part of each action variable in vectors, shape (..., n_actions), as views."""
        lead, declared = action.shape[:-1], self.model.declared
        return {
            name: action[..., where].reshape(lead + declared(name).shape)
            for name, where in self.commanded.items()
        }

    def read(self, name: str, vectors: Floats) -> Value:
        """Read a state from vectors, shape (..., size); return shape (..., *shape)."""
        variable = self.model.declared(name)
        found = vectors[..., self.slices[name]].reshape(vectors.shape[:-1] + variable.shape)
        return found.astype(np.int64) if variable.dtype != "real" else found

    def clipped(self, action: ArrayLike, scale: Floats | None = None) -> Floats:
        """Return an action clipped to its range, shape (n_actions,), as a new array.

        Args:
            action: Numbers in SI units, or in others with a scale.
            scale: Summand and factor of each number, and its lower and upper end; shape
                (4, n_actions).

        Raises:
            ActionError: The action does not consist of ``n_actions`` finite numbers.
        """
        given: Any = action
        kind = given.dtype if type(given) is np.ndarray else None
        if kind is not SINGLE and kind is not DOUBLE:
            try:
                given = real_numbers(action)
            except (TypeError, ValueError):  # text, or a ragged list
                given = np.empty((0, 0))
        scale, command = self._in_si if scale is None else scale, np.empty(self.n_actions)
        if given.shape != command.shape or not scale_and_clip(given, scale, command):
            count = self.n_actions
            numbers = "a finite number" if count == 1 else f"{count} finite numbers"
            if given.shape != command.shape and given.ndim < 2:
                numbers += f" of shape {command.shape}, got {given.shape}"
            raise ActionError(f"an action is {numbers}, got {action!r}", action)
        return command


class CompiledTask(Vectors):
    """A task in one structure: its variables, their columns in a row, and their mechanisms.

    A row of numbers has the values of one world (see ``Rows``): its state, its actions, its clock,
    all other variables, and the values of one control step ago.

    Args:
        task: The task, with the plan and the conventions of this world.
        options: Options of the world.

    Attributes:
        task: The task as given.
        model: The causal model, without interventions.
        composition: The entities, as an engine needs them.
        slices: Place of each state in the state vector, and of each bundle of adjacent states.
        bundles: The parts of each bundle.
        parts: The parts of all bundles.
        parameter_keys: The physical parameter that each variable sets.
        set_by_hand: Variables that are set at an instant: states, and the clock.
        moved_by_hand: These, and the actions.
        set_parents: The parents that act on a state when they are set, by state, causes before
            effects.
        carriers: All of these parents.
        computed: Variables that are computed from states, causes before effects.
        static_names: Variables that only interventions change, causes before effects.
        static: The same variables, unordered.
        random: Variables that are drawn at the beginning of an episode.
        where: Columns of each variable.
        state_size: Number of columns of the state, which are the first.
        reading: Columns and shape of each variable, and whether it is an integer.
        earlier: Columns of values of one control step ago; those of a command are its own, since
            the next one has not been chosen.
        action_columns: Columns of all actions.
        kept: Columns that are not computed from others.
        owners: Index of the static variable of each column, -1 of others, shape (width,).
        clock: Column of the number of control steps.
        fresh: Column that is 1 if the values to remember are up to date.
        stepped: Columns that a control step writes; see ``begin_step``.
        start: A row before anything is written into it, shape (width,).
        last_overlaps: The row of which overlaps were computed last, as bytes, and these.
    """

    last_overlaps: tuple[bytes, tuple[Overlap, ...]] | None = None

    def __init__(self, task: Task, options: Options) -> None:
        self.task = task
        self.composition, variables = task.compose(options)
        self.model = model = SCM(_after_commands([*options.conventions.adapt(variables)]))
        self.parameter_keys = self.composition.parameters()
        self.bundles = {v.name: v.parts for v in model.variables if v.parts}
        self.parts = frozenset(part for parts in self.bundles.values() for part in parts)
        self.commanded = {**self.actions, **_in_a_row(self.bundles, self.actions)}
        states = self.composition.system.layout.slices
        self.slices = {**states, **_in_a_row(self.bundles, states)}
        ordered = [model.declared(name) for name in model.structure.order]
        measured = [v for v in ordered if v.is_measured]
        causes = [v.all_parents for v in measured]  # kept, since they are known by their ids
        shared = {id(parents): v for parents, v in zip(causes, measured, strict=True)}
        acting = {key: v.set_parents() for key, v in shared.items()}
        both = zip(measured, map(acting.get, map(id, causes)), strict=True)
        self.set_parents = {v.name: found for v, found in both if found}
        self.carriers = frozenset(name for found in self.set_parents.values() for name in found)
        self.set_by_hand = frozenset(v.name for v in model.variables if v.role == "state")
        self.moved_by_hand = self.set_by_hand.union(self.actions)
        problems = [
            f"{v.name!r} is drawn in every step, which a world does not do: use a noise of the task"
            for v in model.variables
            if v.is_root and v.own_noise and not v.per_episode
        ]
        problems += [
            f"{edge.cause!r} acts on {edge.effect!r} after {edge.lag} control steps; a world has "
            "lags 0 and 1: declare a state that remembers"
            for edge in model.structure.late
        ]
        if problems:
            raise ModelError(problems)
        moving = {v.name for v in measured}
        moving |= {v.name for v in ordered if any(p.lag for p in v.all_parents)}
        follow = {*moving, *model.structure.instant_descendants(moving)}
        # Other coordinates of a quantity have no effects, so they are computed on request.
        follow |= {v.name for v in model.variables if v.coordinates_of is not None}
        self.computed = tuple(
            v.name for v in ordered if v.name in follow and v.equation is not None
        )
        moving |= {v.name for v in ordered if v.role in {"state", "action"}}.union(self.computed)
        self.static_names = tuple(v.name for v in ordered if v.name not in moving)
        self.static = frozenset(self.static_names)
        self.random = tuple(v.name for v in model.variables if v.own_noise is not None)
        # Earlier results; these are pickled with episodes.
        self._orders: dict[tuple[str, ...], tuple[str, ...]] = {}
        self._boxes: dict[Any, tuple[frozenset[str], list[Any]]] = {}
        self._moves: dict[str, bool] = {}
        self._constants: dict[Structure, Mapping[ParameterKey, Floats]] = {}
        self._lay_out()

    def _lay_out(self) -> None:
        """Assign columns, and bind the mechanisms of computed variables to them."""
        declared = self.model.declared
        self._start: State = self.composition.system.empty_state()
        self._width = self.state_size = self._start.vector.size
        self.action_columns = self._take(self.n_actions)
        first = self.action_columns.start
        own = {n: slice(first + at.start, first + at.stop) for n, at in self.commanded.items()}
        self.where = {**self.slices, **own}
        bound = [name for name in self.computed if name not in self.where]
        for name in (CONTROL_INDEX, *self.model):
            if name not in self.where:
                self.where[name] = self._take(prod(declared(name).shape))
        lagged = dict.fromkeys(p.name for n in bound for p in declared(n).all_parents if p.lag)
        kept = {n: self._take(prod(declared(n).shape)) for n in lagged if n not in own}
        self.earlier = {name: kept.get(name) or own[name] for name in lagged}
        self.reading = {
            name: (place, declared(name).shape, declared(name).dtype != "real")
            for name, place in self.where.items()
        }
        given = [place for name, place in self.where.items() if name not in {*bound}]
        self.kept = places([slice(0, self.state_size), *given, *kept.values()])
        before = np.clip(0.0, *self.action_bounds)  # the first step
        self._written: list[tuple[slice, Any]] = [(self.action_columns, before)]
        self._steps = {name: self._bound(name) for name in bound}
        self.clock, self.fresh = self.where[CONTROL_INDEX].start, self._take(1).start
        one = self._take(1)
        self._written.append((one, 1.0))
        self._mark = [copied([one], [slice(self.fresh, self.fresh + 1)])] if self.earlier else []
        now = places([self.where[name] for name in kept])
        memory = np.stack([now, places(kept.values())], axis=1)
        self.stepped = np.concatenate([[(self.clock, self.fresh), (first, first)], memory])
        self._programs: dict[tuple[str, ...] | None, list[Any]] = {}
        self.owners = np.full(self._width, -1)
        for number, name in enumerate(self.static_names):
            self.owners[self.where[name]] = number
        self.start = np.zeros(self._width)
        for place, value in self._written:
            self.start[place] = value

    def _take(self, size: int) -> slice:
        first, self._width = self._width, self._width + size
        return slice(first, self._width)

    def _bound(self, name: str) -> list[Step]:
        """Bind a mechanism to columns, as compiled steps if possible, else as a Python step."""
        variable: Any = self.model.declared(name)
        parents = variable.all_parents
        columns = [(self.earlier if p.lag else self.where)[p.name] for p in parents]
        if variable.parts:
            return [copied(columns, [self.where[name]])]
        function, constants = positional(variable.equation, len(parents))
        called: Any = function.kernel if isinstance(function, Stacked | Unboxed) else function
        readings = [self.reading[p.name][1:] for p in parents]
        kinds = [VECTOR if shape else WHOLE if whole else NUMBER for shape, whole in readings]
        flat = not any(len(shape) > 1 or (shape and whole) for shape, whole in readings)
        if isinstance(function, Stacked):
            kinds, flat = [VECTOR], True
        if isinstance(variable.equation, Linear) and any(shape for shape, _ in readings):
            flat = False
        kinds += [VECTOR if np.shape(value) else NUMBER for value in constants]
        found = None
        if is_jitted(called) and parents and flat and len(variable.shape) < 2:
            found = addresses(called, tuple(kinds), is_vector=variable.shape != ())
        if found is None:
            return [PythonStep(self, name, variable, columns)]
        steps: list[Step] = []
        if isinstance(function, Stacked):
            whole = self._take(sum(at.stop - at.start for at in columns))
            steps, columns = [copied(columns, [whole])], [whole]
        for value in constants:
            columns.append(self._take(np.size(value)))
            self._written.append((columns[-1], value))
        where = [(at.start, at.stop) for at in (*columns, self.where[name])]
        vectors = (*(kind == VECTOR for kind in kinds), variable.shape != ())
        return [*steps, CompiledStep(found, np.array(where), called, vectors)]

    def needed(self, names: Iterable[str]) -> tuple[str, ...]:
        """List the computed variables on which some names and the memory depend, causes first."""
        wanted: set[str] = set()
        stack = [*names, *self.earlier]
        while stack:
            name = stack.pop()
            if name in self._steps and name not in wanted:
                wanted.add(name)
                stack.extend(p.name for p in self.model.declared(name).all_parents if not p.lag)
        return tuple(name for name in self._steps if name in wanted)

    def program(self, names: tuple[str, ...] | None) -> list[Any]:
        """Return what computes variables, their causes and the inputs of the memory in a row."""
        try:
            found = self._programs.get(names)
        except TypeError:  # not hashable
            raise UnknownOption("names", names, ("a tuple of names of variables",)) from None
        if found is None:
            wanted = self.needed(self._steps if names is None else as_names(names))
            steps = [step for name in wanted for step in self._steps[name]]
            found = self._programs[names] = program_of([*steps, *self._mark])
        return found

    @property
    def constants(self) -> dict[int, float]:
        """The values of columns that have the same one in all worlds, by column."""
        found: dict[int, float] = {}
        for place, value in self._written[1:]:
            found |= zip(range(place.start, place.stop), np.ravel(value).tolist(), strict=True)
        return found

    def steps_of(self, name: str) -> list[Step]:
        """Return the steps that compute a variable from others, last what marks that it is done."""
        return self._steps[name]

    @property
    def plan(self) -> Plan:
        """The bodies that the task requires, and the names of those that were removed."""
        return self.task.plan, self.task.absent

    @cached_property
    def bounded(self) -> frozenset[str]:
        """The variables whose bounds follow others."""
        declared = self.model.variables
        return frozenset(v.name for v in declared if v.bounds is not None and v.bounds.parents())

    @cached_property
    def readouts(self) -> tuple[str, ...]:
        """The variables that are computed from measurements, without bundles."""
        measured = (v for v in self.model.variables if v.is_measured and v.equation is not None)
        return tuple(v.name for v in measured if v.name not in self.bundles)

    @cached_property
    def places(self) -> Mapping[str, slice]:
        """Places of the states that describe positions and orientations, not velocities."""
        units = ("m", "rad", "1")
        return {n: at for n, at in self.slices.items() if self.model.declared(n).unit in units}

    @cached_property
    def placed(self) -> NDArray[np.bool_]:
        """Mask of the state's numbers for positions and orientations, shape (size,)."""
        found = np.zeros(self._start.vector.shape, dtype=np.bool_)
        for name, where in self.places.items():
            found[where] |= name not in self.bundles
        return found

    @cached_property
    def inertias(self) -> Mapping[ParameterKey, ParameterKey]:
        """The moments of inertia that follow from a mass or a size, by the key of that."""
        movers = {*self.composition.movers()}
        fixed = {*self.composition.bodies} - movers
        keys = (key for key in self.parameter_keys.values() if movers and key[0] not in fixed)
        return {key: (key[0], "inertia") for key in keys if key[1] in ("mass", "size")}

    def static_order(self, targets: tuple[str, ...]) -> tuple[str, ...]:
        """List variables and their static descendants at lag 0, causes first."""
        if targets not in self._orders:
            follow = {*targets, *self.model.structure.instant_descendants(targets)}
            self._orders[targets] = tuple(name for name in self.static_names if name in follow)
        return self._orders[targets]

    def boxes(
        self, draws: tuple[tuple[str, Any, str | None], ...]
    ) -> tuple[frozenset[str], list[Any]]:
        """Return the parameters that are drawn from boxes without parents: their names.

        And, grouped by size, names, streams, columns, lower ends and edges, the last three of shape
        (draws, size).
        """
        found = self._boxes.get(draws)
        if found is not None:
            return found
        sizes = dict[int, list[Any]]()
        for name, source, stream in draws:
            box = self._box(name, source)
            if box is not None:
                sizes.setdefault(len(box[0]), []).append((name, stream, *box))
        names = frozenset(one[0] for group in sizes.values() for one in group)
        groups = [(*zip(*group, strict=True),) for group in sizes.values()]
        if len(self._boxes) == BOXES:
            self._boxes.clear()
        found = self._boxes[draws] = names, [(*g[:2], *map(np.stack, g[2:])) for g in groups]
        return found

    def _box(self, name: str, source: Any) -> tuple[Integers, Floats, Floats] | None:
        """Return columns, lower ends and edges; None for a source that exceeds the bounds."""
        variable: Any = self.model.declared(name)
        space: Any = variable.space(source) if isinstance(source, str) else source
        ends = []
        for one in (space, variable.bounds or space) if name in self.static else ():
            if isinstance(one, Box) and not one.parents() and variable.dtype == "real":
                ends += [np.ravel(end) for end in one.bounds(variable.shape, {})]
        if len(ends) < 4 or (ends[0] < ends[2]).any() or (ends[1] > ends[3]).any():
            return None
        where = self.where[name]
        return np.arange(where.start, where.stop), ends[0], ends[1] - ends[0]

    def reached(self, names: Iterable[str]) -> set[str]:
        """Return the parameters and states that change at the instant at which targets are set."""
        targets = {target for name in names for target in self.model.targets(name)}
        found = {*targets, *self.static_order(tuple(sorted(targets)))}
        for name, parents in self.set_parents.items():
            if not found.isdisjoint(parents):
                found.add(name)
        return found

    def moves_bodies(self, name: str) -> bool:
        """Return whether an intervention on a variable moves or resizes a body."""
        if name not in self._moves:
            self._moves[name] = not self.material.isdisjoint(self.reached((name,)))
        return self._moves[name]

    @cached_property
    def surfaces(self) -> frozenset[str]:
        """The parameters and states that determine positions, orientations and sizes of bodies."""
        shaping = self.composition.surfaces
        shapes = (name for name, key in self.parameter_keys.items() if key in shaping)
        return frozenset((*self.places, *shapes))

    @cached_property
    def material(self) -> frozenset[str]:
        """The parameters and states that move or resize a body when they are set.

        What must be kept clear of bodies counts as one.
        """
        clear = self.static & self.composition.kept_clear
        return frozenset((*self.surfaces, *self.set_by_hand, *clear))

    def empty_state(self, vector: Floats | None = None) -> State:
        """Return an empty state, or a state with the numbers of a vector."""
        return self._start.copy() if vector is None else self._start.with_vector(vector)

    def state_of(self, row: Rows) -> State:
        """Return the state of a row, as a view."""
        return self._start.with_vector(row.numbers[: self.state_size])

    def in_coordinates(self, name: str, *values: Value) -> Value:
        """Convert a value to other coordinates, or the values of parts to one of their bundle."""
        variable: Any = self.model.declared(name)
        return np.asarray(variable.equation.bind()(*values))

    def coordinates(self, name: str, row: Rows) -> Value:
        """Return a parameter, a state, other coordinates of these, or a bundle."""
        targets = self.model.targets(name)
        if targets == (name,):
            return row[name]
        return self.in_coordinates(name, *(row[target] for target in targets))

    def refuse_impossible(self) -> None:
        """Refuse a world with a default out of bounds, or with overlapping bodies."""
        values, known = beginning(self, None), self.static | self.slices.keys()
        problems = _problems(self, values, (name for name in self.model if name in known))
        problems += map(str, self.composition.overlaps(self.scene(values)))
        if problems:
            advice = f"choose other arguments of the task {self.task.name!r}"
            raise ModelError([f"it cannot begin: {problem}; {advice}" for problem in problems])

    @property
    def source(self) -> Hashable:
        """What a structure is read from, kept so that it can be compiled again without reading."""
        return self.composition.system

    @property
    def movers(self) -> tuple[str, ...]:
        """The bodies that move."""
        return self.composition.movers()

    def describe(self, values: Values, state: State) -> Scene:
        """Build the scene of values and a state."""
        structure = self.composition.structure(values)
        if structure not in self._constants:
            self._constants[structure] = structure.default_scene().parameters
        parameters = dict(self._constants[structure])
        for name, key in self.parameter_keys.items():
            parameters[key] = values[name]
        return Scene(structure, parameters, state, *self.composition.looks(values))

    def scene(self, row: Rows) -> Scene:
        """Build the scene of a row."""
        return self.describe(row, self.state_of(row))


def _after_commands(variables: list[Variable]) -> Iterator[Variable]:
    """Yield variables; what a command computes has that of the control step before, with lag 1.

    An instant is computed when its command has not been chosen.
    """
    actions = {v.name for v in variables if v.role == "action"}
    chosen = actions | {v.name for v in variables if v.parts and {*v.parts} <= actions}
    for variable in variables:
        found = variable
        computed = variable.equation is not None and variable.name not in chosen
        if computed and not chosen.isdisjoint(p.name for p in variable.all_parents):
            parents = tuple(
                p.model_copy(update={"lag": 1}) if p.name in chosen and not p.lag else p
                for p in variable.all_parents
            )
            found = variable.with_parents(parents)
        yield found


def _in_a_row(
    bundles: Mapping[str, tuple[str, ...]], places: Mapping[str, slice]
) -> dict[str, slice]:
    """Return the place of each bundle whose parts are adjacent in a vector."""
    found: dict[str, slice] = {}
    for name, parts in bundles.items():
        there = [places[part] for part in parts if part in places]
        whole = len(there) == len(parts)
        if whole and all(one.stop == other.start for one, other in pairwise(there)):
            found[name] = slice(there[0].start, there[-1].stop)
    return found


def beginning(
    compiled: CompiledTask,
    key: NoiseKey | None,
    model: SCM | None = None,
    known: Values | None = None,
) -> Rows:
    """Return a row at the beginning of an episode, with static variables and states.

    Without a key nothing is drawn. ``model`` has the interventions in force, if any, and ``known``
    has given values of exogenous variables.
    """
    row = Rows(compiled, compiled.start.copy())
    static = (model or compiled.model).solve(known, only=compiled.static_names, key=key)
    for name in compiled.static_names:
        row[name] = static[name]
    declared = map(compiled.model.declared, compiled.slices)
    states: dict[str, Any] = {v.name: v for v in declared if not v.parts}
    default = {n: v.array(v.default) for n, v in states.items() if v.default is not None}
    values = {**default, **static}
    order = {name: number for number, name in enumerate(compiled.set_parents, 1)}
    for name in sorted(states, key=lambda name: order.get(name, 0)):  # causes before effects
        start, parents = states[name].start, compiled.set_parents.get(name, ())
        now = start.bind()(*map(values.get, parents)) if start else default[name]
        row[name] = values[name] = now
    return row


def beginnings(
    compiled: CompiledTask, first: Rows, where: NDArray[np.uint64], key: Callable[[int], NoiseKey]
) -> Floats:
    """Return the rows of several worlds at the beginning of episodes, shape (n, width).

    Args:
        compiled: The task.
        first: The row in which nothing is drawn.
        where: The key of the seed, the episode and the control step 0 of each, shape (n, 3).
        key: Returns the noise key of one of them.
    """
    numbers = np.repeat(first.numbers[None], len(where), axis=0)
    variables: list[Any] = [compiled.model.declared(name) for name in compiled.random]
    sources: list[Any] = [getattr(variable, "distribution", None) for variable in variables]
    alone = all(source is not None and not source.parents() for source in sources)
    if not (alone and compiled.reached(compiled.random) == {*compiled.random}):
        for place, row in enumerate(numbers):
            row[:] = beginning(compiled, key(place)).numbers
        return numbers
    for variable, source in zip(variables, sources, strict=True):
        words = words_of(variable.name, None, range(1))
        drawn = uniforms(where, words, source.n_uniforms(variable.shape))[:, 0]
        values = source.transform(drawn, variable.shape, {})
        numbers[:, compiled.where[variable.name]] = values.reshape(len(numbers), -1)
    return numbers


def _problems(compiled: CompiledTask, values: Values, names: Iterable[str]) -> list[str]:
    """List which values are not finite, misshaped or out of bounds."""
    found = []
    for variable in map(compiled.model.declared, names):
        value, bounds = values[variable.name], variable.bounds
        problem = wrong_value(variable, value)
        if not problem and bounds is not None and not bounds.contains(value, values):
            problem = f"gives {np.asarray(value).tolist()}, not in {bounds.describe()}"
        found += [f"{variable.name!r} {problem}"] if problem else []
    return found


def check_functions(compiled: CompiledTask, values: Values) -> None:
    """Refuse readouts whose initial values are not finite, misshaped or out of bounds."""
    names = compiled.readouts
    problems = [f"the function of {problem}" for problem in _problems(compiled, values, names)]
    if problems:
        raise ModelError(problems)
