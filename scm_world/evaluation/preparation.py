"""Preparing an evaluation: agents, their task and options, and the first try of everything.

A trained policy says with which options it was trained. Observations and the meaning of actions may
differ between agents of one evaluation: each acts in an environment of its own form, with the same
draws. The length of a control step and the conventions are shared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import gymnasium

from scm_world._arguments import one_of, true_or_false, whole_number
from scm_world._fingerprint import differing, fingerprint
from scm_world.backends import require_backend
from scm_world.env import ENV_OPTIONS
from scm_world.errors import (
    EvaluationError,
    ModelError,
    ScmWorldError,
    UnknownOption,
    in_one_line,
)
from scm_world.evaluation.episodes import placed, under, unrelated
from scm_world.evaluation.protocols import Protocol, chosen, named, protocols_of
from scm_world.evaluation.results import Evaluation
from scm_world.evaluation.setups import Setup, several
from scm_world.policies.agents import Agent, agent_from, as_agent
from scm_world.policies.cards import (
    ANY,
    COMMON,
    FORM,
    FREE,
    contradiction,
    option_form,
    usual,
)
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import FORMAT, Plan
from scm_world.tasks import AnySource, Task, make_task, tasks
from scm_world.tasks.sources import is_named, refuse_untrusted
from scm_world.variables import Draw, Intervention

_MINE = ("task", "backend", "render_mode")
"""Options of the environment that an evaluation sets by itself."""

TASK = "pushing"
"""The default task of agents that name none."""

Agents = Mapping[tuple[str, int], Agent]
"""Agents by name and training run."""


def prepare(
    policy: object,
    protocols: object,
    task: AnySource | None,
    n: int,
    seeds: object,
    backend: object,
    env: Mapping[str, Any] | None,
    trusted: Sequence[str] | None,
    repeats: int | None = None,
    steps: bool = False,
) -> Setup:
    """Check everything that can be checked before the first episode.

    The arguments are those of ``evaluate``.
    """
    agents = load_agents(policy, trusted)
    for (name, _), agent in agents.items():
        about = agent.about
        learned = str(about.get("path", "")).endswith(".zip") and "library" in about
        learned = learned or (hasattr(agent.policy, "predict") and "sha256" not in about)
        if learned and agent.card is None and not {*FORM} & {*(env or {})}:
            gymnasium.logger.warn(
                f"{name!r} does not say how it observes and acts; it acts here with the "
                "defaults of gymnasium.make, and recipes train with other actions: give "
                "as_agent(…, env={'action_mode': …}) as in its training, or a file that export_sb3 "
                "has written"
            )
    task = task_for(_made(task), agents, trusted or ())
    for name in env or {}:
        allowed = [name for name in ENV_OPTIONS if name not in _MINE]
        one_of("option of the environment", name, allowed)
    if backend is None:
        given = (env or {}).get("task_options") or {}
        backend = (task if isinstance(task, Task) else make_task(task, **given)).backend
    engines = several("backend", backend)
    for engine in engines:
        require_backend(engine)
    texts = several("seeds", seeds)
    numbers = (int(s) if isinstance(s, str) and s.isdecimal() else s for s in texts)
    noises = tuple(whole_number("seed", one, least=0, most=2**63 - 1) for one in numbers)
    count = whole_number("n", n, least=1)
    place = Setup(task, shared_options(env, agents), agents, engines, {}, noises, count)
    wanted = {one.name: one for one in chosen(protocols, protocols_of(place.made, engines[0]))}
    if repeats is not None:
        same = {"repeats": whole_number("repeats", repeats, least=1)}
        wanted = {name: one.model_copy(update=same) for name, one in wanted.items()}
    for one in wanted.values():
        if count % one.repeats:
            multiple = f"a multiple of {one.repeats}, the repeats of each draw of {one.name}"
            raise UnknownOption("n", count, (multiple,))
    found: dict[str, dict[str, str]] = {}
    silent: dict[str, tuple[str, ...]] = {}
    for engine in engines:
        with closing(place.env(engine)) as shared:
            for protocol in wanted.values():
                begun = {"engine": engine, "protocol": protocol.name, "seed": noises[0]}
                with placed({**begun, "episode": 0}, shared):
                    under(shared, protocol).reset(seed=noises[0], options={"episode": 0})
            found[engine] = versions(shared.world.engine)
            for (name, run), agent in agents.items() if engine == engines[0] else ():
                own = shared if agent.card is None else place.env(engine, agent)
                try:
                    observation, _ = own.reset(seed=0)
                    agent.forget()
                    agent.start(own)
                    agent.act(observation)
                    if "sha256" not in agent.about and agent.about.get("kind") != "named":
                        agent.about |= {"fingerprint": fingerprint({"policy": agent.policy})}
                    silent[name] = unrelated(own, agent.about, wanted.values())
                except ScmWorldError as error:
                    raise EvaluationError({"agent": name, "run": run}, str(error)) from error
                finally:
                    if own is not shared:
                        own.close()
    kept = found, silent, true_or_false("steps", steps)
    setup = Setup(task, place.options, agents, engines, wanted, noises, count, *kept)
    setup.about()  # refuses an environment that cannot be written down, before any episode
    return setup


# --- agents ---------------------------------------------------------------------------------------


def load_agents(policy: object, trusted: Sequence[str] | None) -> dict[tuple[str, int], Agent]:
    """Load the agents by name and training run; they are not tried out yet.

    An agent without a name has the last part of a path or of a module, as it can stand in a table.
    """
    found: dict[tuple[str, int], Agent] = {}
    for given, run, one in listed(policy):
        agent = as_agent(one, trusted=trusted)
        last = str(agent.about["name"]).replace("\\", "/").rstrip("/").rpartition("/")[2]
        name = last.rpartition(":")[2].replace(",", " ").strip() or "policy"
        if given is not None:
            name = given
        elif found:  # a list is one agent
            name = next(iter(found))[0]
        found[named("name of an agent", name), run] = agent
    if not found:
        raise UnknownOption("policy", policy, ("one or several",))
    return found


def listed(policy: object) -> Iterator[tuple[str | None, int, Any]]:
    """List policies with agent and training run; the agent is None if it was not named."""
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


# --- tasks and options ----------------------------------------------------------------------------


def task_of(policy: object, trusted: Sequence[str] | None = None) -> str:
    """Return the name of the default task of policies; arguments as in ``prepare``."""
    return str(task_for(None, load_agents(policy, trusted), trusted or ()))


def _made(task: AnySource) -> Task | str | None:
    """Return a name unchanged, and the task of any other source."""
    return task if task is None or isinstance(task, str) else make_task(task)


def task_for(task: Task | str | None, agents: Agents, trusted: Sequence[str] = ()) -> Task | str:
    """Choose the task: the one that is given, else the one that the agents were trained for.

    Warn of an agent that was trained for another task than the one that is given.
    """
    every = {name: agent.card for (name, _), agent in agents.items() if agent.card is not None}
    cards = {name: card for name, card in every.items() if card.task != ANY}
    if task is not None:
        given = task if isinstance(task, str) else task.name
        for name, card in cards.items():
            if card.task != given:
                gymnasium.logger.warn(
                    f"{name!r} was trained for the task {card.task!r}, and acts in {given!r}"
                )
        return task
    trained = list(dict.fromkeys(card.task for card in cards.values()))
    if len(trained) > 1:
        raise UnknownOption("task", None, [f"{one!r}" for one in trained])
    for one in trained:
        refuse_untrusted(one, trusted)
    return trained[0] if trained else TASK


def shared_options(given: Mapping[str, Any] | None, agents: Agents) -> dict[str, Any]:
    """Choose the options of the environment that are shared by all agents.

    Options of the user come first; among them those of ``FORM`` are for agents without a
    description of their training.
    """
    found = dict(given or {})
    trained = [(name, agent.card) for (name, _), agent in agents.items() if agent.card is not None]
    all_say = bool(trained) and len(trained) == len(agents)
    for option in (*FORM, *COMMON) if all_say else COMMON:
        for name, card in trained:
            wanted = card.option(option)
            if (
                option in found
                and wanted is not None
                and option_form(option, found[option]) != wanted
            ):
                raise contradiction(option, found[option], wanted, name)
    if all_say:
        found = {option: value for option, value in found.items() if option not in FORM}
    for option in (name for name in (*COMMON, *FREE) if name not in found):
        say = [(n, card) for n, card in trained if card.task != ANY or option in card.env]
        options = [card.option(option) for _, card in say]
        if any(one != options[0] for one in options):
            each = "; ".join(f"{name} with {card.option(option)!r}" for name, card in say)
            allowed = f"the same for all agents, and they were trained {each}: "
            allowed += "evaluate them apart" if option in COMMON else f"give {option} in env"
            raise UnknownOption(option, "several values", (allowed,))
        if options and options[0] != usual(option, say[0][1].task):
            found[option] = options[0]
    return found


# --- an evaluation that was run -------------------------------------------------------------------


def again(
    evaluation: Evaluation,
    policy: object = None,
    task: AnySource | None = None,
    trusted: Sequence[str] = (),
) -> Setup:
    """Prepare to run episodes of an evaluation again: the agents and backends of its table.

    Without a policy it is the one that was given in this process, or one made again from its
    description. The other arguments are those of ``why``.
    """
    about = evaluation.about
    try:
        options = _acts(about["env"], trusted)
        task = evaluation.made if task is None else _made(task)
        if task is None:
            task = text = str(about["task"])
            refuse_untrusted(text, None if evaluation.policies else trusted)
            if not is_named(text):
                raise UnknownOption("task", text, (*tasks(), "one of your own, if given: task="))
            if about["arguments"]:
                options["task_options"] = about["arguments"]
        protocols = [Protocol.from_dict(one, trusted=trusted) for one in about["protocols"]]
        setup = Setup(
            task,
            options,
            dict(_acted(evaluation, policy, trusted)),
            evaluation.engines,
            {one.name: one for one in protocols},
            tuple(about["seeds"]),
            about["n"],
            about["versions"],
        )
        now = setup.made.__fingerprint__()
        there = {name: part for name, part in about["fingerprint"].items() if name in now}
        if parts := differing(there, fingerprint(now, libraries=False)):
            advice = f"the one that was evaluated, given as task=: {', '.join(parts)} differ"
            raise UnknownOption("task", setup.place["task"], (advice,))
        return setup
    except Exception as error:
        if isinstance(error, ScmWorldError):
            raise
        problem = f"the description of the evaluation cannot be used: {in_one_line(error)}"
        raise ModelError([problem]) from error


def _acted(
    evaluation: Evaluation, policy: object, trusted: Sequence[str]
) -> Iterator[tuple[tuple[str, int], Agent]]:
    """Find who acted: the policy given now, one in a file, one given then, or one by its name."""
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
        if who[0] not in evaluation.agents:
            continue
        what = one["policy"]
        if who in given:
            yield who, as_agent(given[who])
        elif who in evaluation.policies and "path" not in what:
            yield who, as_agent(evaluation.policies[who], env=one.get("env"))
        else:
            yield who, agent_from(what, trusted=trusted, env=one.get("env"))


def _acts(options: object, trusted: Sequence[str]) -> Any:
    """Read the interventions and spaces among the options of an environment, as written down."""
    if not isinstance(options, Mapping):
        return options
    if isinstance(kind := options.get("kind"), str):
        if kind not in Intervention.kinds:
            return Draw(options).source
        data = {"format": FORMAT, "do": {"option": [options]}}
        return Plan.from_dict(data, trusted=trusted)["option"][0]
    return {name: _acts(value, trusted) for name, value in options.items()}
