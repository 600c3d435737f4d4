"""Causal models without a backend, stepped like a world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Self, final

import numpy as np

from scm_world._arguments import real_numbers, whole_number
from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.errors import (
    InterventionError,
    ModelError,
    SnapshotMismatch,
    UnknownOption,
    raise_all,
)
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.variables.checks import check_space
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import Applied, Audit
from scm_world.world.compiled_task import Vectors
from scm_world.world.interventions import fixed_action, renewed, same
from scm_world.world.philox import CompiledNoise
from scm_world.world.snapshot import Snapshot
from scm_world.world.system import CausalSystem

PRESENT = ("graph", "_before", "_action", "_drawn", "_solved")
"""The attributes of equations that a snapshot keeps."""


@final
@dataclass(frozen=True, eq=False)
class CompiledModel(Vectors):
    """A model with the places of its variables in a row of numbers; see ``CompiledTask``.

    Attributes:
        model: The model, with the interventions of every episode.
    """

    model: SCM
    plan = None

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

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self.model}


class Equations(CausalSystem):
    """A causal model without a backend that is stepped.

    Instant 0 of a model with lagged edges precedes its first step (see ``SCM.begin``); instant
    t + 1 is drawn with the noise of step t. A model without lagged edges has one instant, drawn
    with the noise of step 0. An intervention replaces a mechanism from its instant on, and the
    instant is solved again with the same noise.

    A number of successive episodes can be solved together, under the same interventions; then every
    value has a leading axis.

    Args:
        compiled: The model.
        count: Number of episodes; None for a single one without a leading axis.
        vectorised: Whether to solve a single episode as a batch of one, so that it has the same
            bits as in a batch; ``compiled.is_vectorised`` if None.
    """

    compiled: CompiledModel
    static_names: tuple[str, ...] = ()
    index = 0
    _solved: dict[str, Value] | None

    def __init__(
        self, compiled: CompiledModel, count: int | None = None, *, vectorised: bool | None = None
    ) -> None:
        self.compiled, self._is_one = compiled, count is None
        vectorised = compiled.is_vectorised if vectorised is None else vectorised
        self._count = (count or 1) if vectorised else None
        self._lead = () if self._count is None else (self._count,)
        self._have_no_episode()

    def _have_no_episode(self) -> None:
        self.has_begun = False
        self.noise, self.episode = CompiledNoise(0), 0
        self._clear()

    def _begin(self) -> None:
        self.has_begun = True
        self._clear()

    def _clear(self) -> None:
        self.graph, self.index = self.model, 0
        self._before: Values = {}
        self._action: Values = self._split(self.idle())
        self._drawn: Mapping[str, int] = {}  # number of draws at this instant
        self._changed()

    def __deepcopy__(self, memo: Any) -> Self:
        return copy(self)  # its parts are replaced, never changed

    # --- the present ----------------------------------------------------------------------------

    @property
    def engine(self) -> str:
        """The word for what has no engine."""
        return "equations"

    @property
    def has_steps(self) -> bool:
        """Whether an episode has control steps; without lagged edges, an instant is all."""
        return self.model.is_temporal

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

    def do(self, request: Mapping[str, Any], *, space: AnyRegion | None = None) -> Audit:
        """Intervene now; see ``Simulation.do``."""
        self._require_episode()
        flat, drawn = renewed(self.model.named(flatten(request)), self._drawn)
        earlier, before = self._now(), self.snapshot()
        waiting = self._action if self.model.is_temporal else {}
        try:
            self.graph, self._drawn = self.graph.do(flat), drawn
            self._changed()
            now, region = self._now(), as_region("space", space)
            if region is not None:
                self._check_space(flat, region, waiting)
        except BaseException:
            self.restore(before)
            raise
        targets = {
            name: Applied(name, act, None if name in waiting else self[name], None)
            for name, act in flat.items()
        }
        moved = {
            name: (self._shown(earlier[name]), self._shown(now[name]))
            for name in self.model
            if name not in targets and not same(earlier[name], now[name])
        }
        return Audit(lambda: (targets, moved, {}, (), (), ()))

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
        if not self.model.is_temporal:
            raise ModelError(["a model without lagged edges has one instant, and takes no step"])
        if self._is_one or np.ndim(action) != 2:
            given = self.compiled.clipped(action)
        else:
            given = np.clip(real_numbers(action), *self.compiled.action_bounds)
        now, actions = {**self._now(), **self._split(given)}, self.compiled.actions
        structure, starts = self.graph.structure, self.index == 0
        follow = {*actions, *structure.instant_descendants(actions)}
        for name in structure.order:  # the instant is complete once its actions are chosen
            if name in actions:
                now[name] = self._taken(name, now)
            elif name in follow:
                now[name] = self._computed(name, now, max(self.index - 1, 0), starts)
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
        present: Any = self.graph, {name: getattr(self, name) for name in PRESENT}, None
        where: Any = {"index": self.index, "seed": self.noise.seed, "episode": self.episode}
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
        self.noise, self.episode = CompiledNoise(snapshot.seed), snapshot.episode
        self.version += 1

    # --- solving ------------------------------------------------------------------------------

    def _changed(self) -> None:
        self.version += 1
        self._solved = None

    def _split(self, action: Floats) -> dict[str, Value]:
        """Return the part of each action variable in a vector of all actions, for each episode."""
        return self.compiled.split(np.broadcast_to(action, (*self._lead, action.shape[-1])))

    def _now(self) -> dict[str, Value]:
        """Return the present values, and solve for them if necessary."""
        self._require_episode()
        if self._solved is None:
            values: dict[str, Value] = dict(self._action)
            starts, step = self.index == 0 and self.model.is_temporal, max(self.index - 1, 0)
            for name in self.graph.structure.order:
                if name in values and not self.model.is_temporal:  # no step will compute it
                    values[name] = self._taken(name, values)
                elif name not in values:
                    values[name] = self._computed(name, values, step, starts)
            self._solved = values
        return self._solved

    def _taken(self, name: str, values: Values) -> Value:
        """Compute an action after interventions, clipped to its bounds."""
        shape = self.model.declared(name).shape
        where = self.compiled.actions[name]
        low, high = (end[where].reshape(shape) for end in self.compiled.action_bounds)
        return np.clip(self._computed(name, values, self.index), low, high)

    def _computed(self, name: str, values: Values, step: int, starts: bool = False) -> Value:
        """Compute one variable under the interventions in force."""
        key = NoiseKey(self.noise, self.episode, step, self._count)
        given: Any = {"previous": self._before, "key": key, "only": (name,), "begins": starts}
        found = self.graph.solve(values, **given)[name]
        return np.broadcast_to(found, (*self._lead, *self.model.declared(name).shape))
