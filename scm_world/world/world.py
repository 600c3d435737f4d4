"""A structural causal model, realised by a physics engine."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from typing import Any

import numpy as np

from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.backends import Backend
from scm_world.errors import NotReset, SnapshotMismatch
from scm_world.graph import SCM, Moment
from scm_world.models import Scene, State
from scm_world.models.camera import Camera
from scm_world.tasks import Task
from scm_world.variables import Noise
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import Audit
from scm_world.world.commands import clipped
from scm_world.world.commit import commit, difference, feasible, refuse_overlaps
from scm_world.world.declaration import Declaration, Options
from scm_world.world.family import Family, as_family
from scm_world.world.following import policy_inputs
from scm_world.world.proposal import Instant, Proposal
from scm_world.world.snapshot import SavedInstant, WorldSnapshot
from scm_world.world.start import (
    beginning,
    check_functions,
    check_held,
    the_backend,
    the_task,
    whole_number,
)
from scm_world.world.stepping import Stepped


class World(Stepped):
    """A task as a causal model, with an engine that moves it.

    Args:
        task: A registered name, a task, or the ``family`` of a world that was made with the same
            options: then they share what is declared.
        backend: ``"mujoco"``, ``"bullet"``, ``"step"``, ``"fake"``, or an engine that is not used
            elsewhere; that of the task if None.
        preset: Of the robot's tasks: ``"fast"`` (4 ms physics steps) or ``"precise"`` (2 ms).
        action_mode: Of the robot's tasks: ``"joint_positions"``, ``"joint_torques"`` or
            ``"end_effector_positions"``.
        resolution: Of the robot's tasks: whether joint positions, velocities, torques and actions
            are variables of the whole robot (``"vector"``), of each ``"finger"`` or of each
            ``"joint"``. The names of the whole robot can be used at every resolution, and nothing
            that happens depends on it.
        frame_skip: Length of a control step: of the robot's tasks in units of 4 ms, whatever the
            preset; of a model in its physics steps. The default of the task if None.
        max_episode_length: In control steps; the task's own length if None.
        conventions: ``"scm_world"``, or ``"causal_world"`` for the predecessor's.
        variables_space: The space that every target of an intervention must lie in, unless ``do``
            is told another one: ``"A"``, ``"B"``, ``"A|B"`` or a ``Subset``.

    Raises:
        UnknownOption: One of the names does not exist.
        MissingEngine: The engine is not installed.

    Example:
        >>> world = World("pushing", backend="fake")
        >>> world.reset(seed=0)
        >>> audit = world.do({"block.size": [0.07, 0.07, 0.07]})
        >>> world["goal_block.cartesian_position"].round(3)
        array([0.   , 0.08 , 0.035])
        >>> world.step(np.zeros(9))
        >>> int(world["control_index"])
        1
    """

    def __init__(
        self,
        task: Task | Family | str = "pushing",
        *,
        backend: Backend | str | None = None,
        preset: str | None = None,
        action_mode: str | None = None,
        resolution: str | None = None,
        frame_skip: int | None = None,
        max_episode_length: int | None = None,
        conventions: str = "scm_world",
        variables_space: AnyRegion | None = None,
    ) -> None:
        self.variables_space = as_region("variables_space", variables_space)
        given = task.task if isinstance(task, Family) else the_task(task)
        self.backend = the_backend(backend, given.backend)
        kind = given if isinstance(task, Family) else given.on(self.backend)
        self.options = Options.checked(
            kind,
            preset=preset,
            action_mode=action_mode,
            resolution=resolution,
            frame_skip=frame_skip,
            max_episode_length=max_episode_length,
            conventions_name=conventions,
        )
        self.family = as_family(task if isinstance(task, Family) else kind, self.options)
        self._started = self._checked = False
        self.noise, self.episode = Noise(0), 0
        self.version = 0  # counts changes of anything but what physics moves
        self._static: Values = {}
        self._held_actions: tuple[str, ...] = ()
        self._translates = False
        self._inputs: tuple[str, ...] = ()
        self._index = 0
        self._instant: Instant | None = None
        self._enter(self.family.natural(None))
        self._held = self.model
        check_held(self.variables_space, self.family)
        self.structure = self.declaration.structure(self.model.solve(only=self.static_names))

    @property
    def graph(self) -> SCM:
        """The causal model as it is now, with the parameters that ``do`` holds."""
        return self._held

    @property
    def index(self) -> int:
        """How many control steps of the episode are over."""
        return self._index

    def __getitem__(self, name: str) -> Value:
        """Give the present value of one variable.

        Raises:
            UnknownVariable: No variable has this name.
            NotReset: There is no episode yet.
        """
        self.model.declared(name)
        self._require_episode()
        self._compute()
        return np.array(self._now[name])

    def values(self) -> dict[str, Value]:
        """Give the present value of every variable, as copies."""
        self._require_episode()
        self._compute()
        return {name: np.array(self._now[name]) for name in self.model}

    def previous(self) -> dict[str, Value]:
        """Give the values of one control step ago that present variables depend on."""
        self._require_episode()
        declared = self.model.declared
        return {
            name: value.astype(np.float64 if declared(name).dtype == "real" else np.int64)
            for name, value in self._before.items()
        }

    def evaluate(self, names: tuple[str, ...]) -> dict[str, Value]:
        """Compute some variables and give all present values without copying them.

        For loops that cannot wait; the values change with the next step.

        Raises:
            NotReset: There is no episode yet.
        """
        self._require_episode()
        self._compute(names)
        return self._now

    def scene(self) -> Scene:
        """Describe the present for a picture, or for another engine."""
        self._require_episode()
        return self.describe(self._now, self._state.copy())

    def cameras(self) -> tuple[Camera, ...]:
        """Describe the cameras whose places are variables: the three of the robot."""
        self._require_episode()
        return self.composition.cameras(self._now)

    def reset(
        self, *, seed: int | None = None, episode: int = 0, do: Mapping[str, Any] | None = None
    ) -> Audit | None:
        """Begin an episode. Nothing that was done in the last one remains.

        Args:
            seed: Of the noise. Without it the next episode of the same noise begins, or of a
                fresh seed if there was none.
            episode: Number of the episode, with a seed.
            do: An intervention that takes part in the beginning: a block of another size stands
                on the floor. It holds until the next reset.

        Returns:
            The audit of the intervention, or None if there was none.

        Raises:
            InterventionError: The intervention was refused. The episode has begun without it.
        """
        if seed is not None:
            self.noise = Noise(whole_number("seed", seed, least=0))
            self.episode = whole_number("episode", episode, least=0)
        elif not self._started:
            self.noise, self.episode = Noise(secrets.randbits(63)), 0
        else:
            self.episode += 1
        self._begin()
        return self.do(do) if do else None

    def _begin(self) -> None:
        self._lost = ""
        origin = self.family.natural(None)
        if self._started:
            self.backend.restore(self._origin.unpacked(self.structure))
        else:
            self._build(origin)
        self._action[:] = 0.0
        self.adopt(origin, origin.model, self._origin.static, 0)
        self._draw_nature()
        self._forget()
        if self.task.checks_functions and not self._checked:
            self._compute()
            check_functions(self.declaration, self._now)
            self._checked = True
        self._instant = self._present(at_start=True)

    def _build(self, origin: Declaration) -> None:
        static, state = beginning(origin, None)
        self.backend.build(origin.describe(static, state))
        self._origin = WorldSnapshot(engine=self.backend.snapshot(), static=static)
        self._started = True

    def _draw_nature(self) -> None:
        """Draw what is random by declaration: the noise of this episode."""
        moment = self.moment(0)
        declaration = self.family.natural(moment)
        if not declaration.random:
            return
        static, state = beginning(declaration, moment)
        model = declaration.model
        drawn = Proposal(declaration, model, static, state, 0, {}, declaration.random[:1])
        change = difference(self, drawn)
        if declaration.composition.solid:
            refuse_overlaps(self, self._present(), drawn, change, declaration.random[0])
        if change:
            self.backend.apply(change)
        self.adopt(declaration, model, static, 0)

    def moment(self, index: int) -> Moment:
        """Say where in the noise a control step of this episode draws."""
        return Moment(self.noise, self.episode, index, origin=0)

    def step(self, action: ArrayLike) -> None:
        """Advance one control step.

        Args:
            action: All actions in their order, shape (n_actions,) in SI units. Numbers outside
                the action's range are clipped to it.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
            NotReset: There is no episode yet.
            EngineFailure: The engine lost the state.
        """
        self.advance(clipped(action, *self.declaration.action_bounds, self.declaration.action_unit))

    def do(self, request: Mapping[str, Any], *, space: AnyRegion | None = None) -> Audit:
        """Intervene now, without advancing time. All of it happens, or none of it.

        A parameter holds until the reset; a state is set at this instant and physics carries it
        on. Interventions at one instant add up to one: taking one back leaves no trace.

        Args:
            request: Values, ``Shift``, ``Scale`` or ``Draw`` by name, dotted or nested.
            space: If given, every target must lie in this space: ``"A"``, ``"B"``, ``"A|B"`` or
                a ``Subset``; ``variables_space`` of the world if None.

        Returns:
            What was requested, applied and read back, and what followed.

        Raises:
            InterventionError: The request was refused; the world is bit-identical to before.
            NotReset: There is no episode yet.
        """
        self._require_episode()
        self._refuse_lost()
        instant = self._instant or self._present()
        space = self.variables_space if space is None else space
        proposal, change = feasible(self, instant, request, space)
        audit, self._instant = commit(self, instant, proposal, change, request)
        if instant.at_start:
            self._forget()
        return audit

    def _present(self, *, at_start: bool = False) -> Instant:
        state = self._state.copy()
        return Instant(
            self.declaration, self._held, self._static, state, self._index, at_start=at_start
        )

    def adopt(
        self,
        declaration: Declaration,
        model: SCM,
        static: Values,
        index: int,
        state: State | None = None,
    ) -> None:
        """Take over what an intervention decided; the engine has taken over its part.

        Args:
            declaration: Of the structure that there is now.
            model: With the interventions that hold.
            static: Values of everything that physics does not move.
            index: The control step.
            state: Where everything is; what the engine reports if None.
        """
        earlier, action = dict(self._before), self._action
        changed = declaration is not self.declaration
        if changed:
            self._enter(declaration)
            if self._action.shape == action.shape:
                self._action[:] = action
        row, where = self._matrix[0], declaration.mechanisms.where
        if static is not self._static:
            for name, value in static.items():
                if value is not self._static.get(name):
                    row[where[name]] = np.ravel(value)
            self._now.update(static)
        self._held, self._static = model, static
        held = model.interventions
        self._held_actions = tuple(name for name in declaration.actions if name in held)
        self._inputs = policy_inputs(model, self._held_actions)
        commands = declaration.composition.commands
        self._translates = commands is not None and commands.applies(static)
        self.structure = declaration.structure(static)
        timestep = declaration.composition.timestep(static)
        self._substeps = max(1, round(self.control_period / timestep))
        self.version += 1
        if state is None:
            self.backend.read(self._state)
        else:
            self._state.vector[:] = state.vector
        self._be_at(index)
        if changed:
            self._forget()
            for name in earlier.keys() & self._before.keys():
                self._before[name][...] = earlier[name]

    def _enter(self, declaration: Declaration) -> None:
        """Make room for the values of a structure; actions are those of the last step."""
        self.declaration = declaration
        self._static = {}
        self._occupy(declaration.mechanisms.start[None].copy())

    def move(self, matrix: Floats) -> None:
        """Keep the present in another matrix from now on, shape (1, width)."""
        matrix[...] = self._matrix
        self._occupy(matrix)

    def _occupy(self, matrix: Floats) -> None:
        """Look at the values in a matrix from now on, by views."""
        self._matrix = matrix
        row, mechanisms = matrix[0], self.declaration.mechanisms
        self._state = self.declaration.empty_state(row[: mechanisms.state_size])
        self._action, self._clock = row[mechanisms.actions], row[mechanisms.where[CONTROL_INDEX]]
        self._now: dict[str, Value] = {n: mechanisms.view(row, n) for n in mechanisms.where}
        counted = {n: (self._now[n].astype(np.int64), self._now[n]) for n in mechanisms.whole}
        self._counted = tuple(counted.values())
        self._now |= {name: whole for name, (whole, _) in counted.items()} | dict(self._static)
        self._before = {n: mechanisms.view(row, n, earlier=True) for n in mechanisms.earlier}

    @property
    def numbers(self) -> Floats:
        """The present as one row of numbers, shape (1, width); see ``Mechanisms.where``."""
        return self._matrix

    @property
    def vector(self) -> Floats:
        """The live state, flat, shape (size,)."""
        return self._state.vector

    def current(self) -> tuple[Values, State]:
        """Give the live values and the live state, for the parts of a ``do``."""
        return self._now, self._state

    def snapshot(self) -> WorldSnapshot:
        """Save everything that decides how the world goes on. It can be pickled."""
        self._require_episode()
        return WorldSnapshot(
            engine=self.backend.snapshot(),
            static=self._static,
            interventions=self._held.interventions,
            previous=self.previous(),
            action=np.array(self._action),
            index=self._index,
            seed=self.noise.seed,
            episode=self.episode,
            world=self.identity,
            instant=None if self._instant is None else SavedInstant.of(self._instant),
            plan=self.declaration.plan,
        )

    def restore(self, snapshot: WorldSnapshot) -> None:
        """Go back to a snapshot, bit for bit.

        Raises:
            SnapshotMismatch: It is one of another task or engine.
        """
        if not isinstance(snapshot, WorldSnapshot):
            raise SnapshotMismatch(f"{snapshot!r} is no snapshot of a world")
        if snapshot.world != self.identity:
            raise SnapshotMismatch("the snapshot is one of another task, or of other options")
        if not self._started:
            self._begin()
        self.backend.restore(snapshot.unpacked(self.structure))
        self._lost = ""
        self.noise, self.episode = Noise(snapshot.seed), snapshot.episode
        declaration = self.family.declaration(snapshot.plan)
        held = declaration.model.with_interventions(snapshot.interventions)
        self.adopt(declaration, held, snapshot.static, snapshot.index)
        self._action[:] = snapshot.action
        for name, value in snapshot.previous.items():
            self._before[name][...] = value
        saved = snapshot.instant
        self._instant = None if saved is None else saved.instant(self.family)

    def close(self) -> None:
        """Free the engine. There is no episode any more."""
        self._started = False
        self.backend.close()

    def _require_episode(self) -> None:
        if not self._started:
            raise NotReset
