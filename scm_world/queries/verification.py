"""Reports of verification."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from itertools import accumulate
from types import MappingProxyType
from typing import Any, Literal, Self, final

from pydantic import BaseModel, ConfigDict, ValidationError

from scm_world.errors import UnreadableFile
from scm_world.graph import SCM, Edge
from scm_world.queries.experiments.effects import EdgeKey, Effects, ProbeSetting
from scm_world.queries.experiments.versions import versions
from scm_world.variables import Measured
from scm_world.world import Simulation

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
        cls, system: Simulation | SCM, effects: Effects, edges: Iterable[EdgeReport], **more: Any
    ) -> Self:
        """Make the report of a system."""
        world = None if isinstance(system, SCM) else system
        model = system if isinstance(system, SCM) else system.model
        return cls(
            task=world.task.name if world else "model",
            backend=world.backend.name if world else "equations",
            preset=world.options.preset if world else "none",
            versions=versions(world.engine if world else ""),
            rollouts=effects.rollouts,
            unstable=effects.unstable,
            edges=tuple(edges),
            provenance=by_provenance(model, edges),
            **more,
        )


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
        silent = f"{', '.join(names[:NAMED])}{more}"
        told = {
            f"{silent} never changed under any of {its} declared causes": names,
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
            *counted(self.provenance),
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


def by_provenance(model: SCM, edges: Iterable[EdgeReport]) -> dict[str, tuple[int, int, int]]:
    """Count declared edges that were seen, all of them, and undeclared ones, by what decides.

    The engine decides states and what it reports. What is computed from them is a readout, and
    everything else follows by definition: its edges hold because the mechanism is what it is.
    """
    counts = {by: Counter[str]() for by in ("engine", "readout", "definition")}
    for edge in edges:
        effect: Any = model.declared(edge.effect)
        measured = isinstance(effect, Measured)
        by = "definition" if not measured else "engine" if effect.mechanism is None else "readout"
        counts[by][edge.status] += 1
    return {
        by: (found["fired"], found["fired"] + found["unseen"], found["undeclared"])
        for by, found in counts.items()
    }


def edge_reports(
    model: SCM,
    effects: Effects,
    after: Mapping[EdgeKey, int] = MappingProxyType({}),
    reason: Callable[[Edge], str] = lambda edge: "not seen",
) -> list[EdgeReport]:
    """List declared edges, seen or not, and effects without an edge.

    Args:
        model: Declares the edges.
        effects: What was seen.
        after: How many probe states it took until an edge was seen, where that is known.
        reason: Returns why a declared edge was not seen.
    """
    edges, reports = sorted(model.edges, key=lambda edge: edge.key), list[EdgeReport]()
    declared = {edge.key for edge in edges}
    observed = effects.edges(declared)

    def add(key: EdgeKey, size: float, setting: ProbeSetting | None, **more: Any) -> None:
        if setting is not None:
            more |= setting._asdict() | {"change": setting.change.tolist()}
        cause, effect, lag = key
        reports.append(EdgeReport(cause=cause, effect=effect, lag=lag, size=size, **more))

    for edge in edges:
        more: dict[str, Any] = {"states": effects.changed[edge.cause], "status": "fired"}
        if edge.key in observed:
            more["after"] = after.get(edge.key, 0)
        else:
            more |= {"status": "unseen", "reason": reason(edge)}
        where = effects.settings.get(edge.key)
        add(edge.key, effects.largest.get(edge.key, 0.0), where, **more)
    for key in sorted(observed - declared | effects.violations.keys()):
        seen = effects.largest.get(key, 0.0), effects.settings.get(key)
        add(key, *effects.violations.get(key, seen), status="undeclared")
    return reports


def counted(provenance: Mapping[str, tuple[int, int, int]]) -> list[Row]:
    """Write the counts of ``by_provenance`` as rows; of what there is none, there is no row."""
    return [
        (f"edges by {by}", f"{seen} of {all_} seen, {others} undeclared", not others)
        for by, (seen, all_, others) in provenance.items()
        if all_ or others
    ]


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
