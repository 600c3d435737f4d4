"""Causal models without a backend, stepped like a world."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, Self, final

import numpy as np

from scm_world._arguments import real_numbers, typed, whole_number
from scm_world._types import ArrayLike, Floats, Integers, Value, Values
from scm_world.errors import (
    InterventionError,
    ModelError,
    SnapshotMismatch,
    UnknownOption,
    raise_all,
)
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.variables import Hard
from scm_world.variables.checks import check_space
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import Applied, Audit
from scm_world.world.compiled_task import Vectors
from scm_world.world.interventions import fixed_action, renewed, same
from scm_world.world.mechanisms import Rows, places
from scm_world.world.philox import NoiseOfRows
from scm_world.world.snapshot import Snapshot
from scm_world.world.system import CausalSystem, needs_engine

PRESENT = ("graph", "_before", "_action", "_each", "_drawn", "_solved")
"""The attributes of equations that a snapshot keeps."""

LATE = ("_before", "_action", "_drawn", "_solved")
"""Those that a step changes, without its number."""


@typed
@final
@dataclass(frozen=True, eq=False)
class CompiledModel(Vectors):
    """A model with the places of its variables in a row of numbers; see ``CompiledTask``.

    Attributes:
        model: The model, with the interventions of every episode.
        task: What acts in it and what counts, for an environment; None of a model alone.
        options: Options of the world, with a task.
        clock: Column of the number of control steps in a row; all variables stand before it.
    """

    model: SCM
    task: Any = None
    options: Any = None
    plan = None
    earlier: ClassVar[Mapping[str, slice]] = {}
    composition = source = None
    movers: ClassVar[tuple[str, ...]] = ()

    @cached_property
    def is_vectorised(self) -> bool:
        """Whether the functions of the model accept values with a leading axis."""
        try:
            alone = [Equations(self, vectorised=False) for _ in range(2)]
            both = Equations(self, 2, vectorised=True)
            for episode, one in enumerate(alone):
                one.reset(seed=0, episode=episode)
            both.reset(seed=0)
            for _ in range(2 if self.model.is_temporal else 0):
                for system in (*alone, both):
                    system.step(system.idle())
            wanted = np.array([one.vector for one in alone])
            near = 1e-9 * np.abs(wanted).max(axis=0)  # a share of each number
            return np.allclose(both.vector, wanted, rtol=0.0, atol=near, equal_nan=True)
        except Exception:  # functions may raise anything for unexpected shapes
            return False

    @cached_property
    def is_temporal(self) -> bool:
        """Whether the model has lagged edges."""
        return self.model.is_temporal

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each variable."""
        return {name: self.model.declared(name).shape for name in self.model}

    # --- rows -----------------------------------------------------------------------------------

    @cached_property
    def where(self) -> Mapping[str, slice]:
        """Columns of each variable in a row."""
        return self.slices

    @cached_property
    def clock(self) -> int:
        """Column of the number of control steps, the last one."""
        return sum(np.prod(shape, dtype=int) for shape in self.shapes.values())

    @cached_property
    def reading(self) -> dict[str, tuple[slice, tuple[int, ...], bool]]:
        """Columns and shape of each variable, and whether it is an integer."""
        whole = {v.name: v.dtype != "real" for v in self.model.variables}
        return {n: (at, self.shapes[n], whole[n]) for n, at in self.slices.items()}

    @cached_property
    def action_columns(self) -> Integers:
        """Columns of all actions."""
        return places(self.slices[name] for name in self.actions)

    @cached_property
    def parts(self) -> frozenset[str]:
        """The parts of all bundles."""
        return frozenset(part for v in self.model.variables for part in v.parts)

    @cached_property
    def static_names(self) -> tuple[str, ...]:
        """Variables without causes that have one value in an episode, unless do sets them."""
        roots = (v for v in self.model.variables if v.is_root or v.is_constant)
        return tuple(v.name for v in roots if v.own_noise is None or v.per_episode)

    @cached_property
    def random(self) -> tuple[str, ...]:
        """Variables that are drawn at the beginning of an episode."""
        drawn = (v for v in self.model.variables if v.is_root and v.own_noise is not None)
        return tuple(v.name for v in drawn if v.per_episode or not self.is_temporal)

    @cached_property
    def unacted(self) -> dict[str, Floats]:
        """What an action decides, as it is before the first one: zero, or nearest to it."""
        ends: dict[str, Any] = {v.name: v.bounds for v in self.model.variables}
        zeros = {n: np.zeros(self.shapes[n]) for n in self.model if n in self.decided}
        return {n: z if ends[n] is None else ends[n].nearest(z, zeros) for n, z in zeros.items()}

    def program(self, names: tuple[str, ...] | None) -> list[Any]:
        """Return what computes variables in a row: nothing, since all are solved for."""
        return []

    def refuse_impossible(self) -> None:
        """Refuse a model that cannot begin: its declarations are checked already."""

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self.model, "task": self.task, "options": self.options}


class Equations(CausalSystem):
    """A causal model without a backend that is stepped.

    Instant 0 of a model with lagged edges precedes its first step (see ``SCM.begin``); instant
    t + 1 is drawn with the noise of step t. A model without lagged edges has one instant, drawn
    with the noise of step 0. An intervention replaces a mechanism from its instant on, and the
    instant is solved again with the same noise.

    Several episodes, each with a seed and a number of its own, can be solved together, under
    interventions on the same variables; then every value has a leading axis. An intervention may
    have a value for each of them.

    Args:
        compiled: The model.
        count: Number of episodes; None for a single one without a leading axis.
        vectorised: Whether to solve a single episode as a batch of one, so that it has the same
            bits as in a batch; ``compiled.is_vectorised`` if None.
    """

    compiled: CompiledModel
    structures: Any = None  # the one structure there is, of a task
    variables_space: AnyRegion | None = None
    _kind: tuple[Any, ...] = ()  # the interventions in force, but for constants
    is_planned = False  # whether the present episode has planned interventions
    static_names: tuple[str, ...] = ()
    index = 0
    _solved: dict[str, Value] | None

    @typed
    def __init__(
        self, compiled: CompiledModel, count: int | None = None, *, vectorised: bool | None = None
    ) -> None:
        self.compiled = compiled
        count = None if count is None else whole_number("count", count, least=1)
        self._size(count, compiled.is_vectorised if vectorised is None else vectorised)
        self._have_no_episode()

    def _size(self, count: int | None, vectorised: bool) -> None:
        self._is_one, self._count = count is None, (count or 1) if vectorised else None
        self._lead = () if self._count is None else (self._count,)

    def _have_no_episode(self) -> None:
        self.has_begun = False
        self._take(0, 0)
        self._clear()

    def _noise_of(self, seed: Any, episode: Any) -> tuple[Any, Any]:
        """Return the noise and the number of an episode; of several, one number counts up."""
        if self._is_one:
            return super()._noise_of(seed, episode)
        count = self._count or 1
        numbers = episode + np.arange(count) if np.ndim(episode) == 0 else np.asarray(episode)
        return NoiseOfRows(seed, count), numbers.astype(np.uint64)

    def _take(self, seed: Any, episode: Any) -> None:
        self.noise, self.episode = self._noise_of(seed, episode)

    def _begin(self) -> None:
        self.has_begun = True
        self._clear()

    def _clear(self) -> None:
        self.graph, self.index = self.model, 0
        self._before: Values = {}
        self._action: Values = self._split(self.idle())
        self._each: Values = {}  # values that differ between the episodes, by target
        self._drawn: Mapping[str, int] = {}  # number of draws at this instant
        self._changed()

    if not TYPE_CHECKING:  # else every name would be one

        def __getattr__(self, name: str) -> Any:
            """Fetch what a table that this is one episode of has computed since."""
            table = vars(self).get("_table") if name in LATE else None
            if table is None:
                raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
            table.settle(self)
            return vars(self)[name]

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        found = copy(self)
        vars(found).update({name: getattr(self, name) for name in LATE})
        return found  # its parts are replaced, never changed

    # --- the present ----------------------------------------------------------------------------

    @property
    def engine(self) -> str:
        """The word for worlds without an engine."""
        return "equations"

    @property
    def has_steps(self) -> bool:
        """Whether an episode has control steps; without lagged edges, an instant is all."""
        return self.compiled.is_temporal

    def length(self, steps: int | None) -> int:
        """Return the checked number of control steps of an episode."""
        if self.has_steps:
            if steps is None:
                text = "the model has lagged edges: say how many steps an episode has"
                raise ModelError([text])
            return whole_number("steps", steps, least=1)
        if steps is not None and whole_number("steps", steps, least=0):
            raise UnknownOption("steps", steps, ("0: the model has no lagged edges",))
        return 0

    def usual_setting(self) -> dict[str, Any]:
        """Return what a question takes by default: no steps without lags, and idle actions."""
        return {"steps": None if self.has_steps else 0, "policy": None}

    def usual_outcomes(self) -> tuple[str, ...]:
        """List all variables but actions."""
        return tuple(name for name in self.model if name not in self.compiled.actions)

    def usual_columns(self, *, every_step: bool = False) -> tuple[str, ...]:
        """List all variables but actions."""
        return self.usual_outcomes()

    def maker(self) -> Callable[..., Equations]:
        """Return a function that makes equations of the same model."""
        return partial(Equations, self.compiled)

    # --- of a task ------------------------------------------------------------------------------

    @property
    def task(self) -> Any:
        """What acts in the model, and what counts; None of a model alone."""
        return self.compiled.task

    @property
    def options(self) -> Any:
        """The options of the world; None of a model alone."""
        return self.compiled.options

    @property
    def settings(self) -> dict[str, Any]:
        """The options that it was made with, as far as they are not the usual ones of its task."""
        given = None if self.options is None else self.options.given_length
        return {} if given is None else {"max_episode_length": given}

    @property
    def structure(self) -> Any:
        """Refuse: there are no bodies."""
        raise needs_engine("bodies to be drawn")

    @property
    def max_episode_length(self) -> int:
        """Length of an episode in control steps."""
        return int(self.options.steps)

    def noise_key(self, index: int) -> NoiseKey:
        """Return the noise key of a control step of this episode."""
        return NoiseKey(self.noise, self.episode, index, None if self._is_one else self._count)

    @property
    def row(self) -> Rows:
        """The present as an environment shows it, each episode a row.

        What an action decides within its instant has the values of the last control step. Before
        the first one it has none, and zero, or what is nearest to it in the bounds, stands for it.
        """
        now, compiled = self._now(), self.compiled
        columns: Any = compiled  # they answer like those of a task
        last = self._before if self.index else compiled.unacted
        lead = self._lead or (1,)
        numbers = np.empty((*lead, compiled.clock + 1))
        for name, at in compiled.slices.items():
            value = last[name] if name in compiled.decided else now[name]
            numbers[:, at] = np.reshape(value, (-1, at.stop - at.start))
        numbers[:, compiled.clock] = self.index
        return Rows(columns, numbers[0] if self._is_one else numbers)

    def advance(self, action: ArrayLike, scale: Floats | None = None) -> None:
        """Take a step with an action, in a unit of its own, without the plan of the episode.

        A model without lagged edges has one instant, which the action completes. If a function
        fails there, nothing has changed.
        """
        command = self.compiled.clipped(action, scale)
        self._now()
        before = dict(vars(self))
        try:
            self._advance(command)
            self._now()
        except BaseException:
            vars(self).update(before)
            raise

    def idle(self) -> Floats:
        """Return the idle action, shape (n_actions,): zero, or the nearest one in the range."""
        return np.clip(np.zeros(self.compiled.n_actions), *self.compiled.action_bounds)

    @property
    def vector(self) -> Floats:
        """All values, flat, shape (size,), or (n, size) for several episodes."""
        values = self._now()
        parts = [np.reshape(values[name], (*self._lead, -1)) for name in self.model]
        return self._shown(np.concatenate(parts, axis=-1).astype(np.float64))

    def evaluate(self, names: tuple[str, ...] | None = None) -> dict[str, Value]:
        """Return all present values."""
        return {name: self._shown(value) for name, value in self._now().items()}

    def _shown(self, value: Value) -> Value:
        """Remove the leading axis of a single episode."""
        return value[0] if self._is_one and self._lead else value

    # --- interventions and steps --------------------------------------------------------------

    def do(
        self,
        request: Mapping[str, Any],
        *,
        space: AnyRegion | None = None,
        check: Callable[[], object] | None = None,
    ) -> Audit:
        """Intervene now; see ``Simulation.do``."""
        space = self.variables_space if space is None else space
        self._require_episode()
        flat, drawn = renewed(self.model.named(flatten(request)), self._drawn)
        each = {
            name: self._of_each(name, act) for name, act in flat.items() if self.differs(name, act)
        }
        earlier, before = self._now(), self.snapshot()
        waiting = self._action if self.has_steps else {}
        try:
            self.graph = self.graph.do({**flat, **{name: rows[0] for name, rows in each.items()}})
            targets = {target for name in flat for target in self.model.targets(name)}
            kept = {name: rows for name, rows in self._each.items() if name not in targets}
            self._drawn, self._each = drawn, {**kept, **each}
            self._changed()
            now, region = self._now(), as_region("space", space)
            if region is not None:
                self._check_space(flat, region, waiting)
            if check is not None:
                check()
        except BaseException:
            self.restore(before)
            raise
        self.requested = request
        return self._audit(flat, earlier, now, waiting)

    def _audit(
        self, flat: Mapping[str, Any], earlier: Values, now: Values, waiting: Values
    ) -> Audit:
        targets = {
            name: Applied(
                name, act, None if name in waiting else np.array(self.evaluate()[name]), None
            )
            for name, act in flat.items()
        }
        moved = {
            name: (self._shown(earlier[name]), self._shown(now[name]))
            for name in self.model
            if name not in targets and not same(earlier[name], now[name])
        }
        return Audit(lambda: (targets, moved, {}, (), (), ()))

    def differs(self, name: str, act: Any) -> bool:
        """Return whether an intervention has a value for each of several episodes."""
        if self._is_one or not isinstance(act, Hard | list | np.ndarray) or name not in self.model:
            return False
        value = act.value if isinstance(act, Hard) else act
        return np.shape(value) == (*self._lead, *self.model.declared(name).shape)

    def _of_each(self, name: str, act: Any) -> Value:
        """Return the checked values of an intervention, one for each episode."""
        values: Any = act.value if isinstance(act, Hard) else act
        variable = self.model.declared(name)
        bounds, numbers = variable.bounds, np.asarray(values)
        plain = variable.dtype == "real" and not variable.shape and numbers.dtype.kind in "if"
        fixed = plain and (bounds is None or not bounds.parents())
        free = fixed and (bounds is None or bool(bounds.contains(numbers)))
        if not (free and np.isfinite(numbers).all()):
            acts: Any = [self.model.accept(name, value) for value in values]
            numbers = np.array([variable.array(one.value) for one in acts])
        return numbers.astype(np.float64 if variable.dtype == "real" else np.int64)

    def _check_space(self, request: Values, region: AnyRegion, waiting: Values) -> None:
        """Refuse values outside a space; actions must be constant."""
        problems: list[InterventionError] = []
        now = self.evaluate()
        for name in request:
            variable = self.model.declared(name)
            act: Any = self.graph._act_on(self.model.target(name))
            try:
                value = now[name]
                if name in waiting:
                    value = fixed_action(name, [act.intervention])
                check_space(variable, value, region, now)
            except InterventionError as problem:
                problems.append(problem)
        raise_all(problems)

    def step(self, action: ArrayLike) -> None:
        """Take a step with all actions, shape (n_actions,), or (n, n_actions) for several episodes.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
            ModelError: The model has no lagged edges, so that it has one instant.
            NotReset: No episode has begun.
        """
        if not self.has_steps:
            raise ModelError(["a model without lagged edges has one instant, and takes no step"])
        self._advance(action)

    def _advance(self, action: ArrayLike) -> None:
        now, actions = dict(self._now()), self.compiled.actions
        if self._is_one or np.ndim(action) != 2:
            now |= self._split(self.compiled.clipped(action))
        elif actions:
            now |= self._split(np.clip(real_numbers(action), *self.compiled.action_bounds))
        if actions:  # the instant is complete once they are chosen
            structure = self.graph.structure
            follow = {*actions, *structure.instant_descendants(actions)}
            self._solve([name for name in structure.order if name in follow], now)
        self._action = {name: now[name] for name in actions}
        self._before = self.graph._remembered(now, self._before)
        self.index += 1
        self._drawn, self._solved = {}, None

    def decided_values(self) -> dict[str, Value]:
        """Return the last instant as its actions completed it; empty for a model without any."""
        names = self.model if self.compiled.actions else ()
        return {name: self._shown(self._before[name]) for name in names}

    def snapshot(self) -> Snapshot:
        """Return everything that determines the future. It can be pickled."""
        self._now()
        present: tuple[Any, ...] = self.graph, {name: getattr(self, name) for name in PRESENT}, None
        where: dict[str, Any] = {
            "index": self.index,
            "seed": self.noise.seed,
            "episode": self.episode,
        }
        where["world"] = (self.model,)
        return Snapshot(*present, **where)

    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot bit-identically.

        Raises:
            SnapshotMismatch: It is not a snapshot of these equations.
        """
        is_one = isinstance(snapshot, Snapshot)
        if not is_one or snapshot.world != (self.model,):
            raise SnapshotMismatch(f"{snapshot!r} is not a snapshot of these equations")
        if snapshot.content is not None:
            snapshot = snapshot._opened(None, None)
        vars(self).update(snapshot.row, index=snapshot.index, has_begun=True)
        self._take(snapshot.seed, snapshot.episode)
        self.version += 1

    # --- solving ------------------------------------------------------------------------------

    def _changed(self) -> None:
        self.version += 1
        self._solved = None

    def _split(self, action: Floats) -> dict[str, Value]:
        """Return the part of each action variable in a vector of all actions, for each episode."""
        found = self.compiled.split(np.broadcast_to(action, (*self._lead, action.shape[-1])))
        if self.compiled.whole.any():
            whole = (name for name in found if self.model.declared(name).dtype != "real")
            found |= {name: np.rint(found[name]).astype(np.int64) for name in whole}
        return found

    def _now(self) -> dict[str, Value]:
        """Return the present values, and solve for them if necessary."""
        self._require_episode()
        if self._solved is None:
            values: dict[str, Value] = dict(self._action)
            known = values if self.has_steps else ()  # else no step will compute the actions
            names = [name for name in self.graph.structure.order if name not in known]
            self._solve(names, values)
            self._solved = values
        return self._solved

    def _solve(self, names: Iterable[str], values: dict[str, Value]) -> None:
        """Compute variables, causes before effects, under the interventions in force."""
        actions, shapes = self.compiled.actions, self.compiled.shapes
        first = self.has_steps and self.index == 0
        for commands, part in groupby(names, actions.__contains__):
            step, starts = (self.index, False) if commands else (max(self.index - 1, 0), first)
            some = [*part]
            values |= {name: self._each[name] for name in some if name in self._each}
            only = [name for name in some if name not in self._each] if self._each else some
            key = NoiseKey(self.noise, self.episode, step, self._count)
            given: dict[str, Any] = {
                "previous": self._before,
                "key": key,
                "only": only,
                "begins": starts,
            }
            solved = self.graph.solve(values, **given)
            for name in some:
                value, shape = solved[name], (*self._lead, *shapes[name])
                value = value if np.shape(value) == shape else np.broadcast_to(value, shape)
                if commands:  # clipped to its bounds, also after interventions
                    ends = (end[actions[name]] for end in self.compiled.action_bounds)
                    value = np.clip(value, *(end.reshape(shapes[name]) for end in ends))
                values[name] = value

    # --- several episodes ---------------------------------------------------------------------

    @property
    def is_several(self) -> bool:
        """Whether values have a leading axis of episodes."""
        return not self._is_one

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of each episode."""
        seed: Any = self.noise.seed
        return (seed,) if self._is_one else seed

    @property
    def instant(self) -> tuple[Any, ...]:
        """A key that is equal for equations that can be solved ``together``."""
        drawn = tuple(self._drawn.items())
        acts = self._kind or id(self.graph)
        return self.has_begun, acts, self.index, drawn, tuple(self._each)

    def joining(self) -> Self:
        """Return a copy of single equations that may be solved with others under other constants.

        Constants that interventions have set are values of this episode there; all else in force
        is the same in equations of one ``instant``.
        """
        found, kept, each = copy(self), list[Any](), dict[str, Value]()
        for name in self.model:
            act = self.graph._act_on(name)
            if act is None:
                continue
            own = act.below is None and act.requested.name == name
            if own and act.intervention.constant is not None:
                value = self.model.declared(name).array(act.intervention.constant)
                each[name] = np.broadcast_to(value, (1, *value.shape))
            elif own and act.intervention.draws:
                kept.append((name, act.intervention))
            else:
                kept.append(id(self.graph))
        found._each = each
        found._kind = ("acts", *kept)
        try:
            hash(found._kind)
        except TypeError:  # of a distribution with arrays
            found._kind = ("acts", id(self.graph))
        return found

    def takes_each(self, names: Iterable[str]) -> bool:
        """Return whether an intervention may have a value of these for each episode."""
        return not self.is_planned and all(self.model.targets(n) == (n,) for n in names)

    def awaits(self, request: Mapping[str, Any]) -> bool:
        """Return whether an intervention waits for an event, which differs between episodes."""
        return False

    def several(self, count: int) -> Self:
        """Return equations of several episodes, none of which has begun."""
        found = copy(self)
        found._size(count, vectorised=True)
        found._have_no_episode()
        return found

    def of(self, rows: Integers, *, alone: bool = False) -> Self:
        """Return the equations of some of several episodes, at the same instant.

        With ``alone`` it is a single one, without a leading axis.
        """
        found = copy(self)
        found._size(None if alone else len(rows), self._count is not None)
        if not self.has_begun:
            found._have_no_episode()
            return found

        def some(values: Values) -> dict[str, Value]:
            return {name: value[rows] for name, value in values.items()}

        found._before, found._action = some(self._before), some(self._action)
        found._solved = None if self._solved is None else some(self._solved)
        found._each = {} if alone else some(self._each)
        if alone:
            (row,) = rows.tolist()
            found._take(self.seeds[row], int(np.ravel(self.episode)[row]))
            if self._each:
                found.graph = self.graph.do({n: each[row] for n, each in self._each.items()})
        else:
            found._take([self.seeds[row] for row in rows], np.ravel(self.episode)[rows])
        return found

    @classmethod
    def together(cls, parts: Sequence[Self]) -> Self:
        """Return equations at the same instant, under the same interventions, as one."""
        found = copy(parts[0])
        found._size(sum(len(one.seeds) for one in parts), vectorised=True)
        if not found.has_begun:
            found._have_no_episode()
            return found

        def joined(values: Sequence[Values]) -> dict[str, Value]:
            return {n: np.concatenate([each[n] for each in values]) for n in values[0]}

        found._before = joined([one._before for one in parts])
        found._action = joined([one._action for one in parts])
        found._each = joined([one._each for one in parts])
        found._solved = joined([one._now() for one in parts])
        numbers = np.concatenate([np.ravel(one.episode) for one in parts])
        found._take([seed for one in parts for seed in one.seeds], numbers)
        return found
