"""What an evaluation gives: a table with a row for each episode, and what it says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of
from scm_world._types import Floats
from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import FRACTIONS, METRICS, EpisodeRow
from scm_world.evaluation.statistics import (
    Causes,
    Interval,
    aggregate,
    difference_interval,
    find_causes,
    mean_interval,
)
from scm_world.runs.files import Location, located

TEXTS = ("agent", "engine", "protocol", "hash")
WHOLE = ("run", "seed", "episode", "steps")
KEYS = ("agent", "run", "engine", "protocol", "seed", "episode")
"""The columns that say which episode a row is of."""

DRAWN = "drawn "
"""First word of the columns with the values that were drawn."""

RATES: Mapping[str, bool | None] = {
    **dict.fromkeys((*FRACTIONS, "success"), True),
    "return": False,
    "published_overlap": None,
}
"""Whether a metric always lies in [0, 1]; None: as far as its scores do."""

NO_PATH = "no directed path leads from it to the score or the observation"

Columns = dict[str, NDArray[Any]]


def columns_of(rows: Sequence[EpisodeRow]) -> Columns:
    """Return the table of some episodes: a column of shape (n,) for each field of a row."""
    found: Columns = {}
    for name in (*KEYS, "steps"):
        kind: Any = str if name in TEXTS else np.int64
        found[name] = np.array([getattr(row, name) for row in rows], dtype=kind)
    for metric in METRICS:
        if all(metric in row.scores for row in rows):
            found[metric] = np.array([row.scores[metric] for row in rows], dtype=np.float64)
    found["hash"] = np.array([row.hash for row in rows], dtype=str)
    return {**found, **_drawn(rows)}


def _drawn(rows: Sequence[EpisodeRow]) -> Columns:
    """Give a column for each number of each variable that was drawn; NaN where it was not."""
    sizes: dict[str, int] = {}
    for row in rows:
        for name, values in row.drawn.items():
            sizes[name] = max(sizes.get(name, 0), len(values))
    found: Columns = {}
    for name, size in sizes.items():
        table = np.full((len(rows), size), np.nan)
        for place, row in enumerate(rows):
            values = row.drawn.get(name, [])
            table[place, : len(values)] = values
        labels = [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]
        found |= {DRAWN + label: table[:, k].copy() for k, label in enumerate(labels)}
    return found


def means(columns: Columns, metric: str) -> dict[tuple[int, int], float]:
    """Give the mean score of each episode over the training runs, by seed and number."""
    found: dict[tuple[int, int], list[float]] = {}
    seeds, episodes = columns["seed"].tolist(), columns["episode"].tolist()
    for seed, episode, score in zip(seeds, episodes, columns[metric].tolist(), strict=True):
        found.setdefault((seed, episode), []).append(score)
    return {unit: sum(scores) / len(scores) for unit, scores in found.items()}


def is_settled(columns: Columns) -> bool:
    """Whether nothing is random: each run played one and the same episode again and again."""
    episodes = set(zip(columns["run"].tolist(), columns["hash"].tolist(), strict=True))
    return len(episodes) == len(set(columns["run"].tolist())) < len(columns["run"])


def paired(one: Columns, other: Columns, metric: str) -> Interval:
    """Estimate by how much the scores of a table are higher, episode by episode.

    Raises:
        UnknownOption: They do not have the same episodes.
    """
    mine, its = means(one, metric), means(other, metric)
    if mine.keys() != its.keys():
        differ = sorted(mine.keys() ^ its.keys())[0]
        allowed = ("episodes that both have played",)
        raise UnknownOption("seed and episode of a pair", differ, allowed)
    units = sorted(mine)
    first, second = (np.array([scores[unit] for unit in units]) for scores in (mine, its))
    found = difference_interval(first, second, proportion=RATES[metric])
    return _exact(found) if is_settled(one) and is_settled(other) else found


def _exact(found: Interval) -> Interval:
    """Return an estimate of what is not random."""
    return replace(found, low=found.value, high=found.value)


def digest_of(columns: Columns) -> str:
    """Return a digest of a table; the order of its columns does not matter."""
    found = blake2b(digest_size=16)
    for name in sorted(columns):
        column = columns[name]
        found.update(f"\0{name}\0".encode())
        text = "\0".join(column) if column.dtype.kind == "U" else ""
        found.update(text.encode() if text else column.tobytes())
    return found.hexdigest()


@final
@dataclass(frozen=True, eq=False)
class Evaluation:
    """All episodes of an evaluation.

    Attributes:
        about: What was evaluated, as plain data: task, options, agents, protocols, seeds, versions.
        columns: The table, each column of shape ``(n,)``: ``KEYS``, ``steps``, ``METRICS``,
            ``hash``, and the values that were drawn (NaN where a variable was not).
        policies: Who acted, by agent and run, as long as it was in this process; in no file.
    """

    about: Mapping[str, Any]
    columns: Columns
    policies: Mapping[tuple[str, int], Any] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, about: Mapping[str, Any], rows: Sequence[EpisodeRow]) -> Evaluation:
        """Make the table of some rows."""
        return cls(about, columns_of(rows))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the policies: not all of them can be pickled."""
        return {**self.__dict__, "policies": {}}

    def __len__(self) -> int:
        return len(self.columns["episode"])

    def __eq__(self, other: object) -> bool:
        """Tell whether both have the same rows, bit for bit."""
        return isinstance(other, Evaluation) and self.digest == other.digest

    __hash__ = None  # type: ignore[assignment] # compared by content

    @cached_property
    def digest(self) -> str:
        """Digest of the table; the order of its columns does not matter."""
        return digest_of(self.columns)

    # --- what there is ------------------------------------------------------------------------

    def _listed(self, name: str) -> tuple[Any, ...]:
        return tuple(dict.fromkeys(self.columns[name].tolist()))

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.about["task"])

    @property
    def agents(self) -> tuple[str, ...]:
        """Who acted."""
        return self._listed("agent")

    @property
    def engines(self) -> tuple[str, ...]:
        """On which engines."""
        return self._listed("engine")

    @property
    def protocols(self) -> tuple[str, ...]:
        """In which protocols."""
        return self._listed("protocol")

    @property
    def metrics(self) -> tuple[str, ...]:
        """What was measured: those of ``METRICS`` that the task has."""
        return tuple(metric for metric in METRICS if metric in self.columns)

    def metric(self, name: str | None = None) -> str:
        """Choose what is looked at; None stands for the first one of ``metrics``.

        That is the last fractional success, as in the published figures; of a task without it,
        success; of one that does not say what success is, the return.

        Raises:
            UnknownOption: Nothing of this name was measured.
        """
        if name is not None and name not in self.metrics:
            raise UnknownOption("metric", name, self.metrics)
        return self.metrics[0] if name is None else name

    def runs(self, agent: str) -> tuple[int, ...]:
        """List the training runs of an agent."""
        return self.only(agent=agent)._listed("run")

    def only(self, **wanted: Any) -> Evaluation:
        """Give the rows of one agent, run, engine, protocol, seed or episode.

        Raises:
            UnknownOption: There are none.
        """
        kept = np.ones(len(self), dtype=bool)
        for name, value in wanted.items():
            one_of("column", name, KEYS)
            if value is not None:
                if value not in self._listed(name):
                    raise UnknownOption(name, value, tuple(map(str, self._listed(name))))
                kept &= self.columns[name] == value
        columns = {name: column[kept] for name, column in self.columns.items()}
        return Evaluation(self.about, columns, self.policies)

    def the(self, name: str, given: str | None) -> str:
        """Choose an agent or a backend; where there is only one it need not be named.

        Raises:
            UnknownOption: There are several, or none of this name.
        """
        known = self._listed(name)
        if given is None and len(known) == 1:
            return str(known[0])
        one_of(name, given, known)
        return str(given)

    # --- what it says -------------------------------------------------------------------------

    def scores(
        self, metric: str | None = None, *, agent: str | None = None, engine: str | None = None
    ) -> Floats:
        """Give the scores of an agent on an engine.

        Returns:
            Shape ``(runs, protocols, episodes)``, of the protocols that it has played; episodes
            in the order of seed and number.

        Raises:
            UnknownOption: There is no such metric, agent or backend, or protocols do not have the
                same episodes.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine)
        played = [protocol for protocol in self.protocols if protocol in mine.protocols]
        parts = [
            [mine.only(run=run, protocol=protocol)._by_unit(metric) for protocol in played]
            for run in mine._listed("run")
        ]
        lengths = {len(scores) for row in parts for scores in row}
        if len(lengths) != 1:
            raise UnknownOption("episodes", lengths, ("the same number in every protocol",))
        return np.array(parts)

    def _by_unit(self, metric: str) -> Floats:
        order = np.lexsort([self.columns["episode"], self.columns["seed"]])
        found: Floats = self.columns[metric][order]
        return found

    def score(
        self,
        protocol: str,
        metric: str | None = None,
        *,
        agent: str | None = None,
        engine: str | None = None,
    ) -> Interval:
        """Estimate the mean score in a protocol, with its 95 % interval over episodes.

        Of several training runs the mean of each episode counts, since all met the same draws: the
        interval says how sure we are of these runs. Where all episodes of a run are one and the
        same, bit for bit, nothing is random and the score is what it is.

        Raises:
            UnknownOption: There is no such protocol, metric, agent or engine.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine, protocol=protocol).columns
        found = mean_interval([*means(mine, metric).values()], proportion=RATES[metric])
        return _exact(found) if is_settled(mine) else found

    def difference(
        self,
        one: str,
        other: str,
        protocol: str,
        metric: str | None = None,
        *,
        engine: str | None = None,
    ) -> Interval:
        """Estimate by how much an agent is better than another one, episode by episode.

        Both met the same draws, so this interval is mostly smaller than with draws of their own.
        Of several runs of an agent the mean counts.

        Raises:
            UnknownOption: They did not play the same episodes.
        """
        metric = self.metric(metric)
        engine = self.the("engine", engine)
        here = self.only(engine=engine, protocol=protocol)
        return paired(here.only(agent=one).columns, here.only(agent=other).columns, metric)

    def gap(
        self,
        one: str,
        other: str,
        protocol: str,
        metric: str | None = None,
        *,
        agent: str | None = None,
    ) -> Interval:
        """Estimate by how much an agent does better on a backend than on another one.

        Raises:
            UnknownOption: It did not play the same episodes on both.
        """
        metric = self.metric(metric)
        here = self.only(agent=self.the("agent", agent), protocol=protocol)
        return paired(here.only(engine=one).columns, here.only(engine=other).columns, metric)

    def overall(
        self, metric: str | None = None, *, agent: str | None = None, engine: str | None = None
    ) -> dict[str, Interval]:
        """Estimate mean, median, interquartile mean and optimality gap over all protocols.

        Over training runs if there are several, else over episodes; see ``aggregate``.
        """
        metric = self.metric(metric)
        scores = self.scores(metric, agent=agent, engine=engine)
        return aggregate(scores, over="runs" if len(scores) > 1 else "episodes")

    def drawn(self) -> dict[str, Floats]:
        """Give the values that were drawn in all rows, by variable, shape ``(n, numbers)``."""
        found: dict[str, list[Floats]] = {}
        for name, column in self.columns.items():
            if name.startswith(DRAWN):
                found.setdefault(name.removeprefix(DRAWN).partition("[")[0], []).append(column)
        return {name: np.stack(parts, axis=1) for name, parts in found.items()}

    def causes(
        self,
        protocol: str,
        metric: str | None = None,
        *,
        agent: str | None = None,
        engine: str | None = None,
    ) -> Causes:
        """Estimate what each variable that a protocol varies does to the score.

        The values were drawn at random, each on its own, so what goes with them is their effect.
        Variables without a directed path to the score or to the observation are left out. Of
        several runs of an agent the mean counts.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine, protocol=protocol)
        first = mine.only(run=mine._listed("run")[0])
        score_of = means(mine.columns, metric)
        units = zip(first.columns["seed"].tolist(), first.columns["episode"].tolist(), strict=True)
        varied = {n: v for n, v in first.drawn().items() if not np.isnan(v).all()}
        scores = np.array([score_of[unit] for unit in units])
        silent = [n for n in self.about.get("unrelated", {}).get(agent, ()) if n in varied]
        tested = {name: values for name, values in varied.items() if name not in silent}
        found = find_causes(tested, scores, proportion=RATES[metric])
        return replace(found, left_out={**found.left_out, **dict.fromkeys(silent, NO_PATH)})

    def published(self, *, agent: str | None = None, engine: str | None = None) -> dict[str, Any]:
        """Give means and standard deviations under the predecessor's names, by protocol."""
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        found: dict[str, Any] = {}
        for protocol in self.only(agent=agent, engine=engine).protocols:
            mine = self.only(agent=agent, engine=engine, protocol=protocol)
            found[protocol] = {
                f"{how}_{metric}": float(getattr(np, how)(mine.columns[metric]))
                for metric in FRACTIONS
                if metric in mine.columns
                for how in ("mean", "std")
            }
        return found

    # --- files --------------------------------------------------------------------------------

    def save(self, folder: Location | str, *, kind: str = "parquet") -> tuple[Location, Location]:
        """Write ``results.json`` and the table beside it, ``"parquet"`` or ``"csv"``.

        Raises:
            UnwritableFolder: There is no room, or no permission.
        """
        from scm_world.evaluation.files import save

        return save(self, located(folder), kind)

    @classmethod
    def load(cls, path: Location | str) -> Evaluation:
        """Read what ``save`` wrote: the folder, or its ``results.json``.

        Raises:
            UnreadableFile: It is damaged, or something else.
        """
        from scm_world.evaluation.files import load

        return load(located(path))
