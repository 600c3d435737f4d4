"""Episodes of an evaluation, run again: the same task, options, agents and versions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from scm_world._fingerprint import differing, fingerprint
from scm_world.errors import (
    DAMAGED,
    ModelError,
    ScmWorldError,
    SnapshotMismatch,
    UnknownOption,
    in_one_line,
)
from scm_world.evaluation.agents import AgentRun, listed
from scm_world.evaluation.episodes import EpisodeRunner
from scm_world.evaluation.pipeline import ShardRunner
from scm_world.evaluation.players import as_player, player_from
from scm_world.evaluation.protocols import Protocol
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.setups import EvaluationPlace, Setup
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import FORMAT, Plan
from scm_world.tasks import Task, tasks
from scm_world.tasks.factories import is_model, refuse_untrusted


def shard_runner_of(
    evaluation: Evaluation,
    *,
    policy: Any = None,
    task: Task | str | None = None,
    trusted: Sequence[str] = (),
) -> ShardRunner:
    """Prepare to run episodes of an evaluation again.

    Args:
        evaluation: That was run.
        policy: As it was given to ``evaluate``; if None the one that was given in this process, or
            one made again from its description.
        task: If it is a task of the user's own class.
        trusted: Packages whose functions may be policies, or parts of protocols.

    Raises:
        SnapshotMismatch: It was made with other versions.
        UnknownOption: A policy cannot be made again, or the task is not registered.
        UnreadableFile: The file of a policy has changed.
    """
    about = evaluation.about
    try:
        place = _place(about, task, trusted, known=bool(evaluation.policies))
        _same_versions(place, about["versions"])
        protocols = [Protocol.from_dict(one, trusted=trusted) for one in about["protocols"]]
        setup = Setup(
            place,
            tuple(_agent_runs(evaluation, policy, trusted)),
            tuple(about["engines"]),
            tuple(protocols),
            tuple(about["seeds"]),
            about["n"],
            about["versions"],
        )
        return ShardRunner(setup)
    except DAMAGED as error:
        if isinstance(error, ScmWorldError):
            raise
        problem = f"what the evaluation says of itself cannot be used: {in_one_line(error)}"
        raise ModelError([problem]) from error


def _place(
    about: Mapping[str, Any], task: Task | str | None, trusted: Sequence[str], *, known: bool
) -> EvaluationPlace:
    """Make the task and the options of the environment again.

    Args:
        about: Description of the evaluation.
        task: If it is given.
        trusted: Packages whose functions may be called.
        known: Whether it was evaluated in this process, so that its task may be made again.

    Raises:
        UnknownOption: Its task is one of the user's own, and is not given, or another one is.
        ModelError: An intervention at the start calls a function of no trusted package.
    """
    options = _acts(about["env"], trusted)
    if task is not None:
        place = EvaluationPlace(task, options)
        _same_task(about, place)
        return place
    text = about["task"]
    refuse_untrusted(text, None if known else trusted)
    if text not in tasks() and not is_model(text) and ":" not in text:
        allowed = (*tasks(), "one of your own, if it is given: task=")
        raise UnknownOption("task", about["task"], allowed)
    if about["arguments"]:
        options["task_options"] = about["arguments"]
    place = EvaluationPlace(about["task"], options)
    _same_task(about, place)
    return place


def _same_task(about: Mapping[str, Any], place: EvaluationPlace) -> None:
    """Refuse a task that is not the one that was evaluated.

    Raises:
        UnknownOption: With the parts that differ.
    """
    now = place.made.__fingerprint__()
    there = {name: part for name, part in about["fingerprint"].items() if name in now}
    parts = differing(there, fingerprint(now, libraries=False))
    if parts:
        allowed = (f"the one that was evaluated, given as task=: {', '.join(parts)} differ",)
        raise UnknownOption("task", place.name, allowed)


def _agent_runs(evaluation: Evaluation, policy: Any, trusted: Sequence[str]) -> Iterator[AgentRun]:
    """Find who acted: the policy given now, one in a file, one given then, or one by its name.

    Raises:
        UnknownOption: A given policy is of no agent of the evaluation.
    """
    agents = {(one["agent"], one["run"]): one for one in evaluation.about["agents"]}
    names = list(dict.fromkeys(agent for agent, _ in agents))
    if policy is not None and not isinstance(policy, Mapping):
        if len(names) > 1:
            raise UnknownOption("policy", policy, (f"one by the name of each of {names}",))
        policy = {names[0]: policy}
    given = {(str(agent), run): one for agent, run, one in listed(policy or {})}
    for agent, run in given.keys() - agents.keys():
        raise UnknownOption("policy", f"{agent}, run {run}", [f"{a}, run {r}" for a, r in agents])
    for who, one in agents.items():
        what = one["policy"]
        if who in given:
            player = as_player(given[who])
        elif who in evaluation.policies and "path" not in what:
            player = as_player(evaluation.policies[who])
        else:
            player = player_from(what, trusted=trusted)
        yield AgentRun(*who, player, what, one.get("env"))


def _acts(options: Any, trusted: Sequence[str]) -> Any:
    """Read the interventions among the options of an environment, which were written down.

    Raises:
        ModelError: One calls a function of no trusted package.
    """
    if not isinstance(options, Mapping):
        return options
    if isinstance(options.get("kind"), str):
        data = {"format": FORMAT, "do": {"option": [options]}}
        return Plan.from_dict(data, trusted=trusted)["option"][0]
    return {name: _acts(value, trusted) for name, value in options.items()}


def _same_versions(place: EvaluationPlace, made: Mapping[str, Mapping[str, str]]) -> None:
    for engine, then in made.items():
        runner = EpisodeRunner(place.env(engine))
        now = versions(runner.env.world.engine)
        runner.close()
        differ = [
            f"{package} {then.get(package, 'none')} (here {now.get(package, 'none')})"
            for package in sorted(then.keys() | now.keys())
            if then.get(package) != now.get(package)
        ]
        if differ:
            raise SnapshotMismatch(
                f"it was made with {', '.join(differ)}; the same bits are promised for the same "
                "versions only: install those"
            )
