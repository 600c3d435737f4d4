"""The result of an evaluation: a data frame with a row for each episode, and its estimates."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, final

import numpy as np
import pandas

from scm_world._arguments import one_of, typed, whole_number
from scm_world._types import Floats
from scm_world.env.observer import FAILED
from scm_world.errors import UnknownOption, reading
from scm_world.evaluation.episodes import FRACTIONS, KEYS, METRICS, REWARDS, drawn_columns
from scm_world.evaluation.statistics import (
    Causes,
    Interval,
    aggregate,
    crossed_interval,
    difference_interval,
    find_causes,
    mean_interval,
)
from scm_world.evaluation.verdicts import Inferred, verdicts_of
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
STEPS = "steps.parquet"
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


def padded(rows: pandas.Series[Any]) -> Floats:
    """Return the rewards of episodes as an array, shape (n, steps); NaN after an episode's end."""
    found = np.full((len(rows), max(map(len, rows))), np.nan)
    for row, rewards in zip(found, rows, strict=True):
        row[: len(rewards)] = rewards
    return found


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
        rewards: The reward of each control step, if asked for by ``steps=True``, shape (n, steps)
            in the order of the rows of ``frame``; NaN after an episode's end.
    """

    about: Mapping[str, Any]
    frame: pandas.DataFrame
    policies: Mapping[tuple[str, int], Any] = field(default_factory=dict, repr=False)
    made: Task | None = field(default=None, repr=False)
    rewards: Floats | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the policies and the task: not all of them can be pickled."""
        return {**self.__dict__, "policies": {}, "made": None}

    def __len__(self) -> int:
        return len(self.frame)

    def __str__(self) -> str:
        metric, lines = self.metric(), ["agent", "engine"][: min(len(self.engines), 2)]
        table = self.frame.groupby(["protocol", *lines], sort=False)[metric].mean().unstack(lines)
        about = f"{len(self):,} episodes of {self.task}, mean {metric.replace('_', ' ')}"
        return f"{about}\n{table.to_string(float_format='{:.3f}'.format)}"

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
        kept = np.full(len(self), True)
        for name, value in wanted.items():
            one_of("column", name, KEYS)
            if value is not None:
                if np.ndim(value) or value not in self._listed(name):
                    raise UnknownOption(name, value, tuple(map(str, self._listed(name))))
                kept &= (self.frame[name] == value).to_numpy()
        rewards = None if self.rewards is None else self.rewards[kept]
        return replace(self, frame=self.frame[kept].reset_index(drop=True), rewards=rewards)

    @cached_property
    def by_draw(self) -> Evaluation:
        """The evaluation with a row for each draw, with the means of the episodes that repeat it.

        Its column ``episode`` has the number of the draw. Estimates are over draws, since episodes
        of one draw depend on one another. What is drawn anew in each of them, such as a start
        state, has its mean, too.
        """
        about = {one["name"]: dict(one) for one in self.about.get("protocols", ())}
        times = {name: one.pop("repeats", 1) for name, one in about.items()}
        each = self.frame["protocol"].map(times).fillna(1).astype(int)
        if (each == 1).all():
            return self
        means = dict.fromkeys(("steps", *self.metrics), "mean")
        how: dict[str, Any] = {
            name: means.get(name, "".join if name == "hash" else "first")
            for name in map(str, self.frame)
            if name not in KEYS
        }
        frame = self.frame.assign(episode=self.frame["episode"] // each)
        groups = frame.groupby([*KEYS], sort=False, as_index=False)
        for label in (one for columns in drawn_columns(frame).values() for one in columns):
            how[label] = "mean" if np.max(groups[label].nunique()[label]) > 1 else "first"
        described = {**self.about, "protocols": [*about.values()]}
        return replace(self, about=described, frame=groups.agg(how), rewards=None)

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
            in the order of seed and number, of a draw that is repeated their mean.

        Raises:
            UnknownOption: Metric, agent or backend is unknown, or protocols do not have the same
                episodes.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.by_draw.only(agent=agent, engine=engine).frame
        mine = mine.sort_values(["seed", "episode"])
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
        mine = self.by_draw.only(agent=agent, engine=engine, protocol=protocol).frame
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
        metric, here = self.metric(metric), self.by_draw.only(protocol=protocol)
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

    # --- adaptation ---------------------------------------------------------------------------

    def _tables(
        self, agents: Sequence[str], protocol: str, metric: str, engine: str | None
    ) -> tuple[list[pandas.DataFrame], list[pandas.DataFrame]]:
        """Return the scores of each agent by draw and run, of the same draws, and its rows."""
        here = self.by_draw.only(protocol=protocol, engine=self.the("engine", engine))
        rows = [here.only(agent=agent).frame for agent in agents]
        tables = [f.pivot(index=["seed", "episode"], columns="run", values=metric) for f in rows]
        if any(
            one.isna().any(axis=None) or not one.index.equals(tables[0].index) for one in tables
        ):
            allowed = ("one whose draws every run of both agents has played",)
            raise UnknownOption("protocol", protocol, allowed)
        return tables, rows

    @typed
    def regret(
        self,
        agent: str,
        reference: str,
        protocol: str,
        metric: str | None = None,
        *,
        engine: str | None = None,
    ) -> Interval:
        """Estimate by how much the scores of a reference agent are higher, paired by draw.

        A reference that observes what the agent has to find out says what there is to be gained.
        The interval is over draws and over the training runs of both, see ``crossed_interval``;
        ``difference`` has one over episodes of these runs.

        Raises:
            UnknownOption: Agent, protocol, metric or backend is unknown, or they have not played
                the same draws.
        """
        metric = self.metric(metric)
        (mine, best), rows = self._tables((agent, reference), protocol, metric, engine)
        lost = best.to_numpy().T[:, None] - mine.to_numpy().T[None]  # (runs, runs, draws)
        return settled(crossed_interval(lost, bounds=(-1.0, 1.0) if RATES[metric] else None), *rows)

    @typed
    def probability_of_improvement(
        self,
        one: str,
        other: str,
        protocol: str,
        metric: str | None = None,
        *,
        engine: str | None = None,
    ) -> Interval:
        """Estimate the probability that a run of one scores higher than one of another agent.

        It is the share of pairs of their training runs, in the same draw, that the first one wins,
        with half of the ties. Intervals and errors are those of ``regret``.

        Source:
            Agarwal et al., *Deep reinforcement learning at the edge of the statistical precipice*,
            NeurIPS 2021; Mann and Whitney, Annals of Mathematical Statistics 1947.
        """
        (first, second), rows = self._tables((one, other), protocol, self.metric(metric), engine)
        apart = first.to_numpy().T[:, None] - second.to_numpy().T[None]
        found = crossed_interval(0.5 + 0.5 * np.sign(apart), bounds=(0.0, 1.0))
        return settled(found, *rows)

    @typed
    def attempts(
        self,
        protocol: str,
        metric: str | None = None,
        *,
        agent: str | None = None,
        engine: str | None = None,
    ) -> tuple[Interval, ...]:
        """Estimate the mean score of the first, second, … episode of each draw, then last - first.

        The last estimate is by how much the last episode of a draw scores higher than the first
        one, paired: what an agent that remembers has learned. Intervals are over draws and
        training runs, see ``crossed_interval``.

        Raises:
            UnknownOption: The protocol repeats no draw, or a name is unknown.
        """
        metric, about = self.metric(metric), self.about.get("protocols", ())
        times = {one["name"]: one.get("repeats", 1) for one in about}.get(protocol, 1)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        frame = self.only(agent=agent, engine=engine, protocol=protocol).frame
        if times < 2:
            raise UnknownOption("protocol", protocol, ("one with repeats=2 or more",))
        table = frame.pivot(index="run", columns=["seed", "episode"], values=metric).sort_index(
            axis=1
        )
        scores = table.to_numpy().reshape(len(table), -1, times)  # (runs, draws, attempts)
        one, apart = ((0.0, 1.0), (-1.0, 1.0)) if RATES[metric] else (None, None)
        each = [crossed_interval(scores[..., k], bounds=one) for k in range(times)]
        return (*each, crossed_interval(scores[..., -1] - scores[..., 0], bounds=apart))

    @typed
    def since(
        self,
        protocol: str,
        *,
        agent: str | None = None,
        engine: str | None = None,
        every: int = 1,
    ) -> pandas.DataFrame:
        """Estimate the mean reward by control step since the intervention of a protocol.

        Args:
            protocol: Name of the protocol, such as ``"P2@100"``.
            agent: Name of the agent; not needed where there is one.
            engine: Name of the backend; not needed where there is one.
            every: Control steps that one row is the mean of.

        Returns:
            A row for each ``every`` control steps: ``step``, counted from the intervention, so that
            those before it are negative; the mean ``reward`` of a control step from there on; and
            ``low`` and ``high`` of the interval over draws and training runs, see
            ``crossed_interval``. After its end an episode earns nothing.

        Raises:
            UnknownOption: The evaluation kept no rewards, or a name is unknown.
        """
        size = whole_number("every", every, least=1)
        if self.rewards is None:
            raise UnknownOption("since", "without rewards", ("an evaluation with steps=True",))
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.only(agent=agent, engine=engine, protocol=protocol)
        about = {one["name"]: one for one in self.about["protocols"]}[protocol]
        at, times = about["step"], about.get("repeats", 1)
        order = mine.frame.sort_values(["run", "seed", "episode"]).index
        values = np.nan_to_num(mine.rewards[order])  # type: ignore[index] # it has some
        values = values.reshape(mine.frame["run"].nunique(), -1, times, values.shape[1]).mean(
            axis=2
        )
        first = -(at // size) * size
        rows = []
        for begin in range(first, values.shape[2] - at, size):
            places = slice(max(at + begin, 0), at + begin + size)
            found = crossed_interval(values[:, :, places].mean(axis=2))
            rows.append((begin, found.value, found.low, found.high))
        return pandas.DataFrame(rows, columns=["step", "reward", "low", "high"])

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

        Raises:
            UnknownOption: A name is unknown, or ``inferred`` is about another policy.
        """
        metric = self.metric(metric)
        agent, engine = self.the("agent", agent), self.the("engine", engine)
        mine = self.by_draw.only(agent=agent, engine=engine, protocol=protocol)
        first = mine.only(run=mine._listed("run")[0])
        units = pandas.MultiIndex.from_frame(first.frame[["seed", "episode"]])
        scores = means(mine.frame, metric).loc[units].to_numpy()
        varied = {n: v for n, v in first.drawn().items() if not np.isnan(v).all()}
        silent = [n for n in self.about.get("unrelated", {}).get(agent, ()) if n in varied]
        tested = {name: values for name, values in varied.items() if name not in silent}
        found = find_causes(tested, scores, proportion=RATES[metric])
        left_out = {**found.left_out, **dict.fromkeys(silent, NO_PATH)}
        verdicts = verdicts_of(inferred, self.about, agent)
        return replace(found, left_out=left_out, verdicts=verdicts)

    # --- files --------------------------------------------------------------------------------

    def save(self, folder: Location | str) -> tuple[Location, ...]:
        """Write ``results.json`` and the table beside it, ``episodes.parquet``.

        If rewards were kept, ``steps.parquet`` has them as lists, with the same rows.

        Raises:
            UnwritableFolder: The disk is full, or permission is missing.
        """
        place, content, more = located(folder), io.BytesIO(), io.BytesIO()
        summary, table, steps = place / RESULTS, place / TABLE, place / STEPS
        self.frame.to_parquet(content, compression="zstd", index=False)
        data = {
            "format": FORMAT,
            "rows": len(self),
            "scores": self._summarized(),
            "about": dict(self.about),
        }
        remove(summary)  # it is of the table that goes
        remove(steps)
        write_whole(table, content.getvalue())
        if self.rewards is not None:
            data["steps"] = True
            kept = zip(self.rewards, self.frame["steps"], strict=True)
            lists = self.frame[[*KEYS]].assign(**{REWARDS: [row[:n] for row, n in kept]})
            lists.to_parquet(more, compression="zstd", index=False)
            write_whole(steps, more.getvalue())
        write_whole(summary, json.dumps(data, indent=1, allow_nan=False) + "\n")
        return (summary, table) if self.rewards is None else (summary, table, steps)

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
            rewards = None
            if data.get("steps"):
                lists = pandas.read_parquet(io.BytesIO(read_bytes(file.parent / STEPS)))
                rewards = padded(lists[REWARDS])
                if len(rewards) != len(frame):
                    raise ValueError(f"{STEPS} has another number of rows")
        return cls(data["about"], frame, rewards=rewards)
