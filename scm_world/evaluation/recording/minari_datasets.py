"""Recordings as datasets of Minari, and back.

Minari keeps observations, actions, rewards and infos; all that it takes to live through an episode
again stands in the metadata of the dataset, which are written last.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world.errors import ModelError, UnreadableFile
from scm_world.evaluation.recording.environments import as_data, gym_arguments
from scm_world.evaluation.recording.episodes import ONLY, Recorded, parts, whole
from scm_world.evaluation.recording.headers import Header, Numbers
from scm_world.graph.exchange.libraries import load

if TYPE_CHECKING:
    from scm_world.evaluation.recording.recording import Recording

KEY = "scm_world"
STATE = "scm_world_state"
ADVICE = "give a dataset that Recording.to_minari wrote"


def to_dataset(recording: Recording, header: str, dataset_id: str, about: Mapping[str, Any]) -> Any:
    """Write a dataset; see ``Recording.to_minari``."""
    minari = _library()
    made_with = as_data(recording.environment)
    env: Any = gymnasium.make(disable_env_checker=True, **gym_arguments(made_with))
    seen = _stacked_all(recording.episodes)
    name = (recording.policy or {}).get("name", "unknown")
    given = {
        "env": env,
        "eval_env": env,
        "observation_space": _space(env.observation_space, seen[0]),
        "action_space": _actions(env.action_space, recording.episodes),
        "algorithm_name": str(name),
        "description": f"{recording!r}, recorded by scm_world.",
        "data_format": "hdf5",
        "jpeg_encoding": False,
        **about,
    }
    kind = given["action_space"].dtype
    names = set.intersection(*({*episode.infos} for episode in recording.episodes))
    buffers = [
        _buffer(number, episode, observations, kind, sorted(names))
        for number, (episode, observations) in enumerate(zip(recording.episodes, seen, strict=True))
    ]
    engine = "h5py" if given["data_format"] == "hdf5" else "pyarrow"
    load(engine, engine, "minari")
    was_there = _place(dataset_id).exists()
    try:
        made = minari.create_dataset_from_buffers(dataset_id, buffers, **given)
        made.storage.update_metadata({KEY: header})
    except BaseException:
        if not was_there and _place(dataset_id).exists():
            shutil.rmtree(_place(dataset_id))
        raise
    finally:
        env.close()
    return made


def from_dataset(dataset: Any, trusted: Sequence[str]) -> tuple[Header, list[Recorded]]:
    """Read a dataset; see ``Recording.from_minari``."""
    minari = _library()
    if isinstance(dataset, str):
        try:
            dataset = minari.load_dataset(dataset)
        except FileNotFoundError as error:
            raise UnreadableFile(dataset, str(error), ADVICE) from None
    text = dataset.storage.metadata.get(KEY)
    if text is None:
        raise UnreadableFile(str(dataset.id), "it is no recording", ADVICE)
    header = Header.read(text, str(dataset.id), trusted)
    numbers = [int(number) for number in dataset.episode_indices]
    episodes = [
        header.episode(number, partial(_numbers, held))
        for number, held in zip(numbers, dataset.iterate_episodes(), strict=True)
    ]
    return header, episodes


def _library() -> Any:
    load("minari.data_collector.episode_buffer", "minari", "minari")
    return load("minari", "minari", "minari")


def _place(dataset_id: str) -> Path:
    """Say where Minari keeps a dataset."""
    local: Any = load("minari.storage.local", "minari", "minari")
    return Path(local.get_dataset_path(dataset_id))


def _buffer(
    number: int, episode: Recorded, observations: Any, kind: Any, names: Sequence[str]
) -> Any:
    infos = {name: episode.infos[name].tolist() for name in names}
    infos[STATE] = episode.states.tolist()
    made = load("minari.data_collector.episode_buffer", "minari", "minari").EpisodeBuffer
    return made(
        id=number,
        seed=episode.seed,
        options={"episode": episode.number},
        observations=observations,
        actions=episode.actions.astype(kind),
        rewards=episode.rewards.tolist(),
        terminations=episode.terminations.tolist(),
        truncations=episode.truncations.tolist(),
        infos=infos,
    )


def _stacked_all(episodes: Sequence[Recorded]) -> list[Any]:
    """Give the observations of each episode as one array, or as one for each part.

    Raises:
        ModelError: They have several shapes.
    """
    kinds = {
        tuple((name, part.shape) for name, part in parts(seen).items())
        for episode in episodes
        for seen in episode.observations
    }
    if len(kinds) != 1:
        raise ModelError([f"a dataset of Minari has observations of one shape, got {len(kinds)}"])
    return [_stacked(episode) for episode in episodes]


def _stacked(episode: Recorded) -> Any:
    seen = [parts(observation) for observation in episode.observations]
    return whole({name: np.stack([part[name] for part in seen]) for name in seen[0]})


def _space(space: gymnasium.Space[Any], seen: Any) -> gymnasium.Space[Any]:
    """Give the space of the environment, or of its structure after interventions at the reset."""
    if isinstance(space, gymnasium.spaces.Dict):
        return gymnasium.spaces.Dict({name: _space(space[name], seen[name]) for name in space})
    if space.shape == seen.shape[1:]:
        return space
    return gymnasium.spaces.Box(-np.inf, np.inf, seen.shape[1:], seen.dtype)


def _actions(space: gymnasium.Space[Any], episodes: Sequence[Recorded]) -> gymnasium.Space[Any]:
    """Give the space of actions, with the type that they were recorded in."""
    kind: np.dtype[Any] = np.result_type(*(episode.actions for episode in episodes))
    if kind == space.dtype or not isinstance(space, gymnasium.spaces.Box):
        return space
    return gymnasium.spaces.Box(space.low.astype(kind), space.high.astype(kind), dtype=kind.type)


def _numbers(held: Any) -> Numbers:
    """Give the arrays of an episode.

    Raises:
        KeyError: Some are missing.
    """
    infos: dict[str, NDArray[Any]] = {k: np.asarray(v) for k, v in (held.infos or {}).items()}
    states = infos.pop(STATE)
    seen = held.observations if isinstance(held.observations, dict) else {ONLY: held.observations}
    return {
        "observations": tuple(
            whole({name: part[at] for name, part in seen.items()}) for at in range(len(states))
        ),
        "actions": held.actions,
        "rewards": held.rewards,
        "terminations": held.terminations,
        "truncations": held.truncations,
        "infos": infos,
        "states": states,
    }
