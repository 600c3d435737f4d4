"""A recipe says how an agent is trained: immutable and JSON-serialisable."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast, final

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from scm_world._arguments import one_of
from scm_world.backends import make_backend
from scm_world.curricula import Curriculum, everything, goals
from scm_world.curricula.curriculum import Part, as_curriculum
from scm_world.env import ENV_OPTIONS
from scm_world.errors import UnknownOption, reading
from scm_world.evaluation.protocols import chosen, protocols_of
from scm_world.runs.files import read_text
from scm_world.tasks import TASKS, Task, make_task
from scm_world.tasks.sources import refuse_untrusted
from scm_world.training.settings import (
    ALGORITHMS,
    Count,
    Hindsight,
    Network,
    Observations,
    OffPolicy,
    Ppo,
    Rate,
    TaskName,
    Trials,
    built,
    known_task,
    observed,
    tuned,
)
from scm_world.variables.spaces import Frozen

FORMAT = "scm_world/recipe/1"

PUBLISHED = {"0": as_curriculum(None), "1": goals("A"), "2": everything("A")}
"""The published curricula: nothing varies, goals, everything."""

RESERVED = ("task", "backend", "render_mode", "normalize_actions")
"""Options of the environment that a recipe does not set."""

REWARDS = (
    "terms",
    "weights",
    "fractional_reward_weight",
    "dense_reward_weights",
    "activate_sparse_reward",
)
"""Options of tasks that define the reward."""


@final
class Recipe(Frozen):
    """How an agent is trained.

    Attributes:
        task: Name of the task; a file, or ``"module:function"``, for one of a model.
        algo: ``"ppo"``, ``"sac"`` or ``"td3"`` of Stable-Baselines3; ``"rsl_ppo"``: PPO of rsl-rl,
            for thousands of worlds, whose networks, storage and updates stay on a GPU;
            ``"recurrent_ppo"`` of sb3-contrib: PPO with an LSTM, of width ``network.recurrent``.
        name: ``"tuned"`` where it comes from ``recipe``.
        env: Options of the environment.
        curriculum: Interventions in it; plain data of a ``Curriculum``.
        levels: Train on so many draws of the curriculum and the noise: each episode is one of them,
            drawn uniformly. Level i is episode i of the noise ``training.worlds.level_seed``.
            Trials then have scores on these levels (the first ``trials.episodes``) and on new
            draws, and the gap between both. None: new draws for ever.
        worlds: How many are simulated together.
        steps: Control steps of training, in all worlds together.
        settings: Settings of the algorithm.
        rate: Learning rate.
        network: Network of the policy, and likewise of the values.
        scale_rewards: Divide rewards by the running standard deviation of the return (PPO).
        episode_length: Control steps of an episode while it is trained; as the environment has it
            if None. Evaluations are as long as ever.
        staggered: Begin the worlds at different steps of their episodes.
        critic_warmup: Control steps in which PPO learns the value only.
        hindsight: Hindsight experience replay, with sparse rewards, if given (SAC and TD3).
        observations: ``"plain"``; ``"privileged"``: with every causal parameter, or those that
            ``env["context"]`` names; ``"critic"`` (PPO): with these for the value alone, which
            policy files do not have.
        trials: Evaluations while it is trained.
    """

    task: TaskName
    algo: Literal["ppo", "sac", "td3", "rsl_ppo", "recurrent_ppo"] = "ppo"
    name: str = "own"
    env: dict[str, Any] = Field(default_factory=dict)
    curriculum: dict[str, Any] = Field(default_factory=PUBLISHED["0"].as_dict)
    levels: Count | None = None
    worlds: Count = 64
    steps: Count = 1_000_000
    settings: SerializeAsAny[Ppo | OffPolicy] = Field(default_factory=Ppo)
    rate: Rate = Field(default_factory=Rate)
    network: Network = Field(default_factory=Network)
    scale_rewards: bool = False
    episode_length: Count | None = None
    staggered: bool = True
    critic_warmup: Annotated[int, Field(ge=0)] = 0
    hindsight: Hindsight | None = None
    observations: Observations | Literal["critic"] = "plain"
    trials: Trials = Field(default_factory=Trials)

    @field_validator("env")
    @classmethod
    def _plain(cls, env: dict[str, Any]) -> dict[str, Any]:
        known = [name for name in ENV_OPTIONS if name not in RESERVED]
        for name in env:
            one_of("option of the environment in a recipe", name, known)
        if env.get("observation_mode") == "pixel":
            allowed = ("structured", "full", "custom: networks here take vectors of numbers")
            raise UnknownOption("observation_mode of a recipe", "pixel", allowed)
        try:
            return dict(json.loads(json.dumps(env, allow_nan=False)))
        except (TypeError, ValueError) as error:
            raise UnknownOption("env of a recipe", env, (f"plain data: {error}",)) from None

    @field_validator("curriculum", mode="before")
    @classmethod
    def _read(cls, given: object, info: ValidationInfo) -> dict[str, Any]:
        if isinstance(given, str | Path) and str(given).endswith(".json"):
            return Curriculum.load(given).as_dict()
        if not isinstance(given, bool | int | float | str):
            return as_curriculum(given).as_dict()
        known = dict(PUBLISHED)
        if str(given) not in known and "task" in info.data:
            task = _made_task(info.data["task"], info.data.get("env"))
            known |= {one.name: one.curriculum() for one in protocols_of(task)}
        if str(given) not in known:
            allowed = (*known, "the path of a JSON file", "a Curriculum")
            raise UnknownOption("curriculum", given, allowed)
        return known[str(given)].as_dict()

    @field_validator("hindsight", mode="before")
    @classmethod
    def _usual(cls, given: object) -> object:
        return ({} if given else None) if isinstance(given, bool) else given

    @field_validator("settings", mode="before")
    @classmethod
    def _of_algorithm(cls, given: object, info: ValidationInfo) -> object:
        kind = ALGORITHMS.get(info.data.get("algo", ""))
        return given if kind is None or isinstance(given, kind) else kind.model_validate(given)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Refuse fields that do not go together."""
        width = self.network.recurrent
        if (width is None) == (self.algo == "recurrent_ppo"):
            allowed = "a width, such as 128" if width is None else "None, or algo='recurrent_ppo'"
            raise UnknownOption(f"network.recurrent with {self.algo}", width, (allowed,))
        if self.observations == "critic":
            if self.algo not in ("ppo", "rsl_ppo"):
                known = ("'plain'", "'privileged'", "algo='ppo' or 'rsl_ppo'")
                raise UnknownOption(f"observations with {self.algo}", "critic", known)
            for name in ("goal_env", "stack_history"):
                if self.env.get(name):
                    said = "False: the observation is one vector"
                    raise UnknownOption(f"{name} with observations='critic'", True, (said,))
        if isinstance(self.settings, Ppo):
            if self.algo == "rsl_ppo":
                self._fits_rsl(self.settings)
            if self.hindsight is not None:
                raise UnknownOption("hindsight with PPO", True, ("none: it needs SAC or TD3",))
            if self.round < 2:
                raise UnknownOption("n_steps of PPO in 1 world", 1, ("any whole number from 2 on",))
        else:
            own = {
                "scale_rewards": self.scale_rewards,
                "critic_warmup": self.critic_warmup > 0,
                "log_std_end": self.network.log_std_end is not None,
                "adaptive learning rate": self.rate.schedule == "adaptive",
            }
            for name in (name for name, given in own.items() if given):
                raise UnknownOption(f"{name} with {self.algo}", True, ("none: it is of PPO",))
            if self.hindsight is not None and self.settings.n_steps > 1:
                raise UnknownOption("n_steps with hindsight", self.settings.n_steps, ("1",))
        parts = as_curriculum(self.curriculum).parts() if self.levels else ()
        if any(part.kind == "stages" for part in parts):
            none = "None: stages follow from the episodes before"
            raise UnknownOption("levels of a curriculum with stages", self.levels, (none,))
        if self.steps < self.round:
            least = f"at least {self.round:,}: {self.worlds} worlds make so many in one round"
            raise UnknownOption("steps", self.steps, (least,))
        if self.trials.protocols:
            chosen(self.trials.protocols, protocols_of(_made_task(self.task, self.env)))
        return self

    def _fits_rsl(self, kept: Ppo) -> None:
        """Refuse what PPO of rsl-rl does not have."""
        wrong = {
            "critic_warmup": self.critic_warmup > 0,
            "target_kl of PPO": kept.target_kl is not None,
            "normalize_advantage": not kept.normalize_advantage,
            "clip_range_vf": kept.clip_range_vf not in (None, kept.clip_range),
        }
        for name in (name for name, given in wrong.items() if given):
            raise UnknownOption(f"{name} with rsl_ppo", True, ("the usual one, or algo='ppo'",))
        if self.round % kept.batch_size:
            least = f"a number that divides {self.round:,}, the steps of a round"
            raise UnknownOption("batch_size with rsl_ppo", kept.batch_size, (least,))

    def __str__(self) -> str:
        """Summarise the training in a line."""
        trials = ", ".join(self.trials.protocols) or "nothing"
        goals = ", with goals" if self.hindsight else ""
        return (
            f"{self.algo.upper()} on {self.task}: {self.steps:,} steps in {self.worlds} worlds, "
            f"actions {self.env.get('action_mode', 'as the task has them')}, observations "
            f"{self.observations}{goals}; meanwhile {trials} is evaluated"
        )

    def but(self, **changes: object) -> Recipe:
        """Return the same recipe with changes, as ``recipe`` takes them; None changes nothing.

        Raises:
            UnknownOption: A field is unknown, or a value is impossible.
        """
        wanted = {name: value for name, value in changes.items() if value is not None}
        return _changed(self.model_dump(mode="json"), wanted)

    @property
    def round(self) -> int:
        """Control steps in all worlds from one update to the next."""
        kept = self.settings
        return self.worlds * (kept.n_steps if isinstance(kept, Ppo) else kept.train_freq)

    @property
    def options(self) -> dict[str, Any]:
        """Options of the environment, with all that follows from the other fields."""
        found = observed(self.env, self.observations)
        if self.observations == "critic":
            found["context"] = "none"
        if self.hindsight is not None:
            given = found.get("task_options") or {}
            kept = {name: value for name, value in given.items() if name not in REWARDS}
            found |= {"goal_env": True, "task_options": {**kept, "weights": "sparse"}}
        return found

    @property
    def trained_in(self) -> dict[str, Any]:
        """Options of the environment while the agent is trained."""
        found = {**self.options}
        if self.observations == "critic":
            found |= {"context": observed(self.env, "critic")["context"]}
        length = self.episode_length
        return found if length is None else {**found, "max_episode_length": length}

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {"format": FORMAT, **self.model_dump(mode="json")}

    def to_json(self) -> str:
        """Return it as JSON."""
        return json.dumps(self.as_dict(), indent=2, allow_nan=False)

    @classmethod
    def from_dict(cls, data: object, *, trusted: Sequence[str] = ()) -> Recipe:
        """Read a recipe that ``as_dict`` wrote.

        Args:
            data: Plain data.
            trusted: Packages whose functions may be called for the task.

        Raises:
            UnknownOption: It is not a recipe, and it says where; or its task is a function of no
                trusted package.
        """
        if not isinstance(data, Mapping) or data.get("format") != FORMAT:
            raise UnknownOption("format of a recipe", data, (FORMAT,))
        refuse_untrusted(str(data.get("task")), trusted)
        fields = {name: value for name, value in data.items() if name != "format"}
        return built(Recipe, "a recipe", fields)

    @classmethod
    def load(cls, path: Path | str, *, trusted: Sequence[str] = ()) -> Recipe:
        """Read a file with the JSON of a recipe; see ``from_dict``.

        Raises:
            UnreadableFile: It does not exist, or is something else.
        """
        with reading(path, "give a file with the text of Recipe.to_json()"):
            return cls.from_dict(json.loads(read_text(path)), trusted=trusted)


def recipe(
    task: str,
    algo: str = "ppo",
    *,
    curriculum: Part | Path | str | int = None,
    **changes: object,
) -> Recipe:
    """Return the recipe that works for a task, as far as we know, with changes.

    Args:
        task: Name of a task, also of one after ``scm_world.tasks.register``; a model file, or
            ``"module:function"`` for a function or class that gives a task. What its class has in
            ``training`` takes precedence over the usual values. Trials of a task of another
            package are in P0, A and B, as far as there are these.
        algo: ``"ppo"``, ``"sac"``, ``"td3"``, ``"rsl_ppo"`` or ``"recurrent_ppo"``.
        curriculum: The name of a protocol of the task, such as ``"P10"``: its variables vary
            in each episode. 0, 1 or 2 for the published ones: nothing, goals, everything; the path
            of a JSON file; or a ``Curriculum``, interventions, or plain data. The usual one of the
            task if None.
        changes: Fields of the ``Recipe`` or settings of the algorithm. A dictionary
            (``env``, ``settings``, ``rate``, ``network``, ``trials``) changes the parts that it
            names, and ``a.b`` names a part. ``hindsight=True`` stands for its usual settings.

    Raises:
        UnknownOption: The task, the algorithm, the curriculum, a field or a setting is unknown, or
            a value is impossible.

    Example:
        >>> made = recipe("pushing", curriculum=1, n_steps=32, env={"frame_skip": 5})
        >>> made.settings.n_steps, made.env["frame_skip"]
        (32, 5)
        >>> Recipe.from_dict(made.as_dict()) == made
        True
    """
    known_task(task)
    one_of("algorithm", algo, ALGORITHMS)
    made = _made_task(task, cast("Mapping[str, Any] | None", changes.get("env")))
    fields: dict[str, Any] = {"task": task, "algo": algo, "name": "tuned", **tuned(made, algo)}
    if type(made) is not TASKS.get(made.name):
        there = {protocol.name for protocol in protocols_of(made)}
        names = tuple(name for name in ("P0", "A", "B") if name in there)
        fields["trials"] = {"protocols": names, **fields.get("trials", {})}
    if curriculum is not None:
        fields["curriculum"] = curriculum
    return _changed(fields, changes)


def usual_algorithm(backend: str | None) -> str:
    """Return the algorithm that is used on an engine if none is named.

    An engine that steps many worlds best, and has their states on a device, has the one for them.
    """
    if backend is None:
        return "ppo"
    with closing(make_backend(backend)) as engine:
        many = engine.capabilities.scenes is not None and engine.batch.stays
    return "rsl_ppo" if many else "ppo"


def _made_task(task: str, env: Mapping[str, Any] | None) -> Task:
    """Make a task with its options in an environment."""
    return make_task(task, **((env or {}).get("task_options") or {}))


def _changed(fields: Mapping[str, Any], changes: Mapping[str, Any]) -> Recipe:
    """Make a recipe of fields and changes, among them settings of the algorithm by name."""
    found = {n: v for n, v in fields.items() if n != "curriculum" or n not in changes}
    said = {name.rpartition(".")[2] for name in changes} | {*changes.get("settings", ())}
    goals = [part for name, part in changes.items() if name.partition(".")[0] == "hindsight"]
    has_goals = (goals or [fields.get("hindsight")])[-1] not in (None, False)
    if has_goals and found["algo"] in ("sac", "td3") and "n_steps" not in said:
        changes = {**changes, "n_steps": 1}  # goals decide no more
    return built(Recipe, "a recipe", found, changes, ALGORITHMS[found["algo"]].model_fields)
