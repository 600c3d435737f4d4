"""``World``: a simulation with causal queries."""

from __future__ import annotations

import copy
from abc import ABCMeta, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Self, final

import networkx as nx

from scm_world import graph
from scm_world._arguments import one_of, typed
from scm_world._types import ArrayLike
from scm_world.errors import InterventionError, ModelError, UnknownOption
from scm_world.graph import flatten
from scm_world.graph.scm import request_of
from scm_world.models import Model
from scm_world.queries.comparison import HORIZONS, Comparison, compare_backends
from scm_world.queries.episodes import Episode
from scm_world.queries.equations import refuse_other_than_parameters, stepped
from scm_world.queries.local import local_graph
from scm_world.queries.plans import Memory, Plan, check_names, retimed
from scm_world.queries.progress import Progress
from scm_world.queries.questions import SCM, Questions
from scm_world.tasks import EquationTask, Options, read_source
from scm_world.variables.interventions import has_times
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world import (
    Audit,
    CompiledModel,
    Equations,
    Simulation,
    Snapshot,
)
from scm_world.world.batch import OF_WORLD, Batch
from scm_world.world.compiled_task import beginning
from scm_world.world.equation_rows import EquationTable
from scm_world.world.structures import StructureCache
from scm_world.world.system import CausalSystem

if TYPE_CHECKING:
    from scm_world.backends.mujoco.fidelity import Fidelity
    from scm_world.fit import Deviation, Fit, Search


class _Schedule(NamedTuple):
    """The plan of the present episode, its memory, and the step of its last intervention."""

    plan: Plan = Plan()
    memory: Memory = Memory()  # replaced, never changed
    space: AnyRegion | None = None
    acted: int = -1


class Planned(CausalSystem):
    """A system whose episodes follow a plan: ``World``, of an engine or of equations."""

    _given = Plan()
    _schedule = _Schedule()
    is_planned, plan_end = False, 0.0  # of this episode: the last step at which its plan may act

    @property
    def plan(self) -> Plan:
        """The interventions of ``given`` in every episode of this world."""
        return self._given

    def _under(self, do: Mapping[str, Any]) -> Self:
        """Return a new world, of which no episode has begun, with interventions of ``given``."""
        self._given = self._given._replacing(dict(self.planned(do)), self.model)
        return self

    def given(self, do: Mapping[str, Any]) -> Self:
        """Return another world with further interventions; this one is not changed.

        They are the context of every episode and query of the other world: a ``Shift`` of a query
        acts on what they make of a variable, and ``Natural`` shows that. A running episode
        continues there bit-identically, and interventions without a time are applied immediately.
        As a context manager the other world is closed at the end.

        Args:
            do: Interventions, with or without a time; ``world.given(a).given(b)`` is
                ``world.given({**a, **b})``.

        Raises:
            InterventionError: The intervention was refused.
        """
        other = copy.deepcopy(self)._under(do)
        if other.has_begun:
            now, step = self._schedule.plan, other.index
            if not self.is_planned:  # what was done by hand lies above
                now = Plan(dict(other.graph.done().values()))
            given = dict(now.context).get("given", Plan()).then(do, self.model, at=step)
            above = [(kind, dict(plan)) for kind, plan in now.context if kind != "given"]
            plan = Plan._of(dict(now), above).over(given, "given")
            other._follow(self._schedule._replace(plan=plan, acted=-1))
            other.act()
        return other

    def reset(
        self,
        *,
        seed: int | None = None,
        episode: int = 0,
        do: Mapping[str, Any] | None = None,
        space: AnyRegion | None = None,
        draws: int | None = None,
    ) -> Audit | None:
        """Begin an episode, with the interventions of ``given``; see ``Simulation.reset``.

        Interventions with a time are applied within the episode; ``space`` applies to them, too. If
        ``do`` is refused, the episode has begun in its context, without it.
        """
        region, asked = as_region("space", space), request_of(do)
        super().reset(seed=seed, episode=episode, draws=draws)
        self._follow(_Schedule())
        context = do.context if isinstance(do, Plan) else ()
        if not (len(self._given) or context or has_times(asked)):
            return self.do(asked, space=space) if asked else None
        try:
            self._follow(_Schedule(self.planned(do), space=region))
            return self.act()
        except BaseException:
            below = self.planned(Plan._of({}, do._context if isinstance(do, Plan) else ()))
            self._follow(_Schedule())
            if below.context:
                self._follow(_Schedule(below, space=region))
                with suppress(InterventionError):  # the context itself is refused
                    self.act()
            raise

    def do(self, request: Mapping[str, Any], **options: object) -> Audit:
        """Intervene now, without advancing time; see ``Simulation.do``.

        The intervention lies above the plan of the episode: a ``Shift`` acts on what the context
        makes of the variable now, and ``Natural`` shows that. Where a plan acts on the same
        variable at this instant, this intervention counts.
        """
        system: Any = super()
        if not self.is_planned or has_times(request):
            return system.do(request, **options)  # type: ignore[no-any-return]
        doing: Callable[..., Audit] = partial(system.do, **options)
        try:
            flat = self.model.named(flatten(request))
            acts = {name: self.model.accept(name, value) for name, value in flat.items()}
        except InterventionError:
            return doing(request)  # which names every problem
        now, step = self._schedule, self.index
        plan = now.plan._replacing(
            {n: retimed(act, at=step) for n, act in acts.items()}, self.model
        )
        memory = now.memory.copy()
        for name in acts:
            memory.forget(name, step)
        audit = plan._act(self, step, memory, doing, acts)
        self._follow(now._replace(plan=plan, memory=memory))
        return audit or doing({})

    def step(self, action: ArrayLike) -> None:
        """Advance one control step, after its planned interventions; see ``Simulation.step``.

        A step that is refused has not applied them.
        """
        system: Any = super()
        if not (self.is_planned and self._may_act(self.index)):
            system.step(action)
            return
        back, schedule = self.way_back(), self._schedule
        try:
            self.act()
            system.step(action)
        except BaseException:
            if not self.is_lost:
                back()
                self._follow(schedule)
            raise

    def _follow(self, schedule: _Schedule) -> None:
        self._schedule, self.plan_end = schedule, 0.0
        self.is_planned = any(parts for _, parts in schedule.plan.layers())
        if self.is_planned:
            self.plan_end = max((act.time.last for _, act in schedule.plan.timed()), default=0.0)

    def _may_act(self, step: int) -> bool:
        """Return whether the plan of the episode may still intervene at a control step."""
        now = self._schedule
        if step > self.plan_end:
            return False
        return step != now.acted and now.plan._concerns(self, step, now.memory)

    def act(self) -> Audit | None:
        """Apply the planned interventions of this instant, as the next step would.

        Returns:
            The audit; None if none is due, or all were applied already.

        Raises:
            InterventionError: An intervention was refused.
        """
        step, now = self.index, self._schedule
        if not self._may_act(step):
            return None
        memory = now.memory.copy()
        system: Any = super()
        audit = now.plan._act(self, step, memory, partial(system.do, space=now.space))
        self._schedule = now._replace(memory=memory, acted=step)
        return audit

    def snapshot(self) -> Snapshot:
        """Return everything that determines the future, with the plan and past events."""
        system: Any = super()
        taken: Snapshot = system.snapshot()
        return replace(taken, memory=self._schedule)

    def restore(self, snapshot: Snapshot) -> None:
        """Restore a snapshot bit-identically."""
        system: Any = super()
        system.restore(snapshot)
        if snapshot.memory is not None:
            self._follow(snapshot.memory)

    @abstractmethod
    def planned(self, do: Mapping[str, Any] | None) -> Plan:
        """Return the plan of an episode: ``do`` over the interventions of ``given``."""


_OPTIONS = ("preset", "action_mode", "resolution", "frame_skip", "max_episode_length")


class _Opener(ABCMeta):
    def __call__(
        cls, source: Any = ..., *args: Any, num_worlds: int | None = None, **options: Any
    ) -> Any:
        """Make what ``World`` opens: a world with an engine, one of equations, or a batch."""
        if cls is not World:
            given = args if source is ... else (source, *args)
            return super().__call__(*given, **options)
        of_batch = {"threads"} if num_worlds is not None else set()
        own = {name: options.pop(name) for name in (OF_WORLD | of_batch) & {*options}}
        if "task" in own:
            if source is not ...:
                raise UnknownOption("task beside a source", own["task"], ("left out",))
            source = own.pop("task")
        source = "pushing" if source is ... else source
        made: Any = source
        plan: Mapping[str, Any] = {}
        if isinstance(source, StructureCache):
            own |= options
        else:
            if own.get("frame_skip") is not None and "control_dt" in options:
                allowed = ("left out, beside control_dt",)
                raise UnknownOption("frame_skip", own["frame_skip"], allowed)
            made, plan, usual = read_source(source, options)
            own = {**usual, **own}
        if isinstance(made, EquationTask):
            made = _structures(made, own)
        if num_worlds is not None:
            from scm_world.queries.worlds import EngineWorlds, EquationWorlds  # above this one
        if isinstance(made, graph.SCM):
            if args or own:
                allowed = ("left out: a world of equations has no engine, and no such option",)
                raise UnknownOption("option of a world", next(iter(own), args), allowed)
            world: Any = EquationWorld(CompiledModel(SCM(made)))
            world = world if num_worlds is None else EquationWorlds(world, num_worlds)
        elif isinstance(made, StructureCache) and isinstance(made.task, EquationTask):
            world = EquationWorld(made.natural(None))
            world.structures, world.policies = made, made.task.policies
            world.variables_space = as_region("variables_space", own.get("variables_space"))
            world = world if num_worlds is None else EquationWorlds(world, num_worlds)
        elif num_worlds is not None:
            world = EngineWorlds._of(EngineWorld, num_worlds, made, *args, **own)
        else:
            world = EngineWorld(made, *args, **own)
        return world._under(plan) if plan else world


def _structures(task: EquationTask, own: Mapping[str, Any]) -> StructureCache:
    """Return the one structure of equations, compiled with the options of a world."""
    one_of("backend", own.get("backend"), (None, task.backend))
    asked = {name: own.get(name) for name in _OPTIONS} | {"conventions": own.get("conventions")}
    options = Options.checked(task, **asked)
    return StructureCache(task, options, _compiled)


def _compiled(task: EquationTask, options: Options) -> CompiledModel:
    return CompiledModel(SCM(task.model), task, options)


if TYPE_CHECKING:
    _System = Simulation  # a type checker takes a world for one with an engine
else:
    _System = CausalSystem


class World(Planned, _System, Questions, metaclass=_Opener):
    """A system that is reset, stepped, intervened on, and asked causal questions.

    It has a physics engine, or computes equations. Methods such as ``reset``, ``step`` and ``do``
    change it. Questions (``rollout``, ``sample``, ``effect``, …) run on twins, and ``given``
    returns another world; they leave this one as it is.

    Args:
        source: What the world is made of: a task or its name, a model (a path, text, ``MjSpec`` or
            ``MjModel``), a step function, an ``SCM`` or its file, a family of problems, or
            ``"module:name"``; see ``scm_world.tasks.read_source``.
        num_worlds: How many worlds; None for a single one.
        options: Options of ``scm_world.world.Simulation`` (``backend``, ``frame_skip``,
            ``max_episode_length``, …), with an engine; all others are options of the source:
            ``control_dt``, ``expose``, ``spaces``, ``fixed_base``, … of ``ModelTask``, or those of
            ``StepTask`` (``parameters``, ``states``, …) or of a task.

    Raises:
        UnknownOption: There is no such source, or it does not take an option.
        ModelError: A model cannot be read, or the backend cannot realise it.

    Example:
        >>> world = World("pushing", backend="fake")
        >>> with world.given({"tool_block.mass": 0.05}) as heavy:
        ...     episode = heavy.rollout("random", seed=1, steps=3)
        >>> float(episode["tool_block.mass"][-1])
        0.05
        >>> episode.counterfactual({}) == episode
        True

    With ``num_worlds=n`` it is n worlds, which are stepped together and read as arrays with a
    leading axis; see ``scm_world.world.Batch``, and ``EquationBatch`` for equations. Questions are
    about the model under the interventions of ``given``, as in one world; the present of one of
    them is that of ``world(i)``:

        >>> worlds = World("pushing", backend="fake", num_worlds=3)
        >>> _ = worlds.reset(seed=0, do={"tool_block.mass": [0.02, 0.05, 0.08]})
        >>> worlds.step(worlds["joint_positions"])
        >>> worlds["tool_block.mass"], worlds["tool_block.cartesian_position"].shape
        (array([0.02, 0.05, 0.08]), (3, 3))
        >>> worlds.effect("reward", do={"floor_friction": 0.9}, n=2, steps=3).n
        2
        >>> bool(worlds.world(1)["tool_block.mass"] == 0.05)
        True
        >>> worlds.close()

    A model, a step function and equations:

        >>> pole = World(
        ...     "<mujoco><worldbody><body name='pole'><joint name='hinge' axis='0 1 0'/>"
        ...     "<geom type='capsule' size='0.02' fromto='0 0 0 0 0 1'/></body></worldbody>"
        ...     "</mujoco>"
        ... )
        >>> pole.reset(seed=0)
        >>> print(pole.do({"pole.mass": 2.5}))
        pole.mass = 2.5, engine reports 2.5
          note: pole.inertia as before, not in proportion to the mass
        >>> from scm_world.variables import Box, Derived, Exogenous, Linear, Measured, Normal
        >>> growth = World(
        ...     lambda parameters, state, action, noise: {
        ...         "size": state["size"] * (1.0 + 0.1 * parameters["rate"])
        ...     },
        ...     parameters=[Exogenous(name="rate", default=1.0, bounds=Box(0.0, 2.0))],
        ...     states=[Measured(name="size", default=1.0, parents=("rate", "size"))],
        ...     control_dt=0.1,
        ... )
        >>> growth.reset(seed=0, do={"rate": 2.0}) and growth.step([])
        >>> float(growth["size"])
        1.2
        >>> equations = World(SCM([
        ...     Exogenous(name="x", distribution=Normal()),
        ...     Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ... ]))
        >>> equations.reset(seed=0)
        >>> print(equations.do({"x": 1.5}))
        x = 1.5
          follows: y -2.186088 → 3.
        >>> equations.effect("y", do={"x": 1.0}, versus={"x": 0.0}, n=10).mean.round(3)
        np.float64(2.0)
        >>> worlds = World(equations, num_worlds=3)
        >>> _ = worlds.reset(seed=0, do={"x": [0.0, 0.5, 1.0]})
        >>> worlds["y"]
        array([0., 1., 2.])
    """

    def fidelity(self) -> Fidelity:
        """Measure how far this world is from plain MuJoCo with its file.

        Returns:
            Data frames of changed settings, of differences over the first control steps, and of
            contacts, equality constraints and limits that the start pose violates, before anything
            is drawn; its text is one line.

        Raises:
            ModelError: The world is not that of a model file.
            MissingEngine: MuJoCo is not installed.

        Example:
            >>> world = World(
            ...     "<mujoco><worldbody><body name='pole'><joint name='hinge' axis='0 1 0'/>"
            ...     "<geom type='capsule' size='0.02' fromto='0 0 0 0 0 1'/></body></worldbody>"
            ...     "</mujoco>"
            ... )
            >>> world.fidelity().largest()[0]
            0.0
        """
        self._require_engine("fidelity")
        system = getattr(self.task, "system", None)
        if not isinstance(system, Model):
            raise ModelError([f"{self.task.name!r} has no model file to be compared with"])
        from scm_world.backends.mujoco.fidelity import fidelity

        begin = self.compiled.scene(beginning(self.compiled, None))
        return fidelity(system, self.backend.name, begin)

    @typed
    def compare(
        self,
        backend: str,
        *,
        probes: int = 12,
        seed: int = 0,
        steps: Sequence[int] = HORIZONS,
        progress: Progress | None = None,
    ) -> Comparison:
        """Compare two backends: the gap of each state, and signs and sizes of effects.

        From equal states on both a control step is taken, without a change, and after each
        parameter was changed by the same amount. Only effects of at least ten times the gap of that
        step are compared. Then both go on from the same states with the same actions: ``gaps`` has
        how far apart each state is after some ``steps``, in its unit. Agreement is not confirmed
        where bodies touch at the start on one backend only (``one_sided``).

        Args:
            backend: Name of the other backend.
            probes: Number of states.
            seed: Of states, values and actions.
            steps: Numbers of control steps after which the gaps are measured.
            progress: Called with (finished, planned).

        Raises:
            MissingEngine: The backend is not installed.
            UnknownOption: The backend does not exist, or ``probes`` or one of ``steps`` is not a
                positive whole number.

        Example:
            >>> found = World("reaching", backend="fake").compare("fake", probes=1, steps=[1, 5])
            >>> found.share, {(gap.steps, gap.largest) for gap in found.gaps} == {(1, 0), (5, 0)}
            (1.0, True)
        """
        self._require_engine("compare")
        return compare_backends(self, backend, probes, seed, steps, progress)

    @typed
    def fit(
        self,
        recording: object,
        parameters: Iterable[str],
        *,
        noise: Any = None,
        window: int | None = None,
        begins: Any = None,
        held_out: float | None = None,
        setups: Sequence[Mapping[str, object]] | None = None,
        columns: Mapping[str, str] | None = None,
        ignore: Iterable[str] = (),
        symmetric: bool = False,
        thin: int | None = None,
        progress: Progress | None = None,
        search: Search | None = None,
    ) -> Fit:
        """Fit parameters to a recording of a real system, or of another world.

        Multiple shooting: the recording is cut into windows, which are simulated from start states
        that are fitted, too; measurements there count like all others. So noise in the
        start states does not bias parameters, and states need not be measured. Least squares are
        bounded by the ranges of the parameters; sensitivities are finite differences of paired
        rollouts, which are stepped together. Whatever the recording does not determine stays near
        its default.

        Args:
            recording: A CSV, Parquet or npz file, a data frame or arrays by name, with ``time`` [s]
                in whole control steps (to a quarter of one; rows that have commands alone at any
                time), a column for each command, held until the next row, and columns of any
                states, readouts or outcomes in their units; vectors have columns ``name[i]``, and
                NaN was not measured. A column ``episode`` separates runs, and so do a gap in time
                and a command that is NaN. Or a ROS bag, a LeRobot dataset, an ``Episode``, a
                ``Dataset`` with every step, a dataset of Minari (with observations and actions in
                units, not normalised), or a list of these.
            parameters: Patterns of parameters, such as ``["*.damping", "upper_arm.mass"]``, or of
                their components; ``"delay"`` is a delay of all commands. Inertias keep the
                proportions of their components unless these are named.
            noise: Standard deviations of the measurements: a number, or numbers by patterns of
                columns; estimated from the residuals if None.
            window: Number of used rows of a window; if None 50, or 10 where only these explain the
                recording, which is a remark then. Longer windows determine more, and shorter ones
                bear more disturbances, contacts and chaos.
            begins: How the recording begins, where that was not measured: ``"rest"`` (velocities 0,
                activations at what they follow, the first command, to 0.001), or values and
                standard deviations by patterns of states, ``{"*.velocity": (0.0, 0.01)}``.
            held_out: Share of the rows at the end of each run that are not fitted, but predicted:
                ``fit.held_out``.
            setups: The set-up of each of several recordings: values of parameters that were set for
                it, ``[{}, {"weight.mass": 1.0}]``. A recording may carry its own: a column
                ``do.weight.mass``, or arrays by name with ``"do": {"weight.mass": 1.0}``.
            columns: Names of this world by those of the tables, ``{"torque": "motor.control"}``,
                if need be with their units, ``{"stamp": "time [ms]"}``.
            ignore: Patterns of columns that are left out.
            symmetric: Whether ranges [-a, a], such as those of forces, stay symmetric.
            thin: Every which row is used; 1 for all rows. If None, rows at high rates are thinned
                as far as lines between the used ones pass the others within their noise and 0.3 %
                of their spread, and 250 rows are left; a remark says so. Commands act as recorded.
            progress: Called after each search: of the minimum, and of the ends of intervals. How
                many there will be is not known before.
            search: What finds the next minimum of least squares; ``gauss_newton`` if None. See
                ``scm_world.fit.Search``.

        Raises:
            UnknownVariable: A pattern of parameters or of noise fits nothing.
            NotIntervenable: A parameter cannot be changed, or is not exposed.
            UnknownOption: The recording is of another kind, or has too few measurements.
            ModelError: Columns are missing, or none of this world; times do not rise, or are not
                whole control steps; a value lies far outside of its limits, a command at all.
            UnreadableFile: A file is missing or damaged.

        Ctrl-C ends a fit with the best values so far: ``fit.interrupted`` and a remark say so, none
        is determined. It is raised only before the first values are reached.

        Where the model leaves more than the noise, or only short windows are explained, intervals
        contain what each half of the recording and windows of other lengths say.

        Equations are fitted as a step function. They, and a recorded episode, may have
        interventions on parameters only; a ``ModelError`` says what else stands against it: lags of
        several steps, an action that acts within its instant, noise that later steps depend on.

        Source:
            Bock, *Recent advances in parameteridentification techniques for O.D.E.*, 1983.
        """
        from scm_world.fit import fit

        options: dict[str, Any] = {"noise": noise, "window": window, "begins": begins}
        options |= {"held_out": held_out, "setups": setups, "progress": progress}
        options |= {"symmetric": symmetric, "columns": columns, "ignore": ignore, "thin": thin}
        options |= {} if search is None else {"search": search}
        return fit(self, recording, parameters, **options)

    @typed
    def explain(
        self,
        recording: object,
        candidates: Iterable[str] | None = None,
        *,
        most: int = 1,
        noise: Any = None,
        window: int | None = None,
        begins: Any = None,
        setups: Sequence[Mapping[str, object]] | None = None,
        columns: Mapping[str, str] | None = None,
        ignore: Iterable[str] = (),
        thin: int | None = None,
        progress: Progress | None = None,
    ) -> Deviation:
        """Find which parameter accounts for the deviation of a recording from this world.

        Candidates are ranked by linearisations over all of them. The first ones are fitted, and
        compared with one another and with the world as it is. Those that are predicted to be far
        worse than the best are not fitted; the table has the predictions for them. Close ones are
        searched as thoroughly as ``fit`` does. A large sensitivity is no explanation: a parameter
        explains a deviation if some value of it reproduces the recording.

        Args:
            recording: See ``fit``.
            candidates: Patterns of parameters; all that act on a measurement, and the delay of
                the commands, if None.
            most: Largest number of parameters that explain together. The best set of one
                linearisation is fitted, then sets that differ from the best in one parameter.
            noise: See ``fit``.
            window: Number of rows of a window; 50 if None.
            begins: See ``fit``.
            setups: See ``fit``.
            columns: See ``fit``.
            ignore: See ``fit``.
            thin: See ``fit``.
            progress: Called after each linearisation and each search. Ctrl-C (an error
                ``KeyboardInterrupt``) ends the search; what is known by then is returned, and says
                so.

        Raises:
            Those of ``fit``.
        """
        from scm_world.fit import explain

        options: dict[str, Any] = {
            "noise": noise,
            "window": window,
            "begins": begins,
            "setups": setups,
        }
        options |= {"columns": columns, "ignore": ignore, "most": most, "thin": thin}
        return explain(self, recording, candidates, progress=progress, **options)

    def for_fit(self, recording: object) -> World:
        """Return the world that a fit computes: of equations, that of their step function."""
        model = self.compiled
        if not isinstance(model, CompiledModel):
            return self
        refuse_other_than_parameters(self.model, self._given, "a world that is fitted")
        for one in recording if isinstance(recording, list | tuple) else (recording,):
            if isinstance(one, Episode):
                refuse_other_than_parameters(self.model, one.plan, "a recorded episode")
        return World(stepped(model.model)).given(dict(self._given))

    def local_graph(self, action: ArrayLike | None = None) -> nx.MultiDiGraph:
        """Return the declared graph with the edges that are active now.

        An edge by contact is active if bodies that press on one another, directly or through
        movable bodies, join its cause to its effect. Edges into intervened variables are removed.

        Args:
            action: The next action. The control step is simulated to find the contacts in its
                physics steps, and undone. If None, the contacts are those of the last physics
                step, the only ones that a backend stores.

        Returns:
            A graph of variables; its edges have ``lag`` (in control steps) and ``when``.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
            ModelError: The contacts are not all known.
            NotReset: No episode has begun.

        Example:
            >>> world = World("pushing", backend="fake")
            >>> world.reset(seed=0)
            >>> graph = world.local_graph()
            >>> graph.has_edge("gravity", "tool_block.linear_velocity")
            True
            >>> graph.has_edge("joint_positions", "tool_block.linear_velocity")
            False
        """
        return local_graph(self, action)

    def planned(self, do: Mapping[str, Any] | None) -> Plan:
        """Return the plan of an episode: ``do`` over the interventions of ``given``."""
        asks_nothing = do is None or (
            type(do) is dict and not do
        )  # a plan may have a context alone
        plan = Plan() if asks_nothing else Questions.planned(self, do)
        check_names(self, plan)
        return plan.over(self._given, "given")


@final
class EngineWorld(World, Simulation):
    """A world with a physics engine; ``World`` makes it."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for copying and pickling, with the interventions of ``given``."""
        return (*super().__reduce__(), {"_given": self._given})

    @staticmethod
    def batched(worlds: Sequence[Any], *, threads: int | None, names: Sequence[str]) -> Batch:
        """Return worlds like this one as a table of rows that are advanced in one call."""
        return Batch(worlds, threads=threads, names=names)


@final
class EquationWorld(World, Equations):  # type: ignore[misc, override] # see ``_System``
    """A world of equations, without an engine; ``World`` makes it."""

    def takes_each(self, names: Iterable[str]) -> bool:
        """Return whether an intervention may have a value of these for each episode."""
        return not self._given and super().takes_each(names)

    @staticmethod
    def batched(
        worlds: Sequence[Any], *, threads: int | None, names: Sequence[str]
    ) -> EquationTable:
        """Return worlds like this one as a table of rows that are advanced in one call."""
        return EquationTable(worlds, threads=threads, names=names)

    def awaits(self, request: Mapping[str, Any]) -> bool:
        """Return whether an intervention waits for an event, which differs between episodes."""
        plans = [self._given, self._schedule.plan] if self._given or self.is_planned else []
        plans += [Plan(request)] if has_times(request) else []
        return any(act.time.when for plan in plans for _, act in plan.timed())
