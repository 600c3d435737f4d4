"""Episodes: one loop of an environment with an agent, its hooks, and the scores of an episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from typing import Any, final

import gymnasium
import networkx as nx
import numpy as np

from scm_world._arguments import typed
from scm_world._types import Floats, Observation
from scm_world.curricula import CurriculumEnv
from scm_world.env import ScmWorldEnv
from scm_world.env.environment import FIRST, unwrapped_env
from scm_world.env.observer import FAILED
from scm_world.errors import (
    ActionError,
    EvaluationError,
    ScmWorldError,
    UnknownOption,
    UnknownVariable,
)
from scm_world.evaluation.protocols import Protocol
from scm_world.policies.agents import Actions, Agent, as_agent
from scm_world.policies.cards import FORM
from scm_world.policies.scripted import Policy
from scm_world.queries.world import World
from scm_world.tasks.base import OVERLAP
from scm_world.tasks.rewards import FRACTION, SUCCESS, TERMINATED
from scm_world.variables import Subset
from scm_world.variables.reserved import SENSOR_NOISE

LAST = 20
"""Control steps over which the end of an episode is averaged."""

FRACTIONS = (
    "last_fractional_success",
    "last_integrated_fractional_success",
    "full_integrated_fractional_success",
)
"""The published scores: at the end, over the last steps, over all steps."""

METRICS = (*FRACTIONS, "success", "return", "published_overlap", FAILED)
"""The scores of an episode, as far as the task defines success. ``published_overlap`` is the
fractional success at the end as CausalWorld 1.2 computes it, of axis-aligned boxes; ``failed``,
with ``on_failure="truncate"``, whether the engine could not go on."""


# --- the loop -------------------------------------------------------------------------------------


class Hook:
    """Follows an episode of ``play``; a subclass defines the methods that it needs."""

    def begin(self, env: ScmWorldEnv, observation: Observation) -> None:
        """Observe the beginning of an episode, after the interventions of its reset."""

    def choose(self, observation: Observation, action: Actions) -> Actions:
        """Return the action that is played, before every control step."""
        return action

    def after(self, observation: Observation, reward: float, info: Mapping[str, Any]) -> bool:
        """Observe a control step; return whether the episode ends here."""
        return False


@typed
def play(
    env: gymnasium.Env[Any, Any],
    agent: object,
    plan: Mapping[str, Any] | None = None,
    hooks: Sequence[Hook] = (),
    *,
    seed: int | None = None,
    episode: int | None = None,
    draws: int | None = None,
) -> dict[str, Any]:
    """Run an episode of an environment with an agent; return the info of its end.

    Args:
        env: An environment of this package, in any wrappers.
        agent: An ``Agent``, or an object with its methods ``start`` and ``act``.
        plan: Interventions of the episode, as in ``options["do"]`` of ``reset``.
        hooks: They follow the episode in this order.
        seed: Seed of the noise; the present noise if None.
        episode: Number of the episode within the noise; the next one if None.
        draws: Number of the episode whose draws hold; its own if None. See ``World.reset``.

    Example:
        >>> env = gymnasium.make("scm_world/Pushing-v0", backend="fake", max_episode_length=3)
        >>> info = play(env, as_agent("random"), {"tool_block.mass": 0.03}, seed=0)
        >>> round(env.unwrapped.world["tool_block.mass"].item(), 3)
        0.03
    """
    if not (hasattr(agent, "start") and hasattr(agent, "act")):
        raise UnknownOption("agent", agent, ("as_agent(policy)", "an object with start and act"))
    given: dict[str, Any] = {} if plan is None else {"do": plan}
    numbers = {"episode": episode, "draws": draws}
    given |= {name: number for name, number in numbers.items() if number is not None}
    observation, info = env.reset(seed=seed, options=given)
    inner = unwrapped_env(env, "play")
    agent.start(inner)
    for hook in hooks:
        hook.begin(inner, observation)
    over = False
    while not over:
        action = agent.act(observation)
        for hook in hooks:
            action = hook.choose(observation, action)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        for hook in hooks:
            over |= hook.after(observation, float(reward), info)
    return info


# --- scores ---------------------------------------------------------------------------------------


KEYS = ("agent", "run", "engine", "protocol", "seed", "episode")
"""The columns that say which episode a row of an evaluation is of."""

DRAWN = "drawn "
"""First word of the columns with the values that were drawn."""

REWARDS = "rewards"
"""Entry of a row with the reward of each control step, if these are kept."""

Row = dict[str, Any]
"""An episode in the table of an evaluation, by column: ``KEYS``, ``steps``, those of ``METRICS``
that the task has, ``hash``, and each number of each variable that was drawn."""


def drawn_columns(columns: Iterable[Any]) -> dict[str, list[str]]:
    """Return the columns with the drawn values of each variable."""
    found: dict[str, list[str]] = {}
    for label in map(str, columns):
        if label.startswith(DRAWN):
            found.setdefault(label.removeprefix(DRAWN).partition("[")[0], []).append(label)
    return found


@final
class ScoreHook(Hook):
    """Measures an episode: its scores, the values that were drawn, and a digest of all of it."""

    def begin(self, env: ScmWorldEnv, observation: Observation) -> None:
        """Begin to measure."""
        self._env, self.digest, self._version = env, blake2b(digest_size=16), -1
        self._fractions: list[float] = []
        self.rewards: list[float] = []
        self._total, self.steps = 0.0, 0
        self.drawn = self._values(0)
        self._look()

    def choose(self, observation: Observation, action: Actions) -> Actions:
        """Keep the action: a policy may return one array again."""
        kept = action.copy()
        self.digest.update(kept.tobytes())
        return kept

    def after(self, observation: Observation, reward: float, info: Mapping[str, Any]) -> bool:
        """Measure a control step."""
        self._total += reward
        self.rewards.append(reward)
        self.steps += 1
        if info.get(FRACTION) is not None:
            self._fractions.append(info[FRACTION])
        done, index = self._env.interventions, self._env.world.index
        if done and done[-1][0] == index:
            self.drawn |= self._values(index)
        self._success, self._failed = info.get(SUCCESS), info.get(FAILED)
        self._look()
        return False

    def scores(self) -> dict[str, float]:
        """Return the scores of the episode."""
        found = scored(self._fractions, success=self._success, total=self._total)
        goal = self._env.world.task.goal
        if OVERLAP in goal.measures:
            vectors = goal.vectors(self._env.world.evaluate(()))
            found[OVERLAP] = float(goal.measures[OVERLAP](*vectors))
        return found if self._failed is None else {**found, FAILED: float(self._failed)}

    def _look(self) -> None:
        """Take in the state, and the parameters after an intervention."""
        world = self._env.world
        if world.version != self._version:
            self._version = world.version
            for name in world.static_names:
                self.digest.update(name.encode())
                self.digest.update(np.asarray(world.row[name]).tobytes())
        self.digest.update(world.vector.tobytes())

    def _values(self, step: int) -> dict[str, list[float]]:
        """Read the values that were drawn, or set by an intervention, at a control step."""
        world = self._env.world
        nature = world.compiled.random if step == 0 else ()
        asked: Mapping[str, Any] = {
            name: act
            for at, request in self._env.interventions
            if at == step
            for name, act in request.items()
        }
        names = tuple(
            name
            for name in dict.fromkeys((*nature, *asked))
            if not getattr(asked.get(name), "removes", False)
            and name in world.model
            and name not in world.compiled.actions
        )
        now = world.evaluate(names) if names else {}
        return {name: np.ravel(now[name]).astype(float).tolist() for name in names}


def scored(fractions: list[float], *, success: bool | None, total: float) -> dict[str, float]:
    """Compute the scores of an episode.

    Args:
        fractions: Fractional success after each control step; none if the task has no such thing.
        success: Whether it succeeded in the end; None if the task does not say so.
        total: Sum of the rewards.

    Returns:
        A number for each of ``METRICS`` that the task has, but for the last two.

    Example:
        >>> found = scored([0.0, 0.5, 1.0], success=True, total=2.5)
        >>> [found[name] for name in (*FRACTIONS, "success", "return")]
        [1.0, 0.5, 0.5, 1.0, 2.5]

    Source:
        CausalWorld 1.2, ``metrics``: full, last integrated and last fractional success. There the
        second one is the mean of the first step and the last nineteen.
    """
    found = {}
    if fractions:
        ends = fractions[-LAST:]
        values = fractions[-1], sum(ends) / len(ends), sum(fractions) / len(fractions)
        found = dict(zip(FRACTIONS, values, strict=True))
    if success is not None:
        found["success"] = float(success)
    return {**found, "return": total}


# --- episodes under a protocol --------------------------------------------------------------------


def scored_episode(
    env: ScmWorldEnv,
    agent: object,
    protocol: Protocol,
    *,
    seed: int,
    episode: int,
    who: tuple[str, int] = ("", 0),
    hooks: Sequence[Hook] = (),
    steps: bool = False,
) -> Row:
    """Run an episode under a protocol, and return its row, also with ``REWARDS`` if asked.

    ``who`` is the agent's name and the number of its run. An agent that remembers forgets before
    the first episode of each draw.
    """
    measured, engine = ScoreHook(), env.world.engine_name
    place = dict(zip(KEYS, (*who, engine, protocol.name, seed, episode), strict=True))
    with placed(place, env):
        acting = under(env, protocol)
        draw, attempt = divmod(episode, protocol.repeats)
        if not attempt and isinstance(agent, Agent):
            agent.forget()
        draws = draw if protocol.repeats > 1 else None
        every = (*hooks, measured)
        play(acting, agent, hooks=every, seed=seed, episode=episode, draws=draws)
    drawn = {
        f"{DRAWN}{name}" + (f"[{k}]" if len(values) > 1 else ""): value
        for name, values in measured.drawn.items()
        for k, value in enumerate(values)
    }
    row = {**place, "steps": measured.steps, **measured.scores()}
    row |= {REWARDS: measured.rewards} if steps else {}
    return {**row, "hash": measured.digest.hexdigest(), **drawn}


def under(env: ScmWorldEnv, protocol: Protocol) -> CurriculumEnv:
    """Return an environment under a protocol; check that it fits."""
    world, curriculum = env.world, protocol.curriculum()
    if protocol.step >= world.max_episode_length:
        allowed = (f"control steps from 0 to {world.max_episode_length - 1}",)
        raise UnknownOption(f"step of protocol {protocol.name}", protocol.step, allowed)
    if any(part.kind == "stages" for part in curriculum.parts()):
        allowed = ("parts without stages: an episode must not depend on others",)
        raise UnknownOption(f"act of protocol {protocol.name}", "stages", allowed)
    try:
        found = CurriculumEnv(env, curriculum)
        if isinstance(protocol.space, Subset) and not world.structures.head:
            for pattern in protocol.space.unused(world.model):
                raise UnknownVariable(pattern, world.model)
    except ScmWorldError as error:
        place = {"protocol": protocol.name, "task": world.task.name}
        raise EvaluationError(place, str(error)) from error
    return found


@contextmanager
def placed(place: dict[str, Any], env: ScmWorldEnv) -> Iterator[None]:
    """Add the episode to an error."""
    try:
        yield
    except EvaluationError as error:
        raise EvaluationError({**place, **error.place}, error.reason) from error
    except ScmWorldError as error:
        if env.world.index:
            place = {**place, "control step": env.world.index}
        raise EvaluationError(place, str(error)) from error


def unrelated(
    env: ScmWorldEnv, about: Mapping[str, Any], protocols: Iterable[Protocol] = ()
) -> tuple[str, ...]:
    """Name the variables without a directed path to the score or the observation.

    Of pictures nothing is named, since everything counts that can be seen, nor for a function of
    the whole world, nor where a variable decides which bodies, and so which paths, there are, nor
    where a function decides what a protocol does. Named policies of this package read states.

    Args:
        env: Where a policy acts.
        about: Description of its ``Agent``.
        protocols: Their mechanisms count as paths.
    """
    parts = [part for protocol in protocols for part in protocol.curriculum().parts()]
    if env.observed is None or about.get("sees") == "world" or len(env.world.structures.head):
        return ()
    if any(part.kind == "follow" for part in parts):
        return ()
    model = env.world.model
    graph = model.structure.graph.copy()
    for part in parts:
        for name, acts in model.named(getattr(part, "request", {})).items():
            asked = model.declared(name)
            causes = {p.name for act in acts for p in act.follows(asked)}
            graph.add_edges_from((c, target) for c in causes for target in model.targets(name))
    observed = env.observed
    if about["kind"] == "named":
        observed = tuple(name for name in model if model.declared(name).role == "state")
    scored_by = (FRACTION, SUCCESS, TERMINATED, "reward", SENSOR_NOISE)
    counted = {name for name in (*observed, *scored_by) if name in model}
    counted = counted.union(*(nx.ancestors(graph, name) for name in counted))
    settable = (name for name in model if model.declared(name).settable)
    return tuple(name for name in settable if counted.isdisjoint(model.targets(name)))


# --- agents in worlds -----------------------------------------------------------------------------


@typed
def in_world(policy: object, world: World) -> Policy:
    """Return a policy of observations as one of a world, for ``rollout`` and ``live``.

    It gets the observations of an environment, and its actions are converted to commands.

    Args:
        policy: As in ``as_agent``; one that says how it was trained gets such observations.
        world: In which it acts, or one like it.

    Raises:
        UnknownOption: The policy is unknown, or was trained with other options.
        SnapshotMismatch: When it acts: that world has another task or other options.
        ActionError: When it acts: it has a memory or observes a history, and this is not the
            control step after the last one, as in a branch of an episode.

    Example:
        >>> from scm_world.queries import World
        >>> world = World("pushing", backend="fake")
        >>> world.rollout(in_world("zoo:pushing", world), steps=2).actions.shape
        (2, 9)
    """
    agent = as_agent(policy)
    options = {} if agent.card is None else agent.card.unusual(FORM)
    env = ScmWorldEnv(
        world.structures.task,
        backend=world.engine_name,
        preset=world.options.preset,
        resolution=world.options.resolution,
        frame_skip=world.options.frame_skip,
        max_episode_length=world.options.given_length,
        conventions=world.options.conventions.name,
        **options,
    )
    history = env.history

    def require_one_world(does: bool) -> None:
        if not does:
            problem = "a policy with a memory acts from the first control step on, in one world"
            raise ActionError(f"{problem}; make one for each branch, and begin at step 0", None)

    last, action, sent = (-1, -1, -1), np.empty(0), np.empty(0)

    def act(now: World) -> Floats:
        nonlocal last, action, sent
        present = now.noise.seed, now.episode, now.index
        goes_on = now.index == 0 or present == (*last[:2], last[2] + 1)
        require_one_world(goes_on or (history is None and not agent.remembers))
        if history is not None and now.index > 0:  # somebody else may have decided
            played = now.row.actions
            taken = action if np.array_equal(played, sent) else env.actions.toward(played)
            history.push(FIRST, env.actions.in_space(np.ravel(taken)))
        env.world.restore(now.snapshot())
        if now.index == 0 or present[:2] != last[:2]:
            if history is not None:
                history.rows[:] = 0.0
            agent.start(env)
        last = present
        action = agent.act(env.observe())
        require_one_world(goes_on or not agent.remembers)
        sent = env.actions.command(action)
        return sent

    return act
