"""Run an episode of an evaluation: an environment, a policy, a protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, final

import numpy as np

from scm_world.curricula import CurriculumEnv, Part
from scm_world.curricula.base import nested
from scm_world.env import ScmWorldEnv
from scm_world.errors import EvaluationError, ScmWorldError, UnknownOption, UnknownVariable
from scm_world.evaluation.players import Player
from scm_world.evaluation.protocols import Protocol
from scm_world.tasks.base import OVERLAP
from scm_world.tasks.rewards import FRACTION, SUCCESS, TERMINATED
from scm_world.variables import Null, Subset
from scm_world.variables.reserved import SENSOR_NOISE

LAST = 20
"""Control steps over which the end of an episode is averaged."""

FRACTIONS = (
    "last_fractional_success",
    "last_integrated_fractional_success",
    "full_integrated_fractional_success",
)
"""The published scores: at the end, over the last steps, over all steps."""

METRICS = (*FRACTIONS, "success", "return", "published_overlap")
"""What is measured of every episode, as far as the task says what success is. The last one is the
fractional success at the end as CausalWorld 1.2 computes it, of axis-aligned boxes."""

Watch = Callable[[ScmWorldEnv], Any]


@final
@dataclass(frozen=True)
class EpisodeRow:
    """What is kept of an episode.

    Attributes:
        agent: Name of the agent.
        run: Number of the training run of this agent.
        engine: Name of the physics engine.
        protocol: Name of the protocol.
        seed: Of the noise.
        episode: Its number within the noise.
        steps: How many control steps it had.
        scores: By those names of ``METRICS`` that the task has.
        drawn: The values of what was intervened on, by variable.
        hash: Sums up all states, parameters and actions, bit for bit.
    """

    agent: str
    run: int
    engine: str
    protocol: str
    seed: int
    episode: int
    steps: int
    scores: dict[str, float]
    drawn: dict[str, list[float]] = field(default_factory=dict)
    hash: str = ""


@final
class Fingerprint:
    """Sums up an episode, bit for bit.

    Args:
        env: At the beginning of the episode.
    """

    def __init__(self, env: ScmWorldEnv) -> None:
        self._world = env.world
        self._sum = blake2b(digest_size=16)
        self._version = -1
        self.look()

    def look(self) -> None:
        """Take in the state, and the parameters after an intervention."""
        world = self._world
        if world.version != self._version:
            self._version = world.version
            for name in world.static_names:
                self._sum.update(name.encode())
                self._sum.update(np.asarray(world.row[name]).tobytes())
        self._sum.update(world.vector.tobytes())

    def act(self, action: Any) -> None:
        """Take in an action."""
        self._sum.update(action.tobytes())

    def __str__(self) -> str:
        return self._sum.hexdigest()


def under(protocol: Protocol, env: ScmWorldEnv) -> CurriculumEnv:
    """Return an environment under a protocol.

    Raises:
        UnknownOption: It depends on what happened in other episodes, or acts after their end.
        EvaluationError: It names something that does not exist, or a region that is impossible.
    """
    if protocol.step >= env.world.max_episode_length:
        allowed = (f"control steps from 0 to {env.world.max_episode_length - 1}",)
        raise UnknownOption(f"step of protocol {protocol.name}", protocol.step, allowed)
    if any(part.kind == "stages" for part in nested(protocol.part, Part)):
        allowed = ("parts without stages: an episode must not depend on others",)
        raise UnknownOption(f"act of protocol {protocol.name}", "stages", allowed)
    try:
        found = CurriculumEnv(env, protocol.curriculum())
        if isinstance(protocol.space, Subset) and not env.world.structures.head:
            for pattern in protocol.space.unused(env.world.model):
                raise UnknownVariable(pattern, env.world.model)
    except ScmWorldError as error:
        place = {"protocol": protocol.name, "task": env.world.task.name}
        raise EvaluationError(place, str(error)) from error
    return found


@final
class EpisodeRunner:
    """Runs episodes in one environment.

    Args:
        env: It is reset again and again.
    """

    def __init__(self, env: ScmWorldEnv) -> None:
        self.env = env
        self._under: dict[str, tuple[Protocol, CurriculumEnv]] = {}

    def play(
        self,
        player: Player,
        protocol: Protocol,
        *,
        seed: int,
        episode: int,
        who: tuple[str, int] = ("", 0),
        watch: Watch | None = None,
    ) -> EpisodeRow:
        """Run an episode.

        Args:
            player: The policy.
            protocol: What is done.
            seed: Of the noise.
            episode: Its number within the noise.
            who: Name and number of the run, for the row.
            watch: Called before every control step and at the end.

        Raises:
            EvaluationError: The policy gave no action, or an intervention was refused; with the
                place.
        """
        env, engine = self.env, self.env.world.backend.name
        named = (who[0], engine, protocol.name, seed, episode)
        place = dict(zip(("agent", "engine", "protocol", "seed", "episode"), named, strict=True))
        with _placed(place, env):
            acting, observation = self.begin(protocol, seed=seed, episode=episode)
            drawn = _drawn(env, 0)
            player.begin(env)
            mark = Fingerprint(env)
            fractions: list[float] = []
            total, steps, over = 0.0, 0, False
            while not over:
                if watch is not None:
                    watch(env)
                action = player.act(observation).copy()  # a policy may return one array again
                mark.act(action)
                observation, reward, terminated, truncated, info = acting.step(action)
                over = terminated or truncated
                total += reward
                steps += 1
                if info.get(FRACTION) is not None:
                    fractions.append(info[FRACTION])
                if env.interventions[-1:] and env.interventions[-1][0] == env.world.index:
                    drawn |= _drawn(env, env.world.index)
                mark.look()
            if watch is not None:
                watch(env)
        scores = scored(fractions, success=info.get(SUCCESS), total=float(total))
        goal = env.world.task.goal
        if OVERLAP in goal.measures:
            vectors = goal.vectors(env.world.evaluate(()))
            scores[OVERLAP] = float(goal.measures[OVERLAP](*vectors))
        return EpisodeRow(
            *who, engine, protocol.name, seed, episode, steps, scores, drawn, str(mark)
        )

    def try_out(self, protocol: Protocol, *, seed: int) -> None:
        """Check that a protocol fits: begin the first episode with it.

        Raises:
            UnknownOption: It depends on what happened in other episodes, or acts after their end.
            EvaluationError: What it does is impossible, with the place.
        """
        self._env(protocol)
        place = {"engine": self.env.world.backend.name, "protocol": protocol.name}
        with _placed({**place, "seed": seed, "episode": 0}, self.env):
            self.begin(protocol, seed=seed, episode=0)

    def begin(self, protocol: Protocol, *, seed: int, episode: int) -> tuple[CurriculumEnv, Any]:
        """Begin an episode, with the interventions of a protocol at its reset.

        Returns:
            The environment under the protocol, and the observation.

        Raises:
            UnknownOption: The protocol does not fit; see ``under``.
            EvaluationError: It names something that does not exist, or a region that is
                impossible.
            InterventionError: An intervention was refused.
        """
        found = self._env(protocol)
        return found, found.reset(seed=seed, options={"episode": episode})[0]

    def _env(self, protocol: Protocol) -> CurriculumEnv:
        kept, found = self._under.get(protocol.name, (None, None))
        if found is None or kept != protocol:
            found = under(protocol, self.env)
            self._under[protocol.name] = protocol, found
        return found

    def close(self) -> None:
        """Free the engine."""
        self.env.close()


def unrelated(env: ScmWorldEnv, about: Mapping[str, Any]) -> tuple[str, ...]:
    """Name what cannot matter: no directed path leads from it to the score or the observation.

    Of pictures nothing is named, since everything counts that can be seen, nor for a function of
    the whole world, nor where a variable decides which bodies, and so which paths, there are.
    Named policies of this package read states.

    Args:
        env: Where a policy acts.
        about: Of its ``Player``.
    """
    if env.observed is None or about.get("sees") == "world" or len(env.world.structures.head):
        return ()
    model = env.world.model
    observed = env.observed
    if about["kind"] == "named":
        observed = tuple(name for name in model if model.declared(name).role == "state")
    scored_by = (FRACTION, SUCCESS, TERMINATED, "reward", SENSOR_NOISE)
    counted = {name for name in (*observed, *scored_by) if name in model}
    counted |= {cause for name in tuple(counted) for cause in model.ancestors(name)}
    settable = (name for name in model if model.declared(name).settable)
    return tuple(name for name in settable if counted.isdisjoint(model.targets(name)))


def scored(fractions: list[float], *, success: bool | None, total: float) -> dict[str, float]:
    """Compute the scores of an episode.

    Args:
        fractions: Fractional success after each control step; none if the task has no such thing.
        success: Whether it succeeded in the end; None if the task does not say so.
        total: Sum of the rewards.

    Returns:
        A number for each of ``METRICS`` that the task has, but for ``published_overlap``.

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


def _drawn(env: ScmWorldEnv, step: int) -> dict[str, list[float]]:
    """Read the values of what was intervened on at a control step."""
    asked: Mapping[str, Any] = {
        name: act
        for at, request in env.interventions
        if at == step
        for name, act in request.items()
    }
    names = tuple(
        name
        for name, act in asked.items()
        if not isinstance(act, Null)
        and name in env.world.model
        and name not in env.world.compiled.actions
    )
    now = env.world.evaluate(names) if names else {}
    return {name: np.ravel(now[name]).astype(float).tolist() for name in names}


@contextmanager
def _placed(place: dict[str, Any], env: ScmWorldEnv) -> Iterator[None]:
    """Add the episode to an error."""
    try:
        yield
    except EvaluationError as error:
        raise EvaluationError({**place, **error.place}, error.reason) from error
    except ScmWorldError as error:
        if env.world.index:
            place = {**place, "control step": env.world.index}
        raise EvaluationError(place, str(error)) from error
