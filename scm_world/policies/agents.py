"""Agents: policies of every form behind two methods, ``start`` and ``act``."""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast, final

import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import load, typed
from scm_world._types import ArrayLike, Floats, Observation
from scm_world.errors import ActionError, ModelError, UnknownOption, UnreadableFile, blamed
from scm_world.policies.cards import ANY, PolicyAbout, PolicyEnv, contradiction
from scm_world.policies.networks import MlpPolicy, load_policy, load_sb2
from scm_world.policies.scripted import NAMED, OpenLoopPolicy, Policy, Sequence
from scm_world.policies.wrappers import LinearMap, seen_through
from scm_world.policies.zoo import PREFIX as ZOO
from scm_world.policies.zoo import file_of
from scm_world.runs.files import read_bytes
from scm_world.variables import Function
from scm_world.world import CausalSystem

Actions = NDArray[Any]
About = dict[str, Any]
"""Description of a policy as plain data: its kind, its name, and where it comes from."""

Actor = Callable[[Observation], object]
"""Returns an action for an observation, within one episode."""


SB3 = "stable_baselines3"
_FLOATS = (np.dtype(np.float32), np.dtype(np.float64))


def still(world: CausalSystem) -> Floats:
    """Return the idle action, shape (n_actions,)."""
    return world.idle()


NAMES: Mapping[str, Callable[[], Policy]] = {"still": lambda: still, **NAMED}
"""Policies that have a name; each entry returns the policy of one episode."""

OWN_POLICIES = frozenset(
    Function(getattr(made, "func", made)).reference for made in (still, *NAMED.values())
)
"""Functions and classes of this package that a file may name as policies."""

FORMS = (
    *NAMES,
    "a function of the observation, such as one that runs an ONNX network",
    "a WorldPolicy",
    "an object with the method predict",
    "an object with the methods start and act",
    "an array of actions, such as those of an episode",
    "a file (.safetensors, .zip of Stable-Baselines 2 or 3)",
    "the folder of a training run",
    "'zoo:name'",
    "'module:function'",
)


@final
@dataclass(frozen=True)
class WorldPolicy:
    """Marks a policy that reads the world instead of the observation.

    It is called with the world of the environment and returns an action in the units of the action
    mode (rad, N m or m), shape (n_actions,). It serves as a decorator.

    Attributes:
        policy: The function; a class is instantiated for every episode.

    Example:
        >>> @WorldPolicy
        ... def lazy(world):
        ...     return 0.5 * (world.action_low + world.action_high)
    """

    policy: Callable[..., Any]

    def __post_init__(self) -> None:
        """Belong to the module of the function, which files may have to trust."""
        object.__setattr__(self, "__module__", getattr(self.policy, "__module__", None))

    def __call__(self, world: CausalSystem) -> ArrayLike:
        """Choose the action."""
        action: ArrayLike = self.policy(world)
        return action


@final
class Agent:
    """Acts in an environment, episode after episode; ``as_agent`` makes it.

    What it learns in an episode is gone in the next one, unless its policy has a method ``forget``
    (and no attribute ``keeps`` that is false): then the policy may remember until that is called,
    which an evaluation does before the first episode of each draw of a protocol.

    Args:
        about: Description of the policy, as plain data.
        begin: Returns the actor of the episode that an environment has begun.
        policy: What ``as_agent`` was given.
        card: What the policy was trained for, if known.
        network: What computes the actions, if it is not the world that is read.
        remembers: Whether its actions follow from earlier control steps of the episode, too.
    """

    @typed
    def __init__(
        self,
        about: Mapping[str, Any],
        begin: Callable[[PolicyEnv], Actor],
        policy: object = None,
        card: PolicyAbout | None = None,
        network: object = None,
        *,
        remembers: bool = False,
    ) -> None:
        self.about: About = dict(about)
        self.policy, self.card, self.network = policy, card, network
        self.remembers = remembers
        self._begin = begin
        self._env: PolicyEnv | None = None
        self._act: Actor | None = None
        self._seen: Observation | None = None

    def start(self, env: PolicyEnv) -> None:
        """Begin an episode; called after every reset.

        Args:
            env: The ``ScmWorldEnv`` whose episode has begun.

        Raises:
            UnknownOption: It has other observations or actions than the policy was trained with.
            ActionError: Its observations or actions have other shapes.
            FunctionFailure: The policy raised an error.
        """
        with blamed(f"the policy {self.about['name']!r}"):
            self._env, self._act, self._seen = env, self._begin(env), None

    @property
    def keeps(self) -> bool:
        """Whether its policy remembers earlier episodes, too, until ``forget`` is called."""
        forgets = callable(getattr(self.policy, "forget", None))
        return forgets and bool(getattr(self.policy, "keeps", True))

    def forget(self) -> None:
        """Forget all episodes; called where the next one has nothing in common with them."""
        if self.keeps:
            with blamed(f"the policy {self.about['name']!r}"):
                cast("Any", self.policy).forget()

    def act(self, observation: Observation) -> Actions:
        """Choose an action of the environment, shape (n_actions,).

        Args:
            observation: An array, or arrays by name.

        Raises:
            ActionError: The policy gave no such action, or no episode has begun.
            FunctionFailure: It raised an error.
        """
        name = self.about["name"]
        if self._act is None:
            raise ActionError(f"the policy {name!r} acts in no episode; call start()", None)
        self._seen = observation
        with blamed(f"the policy {name!r}"):
            action = self._act(observation)
        return checked(action, self._env, name)

    def hidden(self) -> Floats | None:
        """Return the hidden state with which the last action was chosen, shape (k,).

        Of a network it is the activations of the last hidden layer, and the memory after the
        action; of a recurrent model without such a method the memory; of any other object what its
        method ``hidden`` returns for the observation.

        Returns:
            The numbers; None of a policy without a hidden state, or before the first action.

        Raises:
            FunctionFailure: The method of the policy raised an error.
        """
        ask = getattr(self._act, "hidden", None) or getattr(self.network, "hidden", None)
        if not callable(ask) or self._seen is None:
            return None
        with blamed(f"the policy {self.about['name']!r}"):
            found = ask(self._seen)
            return None if found is None else np.array(found, dtype=np.float64).ravel()

    def untrained(self, seed: int = 0) -> Agent | None:
        """Return the agent with the same network of random weights; None without a network."""
        make = getattr(self.network, "untrained", None)
        return None if make is None else as_agent(make(seed))

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle without the episode."""
        return {**vars(self), "_env": None, "_act": None, "_seen": None}


def checked(action: object, env: PolicyEnv | None, name: str) -> Actions:
    """Check that a policy gave finite numbers; numbers beyond the range are left alone.

    Anything but floats becomes 64-bit floats. Without an environment the length may be any.

    Example:
        >>> checked([0.0, float("nan")], None, "wild")
        Traceback (most recent call last):
        scm_world.errors.ActionError: the policy 'wild' gave [0.0, nan]; an action is an array of
        shape (n,) with finite numbers
    """
    shape = None if env is None else env.action_space.shape
    if type(action) is np.ndarray and action.dtype in _FLOATS and action.shape == shape:
        found: Actions = action
        if math.isfinite(sum(action.tolist())):  # faster than numpy for a few numbers
            return found
    else:
        try:
            found = np.asarray(action)
            if found.dtype.kind != "f":
                is_real = found.dtype.kind in "bui"
                found = found.astype(np.float64, casting="safe" if is_real else "no")
        except (TypeError, ValueError):
            found = np.empty((0, 0))
    fits = found.shape == shape or (shape is None and found.ndim == 1)
    fits |= shape == () and found.shape == (1,)  # one choice of several
    if fits and np.isfinite(found).all():
        return found
    where = "" if env is None else f" of {env.action_space}"
    raise ActionError(
        f"the policy {name!r} gave {action!r}; an action is an array of shape {shape or '(n,)'} "
        f"with finite numbers{where}",
        action,
    )


# --- how episodes begin: each function returns what acts in an episode ----------------------------


def _function(policy: Any, env: PolicyEnv) -> Actor:
    if callable(getattr(policy, "reset", None)):
        policy.reset()
    act: Actor = policy
    return act


def _started(agent: Any, env: PolicyEnv) -> Actor:
    agent.start(env)
    act: Actor = agent.act
    return act


def _formed(
    begin: Callable[[PolicyEnv], Actor], card: PolicyAbout, name: str, env: PolicyEnv
) -> Actor:
    card.check(env, name)
    return begin(env)


def _model(model: Any, env: PolicyEnv, seen: LinearMap | None = None) -> Actor:
    """Begin an episode of a model with ``predict``, which observes through wrappers."""
    shapes = [_shapes(getattr(one, "observation_space", None)) for one in (model, env)]
    if seen is None and shapes[0] not in (None, shapes[1]):
        problem = f"it observes shape {shapes[0]}, and the environment shows {shapes[1]}"
        raise ActionError(f"{problem}; give the options of its training: env={{…}}", None)
    return _Recurrent(model, seen)


@final
class _Recurrent:
    """Acts by a model with ``predict``, and carries its state from step to step."""

    def __init__(self, model: Any, seen: LinearMap | None) -> None:
        self._model, self._seen = model, seen
        self._before: Any = None
        self._state: Any = None
        self._first = True

    def __call__(self, observation: Observation) -> object:
        self._before, first = self._state, np.array([self._first])
        action, self._state = self._model.predict(
            self._shown(observation), state=self._before, episode_start=first, deterministic=True
        )
        self._first = False
        return action

    def hidden(self, observation: Observation) -> Floats | None:
        """Return the hidden state of the last action, which followed from this observation."""
        ask, state = getattr(self._model, "hidden", None), self._state
        parts = [ask(self._shown(observation), self._before)] if callable(ask) else []
        parts += [] if state is None else state if isinstance(state, tuple) else [state]
        return np.concatenate([*map(np.ravel, parts)]) if parts else None

    def _shown(self, observation: Observation) -> object:
        return observation if self._seen is None else self._seen(cast("ArrayLike", observation))


def _shapes(space: object) -> object:
    """Return the shape of a space, by name where it has parts; the channels of pictures last."""
    parts = getattr(space, "spaces", None)
    if isinstance(parts, Mapping):
        return {name: _shapes(part) for name, part in parts.items()}
    shape = getattr(space, "shape", None)
    return tuple(sorted(shape)) if shape is not None and len(shape) == 3 else shape


def _network(policy: MlpPolicy, name: str, env: PolicyEnv) -> Actor:
    if policy.made_for is not None:
        policy.made_for.check(env, name)
    policy.check(env.observe(), env.world.compiled.n_actions)
    return _model(policy, env) if policy.n_remembered else policy


def _of_world(given: str | Policy, name: str, env: PolicyEnv) -> Actor:
    """Return actions that lead as near to the command of a world policy as one action can."""
    made = NAMES[given]() if isinstance(given, str) else given  # some cannot be pickled
    policy: Any = _function(made() if isinstance(made, type) else made, env)
    return lambda _: env.as_action(checked(policy(env.world), env, name))


def _open_loop(actions: Actions, name: str, env: PolicyEnv) -> Actor:
    """Play actions of the environment one after another, and hold the last one."""
    checked(actions[0], env, name)
    rows = chain(actions, repeat(actions[-1]))
    return lambda _: next(rows)


# --- what a user gives ----------------------------------------------------------------------------


def as_agent(
    policy: object,
    *,
    trusted: SequenceOf[str] | None = None,
    env: Mapping[str, Any] | None = None,
) -> Agent:
    """Read a policy.

    Args:
        policy: A function of the observation; an object with ``predict`` as Stable-Baselines3 has
            it, or with ``start`` and ``act`` as an ``Agent`` has them; the name of a policy of this
            package; a ``WorldPolicy``; actions, shape (n,) or (steps, n), in the units of the
            environment; the path of a policy file or of an archive of Stable-Baselines 2; the
            folder of a training run; an archive of Stable-Baselines3, if ``"stable_baselines3"`` is
            among ``trusted``; ``"zoo:pushing"``, one that comes with this package; or
            ``"package.module:function"``.
        trusted: Packages whose functions may be named. None: any, as the caller named it.
        env: How it observes and acts, as a policy file says it: options of the environment such as
            ``{"action_mode": "delta_joint_positions", "context": "observation"}``; the others have
            their defaults. An evaluation gives it an environment of this form. If None, it takes
            any, and a model of Stable-Baselines3 that has its environment that one's.

    Raises:
        UnknownOption: It is something else, or says itself that an option is another one.
        ModelError: It names a function that is not there, or of no trusted package.
        UnreadableFile: The file is not a policy, or reading it would run code in it.
        ActionError: Actions have another shape, or are not finite.
        MissingExtra: The file needs a library that is not installed.

    Example:
        >>> about = as_agent("random").about
        >>> about["kind"], agent_from(about).about == about
        ('named', True)
    """
    if isinstance(policy, Agent):
        found = policy
    elif isinstance(policy, str | Path):
        found = _of_text(str(policy), trusted)
    elif isinstance(policy, np.ndarray | list | tuple):
        found = _of_actions(policy)
    elif callable(policy) or hasattr(policy, "predict") or hasattr(policy, "act"):
        found = _of_object(policy, _description(policy))
    else:
        raise UnknownOption("policy", policy, FORMS)
    if env is None:
        return found
    name, known = str(found.about["name"]), found.card
    card = PolicyAbout.of({"task": ANY if known is None else known.task, "env": env})
    if known is None:
        begin = partial(_formed, found._begin, card, name)
        rest: Any = {"network": found.network, "remembers": found.remembers}
        return Agent(found.about, begin, found.policy, card, **rest)
    for option, given in card.env.items():
        if known.option(option) not in (given, None):
            raise contradiction(option, given, known.option(option), name)
    return found


@typed
def agent_from(
    about: Mapping[str, Any],
    *,
    trusted: SequenceOf[str] = (),
    env: Mapping[str, Any] | None = None,
) -> Agent:
    """Make the agent again that ``Agent.about`` describes.

    Args:
        about: Description in a results file.
        trusted: Packages whose functions may be named.
        env: Its options of the environment, if the file has them.

    Raises:
        UnknownOption: It was an object in memory; it can only be given.
        UnreadableFile: The file is gone, or its content has changed.
        ModelError: It is a function of no trusted package.
    """
    kind, name = about.get("kind"), str(about.get("name"))
    advice = "give the policy itself: policy=…"
    if kind == "named" and name in NAMES:
        return as_agent(name, env=env)
    if kind == "function":
        found = _resolved(name, trusted)
        sees = about.get("sees") == "world" and not hasattr(found, "act")
        if sees and not isinstance(found, WorldPolicy):
            found = WorldPolicy(found)
        return as_agent(_of_object(found, {"kind": kind, "name": name, **_library(name)}), env=env)
    if kind not in ("zoo", "file"):
        raise UnknownOption(f"policy to make again from {kind!r}", name, (advice,))
    text = name if kind == "zoo" else str(about["path"])
    path = file_of(text)
    if _sha256(path, advice) != about["sha256"]:
        raise UnreadableFile(str(path), "it is another file than the one that acted", advice)
    return as_agent(text, trusted=trusted, env=env)


def _of_text(text: str, trusted: SequenceOf[str] | None) -> Agent:
    ours = _library("scm_world")
    about: About
    if text in NAMES:
        about = {"kind": "named", "name": text, **ours}
        return Agent(about, partial(_of_world, text, text), text)
    if text.startswith(ZOO):
        path, about = file_of(text), {"kind": "zoo", "name": text, **ours}
    elif Path(text).is_dir():
        path = file_of(text)
        about = {"kind": "file", "name": Path(text).resolve().name, "path": str(path)}
    elif Path(text).suffix in (".safetensors", ".zip"):
        path, about = Path(text), {"kind": "file", "name": Path(text).name, "path": text}
    elif ":" in text:
        about = {"kind": "function", "name": text, **_library(text)}
        return _of_object(_resolved(text, trusted), about)
    else:
        raise UnknownOption("policy", text, FORMS)
    about["sha256"] = _sha256(path, "give the path of a policy")
    found = load_policy(path) if path.suffix == ".safetensors" else _archived(path, trusted or ())
    if isinstance(found, MlpPolicy):
        return _of_network(found, about, text)
    return Agent({**about, **_library(SB3)}, partial(_model, found), text)


def _archived(path: Path, trusted: SequenceOf[str]) -> Any:
    """Read an archive of Stable-Baselines 2, or a trusted one of Stable-Baselines3."""
    try:
        return load_sb2(path)
    except UnreadableFile as error:
        if b"_stable_baselines3_version" not in read_bytes(path):
            raise
        if SB3 not in trusted:
            advice = (
                f"if you trust it, say so by trusted=({SB3!r},), or --trust {SB3}, or give the "
                "model: as_agent(PPO.load(path))"
            )
            reason = "it is one of Stable-Baselines3, whose reading may run any code in it"
            raise UnreadableFile(str(path), reason, advice) from error
    library = load(SB3, "stable-baselines3", "train")
    try:
        saved = load(f"{SB3}.common.save_util", "stable-baselines3", "train")
        data, _, _ = saved.load_from_zip_file(path)
        kind = {"SACPolicy": "SAC", "TD3Policy": "TD3"}.get(data["policy_class"].__name__)
        kind = kind or ("PPO" if "clip_range" in data else "A2C")
        return getattr(library, kind).load(path, device="cpu").policy
    except Exception as error:  # of many kinds: torch, pickle, zip, Stable-Baselines3
        advice = "load it yourself, and give the model: as_agent(PPO.load(path))"
        raise UnreadableFile(str(path), f"it cannot be loaded ({error})", advice) from error


def _of_actions(actions: ArrayLike) -> Agent:
    rows = Sequence(actions).actions
    digest = hashlib.sha256(rows.tobytes()).hexdigest()
    about = {"kind": "actions", "name": "actions", "sha256": digest}
    return Agent(about, partial(_open_loop, rows, "actions"), actions)


def _of_object(policy: Any, about: About) -> Agent:
    made = policy() if isinstance(policy, type) else policy
    policy = made if hasattr(made, "forget") else policy  # the one that remembers
    if isinstance(made, WorldPolicy | OpenLoopPolicy) or made is still:
        inside = made.policy if isinstance(made, WorldPolicy) else made
        begin = partial(_of_world, inside, about["name"])
        return Agent({**about, "sees": "world"}, begin, policy)
    if isinstance(made, MlpPolicy):
        return _of_network(made, {**about, "sha256": made.sha256}, policy)
    if hasattr(made, "start") and hasattr(made, "act"):
        how: Any = {"card": getattr(made, "card", None), "network": made, "remembers": True}
        return Agent({**about, "sees": "world"}, partial(_started, made), policy, **how)
    if not hasattr(made, "predict"):
        return Agent(about, partial(_function, made), policy, network=made)
    try:
        card = PolicyAbout.in_env(made.get_env())
    except (AttributeError, UnknownOption):  # it has no environment of this package any more
        return Agent(about, partial(_model, made), policy, network=made)
    begin = partial(_model, made, seen=seen_through(made.get_env()))
    return Agent(about, begin, policy, card, made)


def _of_network(network: MlpPolicy, about: About, policy: object) -> Agent:
    begin, remembers = partial(_network, network, about["name"]), network.n_remembered > 0
    return Agent(about, begin, policy, network.made_for, network, remembers=remembers)


def _description(policy: object) -> About:
    """Describe a policy in memory: a function that can be found again, or an object."""
    inside = policy.policy if isinstance(policy, WorldPolicy) else policy
    named = inside if hasattr(inside, "__qualname__") else type(inside)
    name = f"{named.__module__}:{named.__qualname__}"
    try:
        found = Function(name).resolve()
        found = found.policy if isinstance(found, WorldPolicy) else found
    except (ImportError, AttributeError, ValueError):  # a ModelError is one
        found = None
    is_found = named is inside is found and named.__module__ != "__main__"
    return {"kind": "function" if is_found else "object", "name": name, **_library(name)}


def _library(name: str) -> dict[str, str]:
    """Return the distribution of ``"module:function"`` and its version, where there is one."""
    package = name.partition(":")[0].partition(".")[0]
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return {}
    return {"library": f"{package.replace('_', '-')} {version}"}


def _resolved(name: str, trusted: SequenceOf[str] | None) -> Any:
    function = Function(name)
    if not (trusted is None or name in OWN_POLICIES or function.is_defined_in(trusted)):
        problem = "is neither a policy of this package nor a function of a trusted one"
        raise ModelError([f"{name!r} {problem}; pass trusted=(…) to use it"])
    try:
        found = resolve_name(name)
        return found if hasattr(found, "act") else function.resolve()
    except (ImportError, AttributeError, ValueError) as error:
        raise ModelError([f"no function is named {name!r}: {error}"]) from None


def _sha256(path: Path, advice: str) -> str:
    try:
        return hashlib.sha256(read_bytes(path)).hexdigest()
    except OSError as error:
        raise UnreadableFile(str(path), error.strerror or str(error), advice) from None
