"""Verification: every declared edge must move its child, every other one must leave it alone."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import accumulate
from typing import Any, Literal, Self, final

from pydantic import BaseModel, ConfigDict, ValidationError

from scm_world._arguments import whole_number
from scm_world.errors import UnreadableFile
from scm_world.graph import SCM, Edge
from scm_world.queries.equations import System
from scm_world.queries.experiments.effects import EdgeKey, Effects
from scm_world.queries.experiments.markov import Markov
from scm_world.queries.experiments.paired import Paired, opened
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.tasks import Task
from scm_world.variables import Measured
from scm_world.world import Simulation

MOST = 200
"""Largest number of probe states in which declared edges are looked for."""

QUIET = 10
"""After how many probe states without a new edge the search ends, of a generated graph."""

HELD_OUT = 8
"""In how many further probe states of another seed effects without an edge are looked for."""

OTHER = 1_000_003
"""What is added to the seed for these."""

SHOWN = 10  # edges that are written out in a table
NAMED = 3  # variables that are named in a headline
Outcome = Literal["confirmed", "not refuted", "refuted"]
Row = tuple[str, str, bool | None]
"""What a number means, the number, and whether it is good; None where it is neither."""


class Report(BaseModel, ABC):
    """Data that can be written as JSON and read back without loss, and as text."""

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

    @property
    @abstractmethod
    def title(self) -> str:
        """The first line of the report."""

    @abstractmethod
    def rows(self) -> tuple[Row, ...]:
        """List the numbers, what they mean, and whether they are good."""

    def __str__(self) -> str:
        rows = self.rows()
        width = max(len(name) for name, _, _ in rows)
        indent = "\n" + " " * (width + 4)
        lines = (f"  {name:<{width}}  {value.replace(chr(10), indent)}" for name, value, _ in rows)
        return "\n".join([self.title, *lines])

    def to_json(self) -> str:
        """Write the report as JSON."""
        return self.model_dump_json(indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read what ``to_json`` wrote.

        Raises:
            UnreadableFile: It is something else.
        """
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise UnreadableFile(cls.__name__, reason, "give what to_json() wrote") from None


@final
class EdgeReport(BaseModel):
    """What was found of one edge.

    Attributes:
        cause: The variable that was changed; several, joined by ``" & "``, if each is needed.
        effect: The variable that responded, or did not.
        lag: After how many control steps; at a lag of 2 or more without a declared edge, something
            remembers what no state holds.
        status: ``"fired"`` is a declared edge that moved its child, ``"unseen"`` one that did in no
            probe state, ``"undeclared"`` an effect without an edge.
        size: Largest effect observed, in the unit of the child.
        states: In how many probe states the cause was changed; of declared edges.
        after: How many probe states it took until it was seen; of declared edges.
        probe: Number of the probe state in which the largest effect was observed.
        kind: How this probe state came about.
        change: By how much the cause was moved, flattened; empty if a mechanism was evaluated.
        reason: Why nothing was seen, as far as the experiments tell.
    """

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

    cause: str
    effect: str
    lag: int
    status: Literal["fired", "unseen", "undeclared"]
    size: float = 0.0
    states: int = 0
    after: int = 0
    probe: int | None = None
    kind: str = ""
    change: tuple[float, ...] = ()
    reason: str = ""

    @property
    def key(self) -> EdgeKey:
        """Cause, effect and lag."""
        return self.cause, self.effect, self.lag

    def __str__(self) -> str:
        seen = f"{self.size:.3g} in probe {self.probe} ({self.kind})"
        return f"{arrow(self.key)}: {self.reason or seen}"


class GraphReport(Report):
    """The result of experiments with a declared graph.

    Attributes:
        task: Name of the task.
        arguments: What the task was made with, each as ``name=value``, where that is known.
        backend: Its name.
        preset: Its numerical settings.
        seed: Of the experiments.
        probes: Probe states that were used.
        planned: How many there may have been.
        rollouts: Control steps simulated in an experiment of their own.
        edges: Declared edges, and effects without one.
        provenance: How many declared edges were seen, how many there are, and how many effects
            without an edge were seen, by what decides the effect: ``"engine"``, ``"readout"``
            (computed from states) or ``"definition"``.
        unstable: By how much a variable differed though nothing had been changed: in a second run,
            or evaluated a second time.
        seconds: Wall time.
        versions: Of everything that decides the result.
    """

    task: str
    arguments: tuple[str, ...] = ()
    backend: str
    preset: str
    seed: int
    probes: int
    planned: int
    rollouts: int
    edges: tuple[EdgeReport, ...]
    provenance: dict[str, tuple[int, int, int]] = {}
    unstable: dict[str, float] = {}
    seconds: float
    versions: dict[str, str]

    @property
    def fired(self) -> tuple[EdgeReport, ...]:
        """The declared edges that were seen."""
        return tuple(edge for edge in self.edges if edge.status == "fired")

    @property
    def unseen(self) -> tuple[EdgeReport, ...]:
        """The declared edges that were not seen, with the reasons."""
        return tuple(edge for edge in self.edges if edge.status == "unseen")

    @property
    def undeclared(self) -> tuple[EdgeReport, ...]:
        """The effects without an edge."""
        return tuple(edge for edge in self.edges if edge.status == "undeclared")

    @property
    def declared(self) -> tuple[EdgeKey, ...]:
        """The declared edges, as keys."""
        return tuple(edge.key for edge in self.edges if edge.status != "undeclared")

    @property
    def found(self) -> tuple[EdgeKey, ...]:
        """The edges that were observed, declared or not, as keys."""
        return tuple(edge.key for edge in self.edges if edge.status != "unseen")

    @property
    def floor(self) -> float:
        """The largest difference between two runs without a change."""
        return max(self.unstable.values(), default=0.0)

    @classmethod
    def of(
        cls,
        system: Simulation | SCM,
        effects: Effects,
        after: Mapping[EdgeKey, int] | None = None,
        reason: Callable[[Edge], str] = lambda edge: "not seen",
        **fields: Any,
    ) -> Self:
        """Make the report of a system: declared edges, seen or not, and effects without an edge.

        Args:
            system: The system.
            effects: What was seen.
            after: How many probe states it took until an edge was seen, where that is known.
            reason: Returns why a declared edge was not seen.
            fields: Further fields of the report.
        """
        world = None if isinstance(system, SCM) else system
        model = system if isinstance(system, SCM) else system.model
        declared = {edge.key: edge for edge in sorted(model.edges, key=lambda edge: edge.key)}
        observed, edges = effects.edges(declared), list[EdgeReport]()
        counts = {by: Counter[str]() for by in ("engine", "readout", "definition")}

        def add(key: EdgeKey, status: str, **more: Any) -> None:
            seen = effects.largest.get(key, 0.0), effects.settings.get(key)
            size, where = effects.violations.get(key, seen) if status == "undeclared" else seen
            if where is not None:
                more |= where._asdict() | {"change": where.change.tolist()}
            names = dict(zip(("cause", "effect", "lag"), key, strict=True))
            edges.append(EdgeReport(**names, status=status, size=size, **more))
            effect: Any = model.declared(key[1])
            computed = "engine" if getattr(effect, "mechanism", None) is None else "readout"
            counts[computed if isinstance(effect, Measured) else "definition"][status] += 1

        for key, edge in declared.items():
            more = {"states": effects.changed[edge.cause]}
            if key in observed:
                add(key, "fired", after=(after or {}).get(key, 0), **more)
            else:
                add(key, "unseen", reason=reason(edge), **more)
        for key in sorted(observed - declared.keys() | effects.violations.keys()):
            add(key, "undeclared")
        return cls(
            task=world.task.name if world else "model",
            backend=world.backend.name if world else "equations",
            preset=world.options.preset if world else "none",
            versions=versions(world.engine if world else ""),
            rollouts=effects.rollouts,
            unstable=effects.unstable,
            edges=tuple(edges),
            provenance={
                by: (found["fired"], found["fired"] + found["unseen"], found["undeclared"])
                for by, found in counts.items()
            },
            **fields,
        )

    def counted(self) -> list[Row]:
        """List the counts of ``provenance``; of what there is none, there is no row."""
        return [
            (f"edges by {by}", f"{seen} of {all_} seen, {others} undeclared", not others)
            for by, (seen, all_, others) in self.provenance.items()
            if all_ or others
        ]


@final
class Verification(GraphReport):
    """The result of comparing a declared graph with the physics.

    Attributes:
        format: Of the file.
        generated: Whether the graph follows from structure: then physics may have nothing to show
            of an edge (the mass of what falls freely moves nothing).
        held_out: Further probe states, of another seed and without the task's scenarios, in which
            effects without an edge were looked for.
        interrupted: Whether it was stopped (Ctrl-C) before it was through.
    """

    format: Literal["scm_world/verification/4"] = "scm_world/verification/4"
    generated: bool = False
    held_out: int = 0
    interrupted: bool

    @property
    def never_fired(self) -> tuple[EdgeKey, ...]:
        """The declared edges that were not seen, as keys."""
        return tuple(edge.key for edge in self.unseen)

    @property
    def share(self) -> float:
        """Declared edges that were observed, as a fraction; 1 if none is declared."""
        return len(self.fired) / len(self.declared) if self.declared else 1.0

    @property
    def coverage(self) -> tuple[int, ...]:
        """How many declared edges had been observed after each probe state, those held out last."""
        new = [0] * (self.probes + self.held_out)
        for edge in self.fired:
            new[edge.after - 1] += 1
        return tuple(accumulate(new))

    @property
    def unresponsive(self) -> tuple[str, ...]:
        """Variables that changed under none of their declared causes, some of which were varied.

        Nothing speaks for such a declaration, so they are named before everything else.
        """
        responded = {edge.effect for edge in self.fired}
        tried = {edge.effect: None for edge in self.unseen if edge.states}
        return tuple(name for name in tried if name not in responded)

    @property
    def outcome(self) -> Outcome:
        """The verdict on the declared graph.

        ``"refuted"`` if something was seen that it excludes: an effect without an edge, or a
        difference without a cause. Otherwise ``"confirmed"`` if every declared edge was seen and
        nothing was interrupted, and ``"not refuted"`` if not.
        """
        wrong, unseen = self.undeclared or self.unstable, self.unseen or self.interrupted
        return outcome(wrong=bool(wrong), unseen=bool(unseen))

    @property
    def headline(self) -> str:
        """The outcome in a sentence: what never changed, what was wrong, what is left."""
        names, its = self.unresponsive, "its" if len(self.unresponsive) == 1 else "their"
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        told = {
            f"{', '.join(names[:NAMED])}{more} never changed under any of {its} declared causes": (
                names
            ),
            f"{len(self.undeclared)} effects without an edge": self.undeclared,
            f"{len(self.unstable)} variables that differ by themselves": self.unstable,
            f"{len(self.unseen)} of {len(self.declared)} edges were never seen": self.unseen,
            f"all {len(self.declared)} edges were seen, and no other effect": (
                self.outcome == "confirmed"
            ),
            "interrupted": self.interrupted,
        }
        return f"{self.outcome}: {'; '.join(words for words, holds in told.items() if holds)}"

    @property
    def title(self) -> str:
        """The first line of the report."""
        return f"Verification of {self.task} on {self.backend}: {self.headline}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers, what they mean, and whether they are good."""
        states = f"{self.probes} of at most {self.planned}"
        states += f", {self.held_out} held out" if self.held_out else ""
        unstable = (f"{name}: {size:.3g}" for name, size in self.unstable.items())
        silent, unseen = {*self.unresponsive}, dict[tuple[str, str], list[str]]()
        for edge in sorted(self.unseen, key=lambda edge: edge.effect not in silent):
            unseen.setdefault((edge.cause, edge.reason), []).append(edge.effect)
        never = (
            f"{c} -> {', '.join(dict.fromkeys(found))}: {why}" for (c, why), found in unseen.items()
        )
        return (
            *self.counted(),
            ("engine", f"{self.backend} {self.versions.get(self.backend, '')}".strip(), None),
            ("preset, seed", f"{self.preset}, {self.seed}", None),
            ("probe states", states + ": interrupted" * self.interrupted, None),
            ("rollouts", f"{self.rollouts:,}", None),
            ("noise floor (run twice)", f"{self.floor:g}", self.floor == 0.0),
            ("never seen", listed(never, len(self.unseen)), None),
            ("undeclared effects", listed(self.undeclared), not self.undeclared),
            ("differs by itself", listed(unstable), not self.unstable),
            ("seconds", f"{self.seconds:.1f}", None),
        )


def outcome(*, wrong: bool, unseen: bool) -> Outcome:
    """Return the outcome of experiments with a graph.

    Args:
        wrong: Whether something was seen that the graph excludes.
        unseen: Whether something that it declares was not seen.
    """
    return "refuted" if wrong else "not refuted" if unseen else "confirmed"


def failed(outcomes: Iterable[Outcome], *, strict: bool) -> bool:
    """Check whether a command exits 1: something is refuted or, if strict, not confirmed."""
    return not {*outcomes} <= ({"confirmed"} if strict else {"confirmed", "not refuted"})


def arrow(key: EdgeKey) -> str:
    """Write an edge.

    Example:
        >>> arrow(("gravity", "block.linear_velocity", 1))
        'gravity -> block.linear_velocity (lag 1)'
    """
    cause, effect, lag = key
    return f"{cause} -> {effect} (lag {lag})"


def listed(items: Iterable[object], count: int | None = None) -> str:
    """Count things and name the first of them, one per line."""
    found = [str(item) for item in items]
    more = [f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join([str(len(found) if count is None else count), *found[:SHOWN], *more])


def verify(
    system: System | SCM | Task | str,
    *,
    probes: int = MOST,
    held_out: int = HELD_OUT,
    seed: int = 0,
    progress: Progress | None = None,
    found: Callable[[set[EdgeKey]], object] | None = None,
    **options: Any,
) -> Verification:
    """Check a declared graph against the physics or the equations that realise it.

    Two tests are made. Each declared edge has to change its child when its cause is changed and
    everything else is kept. And with its parents held, changing everything else together has to
    leave each variable as it is, bit for bit.

    Edges are looked for in one probe state after another, until each was observed. Effects without
    an edge are looked for in further states, which are held out: of another seed, half of them
    with other parameters, where random actions lead, anywhere that is feasible, and where bodies
    touch. It may be interrupted (Ctrl-C); the report then covers the probe states that were
    finished.

    A graph that was generated from a model says what can act on what; some of its edges may never
    show, and stay unseen. So its search ends when nothing new is seen any more.

    A causal model without a backend is its own physics: each mechanism is evaluated with one
    parent changed, and with everything but its parents changed.

    Args:
        system: A world, a causal model, a task, the name of one, or a model file.
        probes: How many states to look for edges in at most.
        held_out: How many further ones for effects without an edge.
        seed: Of states and values.
        progress: Called with (finished, planned) after each probe state.
        found: Called before that with all edges observed so far: (cause, effect, lag).
        options: Arguments of ``World``, such as ``backend``, unless ``system`` is one.

    Returns:
        The report. Its ``outcome`` is ``"confirmed"``, ``"not refuted"`` where declared edges are
        left that no probe state showed, with the reasons, or ``"refuted"``. A world that was given
        is afterwards as it was.

    Raises:
        UnknownOption: ``probes`` is not a positive whole number, ``held_out`` is not a whole
            number, there are options for a world that is made, or a name does not exist.

    Example:
        >>> found = verify("reaching", backend="fake", probes=1, held_out=0)
        >>> found.floor, found.undeclared, found.outcome  # without physics nothing moves
        (0.0, (), 'not refuted')
    """
    whole_number("number of probes", probes, least=1)
    whole_number("number of held-out probes", held_out, least=0)
    with opened(system, options) as there:
        started, paired = time.perf_counter(), Paired(there, seed)
        world = there if isinstance(there, Simulation) else None
        markov = None if world is None else Markov(paired)
        declared = {edge.key for edge in paired.model.edges}
        missing, after = set(declared), dict[EdgeKey, int]()
        effects, done, searched, interrupted = Effects(exact=paired.exact), 0, 0, False
        search = probe_states(there, probes, seed)
        others = probe_states(there, held_out, seed + OTHER, scenarios=False)
        try:
            for held, states in ((False, search), (True, others)):
                for probe in states:
                    one = paired.run(done, probe, missing)
                    if held and markov is not None and not one.unstable:
                        markov.run(one)
                    effects.add(one)
                    done, searched = done + 1, searched + (not held)
                    now = effects.edges(declared)
                    after.update(dict.fromkeys(missing & now, done))
                    missing -= now
                    quiet = paired.exact and done - max(after.values(), default=0) >= QUIET
                    last = not held and (quiet or not missing)
                    if found is not None:
                        found(now)
                    if progress is not None:
                        progress(done, held_out + (searched if held or last else probes))
                    if last:
                        break
        except KeyboardInterrupt:
            if not done:
                raise
            interrupted = True
        return Verification.of(
            there,
            effects,
            after,
            partial(_reason, world, effects, effects.edges(declared)),
            seed=seed,
            generated=paired.exact,
            probes=searched,
            held_out=done - searched,
            planned=probes,
            interrupted=interrupted,
            seconds=time.perf_counter() - started,
        )


def _reason(world: Simulation | None, effects: Effects, observed: set[EdgeKey], edge: Edge) -> str:
    """Say why an edge was not seen, as far as the experiments tell."""
    cause, states = edge.cause, effects.changed[edge.cause]
    if not states:
        refused = ": every other value that was tried was refused" * (cause in effects.refused)
        return f"no probe state had another value of {cause}{refused}"
    if edge.when == "contact":
        body = cause.partition(".")[0]
        known = world is not None and body in getattr(world.structure, "bodies", ())
        if not effects.touched:
            return "nothing touched in any probe state"
        if known and body not in effects.touched:
            return f"{body} touched nothing in any probe state"
    acted = {name for name, _, lag in observed if lag}
    for action in () if world is None else world.compiled.actions:
        if action.partition(".")[0] == cause.partition(".")[0] and action not in acted:
            return f"no command of {action} acted: each was cut to a limit, or drives nothing"
    beyond = " beyond rounding and noise" * (effects.largest.get(edge.key, 0.0) > 0.0)
    return f"no difference{beyond}, though {cause} was changed in {states} of the probe states"
