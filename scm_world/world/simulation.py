"""A structural causal model, realised by a physics engine."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from scm_world._arguments import whole_number
from scm_world._types import ArrayLike, Floats, Value, Values
from scm_world.backends import Backend, backends, make_backend
from scm_world.backends.base import EngineSnapshot
from scm_world.errors import (
    CyclicModel,
    EngineFailure,
    InterventionError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
    WrongValue,
    in_one_line,
)
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.models import Difference, ParameterKey, Parameters, Scene, State, Structure
from scm_world.models.camera import Camera
from scm_world.models.scene import Overlap
from scm_world.tasks import Conventions, Task
from scm_world.tasks.composition import Composition
from scm_world.variables import Draw, Mechanism, Subset
from scm_world.variables.checks import check_subset
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import Audit, report
from scm_world.world.compiled_task import (
    CompiledTask,
    Options,
    StepBase,
    beginning,
    check_functions,
)
from scm_world.world.interventions import (
    CheckedRequest,
    Present,
    Solution,
    difference,
    feasible,
    overlaps,
    refusal,
    same,
)
from scm_world.world.mechanisms import Row
from scm_world.world.philox import CompiledNoise
from scm_world.world.snapshot import WorldSnapshot, opened
from scm_world.world.structures import StructureCache, as_structures, as_task
from scm_world.world.values import PresentValues

READ_BACK = 1e-6  # how far a backend may report a number from what it was given


class Simulation:
    """The causal model of a task, stepped by a physics backend; ``scm_world.World`` adds questions.

    Args:
        task: A registered name, a task, a model (a path, XML text, an ``MjSpec`` or ``MjModel``),
            or the ``structures`` of a world that was made with the same options: then they share
            what is compiled.
        backend: ``"mujoco"``, ``"bullet"``, ``"step"``, ``"fake"``, or a backend that is not used
            elsewhere; that of the task if None.
        preset: Of the robot's tasks: ``"fast"`` (4 ms physics steps) or ``"precise"`` (2 ms).
        action_mode: Of the robot's tasks: ``"joint_positions"``, ``"joint_torques"`` or
            ``"end_effector_positions"``.
        resolution: Of the robot's tasks: whether joint positions, velocities, torques and actions
            are variables of the whole robot (``"vector"``), of each ``"finger"`` or of each
            ``"joint"``. The names of the whole robot can be used at every resolution, and nothing
            that happens depends on it.
        frame_skip: Length of a control step: of the robot's tasks in units of 4 ms for every
            preset; of a model in its physics steps. The default of the task if None.
        max_episode_length: In control steps; the task's own length if None.
        conventions: ``"scm_world"``, or ``"causal_world"`` for the predecessor's.
        variables_space: The space that every target of an intervention must lie in, unless ``do``
            is given another one: ``"A"``, ``"B"``, ``"A|B"`` or a ``Subset``.
        task_options: Of the task, where it is given by its name or as a model: those of
            ``ModelTask`` for a model (``control_dt``, ``expose``, ``fixed_base``, …).

    Raises:
        UnknownOption: One of the names does not exist.
        MissingEngine: The backend is not installed.

    Example:
        >>> world = Simulation("pushing", backend="fake")
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
        task: Task | StructureCache | str = "pushing",
        *,
        backend: Backend | str | None = None,
        preset: str | None = None,
        action_mode: str | None = None,
        resolution: str | None = None,
        frame_skip: int | None = None,
        max_episode_length: int | None = None,
        conventions: str = "scm_world",
        variables_space: AnyRegion | None = None,
        **task_options: Any,
    ) -> None:
        self.variables_space = as_region("variables_space", variables_space)
        shared = task if isinstance(task, StructureCache) else None
        given = as_task(task if shared is None else shared.task, task_options)
        self.backend = _as_backend(given.backend if backend is None else backend)
        kind = given if shared is not None else given.on(self.backend)
        self.options = Options.checked(
            kind,
            preset=preset,
            action_mode=action_mode,
            resolution=resolution,
            frame_skip=frame_skip,
            max_episode_length=max_episode_length,
            conventions_name=conventions,
        )
        self.structures = as_structures(shared or kind, self.options)
        self._checked = self._closed = False
        self.version = 0  # counts changes of anything but what physics moves
        self._origin: EngineSnapshot | None = None
        self._origin_row: Row | None = None
        self._have_no_episode()
        if isinstance(self.variables_space, Subset):
            # Where variables decide which bodies there are, some may be named that are not there.
            may_come = len(self.structures.head) > 0
            check_subset(self.variables_space, self.model.variables, may_come=may_come)

    def _have_no_episode(self) -> None:
        """Be as a world is that was never reset."""
        self._started, self._lost = False, ""
        self.noise, self.episode = CompiledNoise(0), 0
        self._index = 0
        self._offset = 0  # by how much interventions have moved control_index
        self._base: StepBase | None = None
        compiled = self.structures.natural(None)
        self._values = PresentValues(compiled)
        row = beginning(compiled, None)
        self._values.put(row, [*compiled.static_names])
        self._adopt_model(compiled.model)
        self._adopt_structure(compiled.structure(row))

    @property
    def compiled(self) -> CompiledTask:
        """The task in the structure that there is."""
        return self._values.compiled

    @property
    def graph(self) -> SCM:
        """The causal model as it is now, with the parameters that ``do`` holds."""
        return self._held

    @property
    def index(self) -> int:
        """How many control steps of the episode are over."""
        return self._index

    @property
    def has_begun(self) -> bool:
        """Whether there is an episode."""
        return self._started

    def __getitem__(self, name: str) -> Value:
        """Give the present value of one variable.

        Raises:
            UnknownVariable: No variable has this name.
            NotReset: There is no episode yet.
        """
        self.model.declared(name)
        self._require_episode()
        self._values.compute()
        return np.array(self._values.now[name])

    def values(self) -> dict[str, Value]:
        """Give the present value of every variable, as copies."""
        self._require_episode()
        self._values.compute()
        return {name: np.array(self._values.now[name]) for name in self.model}

    def previous(self) -> dict[str, Value]:
        """Give the values of one control step ago that present variables depend on."""
        self._require_episode()
        declared = self.model.declared
        return {
            name: value.astype(np.float64 if declared(name).dtype == "real" else np.int64)
            for name, value in self._values.before.items()
        }

    def evaluate(self, names: tuple[str, ...]) -> dict[str, Value]:
        """Compute some variables and give all present values without copying them.

        For loops that cannot wait; the values change with the next step.

        Raises:
            NotReset: There is no episode yet.
        """
        self._require_episode()
        self._values.compute(names)
        return self._values.now

    def scene(self) -> Scene:
        """Describe the present for a picture, or for another engine."""
        self._require_episode()
        scene = self.describe(_copies(self._values.now), self._values.state.copy())
        parameters = {key: np.array(value) for key, value in scene.parameters.items()}
        return replace(scene, parameters=parameters)

    def cameras(self) -> tuple[Camera, ...]:
        """Describe the cameras whose places are variables: the three of the robot."""
        self._require_episode()
        return self.composition.cameras(_copies(self._values.now))

    def reset(
        self,
        *,
        seed: int | None = None,
        episode: int = 0,
        do: Mapping[str, Any] | None = None,
        space: AnyRegion | None = None,
    ) -> Audit | None:
        """Begin an episode. Nothing that was done in the last one remains.

        Args:
            seed: Of the noise. Without it the next episode of the same noise begins, or of a
                fresh seed if there was none.
            episode: Number of the episode, with a seed.
            do: An intervention that takes part in the beginning: a block of another size stands
                on the floor. It holds until the next reset.
            space: In which every target of it must lie; see ``do``.

        Returns:
            The audit of the intervention, or None if there was none.

        Raises:
            InterventionError: The intervention was refused. The episode has begun without it.
        """
        if seed is not None:
            self.noise = CompiledNoise(seed)
            self.episode = whole_number("episode", episode, least=0)
        elif not self._started:
            self.noise, self.episode = CompiledNoise(secrets.randbits(63)), 0
        else:
            self.episode += 1
        self._begin()
        return self.do(do, space=space) if do else None

    def _begin(self) -> None:
        self._lost, self._offset = "", 0
        origin = self.structures.natural(None)
        row = self._origin_row
        if self._started and self._origin is not None and row is not None:
            self.backend.restore(self._origin)
        else:
            row = beginning(origin, None)
            self.backend.build(origin.describe(row, origin.state_of(row)))
            self._origin, self._origin_row = self.backend.snapshot(), row
            self._started = True
        self._adopt(origin, origin.model, row)
        self._draw_nature()
        self._forget()
        if not self._checked:
            self._values.compute()
            check_functions(self.compiled, self._values.now)
            self._checked = True
        self._base = self._step_base(at_start=True)

    def _draw_nature(self) -> None:
        """Draw what is random by declaration: the noise of this episode."""
        key = self.noise_key(0)
        compiled = self.structures.natural(key)
        if not compiled.random:
            return
        row, present, base = beginning(compiled, key), self._values.row, self._step_base()
        change = difference(compiled, present, self.structure, row, present.differing(row))
        problems: list[Overlap] = []
        if change is not None and compiled.composition.solid:
            problems = overlaps(compiled, base, present, row, change)
        if problems:
            checked = CheckedRequest(
                self.structures, base, {compiled.random[0]: Draw("A")}, None, key
            )
            here = Present(self.structures, base, present, self.structure)
            raise refusal(here, checked, problems, key)
        if change is not None:
            self.backend.apply(change)
        self._adopt(compiled, compiled.model, row)

    def noise_key(self, index: int) -> NoiseKey:
        """Return the noise key of a control step of this episode.

        Noise follows the steps that were taken: an intervention on ``control_index`` leaves it.
        """
        return NoiseKey(self.noise, self.episode, index - self._offset, origin=0)

    # --- the task and the options -------------------------------------------------------------

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle through a snapshot: another backend, the same future bit for bit."""
        try:
            snapshot = self.snapshot()
        except NotReset:
            snapshot = None
        options = {
            "backend": self.backend.name,
            "preset": self.options.preset,
            "action_mode": self.action_mode,
            "frame_skip": self.frame_skip,
            "max_episode_length": self.given_length,
            "conventions": self.conventions.name,
            "variables_space": self.variables_space,
        }
        usual = self.task.choices["resolution"][0]
        if self.resolution != usual:  # logs and files of before have none
            options["resolution"] = self.resolution
        return _copied, (type(self), self.structures.task, options, snapshot)

    @property
    def engine(self) -> str:
        """Name and version of the physics engine."""
        return f"{self.backend.name} {self.backend.version}"

    @property
    def task(self) -> Task:
        """The task, with its present plan."""
        return self.compiled.task

    @property
    def model(self) -> SCM:
        """The causal model of the present structure, without interventions."""
        return self.compiled.model

    @property
    def composition(self) -> Composition:
        """The entities."""
        return self.compiled.composition

    @property
    def slices(self) -> Mapping[str, slice]:
        """Where each state stands in the state vector."""
        return self.compiled.slices

    @property
    def parameter_keys(self) -> Mapping[str, ParameterKey]:
        """Which physical parameter each variable sets."""
        return self.compiled.parameter_keys

    @property
    def static_names(self) -> tuple[str, ...]:
        """Everything that interventions alone decide, causes before effects."""
        return self.compiled.static_names

    @property
    def computed(self) -> tuple[str, ...]:
        """Variables that are computed from what moves, causes before effects."""
        return self.compiled.computed

    @property
    def conventions(self) -> Conventions:
        """Ours or the predecessor's."""
        return self.options.conventions

    @property
    def action_mode(self) -> str:
        """How the system is commanded."""
        return self.options.action_mode

    @property
    def resolution(self) -> str:
        """How finely the variables are cut."""
        return self.options.resolution

    @property
    def frame_skip(self) -> int:
        """Length of a control step in units of the task; 4 ms for the robot."""
        return self.options.frame_skip

    @property
    def control_period(self) -> float:
        """Length of a control step [s]."""
        return self.options.control_period

    @property
    def given_length(self) -> int | None:
        """Length of an episode in control steps, if one was given."""
        return self.options.given_length

    @property
    def max_episode_length(self) -> int:
        """Length of an episode in control steps."""
        return self.structures.steps

    @property
    def action_low(self) -> Floats:
        """Lower end of all actions, shape (n_actions,)."""
        return self.compiled.action_bounds[0]

    @property
    def action_high(self) -> Floats:
        """Upper end of all actions, shape (n_actions,)."""
        return self.compiled.action_bounds[1]

    @property
    def action_space(self) -> gymnasium.spaces.Box:
        """The space of actions in SI units."""
        low, high = self.compiled.action_bounds
        return gymnasium.spaces.Box(low, high, dtype=np.float64)

    @property
    def observation_space(self) -> gymnasium.spaces.Dict:
        """The space of the observed variables by name, in SI units; nothing is clipped."""
        names = (part.variable for part in self.task.observation.rows)
        shapes = {name: self.model.declared(name).shape for name in names}
        return gymnasium.spaces.Dict(
            {
                name: gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)
                for name, shape in shapes.items()
            }
        )

    @property
    def identity(self) -> tuple[Any, ...]:
        """What two worlds have in common if one can take up a snapshot of the other."""
        return (*self._settings, self.structures.digest)

    @property
    def _settings(self) -> tuple[Any, ...]:
        numbers = (self.frame_skip, self.max_episode_length)
        options = (self.options.preset, self.action_mode, self.conventions.name)
        usual = self.task.choices["resolution"][0]
        finer = () if self.resolution == usual else (self.resolution,)
        return (self.task.name, *options, *numbers, *finer)

    def __fingerprint__(self) -> dict[str, Any]:
        """Return what decides what happens here, except versions: the task, and the options."""
        options = (self.backend.name, self.variables_space, self._settings)
        return {**self.structures.__fingerprint__(), "options": options}

    def describe(self, values: Values, state: State) -> Scene:
        """Describe the scene that some values stand for."""
        return self.compiled.describe(values, state)

    def static_order(self, targets: Iterable[str]) -> tuple[str, ...]:
        """Name some variables and what follows them at lag 0, without physics, causes first."""
        return self.compiled.static_order(targets)

    # --- a control step -----------------------------------------------------------------------

    def step(self, action: ArrayLike) -> None:
        """Advance one control step.

        Args:
            action: All actions in their order, shape (n_actions,) in SI units. Numbers outside
                the action's range are clipped to it.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
            NotReset: There is no episode yet.
            EngineFailure: The backend lost the state.
        """
        self.advance(self.compiled.clipped(action))

    def advance(self, command: Floats) -> None:
        """Advance one control step with finite numbers in their range; see ``step``."""
        self._require_state()
        command = self.decided(command)
        values = self._values
        kept = values.matrix.copy()
        values.remember()
        values.action[:] = command
        try:
            sent = self.command(command, self._index)
            self.backend.step(sent, self._substeps)
        except EngineFailure as error:
            left = self.compiled.empty_state()
            self.backend.read(left)
            if np.isfinite(left.vector).all():  # nothing has happened
                values.matrix[...] = kept
                values.be_at(self._index)
                raise
            said = f"{error}; {self._largest()}" if left.vector.size else str(error)
            self._lost = f"the state was lost in control step {self._index}: {said}"
            raise EngineFailure(self._lost, self.backend.name) from error
        self.backend.read(values.state)
        self.arrive(self._index + 1)

    def _largest(self) -> str:
        """Name the state with the largest number, as it was before a step."""
        vector = self._values.state.vector
        worst = int(np.abs(vector).argmax())
        places = self.composition.system.layout.slices.items()
        name = next((name for name, where in places if where.start <= worst < where.stop), "")
        return f"before that step, the largest number was {vector[worst]:.3g}, of {name}"

    def arrive(self, index: int) -> None:
        """Be at the next control step; where everything is has been written already."""
        self._index = index
        self._values.be_at(index)
        self._base = None

    def decided(self, command: Floats) -> Floats:
        """Return the action that is taken: the command, where no action has a mechanism."""
        held = self._held_actions
        if not held:
            return command
        given = self.compiled.split(command)
        known = {**self.evaluate(self._inputs), **given}
        solved = self._held.solve(known, key=self.noise_key(self._index), only=held)
        command = command.copy()
        for name in held:
            command[self.compiled.actions[name]] = np.ravel(solved[name])
        return self.compiled.clipped(command)

    def command(self, action: Floats, index: int) -> Floats:
        """Compute the command of an action in a control step; it is valid until the next call."""
        commands = self.composition.commands
        if commands is None or not self.translates:
            return action
        values = self._values
        return commands.command(action, values.now, values.state.vector, self.noise_key(index))

    @property
    def substeps(self) -> int:
        """The physics steps of a command."""
        return self._substeps

    @property
    def holds_action(self) -> bool:
        """Whether an action has a mechanism, or a value of its own."""
        return bool(self._held_actions)

    # --- interventions ------------------------------------------------------------------------

    def do(
        self,
        request: Mapping[str, Any],
        *,
        space: AnyRegion | None = None,
        check: Callable[[], object] | None = None,
    ) -> Audit:
        """Intervene now, without advancing time. All of it happens, or none of it.

        A parameter holds until the reset; a state is set at this instant and physics carries it
        on. Interventions at one instant add up to one: taking one back leaves no trace.

        Args:
            request: Values, ``Shift``, ``Scale`` or ``Draw`` by name, dotted or nested.
            space: If given, every target must lie in this space: ``"A"``, ``"B"``, ``"A|B"`` or
                a ``Subset``; ``variables_space`` of the world if None.
            check: Called when it is done. If it raises, nothing is done, and the error goes on.

        Returns:
            What was requested, applied and read back, and what followed.

        Raises:
            InterventionError: The request was refused; the world is bit-identical to before.
            NotReset: There is no episode yet.
        """
        if not self._started or self._lost:
            self._require_state()
        twice: list[InterventionError] = []
        flat = flatten(request, twice)
        base, drawn = self._base or self._step_base(), dict[str, int]()
        if any(isinstance(act, Draw | Mechanism) for act in flat.values()):
            twice += self._wrong_actions(flat)
            flat, drawn = self._anew(flat, base)
        region = self.variables_space if space is None else as_region("space", space)
        key = self.noise_key(self._index)
        here = Present(self.structures, base, self._values.row, self.structure)
        solution, change = feasible(here, flat, region, key, twice)
        audit = self._commit(solution, change, flat, check, at_start=base.at_start)
        self._base = StepBase(
            base.compiled, base.model, base.row, solution.kept(), drawn or base.drawn, base.at_start
        )
        return audit

    def _anew(
        self, request: Mapping[str, Any], base: StepBase
    ) -> tuple[dict[str, Any], dict[str, int]]:
        """Give draws noise that no earlier draw of the variable had at this instant.

        Returns:
            The request, and how often each variable has been drawn then.
        """
        drawn, found = dict(base.drawn), dict(request)
        for name, act in request.items():
            if not (isinstance(act, Draw) and act.stream is None and act.of is None):
                continue
            nature = base.at_start and name in base.compiled.random
            times = drawn.get(name, int(nature))
            drawn[name] = times + 1
            if times:
                found[name] = act.model_copy(update={"stream": f"draw {times}"})
        return found, drawn

    def _wrong_actions(self, request: Mapping[str, Any]) -> list[InterventionError]:
        """List mechanisms of actions that give no action at this instant."""
        problems: list[InterventionError] = []
        for name, act in request.items():
            if not isinstance(act, Mechanism) or name not in self.model:
                continue
            targets, parents = self.model.targets(name), [p.name for p in act.parents if not p.lag]
            known = len(parents) == len(act.parents) and all(p in self.model for p in parents)
            if not known or not self.compiled.actions.keys() >= {*targets}:
                continue  # parents are refused with the reason
            try:
                model, values = (
                    self.model.with_interventions({name: act}),
                    self.evaluate((*parents,)),
                )
                for target in targets:
                    value, declared = model.evaluate(target, values), model.declared(target)
                    if np.shape(value) != declared.shape:
                        raise WrongValue(name, act, declared.shape, np.shape(value))
                    if not np.isfinite(value).all():
                        raise WrongValue(name, value)
            except CyclicModel:
                continue  # refused with the reason
            except InterventionError as problem:
                problems.append(problem)
            except Exception as error:
                said = f"do({name}): its function raised {in_one_line(error)}"
                problems.append(InterventionError(said, variable=name, value=act))
        return problems

    def _step_base(self, *, at_start: bool = False) -> StepBase:
        row = Row(self.compiled.mechanisms, self._values.row.numbers.copy())
        return StepBase(self.compiled, self._held, row, at_start=at_start)

    def _commit(
        self,
        solution: Solution,
        change: Difference | None,
        request: Mapping[str, Any],
        check: Callable[[], object] | None,
        *,
        at_start: bool,
    ) -> Audit:
        """Apply what was computed, read it back, and report; or put everything back and raise."""
        before, index = self._step_base(), self._index

        def undo() -> None:
            there = solution.compiled.structure(solution.row)
            lost = difference(before.compiled, solution.row, there, before.row, solution.changed)
            if lost is not None:
                self.backend.apply(lost)

        with self._all_or_nothing(before, undo):
            inertia: Parameters = {}
            reported: Parameters = {}
            if change is not None:
                inertia = self._inertia(change)
                self.backend.apply(change)
                reported = self._applied(change)
            row, changed = solution.row, solution.changed
            stays = solution.compiled is self.compiled and row[CONTROL_INDEX] == index
            if stays and change is None and not changed:
                self._adopt_model(solution.model)
                self.version += 1
            else:
                self._adopt(solution.compiled, solution.model, row, changed, change)
            now = self._values.row
            audit = report(request, solution, change, before, now, inertia, reported, self.backend)
            self._offset += self._index - index
            if at_start and not (stays and change is None and not changed):
                self._forget()
            if check is not None:
                check()
        return audit

    @contextmanager
    def _all_or_nothing(self, before: StepBase, undo: Callable[[], None]) -> Iterator[None]:
        """Put everything back as it was before, should something fail half way."""
        kept, offset = self._values, self._offset
        try:
            yield
        except BaseException:
            undo()
            self._values = kept
            self._adopt(before.compiled, before.model, before.row, moved=False)
            self._offset = offset
            raise

    def _inertia(self, change: Difference) -> Parameters:
        bodies = {body for body, what in change.parameters if what in ("mass", "size")}
        if change.structure is not None or not bodies:
            return {}
        if not self.compiled.movers:
            return {}
        bodies -= {*self.composition.bodies} - self.compiled.movers
        return dict(self.backend.parameters((body, "inertia") for body in sorted(bodies)))

    def _applied(self, change: Difference) -> Parameters:
        """Read back what was applied."""
        reported = self.backend.parameters(change.parameters)
        values = change.parameters.items()
        wrong = [".".join(key) for key, value in values if not _close(value, reported[key])]
        if change.state is not None:
            got = change.state.copy()
            self.backend.read(got)
            if not _close(change.state.settable(), got.settable()):
                wrong.append("the state")
        if wrong:
            problem = f"the engine did not take over {', '.join(wrong)}"
            raise EngineFailure(problem, self.backend.name)
        return reported

    def _adopt(
        self,
        compiled: CompiledTask,
        model: SCM,
        row: Row,
        changed: list[str] | None = None,
        change: Difference | None = None,
        *,
        moved: bool = True,
    ) -> None:
        """Take over what an intervention decided; the backend has taken over its part.

        Args:
            compiled: The task in the structure that there is now.
            model: With the interventions that hold.
            row: The values.
            changed: What only interventions decide and differs from the present, if known.
            change: What the backend had to change.
            moved: Whether the backend reports where everything is; else the row does.
        """
        last = self._values
        if changed is None:
            changed, structure = last.row.differing(row), compiled.structure(row)
        else:
            structure = change.structure if change and change.structure else self.structure
        if compiled is not last.compiled:
            self._values, changed = PresentValues(compiled), [*compiled.static_names]
        values = self._values
        values.put(row, changed)
        self._adopt_model(model)
        if changed or values is not last:
            self._adopt_structure(structure)
        self.version += 1
        if moved:
            self.backend.read(values.state)
        self._index = int(values.row[CONTROL_INDEX])
        if values is not last:
            self._forget()
            for name in last.before.keys() & values.before.keys():
                values.before[name][...] = last.before[name]

    def _adopt_structure(self, structure: Structure) -> None:
        commands = self.composition.commands
        self.translates = commands is not None and commands.applies(self._values.row)
        self.structure = structure
        self._substeps = max(1, round(self.control_period / float(structure.timestep)))

    def _adopt_model(self, model: SCM) -> None:
        self._held, held = model, model.interventions
        self._held_actions = tuple(name for name in self.compiled.actions if name in held)
        acts = (held[name] for name in self._held_actions)
        self._inputs = tuple(p.name for a in acts if isinstance(a, Mechanism) for p in a.parents)

    def _forget(self) -> None:
        """Take the present as the step before, where there is none."""
        self._values.compute(())
        self._values.remember()

    # --- state ------------------------------------------------------------------------

    @property
    def numbers(self) -> Floats:
        """The present as one row of numbers, shape (1, width); see ``Mechanisms.where``."""
        return self._values.matrix

    @property
    def vector(self) -> Floats:
        """The live state, flat, shape (size,)."""
        return self._values.state.vector

    def move(self, matrix: Floats) -> None:
        """Keep the present in another matrix from now on, shape (1, width)."""
        self._values.move(matrix)

    def current(self) -> tuple[Values, State]:
        """Return the live values and the live state; both change with the next step."""
        return self._values.now, self._values.state

    def snapshot(self) -> WorldSnapshot:
        """Save everything that decides the future of the world. It can be pickled.

        Raises:
            NotReset: There is no episode yet.
            EngineFailure: The backend has lost the state.
        """
        self._require_state()
        return WorldSnapshot(
            engine=self.backend.snapshot(),
            present=self._step_base(),
            base=self._base,
            index=self._index,
            offset=self._offset,
            seed=self.noise.seed,
            episode=self.episode,
            world=self.identity,
        )

    def restore(self, snapshot: WorldSnapshot) -> None:
        """Go back to a snapshot, bit for bit.

        Raises:
            SnapshotMismatch: It is one of another task or backend, or damaged. The world is as it
                was.
            EngineFailure: The backend failed on the way; the world needs a reset or a snapshot.
        """
        if not isinstance(snapshot, WorldSnapshot):
            raise SnapshotMismatch(f"{snapshot!r} is no snapshot of a world")
        if snapshot.world != self.identity:
            raise SnapshotMismatch(
                "the snapshot is one of another task, of other arguments of it or of other options"
            )
        if not self._started:
            self._begin()
        before = self.backend.snapshot() if isinstance(snapshot.engine, bytes) else None

        def undo() -> None:
            if before is not None:
                self.backend.restore(before)
            else:
                self._lost = "a snapshot was restored in part"

        try:
            engine, base = snapshot.unpacked(self.structure), snapshot.base
            engine.opened(self.backend)
            present = opened(snapshot.present, self.structures)
            base = base if base is None else opened(base, self.structures)
            noise = CompiledNoise(snapshot.seed)
            with self._all_or_nothing(self._step_base(), undo):
                self.backend.restore(engine)
                self._adopt(present.compiled, present.model, present.row, moved=False)
                self._values.matrix[0] = present.row.numbers
                self._values.be_at(self._index)
        except (SnapshotMismatch, EngineFailure):
            raise
        except Exception as error:
            raise SnapshotMismatch(f"the snapshot is damaged: {in_one_line(error)}") from error
        self._lost, self._offset = "", snapshot.offset
        self.noise, self.episode = noise, snapshot.episode
        self._base = base

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Go back to the present afterwards, bit for bit, also after an error or Ctrl-C.

        A world without an episode has none afterwards. One whose backend has lost the state still
        needs a reset or a snapshot.

        Example:
            >>> world = Simulation("pushing", backend="fake")
            >>> world.reset(seed=5)
            >>> with world.unchanged():
            ...     world.reset(seed=0)
            ...     world.step(np.zeros(9))
            >>> world.noise.seed, world.index
            (5, 0)
        """
        started, lost = self._started, self._lost
        noise = self.noise, self.episode, self._index, self._offset
        before = self.snapshot() if started and not lost else None
        try:
            yield
        finally:
            if before is not None:
                self.restore(before)
            elif not started:
                self._have_no_episode()
            else:
                self._lost, self._base = lost, None
                self.noise, self.episode, self._index, self._offset = noise

    def close(self) -> None:
        """Free the engine. There is no episode any more."""
        self._closed |= self._started
        self._started = False
        self.backend.close()

    def _require_episode(self) -> None:
        if not self._started:
            raise NotReset(closed=self._closed)

    def _require_state(self) -> None:
        """Refuse to continue without an episode, or from a state that the backend has lost."""
        self._require_episode()
        if self._lost:
            advice = "reset the world, or restore a snapshot"
            raise EngineFailure(f"{self._lost}; {advice}", self.backend.name)


def _copied(kind: Any, task: Task, options: Mapping[str, Any], snapshot: Any) -> Any:
    world = kind(task, **options)
    if snapshot is not None:
        world.restore(snapshot)
    return world


def _copies(values: Values) -> dict[str, Value]:
    return {name: np.array(value) for name, value in values.items()}


def _close(given: Floats, reported: Floats) -> bool:
    if same(given, reported):
        return True
    return bool(np.all(np.abs(given - reported) <= READ_BACK * np.maximum(1.0, np.abs(given))))


def _as_backend(backend: Any) -> Backend:
    """Return a backend, or make the one of a name."""
    if isinstance(backend, Backend):
        return backend
    if isinstance(backend, str):
        return make_backend(backend)
    raise UnknownOption("backend", backend, (*backends(), "a backend that is made"))
