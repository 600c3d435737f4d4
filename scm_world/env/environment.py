"""The Gymnasium face of a world."""

from __future__ import annotations

import inspect
import math
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast, final
from weakref import WeakKeyDictionary

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import EzPickle
from numpy.typing import ArrayLike, NDArray

from scm_world._arguments import one_of, refuse_other, scalar, whole_number
from scm_world._patterns import is_pattern
from scm_world._types import Floats, Observation, Values
from scm_world.backends.renderer import RenderedImage, picture, render, scene_camera
from scm_world.env.actions import COMMAND, PREFIX, Actions
from scm_world.env.arguments import (
    RESETS,
    asked,
    beginning_structure,
    check_names,
    ranges,
    reset_options,
)
from scm_world.env.history import History
from scm_world.env.observer import FAILED, Observer, check_options
from scm_world.env.pictures import Cameras, has_screen, height_and_width, read_camera
from scm_world.env.vector import Vector
from scm_world.errors import (
    EngineError,
    EngineFailure,
    InterventionError,
    ModelError,
    NotReset,
    SnapshotMismatch,
    UnknownOption,
    UnknownVariable,
)
from scm_world.graph import flatten
from scm_world.graph.scm import request_of
from scm_world.models.camera import Camera
from scm_world.queries.plans import Plan
from scm_world.queries.world import World
from scm_world.tasks import AnySource, make_task
from scm_world.tasks.model import REWARD
from scm_world.tasks.rewards import SUCCESS, one_number
from scm_world.variables.kinds import SPACES, SpaceName
from scm_world.variables.subsets import AnyRegion, as_region
from scm_world.world import Audit, Snapshot
from scm_world.world.compiled_task import CompiledTask
from scm_world.world.mechanisms import Rows
from scm_world.world.structures import StructureCache

if TYPE_CHECKING:
    from scm_world.backends.mujoco.viewer import Viewer

RENDER_MODES = ("rgb_array", "human")
ON_FAILURE = ("raise", "truncate")
FIRST = np.zeros(1, int)
"""The row of one environment."""


@final
@dataclass(frozen=True)
class EnvSnapshot:
    """An instant of an episode of an environment. It can be pickled.

    Attributes:
        world: Of its world.
        interventions: The interventions so far.
        ended: Whether the episode is over and the next one begins with the next step of a batch.
        memory: The state of a curriculum around it.
        history: The last observations and actions, with the option ``history``.
    """

    world: Snapshot
    interventions: tuple[tuple[int, dict[str, Any]], ...]
    ended: bool = False
    memory: tuple[Any, ...] | None = None
    history: NDArray[np.float32] | None = field(default=None, compare=False)


class ScmWorldEnv(EzPickle, gymnasium.Env[Observation, NDArray[np.float32]]):
    """An environment whose every variable is a node of a causal graph.

    Made by ``gymnasium.make("scm_world/Pushing-v0")``; ``scm_world.env.IDS`` lists the ids. Any
    other model is ``gymnasium.make("scm_world/Model-v0", model="cartpole.xml", reward=…)``.

    Every observation lies in ``observation_space``. Bounds are physical; a number of the robot's
    tasks beyond them (a joint faster than 50 rad/s) saturates, like a sensor. An episode is
    truncated at its length, and terminated where the variable ``terminated`` says so, if the task
    has one. ``info`` has ``success``, ``fractional_success`` and goals if the task has them. An
    intervention that changes which bodies exist changes the observation: ``observation_space`` is
    then that of the new structure, unless ``pad`` says how many bodies there can be. A copied or
    unpickled environment continues bit-identically to the original.

    Args:
        task: Name of a registered task, or a task.
        task_options: Arguments of the constructor of a task that is given by its name.
        backend: ``"mujoco"``, ``"bullet"``, ``"step"`` or ``"fake"``; that of the task if None.
        preset: One of the task's ``choices["preset"]``; the first one if None.
        frame_skip: Length of a control step: of the robot's tasks in units of 4 ms, of a model in
            its physics steps; the task's own if None.
        action_mode: One of the task's ``choices["action_mode"]`` (of the robot's tasks
            ``"joint_positions"``, ``"joint_torques"``, ``"end_effector_positions"``), or one of
            them after ``"delta_"``: they are relative, see ``Actions``; the first one if None.
        resolution: One of the task's ``choices["resolution"]``: how fine its variables are, see
            ``World``; observations and actions do not depend on it. The first one if None.
        delta_scale: Share of half of the range that the largest relative action stands for.
        delta_origin: Joint positions are relative to the last ``"command"``, or ``"measured"``.
        normalize_actions: Take actions in [-1, 1] instead of SI units.
        observation_mode: ``"structured"``: the published layout; ``"full"``: that and every other
            variable; ``"custom"``: the variables in ``observe``; ``"pixel"``: pictures.
        observe: Names of variables, or one name, for ``"custom"``.
        include: Likewise, to append to the vector.
        context: Where the parameters that can be intervened on are: ``"none"``,
            ``"observation"``: appended to the vector; ``"privileged"``: in a dictionary beside
            it. Names or patterns append these only, like ``{"observation": names}``;
            ``{"privileged": ["*.mass"]}`` has them beside it. The noise of the sensors does not
            reach them.
        keypoints: ``"view"``: append the view of a hand of every block that has a goal, see
            ``scm_world.tasks.trifinger.views``.
        pad: Values of variables that decide which bodies exist: ``{"number_of_obstacles": 3}``. The
            vector always has the places of these bodies then, with zeros where one is missing.
        cameras: Names (``"60"``, ``"120"``, ``"300"``, ``"overview"``) or cameras, for
            ``"pixel"``; the three of the robot if None.
        image_size: Height and width of pictures, or both in one [pixels]; 128 if None.
        stack_images: Whether all pictures are the channels of one, as convolutional networks (the
            ``CnnPolicy`` of Stable-Baselines3) take them.
        normalize_observations: Give numbers in [-1, 1] instead of SI units.
        history: How many last pairs of observation and action, at most 1,000, follow the present
            observation, the newest first: n + history * (n + n_actions) numbers, zeros where there
            was no step. The observation of a pair is that of the instant in which the action was
            taken, and the action is the agent's, clipped to ``action_space``.
        stack_history: Give a dictionary with ``observation`` and ``history``, shape (history, n +
            n_actions), instead.
        goal_env: Give a dictionary with ``observation``, ``achieved_goal``, ``desired_goal``, as
            ``compute_reward`` takes them.
        start: An intervention at every reset; a value may be a space or distribution to draw from,
            the name of a space, or, of a number, the two ends of a range.
        random_goal: Draw a new goal at every reset, from ``"A"``, ``"B"`` or ``"A|B"``.
        variables_space: The space in which every target of an intervention must lie: ``"A"``,
            ``"B"``, ``"A|B"``, a ``Subset``, or the patterns and regions of one.
        max_episode_length: In control steps; the task's own if None. Observations and
            protocols know of it.
        max_episode_steps: Truncate episodes after so many control steps even if they are longer:
            what Gymnasium's ``TimeLimit`` does; never if None or -1.
        on_failure: ``"raise"``: a step that the engine cannot take, since states grow beyond all
            bounds, raises an ``EngineFailure``; ``"truncate"``: it truncates the episode, with a
            reward of 0, the last observation there was, and no success. ``info["failed"]`` says
            whether. An error in a function is raised all the same.
        conventions: ``"scm_world"`` or ``"causal_world"``.
        render_mode: None, ``"rgb_array"`` or ``"human"``.
        render_camera: Of ``render``: a camera or its name, as in ``cameras``; of a model also one
            in its file. ``"overview"``, or of a model ``"automatic"``, if None.
        render_size: Height and width of pictures of ``render``, or both in one [pixels]; if None
            480 and 640, or those of a camera that is given.

    Attributes:
        world: Its ``World``, which can be asked; questions leave the environment as it is.
        observer: The observation of the present structure; so are the next three.
        layout: Where each variable stands in the vector that is observed; empty for pictures. Of
            ``history``: ``"joint_positions@-1"``, and ``"agent.action@-1"``, the last action.
        observed: The variables that the observation is made of; None of pictures, which show many.
        info_shapes: The shape of each entry of ``info``, without the dictionary ``reward_terms``.
        appended: The parameters that ``context`` adds to the vector.
        actions: What actions mean.
        history: The last observations and actions; None without the option.

    Raises:
        UnknownOption: An option does not exist, or does not go with the others.
        ModelError: The task has no reward.
        EngineError: The backend is not installed, or ``"human"`` has no screen.

    Example:
        >>> env = gymnasium.make("scm_world/Pushing-v0", backend="fake")
        >>> observation, info = env.reset(seed=0, options={"do": {"tool_block.mass": 0.04}})
        >>> observation.shape, info["is_success"]
        ((56,), False)
        >>> print(env.unwrapped.do({"floor_friction": 0.4}))
        floor_friction = 0.4, engine reports 0.4
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 # declared by Gymnasium as an instance variable
        "render_modes": list(RENDER_MODES),
        "render_fps": 25,
    }

    def __init__(
        self,
        task: AnySource = "pushing",
        *,
        task_options: Mapping[str, Any] | None = None,
        backend: str | None = None,
        preset: str | None = None,
        frame_skip: int | None = None,
        action_mode: str | None = None,
        resolution: str | None = None,
        delta_scale: float = 1.0,
        delta_origin: str = COMMAND,
        normalize_actions: bool = True,
        observation_mode: str = "structured",
        observe: Iterable[str] = (),
        include: Iterable[str] = (),
        context: str | Iterable[str] | Mapping[str, str | Iterable[str]] = "none",
        keypoints: str | bool = False,
        pad: Mapping[str, Any] | None = None,
        cameras: Sequence[str | Camera] | None = None,
        image_size: int | tuple[int, int] | None = None,
        stack_images: bool = False,
        normalize_observations: bool = True,
        history: int = 0,
        stack_history: bool = False,
        goal_env: bool = False,
        start: Mapping[str, Any] | None = None,
        random_goal: SpaceName | None = None,
        variables_space: AnyRegion | Mapping[str, Any] | None = None,
        max_episode_length: int | None = None,
        max_episode_steps: int | None = None,
        on_failure: str = "raise",
        conventions: str = "scm_world",
        render_mode: str | None = None,
        render_camera: str | Camera | Mapping[str, Any] | None = None,
        render_size: int | tuple[int, int] | None = None,
        **unknown: object,
    ) -> None:
        for name in unknown:
            raise UnknownOption("option of the environment", name, ENV_OPTIONS)
        options = {name: scalar(value) for name, value in locals().items() if name in ENV_OPTIONS}
        check_options(options)
        one_of("on_failure", on_failure, ON_FAILURE)
        self._how, self.truncates_failures = options, on_failure == "truncate"
        refuse_other("task_options", task_options, Mapping[str, Any] | None)
        refuse_other("delta_scale", options["delta_scale"], float)
        refuse_other("delta_origin", delta_origin, str)
        made = task if isinstance(task, StructureCache) else make_task(task, **(task_options or {}))
        kind = made.task if isinstance(made, StructureCache) else made
        modes = kind.choices["action_mode"]
        mode = modes[0] if action_mode is None else action_mode
        one_of("action_mode", mode, (*modes, *(PREFIX + one for one in modes)))
        self.world = World(
            made,
            backend=backend,
            preset=preset,
            action_mode=mode.removeprefix(PREFIX),
            resolution=resolution,
            frame_skip=frame_skip,
            max_episode_length=max_episode_length,
            conventions=conventions,
            variables_space=as_region("variables_space", variables_space),
        )
        used = {"preset": self.world.options.preset, "frame_skip": self.world.options.frame_skip}
        used |= {"backend": self.world.engine_name, "action_mode": mode}
        super().__init__(**options | used)
        model = self.world.model
        if REWARD not in model or model.declared(REWARD).shape:
            self.world.close()
            what = f"a reward of shape {model.declared(REWARD).shape}" if REWARD in model else ""
            advice = "give reward=(function, 'hinge.position', …): a function that returns one "
            advice += "number, and names of causes"
            problem = f"the task {self.world.task.name!r} has {what or 'no reward'}; {advice}"
            raise ModelError([problem])
        one_of("random_goal", random_goal, (None, *SPACES))
        self._start, self._random_goal = asked(ranges(start, model)), random_goal
        published = self.world.options.conventions.published
        # Without steps, the one action terminates the episode before it could be truncated.
        self.limit = self.world.max_episode_length + int(published or not self.world.has_steps)
        is_free = isinstance(max_episode_steps, int) and max_episode_steps == -1
        if max_episode_steps is not None and not is_free:
            steps = whole_number("max_episode_steps", max_episode_steps, least=1)
            self.limit = min(self.limit, steps)

        modes = RENDER_MODES if self.world.has_scene else ()
        one_of("render_mode", render_mode, (None, *modes))
        self.render_mode = render_mode
        if render_mode == "human" and not has_screen():
            raise EngineError(
                "render_mode='human' opens a window on a screen, and neither DISPLAY nor "
                "WAYLAND_DISPLAY is set; use render_mode='rgb_array', which needs no screen",
                "mujoco",
            )
        self._viewer: Viewer | None = None
        self._cameras, self._view = Cameras(self.world), read_camera(render_camera)
        self._size = height_and_width("render_size", render_size)
        if self._view is not None:  # refuses one that there is not
            scene_camera(self.world.structure.default_scene(), self._view)
        modes = [one for one in modes if one != "human" or has_screen()]
        fps = round(1 / self.world.options.control_period)
        self.metadata = {**type(self).metadata, "render_modes": modes, "render_fps": fps}

        self.actions = Actions(
            self.world,
            relative=mode.startswith(PREFIX),
            normalized=normalize_actions,
            scale=delta_scale,
            origin=delta_origin,
        )
        self.action_space = self.actions.space
        self.reward_scale = self.world.options.control_period if published else 1.0
        self._terms = tuple(self.world.task.weights)
        self._version = -1
        self._done: list[tuple[int, dict[str, Any]]] = []
        self._known: WeakKeyDictionary[CompiledTask, Observer] = WeakKeyDictionary()
        self._largest, self.history = None, cast("History | None", None)
        self._seen_at = (-1, -1)  # version and control step of the observation in the history
        if pad is not None:
            for name in asked(pad):
                if name not in self.world.structures.head:
                    raise UnknownVariable(name, self.world.structures.head)
            self._largest = beginning_structure(self.world, {**self._start, **asked(pad)})
        first = beginning_structure(self.world, self._start)
        check_names(self._start, first.model, self.world.structures.head)
        self._arrange(first)
        if goal_env:  # learners take every environment that has it for one with goals
            self.compute_reward = self.goal_reward

    # --- properties -------------------------------------------------------------------------------

    @property
    def made_with(self) -> dict[str, Any]:
        """The options that it was made with, by name."""
        return dict(self._ezpickle_kwargs)

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium knows of it; ``max_episode_steps`` is the length of its episodes."""
        return self.__dict__.get("spec")

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = replace(spec, max_episode_steps=self.limit)
        self.__dict__["spec"] = spec

    def as_action(self, command: ArrayLike) -> NDArray[Any]:
        """Return the action, now, that leads to a command in SI units, shape (n,).

        A relative one leads as near to it as one can.

        Raises:
            ActionError: The command has another shape, or is not real numbers.
        """
        return self.actions.toward(command)

    def _arrange(self, declaration: CompiledTask) -> None:
        if declaration not in self._known:
            largest = self._largest or declaration
            ends = self.actions.bounds
            self._known[declaration] = Observer(self.world, declaration, self._how, largest, ends)
        observer = self._known[declaration]
        if self.history is not None and observer.layout != self.history.layout:
            raise InterventionError(
                "an intervention changes which bodies exist, and with them what is observed, while "
                f"a history has observations of one kind: beside history={self._how['history']}, "
                "give pad={…}, the most bodies that there can be",
                variable=next(iter(self.world.structures.head)),
            )
        if self._how["history"] and self.history is None:
            self.history = observer.history
        self._declaration, self.observer = declaration, observer
        self.observation_space, self.info_shapes = observer.space, observer.info_shapes
        self.layout, self.appended = observer.layout, observer.appended
        self.observed = None if self._how["observation_mode"] == "pixel" else observer.names

    def follow(self) -> None:
        """Observe the structure that there is, if it has changed."""
        if self._version != self.world.version:
            if self.world.compiled is not self._declaration:
                self._arrange(self.world.compiled)
            self._version = self.world.version

    def _look(self) -> Rows:
        """Compute the present values that are needed."""
        if self._version != self.world.version:
            self.follow()
        self.world._require_episode()
        now = self.world.row
        now.evaluate(self.observer.needed)
        return now

    def _observed(self, now: Rows) -> Observation:
        """Return the observation of the present values."""
        found = self.observer.observe(now)
        if self.history is None:
            return found
        self.note_observed()
        return self.history.observe(found, 0)

    def note_observed(self) -> None:
        """Note that the history has the present observation."""
        self._seen_at = self.world.version, self.world.index

    def update_history(self) -> None:
        """Observe again what a pair of the history needs, if the world has changed since."""
        if self.history is not None and self._seen_at != (self.world.version, self.world.index):
            self.observe()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed of the noise.
            options: ``{"do": {…}}``: an intervention that holds for the whole episode, or a plan
                whose times lie within it. Where it
                sets what ``start`` or a random goal sets too, it counts. ``{"episode": n}``: the
                number of the episode within the noise; the next one if not given, 0 with a seed.
                ``{"space": …}``: the space in which every target must lie. ``{"draws": n}``: the
                number of the episode whose draws hold, see ``World.reset``.

        Raises:
            UnknownOption: Another key.
            InterventionError: The intervention was refused.
            ModelError: A custom reward term is not a number.
        """
        super().reset(seed=None if seed is None else whole_number("seed", seed, least=0))
        asked_for = reset_options(options, RESETS)
        request = self.beginning(asked_for.get("do"))
        number, space = asked_for.get("episode"), asked_for.get("space")
        if number is not None and seed is None:
            seed = self.world.noise.seed
        self._done = []
        if self.history is not None:
            self.history.rows[:] = 0.0
        drawn: Any = {"space": space, "draws": asked_for.get("draws")}
        self.world.reset(seed=seed, episode=0 if number is None else number, do=request, **drawn)
        if request:
            self._note()
        now = self._look()
        for name in self._terms:
            one_number(now, name, (name,))
        self._show()
        return self._observed(now), self.observer.outcome(now)[2]

    def beginning(self, do: Mapping[str, Any] | None) -> Mapping[str, Any]:
        """Return the interventions of a reset: those of the caller, over goal and ``start``."""
        mine, context = asked(request_of(do)), do.context if isinstance(do, Plan) else ()
        if not (self._start or self._random_goal or context or any(map(is_pattern, mine))):
            return mine
        plan = Plan(mine)
        for kind, layer in reversed(context):
            plan = plan.over(asked(layer), kind)
        plan = plan.over(self._start, "start")
        structure = beginning_structure(self.world, plan)
        if self._random_goal:
            plan = plan.over(structure.task.sample_goal(self._random_goal), "start")
        return plan.named(structure.model)

    def _note(self) -> None:
        """Note the last intervention of this instant, complete with those below it."""
        if self.world.requested:
            self._done.append((self.world.index, dict(self.world.requested)))

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance one control step, and apply the plan of the reset at the new instant.

        Observation and info are those after it; it earns nothing.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
            InterventionError: The plan was refused there; the step is taken.
            EngineFailure: The engine cannot take the step; see ``on_failure``.
        """
        world = self.world
        actions, history, index = self.actions, self.history, 0
        if history is not None:
            self.update_history()
            index = world.index
        try:
            world.advance(actions.absolute(action) if actions.converts else action, actions.scale)
        except EngineFailure as error:
            if not (self.truncates_failures and error.diverged):
                raise
            observation, info = self.present_of_failure()
            return observation, 0.0, False, True, info
        finally:
            if history is not None and world.has_begun and world.index > index:
                history.push(FIRST, actions.in_space(np.ravel(action)))
        if self._version != world.version:
            self.follow()
        now = world.row
        now.evaluate(self.observer.needed)
        reward, terminated, info = self.observer.outcome(now)
        if not math.isfinite(reward):
            one_number(now, REWARD, self._terms)  # refuses it, and names the cause
        truncated: bool = now.numbers.item(now.compiled.clock) >= self.limit
        if world.is_planned and not (terminated or truncated) and self.act():
            now, terms = self._look(), info["reward_terms"]
            info = {**self.observer.outcome(now)[2], "reward_terms": terms}  # of the step
        if self.render_mode == "human":
            self._show()
        scaled = self.reward_scale * reward
        return self._observed(now), scaled, terminated, truncated, info

    def act(self) -> bool:
        """Apply the interventions that the plan has for this instant; return whether it has any.

        Steps do so by themselves.

        Raises:
            InterventionError: It was refused.
        """
        audit = self.world.act()
        if audit is not None:
            self._note()
        return audit is not None

    def do(self, request: Mapping[str, Any], *, space: AnyRegion | None = None) -> Audit:
        """Intervene now; see ``World.do``. ``observe`` gives the observation afterwards.

        Args:
            request: As in ``World.do``; ``"A"``, ``"B"`` and ``"A|B"`` stand for draws.
            space: In which every target must lie.

        Raises:
            InterventionError: The intervention was refused; nothing has changed.
            ModelError: A function of the reward fails where it was done; nothing has changed.
        """
        wanted = dict(self.world.model.named(asked(request)))
        audit = self.world.do(wanted, space=space, check=self._look)
        self._note()
        return audit

    @property
    def interventions(self) -> tuple[tuple[int, dict[str, Any]], ...]:
        """The interventions of this episode, each with its control step, as copies."""
        return tuple((index, flatten(acts)) for index, acts in self._done)

    def observe(self) -> Observation:
        """Return the present observation."""
        return self.present()[0]

    def observe_values(self, values: Values) -> NDArray[np.float32]:
        """Return the observation of other values of the ``observed`` variables, without noise.

        Raises:
            UnknownOption: The observation is not a vector, or has a history, or a value is missing.
        """
        vector, names = self.observer.parts["observation"], self.observer.names
        if not isinstance(vector, Vector) or isinstance(self.observation_space, spaces.Dict):
            raise UnknownOption("observation of values", self.observation_space, ("a vector",))
        if self.history is not None:  # values of an instant have no past
            raise UnknownOption("history for observe_values", self._how["history"], ("0",))
        if not isinstance(values, Mapping) or not values.keys() >= {*names}:
            raise UnknownOption("values of an observation", values, names)
        return vector.observe_values(values)

    def present(self) -> tuple[Observation, dict[str, Any]]:
        """Return the present observation and info, as after an intervention."""
        now = self._look()
        return self._observed(now), self.observer.outcome(now)[2]

    def present_of_failure(self) -> tuple[Observation, dict[str, Any]]:
        """Return the last observation and info of an episode that ends since its world failed."""
        observation, info = self.present()
        info |= {name: False for name in ("is_success", SUCCESS) if name in info}
        terms = dict.fromkeys(info["reward_terms"], 0.0)
        return observation, info | {"reward_terms": terms, FAILED: True}

    def goal_reward(self, achieved: ArrayLike, desired: ArrayLike, info: object = None) -> Floats:
        """Compute the reward of having achieved one goal while another one was desired.

        With ``goal_env`` it is called ``compute_reward``, too, the name that learners know.

        With ``weights="sparse"``, or where only ``fractional_success`` and ``success`` have
        weights, it is the reward of the step. Else the first call warns: goals do not decide dense
        terms.

        Args:
            achieved: As in ``info``, shape (..., n).
            desired: Shape (..., n).
            info: Not needed; learners give it.

        Returns:
            The weighted sum of the terms that goals alone decide, shape (...); times the control
            period under the conventions that say so.

        Raises:
            UnknownOption: The task has no goals, or these have another shape.
        """
        goals = self.observer.goals
        if goals is None:
            raise UnknownOption("task with goals", self.world.task.name, ("one that has goals",))
        return self.reward_scale * goals.reward(achieved, desired)

    # --- pictures ---------------------------------------------------------------------------------

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene, shape (h, w, 3); None without ``render_mode="rgb_array"``.

        With ``render_mode="human"`` the window shows every step by itself. A model is drawn by
        MuJoCo where it can, and its camera follows moving bodies.

        Raises:
            ModelError: There is nothing to draw: a step function has no shapes.
        """
        self._show()
        if self.render_mode != "rgb_array":
            return None
        scene = self.world.scene()
        return picture(scene, self._cameras.now(scene, self._view, self._size))

    def image(self, camera: Camera | str | None = None) -> RenderedImage:
        """Measure the view of a camera: the depth and the body of every pixel.

        Args:
            camera: A camera, or its name: of the robot's tasks ``"60"``, ``"120"``, ``"300"``,
                ``"overview"``, of a model one in its file, or ``"automatic"``. The last one if
                None.
        """
        scene = self.world.scene()
        return render(scene, self._cameras.now(scene, camera))

    def _show(self) -> None:
        if self.render_mode != "human":
            return
        if self._viewer is None:
            from scm_world.backends.mujoco.viewer import Viewer  # an engine, only where it is used

            self._viewer = Viewer()
        self._viewer.show(self.world.scene())

    # --- copies -----------------------------------------------------------------------------------

    def snapshot(self) -> EnvSnapshot:
        """Save everything that decides the future of the episode.

        Raises:
            NotReset: No episode has begun.
        """
        past = None if self.history is None else self.history.rows.copy()
        return EnvSnapshot(self.world.snapshot(), tuple(self._done), history=past)

    def restore(self, snapshot: EnvSnapshot) -> None:
        """Restore a snapshot, bit for bit.

        Raises:
            SnapshotMismatch: It is not of an environment, or is one of another task or engine.
        """
        if not isinstance(snapshot, EnvSnapshot):
            found = reprlib.repr(snapshot)
            raise SnapshotMismatch(f"{found} is not a snapshot; give the result of snapshot()")
        past = None if self.history is None else self.history.rows
        if getattr(past, "shape", None) != getattr(snapshot.history, "shape", None):
            raise SnapshotMismatch("it is one of an environment with another history=…")
        self.world.restore(snapshot.world)
        if past is not None:
            past[...] = snapshot.history
        self._done = list(snapshot.interventions)

    def __getstate__(self) -> dict[str, Any]:
        """Return the arguments, a snapshot, and Gymnasium's generator."""
        try:
            snapshot = self.snapshot()
        except NotReset:
            snapshot = None
        kept = ("_np_random", "_np_random_seed", "spec")
        generator = {name: self.__dict__[name] for name in kept if name in self.__dict__}
        return {**super().__getstate__(), "snapshot": snapshot, "generator": generator}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin where the other environment is; a closed one, or one without episode, is new."""
        super().__setstate__(state)
        self.__dict__.update(state["generator"])
        if state["snapshot"] is not None:
            self.restore(state["snapshot"])

    def close(self) -> None:
        """Free the backend and the window."""
        if self._viewer is not None:
            self._viewer.close()
        self.world.close()


def unwrapped_env(env: gymnasium.Env[Any, Any], wrapper: str) -> ScmWorldEnv:
    """Return the environment of this package inside of wrappers."""
    inner = env.unwrapped
    if not isinstance(inner, ScmWorldEnv):
        raise UnknownOption(f"environment for {wrapper}", type(inner).__name__, ("ScmWorldEnv",))
    return inner


ENV_OPTIONS = tuple(inspect.signature(ScmWorldEnv).parameters)[:-1]
"""Names of the options of an environment."""
