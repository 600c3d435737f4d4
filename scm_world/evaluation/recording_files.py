"""Recorded episodes, their Parquet files, and their export to Minari.

A Parquet file has a row for each instant. The last instant of an episode has an observation and a
state, but no action and no reward. All else that a replay needs is a header: JSON in the metadata
of the file. All numbers keep their bits. Minari gets observations, actions, rewards and infos.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.output.reading import read_table
from scm_world.queries.plans import Plan
from scm_world.tasks import Task, tasks
from scm_world.tasks.factories import load_factory
from scm_world.variables import Draw, Subset
from scm_world.variables.kinds import SPACES

FORMAT = "scm_world/recording/2"
KEY = "scm_world"
ONLY = ""
"""Name of an observation that has no parts."""

_KEYS = {"environment", "fingerprint", "versions", "policy", "episodes"}
_ADVICE = "give one that a Recording was saved to"
_STEPS = {"reward": "rewards", "terminated": "terminations", "truncated": "truncations"}
_TYPES = {"rewards": "f8", "states": "i8", "terminations": "?", "truncations": "?"}


@final
@dataclass(frozen=True)
class Recorded:
    """An episode of T control steps. An instant is observed after its interventions.

    Attributes:
        environment: Arguments of the environment.
        seed: Of the noise.
        number: Of the episode within the noise.
        interventions: Each with its control step, in their order.
        observations: Of the T + 1 instants.
        actions: Shape (T, n_actions), as the environment was given them.
        rewards: Shape (T,).
        terminations: Whether each step ended the episode, shape (T,).
        truncations: Whether each step ended it for lack of time, shape (T,).
        infos: Entries of ``info`` by name, each of shape (T + 1,).
        states: A digest of the true state of each instant, shape (T + 1,).
        labels: What a teacher would have done at each step, in the units of actions, shape
            (T, n_actions); None where nobody was asked.
    """

    environment: Mapping[str, Any] = field(repr=False)
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
        """Tell whether two episodes are the same, bit for bit."""
        return (
            isinstance(other, Recorded)
            and self.interventions == other.interventions
            and self._digest().digest() == other._digest().digest()
        )

    def __hash__(self) -> int:
        return hash((self.seed, self.number, len(self)))

    def plans(self) -> list[list[Any]]:
        """Return the interventions as plain data.

        Raises:
            ModelError: A mechanism is a function without a name.
        """
        return [[step, plan.as_dict()] for step, plan in self.interventions]

    def sha256(self) -> str:
        """Return a digest of the episode and its interventions; errors as in ``plans``."""
        found = self._digest()
        found.update(json.dumps(self.plans()).encode())
        return found.hexdigest()

    def _digest(self) -> hashlib._Hash:
        known = [self.seed, self.number, sorted(self.infos)]
        found = hashlib.sha256(json.dumps(known).encode())
        for observation in self.observations:
            for name, part in parts(observation).items():
                found.update(f"{name} {part.dtype.str} {part.shape}".encode() + part.tobytes())
        found.update(np.asarray(self.actions, dtype=np.float64).tobytes())
        for array in (self.rewards, self.terminations, self.truncations, self.states):
            found.update(array.tobytes())
        for name in sorted(self.infos):
            found.update(self.infos[name].tobytes())
        if self.labels is not None:
            found.update(self.labels.tobytes())
        return found


def parts(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return the arrays of an observation by name, in the order of their names.

    Example:
        >>> parts({"b": np.zeros(1), "a": np.ones(1)})
        {'a': array([1.]), 'b': array([0.])}
    """
    if isinstance(observation, dict):
        return {name: observation[name] for name in sorted(observation)}
    return {ONLY: observation}


def _whole(arrays: Mapping[str, NDArray[Any]]) -> Observation:
    return arrays[ONLY] if ONLY in arrays else dict(arrays)


# --- the header -------------------------------------------------------------------------------


def header_of(
    environment: Mapping[str, Any],
    versions: Mapping[str, str],
    policy: Mapping[str, Any] | None,
    episodes: Sequence[Recorded],
    fingerprint: Mapping[str, str],
) -> str:
    """Return everything of a recording but its numbers, as JSON.

    Raises:
        ModelError: Something is no plain data: an argument of the environment, or a function.
    """
    header = {
        "format": FORMAT,
        "environment": as_data(environment),
        "fingerprint": dict(fingerprint),
        "versions": dict(versions),
        "policy": None if policy is None else dict(policy),
        "episodes": [
            {
                "seed": episode.seed,
                "number": episode.number,
                "interventions": episode.plans(),
                "sha256": episode.sha256(),
            }
            for episode in episodes
        ],
    }
    try:
        return json.dumps({**header, "checksum": _checksum(header)}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelError([f"what the policy is cannot be written: {error}"]) from None


def _checksum(header: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(header, sort_keys=True).encode()).hexdigest()


def _header(text: str | bytes | None, path: str) -> dict[str, Any]:
    """Read a header.

    Raises:
        UnreadableFile: It is something else, or damaged.
    """
    try:
        header = json.loads(text or "")
    except ValueError:
        header = None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise UnreadableFile(path, "it is no recording", _ADVICE)
    if header.pop("checksum", None) != _checksum(header) or not header.keys() >= _KEYS:
        raise UnreadableFile(path, "its header is not what was written", _ADVICE)
    return header


def _episode(
    header: Mapping[str, Any], place: int, numbers: Any, path: str, trusted: Sequence[str]
) -> Recorded:
    """Put an episode together.

    Args:
        header: Of the recording.
        place: Of the episode in it.
        numbers: Called for the arrays; an error says that they are damaged.
        path: Of the file, for messages.
        trusted: Packages whose functions may be mechanisms.

    Raises:
        UnreadableFile: The numbers are not those that were written.
        ModelError: A mechanism is a function of no trusted package.
    """
    known = header["episodes"][place]
    plans = tuple(
        (int(step), Plan.from_dict(plan, trusted=trusted)) for step, plan in known["interventions"]
    )
    try:
        arrays = numbers()
        arrays |= {name: np.asarray(arrays[name], dtype=kind) for name, kind in _TYPES.items()}
        found = Recorded(header["environment"], known["seed"], known["number"], plans, **arrays)
        is_whole = found.sha256() == known["sha256"]
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise UnreadableFile(path, f"its episode {place} is damaged ({error})", _ADVICE) from None
    if not is_whole:
        raise UnreadableFile(path, f"its episode {place} is not what was written", _ADVICE)
    return found


def as_data(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an environment as plain data.

    Raises:
        ModelError: Some cannot be written; all of them are named.
    """
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
    raise TypeError(f"{value!r} is no plain data")


def _reference(task: Task) -> str:
    """Return the text from which a task can be made again, with its arguments.

    Raises:
        ModelError: There is none: its class can only be found in the program that runs.
    """
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


# --- Parquet ----------------------------------------------------------------------------------


def to_parquet(header: str, episodes: Sequence[Recorded]) -> bytes:
    """Return the content of a Parquet file; the same bytes every time.

    Raises:
        ModelError: There is no episode, or some have other parts of the observation than others.
    """
    import pyarrow as arrow
    from pyarrow import parquet

    if len({tuple(parts(episode.observations[0])) for episode in episodes}) != 1:
        raise ModelError(["a recording to save has episodes of one environment, and one at least"])
    counts = [len(episode) + 1 for episode in episodes]
    shapes: dict[str, list[int]] = {}
    columns: dict[str, Any] = {
        "episode": np.repeat(np.arange(len(episodes)), counts),
        "step": np.concatenate([np.arange(count) for count in counts]),
    }
    for name, first in parts(episodes[0].observations[0]).items():
        rows = [parts(seen)[name].reshape(-1) for one in episodes for seen in one.observations]
        shapes[name] = list(first.shape[1:])
        columns[_column(name)] = _lists(arrow, rows, first.dtype)
    kind = np.result_type(*(episode.actions for episode in episodes))
    actions = [row for episode in episodes for row in (*episode.actions.astype(kind), None)]
    columns["action"] = _lists(arrow, actions, kind)
    labels = [one.labels for one in episodes if one.labels is not None]
    if len(labels) == len(episodes):
        rows = [row for one in labels for row in (*one, None)]
        columns["label"] = _lists(arrow, rows, labels[0].dtype)
    for column, name in _STEPS.items():
        rows = [row for one in episodes for row in (*getattr(one, name).tolist(), None)]
        columns[column] = arrow.array(rows)
    for name in sorted({name for episode in episodes for name in episode.infos}):
        pairs = zip(episodes, counts, strict=True)
        known = [one.infos[name].tolist() if name in one.infos else [None] * n for one, n in pairs]
        columns[f"info.{name}"] = arrow.array([value for values in known for value in values])
    columns["state"] = np.concatenate([episode.states for episode in episodes])
    about = {KEY: header, f"{KEY}_shapes": json.dumps(shapes)}
    sink = arrow.BufferOutputStream()
    table = arrow.table(columns).replace_schema_metadata(about)
    parquet.write_table(table, sink, compression="zstd", use_dictionary=False)
    return bytes(sink.getvalue())


def from_parquet(
    data: bytes, path: str, trusted: Sequence[str]
) -> tuple[dict[str, Any], list[Recorded]]:
    """Read the header and the episodes of a Parquet file.

    Raises:
        UnreadableFile: It is something else, or damaged.
        ModelError: A mechanism is a function of no trusted package.
    """
    try:
        table = read_table(data).combine_chunks()
    except ValueError as error:
        raise UnreadableFile(path, str(error), _ADVICE) from None
    about = table.schema.metadata or {}
    header = _header(about.get(KEY.encode()), path)
    try:
        shapes = json.loads(about[f"{KEY}_shapes".encode()])
        numbers, steps = (table[name].to_numpy() for name in ("episode", "step"))
    except (KeyError, ValueError):
        raise UnreadableFile(path, "it has other columns", _ADVICE) from None
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    counts = np.diff([*starts, len(numbers)])
    if sorted(set(numbers.tolist())) != [*range(len(header["episodes"]))]:
        raise UnreadableFile(path, "it has other episodes than it says", _ADVICE)
    if not np.array_equal(steps, [step for count in counts for step in range(count)]):
        raise UnreadableFile(path, "its rows are in another order", _ADVICE)

    def read(rows: Any) -> dict[str, Any]:
        seen = {
            name: [_array(row, -1, *shape) if shape else row for row in _rows(rows[_column(name)])]
            for name, shape in shapes.items()
        }
        at_steps = rows.slice(0, rows.num_rows - 1)
        infos = [name for name in rows.column_names if name.startswith("info.")]
        return {
            "observations": tuple(
                _whole({name: arrays[at] for name, arrays in seen.items()})
                for at in range(rows.num_rows)
            ),
            "actions": np.array(_rows(at_steps["action"])),
            **{name: at_steps[column].to_numpy() for column, name in _STEPS.items()},
            "infos": {
                name.removeprefix("info."): rows[name].to_numpy()
                for name in infos
                if rows[name].null_count == 0
            },
            "states": rows["state"].to_numpy(),
            "labels": np.array(_rows(at_steps["label"])) if "label" in rows.column_names else None,
        }

    episodes = []
    for place, (start, count) in enumerate(zip(starts, counts, strict=True)):
        rows = table.slice(start, count)
        episodes.append(_episode(header, place, lambda rows=rows: read(rows), path, trusted))
    return header, episodes


def _column(name: str) -> str:
    return "observation" if name == ONLY else f"observation.{name}"


def _lists(arrow: Any, rows: Sequence[NDArray[Any] | None], kind: np.dtype[Any]) -> Any:
    return arrow.array(rows, arrow.large_list(arrow.from_numpy_dtype(kind)))


def _rows(column: Any) -> list[NDArray[Any]]:
    return list(column.to_numpy(zero_copy_only=False)) if column.num_chunks else []


def _array(row: NDArray[Any], *shape: int) -> NDArray[Any]:
    return row.reshape(shape)


# --- Minari -----------------------------------------------------------------------------------


def to_minari(episodes: Sequence[Recorded], dataset_id: str, **about: Any) -> Any:
    """Write a dataset of Minari; see ``Recording.to_minari``."""
    minari = load("minari", "minari", "data")
    local = load("minari.storage.local", "minari", "data")
    folder = Path(local.get_dataset_path(str(dataset_id)))
    if folder.exists():
        allowed = f"one that is not taken: minari.delete_dataset({dataset_id!r}) removes this one"
        raise UnknownOption("id of a dataset", dataset_id, (allowed,))
    buffer = load("minari.data_collector.episode_buffer", "minari", "data").EpisodeBuffer
    arguments = _gym_arguments(as_data(episodes[0].environment))
    env: Any = gymnasium.make(disable_env_checker=True, **arguments)
    shapes = {
        tuple((name, part.shape) for name, part in parts(observation).items())
        for episode in episodes
        for observation in episode.observations
    }
    if len(shapes) != 1:
        raise ModelError([f"a dataset of Minari has observations of one shape, got {len(shapes)}"])
    seen = []
    for episode in episodes:
        rows = [parts(observation) for observation in episode.observations]
        seen.append(_whole({name: np.stack([row[name] for row in rows]) for name in rows[0]}))
    kind: np.dtype[Any] = np.result_type(*(episode.actions for episode in episodes))
    actions = env.action_space
    if kind != actions.dtype and isinstance(actions, gymnasium.spaces.Box):
        low, high = actions.low.astype(kind), actions.high.astype(kind)
        actions = gymnasium.spaces.Box(low, high, dtype=kind.type)
    given = {
        "env": env,
        "eval_env": env,
        "observation_space": _space(env.observation_space, seen[0]),
        "action_space": actions,
        "data_format": "hdf5",
        "jpeg_encoding": False,
        **about,
    }
    names = sorted(set.intersection(*({*episode.infos} for episode in episodes)))
    buffers = [
        buffer(
            id=number,
            seed=episode.seed,
            options={"episode": episode.number},
            observations=observations,
            actions=episode.actions.astype(actions.dtype),
            rewards=episode.rewards.tolist(),
            terminations=episode.terminations.tolist(),
            truncations=episode.truncations.tolist(),
            infos={name: episode.infos[name].tolist() for name in names} | _labelled(episode),
        )
        for number, (episode, observations) in enumerate(zip(episodes, seen, strict=True))
    ]
    library = "h5py" if given["data_format"] == "hdf5" else "pyarrow"
    load(library, library, "minari")
    try:
        return minari.create_dataset_from_buffers(dataset_id, buffers, **given)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        env.close()


def _labelled(episode: Recorded) -> dict[str, Any]:
    """Give the labels of an episode as an info, which has a row for the last instant, too."""
    if episode.labels is None:
        return {}
    return {"label": np.concatenate([episode.labels, episode.labels[-1:]])}


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
