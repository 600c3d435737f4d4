"""The agents of an evaluation: policies, their names, identities and environments.

A trained policy says with which options it was trained. What is observed and what actions mean may
differ between agents of one evaluation: each acts in an environment of its own form, with the same
draws. How long a control step is and the conventions are shared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import gymnasium
import numpy as np

from scm_world._fingerprint import fingerprint
from scm_world.env import ScmWorldEnv
from scm_world.errors import EvaluationError, ScmWorldError, UnknownOption
from scm_world.evaluation.players import Player, as_player
from scm_world.evaluation.protocols import named
from scm_world.policies import PolicyAbout
from scm_world.policies.cards import COMMON, FORM, FREE, contradiction, plain, usual
from scm_world.tasks import Task
from scm_world.tasks.factories import refuse_untrusted

_TRIES = 25  # observations on which a policy without a file is tried out

Trained = Sequence[tuple[str, PolicyAbout | None]]
"""Agents, and what each was trained for, if it says so."""

TASK = "pushing"
"""The default task of agents that name none."""


@final
@dataclass(frozen=True)
class AgentRun:
    """A policy and what it is called.

    Attributes:
        agent: Name of the agent.
        run: Number of its training run.
        player: The policy.
        about: What it is, as plain data.
        form: Options of the environment that are its own; None if it takes those of all.
    """

    agent: str
    run: int
    player: Player
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

    def tried_out(self, env: ScmWorldEnv) -> AgentRun:
        """Call it a few times, and return it with what identifies a policy that has no file.

        That is its fingerprint, and whether it gives two actions for one observation.

        Raises:
            EvaluationError: It does not fit the environment; with its name.
        """
        is_known = "sha256" in self.about or self.about.get("kind") == "named"
        try:
            policy = {} if is_known else {"policy": self.player.policy}
            traits: dict[str, Any] = {"fingerprint": fingerprint(policy)}
            actions = _walked(self.player, env, 1 if is_known else _TRIES)
            if is_known:
                return self
            if actions != _walked(self.player, env, _TRIES):
                traits = {**traits, "repeats": "no"}
            return replace(self, about={**self.about, **traits})
        except ScmWorldError as error:
            raise EvaluationError({"agent": self.agent, "run": self.run}, str(error)) from error


def _walked(player: Player, env: Any, steps: int) -> list[bytes]:
    """Return its actions along a random walk that is always the same one."""
    observation, _ = env.reset(seed=0)
    player.begin(env)
    walk = np.random.default_rng(0)
    low, high = np.clip(env.action_space.low, -1e3, 1e3), np.clip(env.action_space.high, -1e3, 1e3)
    found = []
    for _ in range(steps):
        found.append(player.act(observation).tobytes())
        taken = walk.uniform(low, high).astype(np.float32)
        observation, _, terminated, truncated, _ = env.step(taken)
        if terminated or truncated:
            break
    return found


def what_it_is(about: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out of what a policy is where its file lies.

    Example:
        >>> what_it_is({"kind": "file", "path": "runs/a.zip", "sha256": "5f52"})
        {'kind': 'file', 'sha256': '5f52'}
    """
    return {name: value for name, value in about.items() if name != "path"}


def load_agents(policy: Any, trusted: Sequence[str] | None) -> tuple[AgentRun, ...]:
    """Load the agents, which are not tried out yet.

    Args:
        policy: A policy; a list of them, one for each training run; or either by the name of the
            agent. Without a name, it is the last part of a path or of a module, as it can stand in
            a table.
        trusted: Packages whose functions may be policies, if named by a text.

    Raises:
        UnknownOption: There is none, or two have one name.
    """
    loaded: list[AgentRun] = []
    for given, run, one in listed(policy):
        player = as_player(one, trusted=trusted)
        last = str(player.about["name"]).replace("\\", "/").rstrip("/").rpartition("/")[2]
        agent = last.rpartition(":")[2].replace(",", " ").strip() or "policy"
        if given is not None:
            agent = given
        elif loaded:  # a list is one agent
            agent = loaded[0].agent
        made_for = player.made_for
        form = None if made_for is None else made_for.unusual(FORM)
        loaded.append(AgentRun(named("name of an agent", agent), run, player, player.about, form))
    if not loaded:
        raise UnknownOption("policy", policy, ("one or several",))
    return tuple(loaded)


def listed(policy: Any) -> Iterator[tuple[str | None, int, Any]]:
    """List policies with agent and training run; the agent is None if it was not named.

    Raises:
        UnknownOption: The list of an agent is empty, or two agents have one name.

    Example:
        >>> list(listed({"mine": ["a.zip", "b.zip"], "other": "still"}))
        [('mine', 0, 'a.zip'), ('mine', 1, 'b.zip'), ('other', 0, 'still')]
    """
    agents = policy if isinstance(policy, Mapping) else {None: policy}
    for agent, given in agents.items():
        # A list of numbers is actions, of one policy.
        is_numbers = isinstance(given, list) and given and isinstance(given[0], list | float | int)
        runs = given if isinstance(given, list) and not is_numbers else [given]
        if not runs:
            raise UnknownOption(f"policies of {agent}", given, ("one policy or more",))
        if agent is not None:
            named("name of an agent", agent)
        for run, one in enumerate(runs):
            yield agent, run, one


# --- environments ---------------------------------------------------------------------------------


def task_for(task: Task | str | None, agents: Trained, trusted: Sequence[str] = ()) -> Task | str:
    """Choose the task: the one that is given, else the one that the agents were trained for.

    Warn of an agent that was trained for another task than the one that is given.

    Args:
        task: If it is given.
        agents: See ``Trained``.
        trusted: Packages whose functions may be called for a task that only a policy names.

    Raises:
        UnknownOption: They were trained for several, or for a function of no trusted package.
    """
    if task is not None:
        given = getattr(task, "name", task)
        for name, about in agents:
            if about is not None and about.task != given:
                gymnasium.logger.warn(
                    f"{name!r} was trained for the task {about.task!r}, and acts in {given!r}"
                )
        return task
    tasks = list(dict.fromkeys(about.task for _, about in agents if about is not None))
    if len(tasks) > 1:
        raise UnknownOption("task", None, [f"{one!r}" for one in tasks])
    for one in tasks:
        refuse_untrusted(one, trusted)
    return tasks[0] if tasks else TASK


def shared_options(given: Mapping[str, Any] | None, agents: Trained) -> dict[str, Any]:
    """Choose the options of the environment that are shared by all agents.

    Options of ``FORM`` among them are for the agents that do not say how they were trained.

    Args:
        given: What the user asks for; it counts.
        agents: Who acts.

    Raises:
        UnknownOption: An option contradicts an agent, or agents contradict one another.
    """
    found = dict(given or {})
    trained = [(name, about) for name, about in agents if about is not None]
    all_say = bool(trained) and len(trained) == len(agents)
    for option in (*FORM, *COMMON) if all_say else COMMON:
        for name, about in trained:
            wanted = about.option(option)
            if option in found and wanted is not None and plain(found[option]) != wanted:
                raise contradiction(option, found[option], wanted, name)
    if all_say:
        found = {option: value for option, value in found.items() if option not in FORM}
    for option in (name for name in (*COMMON, *FREE) if name not in found):
        several = [about.option(option) for _, about in trained]
        if any(one != several[0] for one in several):
            each = "; ".join(f"{name} with {about.option(option)!r}" for name, about in trained)
            allowed = f"the same for all agents, and they were trained {each}: "
            allowed += "evaluate them apart" if option in COMMON else f"give {option} in env"
            raise UnknownOption(option, "several values", (allowed,))
        if several and several[0] != usual(option, trained[0][1].task):
            found[option] = several[0]
    return found


def in_form(shared: Mapping[str, Any], form: Mapping[str, Any] | None) -> dict[str, Any]:
    """Give the options of the environment of an agent.

    Args:
        shared: By all agents.
        form: The agent's own.

    Example:
        >>> in_form({"frame_skip": 3, "context": "privileged"}, {"keypoints": True})
        {'frame_skip': 3, 'keypoints': True}
    """
    if form is None:
        return dict(shared)
    return {**{name: shared[name] for name in shared if name not in FORM}, **form}
