"""Discovery from beginning to end: experiments and a report."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable
from functools import cached_property
from typing import Literal, final

from pydantic import computed_field

from scm_world._arguments import real_number, typed, whole_number
from scm_world._fingerprint import fingerprint
from scm_world.discovery.metrics import Scores, evaluate
from scm_world.graph import SCM
from scm_world.queries.experiments.effects import EdgeKey, Effects
from scm_world.queries.experiments.paired import Paired, opened
from scm_world.queries.experiments.probes import probes as probe_states
from scm_world.queries.experiments.versions import versions
from scm_world.queries.progress import Progress
from scm_world.queries.verification import (
    GraphReport,
    Outcome,
    Row,
    arrow,
    listed,
    outcome,
)
from scm_world.runs.files import Location
from scm_world.runs.study import Study
from scm_world.world import CausalSystem


@final
class DiscoveryReport(GraphReport):
    """A graph recovered from interventional experiments, compared with the declared one.

    Attributes:
        format: Format of the file.
        at_least: Edges that were seen and are weaker, in spreads of free motion, are not scored.
        bound: Fewest rollouts that find a graph without prior knowledge: one for each variable that
            can be set, in each probe state.
        inert: Largest effect among the pairs without an edge in the estimated graph.
        refused: Targets that found no feasible value in some probes, with how often.
        floors: Effects on a variable up to this size are noise: the solver's memory.
    """

    format: Literal["scm_world/discovery/4"] = "scm_world/discovery/4"
    at_least: float = 0.0
    bound: int
    inert: float
    refused: dict[str, int]
    floors: dict[str, float]

    @computed_field  # type: ignore[prop-decorator]
    @cached_property
    def score(self) -> Scores:
        """The comparison of the estimated with the declared graph."""
        weak = self.weak(self.at_least)
        return evaluate({*self.found} - weak, {*self.declared} - weak)

    @property
    def outcome(self) -> Outcome:
        """The verdict on the declared graph, as in ``Verification``."""
        wrong, unseen = self.undeclared or self.unstable, self.unseen or self.probes < self.planned
        return outcome(wrong=wrong, unseen=unseen)

    @property
    def title(self) -> str:
        """The first line of the report."""
        return f"Discovery of {self.task} on {self.backend}: {self.outcome}"

    def rows(self) -> tuple[Row, ...]:
        """List the numbers and their meaning."""
        s, version = self.score, self.versions.get(self.backend, "")
        rest = f" of {self.planned}: interrupted" * (self.probes < self.planned)
        states = f"{self.probes}{rest}"
        refused = ", ".join(f"{name} ({n})" for name, n in self.refused.items())
        memory = f"{max(self.floors.values(), default=0.0):.3g}"
        return (
            ("outcome", self.outcome),
            *self.counted(),
            self.sized(),
            ("backend", f"{self.backend} {version}, preset {self.preset}"),
            *((("options", ", ".join(self.arguments)),) if self.arguments else ()),
            ("probe states", states),
            ("rollouts", f"{self.rollouts}, of which {self.bound} are needed at least"),
            ("noise floor, two equal runs", f"{self.floor:.3g}"),
            *((("memory of the solver, at most", memory),) if self.floors else ()),
            *self.rounded(),
            ("largest effect without an edge", f"{self.inert:.3g}"),
            ("precision", f"{s.precision:.4f}"),
            ("recall", f"{s.recall:.4f}"),
            ("F1", f"{s.f1:.4f}"),
            ("SHD over all edges", str(s.shd)),
            ("[+] undeclared", listed(map(arrow, s.undeclared))),
            ("[-] missed", listed(map(arrow, s.missed))),
            *((("not scored: weaker than", self._weak()),) if self.at_least else ()),
            *((("no feasible value in some states", refused),) if refused else ()),
            ("seconds", f"{self.seconds:.1f}"),
        )

    def _weak(self) -> str:
        strength = self.strength
        weak = sorted(self.weak(self.at_least), key=lambda key: -strength[key])
        lines = listed(f"{strength[key]:.3g} {arrow(key)}" for key in weak)
        return f"{self.at_least:g}: {lines}"


@typed
def discover(
    system: CausalSystem | SCM | str,
    *,
    probes: int = 32,
    seed: int = 0,
    at_least: float = 0.0,
    progress: Progress | None = None,
    found: Callable[[set[EdgeKey]], object] | None = None,
    checkpoint: Location | str | None = None,
    **options: object,
) -> DiscoveryReport:
    """Recover a causal graph by paired single-target interventions, and score it.

    The threshold follows from the measured floor: the largest difference between two runs without
    a change. It may be interrupted (Ctrl-C); the report then covers the
    probe states that were finished. The state of a given world does not change.

    Args:
        system: A world, the name of a task, or a causal model without physics.
        probes: How many states to experiment in.
        seed: Of states and values.
        at_least: Edges that were seen and are weaker do not count in the score, and are listed
            apart: the largest effect in units of how much the effect varies in free motion. Those
            into variables that do not move by themselves have no strength, and count.
        progress: Called with (finished, planned) after each probe state.
        found: Called before that with all edges found so far: (cause, effect, lag).
        checkpoint: A folder with a file for each probe state that is finished; the same call
            resumes from there, with the same result.
        options: Arguments of ``World``, where ``system`` is a name.

    Raises:
        UnknownOption: ``probes`` or ``at_least`` is not such a number, a name does not exist, or
            there are options for a world that is made.
        ModelError: A world with an engine was given a mechanism, or equations an act with a time.
        UnreadableFile: A file in the folder is damaged, or it is of another discovery.

    Example:
        >>> from scm_world.variables import Derived, Exogenous, Linear
        >>> model = SCM([
        ...     Exogenous(name="a"),
        ...     Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
        ... ])
        >>> discover(model, probes=2).score.shd
        0
    """
    whole_number("number of probes", probes, least=1)
    real_number("at_least", at_least, least=0.0)
    with opened(system, options) as there:
        started, paired = time.perf_counter(), Paired(there, seed)
        declared = {edge.key for edge in paired.model.edges}
        engine = "" if isinstance(there, SCM) else f"{there.backend.name} {there.backend.version}"
        terms = {"seed": seed, "versions": versions(engine), "fingerprint": fingerprint(there)}
        effects, done = paired.effects(), 0

        def experiment(number: int) -> Effects:
            (probe,) = probe_states(there, number + 1, seed, first=number)
            return paired.run(number, probe)

        cells = {f"probe-{number}.json": number for number in range(probes)}
        try:
            with Study(checkpoint, "discovery", terms) as study:
                for _, seen in study.map(cells, experiment, read=_read, write=_written):
                    effects.add(seen)
                    done += 1
                    if found is not None:
                        found(effects.edges(declared))
                    if progress is not None:
                        progress(done, probes)
        except KeyboardInterrupt:
            if not done:
                raise
        edges = effects.edges(declared)
        inert = [size for key, size in effects.largest.items() if key not in edges]
        effects.settings.clear()  # the files do not have them
        return DiscoveryReport._of(
            there,
            effects,
            seed,
            at_least=at_least,
            probes=done,
            planned=probes,
            bound=done * sum(effects.changed[name] > 0 for name in paired.targets),
            inert=max(inert, default=0.0),
            refused=dict(effects.refused),
            floors=paired.floors,
            seconds=time.perf_counter() - started,
        )


def _written(effects: Effects) -> bytes:
    """Return the content of the file of a probe state, the same bytes in every process."""
    kept = ("unstable", "changed", "refused", "rollouts", "sought", "unsaturated")
    plain = {name: getattr(effects, name) for name in kept}
    plain["touching"] = [sorted(pairs) for pairs in effects.touching]
    sizes = sorted([*key, size, effects.relative[key]] for key, size in effects.largest.items())
    return json.dumps({**plain, "sizes": sizes}, sort_keys=True).encode()


def _read(content: bytes) -> Effects:
    plain = json.loads(content)
    sizes = {(cause, effect, lag): both for cause, effect, lag, *both in plain.pop("sizes")}
    for name in ("changed", "refused", "unsaturated"):
        plain[name] = Counter(plain[name])
    touching = [frozenset((one, other) for one, other in pairs) for pairs in plain.pop("touching")]
    return Effects(
        largest={key: size for key, (size, _) in sizes.items()},
        relative={key: share for key, (_, share) in sizes.items()},
        touching=touching,
        **plain,
    )
