"""What a user gives, read as a player; and the player that a results file names, made again."""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from scm_world.errors import ActionError, ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation.policies.given import OpenLoop
from scm_world.evaluation.policies.onnx import ByNetwork
from scm_world.evaluation.policies.players import (
    About,
    ByObservation,
    ByPrediction,
    ByWorld,
    Player,
    WorldPolicy,
)
from scm_world.evaluation.policies.sb2 import load_sb2
from scm_world.evaluation.policies.trained import ByWeights, in_run
from scm_world.evaluation.policies.weights import NetworkPolicy, load_policy
from scm_world.evaluation.zoo.shelf import PREFIX as ZOO
from scm_world.evaluation.zoo.shelf import path_of
from scm_world.queries.episode_files import load_episode
from scm_world.queries.episodes import Episode
from scm_world.queries.policies import NAMED, Policy
from scm_world.tasks.policies import Blind
from scm_world.variables import Function
from scm_world.world import World

PACKAGE = "scm_world"


def itself(policy: Policy) -> Policy:
    """Give a policy that serves for all episodes."""
    return policy


def still(world: World) -> Any:
    """Let the system be, as the task knows it: shape (n_actions,)."""
    return world.task.idle(world)


NAMES: Mapping[str, Callable[[], Policy]] = {"still": partial(itself, still), **NAMED}
"""Policies that have a name; each gives the policy of one episode."""

FORMS = (
    *NAMES,
    "a function of the observation",
    "a WorldPolicy",
    "an object with the method predict",
    "an array of actions",
    "an episode",
    "a file (.safetensors, .onnx, .zip of Stable-Baselines 2, .npz of an episode, .parquet of a "
    "recording)",
    "the folder of a training run",
    "'zoo:name'",
    "'module:function'",
)
_PICKLED = "_stable_baselines3_version"


@runtime_checkable
class Played(Protocol):
    """An episode of an environment whose actions can be played again."""

    @property
    def actions(self) -> Any:
        """Shape (steps, n_actions)."""

    @property
    def action_mode(self) -> str:
        """What the actions mean."""

    @property
    def normalized(self) -> bool:
        """Whether they lie in [-1, 1], or are in SI units."""

    @property
    def relative(self) -> Mapping[str, Any]:
        """Options of the environment that say what relative actions mean."""


def as_player(policy: Any, *, trusted: Sequence[str] | None = None) -> Player:
    """Read a policy.

    Args:
        policy: A function of the observation; an object with ``predict`` as Stable-Baselines3 has
            it; the name of a policy of this package; a ``WorldPolicy``; actions, shape (n,) or
            (steps, n); an episode of ``World.rollout`` or of a recording; the path of a policy
            file, of an ONNX network, an archive of Stable-Baselines 2, a saved episode or a
            recording (``"runs.parquet#3"`` for its fourth episode); the folder of a training run;
            ``"zoo:pushing"``, one that comes with this package; or
            ``"package.module:function"``.
        trusted: Packages whose functions may be named. None: any, as the caller named it.

    Raises:
        UnknownOption: It is none of these.
        ModelError: It names a function that is not there, or of no trusted package.
        UnreadableFile: The file is no policy, or reading it would run code in it.
        ActionError: Actions have another shape, or are not finite.
        MissingExtra: The file needs a library that is not installed.

    Example:
        >>> about = as_player("random").about
        >>> about["kind"], player_from(about).about == about
        ('named', True)
    """
    if isinstance(policy, str | Path):
        return _of_text(str(policy), trusted)
    if isinstance(policy, Player) and not isinstance(policy, type):
        return policy
    if isinstance(policy, Episode):
        return _of_episode(policy, {"kind": "actions", "name": "episode"})
    if isinstance(policy, np.ndarray | list | tuple):
        return OpenLoop(_rows(policy), {"kind": "actions", "name": "actions"})
    if isinstance(policy, Played):
        return _of_recorded(policy, {"kind": "actions", "name": "recorded episode"})
    if callable(policy) or hasattr(policy, "predict"):
        return _of_callable(policy, _who(policy))
    raise UnknownOption("policy", policy, FORMS)


def player_from(about: Mapping[str, Any], *, trusted: Sequence[str] = ()) -> Player:
    """Make the player again that ``Player.about`` describes.

    Args:
        about: What a results file says.
        trusted: Packages whose functions may be named.

    Raises:
        UnknownOption: It was an object in memory; it can only be given.
        UnreadableFile: The file is gone, or it is another one by now.
        ModelError: It is a function of no trusted package.
    """
    kind, name = about.get("kind"), str(about.get("name"))
    advice = "give the policy itself: policy=…"
    if kind == "named" and name in NAMES:
        return as_player(name)
    if kind == "zoo":
        return _as_it_was(path_of(name), about, name, advice)
    if kind == "function":
        found = _function(name, trusted)
        if about.get("sees") == "world" and not isinstance(found, WorldPolicy):
            found = WorldPolicy(found)
        return _of_callable(found, {"kind": kind, "name": name, **_library(name)})
    if kind != "file":
        raise UnknownOption(f"policy to make again from {kind!r}", name, (advice,))
    path, _, _ = str(about["path"]).partition("#")
    return _as_it_was(Path(path), about, str(about["path"]), advice, trusted)


def _as_it_was(
    path: Path, about: Mapping[str, Any], text: str, advice: str, trusted: Sequence[str] = ()
) -> Player:
    if _sha256(path, advice) != about["sha256"]:
        raise UnreadableFile(str(path), "it is another file than the one that acted", advice)
    return as_player(text, trusted=trusted)


# --- things in memory -------------------------------------------------------------------------


def _of_callable(policy: Any, about: About) -> Player:
    if isinstance(policy, WorldPolicy):
        inside = policy.policy
        make = inside if isinstance(inside, type) else partial(itself, inside)
        return ByWorld(make, {**about, "sees": "world"})
    if policy is still or isinstance(policy, Blind):
        return ByWorld(partial(itself, policy), {**about, "sees": "world"})
    if isinstance(policy, type):
        return _of_callable(policy(), about)
    if isinstance(policy, NetworkPolicy):
        return ByWeights(policy, {**about, "sha256": policy.sha256})
    if hasattr(policy, "predict"):
        return ByPrediction(policy, about)
    return ByObservation(policy, about)


def _who(policy: Any) -> About:
    """Say what a policy in memory is: a function that can be found again, or an object."""
    inside = policy.policy if isinstance(policy, WorldPolicy) else policy
    named = inside if hasattr(inside, "__qualname__") else type(inside)
    name = f"{named.__module__}:{named.__qualname__}"
    is_found = named is inside and named.__module__ != "__main__" and _leads_to(name, inside)
    return {"kind": "function" if is_found else "object", "name": name, **_library(name)}


def _leads_to(name: str, function: Any) -> bool:
    try:
        found = Function(name).resolve()
    except (ImportError, AttributeError, ModelError):
        return False
    return (found.policy if isinstance(found, WorldPolicy) else found) is function


def _library(name: str) -> dict[str, str]:
    """Name the distribution of ``"module:function"`` and its version, where there is one."""
    package = name.partition(":")[0].partition(".")[0]
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return {}
    return {"library": f"{package.replace('_', '-')} {version}"}


def _rows(given: Any) -> Any:
    try:
        return np.atleast_2d(np.asarray(given, dtype=getattr(given, "dtype", np.float64)))
    except (TypeError, ValueError):
        raise ActionError("actions have shape (n,) or (steps, n)", given) from None


def _of_episode(episode: Episode, about: About) -> Player:
    mode = str(episode.twins.options["action_mode"])
    return OpenLoop(episode.actions, _summed(about, episode.actions), action_mode=mode)


def _of_recorded(recorded: Played, about: About) -> Player:
    return OpenLoop(
        recorded.actions,
        _summed(about, recorded.actions),
        action_mode=recorded.action_mode,
        normalized=recorded.normalized,
        relative=recorded.relative,
    )


def _summed(about: About, actions: Any) -> About:
    if "sha256" in about:
        return about
    return {**about, "sha256": hashlib.sha256(np.asarray(actions).tobytes()).hexdigest()}


# --- texts and files --------------------------------------------------------------------------


def _of_text(text: str, trusted: Sequence[str] | None) -> Player:
    if text in NAMES:
        about = {"kind": "named", "name": text, **_library(PACKAGE)}
        return ByWorld(partial(_named, text), about)
    if text.startswith(ZOO):
        path_in_zoo = path_of(text)
        about = {"kind": "zoo", "name": text, **_library(PACKAGE)}
        about["sha256"] = _sha256(path_in_zoo, _ADVICE)
        return ByWeights(load_policy(path_in_zoo), about)
    if Path(text).is_dir():
        found = in_run(Path(text))
        about = {"kind": "file", "name": Path(text).resolve().name, "path": str(found)}
        about["sha256"] = _sha256(found, _ADVICE)
        return ByWeights(load_policy(found), about)
    path, _, number = text.partition("#")
    suffix = Path(path).suffix
    if suffix in _FILES:
        about = {"kind": "file", "name": Path(text).name, "path": text}
        about["sha256"] = _sha256(Path(path), _ADVICE)
        return _FILES[suffix](Path(path), number, about, trusted or ())
    if ":" in text:
        about = {"kind": "function", "name": text, **_library(text)}
        return _of_callable(_function(text, trusted), about)
    raise UnknownOption("policy", text, FORMS)


_ADVICE = "give the path of a policy"


def _named(name: str) -> Policy:
    """Give the policy of one episode, by its name: that can be pickled."""
    return NAMES[name]()


def _sha256(path: Path, advice: str) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UnreadableFile(str(path), error.strerror or str(error), advice) from None


def _function(name: str, trusted: Sequence[str] | None) -> Any:
    function = Function(name)
    if trusted is not None and not function.is_defined_in((PACKAGE, *trusted)):
        allowed = ", ".join((PACKAGE, *trusted))
        raise ModelError([f"{name!r} is no function of {allowed}; pass trusted=(…) to use it"])
    try:
        return function.resolve()
    except (ImportError, AttributeError, ValueError) as error:
        raise ModelError([f"there is no function {name!r}: {error}"]) from None


def _network(path: Path, number: str, about: About, trusted: Sequence[str]) -> Player:
    return ByNetwork(path, about)


def _weights(path: Path, number: str, about: About, trusted: Sequence[str]) -> Player:
    return ByWeights(load_policy(path), about)


def _archive(path: Path, number: str, about: About, trusted: Sequence[str]) -> Player:
    try:
        policy = load_sb2(path)
    except UnreadableFile as error:
        if _PICKLED.encode() not in path.read_bytes():
            raise
        advice = "load it if you trust it, and give the model: as_player(PPO.load(path))"
        reason = "it is one of Stable-Baselines3, whose reading may run any code in it"
        raise UnreadableFile(str(path), reason, advice) from error
    return ByPrediction(policy, about)


def _saved(path: Path, number: str, about: About, trusted: Sequence[str]) -> Player:
    return _of_episode(load_episode(path, trusted=trusted), about)


def _recording(path: Path, number: str, about: About, trusted: Sequence[str]) -> Player:
    from scm_world.evaluation.recording.recording import Recording  # which itself needs players

    found = Recording.load(path, trusted=trusted)
    if not number and len(found) != 1:
        advice = f"say which one: {path}#0 to #{len(found) - 1}"
        raise UnreadableFile(str(path), f"it has {len(found)} episodes", advice)
    if number and not (number.isdecimal() and int(number) < len(found)):
        raise UnknownOption("episode of a recording", number, (f"0 to {len(found) - 1}",))
    return _of_recorded(found[int(number or 0)], about)


_FILES: Mapping[str, Callable[[Path, str, About, Sequence[str]], Player]] = {
    ".safetensors": _weights,
    ".onnx": _network,
    ".zip": _archive,
    ".npz": _saved,
    ".parquet": _recording,
}
