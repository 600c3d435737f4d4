"""Reports of verification."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import accumulate
from typing import Any, Literal, Self, final

from pydantic import BaseModel, ConfigDict, ValidationError

from scm_world.errors import UnreadableFile
from scm_world.graph import SCM
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.variables import Measured

SHOWN = 10  # edges that are written out in a table
NAMED = 3  # variables that are named in a headline
Outcome = Literal["confirmed", "not refuted", "refuted"]
Row = tuple[str, str, bool | None]
"""What a number means, the number, and whether it is good; None where it is neither."""


class Report(BaseModel):
    """Data that can be written as JSON and read back without loss."""

    model_config = ConfigDict(frozen=True, ser_json_inf_nan="strings")

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


class EdgeReport(Report):
    """What was found of one edge.

    Attributes:
        cause: The variable that was changed; several, joined by ``" & "``, if each is needed.
        effect: The variable that responded, or did not.
        lag: After how many control steps.
    """

    cause: str
    effect: str
    lag: int

    @property
    def key(self) -> EdgeKey:
        """Cause, effect and lag."""
        return self.cause, self.effect, self.lag


@final
class Fired(EdgeReport):
    """A declared edge that moved its child.

    Attributes:
        after: How many probe states it took.
        largest: Largest effect observed, in the unit of the child.
    """

    after: int
    largest: float


@final
class Undeclared(EdgeReport):
    """An effect without an edge; at a lag of 2 or more, something remembers what no state holds.

    Attributes:
        size: Largest effect observed, in the unit of the child.
        probe: Number of the probe state in which it was observed.
        kind: How this probe state came about.
        change: By how much the cause was moved, flattened; empty if a mechanism was evaluated.
    """

    size: float
    probe: int
    kind: str
    change: tuple[float, ...]

    def __str__(self) -> str:
        return f"{arrow(self.key)}: {self.size:.3g} in probe {self.probe} ({self.kind})"


@final
class Unseen(EdgeReport):
    """A declared edge that moved its child in no probe state.

    Attributes:
        states: In how many probe states the cause was changed.
        reason: Why nothing was seen, as far as the experiments tell.
    """

    states: int
    reason: str

    def __str__(self) -> str:
        return f"{arrow(self.key)}: {self.reason}"


@final
class Verification(Report):
    """The result of comparing a declared graph with the physics.

    Attributes:
        format: Of the file.
        task: Name of the task.
        arguments: What the task was made with, each as ``name=value``, where that is known.
        backend: Its name.
        preset: Its numerical settings.
        seed: Of the experiments.
        generated: Whether the graph follows from structure: then physics may have nothing to show
            of an edge (the mass of what falls freely moves nothing).
        probes: Probe states that were used.
        held_out: Further ones, of another seed and without the task's scenarios, in which effects
            without an edge were looked for.
        provenance: How many declared edges were seen, how many there are, and how many effects
            without an edge were seen, by what decides the effect: ``"engine"``, ``"readout"``
            (computed from states) or ``"definition"``.
        unstable: By how much a variable differed though nothing had been changed: in a second run,
            or evaluated a second time.
        planned: How many probe states there may have been, without those.
        interrupted: Whether it was stopped (Ctrl-C) before it was through.
        rollouts: Control steps simulated in an experiment of their own.
        fired: Declared edges that were seen.
        unseen: Declared edges that were not, with the reasons.
        undeclared: Effects without an edge.
        seconds: Wall time.
        versions: Of everything that decides the result.
    """

    format: Literal["scm_world/verification/3"] = "scm_world/verification/3"
    task: str
    arguments: tuple[str, ...] = ()
    backend: str
    preset: str
    seed: int
    generated: bool = False
    probes: int
    held_out: int = 0
    provenance: dict[str, tuple[int, int, int]] = {}
    unstable: dict[str, float] = {}
    planned: int
    interrupted: bool
    rollouts: int
    fired: tuple[Fired, ...]
    unseen: tuple[Unseen, ...]
    undeclared: tuple[Undeclared, ...]
    seconds: float
    versions: dict[str, str]

    @property
    def floor(self) -> float:
        """The largest difference between two runs without a change."""
        return max(self.unstable.values(), default=0.0)

    @property
    def never_fired(self) -> tuple[EdgeKey, ...]:
        """List the declared edges that were not seen."""
        return tuple(edge.key for edge in self.unseen)

    @property
    def declared(self) -> tuple[EdgeKey, ...]:
        """List the declared edges."""
        return (*(edge.key for edge in self.fired), *self.never_fired)

    @property
    def found(self) -> tuple[EdgeKey, ...]:
        """List the edges that were observed, declared or not."""
        return (*(edge.key for edge in self.fired), *(edge.key for edge in self.undeclared))

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
        return outcome(
            wrong=bool(self.undeclared or self.unstable),
            unseen=bool(self.unseen) or self.interrupted,
        )

    @property
    def headline(self) -> str:
        """The outcome in a sentence: which variables never changed, what was wrong, what is left.

        Example:
            >>> from scm_world.queries import verify
            >>> verify("reaching", backend="fake", probes=1, held_out=0).headline[:26]
            'not refuted: joint_torques'
        """
        counts = (
            (len(self.undeclared), "effects without an edge"),
            (len(self.unstable), "variables that differ by themselves"),
        )
        names, more = self.unresponsive[:NAMED], len(self.unresponsive) - NAMED
        also, its = f" and {more} more" if more > 0 else "", "its" if len(names) == 1 else "their"
        said = [f"{', '.join(names)}{also} never changed under any of {its} declared causes"]
        said = said * bool(names) + [f"{number} {what}" for number, what in counts if number]
        if self.unseen:
            said.append(f"{len(self.unseen)} of {len(self.declared)} edges were never seen")
        elif self.outcome == "confirmed":
            said.append(f"all {len(self.declared)} edges were seen, and no other effect")
        said += ["interrupted"] * self.interrupted
        return f"{self.outcome}: {'; '.join(said)}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers, what they mean, and whether they are good."""
        states = f"{self.probes} of at most {self.planned}"
        states += f", {self.held_out} held out" if self.held_out else ""
        return (
            *counted(self.provenance),
            ("engine", f"{self.backend} {self.versions.get(self.backend, '')}".strip(), None),
            ("preset, seed", f"{self.preset}, {self.seed}", None),
            ("probe states", states + ": interrupted" * self.interrupted, None),
            ("rollouts", f"{self.rollouts:,}", None),
            ("noise floor (run twice)", f"{self.floor:g}", self.floor == 0.0),
            ("never seen", self._reasons(), None),
            ("undeclared effects", listed(map(str, self.undeclared)), not self.undeclared),
            (
                "differs by itself",
                listed(f"{name}: {size:.3g}" for name, size in self.unstable.items()),
                not self.unstable,
            ),
            ("seconds", f"{self.seconds:.1f}", None),
        )

    def _reasons(self) -> str:
        """Count the unseen edges and list them by cause, of what never changed first."""
        silent = {*self.unresponsive}
        effects: dict[tuple[str, str], list[str]] = {}
        for edge in sorted(self.unseen, key=lambda edge: edge.effect not in silent):
            effects.setdefault((edge.cause, edge.reason), []).append(edge.effect)
        lines = [
            f"{cause} -> {', '.join(dict.fromkeys(names))}: {reason}"
            for (cause, reason), names in effects.items()
        ]
        return "\n".join([str(len(self.unseen)), *listed(lines).split("\n")[1:]])

    @property
    def title(self) -> str:
        """The first line of the report."""
        return f"Verification of {self.task} on {self.backend}: {self.headline}"

    def __str__(self) -> str:
        return written(self.title, self.rows())


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


def by_provenance(
    model: SCM, declared: Iterable[EdgeKey], found: set[EdgeKey], undeclared: Iterable[EdgeKey]
) -> dict[str, tuple[int, int, int]]:
    """Count declared edges that were seen, all of them, and undeclared ones, by what decides.

    The engine decides states and what it reports. What is computed from them is a readout, and
    everything else follows by definition: its edges hold because the mechanism is what it is.
    """
    counted = {"engine": [0, 0, 0], "readout": [0, 0, 0], "definition": [0, 0, 0]}

    def of(key: EdgeKey) -> list[int]:
        effect: Any = model.declared(key[1])
        if not isinstance(effect, Measured):
            return counted["definition"]
        return counted["engine" if effect.mechanism is None else "readout"]

    for key in declared:
        of(key)[0] += key in found
        of(key)[1] += 1
    for key in undeclared:
        of(key)[2] += 1
    return {by: (seen, all_, others) for by, (seen, all_, others) in counted.items()}


def counted(provenance: Mapping[str, tuple[int, int, int]]) -> list[Row]:
    """Write the counts of ``by_provenance`` as rows; of what there is none, there is no row."""
    return [
        (f"edges by {by}", f"{seen} of {all_} seen, {others} undeclared", not others)
        for by, (seen, all_, others) in provenance.items()
        if all_ or others
    ]


def named(key: EdgeKey) -> dict[str, Any]:
    """Name the parts of an edge as the fields of reports are."""
    return dict(zip(("cause", "effect", "lag"), key, strict=True))


def arrow(key: EdgeKey) -> str:
    """Write an edge.

    Example:
        >>> arrow(("gravity", "block.linear_velocity", 1))
        'gravity -> block.linear_velocity (lag 1)'
    """
    cause, effect, lag = key
    return f"{cause} -> {effect} (lag {lag})"


def listed(items: Iterable[object]) -> str:
    """Count things and name the first of them, one per line."""
    found = [str(item) for item in items]
    more = [f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n".join([str(len(found)), *found[:SHOWN], *more])


def written(title: str, rows: tuple[Row, ...]) -> str:
    """Write rows as plain text, continued lines below their first one."""
    width = max(len(name) for name, _, _ in rows)
    indent = "\n" + " " * (width + 4)
    lines = (f"  {name:<{width}}  {value.replace(chr(10), indent)}" for name, value, _ in rows)
    return "\n".join([title, *lines])
