"""The result of an evaluation: a data frame with a row for each episode, and its estimates."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
import pandas

from scm_world._arguments import one_of, typed
from scm_world._types import Floats
from scm_world.env.observer import FAILED
from scm_world.errors import UnknownOption, reading
from scm_world.evaluation.episodes import FRACTIONS, KEYS, METRICS, drawn_columns
from scm_world.evaluation.statistics import (
    Causes,
    Interval,
    aggregate,
    difference_interval,
    find_causes,
    mean_interval,
)
from scm_world.evaluation.verdicts import Inferred
from scm_world.runs.files import (
    Location,
    located,
    read_bytes,
    read_text,
    remove,
    write_whole,
)
from scm_world.tasks import Task

RATES: Mapping[str, bool | None] = {
    **dict.fromkeys((*FRACTIONS, "success"), True),
    FAILED: True,
    "return": False,
    "published_overlap": None,
}
"""Whether a metric always lies in [0, 1]; None: as far as its scores do."""

FORMAT = "scm_world/evaluation/3"
RESULTS = "results.json"
TABLE = "episodes.parquet"
ABOUT = ("task", "arguments", "env", "engines", "agents", "protocols", "seeds", "n", "versions")
ADVICE = "give the folder, or the results.json, that an evaluation wrote"
NO_PATH = "no directed path leads from it to the score or the observation"


def means(frame: pandas.DataFrame, metric: str) -> pandas.Series[float]:
    """Return the mean score of each episode over the training runs, by seed and number."""
    return frame.groupby(["seed", "episode"])[metric].mean()


def settled(found: Interval, *frames: pandas.DataFrame) -> Interval:
    """Return an estimate, exact where each run played one episode bit for bit again and again."""
    runs = [frame.groupby("run")["hash"].nunique() for frame in frames]
    same = (bool((n == 1).all()) and len(n) < len(f) for n, f in zip(runs, frames, strict=True))
    return replace(found, low=found.value, high=found.value) if all(same) else found


@final
@dataclass(frozen=True, eq=False)
class Evaluation:
    """All episodes of an evaluation.

    Attributes:
        about: Description of the evaluation as plain data: task, options, agents, protocols, seeds,
            versions.
        frame: The table: ``KEYS``, ``steps``, ``METRICS``, ``hash``, and the values that were drawn
            (NaN where a variable was not).
        policies: The policies, by agent and run, if they were given in this process; in no file.
        made: The task, if it was given as an object in this process; in no file.
    """

    about: Mapping[str, Any]
    frame: pandas.DataFrame
    policies: Mapping[tuple[str, int], Any] = field(default_factory=dict, repr=False)
    made: Task | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the policies and the task: not all of them can be pickled."""
        return {**self.__dict__, "policies": {}, "made": None}

    def __len__(self) -> int:
        return len(self.frame)

    def __eq__(self, other: object) -> bool:
        """Return whether both have the same rows; the order of columns does not matter."""
        if not isinstance(other, Evaluation) or {*self.frame} != {*other.frame}:
            return False
        return bool(self.frame.equals(other.frame[[*self.frame]]))

    __hash__ = None  # type: ignore[assignment] # compared by content

    # --- contents -----------------------------------------------------------------------------

    def _listed(self, name: str) -> tuple[Any, ...]:
        return tuple(self.frame[name].drop_duplicates().tolist())

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.about["task"])

    @property
    def agents(self) -> tuple[str, ...]:
        """Names of the agents."""
        return self._listed("agent")

    @property
    def engines(self) -> tuple[str, ...]:
        """Names of the backends."""
        return self._listed("engine")

    @property
    def protocols(self) -> tuple[str, ...]:
        """Names of the protocols."""
        return self._listed("protocol")

    @property
    def metrics(self) -> tuple[str, ...]:
        """The scores in the table: those of ``METRICS`` that the task has."""
        return tuple(metric for metric in METRICS if metric in self.frame)

    def metric(self, name: str | None = None) -> str:
        """Return the name of a metric; None stands for the first one of ``metrics``.

        That is the last fractional success, as in the published figures; of a task without it,
        success; without a definition of success, the return.

        Raises:
            UnknownOption: Nothing of this name was measured.
        """
        one_of("metric", name, (None, *self.metrics))
        return self.metrics[0] if name is None else name

    @typed
    def runs(self, agent: str) -> tuple[int, ...]:
        """List the training runs of an agent."""
        return self.only(agent=agent)._listed("run")

    def only(self, **wanted: str | int | None) -> Evaluation:
        """Return the rows of one agent, run, engine, protocol, seed or episode.

        Raises:
            UnknownOption: There are no episodes.
        """
        frame = self.frame
        for name, value in wanted.items():
            one_of("column", name, KEYS)
            if value is not None:
                if np.ndim(value) or value not in self._listed(name):
                    raise UnknownOption(name, value, tuple(map(str, self._listed(name))))
                frame = frame[frame[name] == value]
        return replace(self, frame=frame.reset_index(drop=True))

    def the(self, name: str, given: str | None) -> str:
        """Choose an agent or a backend; where there is only one it need not be named.

        Raises:
            UnknownOption: There are several, or none of this name.
        """
        one_of("column", name, KEYS)
        known = self._listed(name)
        if given is None and len(known) == 1:
            return str(known[0])
        one_of(name, given, known)
        return str(given)

    # --- estimates ----------------------------------------------------------------------------

    @typed
    def scores(
        self, metric: str | None = None, *, agent: str | None = None, engine: str | None = None
    ) -> Floats:
        """Return the scores of an agent on an engine.

        Returns:
            Shape ``(runs, protocols, episodes)``, of the protocols that it has played; episodes
            in the order of seed and number.

        Raises:
            UnknownOption: Metric, agent or backend is unknown, or protocols do not have the same
                episodes.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine).frame.sort_values(["seed", "episode"])
        played = [one for one in self.protocols if (mine["protocol"] == one).any()]
        groups = dict(iter(mine.groupby(["run", "protocol"])[metric]))
        runs = mine["run"].unique()
        parts = [[groups[run, one].to_numpy() for one in played] for run in sorted(runs)]
        lengths = {len(scores) for row in parts for scores in row}
        if len(lengths) != 1:
            raise UnknownOption("episodes", lengths, ("the same number in every protocol",))
        return np.array(parts)

    @typed
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
        same, bit for bit, nothing is random and the score is exact.

        Raises:
            UnknownOption: Protocol, metric, agent or engine is unknown.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine, protocol=protocol).frame
        found = mean_interval(means(mine, metric).to_numpy(), proportion=RATES[metric])
        return settled(found, mine)

    @typed
    def difference(
        self,
        one: str,
        other: str,
        protocol: str,
        metric: str | None = None,
        *,
        agent: str | None = None,
        engine: str | None = None,
    ) -> Interval:
        """Estimate by how much the scores of one are higher than those of another, paired.

        Both met the same draws, so this interval is mostly smaller than with independent draws.
        Of several runs of an agent the mean counts.

        Args:
            one: An agent, or a backend.
            other: Another one.
            protocol: Name of the protocol.
            metric: Name of the metric.
            agent: Of two backends, the agent that acted on both; not needed where there is one.
            engine: Of two agents, the backend; not needed where there is one.

        Raises:
            UnknownOption: Agent or backend is unknown, or they have not played the same episodes.
        """
        metric, here = self.metric(metric), self.only(protocol=protocol)
        if one in self.engines:
            name, here = "engine", here.only(agent=self.the("agent", agent))
        else:
            name, here = "agent", here.only(engine=self.the("engine", engine))
        mine, its = (here.only(**{name: who}).frame for who in (one, other))
        first, second = means(mine, metric), means(its, metric)
        if not first.index.equals(second.index):
            differ = first.index.symmetric_difference(second.index)[0]
            allowed = ("episodes that both have played",)
            raise UnknownOption("seed and episode of a pair", differ, allowed)
        arrays = first.to_numpy(), second.to_numpy()
        found = difference_interval(*arrays, proportion=RATES[metric])
        return settled(found, mine, its)

    @typed
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
        """Return the values that were drawn in all rows, by variable, shape ``(n, numbers)``."""
        columns = drawn_columns(self.frame)
        return {name: self.frame[one].to_numpy(np.float64) for name, one in columns.items()}

    @typed
    def causes(
        self,
        protocol: str,
        metric: str | None = None,
        *,
        agent: str | None = None,
        engine: str | None = None,
        inferred: Inferred | None = None,
    ) -> Causes:
        """Estimate the effect of each variable that varies in a protocol on the score.

        The protocol, the ``start`` of the environment, or nature drew the values at random, each
        on its own, so an association with the score is an effect.
        Variables without a directed path to the score or to the observation are left out. Of
        several runs of an agent the mean counts. This measures how sensitive the score is; which
        parameter accounts for the deviation of a recording is ``World.explain``.

        With ``inferred``, what the function of this name has found for the agent, the table says
        which variables the agent infers, and which of those that matter it does not.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine, protocol=protocol)
        first = mine.only(run=mine._listed("run")[0])
        units = pandas.MultiIndex.from_frame(first.frame[["seed", "episode"]])
        scores = means(mine.frame, metric).loc[units].to_numpy()
        varied = {n: v for n, v in first.drawn().items() if not np.isnan(v).all()}
        silent = [n for n in self.about.get("unrelated", {}).get(agent, ()) if n in varied]
        tested = {name: values for name, values in varied.items() if name not in silent}
        found = find_causes(tested, scores, proportion=RATES[metric])
        left_out = {**found.left_out, **dict.fromkeys(silent, NO_PATH)}
        verdicts = {} if inferred is None else inferred.verdicts()
        return replace(found, left_out=left_out, verdicts=verdicts)

    # --- files --------------------------------------------------------------------------------

    def save(self, folder: Location | str) -> tuple[Location, Location]:
        """Write ``results.json`` and the table beside it, ``episodes.parquet``.

        Raises:
            UnwritableFolder: The disk is full, or permission is missing.
        """
        place, content = located(folder), io.BytesIO()
        summary, table = place / RESULTS, place / TABLE
        self.frame.to_parquet(content, compression="zstd", index=False)
        data = {
            "format": FORMAT,
            "rows": len(self),
            "scores": self._summarized(),
            "about": dict(self.about),
        }
        remove(summary)  # it is of the table that goes
        write_whole(table, content.getvalue())
        write_whole(summary, json.dumps(data, indent=1, allow_nan=False) + "\n")
        return summary, table

    def _summarized(self) -> list[dict[str, Any]]:
        """List the scores with their intervals: one row for each agent, backend and protocol."""
        return [
            {
                "agent": agent,
                "engine": engine,
                "protocol": protocol,
                **{metric: mine.score(protocol, metric).as_dict() for metric in mine.metrics},
            }
            for agent in self.agents
            for engine in self.only(agent=agent).engines
            for mine in [self.only(agent=agent, engine=engine)]
            for protocol in mine.protocols
        ]

    @classmethod
    def load(cls, path: Location | str) -> Evaluation:
        """Read a folder of ``save``, or its ``results.json``.

        Raises:
            UnreadableFile: It is damaged, or something else.
        """
        place = located(path)
        file = place / RESULTS if place.is_dir() else place
        with reading(file, ADVICE):
            data = json.loads(read_text(file))
            if data["format"] != FORMAT:
                raise ValueError(f"it is not an evaluation of the format {FORMAT!r}")
            missing = [name for name in ABOUT if name not in data["about"]]
            frame = pandas.read_parquet(io.BytesIO(read_bytes(file.parent / TABLE)))
            missing += [name for name in (*KEYS, "steps", "return", "hash") if name not in frame]
            if missing or len(frame) != data["rows"]:
                lacks = f"lacks {missing[0]!r}" if missing else "has another number of rows"
                raise ValueError(f"it, or {TABLE}, {lacks}")
        return cls(data["about"], frame)
