"""What a crew that computes for all environments at once has to know of one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

from scm_world._types import Floats
from scm_world.env.delta import Delta
from scm_world.env.environment import ScmWorldEnv
from scm_world.env.goals import Goals
from scm_world.env.keypoints import KEYPOINTS
from scm_world.env.observer import Together
from scm_world.env.vector import Vector


@final
@dataclass(frozen=True)
class Inside:
    """How an environment turns actions into commands, and values into what it returns.

    Attributes:
        needed: Variables that have to be computed.
        middle: The command that an action of 0 stands for, shape (n_actions,).
        half: What an action of 1 adds to it, shape (n_actions,).
        delta: What makes actions relative, if they are.
        vectors: Observations that are vectors of variables, by name; None is the whole.
        is_partial: Whether something else is observed, or told in ``info``.
        shows_goals: Whether goals are part of the observation.
        goals: What is achieved and desired, if the task has goals.
        terms: Names of the reward terms.
        scale: What rewards are multiplied by.
        limit: Control steps of an episode.
    """

    needed: tuple[str, ...]
    middle: Floats
    half: Floats
    delta: Delta | None
    vectors: dict[str | None, Vector]
    is_partial: bool
    shows_goals: bool
    goals: Goals | None
    terms: tuple[str, ...]
    scale: float
    limit: int

    @classmethod
    def of(cls, env: ScmWorldEnv) -> Inside:
        """Look into an environment, as it is in its present structure."""
        seen: Any = env._observer
        together = isinstance(seen, Together)
        parts: dict[str | None, Any] = dict(seen._parts) if together else {None: seen}
        vectors = {name: part for name, part in parts.items() if isinstance(part, Vector)}
        plain = {name: part for name, part in vectors.items() if KEYPOINTS not in part._slices}
        return cls(
            env._needed,
            env._middle,
            env._half,
            env._delta,
            plain,
            len(plain) < len(parts) or any(env._rich),
            together and seen._goals is not None,
            env._goals,
            env._terms,
            env._scale,
            env.limit,
        )
