"""Plans: interventions on several variables, each with its time, as one value."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple, final

import numpy as np
from pydantic import TypeAdapter

from scm_world._arguments import one_of, typed
from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    ModelError,
    UnknownOption,
    UnknownVariable,
)
from scm_world.graph import SCM, flatten
from scm_world.variables import (
    Categories,
    Contact,
    Draw,
    Function,
    Hard,
    Intervention,
    Natural,
    Reaches,
    Time,
)
from scm_world.variables.kinds import SPACES
from scm_world.variables.mechanisms import check_portable, check_trusted
from scm_world.variables.reserved import CONTROL_INDEX
from scm_world.world import Audit, CausalSystem, Simulation
from scm_world.world.interventions import Level

FORMAT = "scm_world/plan/2"

CONTEXT = ("given", "start", "nature", "curriculum")
"""The kinds of context, from the lowest layer up."""

OWN = -1
"""The number of the layer above all context: of what is asked."""

Key = tuple[str, Contact | Reaches, int, int]
"""Variable, awaited event, the control step from which it is awaited, and layer."""


Draws = tuple[int, str, int, Time | None]
"""Layer, variable, control step of a draw, and time of the intervention that draws."""


@final
@dataclass
class Memory:
    """What a plan has to know of its past in an episode.

    Attributes:
        fired: Control steps at which events occurred.
        drawn: Interventions with the numbers that were drawn, by target; by layer, variable, the
            control step of the draw and the time of the intervention.
    """

    fired: dict[Key, int] = field(default_factory=dict)
    drawn: dict[Draws, dict[str, tuple[str, Intervention]]] = field(default_factory=dict)

    def until(self, step: int) -> Memory:
        """Return a copy of what is known before a control step."""
        drawn = {key: acts for key, acts in self.drawn.items() if key[2] < step}
        return Memory({key: at for key, at in self.fired.items() if at < step}, drawn)

    def forget(self, name: str, step: int) -> None:
        """Forget what was drawn now by the layer above all context: there is another draw."""
        for key in [key for key in self.drawn if key[:3] == (OWN, name, step)]:
            del self.drawn[key]

    def copy(self) -> Memory:
        """Return a copy, which can be changed alone."""
        return Memory(dict(self.fired), dict(self.drawn))


class Force(NamedTuple):
    """An intervention that is in force, the control step at which it began, its name and layer."""

    start: int
    act: Intervention
    name: str
    layer: int

    @property
    def key(self) -> Draws:
        """Its place in the memory of a plan."""
        return self.layer, self.name, self.start, self.act.time


_PARTS: TypeAdapter[dict[str, tuple[Intervention, ...]]] = TypeAdapter(
    dict[str, tuple[Intervention, ...]]
)


Layer = tuple[str, dict[str, tuple[Intervention, ...]]]
"""What a layer is of, and the interventions on each variable."""


def as_act(value: object) -> Any:
    """Return an intervention: ``Hard`` for a plain value, ``Draw`` for the name of a space."""
    if isinstance(value, Intervention):
        return value
    if isinstance(value, dict):
        if "kind" in value:  # from a file
            return value
        allowed = "a value or an intervention: {'pole.mass': Hard(1.0, at=3)}, not Hard({…})"
        raise UnknownOption("act", value, (allowed,))
    if isinstance(value, str) and value in SPACES:
        return Draw(value)
    return Hard(value.tolist() if isinstance(value, np.ndarray) else value)


def at_once(act: Intervention) -> Intervention:
    """Return an intervention without its time."""
    return act if act.time is None else act.model_copy(update={"time": None})


def retimed(act: Intervention, **time: object) -> Intervention:
    """Return an intervention with another time; see ``Time``."""
    return act.model_copy(update={"time": Time(**time)})


@final
class Plan(Mapping[str, tuple[Intervention, ...]]):
    """Interventions on variables, with their times. A plan is immutable.

    Later ones replace earlier ones: ``do(a).do(b) == do({**a, **b})``. An intervention without a
    time is applied at the beginning of the episode, or at the instant of a counterfactual.

    Each intervention exists from its time to its end. Of several on one quantity that which began
    last is in force; at its end the one before is in force again. A plan may lie above a context:
    layers that hold without anyone acting, see ``over``. ``Shift`` and ``Scale`` act on what the
    layers below make of the variable, and ``Natural`` shows that.

    Args:
        request: Values or interventions by variable, dotted or nested. Interventions may have a
            time (``at=``, ``during=``, ``every=``, ``when=``); several form a tuple or list.

    Raises:
        UnknownOption: A value is not an intervention, or a name is not text.

    Example:
        >>> plan = Plan({"tool_block": {"mass": 0.05}, "floor_friction": Hard(0.2, at=10)})
        >>> plan.do({"tool_block.mass": 0.08}) == Plan(
        ...     {"tool_block.mass": 0.08, "floor_friction": Hard(0.2, at=10)}
        ... )
        True
        >>> Plan.from_json(plan.to_json()) == plan
        True
    """

    __slots__ = ("_context", "_parts")

    def __init__(self, request: Mapping[str, Any] | None = None) -> None:
        self._context: tuple[Layer, ...] = ()
        if isinstance(request, Plan):
            self._parts: dict[str, tuple[Intervention, ...]] = request._parts
            self._context = request._context
        else:
            flat = flatten({} if request is None else request)
            for name in flat:
                if not isinstance(name, str):
                    allowed = ("text, such as 'tool_block.mass'",)
                    raise UnknownOption("name of a variable", name, allowed)
            self._parts = {}
            for name, value in flat.items():
                try:
                    self._parts[name] = _several(value)
                except ModelError as error:
                    allowed = ("a number", "an array of numbers", "an intervention", *SPACES)
                    raise UnknownOption(name, value, allowed) from error

    @classmethod
    def _of(
        cls,
        parts: dict[str, tuple[Intervention, ...]],
        context: Iterable[tuple[str, dict[str, tuple[Intervention, ...]]]] = (),
    ) -> Plan:
        """Return the plan of interventions by dotted name over a context, without checks."""
        plan = cls.__new__(cls)
        plan._parts, plan._context = parts, tuple(context)
        return plan

    @property
    def context(self) -> tuple[tuple[str, Plan], ...]:
        """The layers below, from the lowest up, each with its kind; see ``CONTEXT``."""
        return tuple((kind, Plan._of(parts)) for kind, parts in self._context)

    def over(self, below: Mapping[str, Any] | None, kind: str) -> Plan:
        """Return the plan over a context, which lies below others of its kind and of higher kinds.

        Example:
            >>> from scm_world.variables import Shift
            >>> plan = Plan({"mass": Shift(0.1)}).over({"mass": "A"}, "nature")
            >>> [kind for kind, _ in plan.over({"mass": 2.0}, "given").context]
            ['given', 'nature']
        """
        one_of("kind of context", kind, CONTEXT)
        lower = Plan(below)._each(lambda act: act.in_context(kind))
        more = [(kind, parts) for parts in (*(p for _, p in lower._context), lower._parts) if parts]
        layers = [*more, *self._context]
        return Plan._of(self._parts, sorted(layers, key=lambda one: CONTEXT.index(one[0])))

    def _replacing(self, request: Mapping[str, Any], model: SCM) -> Plan:
        """Return the plan with interventions instead of all others on the same quantities."""
        new = {target for name in request for target in targets(model, name)}
        kept = {n: acts for n, acts in self._parts.items() if not new.issuperset(targets(model, n))}
        return Plan._of({**kept, **Plan(request)._parts}, self._context)

    def layers(self) -> list[tuple[int, dict[str, tuple[Intervention, ...]]]]:
        """Return the interventions of each layer with its number, from the lowest up."""
        return [*enumerate(parts for _, parts in self._context), (OWN, self._parts)]

    def __getitem__(self, name: str) -> tuple[Intervention, ...]:
        if not isinstance(name, str) or name not in self._parts:
            raise UnknownVariable(name, self._parts)
        return self._parts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def __bool__(self) -> bool:
        """Return whether there are any interventions, in any layer."""
        return any(parts for _, parts in self.layers())

    def __eq__(self, other: object) -> bool:
        mine = (self._parts, self._context)
        return isinstance(other, Plan) and mine == (other._parts, other._context)

    def __hash__(self) -> int:
        return hash(frozenset(self._parts))

    def __repr__(self) -> str:
        over = "".join(f".over({parts}, {kind!r})" for kind, parts in self._context)
        return f"Plan({self._parts}){over}"

    def __str__(self) -> str:
        if not self._parts:
            return "no intervention"
        acts = (f"{name} = {_short(act)}" for name, acts in self._parts.items() for act in acts)
        return f"do({', '.join(acts)})"

    def do(self, request: Mapping[str, Any]) -> Plan:
        """Return a plan with further interventions, which replace those on the same variables."""
        return Plan._of({**self._parts, **Plan(request)._parts}, self._context)

    def at_start(self) -> dict[str, Intervention]:
        """Return the interventions at the first instant, by variable and without times."""
        return {
            name: at_once(act)
            for name, acts in self._parts.items()
            for act in acts
            if act.time is None or act.time.start == 0
        }

    @typed
    def composed(self, model: SCM) -> dict[str, Any]:
        """Return what all layers together do at the beginning, complete with what lies below."""
        system: Any = SimpleNamespace(model=model, is_set_at_once=lambda name: False)
        return self._due(system, 0, Memory())

    @typed
    def only(self, wanted: Callable[[str, Any], bool]) -> Plan:
        """Return the plan with the interventions that are wanted, by variable and intervention."""

        def kept(parts: Mapping[str, Any]) -> dict[str, Any]:
            found = {n: tuple(act for act in acts if wanted(n, act)) for n, acts in parts.items()}
            return {name: acts for name, acts in found.items() if acts}

        found = self._in_layers(kept)
        return Plan._of(found._parts, [one for one in found._context if one[1]])

    def timed(self) -> Iterator[tuple[str, Any]]:
        """Yield the interventions with a time, those of the context first."""
        for _, parts in self.layers():
            for name, acts in parts.items():
                yield from ((name, act) for act in acts if act.time is not None)

    def acts(self) -> Iterator[tuple[str, Intervention]]:
        """Yield all interventions, those of the context first, without their times."""
        for _, parts in self.layers():
            for name, acts in parts.items():
                yield from ((name, at_once(act)) for act in acts)

    @typed
    def named(
        self,
        model: SCM,
        among: Collection[str] | None = None,
        problems: list[InterventionError] | None = None,
    ) -> Plan:
        """Return the plan with the variables of a model that its patterns fit.

        Args:
            model: The model.
            among: The only variables that patterns mean; all that can be set if None.
            problems: A list for the errors; they are raised if None.

        Raises:
            InterventionError: A pattern fits nothing, or two fit one quantity.
        """
        return self._in_layers(lambda parts: dict(model.named(parts, problems, among=among)))

    def _each(self, change: Callable[[Any], Any]) -> Plan:
        """Return the plan with a change of each intervention."""
        return self._in_layers(lambda parts: {n: tuple(map(change, a)) for n, a in parts.items()})

    def _in_layers(self, change: Callable[[Mapping[str, Any]], dict[str, Any]]) -> Plan:
        """Return the plan with a change of what each layer contains."""
        return Plan._of(change(self._parts), [(kind, change(p)) for kind, p in self._context])

    # --- in an episode ------------------------------------------------------------------------

    @typed
    def then(
        self, request: Mapping[str, Any] | None, model: SCM, *, at: int, done: bool = False
    ) -> Plan:
        """Return a plan with further interventions, from a control step on; refuse earlier ones.

        From then on they replace the others on the same quantities: what would begin later does
        not, and what has begun lies beneath them. Those without a time are applied at that step,
        and events are awaited from there on. If this plan has acted at that step already
        (``done``), its interventions at that step are kept, unless the request has one for the
        same quantity and step.
        """
        asked = Plan(request).named(model)
        more = {n: tuple(_since(n, act, at) for act in acts) for n, acts in asked.items()}
        replaced = {target for name in more for target in targets(model, name)}
        now = {
            target
            for name, acts in more.items()
            if any(act.time is None or act.time.start == at for act in acts)
            for target in targets(model, name)
        }
        parts: dict[str, tuple[Intervention, ...]] = {}
        for name, acts in self._parts.items():
            own, kept = targets(model, name), acts
            if replaced.issuperset(own):
                end = at + 1 if done and not now.issuperset(own) else at
                kept = tuple(part for act in acts for part in _until(act, end))
            if kept:
                parts[name] = kept
        parts |= {n: (*parts.get(n, ()), *acts) for n, acts in more.items()}
        return Plan._of(parts, self._context)

    def _act(
        self,
        world: CausalSystem,
        step: int,
        memory: Memory,
        do: Callable[..., Audit],
        names: Iterable[str] | None = None,
    ) -> Audit | None:
        """Apply the interventions of the beginning of a control step; None if there are none.

        ``do`` applies them, and the memory is brought up to date. ``names`` are the only variables
        that may change; all if None. What the context draws does not depend on what is asked.
        """
        forces, moved = self._moved(world, step, memory)
        if names is not None:
            mine = {target for name in names for target in targets(world.model, name)}
            moved = [n for n in moved if not mine.isdisjoint(targets(world.model, n))]
        if not moved:
            return None
        chains = _chains(world, step, forces, moved)
        request = _requests(world, moved, chains, memory)
        if not world.keeps_draws:
            return do(request)
        simulation: Any = world
        context = [force for force in forces if force.layer != OWN]
        own = len(context) < len(forces)
        level = _level(simulation, step, context, moved, memory) if own else None
        levels = (level, Level(request, _draws(chains, memory)))
        audit = do(request) if level is None else do(request, levels=levels)
        self._keep_draws(simulation, step, chains, memory)
        return audit

    def _asked_of_all(self, world: Simulation, steps: int) -> dict[int, dict[str, Any]] | None:
        """Return what is asked for at each instant of episodes that begin alike, by instant.

        None if that depends on the episode: on an event, on what was drawn in it before, on what
        the context draws whatever is asked, or on its structure or clock.

        Args:
            world: One in which the episodes begin.
            steps: Number of control steps.
        """
        compiled, memory, found = world.compiled, Memory(), dict[int, dict[str, Any]]()
        times = [act.time for _, act in self.timed()]
        if any(time.when is not None for time in times):
            return None
        apart = {*compiled.composition.structural, *world.deciding, CONTROL_INDEX}
        for step in range(max(steps, 1) if times else 1):
            try:
                forces, moved = self._moved(world, step, memory)
                chains = _chains(world, step, forces, moved)
                context = [force for force in forces if force.layer != OWN]
                levels = context if len(context) < len(forces) else []
                if moved and _level(world, step, levels, moved, memory) is not None:
                    return None
                request = _requests(world, moved, chains, memory)
                hidden = [(one.name, at_once(one.act)) for one in forces if one.act.draws]
                for name, act in (*request.items(), *hidden):
                    world.model.accept(name, act)
                names = {*chains, *compiled.static_order(tuple(chains))}
            except InterventionError:  # which is that of each episode
                return None
            drawn = (one for chain in chains.values() for one in chain if one.act.has_draw)
            if any(one.start < step for one in drawn) or not apart.isdisjoint(names):
                return None
            if moved:
                found[step] = request
        return found

    def _due(self, world: CausalSystem, step: int, memory: Memory) -> dict[str, Intervention]:
        """Return the interventions at the beginning of a control step, without times.

        Each is complete: a soft one has what it acts on ``below`` it. Events of the present instant
        are added to the memory.
        """
        forces, moved = self._moved(world, step, memory)
        return _requests(world, moved, _chains(world, step, forces, moved), memory)

    def _windows(self, step: int, memory: Memory) -> dict[str, Any]:
        """Return the interventions in force at a control step that have a window."""
        found = (_in_force(n, acts, OWN, step, memory) for n, acts in self._parts.items())
        return {one.name: one.act for one in found if one is not None and one.act.holds(step)}

    def _concerns(self, world: CausalSystem, step: int, memory: Memory) -> bool:
        """Return whether an intervention may be due at a control step, whatever the state."""
        for layer, parts in self.layers():
            for name, acts in parts.items():
                if any(_awaited(name, act, layer, step, memory) is not None for act in acts):
                    return True
                found = _in_force(name, acts, layer, step, memory)
                if _changes(name, acts, layer, step, memory, world, found):
                    return True
        return False

    def _moved(
        self, world: CausalSystem, step: int, memory: Memory
    ) -> tuple[list[Force], list[str]]:
        """Return what is in force, the lowest layer first, and the variables that change now."""
        forces, moved = list[Force](), list[str]()
        for layer, parts in self.layers():
            for name, acts in parts.items():
                for act in acts:
                    key = _awaited(name, act, layer, step, memory)
                    if key is not None and happens(key[1], world):
                        memory.fired[key] = step
                    once = act.is_soft or act.draws  # at one instant, not at each of a window
                    if once and act.holds(step) and world.is_set_at_once(name):
                        raise InterventionError(
                            f"do({name}): a state is held at a value or by a Mechanism, not by "
                            f"{act!r}",
                            variable=name,
                            value=act,
                        )
                found = _in_force(name, acts, layer, step, memory)
                if found is not None:
                    forces.append(found)
                if _changes(name, acts, layer, step, memory, world, found):
                    moved.append(name)
        return forces, moved

    def _keep_draws(
        self, world: Simulation, step: int, chains: Mapping[str, list[Force]], memory: Memory
    ) -> None:
        """Remember the numbers that are drawn now, also by what lies beneath an intervention."""
        model = world.model
        for layer, parts in self.layers():
            last = {(n, act.time): act for n, acts in parts.items() for act in acts}
            for (name, _), act in last.items():  # of two with one time the last one counts
                if not act.has_draw or name not in model:
                    continue
                force = Force(step, act, name, layer)
                begins = _begun(name, act, layer, step, memory) == step
                known = force.key in memory.drawn or chains.keys().isdisjoint(targets(model, name))
                if not begins or known or name in world.compiled.commanded:
                    continue
                kept, hidden = (
                    dict[str, tuple[str, Intervention]](),
                    dict[str, tuple[str, Intervention]](),
                )
                for target in targets(model, name):
                    above = [one.act is act for one in reversed(chains.get(target, ()))]
                    if True in above:
                        found = world.last.settled(target)
                        for _ in range(above.index(True)):
                            found = found[1].lower
                        kept[target] = found[0], found[1].on(None)
                    else:
                        hidden = hidden or world._drawn(name, at_once(act))
                        kept[target] = hidden[target]
                memory.drawn[force.key] = kept

    # --- files --------------------------------------------------------------------------------

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain data.

        Raises:
            ModelError: A function cannot be imported by its name, or a number is not finite.
        """
        check_portable(self._functions())
        problems = list[str]()
        for name, act in self.acts():
            if not act.is_finite:
                text = "has a number that is not finite, which JSON does not have"
                problems.append(f"do({name}): {act!r} {text}")
        if problems:
            raise ModelError(problems)
        plain: Any = [[k, _PARTS.dump_python(parts, mode="json")] for k, parts in self._context]
        more = {"context": plain} if plain else {}
        return {"format": FORMAT, "do": _PARTS.dump_python(self._parts, mode="json"), **more}

    def to_json(self) -> str:
        """Return the plan as JSON, without loss; errors as in ``as_dict``."""
        return json.dumps(self.as_dict(), allow_nan=False)

    @classmethod
    def from_dict(cls, data: object, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Further packages whose functions may be mechanisms.

        Raises:
            ModelError: The data is not a plan, or has a function outside of the trusted packages.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise ModelError([f"not a plan: expected the format {FORMAT!r}; write it again"])
        try:
            layers = [(k, _PARTS.validate_json(json.dumps(d))) for k, d in data.get("context", ())]
            plan = cls._of(_PARTS.validate_json(json.dumps(data["do"])), layers)
            for kind, _ in layers:
                one_of("kind of context", kind, CONTEXT)
        except Exception as error:
            raise ModelError([f"not a plan: {error}"]) from None
        check_trusted(plan._functions(), trusted)
        return plan

    @classmethod
    def from_json(cls, text: str, *, trusted: Sequence[str] = ()) -> Plan:
        """Read a plan that ``to_json`` wrote; see ``from_dict``."""
        try:
            data = json.loads(text)
        except Exception as error:
            raise ModelError([f"not a plan: {error}"]) from None
        return cls.from_dict(data, trusted=trusted)

    def _functions(self) -> Iterable[Function]:
        for _, act in self.acts():
            yield from act.root.functions()


def _short(act: Intervention) -> str:
    return act.describe() if act.time is None else f"{act.describe()} {act.time}"


def _several(value: object) -> tuple[Intervention, ...]:
    if isinstance(value, list | tuple) and any(isinstance(act, Intervention) for act in value):
        return tuple(map(as_act, value))
    return (as_act(value),)


def do(request: Mapping[str, Any]) -> Plan:
    """Return a plan of interventions; see ``Plan``.

    Example:
        >>> do({"floor_friction": 0.3}).do({"floor_friction": 0.4})
        Plan({'floor_friction': (Hard(kind='hard', value=0.4),)})
    """
    return Plan(request)


def numbered(model: SCM, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return a request under dotted names, with labels of categories as numbers."""
    found = dict(model.named(flatten(request)))
    for name, value in found.items():
        bounds = model.declared(name).bounds if isinstance(value, str) and name in model else None
        if isinstance(bounds, Categories) and value in bounds.labels:
            found[name] = int(bounds.numbers(value))
    return found


def check_names(world: CausalSystem, plan: Plan) -> None:
    """Refuse names of timed interventions that do not exist in a world, and never will."""
    for name in dict.fromkeys(name for name, _ in plan.timed()):
        if not world.may_have(name):
            raise UnknownVariable(name, tuple(world.model))


def targets(model: SCM, name: str) -> tuple[str, ...]:
    """Return the quantities that a name sets; the name itself if it is unknown."""
    return model.targets(name) if name in model else (name,)


# --- what is in force -----------------------------------------------------------------------------


def _awaited(name: str, act: Intervention, layer: int, step: int, memory: Memory) -> Key | None:
    """Return the event for which an intervention waits at a control step."""
    time = act.time
    if time is None or time.when is None or not time.first < step or not time.covers(step):
        return None
    key = name, time.when, time.first, layer
    return None if key in memory.fired else key


def _begun(name: str, act: Intervention, layer: int, step: int, memory: Memory) -> int:
    """Return the control step at which an intervention began; later than now if it is not there."""
    time = act.time
    if time is None:
        return 0
    if time.when is not None:
        return memory.fired.get((name, time.when, time.first, layer), step + 1)
    if time.during is not None:
        return time.first if time.holds(step) else step + 1
    if time.every is not None and step >= time.first:
        return step - (step - time.first) % time.every
    return time.first


def _in_force(
    name: str, acts: Iterable[Intervention], layer: int, step: int, memory: Memory
) -> Force | None:
    """Return which of the interventions of a layer on a variable is in force: the last to begin."""
    found: Force | None = None
    for act in acts:
        start = _begun(name, act, layer, step, memory)
        if start <= step and (found is None or start >= found.start):
            found = Force(start, act, name, layer)
    return found


def _changes(
    name: str,
    acts: Iterable[Intervention],
    layer: int,
    step: int,
    memory: Memory,
    world: CausalSystem,
    now: Force | None,
) -> bool:
    """Return whether a layer changes a variable at a control step; ``now`` is what is in force."""
    if step and not world.is_set_at_once(name):
        before = _in_force(name, acts, layer, step - 1, memory)
        if now is None or before is None:
            return now is not before
        return now.start != before.start or now.act is not before.act
    return now is not None and (not step or _acts_on_state(now, step))


def _acts_on_state(force: Force, step: int) -> bool:
    """Return whether a state is set now: at the instant, or in each step of a window."""
    return force.start == step or force.act.holds(step)


def _chains(
    world: CausalSystem, step: int, forces: Iterable[Force], moved: Iterable[str]
) -> dict[str, list[Force]]:
    """Return what determines each quantity that changes: a replacement, and soft ones above it."""
    model, own = world.model, world.model.done()
    found: dict[str, dict[int, Force]] = {t: {} for name in moved for t in targets(model, name)}
    for force in forces:
        if world.is_set_at_once(force.name) and not _acts_on_state(force, step):
            continue
        for target in targets(model, force.name):
            layers = found.get(target)
            if layers is None:
                continue
            other = layers.get(force.layer)
            if other is not None and force.act.time == other.act.time:
                raise ConflictingTargets((other.name, force.name), target)
            if other is None or force.start >= other.start:
                layers[force.layer] = force
    chains: dict[str, list[Force]] = {}
    for target, layers in found.items():
        chain = chains[target] = []
        if target in own and OWN not in layers:  # of a model under intervention
            layers[OWN] = Force(0, own[target][1], own[target][0], OWN)
        for force in layers.values():
            if force.act.replaces:
                chain.clear()
            if not force.act.releases:
                chain.append(force)
    return chains


def _draws(chains: Mapping[str, list[Force]], memory: Memory) -> dict[str, Intervention]:
    """Return the draws at the roots of chains without numbers that are known, by variable."""
    roots = (chain[0] for chain in chains.values() if chain)
    new = (one for one in roots if one.act.draws and one.key not in memory.drawn)
    return {one.name: at_once(one.act) for one in new}


def _level(
    world: Simulation,
    step: int,
    forces: Sequence[Force],
    moved: Iterable[str],
    memory: Memory,
) -> Level | None:
    """Return what holds without other interventions; None if no draw of it is ever repeated."""
    if not any(force.act.draws for force in forces):
        return None
    model, deciding = world.model, world.structures.deciding
    held = {force.name for force in forces}
    there = {entity.name for entity in world.composition.entities}
    there |= set() if deciding.isdisjoint(held) else held  # of bodies that may come
    moved = [name for name in moved if name in model or name in there]
    chains = _chains(world, step, forces, moved)
    draws, moves = _draws(chains, memory), world.compiled.moves_bodies
    if not any(n not in model or n in deciding or moves(n) for n in draws):
        return None
    return Level(_requests(world, moved, chains, memory), draws)


def _requests(
    world: CausalSystem,
    moved: Iterable[str],
    chains: Mapping[str, list[Force]],
    memory: Memory,
) -> dict[str, Any]:
    """Return one intervention by name for each chain; a bundle stays whole where it is alone."""
    model, found = world.model, dict[str, Any]()
    of_name: dict[str, set[str]] = {}
    for target, chain in chains.items():
        for force in chain[-1:]:
            of_name.setdefault(force.name, set()).add(target)
    whole = {
        name
        for name, there in of_name.items()
        if {*targets(model, name)} == there
        and all(len(chains[t]) == 1 and chains[t][0].key not in memory.drawn for t in there)
    }
    released = {t: name for name in moved for t in targets(model, name)}
    for target, chain in chains.items():
        if not chain:
            name = released[target]
            is_whole = all(not chains[t] for t in targets(model, name))
            found[name if is_whole else target] = Natural()
        elif chain[0].name in whole:
            found[chain[0].name] = at_once(chain[0].act)
        else:
            below: Any = model._beneath(target) if chain[0].act.is_soft else None
            for force in chain:
                name, act = _part(model, target, force, memory)
                below = name, act.on(below)
            found[below[0]] = below[1]
    return found


def _part(model: SCM, target: str, force: Force, memory: Memory) -> tuple[str, Intervention]:
    """Return what an intervention is on one target, with numbers that were drawn before."""
    kept = memory.drawn.get(force.key, {}).get(target)
    if kept is not None:
        return kept
    name, act = force.name, at_once(force.act)
    if name not in model or not model.declared(name).parts:
        return name, act
    parts = model.accept(name, act).divided(model.declared(name))
    return next((part, one) for part, one in parts.items() if model.target(part) == target)


def _until(act: Intervention, end: int) -> list[Intervention]:
    """Return what has begun before another intervention replaces one at a control step."""
    time = act.time
    if time is None:
        return [act] if end else []
    start = time.first
    if start >= end:
        return []
    if time.when is not None:
        last = end if time.stop is None else min(end, time.stop)
        return [retimed(act, when=time.when, during=(start, last))]
    if time.during is not None:
        return [act]
    return [retimed(act, at=step) for step in range(start, end, time.every or end)]


def _since(name: str, act: Intervention, start: int) -> Intervention:
    """Return the part of an intervention from a control step on; refuse an earlier one."""
    time = act.time
    if time is None:
        return retimed(act, at=start) if start else act
    if time.when is not None:
        window = max(time.first, start), time.stop
        return retimed(act, when=time.when, during=window) if start else act
    if time.first >= start:
        return act
    if time.every is None:
        raise InterventionError(
            f"do({name}): control step {time.first} is over; the plan begins at {start}",
            variable=name,
            value=act,
        )
    return retimed(act, at=start + (time.first - start) % time.every, every=time.every)


def happens(event: Contact | Reaches, world: CausalSystem) -> bool:
    """Return whether an event occurs now; refuse unknown bodies and components."""
    if isinstance(event, Reaches):
        numbers = np.ravel(world[event.name])
        if event.component >= len(numbers):
            allowed = (f"0 to {len(numbers) - 1}",)
            raise UnknownOption(f"component of {event.name}", event.component, allowed)
        number = float(numbers[event.component])
        return number > event.above if event.above is not None else number < (event.below or 0.0)
    if world.backend is None:
        raise UnknownOption("event of equations", event, ("Reaches(name, above=…)",))
    structure: Any = getattr(world, "structure", None)
    known = structure.body_names
    for body in (event.first, event.second) if known else ():
        if not any(name.startswith(body) for name in known):
            raise UnknownOption("body of a contact", body, known)
    first, second = event.first, event.second
    return any(
        contact.force > 0.0
        and any(
            one.startswith(first) and other.startswith(second)
            for one, other in (contact.bodies, contact.bodies[::-1])
        )
        for contact in world.contacts()
    )
