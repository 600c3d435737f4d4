"""The agents of an evaluation: policies, their names and their identities."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from scm_world.env import ScmWorldEnv
from scm_world.errors import EvaluationError, ScmWorldError, UnknownOption
from scm_world.evaluation.forms import form_of
from scm_world.evaluation.players import Player, WorldPolicy, as_player
from scm_world.evaluation.protocols import named
from scm_world.policies import PolicyAbout

_TRIES = 25  # observations on which a policy without a file is tried out
_PLACE = ("path",)  # where a policy lies does not say which one it is


@final
@dataclass(frozen=True)
class AgentRun:
    """A policy and what it is called.

    Attributes:
        agent: Name of the agent.
        run: Number of its training run.
        policy: What a user gave.
        about: What it is, as plain data.
        form: Options of the environment that are its own; None if it takes those of all.
    """

    agent: str
    run: int
    policy: Any
    about: Mapping[str, Any]
    form: Mapping[str, Any] | None = None

    def identity(self) -> list[Any]:
        """Return its identity as plain data: the same wherever its file lies."""
        own = [] if self.form is None else [dict(self.form)]
        return [self.agent, self.run, what_it_is(self.about), *own]

    def as_dict(self) -> dict[str, Any]:
        """Return it, with the options of its environment, as plain data."""
        own = {} if self.form is None else {"env": dict(self.form)}
        return {"agent": self.agent, "run": self.run, "policy": dict(self.about), **own}


@final
@dataclass(frozen=True)
class LoadedAgent:
    """A policy that was read, and not yet tried out.

    Attributes:
        agent: Name of the agent.
        run: Number of its training run.
        policy: What a user gave.
        player: The policy that is called.
    """

    agent: str
    run: int
    policy: Any
    player: Player

    @property
    def made_for(self) -> PolicyAbout | None:
        """What it was trained for, if it says so."""
        return getattr(self.player, "made_for", None)

    def tried_out(self, env: ScmWorldEnv) -> AgentRun:
        """Call it a few times, and return the agent.

        Args:
            env: The environment.

        Raises:
            EvaluationError: It does not fit the environment; with its name.
        """
        try:
            traits = _traits(self.policy, self.player, env)
        except ScmWorldError as error:
            raise EvaluationError({"agent": self.agent, "run": self.run}, str(error)) from error
        except Exception as error:
            error.add_note(f"agent {self.agent}, run {self.run}, before the first episode")
            raise
        about = {**self.player.about, **traits}
        return AgentRun(self.agent, self.run, self.policy, about, form_of(self.made_for))


def what_it_is(about: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out of what a policy is where its file lies.

    Example:
        >>> what_it_is({"kind": "file", "path": "runs/a.onnx", "sha256": "5f52"})
        {'kind': 'file', 'sha256': '5f52'}
    """
    return {name: value for name, value in about.items() if name not in _PLACE}


def load_agents(policy: Any, trusted: Sequence[str] | None) -> tuple[LoadedAgent, ...]:
    """Load the agents.

    Args:
        policy: A policy; a list of them, one for each training run; or either by the name of the
            agent.
        trusted: Packages whose functions may be policies, if named by a text.

    Raises:
        UnknownOption: There is none, or two have one name.
    """
    loaded: list[LoadedAgent] = []
    for agent, run, one in listed(policy):
        player = as_player(one, trusted=trusted)
        name = _short(str(player.about["name"])) if agent is None else agent
        name = loaded[0].agent if agent is None and loaded else name  # a list is one agent
        loaded.append(LoadedAgent(named("name of an agent", name), run, one, player))
    if not loaded:
        raise UnknownOption("policy", policy, ("one or several",))
    return tuple(loaded)


def listed(policy: Any) -> Iterator[tuple[str | None, int, Any]]:
    """List policies with agent and training run; the agent is None if it was not named.

    Raises:
        UnknownOption: The list of an agent is empty, or two agents have one name.

    Example:
        >>> list(listed({"mine": ["a.onnx", "b.onnx"], "other": "still"}))
        [('mine', 0, 'a.onnx'), ('mine', 1, 'b.onnx'), ('other', 0, 'still')]
    """
    agents = policy if isinstance(policy, Mapping) else {None: policy}
    for agent, given in agents.items():
        runs = given if _is_several(given) else [given]
        if not runs:
            raise UnknownOption(f"policies of {agent}", given, ("one policy or more",))
        if agent is not None:
            named("name of an agent", agent)
        for run, one in enumerate(runs):
            yield agent, run, one


def _is_several(given: Any) -> bool:
    """Tell a list of policies from a list of numbers, which are actions."""
    return isinstance(given, list) and not (given and isinstance(given[0], list | float | int))


def _short(name: str) -> str:
    """Name an agent by the last part of a path or of a module, as it can stand in a table.

    Example:
        >>> _short("runs/a.onnx"), _short("stable_baselines3.ppo.ppo:PPO")
        ('a.onnx', 'PPO')
    """
    last = name.replace("\\", "/").rstrip("/").rpartition("/")[2].rpartition(":")[2]
    return last.replace(",", " ").strip() or "policy"


def _traits(policy: Any, player: Player, env: ScmWorldEnv) -> dict[str, str]:
    """Return what identifies a policy that has no file: its actions and its source.

    It also shows at once that a policy does not fit the environment. One that gives two actions
    for one observation draws from a noise of its own: what it does then says nothing.
    """
    is_known = "sha256" in player.about or player.about.get("kind") == "named"
    actions = _walked(player, env, 1 if is_known else _TRIES)
    if is_known:
        return {}
    found = blake2b(source_of(policy), digest_size=8)
    if actions != _walked(player, env, _TRIES):
        return {"traits": found.hexdigest(), "repeats": "no"}
    found.update(b"".join(actions))
    return {"traits": found.hexdigest()}


def _walked(player: Player, env: Any, steps: int) -> list[bytes]:
    """Return its actions along a random walk that is always the same one."""
    observation, _ = env.reset(seed=0)
    player.begin(env)
    walk = np.random.default_rng(0)
    low, high = np.clip(env.action_space.low, -1e3, 1e3), np.clip(env.action_space.high, -1e3, 1e3)
    found = []
    for _ in range(steps):
        action: NDArray[Any] = player.act(observation)
        found.append(action.tobytes())
        taken = walk.uniform(low, high).astype(np.float32)
        observation, _, terminated, truncated, _ = env.step(taken)
        if terminated or truncated:
            break
    return found


def source_of(policy: Any) -> bytes:
    """Return the source of a function or class, if there is one."""
    inside = policy.policy if isinstance(policy, WorldPolicy) else policy
    inside = inside if inspect.isroutine(inside) or isinstance(inside, type) else type(inside)
    try:
        return inspect.getsource(inside).encode()
    except (OSError, TypeError):
        return b""
