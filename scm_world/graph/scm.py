"""Structural causal models: build, check, intervene, solve."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import replace
from functools import cached_property
from itertools import groupby, starmap
from typing import Any, Self

import networkx as nx
import numpy as np

from scm_world._arguments import true_or_false, typed, whole_number
from scm_world._patterns import as_names, is_pattern, meant
from scm_world._types import Value, Values
from scm_world.errors import (
    ClosesCycle,
    ConflictingTargets,
    CyclicModel,
    InterventionError,
    ModelError,
    NotIntervenable,
    UnknownOption,
    UnknownVariable,
    raise_all,
)
from scm_world.graph.evaluate import AppliedIntervention, evaluate, intended
from scm_world.graph.structure import Edge, EdgeIndex, checked
from scm_world.variables import (
    Derived,
    Draw,
    Exogenous,
    Fixed,
    Function,
    Intervention,
    Moment,
    Noise,
    NoiseKey,
    Variable,
    names,
)
from scm_world.variables.checks import check_rows
from scm_world.variables.interventions import accepted, joined
from scm_world.variables.moments import earlier
from scm_world.variables.spaces import Frozen

BEFORE = 2**32
"""The step whose noise is that of the instant before the first step."""


def request_of(given: object) -> Mapping[str, Any]:
    """Return what is requested, nothing for None; refuse what is no dictionary."""
    if given is not None and not isinstance(given, Mapping):
        raise UnknownOption("request", given, ("a dictionary of variables and values",))
    return {} if given is None else given


def flatten(
    request: Mapping[str, Any], twice: list[InterventionError] | None = None
) -> dict[str, Any]:
    """Return a request under dotted names; arrays and lists are copied.

    Args:
        request: Dotted or nested.
        twice: A list for the errors about names that are given twice, nested and dotted, and about
            empty dictionaries; the first value of such a name is kept. They are raised if None.

    Example:
        >>> flatten({"tool_block": {"mass": 0.05}, "floor_friction": 0.4})
        {'tool_block.mass': 0.05, 'floor_friction': 0.4}
    """
    if not isinstance(request, Mapping):
        raise UnknownOption("request", request, ("a dictionary of variables and values",))
    flat: dict[str, Any] = {}
    problems: list[InterventionError] = [] if twice is None else twice
    for name, value in request.items():
        parts = {name: value}
        if isinstance(value, (Frozen, float)):
            pass
        elif isinstance(value, tuple) and len(value) == 1 and isinstance(value[0], Frozen):
            parts[name] = value[0]  # the only intervention of a plan
        elif isinstance(value, Mapping):
            if not value:
                said = f"do({name}): an empty dictionary sets nothing; leave {name!r} out"
                problems.append(InterventionError(said, variable=name, value=value))
            parts = {f"{name}.{key}": part for key, part in flatten(value, problems).items()}
        elif isinstance(value, (list, tuple)) or hasattr(value, "__array__"):
            parts[name] = deepcopy(value)
        for key, part in parts.items():
            if key in flat:
                problems.append(ConflictingTargets((key, key), key))
            else:
                flat[key] = part
    if twice is None:
        raise_all(problems)
    return flat


def _asked(target: str, act: AppliedIntervention) -> tuple[str, Intervention]:
    """Return the requested name of an intervention, a part for a bundle, and the intervention."""
    return target if act.requested.parts else act.requested.name, act.intervention


def _check(*, key: object, **values: object) -> None:
    """Refuse a key of noise, and values by name, that are of another kind."""
    for option, given in values.items():
        if given is not None and not isinstance(given, Mapping):
            raise UnknownOption(option, given, ("a dictionary of variables and values",))
    if key is not None and not isinstance(key, NoiseKey):
        raise UnknownOption("key", key, ("a NoiseKey",))


class SCM:
    """A structural causal model over typed variables; ``scm_world.SCM`` can be asked, too.

    It is immutable: ``do`` returns another model. Edges of lag 0 act within an instant and form
    a directed acyclic graph; edges of lag 1 reach from one control step into the next.

    Args:
        variables: The declarations.

    Raises:
        ModelError: With every problem: duplicate names, unknown parents, cycles.
    """

    @typed
    def __init__(self, variables: Iterable[Variable]) -> None:
        self._declared, edges = checked(variables)
        vars(self)["structure"] = edges
        self._order: tuple[str, ...] = edges.order
        self._targets: dict[str, tuple[str, ...]] = {}  # looked up once
        self._settable: dict[Any, Variable] = {}  # those that an intervention was accepted on
        self._drawable: set[tuple[str, str]] = set()  # variables and spaces that they have
        self._acts: dict[str, AppliedIntervention] = {}
        self._context: dict[str, AppliedIntervention] = {}  # of ``given``
        self._done = frozenset[str]()  # targets of ``do``
        self._bundles = frozenset(name for name, v in self._declared.items() if v.parts)
        # Whether an intervention adds edges: a mechanism, or a draw from a space with parents.
        self.adds_edges = False

    def __fingerprint__(self) -> dict[str, Any]:
        """Return what decides its values: declarations by entity, functions, interventions."""
        found: dict[str, Any] = {}
        for variable in self._declared.values():
            fields = {name: getattr(variable, name) for name in type(variable).model_fields}
            functions = {name for name, value in fields.items() if isinstance(value, Function)}
            found |= {f"{name} of {variable.name!r}": fields[name] for name in sorted(functions)}
            entity = f"declaration of {variable.name.partition('.')[0]!r}"
            found.setdefault(entity, []).append(variable.model_dump_json(exclude=functions))
        layers = {"": self.interventions, " in the context": self.context}
        for where, acts in layers.items():
            for name, act in acts.items():
                root = act.root
                function = getattr(root, "function", None)
                named = {"function"} if isinstance(function, Function) else set()
                found[f"intervention on {name!r}{where}"] = [
                    act.model_dump_json(exclude={"below", *named}),
                    "" if root is act else root.model_dump_json(exclude={*named}),
                ]
                found |= {f"function that sets {name!r}{where}": function for _ in named}
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._declared)

    def __len__(self) -> int:
        return len(self._declared)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._declared

    def __getitem__(self, name: str) -> Variable:
        """Return the variable as it is in this model: ``Fixed`` where ``do`` has set it."""
        variable, act = self.declared(name), self._acts.get(name)
        if act is None or act.root.intervention.is_soft:
            return variable
        root, relative = act.root, act.relative
        done, requested = root.intervention, root.requested
        kept: dict[str, Any] = {field: getattr(variable, field) for field in Variable.model_fields}
        if done.computes:
            noise = done.noise_for(variable)
            return Derived(
                parents=done.follows(requested),
                mechanism=done.equation,
                noise=noise,
                inverse_noise=None if noise is None else done.noise_inverse,
                **kept,
            )
        if (source := done.distribution(requested) or relative) is not None:
            kept["per"] = "episode" if requested.per_episode else "step"
            return Exogenous(default=np.zeros(variable.shape), distribution=source, **kept)
        value = evaluate(name, act, Moment(self._declared, {}, {}, None))
        return Fixed(value=value, intervenable=True, **kept)

    def declared(self, name: str) -> Variable:
        """Return the variable as it was declared, before any intervention.

        Raises:
            UnknownVariable: No variable has this name.
        """
        try:
            return self._declared[name]
        except (KeyError, TypeError):  # or not hashable
            raise UnknownVariable(name, self._declared) from None

    @property
    def variables(self) -> tuple[Variable, ...]:
        """All variables as declared."""
        return tuple(self._declared.values())

    def done(self) -> dict[str, tuple[str, Intervention]]:
        """Return name and intervention of ``do`` by target, without the context beneath."""
        own = {t: _asked(t, act) for t, act in self._acts.items() if t in self._done}
        return {target: (name, act.on(None)) for target, (name, act) in own.items()}

    def _act_on(self, name: str) -> AppliedIntervention | None:
        """Return the intervention on a variable, if there is one."""
        return self._acts.get(name)

    @property
    def is_temporal(self) -> bool:
        """Whether it has lagged edges."""
        return any(edge.lag for edge in self.edges)

    @property
    def interventions(self) -> Mapping[str, Intervention]:
        """The interventions, by requested name; those on a bundle by the names of its parts."""
        return dict(starmap(_asked, self._acts.items()))

    @property
    def context(self) -> Mapping[str, Intervention]:
        """The interventions of ``given``, by requested name; see ``interventions``."""
        return dict(starmap(_asked, self._context.items()))

    def _beneath(self, target: str) -> tuple[str, Intervention] | None:
        """Return name and intervention of the context of one quantity, if there is one."""
        return _asked(target, self._context[target]) if target in self._context else None

    @cached_property
    def structure(self) -> EdgeIndex:
        """The edges of this model; those into a cut variable are gone."""
        return EdgeIndex({name: self[name].all_parents for name in self})

    @cached_property
    def _temporal(self) -> frozenset[str]:
        """The declared causes and effects of edges with a lag."""
        declared = self._declared.items()
        lagged = ((name, p.name) for name, v in declared for p in v.all_parents if p.lag)
        return frozenset(end for ends in lagged for end in ends)

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All edges."""
        return self.structure.edges

    def parents(self, name: str) -> tuple[str, ...]:
        """Return the direct causes, of any lag."""
        return tuple(dict.fromkeys(names(self[name].all_parents)))

    def children(self, name: str) -> tuple[str, ...]:
        """Return the direct effects, of any lag."""
        return tuple(self.structure.graph.successors(self.declared(name).name))

    def ancestors(self, name: str) -> frozenset[str]:
        """Return the direct and indirect causes; a variable that drives itself is one of them."""
        graph = self.structure.graph
        found = nx.ancestors(graph, self.declared(name).name)
        return frozenset(found | {name} if {name, *found} & {*graph.succ[name]} else found)

    def descendants(self, name: str) -> frozenset[str]:
        """Return the direct and indirect effects."""
        graph = self.structure.graph
        found = nx.descendants(graph, self.declared(name).name)
        return frozenset(found | {name} if {name, *found} & {*graph.pred[name]} else found)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, SCM)
            and self._declared == other._declared
            and self.interventions == other.interventions
            and self.context == other.context
        )

    __hash__ = None  # type: ignore[assignment] # compared by content

    def __repr__(self) -> str:
        held = f", do({', '.join(self.interventions)})" if self._acts else ""
        return f"SCM({len(self)} variables{held})"

    def targets(self, name: str) -> tuple[str, ...]:
        """Return the variables that an intervention acts on: the quantity itself, or all parts."""
        found = self._targets.get(name) if isinstance(name, str) else None
        if found is None:
            variable = self.declared(name)
            found = variable.parts or (name,)
            if variable.coordinates_of is not None:
                found = (variable.coordinates_of,)
            self._targets[name] = found
        return found

    def target(self, name: str) -> str:
        """Return the variable that an intervention acts on; the first one of a bundle."""
        return self.targets(name)[0]

    def do(self, request: Mapping[str, Any], *, any_variable: bool = False) -> Self:
        """Intervene: return the mutilated model and leave this one as it is.

        A later intervention on a variable takes the place of an earlier one, so that
        ``model.do(a).do(b) == model.do({**a, **b})``.

        Args:
            request: Values or interventions by name, dotted or nested.
            any_variable: Whether it may be on a readout, too. No experiment can do this in the
                world; it isolates a direct effect in the model.

        Raises:
            InterventionError: With every problem of the request.
            ClosesCycle: A mechanism, or a draw from a space that follows others, closes a cycle.
        """
        wanted: dict[str, Intervention] = {}
        problems: list[InterventionError] = []
        targets: dict[str, str] = {}
        everything = tuple(self) if true_or_false("any_variable", any_variable) else None
        flat = self.named(flatten(request, problems), problems, among=everything)
        for name, value in flat.items():
            try:
                act = self.accept(name, value, any_variable=any_variable)
                for target in self.targets(name):
                    if target in targets:
                        raise ConflictingTargets((targets[target], name), target)
                    targets[target] = name
                wanted[name] = act
            except InterventionError as problem:
                problems.append(problem)
        model, cycles = self._without_cycles(wanted)
        raise_all([*problems, *cycles])
        return model

    def named(
        self,
        request: Mapping[str, Any],
        problems: list[InterventionError] | None = None,
        *,
        among: Collection[str] | None = None,
    ) -> Mapping[str, Any]:
        """Return a request in which variables take the place of the patterns that they fit.

        A name counts more than a pattern, also where it has the letters of one; see
        ``scm_world._patterns.meant``.

        Args:
            request: Values or interventions by name or pattern.
            problems: A list for the errors; they are raised if None.
            among: The variables that patterns mean; all that can be set if None.

        Raises:
            UnknownVariable: A pattern fits nothing.
            ConflictingTargets: Two patterns fit one quantity.

        Example:
            >>> from scm_world.variables import Exogenous
            >>> model = SCM([Exogenous(name="left.mass"), Exogenous(name="right.mass")])
            >>> dict(model.named({"*.mass": 2.0}))
            {'left.mass': 2.0, 'right.mass': 2.0}
        """
        try:
            is_known = self._declared.keys() >= request.keys()  # as it is nearly always
        except (AttributeError, NotImplementedError):  # no dictionary
            is_known, request = False, flatten(request)
        if is_known:
            return request
        unknown = [name for name in request if name not in self._declared]
        if not any(map(is_pattern, unknown)):
            return request
        if among is None:
            among = [n for n in self if self._declared[self.targets(n)[0]].settable]
        literal = request.keys() - unknown
        found = meant(request, among, self.targets, problems, literal)
        return {name: joined(request[key], key) for name, key in found.items()}

    def _with_interventions(self, acts: Mapping[str, Intervention]) -> Self:
        """Apply checked interventions, or raise ``CyclicModel``; on a bundle, to its parts."""
        model = object.__new__(type(self))
        model._copy(self)
        parts: list[tuple[str, Intervention]] = []
        for name, act in acts.items():
            is_bundle = name in self._bundles
            parts += act.divided(self._declared[name]).items() if is_bundle else [(name, act)]
        done, may_add = {*self._done}, self.adds_edges
        for name, act in parts:
            target = self.targets(name)[0]
            model._acts.pop(target, None)
            done.discard(target)
            if not act.releases:
                alone = act.is_soft and act.lower is None
                whole = act.on(self._beneath(target)) if alone else act
                model._acts[target] = self._applied(name, whole)
                may_add |= whole.root.computes or whole.root.draws
                done.add(target)
            elif target in self._context:
                model._acts[target], may_add = self._context[target], True
        model._done = frozenset(done)
        if acts:
            vars(model).pop("structure", None)
        if may_add:
            roots = [act.root for act in model._acts.values()]
            model.adds_edges = any(
                act.computes or (act.draws and act.follows(of)) for act, of, _ in roots
            )
        if model.adds_edges:  # cutting edges keeps every causal order valid
            model._order = model.structure.order
        return model

    def _applied(self, name: str, act: Intervention) -> AppliedIntervention:
        """Return a checked intervention on one quantity, with those that it acts on."""
        below = act.lower and self._applied(*act.lower) if act.is_soft else None
        return AppliedIntervention(act, self._declared[act.whole(name)], below)

    def _as_context(self) -> Self:
        """Return the model whose interventions are a context, which further ones act on."""
        if not self._acts:
            return self
        model = object.__new__(type(self))
        model._copy(self)
        model._context, model._done = self._acts, frozenset()
        return model

    def given(self, request: Mapping[str, Any]) -> Self:
        """Return the model in a context: interventions that hold although nobody acts.

        The interventions of ``do`` lie above it, before or after: a shift or scale acts on what the
        context makes of a variable, and ``Natural`` leaves that. Within the context, as within
        ``do``, the last intervention on a variable counts, so that
        ``model.given(a).given(b) == model.given({**a, **b})``.

        Args:
            request: As in ``do``.

        Raises:
            InterventionError: With every problem of the request.

        Example:
            >>> from scm_world.variables import Exogenous, Shift
            >>> model = SCM([Exogenous(name="mass", default=1.0)]).given({"mass": 3.0})
            >>> float(model.do({"mass": Shift(0.5)}).solve()["mass"])
            3.5
        """
        bare = object.__new__(type(self))
        bare._copy(self)
        bare._acts, bare._context, bare._done = {}, {}, frozenset()
        vars(bare).pop("structure", None)
        bare.adds_edges, bare._order = False, bare.structure.order
        below = bare.do(self.context, any_variable=True).do(request)
        found = {n: act.in_context("given") for n, act in below.interventions.items()}
        below = below._with_interventions(found)._as_context()
        return below.do(dict(self.done().values()), any_variable=True)

    def _without_cycles(self, acts: Mapping[str, Intervention]) -> tuple[Self, list[ClosesCycle]]:
        """Apply checked interventions but those that close a cycle; return an error for each."""
        kept, problems = dict(acts), list[ClosesCycle]()
        while True:
            try:
                return self._with_interventions(kept), problems
            except CyclicModel as error:
                for cycle in error.cycles:
                    there = [n for n in kept if not {*self.targets(n)}.isdisjoint(cycle)]
                    roots = {n: kept[n].root for n in there}
                    new = [n for n, root in roots.items() if root.draws or root.computes]
                    closing = {name: kept.pop(name) for name in new or there}
                    problems += [ClosesCycle(*next(iter(closing.items())), cycle)]

    def _copy(self, other: SCM) -> None:
        vars(self).update(vars(other))
        self._acts = {**other._acts}

    def accept(self, name: str, value: object, *, any_variable: bool = False) -> Intervention:
        """Return one checked intervention: name, type, shape, finite, fixed bounds."""
        known = self._settable.get(name) if type(name) is str else None
        act = value if isinstance(value, Intervention) else None
        if known is not None and (act is None or not (act.draws or act.computes)):
            return accepted(self._declared, known, value)
        if not isinstance(name, str) or name not in self._declared:
            settable = (n for n, v in self._declared.items() if v.settable or any_variable)
            raise UnknownVariable(name, settable)
        target = self._declared[self.targets(name)[0]]
        whole = name if act is None else act.whole(name)
        if whole != name and name not in self.declared(whole).parts:
            raise InterventionError(
                f"do({name}): it is not a part of the bundle {whole!r}", variable=name, value=value
            )
        if not any_variable and not target.settable:
            reason = "is a constant" if target.is_constant else "is measured, not set"
            graph, passed = (
                self.structure.graph,
                (n for n in self if not self._declared[n].settable),
            )
            past = nx.bfs_tree(graph.subgraph(passed), target.name, reverse=True)
            causes = (c for n in past for c in graph.pred[n] if self._declared[c].settable)
            raise NotIntervenable(name, reason, [*dict.fromkeys(causes)])  # the nearest first
        if target.settable:
            self._settable[name] = self._declared[name]
        if isinstance(act, Draw) and act.time is None and (whole, act.source) in self._drawable:
            return act
        found = accepted(self._declared, self._declared[whole], value)
        if isinstance(act, Draw) and isinstance(act.source, str):
            self._drawable.add((whole, act.source))
        return found

    def solve(
        self,
        known: Values | None = None,
        *,
        previous: Values | None = None,
        key: NoiseKey | None = None,
        only: Iterable[str] | None = None,
        begins: bool = False,
    ) -> dict[str, Value]:
        """Compute every variable from the exogenous ones, shape ``(..., *shape)`` each.

        Every value has the leading batch axes of the known values, or of the draws of the key.

        Args:
            known: Values of exogenous and measured variables and of actions; batch axes may lead.
            previous: Values of one control step ago, for parents of lag 1, and those of longer lags
                as ``remembered`` names them. A missing one is the declared ``start`` or default of
                the parent; ``begins`` computes them under interventions.
            key: The key of the noise. Without it exogenous variables take their default and noise
                terms are zero.
            only: Compute these, in the order of the model, and take the rest from ``known``.
            begins: Whether this is the instant before the first step, which lagged children refer
                to. Variables with lagged causes or effects have their ``start`` or default there,
                unless an intervention replaces their mechanism; the rest follows from them. Only
                interventions, and variables of an episode, draw noise there.

        Raises:
            ModelError: A measured variable or an action has no value, or a computed variable has a
                known one, and ``only`` is not given.
            UnknownOption: An argument is of another kind.
        """
        _check(known=known, previous=previous, key=key)
        begins = true_or_false("begins", begins)
        only = None if only is None else [self.declared(name).name for name in as_names(only)]
        values: dict[str, Value] = dict(known or {})
        free = () if only is not None else (n for n in values if n in self and n not in self._acts)
        computed = [n for n in free if self._declared[n].equation is not None]
        if computed:  # an observed value would be ignored
            said = f"{', '.join(map(repr, computed))} is computed, so a value that was observed "
            said += "would be ignored; ask counterfactual(observed, do=…), or set it with do"
            raise ModelError([said])
        lead: tuple[int, ...] = ()  # batch axes: of the draws, or of what is known
        if key is not None and key.count is not None:
            lead = (key.count,)
        elif only is None:
            sizes = {name: len(self._declared[name].shape) for name in values if name in self}
            leads = (np.shape(values[n])[: np.ndim(values[n]) - k] for n, k in sizes.items())
            lead = np.broadcast_shapes(*leads)
        if begins and key is not None:
            key = replace(key, step=BEFORE)
        at = Moment(self._declared, values, {} if begins or previous is None else previous, key)
        for name in self._order if only is None else only:
            act = self._acts.get(name)
            found = self._first(name, act, at) if begins else evaluate(name, act, at)
            if act is not None and act.intervention.constant is None:  # else it was accepted
                check_rows(self._declared[name], found)
            shape = self._declared[name].shape
            bare = lead and np.ndim(found) <= len(shape)
            values[name] = np.broadcast_to(found, (*lead, *shape)) if bare else found
        return values

    def _first(self, name: str, act: AppliedIntervention | None, at: Moment) -> Value:
        """Compute a variable in the instant before the first step."""
        variable = self._declared[name]
        if act is None or act.root.intervention.keeps_function(variable):
            free = variable.is_root or variable.is_constant or variable.role == "action"
            if name in self._temporal and not free:
                return at.values.get(name, variable.first)
            if at.key and not variable.per_episode:
                quiet = variable.first if variable.is_root else np.zeros(variable.shape_of_noise)
                # Its own noise is absent; a draw by which an intervention moves it is not.
                at = replace(at, key=replace(at.key, given={name: quiet}))
        return evaluate(name, act, at)

    def _remembered(self, values: Values, previous: Values) -> dict[str, Value]:
        """Return the earlier values for the next control step, from those of the present.

        Values of ``lag`` control steps before the next one are named ``name@-lag``.
        """
        roots = [act.root for act in self._acts.values()]
        parents = [p for root in roots for p in root.intervention.follows(root.requested)]
        kept = dict(values)
        parents += [p for v in self._declared.values() for p in v.all_parents if p.lag > 1]
        for parent in parents:
            for lag in range(2, parent.lag + 1):
                before = previous.get(earlier(parent.name, lag - 1))
                if before is not None:
                    kept[earlier(parent.name, lag)] = before
        return kept

    def evaluate(
        self,
        name: str,
        values: Values,
        key: NoiseKey | None = None,
        act: AppliedIntervention | None = None,
    ) -> Value:
        """Compute one variable from its parents, under ``act``, or what is done to it here."""
        known = self.declared(name).name
        _check(values=values, key=key)
        at = Moment(self._declared, values, {}, key)
        return evaluate(known, act or self._acts.get(known), at)

    def _intended(
        self, name: str, act: AppliedIntervention, values: Values, key: NoiseKey
    ) -> Value:
        """Compute what an intervention makes of the variable that it was requested of."""
        return np.asarray(intended(name, act, Moment(self._declared, values, {}, key)))

    def draw(
        self, n: int, *, seed: int, first: int = 0, steps: int | None = None
    ) -> dict[str, Value]:
        """Draw from the model.

        Args:
            n: How many episodes, at least 1.
            seed: Seed of the noise, a whole number that is not negative.
            first: Number of the first episode: ``draw(1, first=i)`` is row i of a larger draw.
            steps: For a model with lagged edges, how many control steps.

        Returns:
            Every variable, shape ``(n, *shape)``, or ``(n, steps, *shape)``: the instants 1 to
            ``steps`` of episodes that are one control step longer.

        Raises:
            ModelError: The model has lagged edges and ``steps`` is not given.
            UnknownOption: An argument is not a whole number, or too small.
        """
        noise, n = Noise(seed), whole_number("n", n, least=1)
        first = whole_number("first", first, least=0)
        if first + n > 2**64:  # counters of the noise have 64 bits
            raise UnknownOption("first", first, (f"whole numbers up to 2**64 - n, with n = {n}",))
        if steps is None:
            if self.is_temporal:
                raise ModelError(["the model has lagged edges: say how many steps to sample"])
            return self._instant({}, NoiseKey(noise, first, 0, n), 0)
        slices: list[dict[str, Value]] = []
        before = self._instant({}, NoiseKey(noise, first, -1, n), 0)
        for step in range(whole_number("steps", steps, least=1)):
            slices.append(self._instant(before, NoiseKey(noise, first, step, n), step + 1))
            before = self._remembered(slices[-1], before)
        return {name: np.stack([s[name] for s in slices], axis=1) for name in self}

    def _instant(self, previous: Values, key: NoiseKey, step: int) -> dict[str, Value]:
        """Compute an instant, and the commands that are taken there: those of a control step."""
        values: dict[str, Value] = {}
        declared: Mapping[str, Any] = self._declared
        for commands, part in groupby(self._order, lambda n: declared[n].role == "action"):
            own, only = replace(key, step=step) if commands else key, [*part]
            given: dict[str, Any] = {"previous": previous, "key": own, "begins": own.step < 0}
            values = self.solve(values, only=only, **given)
            for name in only if commands else ():
                if (bounds := declared[name].bounds) is not None:
                    ends = bounds.bounds(declared[name].shape, {})
                    values[name] = np.clip(values[name], *ends)
        return values
