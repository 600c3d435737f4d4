"""Verification: every declared edge must have an effect, and no other effect may exist."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from itertools import accumulate
from statistics import median
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, final

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, computed_field

from scm_world._arguments import MANY, typed, whole_number
from scm_world.errors import UnreadableFile
from scm_world.graph import SCM, Edge
from scm_world.queries.experiments.effects import EdgeKey, Effects
from scm_world.queries.experiments.markov import Markov
from scm_world.queries.experiments.paired import Paired, opened
from scm_world.queries.experiments.probes import free_spread
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.experiments.versions import versions
from scm_world.queries.local import contact_terms, holds
from scm_world.queries.progress import Progress
from scm_world.tasks import AnySource
from scm_world.variables.spaces import Checked
from scm_world.world import CausalSystem, Simulation

if TYPE_CHECKING:
    import pandas as pd

MOST = 200
"""Default limit of probe states in the search for declared edges."""

QUIET = 10
"""Number of probe states without a new edge that ends the search for a generated graph."""

HELD_OUT = 8
"""Default number of held-out probe states in the search for undeclared effects."""

OTHER = 1_000_003
"""Offset of the seed of held-out probe states."""

SHOWN = 10  # edges listed in a table
NAMED = 3  # variables named in a headline
Outcome = Literal["confirmed", "not refuted", "refuted"]
Row = tuple[str, str]
"""Meaning of a number, and the number."""


class Report(BaseModel, ABC, metaclass=Checked):
    """A result that is JSON-serialisable without loss, and has a text."""

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")
    kept: ClassVar[bool] = False  # as in ``Frozen``

    @property
    @abstractmethod
    def title(self) -> str:
        """The first line of the report."""

    @abstractmethod
    def rows(self) -> tuple[Row, ...]:
        """List the numbers with their meanings."""

    @property
    @abstractmethod
    def table(self) -> pd.DataFrame:
        """The details, as a data frame."""

    def __str__(self) -> str:
        rows = self.rows()
        width = max(len(name) for name, _ in rows)
        indent = "\n" + " " * (width + 4)
        lines = (f"  {name:<{width}}  {value.replace(chr(10), indent)}" for name, value in rows)
        return "\n".join([self.title, *lines])

    def to_json(self) -> str:
        """Return the report as JSON."""
        return self.model_dump_json(indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a report from the JSON of ``to_json``.

        Raises:
            UnreadableFile: The text is not a report of this class.
        """
        try:
            return cls.model_validate_json(text)
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
            raise UnreadableFile(cls.__name__, reason, "give text of to_json()") from None


@final
class EdgeReport(BaseModel):
    """The evidence for one edge.

    Attributes:
        cause: The changed variable; several, joined by ``" & "``, if all are needed.
        effect: The variable that should respond.
        lag: Control steps from cause to effect; an undeclared lag of 2 or more means memory outside
            of the states.
        status: ``"fired"`` for a declared edge with an effect, ``"unseen"`` for one without an
            effect in any probe state, ``"undeclared"`` for an effect without an edge.
        by: Source of the effect: a ``"readout"`` is computed from states of the engine.
        size: Largest observed effect, in the unit of the child.
        median: Median effect of the probe states in which there was one, in the unit of the child.
        seen: Number of these probe states.
        spread: Spread of the child in free motion, in its unit: the largest standard deviation of a
            component over episodes with random actions and without interventions. 0 if it does not
            move by itself.
        unit: Unit of the child.
        states: Number of probe states in which the cause of a declared edge was changed.
        after: Number of probe states until the first effect of a declared edge.
        probe: Number of the probe state with the largest effect.
        kind: Kind of this probe state.
        change: Change of the cause, flattened; empty if a mechanism was evaluated.
        reason: Probable reason why no effect was seen.
    """

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

    cause: str
    effect: str
    lag: int
    status: Literal["fired", "unseen", "undeclared"]
    by: Literal["engine", "readout", "definition"]
    size: float = 0.0
    median: float = 0.0
    seen: int = 0
    spread: float
    unit: str = ""
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

    @property
    def strength(self) -> float:
        """The largest effect in spreads of the child; NaN if it has none, or no cause was changed.

        It is 0 for an edge that was never seen.
        """
        tried = self.states or self.status != "unseen"
        return self.size / self.spread if self.spread and tried else np.nan

    def __str__(self) -> str:
        seen = f"{self.size:.3g} in probe {self.probe} ({self.kind})"
        return f"{arrow(self.key)}: {self.reason or seen}"


class GraphReport(Report):
    """The result of experiments with a declared graph.

    Attributes:
        task: Name of the task.
        arguments: Arguments of the task as ``name=value``, if known.
        backend: Name of the backend.
        preset: Its numerical settings.
        seed: Seed of the experiments.
        probes: Number of probe states used.
        planned: Largest possible number of probe states.
        rollouts: Number of simulated control steps.
        edges: Declared edges, and undeclared effects.
        unstable: Differences of variables without a change: in a second run or evaluation.
        seconds: Wall time.
        versions: Versions that determine the result.
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
    unstable: dict[str, float] = {}
    rounding: dict[str, float] = {}
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

    @property
    def strength(self) -> dict[EdgeKey, float]:
        """The strength of each edge that has one."""
        return {edge.key: edge.strength for edge in self.edges if not np.isnan(edge.strength)}

    @typed
    def weak(self, at_least: float) -> set[EdgeKey]:
        """Return the seen edges below a strength, as keys; those without one are left out."""
        found, strength = {*self.found}, self.strength
        return {key for key, size in strength.items() if size < at_least and key in found}

    @property
    def table(self) -> pd.DataFrame:
        """A row for each edge, the strongest first.

        ``largest`` and ``median`` effects are in spreads of the effect in free motion (NaN without
        spread), ``largest_raw``, ``median_raw`` and the ``spread`` in its ``unit``. ``seen`` is the
        number of probe states with an effect, ``states`` of those in which the cause was changed.
        """
        import pandas as pd

        rows = [edge.model_dump() | {"largest": edge.strength} for edge in self.edges]
        names = {"size": "largest_raw", "median": "median_raw"}
        found = pd.DataFrame(rows, columns=["largest", *EdgeReport.model_fields])
        found = found.rename(columns=names)
        found["median"] = found.median_raw / found.spread.where(found.spread > 0.0)
        first = ["cause", "effect", "lag", "status", "largest", "median", *names.values()]
        found = found[[*first, "unit", "spread", "seen", "states", "reason"]]
        return found.sort_values("largest", ascending=False, kind="stable", ignore_index=True)

    @classmethod
    def _of(
        cls,
        system: Simulation | SCM,
        effects: Effects,
        seed: int,
        after: Mapping[EdgeKey, int] | None = None,
        **fields: object,
    ) -> Self:
        """Build the report of a system; ``after`` is the probe state that showed each edge."""
        world = None if isinstance(system, SCM) else system
        model = system if isinstance(system, SCM) else system.model
        spread, reason = free_spread(system, seed), _reasons(world, effects)
        declared = {edge.key: edge for edge in sorted(model.edges, key=lambda edge: edge.key)}
        observed, edges = effects.edges(declared), list[EdgeReport]()
        others = sorted(observed - declared.keys() | effects.violations.keys())
        for key, edge in (*declared.items(), *((key, None) for key in others)):
            (cause, name, lag), more = key, dict[str, Any]()
            size, where = effects.largest.get(key, 0.0), effects.settings.get(key)
            if edge is None:
                more["status"] = "undeclared"
                size, where = effects.violations.get(key, (size, where))
            elif key in observed:
                more |= {"status": "fired", "after": (after or {}).get(key, 0)}
            else:
                more |= {"status": "unseen", "reason": reason(edge)}
            if where is not None:
                more |= where._asdict() | {"change": where.change.tolist()}
            sizes = [x for x in effects.sizes.get(key, ()) if x > effects.noise(name)]
            more |= {"median": median(sizes or [size]), "seen": len(sizes)}
            effect = model.declared(name)
            computed = "engine" if effect.is_simulated else "readout"
            more["by"] = computed if effect.is_measured else "definition"
            more |= {"spread": spread.get(name, 0.0), "unit": effect.unit}
            more["states"] = 0 if edge is None else effects.changed[cause]
            edges.append(EdgeReport(cause=cause, effect=name, lag=lag, size=size, **more))
        return cls(
            task=world.task.name if world else "model",
            backend=world.backend.name if world else "equations",
            preset=world.options.preset if world else "none",
            versions=versions(world.engine if world else ""),
            seed=seed,
            rollouts=effects.rollouts,
            unstable=effects.unstable,
            rounding=dict(effects.rounding),
            edges=tuple(edges),
            **fields,
        )

    @computed_field  # type: ignore[prop-decorator]
    @property
    def provenance(self) -> dict[str, tuple[int, int, int]]:
        """Numbers of declared edges seen, all declared edges, and undeclared effects, by source."""
        n = Counter((edge.by, edge.status) for edge in self.edges)
        return {
            by: (n[by, "fired"], n[by, "fired"] + n[by, "unseen"], n[by, "undeclared"])
            for by in ("engine", "readout", "definition")
        }

    def counted(self) -> list[Row]:
        """List the counts of ``provenance`` that are not zero."""
        return [
            (f"edges by {by}", f"{seen} of {all_} seen, {others} undeclared")
            for by, (seen, all_, others) in self.provenance.items()
            if all_ or others
        ]

    def rounded(self) -> list[Row]:
        """Return a row on the changes that do not count, if the engine has fewer than 64 bits."""
        if not self.rounding:
            return []
        name, size = max(self.rounding.items(), key=lambda item: item[1])
        said = f"up to {size:.2g} (of {name}) by its value or 1: it computes with few bits, and\n"
        said += "bodies that do not touch change one another; edges by contact count in contact"
        return [("no effect on this engine", said)]

    def sized(self) -> Row:
        """Return the strongest edge between two variables, the weakest, and the median."""
        strength, found = self.strength, {*self.found}
        sizes = sorted((strength[k], k) for k in found & strength.keys() if k[0] != k[1])
        ends = [f"{size:.3g} {arrow(key)}" for size, key in (*sizes[-1:], *sizes[:1])]
        middle = [f"median {median(size for size, _ in sizes):.3g}"] if sizes else []
        still = len(found - strength.keys())
        ends += [*middle, f"{still} edges into variables that do not move by themselves"]
        return "strength, in spreads of free motion", "\n".join(ends)


@final
class Verification(GraphReport):
    """The result of comparing a declared graph with the physics.

    Attributes:
        format: Format of the file.
        generated: Whether the graph follows from the structure of a model: then an edge may have no
            effect in the physics (the mass of a body in free fall).
        held_out: Number of held-out probe states in the search for undeclared effects; they have
            another seed and no scenarios of the task.
        interrupted: Whether it was interrupted (Ctrl-C).
    """

    format: Literal["scm_world/verification/6"] = "scm_world/verification/6"
    generated: bool = False
    held_out: int = 0
    interrupted: bool

    @property
    def never_fired(self) -> tuple[EdgeKey, ...]:
        """The declared edges that were not seen, as keys."""
        return tuple(edge.key for edge in self.unseen)

    @property
    def share(self) -> float:
        """Declared edges that were observed, as a fraction; 1 without declared edges."""
        return len(self.fired) / len(self.declared) if self.declared else 1.0

    @property
    def coverage(self) -> tuple[int, ...]:
        """Number of declared edges seen after each probe state, held-out states last."""
        new = [0] * (self.probes + self.held_out)
        for edge in self.fired:
            new[edge.after - 1] += 1
        return tuple(accumulate(new))

    @property
    def unresponsive(self) -> tuple[str, ...]:
        """Variables that did not respond to any declared cause, although some were varied."""
        responded = {edge.effect for edge in self.fired}
        tried = {edge.effect: None for edge in self.unseen if edge.states}
        return tuple(name for name in tried if name not in responded)

    @property
    def outcome(self) -> Outcome:
        """The verdict on the declared graph.

        ``"refuted"`` after an observation that it excludes: an undeclared effect, or a difference
        without a cause. Otherwise ``"confirmed"`` if every declared edge was seen without
        interruption, else ``"not refuted"``.
        """
        wrong, unseen = self.undeclared or self.unstable, self.unseen or self.interrupted
        return outcome(wrong=wrong, unseen=unseen)

    @property
    def headline(self) -> str:
        """The outcome in a sentence, with unresponsive variables, errors and unseen edges."""
        names, own = self.unresponsive, "its" if len(self.unresponsive) == 1 else "their"
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        findings = {
            f"{', '.join(names[:NAMED])}{more} never changed under any of {own} declared causes": (
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
        return f"{self.outcome}: {'; '.join(words for words, holds in findings.items() if holds)}"

    @property
    def title(self) -> str:
        """The first line of the report."""
        return f"Verification of {self.task} on {self.backend}: {self.headline}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers with their meanings."""
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
            self.sized(),
            ("engine", f"{self.backend} {self.versions.get(self.backend, '')}".strip()),
            ("preset, seed", f"{self.preset}, {self.seed}"),
            ("probe states", states + ": interrupted" * self.interrupted),
            ("rollouts", f"{self.rollouts:,}"),
            ("noise floor, two equal runs", f"{self.floor:g}"),
            *self.rounded(),
            ("never seen", listed(never, len(self.unseen))),
            ("undeclared effects", listed(self.undeclared)),
            ("differs by itself", listed(unstable)),
            ("seconds", f"{self.seconds:.1f}"),
        )


def outcome(*, wrong: object, unseen: object) -> Outcome:
    """Return the outcome for effects that the graph excludes, and for edges not seen."""
    return "refuted" if wrong else "not refuted" if unseen else "confirmed"


def arrow(key: EdgeKey) -> str:
    """Return a short text for an edge."""
    cause, effect, lag = key
    return f"{cause} -> {effect} (lag {lag})"


def listed(items: Iterable[object], count: int | None = None) -> str:
    """Return the number of items and the first ones, one per line."""
    found = [str(item) for item in items]
    more = [f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join([str(len(found) if count is None else count), *found[:SHOWN], *more])


@typed
def verify(
    system: AnySource | CausalSystem,
    *,
    probes: int = MOST,
    held_out: int = HELD_OUT,
    seed: int = 0,
    progress: Progress | None = None,
    found: Callable[[set[EdgeKey]], object] | None = None,
    **options: object,
) -> Verification:
    """Check a declared graph against the physics or the equations that realise it.

    There are two tests. First, if the cause of a declared edge is changed and everything else is
    held, the child must change. Second, if the parents of a variable are held and everything else
    is changed together, the variable must stay bit-identical.

    The search for declared edges uses one probe state after another, until each edge was seen. The
    search for undeclared effects uses held-out states: of another seed, half of them with other
    parameters, after random actions, in random feasible states, and with contacts. It may be
    interrupted (Ctrl-C); the report then covers the finished probe states.

    A graph that was generated from a model contains all possible edges, and some may never have an
    effect. Its search ends after several probe states without a new edge.

    A causal model without a backend realises itself: each mechanism is evaluated with one parent
    changed, and with everything but its parents changed. It is checked under the interventions that
    it, or its world, was given; a world with an engine is checked as it is declared.

    Args:
        system: A world, a causal model, a task, the name of one, or a model file.
        probes: Largest number of probe states for declared edges.
        held_out: Number of held-out probe states for undeclared effects.
        seed: Seed of states and values.
        progress: Called with (finished, planned) after each probe state.
        found: Called before ``progress`` with all edges seen so far: (cause, effect, lag).
        options: Arguments of ``World``, such as ``backend``, unless ``system`` is one.

    Returns:
        The report. Its ``outcome`` is ``"confirmed"``, ``"not refuted"`` if declared edges were not
        seen, with the reasons, or ``"refuted"``. A given world is restored afterwards.

    Raises:
        UnknownOption: ``probes`` is not a positive whole number, ``held_out`` is not a whole
            number, ``options`` are given with a world, or a name does not exist.
        ModelError: A world with an engine was given a mechanism, or equations an act with a time.

    Example:
        >>> found = verify("reaching", backend="fake", probes=1, held_out=0)
        >>> found.floor, found.undeclared, found.outcome  # without physics nothing moves
        (0.0, (), 'not refuted')
    """
    probes = whole_number("number of probes", probes, least=1)
    held_out = whole_number("number of held-out probes", held_out, least=0, most=MANY)
    with opened(system, options) as there:
        started, paired = time.perf_counter(), Paired(there, seed)
        world = None if isinstance(there, SCM) else there
        markov = None if world is None else Markov(paired)
        declared = {edge.key for edge in paired.model.edges}
        missing, after = set(declared), dict[EdgeKey, int]()
        effects, done, searched, interrupted = paired.effects(), 0, 0, False
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
                    quiet = paired.generated and done - max(after.values(), default=0) >= QUIET
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
        return Verification._of(
            there,
            effects,
            seed,
            after,
            generated=paired.generated,
            probes=searched,
            held_out=done - searched,
            planned=probes,
            interrupted=interrupted,
            seconds=time.perf_counter() - started,
        )


def _reasons(world: Simulation | None, effects: Effects) -> Callable[[Edge], str]:
    """Return a function from an edge never seen to what the experiments measured about it."""
    observed = effects.edges({edge.key for edge in world.model.edges} if world else ())
    acted = {name for name, _, lag in observed if lag}
    actions = () if world is None else world.compiled.actions
    touching = [] if world is None else effects.touching
    terms = contact_terms(world) if world and any(touching) else {}
    joins = [(holds(terms, pairs), n) for pairs, n in Counter(filter(None, touching)).items()]

    def reason(edge: Edge) -> str:
        cause, states = edge.cause, effects.changed[edge.cause]
        if not states:
            refused = ": every other value that was tried was refused" * (cause in effects.refused)
            return f"no probe state had another value of {cause}{refused}"
        by_contact = joins if edge.when == "contact" else []
        touched = sum(n for joined, n in by_contact if joined(cause, edge.effect))
        if edge.when == "contact" and not touched:
            if not joins:
                return "nothing touched in any probe state"
            return f"no contacts joined their bodies in any of {len(touching)} probe states"
        for action in actions:
            if action.partition(".")[0] != cause.partition(".")[0]:
                continue
            if action not in acted:
                return f"no command of {action} acted: each was cut to a limit, or drives nothing"
            if effects.sought and not effects.unsaturated[action]:
                sought = f"in all {effects.sought} probe states in which another was sought"
                return f"the command {action} was saturated {sought}"
        size, room = effects.largest.get(edge.key, 0.0), effects.rounding.get(edge.effect, 0.0)
        if size > 0.0 and room:
            others = f"bodies that do not touch change {edge.effect} by {room:.2g}"
            return f"it changed by {effects.relative[edge.key]:.2g} of it or of 1, and {others}"
        beyond = " beyond rounding and noise" * (size > 0.0)
        found = f"no difference{beyond}, though {cause} was changed in {states} of the probe states"
        return found + f", and contacts joined their bodies in {touched}" * (touched > 0)

    return reason
