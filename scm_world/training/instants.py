"""An instant of a training: everything of an algorithm that decides how it goes on, as arrays."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import UnreadableFile
from scm_world.training.learners import torch
from scm_world.training.memory import Memory
from scm_world.training.worlds import Worlds

Tensors = dict[str, NDArray[Any]]
State = dict[str, Any]

COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")
"""What algorithms count."""

NETWORK, OPTIMIZER, RANDOM, RUNNING = "network", "optimizer", "random", "running"
SCALE, MEMORY = "scale", "memory"


def taken(model: Any, worlds: Worlds, memory: Memory | None) -> tuple[Tensors, State]:
    """Take an instant between two rounds.

    Args:
        model: Of Stable-Baselines3.
        worlds: In which it learns.
        memory: Its replay buffer, if it has one.

    Returns:
        Arrays by name, and plain data.
    """
    tensors: Tensors = {}
    for name, tensor in _parameters(model).items():
        tensors[f"{NETWORK}/{name}"] = _numbers(tensor)
    for which, optimizer in _optimizers(model).items():
        for number, entries in optimizer.state_dict()["state"].items():
            for name, value in entries.items():
                tensors[f"{OPTIMIZER}/{which}/{number}/{name}"] = _numbers(value)
    arrays, running = worlds.episodes.state()
    tensors |= {f"{RUNNING}/{name}": array for name, array in arrays.items()}
    tensors[f"{RUNNING}/starts"] = np.asarray(model._last_episode_starts, bool).view(np.uint8)
    if worlds.scaled is not None:
        tensors |= {f"{SCALE}/{name}": array for name, array in worlds.scaled.state().items()}
    generators, state = _randomness(model)
    tensors |= {f"{RANDOM}/{name}": array for name, array in generators.items()}
    state["counters"] = {name: getattr(model, name) for name in COUNTERS}
    state["rate"] = model.learning_rate.now
    state["running"] = running
    if memory is not None:
        arrays, state["memory"] = memory.write()
        tensors |= {f"{MEMORY}/{name}": array for name, array in arrays.items()}
    return tensors, state


def resumed(
    model: Any,
    worlds: Worlds,
    memory: Memory | None,
    tensors: Mapping[str, Any],
    state: Mapping[str, Any],
) -> None:
    """Take a model and worlds to an instant, bit for bit.

    Raises:
        UnreadableFile: It is one of another network or of other worlds.
    """
    try:
        _fill_networks(model, tensors)
        for which, optimizer in _optimizers(model).items():
            _fill_optimizer(optimizer, f"{OPTIMIZER}/{which}/", tensors)
        arrays = _part(tensors, RUNNING)
        starts = arrays.pop("starts").astype(bool)
        if worlds.scaled is not None:
            worlds.scaled.resume(_part(tensors, SCALE))
        model._last_obs = worlds.episodes.resume(arrays, state["running"])
        model._last_episode_starts = starts
        for name in COUNTERS:
            setattr(model, name, state["counters"][name])
        model.learning_rate.now = state["rate"]
        if memory is not None:
            memory.resume(_part(tensors, MEMORY), state["memory"])
        _set_randomness(model, _part(tensors, RANDOM), state)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        if isinstance(error, UnreadableFile):
            raise
        reason = f"it is of another training ({error!r})"
        raise UnreadableFile("the checkpoint", reason, "begin in another folder") from None


def _parameters(model: Any) -> dict[str, Any]:
    found: dict[str, Any] = dict(model.policy.state_dict())
    if getattr(model, "log_ent_coef", None) is not None:
        found["log_ent_coef"] = model.log_ent_coef
    return found


def _fill_networks(model: Any, tensors: Mapping[str, Any]) -> None:
    wanted, given = _parameters(model), _part(tensors, NETWORK)
    if wanted.keys() != given.keys():
        raise ValueError(f"its tensors are {sorted(given)}")
    with torch().no_grad():
        for name, tensor in wanted.items():
            if tuple(tensor.shape) != given[name].shape:
                raise ValueError(f"{name} has the shape {given[name].shape}")
            tensor.copy_(torch().from_numpy(given[name].copy()))


def _optimizers(model: Any) -> dict[str, Any]:
    owners = {"policy": model.policy, **{n: getattr(model, n, None) for n in ("actor", "critic")}}
    found = {
        name: owner.optimizer
        for name, owner in owners.items()
        if getattr(owner, "optimizer", None) is not None
    }
    if getattr(model, "ent_coef_optimizer", None) is not None:
        found["entropy"] = model.ent_coef_optimizer
    return found


def _fill_optimizer(optimizer: Any, prefix: str, tensors: Mapping[str, Any]) -> None:
    kept: dict[int, dict[str, Any]] = {}
    for name, array in tensors.items():
        if name.startswith(prefix):
            number, entry = name.removeprefix(prefix).split("/")
            kept.setdefault(int(number), {})[entry] = torch().from_numpy(array.copy())
    optimizer.load_state_dict({**optimizer.state_dict(), "state": kept})


def _randomness(model: Any) -> tuple[Tensors, State]:
    """Take the generators that Stable-Baselines3 draws from."""
    kind, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)  # noqa: NPY002
    version, words, next_gauss = random.getstate()
    tensors: Tensors = {
        "torch": torch().get_rng_state().numpy(),
        "numpy": np.asarray(keys, np.uint32),
        "python": np.array(words, np.uint64),
    }
    if torch().cuda.is_available():
        tensors["cuda"] = torch().cuda.get_rng_state().numpy()
    numpy = [str(kind), int(position), int(has_gauss), float(gauss)]
    actions = model.action_space.np_random.bit_generator.state
    return tensors, {"numpy": numpy, "python": [version, next_gauss], "actions": actions}


def _set_randomness(model: Any, tensors: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    kind, position, has_gauss, gauss = state["numpy"]
    version, next_gauss = state["python"]
    torch().set_rng_state(torch().from_numpy(tensors["torch"].copy()))
    if "cuda" in tensors and torch().cuda.is_available():
        torch().cuda.set_rng_state(torch().from_numpy(tensors["cuda"].copy()))
    np.random.set_state((kind, tensors["numpy"], position, has_gauss, gauss))  # noqa: NPY002
    random.setstate((version, tuple(map(int, tensors["python"])), next_gauss))
    model.action_space.np_random.bit_generator.state = state["actions"]


def _part(tensors: Mapping[str, Any], prefix: str) -> Tensors:
    start = f"{prefix}/"
    return {k.removeprefix(start): v for k, v in tensors.items() if k.startswith(start)}


def _numbers(tensor: Any) -> NDArray[Any]:
    found: NDArray[Any] = tensor.detach().cpu().numpy().copy()
    return found
