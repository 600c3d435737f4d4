"""A structural causal model, realised by a physics engine."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._types import ArrayLike, Floats, Value
from scm_world.backends import Backend, backends, make_backend, require_exact
from scm_world.backends.base import ContactPoint
from scm_world.errors import (
    EngineFailure,
    Infeasible,
    InterventionError,
    SnapshotMismatch,
    UnknownOption,
    in_one_line,
)
from scm_world.graph import SCM, NoiseKey, flatten
from scm_world.models import Difference, Parameters, Scene, Structure
from scm_world.models.camera import Camera
from scm_world.tasks import AnySource, Options, Task, make_task
from scm_world.tasks.composition import Composition, Held, parts
from scm_world.tasks.model import REWARD, START
from scm_world.tasks.rewards import FRACTION, SUCCESS
from scm_world.variables import Draw, Hard, Intervention, Subset
from scm_world.variables.checks import check_subset
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world.audit import Audit, report
from scm_world.world.compiled_task import (
    CompiledTask,
    beginning,
    check_functions,
)
from scm_world.world.interventions import (
    Level,
    Transaction,
    difference,
    feasible,
    overlaps,
    renewed,
    stacked,
)
from scm_world.world.mechanisms import Rows
from scm_world.world.philox import CompiledNoise
from scm_world.world.snapshot import Base, Snapshot
from scm_world.world.structures import StructureCache, structures_of
from scm_world.world.system import CausalSystem

if TYPE_CHECKING:
    from scm_world.world.row_memory import RowMemory

READ_BACK = 1e-6  # tolerance for numbers that a backend reports, relative and absolute


class Simulation(CausalSystem):
    """The causal model of a task, stepped by a physics backend; ``scm_world.World`` adds questions.

    Args:
        task: A registered name, a task, a model (a path, XML text, an ``MjSpec`` or ``MjModel``),
            or the ``structures`` of a world with the same options, to share compiled tasks.
        backend: ``"mujoco"``, ``"bullet"``, ``"warp"``, ``"step"``, ``"fake"``, or a backend that
            is not used elsewhere; the default of the task if None.
        device: ``"cpu"``, ``"cuda"`` or one of several GPUs, for an engine with devices:
            ``backend="warp", device="cpu"`` is ``backend="warp:cpu"``.
        preset: For the robot's tasks ``"fast"`` (4 ms physics steps) or ``"precise"`` (2 ms).
        action_mode: For the robot's tasks ``"joint_positions"``, ``"joint_torques"`` or
            ``"end_effector_positions"``.
        resolution: For the robot's tasks: whether joint positions, velocities, torques and actions
            are variables of the whole robot (``"vector"``), of each ``"finger"`` or of each
            ``"joint"``. The names of the whole robot can be used at every resolution, and the
            simulation does not depend on it.
        frame_skip: Length of a control step: for the robot's tasks in units of 4 ms with every
            preset, for a model in its physics steps. The default of the task if None.
        max_episode_length: Length of an episode in control steps; the task's own length if None.
        conventions: ``"scm_world"``, or ``"causal_world"`` for the predecessor's.
        variables_space: Space in which every target of an intervention must lie, unless ``do``
            is given another one: ``"A"``, ``"B"``, ``"A|B"`` or a ``Subset``.
        task_options: Options of a task that is given by its name or as a model: those of
            ``ModelTask`` for a model (``control_dt``, ``expose``, ``fixed_base``, …).

    Attributes:
        task: The task, with its present plan.
        composition: The entities.
        static_names: Variables that only interventions change, causes before effects.
        vector: The live state, flat, shape (size,).

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

    compiled: CompiledTask
    composition: Composition
    task: Task
    static_names: tuple[str, ...]
    backend: Backend
    vector: Floats
    last: Transaction  # the last intervention
    keeps_draws = True
    is_planned = False  # whether the present episode has planned interventions
    acts_alone = False  # whether the backend's command depends on present values, too

    @typed
    def __init__(
        self,
        task: AnySource | StructureCache = "pushing",
        *,
        backend: Backend | str | None = None,
        device: str | None = None,
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
        source: Any = task if shared is None else shared.task
        given = make_task(source, **task_options)
        engine: Any = given.backend if backend is None else backend
        if not isinstance(engine, Backend | str):
            raise UnknownOption("backend", engine, (*backends(), "a Backend instance"))
        if device is not None:
            if not isinstance(engine, str) or ":" in engine:
                raise UnknownOption("device beside this backend", device, ("left out",))
            engine = f"{engine}:{device}"
        self.backend = make_backend(engine) if isinstance(engine, str) else engine
        kind = given if shared is not None else given.on(self.backend)
        self._named: dict[str, Any] = {
            "preset": preset,
            "action_mode": action_mode,
            "resolution": resolution,
            "conventions": conventions,
            "frame_skip": frame_skip,
            "max_episode_length": max_episode_length,
        }
        options = Options.checked(kind, **self._named)
        if shared is not None and replace(shared.options, steps=0) != options:
            name, allowed = "options of a world with these structures", (str(shared.options),)
            raise UnknownOption(name, options, allowed)
        self.structures = shared or structures_of(kind, options)
        self.deciding, self.policies = self.structures.deciding, kind.policies
        self.options = self.structures.options
        self._checked = False
        self._origin: Snapshot | None = None  # before anything is drawn
        self._have_no_episode()
        if isinstance(self.variables_space, Subset):
            # If variables determine which bodies exist, the subset may name absent ones.
            may_come = len(self.structures.head) > 0
            check_subset(self.variables_space, self.model.variables, may_come=may_come)

    def _have_no_episode(self) -> None:
        self.has_begun, self._lost = False, ""
        self.noise, self.episode, self.draws = CompiledNoise(0), 0, None
        self._offset = 0  # steps by which interventions have moved control_index
        self._base: Base | None = None
        self._base_step = -1  # control steps before it was taken
        compiled = self.structures.natural(None)
        self._hold(self.structures.first.copy())
        self._adopt_structure(compiled.composition.structure(self.row))
        self._adopt_model(compiled.model)
        self.version += 1

    def _hold(self, row: Rows) -> None:
        self.compiled, self.row, self.state = row.compiled, row, row.compiled.state_of(row)
        self.vector, self.task = self.state.vector, self.compiled.task
        self.composition, self.static_names = self.compiled.composition, self.compiled.static_names

    def move(self, row: Rows) -> None:
        """Move the present values to another row."""
        row.numbers[...] = self.row.numbers
        self._hold(row)

    @property
    def index(self) -> int:
        """Number of finished control steps of the episode."""
        return int(self.row.numbers[self.compiled.clock])

    def previous(self) -> dict[str, Value]:
        """Return the values of one control step ago that present variables depend on."""
        self._require_episode()
        reading, earlier = self.compiled.reading, self.row.earlier().items()
        return {name: now.astype(int if reading[name][2] else float) for name, now in earlier}

    def decided_values(self) -> dict[str, Value]:
        """Return the commands of the last control step, as views."""
        return {name: self.row[name] for name in self.compiled.commanded}

    @typed
    def tensor(self, name: str) -> Any:
        """Return a state where the engine has it: on a GPU, or as an array on its CPU device.

        Args:
            name: Name of a state, such as ``"tool_block.cartesian_position"``.

        Returns:
            Something with ``__dlpack__``, as ``torch.from_dlpack`` takes it, without a copy, shape
            (size,). It is for reading. Steps change it; after ``do`` and ``reset`` ask again.

        Raises:
            EngineFailure: The engine has no states on a device, or not this one as it is.
            UnknownVariable: No variable has this name.
        """
        self.require_state()
        self.model.declared(name)
        return self.backend.tensor(name)

    def evaluate(self, names: tuple[str, ...] | None = None) -> Rows:
        """Compute some variables, all if None, and return the row of all present values."""
        self._require_episode()
        self.row.evaluate(names)
        return self.row

    def scene(self) -> Scene:
        """Build the present scene, for rendering or for another engine."""
        self._require_episode()
        return self.compiled.scene(self.row.copy())

    def cameras(self) -> tuple[Camera, ...]:
        """Return the cameras whose poses are variables: the three of the robot."""
        self._require_episode()
        return self.composition.cameras(self.row.copy())

    def _begin(self) -> None:
        self._lost, self._offset = "", 0
        natural, origin = self.structures.natural(None), self._origin
        if self.has_begun and origin is not None and origin.engine is not None:
            self.backend.restore(origin.engine)
        else:
            row = self.structures.first.copy()
            self.backend.build(natural.scene(row))
            self.backend.read(natural.state_of(row))
            structure = natural.composition.structure(row)
            taken = self.backend.snapshot()
            origin = Snapshot(natural.model, row.copy(), structure, engine=taken)
            self._origin, self.has_begun = origin, True
        self._adopt(natural.model, origin.row)
        self._draw_nature()
        self.row.remember()
        if not self._checked:
            check_functions(self.compiled, self.evaluate())
            self._checked = True
            warn_of_start(self.row, stacklevel=4)
        self._base = Base(self.graph, self.row.copy(), self.structure, at_start=True)
        self._base_step = self.index

    def _draw_nature(self) -> None:
        """Draw the random initial values of this episode."""
        key = self.draw_key(0)
        compiled, starts = self.structures.natural(key), None
        if not compiled.random:
            return
        if self.draws is not None:  # start states are those of the episode itself
            own, places = beginning(compiled, self.noise_key(0)), {*compiled.random}
            starts = {n: own[n] for s in compiled.slices if (n := f"{s}.{START}") in places}
        row = beginning(compiled, key, known=starts)
        now = Base(self.graph, self.row, self.structure)
        changed = now.row.differing(row)
        change = difference(now, row, changed)
        if change is not None:
            deep = overlaps(now, now, row, change) if compiled.composition.solid else ()
            if deep:
                raise Infeasible(compiled.random[0], Draw("A"), [*map(str, deep)])
            self.backend.apply(change)
        self.backend.read(compiled.state_of(row))
        self._adopt(compiled.model, row, changed)

    def noise_key(self, index: int) -> NoiseKey:
        """Return the noise key of a control step of this episode.

        Noise depends on the steps taken, not on interventions on ``control_index``.
        """
        return NoiseKey(self.noise, self.episode, index - self._offset, origin=0)

    def draw_key(self, index: int) -> NoiseKey:
        """Return the noise key with which interventions draw at a control step."""
        key = self.noise_key(index)
        return key if self.draws is None else replace(key, episode=self.draws)

    # --- the task and the options -------------------------------------------------------------

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for copying and pickling: a new backend, and a snapshot."""
        snapshot = self.snapshot() if self.has_begun else None
        return _copied, (type(self), self.structures.task, self.made_with, snapshot)

    @property
    def made_with(self) -> dict[str, Any]:
        """All options that it was made with, beside the task."""
        where = {"backend": self.backend.name, "variables_space": self.variables_space}
        return {**where, **self._named}

    def maker(self) -> Callable[..., Simulation]:
        """Return a function that makes simulations like this one, or with given structures."""
        return partial(_another, type(self), self.structures.task, self.made_with)

    @property
    def settings(self) -> dict[str, Any]:
        """The options that it was made with, as far as they are not the usual ones of its task."""
        given = {**self._named, "variables_space": self.variables_space}
        if given["conventions"] == "scm_world":
            del given["conventions"]
        if self.backend.name != self.structures.task.backend:
            given["backend"] = self.backend.name
        return {name: value for name, value in given.items() if value is not None}

    @property
    def natural_model(self) -> SCM:
        """The causal model at the beginning of an episode."""
        return self.structures.natural(None).model

    @property
    def engine(self) -> str:
        """Name and version of the physics engine."""
        return f"{self.backend.name} {self.backend.version}"

    @property
    def max_episode_length(self) -> int:
        """Length of an episode in control steps."""
        return self.options.steps

    def length(self, steps: int | None) -> int:
        """Return the checked number of control steps of an episode; the task's own if None."""
        return whole_number("steps", self.max_episode_length if steps is None else steps, least=1)

    def usual_setting(self) -> dict[str, Any]:
        """Return nothing: the usual options are those of a simulation."""
        return {}

    def usual_outcomes(self) -> tuple[str, ...]:
        """List the fractional success of a task, else all variables computed from states."""
        if FRACTION in self.model:
            return (FRACTION,)
        compiled = self.compiled
        return tuple(name for name in compiled.computed if name not in compiled.bundles)

    def usual_columns(self, *, every_step: bool = False) -> tuple[str, ...]:
        """List what the task measures, with ``every_step`` also what moves; else all states."""
        observation = self.task.observation
        names = observation.measured
        if names is None:
            names = (*self.compiled.slices, REWARD, SUCCESS)
        elif every_step:
            names = (*observation.moving, *names)
        return tuple(name for name in names if name in self.model)

    @property
    def tools(self) -> tuple[str, ...]:
        """The names of the boxes that should be moved."""
        return self.task.goal.tools

    def idle(self) -> Floats:
        """Return the idle action of the task, shape (n_actions,)."""
        return self.task.idle(self)

    def contacts(self) -> tuple[ContactPoint, ...]:
        """Return the contacts of the present instant."""
        return self.backend.contacts()

    def may_have(self, name: str) -> bool:
        """Return whether there is a variable or a body of a name, or there may be one."""
        if name in self.model or self.deciding or name in self.composition.system.refused:
            return True
        return any(entity.name == name for entity in self.composition.entities)

    def is_set_at_once(self, name: str) -> bool:
        """Return whether a variable is a state, which physics moves on."""
        model = self.model
        return name in model and model.declared(model.target(name)).role == "state"

    @property
    def observed(self) -> tuple[str, ...]:
        """The names of the observed variables."""
        return tuple(part.variable for part in self.task.observation.rows)

    @property
    def identity(self) -> tuple[Any, ...]:
        """Common properties of worlds that can restore one another's snapshots."""
        options = replace(self.options, given_length=None)
        return self.task.name, options, self.structures.digest

    def __fingerprint__(self) -> dict[str, Any]:
        """Return everything that determines the simulation, except versions: task and options."""
        given = replace(self.options, given_length=None)
        options = (self.backend.name, self.variables_space, self.task.name, given)
        return {**self.structures.__fingerprint__(), "options": options}

    # --- a control step -----------------------------------------------------------------------

    def step(self, action: ArrayLike) -> None:
        """Advance one control step.

        Args:
            action: All actions in order, shape (n_actions,) in SI units. Numbers outside
                the action's range are clipped to it.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
            NotReset: No episode has begun.
            EngineFailure: The backend lost the state.
        """
        self.advance(action)

    def advance(self, action: ArrayLike, scale: Floats | None = None) -> None:
        """Advance one control step, without the plan of the episode; see ``Vectors.clipped``."""
        if not self.has_begun or self._lost:
            self.require_state()
        row, held = self.row, None
        sent = command = self.compiled.clipped(action, scale)
        if self.acts_alone:
            command, sent, held = self._decided(command)
        row.prepare()
        done = 0
        try:
            if sent.ndim == 1:
                self.backend.step(sent, self.substeps)
            for steps, part in parts(sent, held.samples if held else ()) if sent.ndim > 1 else ():
                self.backend.step(part, steps)
                done += steps
                if held is not None and done in held.samples:
                    self.backend.read(self.state)
                    held.see(done, self.state.vector)
        except EngineFailure as error:
            left, vector = self.compiled.empty_state(), self.state.vector
            self.backend.read(left)
            if not (done or error.lost) and np.isfinite(left.vector).all():  # no step was taken
                raise
            text = str(error)
            if vector.size:
                worst = int(np.abs(vector).argmax())
                places = self.composition.system.layout.slices.items()
                name = next((n for n, at in places if at.start <= worst < at.stop), "")
                text += f"; before that step, the largest number was {vector[worst]:.3g}, of {name}"
            self._lose(f"the state was lost in control step {self.index}: {text}")
            failed = EngineFailure(self._lost, self.backend.name)
            failed.diverged = error.diverged
            raise failed from error
        row.advance(command)
        self.backend.read(self.state)
        if held is not None:
            self.state.vector[-held.numbers.size :] = held.numbers

    def _decided(self, action: Floats) -> tuple[Floats, Floats, Held | None]:
        """Compute what a control step does with an action, if the world ``acts_alone``.

        Returns:
            The action after interventions on actions; the backend's command, valid until the next
            call, see ``Commands.command``; and the states that are kept here as they are after the
            step, None without any.
        """
        held, key = self._held_actions, self.noise_key(self.index)
        if held:
            known = {**self.evaluate(self._inputs), **self.compiled.split(action)}
            solved = self.graph.solve(known, key=key, only=held)
            action = action.copy()
            for name in held:
                action[self.compiled.actions[name]] = np.ravel(solved[name])
            action = self.compiled.clipped(action)
        if not self._translates:
            return action, action, None
        commands: Any = self.composition.commands
        given = action, self.row, self.state.vector, key, self.substeps
        return action, commands.command(*given), commands.held(*given)

    # --- interventions ------------------------------------------------------------------------

    def do(
        self,
        request: Mapping[str, Any],
        *,
        space: AnyRegion | None = None,
        check: Callable[[], object] | None = None,
        levels: Sequence[Level] = (),
    ) -> Audit:
        """Intervene now, without advancing time. A refused request changes nothing.

        A parameter stays set until the reset; a state is set at this instant, and physics continues
        from there. Interventions at one instant are combined: undoing one leaves no trace.

        Args:
            request: Values, ``Shift``, ``Scale`` or ``Draw`` by name, dotted or nested; a pattern
                such as ``"*.damping"`` stands for the variables that there are and that fit it.
            space: If given, every target must lie in this space: ``"A"``, ``"B"``, ``"A|B"`` or
                a ``Subset``; ``variables_space`` of the world if None.
            check: Function that is called at the end. If it raises, the intervention is undone, and
                the error propagates.
            levels: What holds at this instant without what is asked, and the request, if a plan
                asks; what the first ones draw is not drawn again where the request does not fit.

        Returns:
            The audit: requested, applied and reported values, and effects.

        Raises:
            InterventionError: The request was refused; the world is bit-identical to before.
            NotReset: No episode has begun.
        """
        if not self.has_begun or self._lost:
            self.require_state()
        problems: list[InterventionError] = []
        named = self.compiled.model.named
        flat = named(flatten(request, problems), problems)
        before = Base(self.graph, self.row.copy(), self.structure)
        base = self.base or before
        drawn, key = base.drawn, self.draw_key(self.index)
        if any(isinstance(a, Intervention) and (a.is_soft or a.draws) for a in flat.values()):
            initial = base.row.compiled.random if base.at_start else ()
            flat, drawn = renewed(flat, drawn, initial)
            lower = [renewed(named(one.request), base.drawn, initial)[0] for one in levels[:-1]]
            draws = [one.draws for one in levels] or [{}]
            levels = [*map(Level, (*lower, flat), draws)]
        region = self.variables_space if space is None else as_region("space", space)
        solved: Any = partial(stacked if levels else feasible, self.structures, base, before)
        done: Transaction = solved(levels or flat, region, key, problems)
        model, pending = done.remains()
        audit = self._commit(done, model, before, flat, check, at_start=base.at_start)
        rest = (base.structure, pending, drawn, base.at_start)
        self._base = Base(base.model, base.row, *rest)
        self._base_step = self.index - self._offset
        self.last, self.requested = done, request
        return audit

    @property
    def base(self) -> Base | None:
        """The world at this control step before any intervention; None after a step."""
        return self._base if self.index - self._offset == self._base_step else None

    def _go_on(self, one: RowMemory, place: int, row: Rows, origin: Snapshot) -> None:
        """Go on alone from what worlds did together; ``row`` has the present of this one."""
        key = one.key(place)
        self.noise, self.episode, self.draws = CompiledNoise(key.noise.seed), key.episode, None
        self._origin, self._base_step = origin, key.step
        self._lost, self._offset, self.has_begun, self._checked = "", 0, True, True
        self._hold(row)
        self._adopt_structure(one.structure)
        self._adopt_model(one.graph(place))
        self.requested = one.request(place)
        if self.index == key.step:
            base, _, self.last = one.done(place)
            rest = (base.structure, self.last.remains()[1], one.drawn, base.at_start)
            self._base = Base(base.model, base.row, *rest)

    def _drawn(self, name: str, act: Any) -> dict[str, tuple[str, Any]]:
        """Draw what an intervention would draw now; return it by target, with the numbers."""
        model, key = self.model, replace(self.draw_key(self.index), kept=self.last.attempts)
        initial = self.compiled.random if self.base is not None and self.base.at_start else ()
        act = renewed({name: model.accept(name, act)}, {}, initial)[0][name]
        if act.draws:
            whole = model._applied(name, act)
            value = model._intended(model.target(name), whole, self.row, key)
            act = Hard.of(value)
        parts, key = act.divided(model.declared(name)).items(), replace(key, kept=None)
        return {model.target(n): (n, one.settled(model.declared(n), key)) for n, one in parts}

    def _commit(
        self,
        done: Transaction,
        model: SCM,
        before: Base,
        request: Mapping[str, Any],
        check: Callable[[], object] | None,
        *,
        at_start: bool,
    ) -> Audit:
        """Apply a transaction and read it back, or restore everything and raise."""
        index, row, offset = self.index, self.row, self._offset
        change, backend, compiled = done.change, self.backend, done.compiled
        keys, structure = compiled.parameter_keys, before.structure
        if change is not None and change.structure is not None:
            structure = change.structure
        wanted = {keys[t] for n in done.asked for t in compiled.model.targets(n) if t in keys}
        inertia: Parameters = {}
        remarks: tuple[str, ...] = ()
        try:
            if change is None:
                reported = backend.parameters(wanted)
            else:
                if change.structure is None:
                    known = compiled.inertias
                    moments = sorted({known[key] for key in change.parameters if key in known})
                    inertia = backend.parameters(moments)
                backend.apply(change)
                reported = backend.parameters({*wanted, *change.parameters, *inertia})
                self._refuse_other(change, reported, done.row)
                if change.structure is None and change.parameters:
                    old = {keys[name]: before.row[name] for name in done.changed if name in keys}
                    remarks = backend.capabilities.remarks(backend, old)
            clock = done.row.numbers[compiled.clock]
            if change is None and not done.changed and clock == index and self.compiled is compiled:
                self._adopt_model(model)
                self.version += 1
            else:
                self._adopt(model, done.row, done.changed, structure)
                self._offset += self.index - index
                if at_start:
                    self.row.remember()
            audit = Audit(partial(report, request, done, before, inertia, reported, remarks))
            if check is not None:
                check()
        except BaseException:
            after = Base(self.graph, done.row, structure)
            lost = difference(after, before.row, done.changed)
            if lost is not None:
                backend.apply(lost)
            self._hold(row)
            self._adopt(before.model, before.row, row.compiled.static_names)
            self._offset = offset
            raise
        return audit

    def _refuse_other(self, change: Difference, reported: Parameters, row: Rows) -> None:
        """Refuse values that the backend did not adopt; write the state that it reports."""
        found = [(".".join(key), value, reported[key]) for key, value in change.parameters.items()]
        if change.state is not None:
            state = change.state.copy()
            self.backend.read(state)
            found.append(("the state", change.state.settable(), state.settable()))
            row.numbers[: row.compiled.state_size] = state.vector
        wrong = [
            name
            for name, asked, got in found
            if asked.tobytes() != got.tobytes()
            and not np.allclose(got, asked, READ_BACK, READ_BACK)
        ]
        if wrong:
            problem = f"the engine did not take over {', '.join(wrong)}"
            raise EngineFailure(problem, self.backend.name)

    def _adopt(
        self,
        model: SCM,
        row: Rows,
        changed: Iterable[str] | None = None,
        structure: Structure | None = None,
    ) -> None:
        """Adopt a model and values, after the backend."""
        last, compiled = self.row, row.compiled
        anew = compiled is not self.compiled
        changed = last.differing(row) if changed is None else changed
        if anew:
            self._hold(row.copy())
        self.row.numbers[...] = row.numbers
        self.row.numbers[compiled.fresh] = 0.0  # computed values may be outdated
        if changed or anew:
            self._adopt_structure(structure or compiled.composition.structure(row))
        self._adopt_model(model)
        self.version += 1
        if anew:
            self.row.remember()
            self.row.recall(last)

    def _adopt_structure(self, structure: Structure) -> None:
        commands = self.composition.commands
        self._translates = commands is not None and bool(commands.applies(self.row))
        self.structure = structure
        self.substeps = physics_steps(self.options, structure)

    def _adopt_model(self, model: SCM) -> None:
        acts = [(name, model._act_on(name)) for name in self.compiled.actions]
        roots = {name: act.root for name, act in acts if act is not None}
        self.graph, self._held_actions = model, (*roots,)
        self.holds_actions = bool(roots)
        self.acts_alone = self._translates or self.holds_actions
        self._inputs: tuple[str, ...] = ()  # what the interventions on actions read
        for root in roots.values():
            followed = root.intervention.follows(root.requested)
            self._inputs += tuple(parent.name for parent in followed)

    # --- state ------------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return everything that determines the future of the world. It can be pickled.

        Raises:
            NotReset: No episode has begun.
            EngineFailure: The backend has lost the state.
        """
        self.require_state()
        return Snapshot(
            *(self.graph, self.row.copy(), self.structure),
            engine=self.backend.snapshot(),
            base=self.base,
            index=self.index,
            offset=self._offset,
            seed=self.noise.seed,
            episode=self.episode,
            draws=self.draws,
            world=self.identity,
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot bit-identically; a world whose backend fails meanwhile is lost.

        Raises:
            SnapshotMismatch: It belongs to another task or backend, or is damaged. The world is
                unchanged.
        """
        if not isinstance(snapshot, Snapshot):
            raise SnapshotMismatch(f"{snapshot!r} is not a snapshot of a world")
        if snapshot.world != self.identity:
            raise SnapshotMismatch(
                "the snapshot is one of another task, of other arguments of it or of other options"
            )
        if not self.has_begun:
            self._begin()
        try:
            found = snapshot._opened(self.structures, self.structure)
            engine: Any = found.engine
            engine.opened(self.backend)
            noise = CompiledNoise(found.seed)
        except SnapshotMismatch:
            raise
        except Exception as error:
            raise SnapshotMismatch(f"the snapshot is damaged: {in_one_line(error)}") from error
        self._lost = "a snapshot was restored in part"
        self.backend.restore(engine)
        self._adopt(found.model, found.row)
        self.row.numbers[:] = found.row.numbers
        self._lost, self._offset = "", found.offset
        self.noise, self.episode, self.draws = noise, found.episode, found.draws
        self._base, self._base_step = found.base, self.index - self._offset

    def close(self) -> None:
        """Free the engine and end the episode."""
        self._closed |= self.has_begun
        self.has_begun = False
        self.version += 1
        self.backend.close()

    def _lose(self, why: str) -> None:
        """Clear the state that the world would continue from, until a reset or a snapshot."""
        self._lost = why

    def require_exact(self, question: str, *, independent: bool = False) -> None:
        """Refuse a question that compares equal runs bit for bit, if the engine is not exact.

        With ``independent``, also if bodies that do not touch change one another.
        """

        def takes(other: Backend) -> None:
            self.structures.task.on(other)
            other.build(self.structure.default_scene())

        require_exact(
            self.backend, question, takes, independent=self.structure if independent else None
        )

    def require_state(self) -> None:
        """Refuse to continue without an episode, or from a state that the backend has lost."""
        self._require_episode()
        if self._lost:
            advice = "reset the world, or restore a snapshot"
            raise EngineFailure(f"{self._lost}; {advice}", self.backend.name)


def warn_of_start(row: Rows, *, stacklevel: int) -> None:
    """Warn if the start of an episode was drawn, and violates equality constraints."""
    compiled = row.compiled
    violated = compiled.composition.violated(compiled.scene(row)) if compiled.random else ()
    if violated:
        which = "; ".join(dict.fromkeys(what for _, what, *_ in violated))
        advice = "follow=True lets states follow those that are drawn"
        warnings.warn(f"the drawn start violates {which}; {advice}", stacklevel=stacklevel)


def physics_steps(options: Options, structure: Structure) -> int:
    """Return the number of physics steps in a control step."""
    return max(1, round(options.control_period / float(structure.timestep)))


def _another(
    kind: type[Simulation],
    task: Task,
    options: Mapping[str, Any],
    structures: StructureCache | None = None,
) -> Simulation:
    return kind(copy.copy(task) if structures is None else structures, **options)


def _copied(
    kind: type[Simulation], task: Task, options: Mapping[str, Any], snapshot: Snapshot | None
) -> Simulation:
    world = kind(task, **options)
    if snapshot is not None:
        world.restore(snapshot)
    return world
