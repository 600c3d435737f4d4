"""A lesson says what is shown to a network, and how the network learns it: a value, with JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Annotated, Any, final

from pydantic import Field, ValidationError, field_validator

from scm_world.errors import UnknownOption
from scm_world.evaluation.benchmark import protocols_of
from scm_world.evaluation.policies.cards import OPTIONS
from scm_world.evaluation.protocols import Protocol, chosen
from scm_world.queries.policies import NAMED
from scm_world.training.settings import (
    Count,
    Network,
    NotNegative,
    Observations,
    Positive,
    Share,
    TaskName,
    Trials,
    merged,
    nested,
    refused,
    seen,
)
from scm_world.training.tuned import ENV, LESSONS
from scm_world.variables.spaces import Frozen

FORMAT = "scm_world/lesson/1"


@final
class Lesson(Frozen):
    """How a network learns from a teacher.

    Attributes:
        task: Name of the task.
        teacher: Name of a policy that looks at the world.
        env: Options of the environment, those that a policy file keeps.
        protocols: Names of what varies while the teacher shows something, in turns.
        episodes: Which the teacher plays alone.
        rounds: How often the network is let play along afterwards, and learns anew.
        more: Episodes of each of these rounds.
        noise: Largest standard deviation of what is added to actions, in units of actions; each
            episode has one between 0 and that.
        share: Of the control steps in which the network acts in those rounds, on average.
        stretch: Control steps that it acts at a stretch, on average.
        keep: Fractional success of an episode, in the end, that is learned from.
        observations: Of the network: ``"plain"``, or ``"privileged"``: with every causal parameter.
        network: What learns.
        updates: Steps of the optimizer, each time.
        batch: Control steps that each of them sees.
        rate: Of learning at the beginning; it falls as a cosine.
        trials: Evaluations after each round; the best policy is kept.

    Source:
        Noise: Laskey et al., *DART*, CoRL 2017. Rounds: Ross et al., *DAgger*, AISTATS 2011; here
        the network acts in short stretches, since a teacher that has a plan is only right about
        what is not far from it.
    """

    task: TaskName
    teacher: str = "grasp"
    env: dict[str, Any] = Field(default_factory=lambda: dict(ENV))
    protocols: Annotated[tuple[str, ...], Field(min_length=1)] = ("P0", "P1", "P5")
    episodes: Count = 250
    rounds: Annotated[int, Field(ge=0)] = 1
    more: Count = 100
    noise: NotNegative = 0.04
    share: Annotated[float, Field(ge=0.0, le=0.5)] = 0.3
    stretch: Annotated[float, Field(ge=1.0, allow_inf_nan=False)] = 10.0
    keep: Share = 0.9
    observations: Observations = "plain"
    network: Network = Field(default_factory=lambda: Network(activation="relu"))
    updates: Count = 20_000
    batch: Count = 512
    rate: Positive = 1e-3
    trials: Trials = Field(default_factory=lambda: Trials(protocols=("P1", "P5")))

    @field_validator("teacher")
    @classmethod
    def _named(cls, teacher: str) -> str:
        if teacher not in NAMED:
            raise UnknownOption("teacher", teacher, (*NAMED, "a recording"))
        return teacher

    @field_validator("env")
    @classmethod
    def _of_a_policy(cls, env: dict[str, Any]) -> dict[str, Any]:
        for name, value in env.items():
            if name not in OPTIONS:
                raise UnknownOption("option of the environment of a lesson", name, OPTIONS)
            _refuse_others(name, value)
        return env

    @property
    def options(self) -> dict[str, Any]:
        """Options of the environment, with all that follows from the other fields."""
        return seen(self.env, self.observations)

    def about(self) -> dict[str, Any]:
        """Write it as plain data."""
        return {"format": FORMAT, **self.model_dump(mode="json")}

    def taught(self) -> tuple[Protocol, ...]:
        """Give what varies while the teacher shows something.

        Raises:
            UnknownOption: The task has no such protocol.
        """
        return chosen(self.protocols, protocols_of(self.task))


_ONLY: Mapping[str, tuple[Any, ...]] = {
    "normalize_actions": (True,),
    "observation_mode": ("structured", "full", "custom"),
    "context": ("none", "observation"),
    "goal_env": (False,),
}


def _refuse_others(name: str, value: Any) -> None:
    """Refuse what is no vector of numbers, or actions that are not in [-1, 1]."""
    if name in _ONLY and value not in _ONLY[name]:
        raise UnknownOption(f"{name} of a lesson", value, [json.dumps(one) for one in _ONLY[name]])


def lesson(task: str, **changes: Any) -> Lesson:
    """Make a lesson.

    Args:
        task: Name of the task.
        changes: Fields of the ``Lesson``. Those that have parts (``env``, ``network``,
            ``trials``) change the parts that are named; ``a.b`` names a part of ``a``.

    Raises:
        UnknownOption: There is no such field, or a value is impossible.

    Example:
        >>> lesson("picking", episodes=10, env={"frame_skip": 5}).env["frame_skip"]
        5
        >>> lesson("picking", **{"trials.episodes": 40}).trials.episodes
        40
    """
    fields: dict[str, Any] = Lesson.model_construct(task=task).model_dump(mode="json")
    fields |= LESSONS.get(task, {})
    for name, value in changes.items():
        first, part = nested(name, value)
        if first not in Lesson.model_fields:
            raise UnknownOption("field of a lesson", name, Lesson.model_fields)
        fields[first] = merged(fields[first], part)
    try:
        made = Lesson.model_validate(fields)
    except ValidationError as error:
        raise refused("a lesson", error) from None
    made.taught()
    chosen(made.trials.protocols or ("P0",), protocols_of(task))
    return made
