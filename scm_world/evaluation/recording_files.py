"""Recorded episodes, their Parquet files, and their export to Minari.

A recording has a file of its own: Minari's format has neither interventions nor digests of true
states, holds observations of one shape only, and needs an extra.

A Parquet file has a row for each instant. The last instant of an episode has an observation and a
state, but no action and no reward. What else a replay needs is a header: JSON in the metadata of
the file. All numbers keep their bits. Minari gets observations, actions, rewards and infos.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load
from scm_world._types import Floats, Integers
from scm_world.env import IDS, MODEL_ID
from scm_world.env.arguments import asked
from scm_world.env.observer import Observation
from scm_world.errors import DAMAGED, ModelError, UnknownOption, UnreadableFile
from scm_world.queries.plans import Plan
from scm_world.tasks import Task, tasks
from scm_world.tasks.factories import load_factory
from scm_world.variables import Draw, Subset
from scm_world.variables.kinds import SPACES

FORMAT = "scm_world/recording/2"
KEY = "scm_world"
ONLY = ""
"""Name of an observation that has no parts."""

_STEPS = {"reward": "rewards", "terminated": "terminations", "truncated": "truncations"}


@final
@dataclass(frozen=True)
class Recorded:
    """An episode of T control steps. An instant is observed after its interventions.

    Attributes:
        seed: Seed of the noise.
        number: Number of the episode within the noise.
        interventions: Each with its control step, in their order.
        observations: The observations of the T + 1 instants.
        actions: Shape (T, n_actions), as the environment was given them.
        rewards: Shape (T,).
        terminations: Whether each step ended the episode, shape (T,).
        truncations: Whether each step ended it for lack of time, shape (T,).
        infos: Entries of ``info`` by name, each of shape (T + 1,).
        states: A digest of the true state of each instant, shape (T + 1,).
        labels: The actions of a teacher at each step, in the units of actions, shape
            (T, n_actions); None where nobody was asked.
    """

    seed: int
    number: int
    interventions: tuple[tuple[int, Plan], ...]
    observations: tuple[Observation, ...] = field(repr=False)
    actions: NDArray[Any] = field(repr=False)
    rewards: Floats = field(repr=False)
    terminations: NDArray[np.bool_] = field(repr=False)
    truncations: NDArray[np.bool_] = field(repr=False)
    infos: Mapping[str, NDArray[Any]] = field(repr=False)
    states: Integers = field(repr=False)
    labels: NDArray[Any] | None = field(default=None, repr=False)

    def __len__(self) -> int:
        """Return the number of control steps."""
        return len(self.rewards)

    def __eq__(self, other: object) -> bool:
        """Return whether two episodes are the same, bit for bit."""
        if not isinstance(other, Recorded):
            return False
        names = [one.name for one in fields(self)]
        return all(_equal(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        return hash((self.seed, self.number, len(self)))


def _equal(one: Any, other: Any) -> bool:
    """Compare values that may hold arrays, bit for bit; actions of any floats by their numbers."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        kind: Any = np.result_type(one, other)
        first, second = (array.astype(kind).tobytes() for array in (one, other))
        return one.shape == other.shape and first == second
    if type(one) is not type(other):
        return False
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_equal(one[name], other[name]) for name in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return bool(one == other)


def parts(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return the arrays of an observation by name, in the order of their names.

    Example:
        >>> parts({"b": np.zeros(1), "a": np.ones(1)})
        {'a': array([1.]), 'b': array([0.])}
        >>> parts(np.zeros(2))
        {'': array([0., 0.])}
    """
    if isinstance(observation, dict):
        return {name: observation[name] for name in sorted(observation)}
    return {ONLY: observation}


def whole(arrays: Mapping[str, Any]) -> Any:
    """Return the observation that has such parts."""
    return arrays[ONLY] if ONLY in arrays else dict(arrays)


# --- what a header says ---------------------------------------------------------------------------


def as_data(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an environment as plain data."""
    arguments, problems = dict(made_with), []
    task = arguments["task"]
    if isinstance(task, Task):
        if not task.is_named:
            problems.append(f"give the arguments of {task.name!r} by name")
        arguments |= {"task": _reference(task), "task_options": task.given or None}
    if arguments.get("start"):
        arguments["start"] = {
            name: next((space for space in SPACES if act == Draw(space)), act)
            for name, act in asked(arguments["start"]).items()
        }
    found: dict[str, Any] = {}
    for name, value in arguments.items():
        try:
            found[name] = json.loads(json.dumps(value, allow_nan=False, default=_plain))
        except (TypeError, ValueError) as error:
            problems.append(f"the argument {name!r} of the environment cannot be written: {error}")
    if problems:
        raise ModelError(problems)
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Subset):
        return value.model_dump(mode="json")
    raise TypeError(f"{value!r} is not plain data")


def _reference(task: Task) -> str:
    """Return the text from which a task can be made again, with its arguments."""
    kind = type(task)
    if tasks().get(task.name) is kind:
        return task.name
    text = f"{kind.__module__}:{kind.__qualname__}"
    try:
        found = None if kind.__module__ == "__main__" else load_factory(text)
    except (ImportError, UnknownOption):
        found = None
    if found is not kind:
        raise ModelError(
            [
                f"the task {task.name!r} cannot be named in a file: its class {text} is found in "
                "no module; put the class or a function that makes it into a module, and give "
                "task='module:name'"
            ]
        )
    return text


# --- Parquet --------------------------------------------------------------------------------------


def to_parquet(about: Mapping[str, Any], episodes: Sequence[Recorded]) -> bytes:
    """Return the content of a Parquet file; the same bytes every time.

    Args:
        about: Plain data for the header: environment, fingerprint, versions, policy.
        episodes: The episodes.
    """
    import pyarrow as arrow
    from pyarrow import parquet

    if len({tuple(parts(episode.observations[0])) for episode in episodes}) != 1:
        raise ModelError(["a recording to save has episodes of one environment, and one at least"])

    def lists(rows: Sequence[Any], kind: Any) -> Any:
        return arrow.array(rows, arrow.large_list(arrow.from_numpy_dtype(kind)))

    counts = [len(episode) + 1 for episode in episodes]
    shapes: dict[str, list[int]] = {}
    columns: dict[str, Any] = {
        "episode": np.repeat(np.arange(len(episodes)), counts),
        "step": np.concatenate([np.arange(count) for count in counts]),
    }
    for name, first in parts(episodes[0].observations[0]).items():
        rows = [parts(seen)[name].reshape(-1) for one in episodes for seen in one.observations]
        shapes[name] = list(first.shape[1:])
        columns[_column(name)] = lists(rows, first.dtype)
    kind = np.result_type(*(episode.actions for episode in episodes))
    actions = [row for episode in episodes for row in (*episode.actions.astype(kind), None)]
    columns["action"] = lists(actions, kind)
    labels = [one.labels for one in episodes if one.labels is not None]
    if len(labels) == len(episodes):
        columns["label"] = lists([row for one in labels for row in (*one, None)], labels[0].dtype)
    for column, name in _STEPS.items():
        values = [row for one in episodes for row in (*getattr(one, name).tolist(), None)]
        columns[column] = arrow.array(values)
    for name in sorted({name for episode in episodes for name in episode.infos}):
        pairs = zip(episodes, counts, strict=True)
        known = [one.infos[name].tolist() if name in one.infos else [None] * n for one, n in pairs]
        columns[f"info.{name}"] = arrow.array([value for values in known for value in values])
    columns["state"] = np.concatenate([episode.states for episode in episodes])
    listed = [
        {
            "seed": one.seed,
            "number": one.number,
            "interventions": [[step, plan.as_dict()] for step, plan in one.interventions],
        }
        for one in episodes
    ]
    header = {"format": FORMAT, **about, "shapes": shapes, "episodes": listed}
    try:
        text = json.dumps(header, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelError([f"the description of the policy cannot be written: {error}"]) from None
    sink = arrow.BufferOutputStream()
    table = arrow.table(columns).replace_schema_metadata({KEY: text})
    parquet.write_table(table, sink, compression="zstd", use_dictionary=False)
    return bytes(sink.getvalue())


def from_parquet(
    data: bytes, path: str, trusted: Sequence[str]
) -> tuple[dict[str, Any], list[Recorded]]:
    """Read the header and the episodes of a Parquet file."""
    import pyarrow as arrow
    from pyarrow import parquet

    advice = "give one that a Recording was saved to"
    try:
        table = parquet.ParquetFile(arrow.BufferReader(data)).read().combine_chunks()
        header = json.loads((table.schema.metadata or {}).get(KEY.encode(), "{}"))
        if header.get("format") != FORMAT:
            raise ValueError("it is not a recording")
        starts = np.flatnonzero(np.diff(table["episode"].to_numpy(), prepend=-1))
        counts = np.diff([*starts, table.num_rows])
        episodes = [
            _episode(known, table.slice(start, count), header["shapes"], trusted)
            for known, start, count in zip(header["episodes"], starts, counts, strict=True)
        ]
        missing = {"environment", "fingerprint", "versions", "policy"} - header.keys()
        if missing:
            raise KeyError(min(missing))
    except ModelError:
        raise
    except DAMAGED as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise UnreadableFile(path, reason, advice) from None
    return header, episodes


def _episode(
    known: Mapping[str, Any], rows: Any, shapes: Mapping[str, Any], trusted: Sequence[str]
) -> Recorded:
    """Put an episode together, of its entry in the header and its rows of the table."""
    steps = rows.slice(0, rows.num_rows - 1)
    seen = {}
    for name, shape in shapes.items():
        flat = _rows(rows[_column(name)])
        seen[name] = [row.reshape(-1, *shape) for row in flat] if shape else flat
    return Recorded(
        seed=known["seed"],
        number=known["number"],
        interventions=tuple(
            (int(step), Plan.from_dict(plan, trusted=trusted))
            for step, plan in known["interventions"]
        ),
        observations=tuple(
            whole({name: arrays[at] for name, arrays in seen.items()})
            for at in range(rows.num_rows)
        ),
        actions=np.array(_rows(steps["action"])),
        **{name: steps[column].to_numpy() for column, name in _STEPS.items()},
        infos={
            name.removeprefix("info."): rows[name].to_numpy()
            for name in rows.column_names
            if name.startswith("info.") and rows[name].null_count == 0
        },
        states=rows["state"].to_numpy(),
        labels=np.array(_rows(steps["label"])) if "label" in rows.column_names else None,
    )


def _column(name: str) -> str:
    return "observation" if name == ONLY else f"observation.{name}"


def _rows(column: Any) -> list[NDArray[Any]]:
    return list(column.to_numpy(zero_copy_only=False)) if column.num_chunks else []


# --- Minari ---------------------------------------------------------------------------------------


def to_minari(
    environment: Mapping[str, Any], episodes: Sequence[Recorded], dataset_id: str, **about: Any
) -> Any:
    """Write a dataset of Minari; see ``Recording.to_minari``."""
    minari = load("minari", "minari", "data")
    local = load("minari.storage.local", "minari", "data")
    buffer = load("minari.data_collector.episode_buffer", "minari", "data").EpisodeBuffer
    library = "pyarrow" if about.get("data_format") == "arrow" else "h5py"
    load(library, library, "data")
    folder = Path(local.get_dataset_path(str(dataset_id)))
    if folder.exists():
        allowed = f"one that is not taken: minari.delete_dataset({dataset_id!r}) removes this one"
        raise UnknownOption("id of a dataset", dataset_id, (allowed,))
    shapes = {
        tuple((name, part.shape) for name, part in parts(observation).items())
        for episode in episodes
        for observation in episode.observations
    }
    if len(shapes) != 1:
        raise ModelError([f"a dataset of Minari has observations of one shape, got {len(shapes)}"])
    env: Any = gymnasium.make(disable_env_checker=True, **_gym_arguments(as_data(environment)))
    seen = []
    for episode in episodes:
        rows = [parts(observation) for observation in episode.observations]
        seen.append(whole({name: np.stack([row[name] for row in rows]) for name in rows[0]}))
    kind: np.dtype[Any] = np.result_type(*(episode.actions for episode in episodes))
    actions = env.action_space
    if kind != actions.dtype and isinstance(actions, gymnasium.spaces.Box):
        low, high = actions.low.astype(kind), actions.high.astype(kind)
        actions = gymnasium.spaces.Box(low, high, dtype=kind.type)
    names = sorted(set.intersection(*({*episode.infos} for episode in episodes)))
    buffers = []
    for number, (episode, observations) in enumerate(zip(episodes, seen, strict=True)):
        infos: dict[str, Any] = {name: episode.infos[name].tolist() for name in names}
        if episode.labels is not None:  # an info has a row for the last instant, too
            infos["label"] = np.concatenate([episode.labels, episode.labels[-1:]])
        buffers.append(
            buffer(
                id=number,
                seed=episode.seed,
                options={"episode": episode.number},
                observations=observations,
                actions=episode.actions.astype(actions.dtype),
                rewards=episode.rewards.tolist(),
                terminations=episode.terminations.tolist(),
                truncations=episode.truncations.tolist(),
                infos=infos,
            )
        )
    given = {
        "env": env,
        "eval_env": env,
        "observation_space": _space(env.observation_space, seen[0]),
        "action_space": actions,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        **about,
    }
    try:
        return minari.create_dataset_from_buffers(dataset_id, buffers, **given)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        env.close()


def _gym_arguments(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments with which Gymnasium makes an environment again, its ``id`` included."""
    name = made_with["task"]
    for id_, task in IDS.items():
        if task == name:
            return {"id": id_, **made_with}
    rest = {key: value for key, value in made_with.items() if key != "task"}
    options = made_with.get("task_options") or {}
    return {"id": MODEL_ID, **rest, "model": name, "task_options": options}


def _space(space: gymnasium.Space[Any], seen: Any) -> gymnasium.Space[Any]:
    """Return the space of the environment, or of its structure after interventions at the reset."""
    if isinstance(space, gymnasium.spaces.Dict):
        return gymnasium.spaces.Dict({name: _space(space[name], seen[name]) for name in space})
    if space.shape == seen.shape[1:]:
        return space
    return gymnasium.spaces.Box(-np.inf, np.inf, seen.shape[1:], seen.dtype)
