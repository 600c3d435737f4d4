"""Explanations: the score of an episode if one variable had had another value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of, typed
from scm_world._types import Observation, Value
from scm_world.curricula import Curriculum, Situation, follow
from scm_world.env import ScmWorldEnv
from scm_world.errors import EvaluationError, SnapshotMismatch, UnknownOption
from scm_world.evaluation.episodes import Hook, drawn_columns, scored_episode
from scm_world.evaluation.preparation import again
from scm_world.evaluation.protocols import Protocol
from scm_world.evaluation.results import Evaluation
from scm_world.queries.progress import Progress
from scm_world.tasks import AnySource
from scm_world.variables import Draw, Hard
from scm_world.world import Simulation
from scm_world.world.compiled_task import beginning

VERSUS = ("A", "default")

Drawn = dict[str, tuple[float, ...]]
"""Values that were drawn in an episode, by variable."""


def _drawn(row: Mapping[str, Any]) -> Drawn:
    return {name: tuple(row[one] for one in labels) for name, labels in drawn_columns(row).items()}


def _instead(
    of: Curriculum, name: str, versus: str, found: set[str], usual: Mapping[str, Value]
) -> Curriculum:
    """Return a part with an alternative for a variable; ``found`` gets its name once it is set.

    One that the part leaves to a draw of nature or of ``start`` gets its alternative at the reset:
    a draw from A, or the value that it has where nothing is drawn, from ``usual``.
    """

    def acts(situation: Situation) -> Mapping[str, Any]:
        plan = of.plan(situation)
        if name not in plan and name not in usual:
            return plan
        found.add(name)
        if name not in plan:
            return {**plan, name: [Draw("A") if versus == "A" else Hard(usual[name])]}
        rest = {other: acts for other, acts in plan.items() if other != name}
        if versus == "default":
            return rest
        streams = ((act.time, getattr(act, "stream", None)) for act in plan[name])
        return {**rest, name: [Draw("A", stream=one, time=time) for time, one in streams]}

    return follow(acts)


@final
@dataclass(frozen=True)
class Otherwise:
    """An episode in which one variable has another value.

    Attributes:
        variable: The variable that has another value.
        was: Its value in the episode.
        would_be: Its value in the alternative.
        score: Score of the episode.
        would_score: Score of the alternative.
        succeeded: Whether the episode succeeded, if the task defines success.
        would_succeed: Whether the alternative succeeds.
    """

    variable: str
    was: tuple[float, ...]
    would_be: tuple[float, ...]
    score: float
    would_score: float
    succeeded: bool | None
    would_succeed: bool | None

    @property
    def gain(self) -> float:
        """By how much the score would have been higher."""
        return self.would_score - self.score

    def __str__(self) -> str:
        success = "would have succeeded" if self.would_succeed else "would have failed"
        success += ", as it did" if self.would_succeed == self.succeeded else ""
        success = "would have scored" if self.would_succeed is None else success
        was, would_be = (_numbers(value) for value in (self.was, self.would_be))
        return (
            f"with {self.variable} = {would_be} instead of {was} it {success}: "
            f"{self.would_score:.3g} ({self.gain:+.3g})"
        )


@final
@dataclass(frozen=True)
class Explanation:
    """The alternatives of an episode, each with another value of one variable.

    Attributes:
        score: Score of the episode.
        others: For each variable that was varied, the best first.
        left_out: Variables that cannot change while the others stay, with the reason.
    """

    score: float
    others: tuple[Otherwise, ...]
    left_out: dict[str, str]

    def __str__(self) -> str:
        lines = [*map(str, self.others)]
        lines += [f"{name}: left out, {why}" for name, why in self.left_out.items()]
        return "\n".join(lines)


def _numbers(value: Sequence[float]) -> str:
    shown = [f"{number:.4g}" for number in value]
    return shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"


@final
class _Look(Hook):
    """Keeps the value of a variable at a control step."""

    def __init__(self, name: str, step: int) -> None:
        self.name, self.step = name, step
        self.seen: tuple[float, ...] = ()

    def begin(self, env: ScmWorldEnv, observation: Observation) -> None:
        """Read the value at the reset."""
        self._env = env
        self.after(observation, 0.0, {})

    def after(self, observation: Observation, reward: float, info: Mapping[str, Any]) -> bool:
        """Read the value after a control step."""
        world = self._env.world
        if world.index == self.step and self.name in world.model:
            self.seen = tuple(np.ravel(world[self.name]).astype(float).tolist())
        return False


@typed
def why(
    evaluation: Evaluation,
    protocol: str,
    episode: int,
    *,
    metric: str | None = None,
    versus: str | None = None,
    policy: object = None,
    task: AnySource | None = None,
    trusted: Sequence[str] = (),
    progress: Progress | None = None,
) -> Explanation:
    """Run an episode again for each variable that was drawn, with another value of it.

    The episode is run again with the same noise and the same policy, which acts on its new
    observations; all other variables keep the values that were drawn: by its protocol, by the
    ``start`` of the environment, or by nature, as the task declares it.

    Args:
        evaluation: Its table has the episode. Of several agents or backends one is chosen with
            ``evaluation.only(agent=…, engine=…)``. Of several runs or seeds the first one is taken.
        protocol: Name of the protocol.
        episode: Number of the episode.
        metric: Name of the score that is compared.
        versus: ``"A"``: the variable drawn from its training space; ``"default"``: left as it is
            without the protocol, or, where that leaves it alone, the value that it has where
            nothing is drawn. If None, A where it has that space and its value lies elsewhere.
        policy: The policy that was given to ``evaluate``; only needed in another process, for
            a policy without a file and without a name.
        task: Where, if it is a task of the user's own class: the task, or its class or function.
        trusted: Packages whose functions may be policies, or parts of protocols.
        progress: Called with how many variables are done.

    Raises:
        UnknownOption: The episode does not exist, nothing was varied in it, or several agents or
            backends have it.
        SnapshotMismatch: The rerun is not bit-identical.
        InexactEngine: Equal runs differ on its engine.
    """
    metric = evaluation.metric(metric)
    one = evaluation.only(protocol=protocol, episode=episode)
    agent, engine = one.the("agent", None), one.the("engine", None)
    run, seed = (int(one.frame[name][0]) for name in ("run", "seed"))
    one_of("versus", versus, (None, *VERSUS))
    setup = again(evaluation.only(agent=agent, engine=engine), policy, task, trusted)
    actor, done_there = setup.agents[agent, run], setup.protocols[protocol]
    draw, attempt = divmod(episode, done_there.repeats)
    if attempt and actor.keeps:
        allowed = (f"{episode - attempt}, the first of its draw: {agent!r} remembers the others",)
        raise UnknownOption("episode", episode, allowed)
    where: dict[str, Any] = {"seed": seed, "episode": episode, "who": (agent, run)}
    found, left_out = [], {}
    with closing(setup.env(engine, actor)) as env:
        env.world.require_exact("an explanation of an episode", independent=True)
        row = scored_episode(env, actor, done_there, **where)
        if row["hash"] != one.only(run=run, seed=seed).frame["hash"][0]:
            made = ", ".join(f"{n} {v}" for n, v in evaluation.about["versions"][engine].items())
            what = f"{protocol}, episode {episode} does not happen again"
            raise SnapshotMismatch(f"{what}; the evaluation was made with {made}")
        drawn = _drawn(row)
        if not drawn:
            allowed = ("an episode in which something is drawn",)
            raise UnknownOption("episode", f"{protocol}, {episode}", allowed)
        same = {"draws": draw} if done_there.repeats > 1 else {}
        env.reset(seed=seed, options={"episode": episode, **same})
        world = env.world
        here = world.values()  # without interventions of the protocol
        against = {name: versus or _versus(world, here, name, drawn) for name in drawn}
        natural = world.structures.natural(None)
        default = beginning(natural, None)
        begun = {name: act for _, acts in env.interventions for name, act in acts.items()}
        random = {*natural.random, *(n for n, act in begun.items() if getattr(act, "draws", False))}
        usual = {
            n: natural.coordinates(n, default) for n in drawn if n in random & {*natural.model}
        }
        for done, (name, how) in enumerate(against.items()):
            is_set: set[str] = set()
            part = _instead(done_there.curriculum(), name, how, is_set, usual)
            look = _Look(name, done_there.step)
            try:
                about = {"act": part, "repeats": done_there.repeats}
                instead = Protocol(f"{protocol} without {name}", **about)
                then = scored_episode(env, actor, instead, hooks=(look,), **where)
            except EvaluationError as error:
                left_out[name] = error.reason
            else:
                ends = (played.get("success") for played in (row, then))
                redrawn = _drawn(then)
                would = Otherwise(
                    name,
                    drawn[name],
                    redrawn.get(name, look.seen),
                    row[metric],
                    then[metric],
                    *(None if success is None else bool(success) for success in ends),
                )
                if reason := _no_answer(would, drawn, redrawn, is_set, env.world):
                    left_out[name] = reason
                else:
                    found.append(would)
            if progress is not None:
                progress(done + 1, len(drawn))
    best_first = tuple(sorted(found, key=lambda one: -one.gain))
    return Explanation(row[metric], best_first, left_out)


def _no_answer(
    one: Otherwise, drawn: Drawn, then: Drawn, found: set[str], world: Simulation
) -> str:
    """Return why an alternative says nothing about a variable; empty if it does."""
    name, model = one.variable, world.model
    if name not in found:
        return "the protocol does not set it"

    def follows(other: str) -> bool:
        """Return whether the spaces of another variable follow, as a height follows a size."""
        if other not in model or name not in model:
            return False
        variable, causes = model.declared(other), {name, *model.descendants(model.target(name))}
        if not variable.is_root and variable.own_noise:  # nature draws its noise alone
            return other in causes
        spaces = (space for space in (variable.a, variable.b) if space is not None)
        return any(not causes.isdisjoint(space.parents()) for space in spaces)

    changed = [n for n in then if n != name and then[n] != drawn.get(n) and not follows(n)]
    gone = [n for n in drawn if n != name and n not in then]
    if changed or gone:
        return f"{', '.join((*changed, *gone))} would have been drawn again with it"
    return "it would have been the same" if one.was == one.would_be else ""


def _versus(world: Simulation, usual: Mapping[str, Any], name: str, drawn: Drawn) -> str:
    """Choose the alternative of a variable: A, unless its value lies in A already."""
    model = world.model
    if name not in model:
        return "default"
    variable = model.declared(name)
    values = {n: model.declared(n).array(v) for n, v in drawn.items() if n in model}
    inside = variable.in_space(values[name], "A", {**usual, **values})
    return "default" if variable.a is None or inside else "A"
