"""The causal queries of worlds and causal models."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, count, repeat
from typing import TYPE_CHECKING, Any, Self, final

import numpy as np

from scm_world._arguments import EPISODES, typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.graph import scm as graph
from scm_world.queries.abduction import Counterfactuals, counterfactuals
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.identification import Identification, identify
from scm_world.queries.plans import Plan, numbered
from scm_world.queries.progress import Progress, part
from scm_world.queries.samples import (
    ORDERLESS,
    Effect,
    Outcome,
    Samples,
    Setting,
    alike,
    as_outcome,
    as_outcomes,
    column,
    effect_of,
    is_category,
    read_each,
    refuse_late,
    usual_outcomes,
)
from scm_world.queries.together import EpisodeBatch
from scm_world.queries.twins import Twins, asked
from scm_world.variables import Variable
from scm_world.world import CausalSystem, CompiledModel, Equations

if TYPE_CHECKING:
    from scm_world.policies.scripted import AnyPolicy
    from scm_world.queries.samples import AnyOutcome
    from scm_world.queries.verification import Verification


class Questions:
    """Causal queries of a ``World`` or an ``SCM``, which they do not change."""

    __slots__ = ()

    def planned(self, do: Mapping[str, Any] | None) -> Plan:
        """Return the plan of an episode under an intervention, with labels as numbers."""
        system = self._asked()[1]
        model = system.natural_model
        if isinstance(do, Plan):
            plan = do._in_layers(lambda parts: dict(model.named(parts)))
        else:
            plan = Plan(numbered(model, {} if do is None else do))
        if not system.has_steps:
            for name, act in plan.timed():
                if act.time.start != 0:
                    allowed = ("none, or at=0: a model without lagged edges has one instant",)
                    raise UnknownOption(f"time of an intervention on {name}", act, allowed)
        return plan

    def _asked(self) -> tuple[Twins, CausalSystem]:
        """Return the twins, and the system with its declarations."""
        return asked(self)

    def close(self) -> None:
        """Free the engine, if there is one."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @typed
    def rollout(
        self,
        policy: AnyPolicy = None,
        *,
        seed: int = 0,
        episode: int = 0,
        do: Mapping[str, Any] | None = None,
        steps: int | None = None,
        record: Iterable[str] = (),
    ) -> Episode:
        """Run an episode and return its record.

        Args:
            policy: A function from the world to an action, shape (n_actions,); actions of shape
                (n_actions,) or (steps, n_actions); ``"random"``; or None for the idle action. See
                ``as_policy`` for other names.
            seed: Seed of the noise.
            episode: Number of the episode within that noise.
            do: Interventions, with or without a time.
            steps: Number of control steps; the task's default if None.
            record: Variables to record during the run; others are computed by replaying it.

        Raises:
            InterventionError: An intervention was refused.
            ActionError: The policy or its action is invalid.
        """
        (twins, system), names = self._asked(), as_names(record)
        return twins.episode(self._unit(seed, episode, do, policy, system.length(steps), names))

    @typed
    def live(
        self,
        policy: AnyPolicy = None,
        *,
        seed: int = 0,
        episode: int = 0,
        do: Mapping[str, Any] | None = None,
    ) -> Episode:
        """Begin a live episode, with methods ``step``, ``do``, ``split`` and ``episode``.

        Arguments and errors are those of ``rollout``; the policy acts if ``step`` is called without
        an action.
        """
        return Episode._live(self._asked()[0], self._unit(seed, episode, do, policy, 1))

    def _unit(self, seed: int, episode: int, do: Mapping[str, Any] | None, *rest: Any) -> Unit:
        """Return an episode to run."""
        number = whole_number("episode", episode, least=0, most=EPISODES)
        return Unit(whole_number("seed", seed, least=0), number, self.planned(do), *rest)

    def see(self, n: int, **options: Any) -> Samples:
        """Sample observational episodes; the options are those of ``sample``."""
        return self.sample(n, **options)

    @typed
    def sample(
        self,
        n: int,
        do: Mapping[str, Any] | None = None,
        *,
        outcomes: object = None,
        first: int = 0,
        progress: Progress | None = None,
        **setting: object,
    ) -> Samples:
        """Run episodes with or without an intervention, and return their outcomes.

        Args:
            n: Number of episodes.
            do: The intervention; none if None.
            outcomes: Names of variables (their final values), ``Outcome`` or functions of the
                episode; see ``usual_outcomes`` if None.
            first: Number of the first episode; with one seed, unit i is the same in every query.
            progress: Called after each episode with the numbers of finished and planned ones.
            setting: ``policy``, ``nature``, ``steps``, ``seed`` and ``workers``; see ``Setting``.
                By default the actions of a world are random, those of an SCM zero.

        Raises:
            InterventionError: An intervention was refused.
            UnknownOption: An outcome or a setting is invalid, or an intervention is later than the
                end of the episode.
        """
        system = self._asked()[1]
        wanted = usual_outcomes(system) if outcomes is None else outcomes
        checked = Setting.of(system, setting)
        return self._sample(n, self.planned(do), wanted, checked, first=first, progress=progress)

    def _sample(
        self,
        n: int,
        plan: Plan,
        outcomes: object,
        setting: Setting,
        *,
        first: int = 0,
        each: Sequence[Mapping[str, Any]] = (),
        progress: Progress | None = None,
    ) -> Samples:
        """Run episodes under a plan; ``each`` has further interventions for every single one."""
        n = whole_number("n", n, least=1)
        first = whole_number("first", first, least=0, most=EPISODES)
        (twins, system), wanted = self._asked(), as_outcomes(outcomes)
        for one in wanted:
            if is_category(one, system) and one.how not in ORDERLESS:
                name = f"summary of the categories of {one.name!r}"
                raise UnknownOption(name, one.how, ORDERLESS)
        names = tuple(dict.fromkeys(one.name for one in wanted if isinstance(one, Outcome)))
        unit = setting.unit(system, plan, first, names)
        refuse_late(plan, unit.steps)
        units = [replace(unit, number=number) for number in range(first, first + n)]
        if each:
            units = [replace(u, plan=u.plan.do(more)) for u, more in zip(units, each, strict=True)]

        done = count(1)

        def outcomes_of(episodes: EpisodeBatch) -> Iterator[tuple[Floats, ...]]:
            of_each = [read_each(one, episodes) for one in wanted]  # may be empty
            return zip(*of_each, strict=True) if of_each else repeat((), len(episodes))

        def finish(episodes: EpisodeBatch) -> Iterator[tuple[Floats, ...]]:
            for row in outcomes_of(episodes):
                yield row
                if progress is not None:
                    progress(next(done), n)

        rows = twins.run(units, finish, setting.workers)
        try:
            found = [np.array([row[i] for row in rows]) for i in range(len(wanted))]
        except ValueError:
            allowed = ("numbers of one shape in every episode",)
            raise UnknownOption("value of an outcome", "of several shapes", allowed) from None
        columns: dict[str, Floats] = {}
        for outcome, values in zip(wanted, found, strict=True):
            text = column(outcome)
            candidates = chain([text], (f"{text} ({number})" for number in count(2)))
            columns[next(name for name in candidates if name not in columns)] = values
        floors = dict[str, Floats]()
        if not twins.is_exact:
            apart = twins.floors(units, wanted, found, outcomes_of, setting.workers)
            floors = dict(zip(columns, apart, strict=True))
        return Samples(columns, tuple(unit.number for unit in units), setting.seed, plan, floors)

    def _arms(
        self,
        outcomes: tuple[Any, ...],
        plans: Sequence[Mapping[str, Any] | None],
        n: int,
        progress: Progress | None,
        setting: Mapping[str, Any],
        *,
        paired: bool = True,
        least: int = 2,
    ) -> list[Samples]:
        """Sample under each intervention, in the same units if paired."""
        system, n = self._asked()[1], whole_number("n", n, least=least)
        wanted = as_outcome(outcomes[0])
        if is_category(wanted, system):
            event = f"lambda episode: episode.final({wanted.name!r}) == …"
            allowed = ("a number", f"a function whose mean is a probability, as {event}")
            raise UnknownOption("outcome of an effect", wanted, allowed)
        shared, arms = Setting.of(system, setting), list[Samples]()
        for number, plan in enumerate(map(self.planned, plans)):
            share = part(progress, number * n, n * len(plans))
            first = 0 if paired else number * n
            arms.append(self._sample(n, plan, outcomes, shared, first=first, progress=share))
        return arms

    @typed
    def effect(
        self,
        outcome: AnyOutcome,
        *,
        do: Mapping[str, Any],
        versus: Mapping[str, Any] | None = None,
        n: int = 100,
        paired: bool = True,
        progress: Progress | None = None,
        **setting: object,
    ) -> Effect:
        """Estimate the average effect of an intervention on an outcome.

        Args:
            outcome: The name of a variable (its final value), an ``Outcome``, or a numerical
                function of the episode.
            do: The intervention.
            versus: The intervention of the control group; none if None.
            n: Number of units.
            paired: Whether both groups are the same units, with the same noise.
            progress: Called after each episode.
            setting: See ``sample``.

        Returns:
            Mean and 95 % interval of the difference, and the ratio of variances unpaired : paired.

        Raises:
            UnknownOption: The outcome is a category, which has no mean; a function can give the
                probability of one.
        """
        arms = self._arms((outcome,), (do, versus), n, progress, setting, paired=paired)
        return effect_of(self._asked()[1], outcome, *arms, paired=paired)

    @typed
    def direct_effect(
        self,
        outcome: AnyOutcome,
        *,
        do: Mapping[str, Any],
        versus: Mapping[str, Any] | None = None,
        mediators: Iterable[str] | Mapping[str, Any],
        n: int = 100,
        progress: Progress | None = None,
        **setting: Any,
    ) -> Effect:
        """Estimate the part of an effect that does not go through mediators.

        The *controlled* direct effect holds ``mediators``, values by name, in both arms. The
        *natural* one, of names alone, lets each unit keep, under ``do``, the values that its
        mediators have under ``versus``. Both are paired. The other arguments are those of
        ``effect``.

        Raises:
            UnknownOption: The natural effect is not defined for systems with several instants,
                where a mediator is a path; hold it with ``mediators={name: value}``.

        Source:
            Pearl, *Direct and indirect effects*, UAI 2001, definitions 1 and 3.
        """
        held_names = tuple(mediators) if isinstance(mediators, Mapping) else as_names(mediators)
        if getattr(as_outcome(outcome), "name", None) in held_names:
            raise UnknownOption("mediators", held_names, ("variables other than the outcome",))
        if isinstance(mediators, Mapping):
            held, other = ({**Plan(given), **mediators} for given in (do, versus))
            return self.effect(outcome, do=held, versus=other, n=n, progress=progress, **setting)
        system, names = self._asked()[1], as_names(mediators)
        n = whole_number("n", n, least=2)
        if system.has_steps:
            allowed = ("values of mediators by name, such as {'m': 1.0}: the controlled effect",)
            raise UnknownOption("mediators of several instants", names, allowed)
        outcomes = (outcome, *map(Outcome, names))
        (control,) = self._arms(outcomes, (versus,), n, part(progress, 0, 2 * n), setting)
        _, *kept = control.values()
        each = [dict(zip(names, row, strict=True)) for row in zip(*kept, strict=True)]
        given = n, self.planned(do), (outcome,), Setting.of(system, setting)
        treated = self._sample(*given, each=each, progress=part(progress, n, 2 * n))
        return effect_of(system, outcome, treated, control)

    @typed
    def effect_over(
        self,
        outcome: AnyOutcome,
        *,
        name: str,
        values: Sequence[Any],
        n: int = 100,
        progress: Progress | None = None,
        **setting: object,
    ) -> tuple[Effect, ...]:
        """Estimate the paired effects of values of a variable, each against the first one.

        ``values`` are two or more values of the variable ``name``; the other arguments are those of
        ``effect``.
        """
        if len(values) < 2:
            raise UnknownOption("values", values, ("two or more values of the variable",))
        plans = [{name: value} for value in values]
        control, *others = self._arms((outcome,), plans, n, progress, setting)
        return tuple(effect_of(self._asked()[1], outcome, one, control) for one in others)

    @typed
    def effect_by(
        self,
        outcome: AnyOutcome,
        *,
        do: Mapping[str, Any],
        versus: Mapping[str, Any] | None = None,
        by: AnyOutcome,
        bins: int = 4,
        n: int = 200,
        progress: Progress | None = None,
        **setting: object,
    ) -> tuple[tuple[tuple[float, float], Effect], ...]:
        """Estimate paired effects in groups of units by a covariate (CATE).

        The covariate ``by`` is an outcome of one number, computed under ``versus``. The ``n`` units
        are sorted into ``bins`` groups of equal size. Units with equal values are in one group, so
        a covariate with at most ``bins`` values has a group for each. The other arguments are those
        of ``effect``.

        Returns:
            For each group the range of the covariate, and the effect.
        """
        plans, least = (do, versus), 2 * whole_number("bins", bins, least=1)
        treated, control = self._arms((outcome, by), plans, n, progress, setting, least=least)
        system, (_, place) = self._asked()[1], control.values()
        if place.ndim != 1:
            allowed = ("one number for each unit, such as Outcome(name, 'first', 0)",)
            raise UnknownOption("by", by, allowed)
        kinds = len(np.unique(place))
        if is_category(as_outcome(by), system) and kinds > bins:
            raise UnknownOption("bins", bins, (f"{kinds} or more: categories have no order",))
        return tuple(
            (
                (float(place[group].min()), float(place[group].max())),
                effect_of(system, outcome, treated, control, rows=group),
            )
            for group in alike(place, bins)
        )

    def verify(self, **options: Any) -> Verification:
        """Check the declared graph against physics or equations; see ``scm_world.verify``."""
        from scm_world.queries.verification import verify

        system: Any = self
        return verify(system, **options)

    def identify(self, treatment: str, outcome: str, **options: Any) -> Identification:
        """Find variables that identify an effect; see ``scm_world.queries.identify``."""
        system: Any = self
        return identify(system.graph, treatment, outcome, **options)


@final
class SCM(Questions, graph.SCM):
    """A structural causal model over typed variables, with the queries of a ``World``.

    It is immutable: ``do`` returns another model. Edges of lag 0 act within an instant and form
    a directed acyclic graph; edges of lag 1 act from one control step on the next.

    Episodes of a model without lagged edges have one instant. Those of a model with lagged edges
    begin at the ``start`` or default values of its variables and have ``steps`` control steps;
    variables with noise or a distribution are drawn in each step.

    Args:
        variables: The declarations, or a model of ``scm_world.graph``.

    Raises:
        ModelError: With every problem: duplicate names, unknown parents, cycles.

    Example:
        >>> from scm_world.variables import Box, Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="mass", unit="kg", default=0.02, distribution=Box(0.015, 0.045)),
        ...     Derived(name="weight", unit="N", parents=("mass",),
        ...             mechanism=Linear(weights=(9.81,))),
        ... ])
        >>> model.sample(1000, seed=0)["weight"].shape
        (1000,)
        >>> heavy = model.rollout(seed=1).counterfactual({"mass": 0.1})
        >>> round(float(heavy.final("weight")), 3)
        0.981
        >>> model.effect("weight", do={"mass": 0.1}, versus={"mass": 0.0}, n=10).mean.round(3)
        np.float64(0.981)
    """

    @typed
    def __init__(self, variables: Iterable[Variable] | graph.SCM) -> None:
        if isinstance(variables, graph.SCM):
            self._copy(variables)
        else:
            super().__init__(variables)

    @property
    def graph(self) -> Self:
        """The model itself; a ``World`` has the model of its backend here."""
        return self

    def counterfactual(
        self,
        observed: object,
        do: Mapping[str, Any] | None = None,
        *,
        n: int | None = None,
        seed: int = 0,
        tolerance: float = 1e-6,
    ) -> Counterfactuals:
        """Return counterfactuals of observed units under an intervention.

        Abduction infers the noise of each unit from its observed values; then the model is solved
        again under the intervention, with the same noise. The noise of observed variables follows
        from their ``inverse_noise``. If several values are possible, no inverse is declared or the
        variable was not observed, noise is drawn and weighed by the observations. The replay of a
        simulated episode, whose noise is known, is ``rollout(…).counterfactual(do)``.

        Args:
            observed: Values or labels by name, of some or all variables: a row (values of the shape
                of the variable), or a table (with a leading axis, a data frame, or a ``Dataset``);
                NaN where there is none. With lagged edges, a column has the control steps before
                the shape; a frame or a dataset has a row for each. The first row is the instant
                after the start, as in ``draw(steps=)``: leave out row 0 of an ``Episode``.
            do: The intervention; the observations were made without it. With lagged edges it may
                have times: ``At`` and ``Clamp``, in control steps of the observations.
            n: Number of draws for each unit; if None, 1 if everything follows exactly, else 1000.
            seed: Seed of the draws.
            tolerance: Largest accepted difference between an observation and the computed value,
                relative to one plus its size.

        Returns:
            Counterfactual and factual values by name, weights and effective number of draws.

        Raises:
            ImpossibleObservation: The model cannot give it; the error names the variable.
            ModelError: No draw agrees with an observation; the error gives a remedy.
            InterventionError: The intervention was refused.

        Example:
            >>> from scm_world.variables import Derived, Exogenous, Linear, Normal
            >>> model = SCM([
            ...     Exogenous(name="x", distribution=Normal()),
            ...     Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)),
            ...             noise=Normal()),
            ... ])
            >>> found = model.counterfactual({"x": 1.0, "y": 2.5}, do={"x": 3.0})
            >>> print(found["y"], found.exact)
            6.5 True
        """
        if do is None:
            allowed = (
                "an intervention, as in counterfactual(observed, do={…})",
                "a replay of a simulated unit, rollout(seed=…).counterfactual({…})",
            )
            raise UnknownOption("do", do, allowed)
        return counterfactuals(self, observed, do, n, seed, tolerance)

    def _asked(self) -> tuple[Twins, CausalSystem]:
        system = vars(self).get("_system")
        if system is None or system.model is not self:  # that of the model this was made from
            system = self._system = Equations(CompiledModel(self))
        return asked(system)
