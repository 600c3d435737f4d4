"""Recordings: episodes of an environment with everything that a bit-exact replay needs.

A recording has a file of its own: Minari's format has neither interventions nor digests of true
states, holds observations of one shape only, and needs an extra. A Parquet file has a row for each
instant. The last instant of an episode has an observation and a state, but no action and no reward.
The rest is a header: JSON in the metadata of the file. All numbers keep their bits.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from scm_world._arguments import load, one_of, real_number, typed, whole_number
from scm_world._fingerprint import differing, fingerprint
from scm_world._patterns import as_names
from scm_world._types import Floats, Integers, Observation
from scm_world.env import ENV_OPTIONS, IDS, MODEL_ID, ScmWorldEnv
from scm_world.env.arguments import asked
from scm_world.env.environment import unwrapped_env
from scm_world.errors import (
    InterventionError,
    ModelError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
    UnreadableFile,
    in_one_line,
)
from scm_world.evaluation.episodes import Hook, play
from scm_world.policies.agents import Actions, Agent, as_agent
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan
from scm_world.runs.files import Location, located, read_bytes, write_whole
from scm_world.tasks import AnySource, Task, tasks
from scm_world.tasks.sources import load_named, refuse_untrusted
from scm_world.variables import Draw, Subset

if TYPE_CHECKING:
    import pyarrow as arrow

FORMAT = "scm_world/recording/2"
KEY = "scm_world"
ONLY = ""
"""Name of an observation that has no parts."""

INFOS = ("success", "fractional_success")
TEACHER = "teacher"

_STEPS = {"reward": "rewards", "terminated": "terminations", "truncated": "truncations"}

UNUSED: Mapping[str, Any] = dict.fromkeys(
    ("start", "random_goal", "variables_space", "render_mode", "render_camera", "render_size")
)
"""Arguments of an environment that repeats recorded interventions, and makes none itself."""

_CHANGING = (gymnasium.ActionWrapper, gymnasium.ObservationWrapper, gymnasium.RewardWrapper)


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
            (T, n_actions); None without a teacher.
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
        return isinstance(other, Recorded) and _same(self, other)

    def __hash__(self) -> int:
        return hash((self.seed, self.number, len(self)))


def _same(one: Recorded | Recording, other: Recorded | Recording) -> bool:
    names = [field.name for field in fields(one) if field.compare]
    return all(_equal(getattr(one, name), getattr(other, name)) for name in names)


def _equal(one: object, other: object) -> bool:
    """Compare values that may hold arrays, bit for bit; actions of any floats by their numbers.

    Lists and tuples are alike, as a file has one kind of them.
    """
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        kind: np.dtype[Any] = np.result_type(one, other)
        first, second = (array.astype(kind).tobytes() for array in (one, other))
        return one.shape == other.shape and first == second
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_equal(one[name], other[name]) for name in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return type(one) is type(other) and bool(one == other)


def parts(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return the arrays of an observation by name, in the order of their names."""
    if isinstance(observation, dict):
        return {name: observation[name] for name in sorted(observation)}
    return {ONLY: observation}


def whole(arrays: Mapping[str, Any]) -> Any:
    """Return the observation that has such parts."""
    return arrays[ONLY] if ONLY in arrays else dict(arrays)


@final
@dataclass(frozen=True)
class Recording:
    """Episodes of one environment, with everything that a bit-exact replay needs.

    Attributes:
        environment: Arguments of the environment.
        episodes: The recorded episodes.
        versions: Versions of Python, the packages and the backend.
        policy: Description of the policy, if known.
        fingerprint: Hashes of the parts of the system; a replay compares them, if there are any.
        trusted: Packages whose functions may be called to make the environment again; any if the
            recording was made in this process.
    """

    environment: Mapping[str, Any]
    episodes: tuple[Recorded, ...]
    versions: Mapping[str, str] = field(default_factory=dict)
    policy: Mapping[str, Any] | None = None
    fingerprint: Mapping[str, str] = field(default_factory=dict)
    trusted: Sequence[str] | None = field(default=None, compare=False, repr=False)

    def __eq__(self, other: object) -> bool:
        """Return whether two recordings are the same, bit for bit."""
        return isinstance(other, Recording) and _same(self, other)

    __hash__ = None  # type: ignore[assignment] # its parts have none

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.episodes)

    def __getitem__(self, number: int) -> Recorded:
        try:
            return self.episodes[number]
        except (TypeError, IndexError):
            allowed = (f"a number up to {len(self) - 1}",)
            raise UnknownOption("number of an episode", number, allowed) from None

    def __iter__(self) -> Iterator[Recorded]:
        return iter(self.episodes)

    def __repr__(self) -> str:
        steps = sum(map(len, self.episodes))
        counts = (len(self), "episode"), (steps, "control step")
        words = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in counts)
        return f"Recording of {words}, of {_name(self.environment)}"

    def pairs(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return observations and the right actions there, for behavior cloning.

        Returns:
            Observations, shape (n, k), and actions, shape (n, m), of all control steps: the labels
            where a teacher was asked, else the actions that followed. The parts of a dictionary
            observation follow one another in the order of their names.

        Raises:
            ModelError: The observations have several lengths, as the structure changed.
        """
        rows = [
            np.concatenate([part.reshape(-1) for part in parts(seen).values()])
            for episode in self.episodes
            for seen in episode.observations[: len(episode)]
        ]
        lengths = sorted({len(row) for row in rows})
        if len(lengths) != 1:
            raise ModelError([f"pairs need observations of one length, got the lengths {lengths}"])
        actions = np.concatenate(
            [one.actions if one.labels is None else one.labels for one in self.episodes]
        )
        return np.array(rows, dtype=np.float32), actions.astype(np.float32)

    def replay(self, which: int | None = None, *, task: AnySource | None = None) -> int:
        """Repeat actions and interventions; compare observations, rewards and true states.

        Args:
            which: Number of the episode; all if None.
            task: In place of the task of the recording, if that is not registered, or the text
                that names it, to run its code.

        Returns:
            How many control steps were repeated, bit for bit.

        Raises:
            SnapshotMismatch: Something differs; it says from which control step on.
            InexactEngine: Equal runs differ on the engine.
            UnknownOption: The task is not registered, or a function of no trusted package.
        """
        if task is None:
            refuse_untrusted(_name(self.environment), self.trusted)
        arguments = {**self.environment, **UNUSED}
        unknown = arguments.keys() - {*ENV_OPTIONS}
        if unknown:
            raise SnapshotMismatch(
                "the recording is one of another version: environments have no option "
                f"{min(unknown)!r}"
            )
        if task is not None:
            arguments["task"] = task
        if isinstance(task, Task):
            arguments["task_options"] = None
        if which is not None:
            self[which]  # refuses a number that there is not
        numbers = range(len(self)) if which is None else (range(len(self))[which],)
        with closing(ScmWorldEnv(**arguments)) as env:
            env.world.require_exact("a replay of a recording")
            now = fingerprint(env.world.structures, libraries=False)
            changed = differing(self.fingerprint, now) if self.fingerprint else ()
            if changed:
                what = f"{', '.join(changed)} of the system differ"
                raise SnapshotMismatch(f"the recording is one of another system: {what}")
            for number in numbers:
                for difference in _differences(env, self.episodes[number]):
                    made = ", ".join(f"{name} {v}" for name, v in self.versions.items())
                    raise SnapshotMismatch(
                        f"episode {number} differs from {difference}; the recording was "
                        f"made with {made or 'unknown versions'}"
                    )
        return sum(len(self.episodes[number]) for number in numbers)

    def save(self, path: Location | str) -> Location:
        """Write a Parquet file, whole or not at all: one row for each instant.

        Args:
            path: The file; it gets the ending ``.parquet`` if it has another one.

        Raises:
            ModelError: Something cannot be written: a function without a name, say.
            UnwritableFolder: The disk is full, or permission is missing.
        """
        import pyarrow as arrow
        from pyarrow import parquet

        target, episodes = located(path), self.episodes
        if target.suffix != ".parquet":
            target = target.with_name(target.name + ".parquet")
        if len({tuple(parts(episode.observations[0])) for episode in episodes}) != 1:
            problem = "a recording to save has episodes of one environment, and one at least"
            raise ModelError([problem])
        environment = as_data(self.environment)

        def lists(rows: Sequence[Any], kind: np.dtype[Any]) -> Any:
            return arrow.array(rows, arrow.large_list(arrow.from_numpy_dtype(kind)))

        def steps(rows: Iterator[Any]) -> list[Any]:
            """Add the last instant of each episode, which has no such value."""
            return [row for one in rows for row in (*one, None)]

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
        kind = np.result_type(*(one.actions for one in episodes))
        columns["action"] = lists(steps(one.actions.astype(kind) for one in episodes), kind)
        labels = [one.labels for one in episodes if one.labels is not None]
        if len(labels) == len(episodes):
            columns["label"] = lists(steps(iter(labels)), labels[0].dtype)
        for column, name in _STEPS.items():
            columns[column] = arrow.array(steps(getattr(one, name).tolist() for one in episodes))
        for name in sorted({name for episode in episodes for name in episode.infos}):
            pairs = zip(episodes, counts, strict=True)
            known = [one.infos.get(name, np.full(n, None)).tolist() for one, n in pairs]
            columns[f"info.{name}"] = arrow.array([value for values in known for value in values])
        columns["state"] = np.concatenate([episode.states for episode in episodes])
        header = {
            "format": FORMAT,
            "environment": environment,
            "fingerprint": dict(self.fingerprint),
            "versions": dict(self.versions),
            "policy": None if self.policy is None else dict(self.policy),
            "shapes": shapes,
            "episodes": [
                {
                    "seed": one.seed,
                    "number": one.number,
                    "interventions": [[step, plan.as_dict()] for step, plan in one.interventions],
                }
                for one in episodes
            ],
        }
        try:
            text = json.dumps(header, allow_nan=False)
        except (TypeError, ValueError) as error:
            problem = f"the description of the policy cannot be written: {error}"
            raise ModelError([problem]) from None
        sink = arrow.BufferOutputStream()
        table = arrow.table(columns).replace_schema_metadata({KEY: text})
        parquet.write_table(table, sink, compression="zstd", use_dictionary=False)
        write_whole(target, bytes(sink.getvalue()))
        return target

    @classmethod
    def load(cls, path: Location | str, *, trusted: Sequence[str] = ()) -> Recording:
        """Read a file of ``save``.

        Args:
            path: The file.
            trusted: Packages other than this one whose functions may be mechanisms.

        Raises:
            UnreadableFile: It is not a recording, or damaged.
            ModelError: A mechanism is a function of no trusted package.
        """
        import pyarrow as arrow
        from pyarrow import parquet

        try:
            table = parquet.ParquetFile(arrow.BufferReader(read_bytes(path))).read()
            header = json.loads((table.schema.metadata or {}).get(KEY.encode(), "{}"))
            if header.get("format") != FORMAT:
                raise ValueError("it is not a recording")
            table = table.combine_chunks()
            starts = np.flatnonzero(np.diff(table["episode"].to_numpy(), prepend=-1))
            counts = np.diff([*starts, table.num_rows])
            episodes = tuple(
                _episode(known, table.slice(start, count), header["shapes"], trusted)
                for known, start, count in zip(header["episodes"], starts, counts, strict=True)
            )
            about = header["environment"], episodes, header["versions"], header["policy"]
            return cls(*about, header["fingerprint"], tuple(trusted))
        except ModelError:
            raise
        except Exception as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else in_one_line(error)
            advice = "give one that a Recording was saved to"
            raise UnreadableFile(str(path), reason, advice) from None

    def to_minari(self, dataset_id: str, **about: object) -> Any:
        """Write a dataset of Minari; its ``recover_environment`` returns the environment.

        Its actions are those that were played, so that every transition is one; the labels of a
        teacher are ``infos["label"]``, of which the last row is there twice. Only the file of
        ``save`` has everything that a bit-exact replay needs.

        Args:
            dataset_id: Such as ``"scm_world/pushing/sweep-v0"``.
            about: Arguments of ``minari.create_dataset_from_buffers``: ``author``,
                ``author_email``, ``code_permalink``, ``algorithm_name``, ``description``,
                ``data_format``, ``ref_min_score``, ``ref_max_score``, ….

        Returns:
            The ``minari.MinariDataset``.

        Raises:
            MissingExtra: Minari is not installed.
            ModelError: Observations have several shapes, the task has no id with Gymnasium, or
                something cannot be written.
            UnknownOption: The task is a function of no trusted package, there is a dataset of this
                name, or the name has no version.
            ValueError: Minari refuses a name or an argument.
        """
        if not re.search(r"[^/]-v\d+$", str(dataset_id)):
            allowed = ("a name with a version, such as scm_world/pushing/sweep-v0",)
            raise UnknownOption("id of a dataset", dataset_id, allowed)
        refuse_untrusted(_name(self.environment), self.trusted)
        minari = load("minari", "minari", "data")
        local = load("minari.storage.local", "minari", "data")
        buffer = load("minari.data_collector.episode_buffer", "minari", "data").EpisodeBuffer
        library = "pyarrow" if about.get("data_format") == "arrow" else "h5py"
        load(library, library, "data")
        folder = Path(local.get_dataset_path(str(dataset_id)))
        if folder.exists():
            remedy = f"minari.delete_dataset({dataset_id!r}) removes this one"
            raise UnknownOption("id of a dataset", dataset_id, (f"a new one; {remedy}",))
        shapes = {
            tuple((name, part.shape) for name, part in parts(observation).items())
            for episode in self.episodes
            for observation in episode.observations
        }
        if len(shapes) != 1:
            problem = f"a dataset of Minari has observations of one shape, got {len(shapes)}"
            raise ModelError([problem])
        made = _gym_arguments(as_data(self.environment))
        env = gymnasium.make(disable_env_checker=True, **made)
        seen = []
        for episode in self.episodes:
            rows = [parts(observation) for observation in episode.observations]
            seen.append(whole({name: np.stack([row[name] for row in rows]) for name in rows[0]}))
        kind: np.dtype[Any] = np.result_type(*(episode.actions for episode in self.episodes))
        actions = env.action_space
        if kind != actions.dtype and isinstance(actions, gymnasium.spaces.Box):
            low, high = actions.low.astype(kind), actions.high.astype(kind)
            actions = gymnasium.spaces.Box(low, high, dtype=kind.type)
        names = sorted(set.intersection(*({*episode.infos} for episode in self.episodes)))
        buffers = []
        for number, (episode, observations) in enumerate(zip(self.episodes, seen, strict=True)):
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
            "algorithm_name": str((self.policy or {}).get("name", "unknown")),
            "description": f"{self!r}, recorded by scm_world.",
            **about,
        }
        try:
            return minari.create_dataset_from_buffers(dataset_id, buffers, **given)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            env.close()


def _name(made_with: Mapping[str, Any]) -> str:
    task = made_with["task"]
    return task.name if isinstance(task, Task) else str(task)


def _differences(env: ScmWorldEnv, episode: Recorded) -> Iterator[str]:
    """Repeat an episode; yield each difference, with its control step."""
    env.reset(seed=episode.seed, options={"episode": episode.number})
    for step in range(len(episode) + 1):
        for at, plan in episode.interventions:
            try:
                if at == step:
                    env.do(plan.at_start())
            except InterventionError as error:
                yield f"control step {step}: an intervention is refused ({error})"
        if _digest(env.world.vector) != episode.states[step]:
            yield f"control step {step}: the true state"
        now, then = parts(env.observe()), parts(episode.observations[step])
        for name in sorted({*now, *then}):
            if not _equal(now.get(name), then.get(name)):
                yield f"control step {step}: the observation{f' {name!r}' if name else ''}"
        if step < len(episode):
            reward, known = env.step(episode.actions[step])[1], episode.rewards[step]
            if not _equal(np.asarray(reward, np.float64), np.asarray(known)):
                yield f"control step {step}: the reward is {reward!r}, not {float(known)!r}"


def _digest(state: Floats) -> int:
    """Return a digest of a true state: a whole number of 64 bits."""
    digest = hashlib.blake2b(state.tobytes(), digest_size=8).digest()
    return int.from_bytes(digest, "little", signed=True)


# --- headers --------------------------------------------------------------------------------------


def as_data(made_with: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an environment as plain data."""
    arguments, problems = dict(made_with), []
    task = arguments["task"]
    if isinstance(task, Task):
        if not task.is_named:
            problems.append(f"give the arguments of {task.name!r} by name")
        arguments |= {"task": _reference(task), "task_options": task.given or None}
    found: dict[str, Any] = {}
    for name, value in arguments.items():
        try:
            found[name] = json.loads(json.dumps(value, allow_nan=False, default=_plain))
        except (TypeError, ValueError) as error:
            problems.append(f"the argument {name!r} of the environment cannot be written: {error}")
    if problems:
        raise ModelError(problems)
    return found


def _plain(value: object) -> Any:
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
        found = None if kind.__module__ == "__main__" else load_named(text, "task")
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


def _episode(
    known: Mapping[str, Any], rows: arrow.Table, shapes: Mapping[str, Any], trusted: Sequence[str]
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


def _rows(column: arrow.ChunkedArray) -> list[NDArray[Any]]:
    return list(column.to_numpy(zero_copy_only=False)) if column.num_chunks else []


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


# --- recording --------------------------------------------------------------------------------


@final
class Recorder(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Records whole episodes of an environment, so that they can be replayed.

    All interventions count: at the reset, by ``env.unwrapped.do``, or by a wrapper above or below.
    An instant is recorded after its interventions, as the next action meets it. An episode without
    any step is left out.

    Args:
        env: An environment of this package. Wrappers that change actions, observations or rewards
            belong above the recorder.
        infos: Names of numbers in ``info`` that are kept; None for success and fractional success,
            if the task has them.

    Raises:
        UnknownOption: The environment is not of this package, or a wrapper changes it.

    Example:
        >>> env = Recorder(gymnasium.make("scm_world/Pushing-v0", backend="fake"))
        >>> _ = env.reset(seed=0, options={"do": {"tool_block.mass": "A"}})
        >>> _ = env.step(np.zeros(9, np.float32))
        >>> _ = env.unwrapped.do({"floor_friction": 0.4})
        >>> env.recording()
        Recording of 1 episode, 1 control step, of pushing
    """

    @typed
    def __init__(
        self, env: gymnasium.Env[Any, Any], infos: Sequence[str] | str | None = None
    ) -> None:
        RecordConstructorArgs.__init__(self, infos=infos)
        super().__init__(env)
        self._inner = unwrapped_env(env, "Recorder")
        _refuse_changes(env, self._inner)
        model = self._inner.world.model
        chosen = tuple(name for name in INFOS if name in model) if infos is None else infos
        self._wanted = as_names(chosen)
        self._made: list[Recorded] = []
        self._steps: list[tuple[Any, ...]] = []  # action, label, reward, terminated, truncated
        self._instants: list[tuple[Observation, dict[str, Any], int]] = []  # the last: the state
        self._label: Actions | None = None
        self._version = -1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the last one is kept.

        Raises:
            UnknownOption: ``info`` has no such name as one that should be kept, or the draws are
                those of another episode.
        """
        self._keep()
        observation, info = self.env.reset(seed=seed, options=options)
        self._write(observation, info)
        return observation, info

    def label(self, action: Actions) -> None:
        """Record the action that a teacher would take in the next control step."""
        self._label = self._inner.actions.read(action)

    def step(self, action: Actions) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            NotReset: No episode has begun.
        """
        if not self._instants:
            raise NotReset
        self._update()
        single = getattr(action, "dtype", None) == np.float32
        taken = np.array(action) if single else self._inner.actions.read(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        ends = float(reward), bool(terminated), bool(truncated)
        self._steps.append((taken, self._label, *ends))
        self._label = None
        self._write(observation, info)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Keep the last episode, and free the backend."""
        self._keep()
        super().close()

    @typed
    def recording(self, policy: Mapping[str, Any] | None = None) -> Recording:
        """Return all episodes so far, the present one included.

        Args:
            policy: Description of the policy.
        """
        present = self._recorded()
        episodes = (*self._made, *([present] if present else []))
        environment, libraries = dict(self._inner.made_with), versions(self._inner.world.engine)
        if environment.get("start"):
            environment["start"] = {
                name: act.source if isinstance(act, Draw) and isinstance(act.source, str) else act
                for name, act in asked(environment["start"]).items()
            }
        system = fingerprint(self._inner.world.structures, libraries=False)
        return Recording(environment, episodes, libraries, policy, system)

    def _write(self, observation: Observation, info: Mapping[str, Any]) -> None:
        """Record an instant."""
        self._info = info
        world = self._inner.world
        self._version, self._did = world.version, self._inner.interventions
        self._place = world.noise.seed, world.episode
        if world.draws is not None:
            allowed = ("None: a replay draws by the number of the episode itself",)
            raise UnknownOption("draws of a recorded episode", world.draws, allowed)
        for name in self._wanted:
            one_of("info", name, info)
        copied: Observation = whole({n: np.array(part) for n, part in parts(observation).items()})
        kept = {name: info[name] for name in self._wanted}
        self._instants.append((copied, kept, _digest(world.vector)))

    def _update(self) -> None:
        """Record the present instant again if there was an intervention since."""
        if self._inner.world.version != self._version:
            observation, info = self._inner.present()
            self._instants.pop()
            self._write(observation, {**self._info, **info})  # wrappers add further infos

    def _keep(self) -> None:
        made = self._recorded()
        if made is not None:
            self._made.append(made)
        self._steps, self._instants = [], []

    def _recorded(self) -> Recorded | None:
        """Return the present episode, if it has a step."""
        if not self._steps:
            return None
        self._update()
        actions, labels, rewards, ends, cuts = zip(*self._steps, strict=True)
        observations, known, states = zip(*self._instants, strict=True)
        infos = {}
        for name in known[0]:
            values = [info[name] for info in known]
            is_logical = all(isinstance(value, bool | np.bool_) for value in values)
            infos[name] = np.array(values, dtype=np.bool_ if is_logical else np.float64)
        has_labels = all(label is not None for label in labels)
        return Recorded(
            seed=self._place[0],
            number=self._place[1],
            interventions=tuple((step, Plan(did)) for step, did in self._did),
            observations=tuple(observations),
            actions=np.array(actions),
            rewards=np.array(rewards, dtype=np.float64),
            terminations=np.array(ends, dtype=np.bool_),
            truncations=np.array(cuts, dtype=np.bool_),
            infos=infos,
            states=np.array(states, dtype=np.int64),
            labels=np.array(labels, dtype=np.float32) if has_labels else None,
        )


CORRELATION = 0.8
"""Of the noise of actions, from a control step to the next one."""


def action_noise(random: np.random.Generator, size: int) -> Iterator[Floats]:
    """Yield correlated noise for actions, shape (size,), with a standard deviation of one."""
    noise = np.zeros(size)
    while True:
        innovation = np.sqrt(1.0 - CORRELATION**2) * random.standard_normal(size)
        noise = CORRELATION * noise + innovation
        yield noise


@typed
def record(
    policy: object,
    env: gymnasium.Env[Any, Any],
    n: int,
    *,
    seed: int = 0,
    first: int = 0,
    do: Mapping[str, Any] | None = None,
    infos: Sequence[str] | str | None = None,
    noise: float = 0.0,
    labels: object = None,
    out: Location | str | None = None,
) -> Recording:
    """Run a policy for some episodes, and record them.

    A learner of demonstrations also needs the actions beside the path of its teacher. With
    ``noise`` and ``labels="teacher"`` the policy is driven off its path, and its action
    there is recorded beside the played one (DART); with a learner as the policy and its teacher
    as ``labels``, that is a round of DAgger. ``Recording.pairs`` gives the labels.

    Args:
        policy: Anything that ``as_agent`` reads.
        env: An environment of this package, perhaps in wrappers that intervene: a curriculum, say.
        n: How many episodes.
        seed: Seed of the noise.
        first: Number of the first episode within the noise.
        do: An intervention at every reset.
        infos: Names in ``info`` that are kept; see ``Recorder``.
        noise: Largest standard deviation of the noise of actions, in their units; each episode
            has one between 0 and that, and it changes slowly (correlation 0.8 between steps).
        labels: The teacher whose action is recorded at every step: ``"teacher"`` for the policy
            itself, or another policy; no labels if None.
        out: Where to save the recording, if anywhere.

    Source:
        Laskey et al., *DART*, CoRL 2017; Ross et al., *DAgger*, AISTATS 2011.

    Raises:
        UnknownOption: A number is not whole, or something else was given as environment or policy.
        ActionError: The policy gave no action.
        InterventionError: ``do`` was refused.

    Example:
        >>> env = gymnasium.make("scm_world/Reaching-v0", backend="fake", max_episode_length=5)
        >>> record("random", env, 2)
        Recording of 2 episodes, 10 control steps, of reaching
    """
    agent, recorder = as_agent(policy), Recorder(env, infos)
    is_own = labels is None or (isinstance(labels, str) and labels == TEACHER)
    teacher = agent if is_own else as_agent(labels)
    n = whole_number("n", n, least=1)
    noise = real_number("noise", noise, least=0.0)
    shown = _Shown(recorder, agent, teacher, noise=noise, has_labels=labels is not None)
    for number in range(n):
        start: dict[str, Any] = {"seed": seed, "episode": first} if number == 0 else {}
        play(recorder, agent, do, [shown], **start)
    found = recorder.recording(agent.about)
    if out is not None:
        found.save(out)
    return found


@final
class _Shown(Hook):
    """Asks a teacher in every control step, and disturbs the action that is played."""

    def __init__(
        self, recorder: Recorder, agent: Agent, teacher: Agent, *, noise: float, has_labels: bool
    ) -> None:
        self.recorder, self.agent, self.teacher = recorder, agent, teacher
        self.noise, self.has_labels = noise, has_labels

    def begin(self, env: ScmWorldEnv, observation: Observation) -> None:
        """Draw how much noise there is in this episode."""
        self.ends = env.actions.ends
        if self.teacher is not self.agent:
            self.teacher.start(env)
        random = np.random.default_rng([env.world.noise.seed, env.world.episode])
        self.scale = self.noise * random.uniform()
        self.noises = action_noise(random, env.world.compiled.n_actions)

    def choose(self, observation: Observation, action: Actions) -> Actions:
        """Record the action of the teacher; add the noise."""
        if self.has_labels:
            same = self.teacher is self.agent
            right = action if same else self.teacher.act(observation)
            self.recorder.label(np.clip(right, *self.ends))
        if self.noise:
            action = np.clip(action + self.scale * next(self.noises), *self.ends)
        return action


def _refuse_changes(env: gymnasium.Env[Any, Any], inside: ScmWorldEnv) -> None:
    """Refuse wrappers below a recorder that change actions, observations or rewards."""
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        same = layer.action_space == inside.action_space
        same = same and layer.observation_space == inside.observation_space
        if isinstance(layer, _CHANGING) or not same:
            name = type(layer).__name__
            allowed = (f"one that changes nothing; record below it: {name}(Recorder(env))",)
            raise UnknownOption("wrapper below a Recorder", name, allowed)
        layer = layer.env
