"""In which form of an environment each agent acts: what it sees, and what its actions mean.

A trained policy says with which options it was trained. What is observed and what actions mean may
differ between agents of one evaluation: each acts in an environment of its own form, with the same
draws. How long a control step is and the conventions are shared.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium

from scm_world.errors import UnknownOption
from scm_world.policies import PolicyAbout
from scm_world.policies.cards import COMMON, FORM, FREE, contradiction, plain, usual
from scm_world.tasks import Task
from scm_world.tasks.factories import refuse_untrusted

Options = dict[str, Any]
Trained = Sequence[tuple[str, PolicyAbout | None]]
"""Agents, and what each was trained for, if it says so."""

TASK = "pushing"
"""Where agents act that say nothing, if nobody says anything."""


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
    tasks = _distinct(about.task for _, about in agents if about is not None)
    if len(tasks) > 1:
        raise UnknownOption("task", None, [f"{one!r}" for one in tasks])
    for one in tasks:
        refuse_untrusted(one, trusted)
    return tasks[0] if tasks else TASK


def shared_options(given: Mapping[str, Any] | None, agents: Trained) -> Options:
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
    if trained and len(trained) == len(agents):
        for option in (*FORM, *COMMON):
            _refuse_contradiction(option, found, trained)
        found = {option: value for option, value in found.items() if option not in FORM}
    for option in COMMON:
        _refuse_contradiction(option, found, trained)
    for option in (*COMMON, *FREE):
        if option in found:
            continue
        wanted = _distinct(about.option(option) for _, about in trained)
        if len(wanted) > 1:
            raise _disagreement(option, trained)
        if wanted and wanted[0] != usual(option, trained[0][1].task):
            found[option] = wanted[0]
    return found


def form_of(about: PolicyAbout | None) -> Options | None:
    """Give the options that are an agent's own; None if it takes what is shared."""
    return None if about is None else about.unusual(FORM)


def in_form(shared: Mapping[str, Any], form: Mapping[str, Any] | None) -> Options:
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


def _refuse_contradiction(
    option: str, given: Mapping[str, Any], trained: Sequence[tuple[str, PolicyAbout]]
) -> None:
    for name, about in trained:
        wanted = about.option(option)
        if option in given and wanted is not None and plain(given[option]) != wanted:
            raise contradiction(option, given[option], about.option(option), name)


def _disagreement(option: str, trained: Sequence[tuple[str, PolicyAbout]]) -> UnknownOption:
    each = "; ".join(f"{name} with {about.option(option)!r}" for name, about in trained)
    allowed = f"the same for all agents, and they were trained {each}: "
    allowed += "evaluate them apart" if option in COMMON else f"give {option} in env"
    return UnknownOption(option, "several values", (allowed,))


def _distinct(values: Iterable[Any]) -> list[Any]:
    found: list[Any] = []
    for value in values:
        if value not in found:
            found.append(value)
    return found
