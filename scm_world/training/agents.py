"""Agents of Stable-Baselines3: made as a recipe says, watched, kept and resumed."""

from __future__ import annotations

import io
import json
import random
import time
import zipfile
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, final

import numpy as np
from gymnasium.vector import AutoresetMode

from scm_world._arguments import missing, one_of
from scm_world._types import Floats
from scm_world.curricula import make_vec
from scm_world.env import IDS
from scm_world.errors import Diverged, UnknownOption, UnreadableFile
from scm_world.output.durable import made, write_durably, write_whole
from scm_world.policies import save_policy
from scm_world.queries.progress import Progress, clock
from scm_world.training.export import begin_with, exported, mean, scored, words
from scm_world.training.recipe import Recipe, curriculum_of
from scm_world.training.sb3 import Sb3VecEnv
from scm_world.training.settings import Rate

try:
    import stable_baselines3
    import tensorboard  # noqa: F401 # its logger asks for it late
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
except ImportError as error:
    raise missing(error, "stable_baselines3", "stable-baselines3", "train") from error

__all__ = ["Watch", "begin_with", "checkpoints", "device_for", "make_learner", "make_worlds"]

SUCCESS, FRACTION = "is_success", "fractional_success"
LINES = 10.0  # [s] between lines about the training

SEEDS = 1_000_003
"""Between the noises of two seeds, which have one for each world; evaluations have those below."""

SCALES: Mapping[str, float] = {
    "cartesian_position": 10.0,  # one for 0.1 m, the radius of where blocks and goals are
    "end_effector_positions": 10.0,
    "joint_positions": 2.0,
    "joint_velocities": 10.0,  # one for 5 rad/s
    "linear_velocity": 20.0,  # one for 0.5 m/s
    "angular_velocity": 10.0,  # one for 10 rad/s
    "orientation": 2.0,
}
"""What a normalized number is multiplied by, by its quantity, so that it varies by about one."""


# --- worlds ---------------------------------------------------------------------------------------


@final
class Episodes(VecMonitor):
    """Counts episodes, and keeps the actions of those under way, so that they can be run again.

    Args:
        env: The worlds.
        length: Control steps of an episode.
        staggered: Whether worlds begin at different steps of their episodes: else a batch shows
            one place of all episodes only.

    Attributes:
        length: As above.
    """

    def __init__(self, env: Sb3VecEnv, length: int, *, staggered: bool) -> None:
        super().__init__(env, info_keywords=env.names)
        self.length, self._staggered = length, staggered
        size = int(np.prod(env.action_space.shape))
        self._actions = np.zeros((length + 1, self.num_envs, size), np.float32)

    def step_async(self, actions: Any) -> None:
        """Take the actions of the next step."""
        given = np.asarray(actions, np.float32)
        self._actions[self.episode_lengths, np.arange(self.num_envs)] = given
        self.venv.step_async(given)

    def reset(self) -> Any:
        """Begin an episode in all worlds.

        Where they are staggered, that of world i of n began i / n of an episode later than the
        first one; actions were zeros since then.
        """
        seen = super().reset()
        begin = self.length * np.arange(self.num_envs) // self.num_envs
        for step in range(1, int(begin[-1]) + 1 if self._staggered else 0):
            self.step(np.zeros((self.num_envs, self._actions.shape[2]), np.float32))
            if (late := begin == step).any():
                seen, _ = self.venv.worlds.reset(options={"reset_mask": late})
                self.episode_returns[late], self.episode_lengths[late] = 0.0, 0
        return seen

    def state(self) -> dict[str, Any]:
        """Return what takes other worlds to where these are."""
        return {
            "running": json.dumps(self.venv.worlds.state()),
            "actions": self._actions[: self.episode_lengths.max()],
            "lengths": self.episode_lengths,
            "returns": self.episode_returns,
            "count": self.episode_count,
        }

    def resume(self, state: Mapping[str, Any]) -> Any:
        """Run the episodes that were under way again, bit for bit; return the observations."""
        actions, lengths = state["actions"].numpy(), state["lengths"].numpy()
        self._actions[: len(actions)] = actions
        self.episode_lengths[:], self.episode_returns[:] = lengths, state["returns"].numpy()
        self.episode_count = state["count"]
        return self.venv.worlds.rerun(json.loads(state["running"]), actions, lengths)


def make_worlds(recipe: Recipe, *, backend: str, threads: int | None = None) -> Episodes:
    """Make the worlds of a recipe.

    Args:
        recipe: How an agent is trained.
        backend: Name of the engine.
        threads: Of a backend that steps many worlds in one call, or processes of another one; as
            many as there are cores if None. What comes out does not depend on it.

    Raises:
        UnknownOption: There is no such backend, or an option of the environment does not exist.
        InterventionError: The curriculum names something that does not exist.
    """
    several = "workers" if backend == "bullet" else "threads"
    ids = {task: name for name, task in IDS.items()}
    envs = make_vec(
        ids.get(recipe.task, ids["general"]),  # the task decides, not the id
        recipe.worlds,
        curriculum_of(recipe.curriculum),
        autoreset_mode=AutoresetMode.SAME_STEP,
        backend=backend,
        task=recipe.task,
        **{several: threads},
        **recipe.trained_in,
    )
    try:
        vec_env = Sb3VecEnv(envs, [])
        (there,) = vec_env.get_attr("info_shapes", 0)
        vec_env.names = tuple(name for name in (SUCCESS, FRACTION) if name in there)
        (length,) = vec_env.get_attr("limit", 0)
        return Episodes(vec_env, length, staggered=recipe.staggered)
    except BaseException:
        envs.close()
        raise


# --- algorithms -----------------------------------------------------------------------------------


@final
class Scaled(BaseFeaturesExtractor):
    """Observations, one part after another, times fixed scales."""

    def __init__(self, space: Any, scale: Floats) -> None:
        super().__init__(space, len(scale))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32), persistent=False)

    def forward(self, observations: Any) -> Any:
        """Scale a batch of observations."""
        if isinstance(observations, dict):
            observations = torch.cat([part.flatten(1) for part in observations.values()], 1)
        return observations.float() * self.scale


def scales_of(vec_env: Any, env: Mapping[str, Any]) -> Floats:
    """Return the scale of each number of an observation, in the order in which networks get them.

    Args:
        vec_env: For Stable-Baselines3.
        env: Options of the environment.

    Raises:
        UnknownOption: Observations are not normalized.
    """
    if env.get("normalize_observations") is False:
        raise UnknownOption("normalize_observations with network.scaled", False, ("True",))
    (layout,) = vec_env.get_attr("layout", 0)
    space = vec_env.observation_space
    found = []
    for key, part in getattr(space, "spaces", {"observation": space}).items():
        scale = np.ones(part.shape[0])
        for name, where in layout.items() if key == "observation" else ():
            scale[where] = SCALES.get(name.rpartition(".")[2], 1.0)
        found.append(scale)
    return np.concatenate(found)


def device_for(recipe: Recipe, device: str) -> str:
    """Choose where networks are computed.

    Args:
        recipe: How an agent is trained.
        device: ``"cpu"``, ``"cuda"``, or ``"auto"``: the GPU for SAC and TD3 if there is one; the
            networks of PPO are too small to gain from it.

    Raises:
        UnknownOption: There is no such device.
    """
    one_of("device", device, ("auto", "cpu", "cuda"))
    has_gpu = device != "cpu" and torch.cuda.is_available()
    if device == "cuda" and not has_gpu:
        raise UnknownOption("device", device, ("cpu: torch finds no GPU here",))
    return "cuda" if has_gpu and (device == "cuda" or recipe.algo != "ppo") else "cpu"


def make_learner(recipe: Recipe, worlds: Episodes, *, seed: int, device: str = "cpu") -> Any:
    """Make the algorithm of a recipe.

    Args:
        recipe: How an agent is trained.
        worlds: In which it learns.
        seed: Of the weights, and of what is drawn while it learns.
        device: Where networks are computed.

    Returns:
        A ``PPO``, ``SAC`` or ``TD3`` of Stable-Baselines3.
    """
    network, settings = recipe.network, recipe.settings.model_dump()
    policy: dict[str, Any] = {
        "net_arch": list(network.hidden),
        "activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[network.activation],
    }
    if recipe.algo == "ppo":
        policy |= {"log_std_init": network.log_std, "ortho_init": network.orthogonal}
    if network.scaled:
        scale = scales_of(worlds, recipe.options)
        policy |= {
            "features_extractor_class": Scaled,
            "features_extractor_kwargs": {"scale": scale},
        }
    if sigma := settings.pop("noise", 0.0):
        size = worlds.action_space.shape
        settings["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, sigma))
    if recipe.hindsight is not None:  # it learns when the first episodes are over
        settings["replay_buffer_class"] = stable_baselines3.HerReplayBuffer
        settings["replay_buffer_kwargs"] = recipe.hindsight.model_dump()
        first = recipe.worlds * worlds.length
        settings["learning_starts"] = max(settings["learning_starts"], first)
    env: Any = worlds
    if recipe.scale_rewards:
        env = VecNormalize(worlds, norm_obs=False, gamma=settings["gamma"])
    is_dict = hasattr(worlds.observation_space, "spaces")
    model = getattr(stable_baselines3, recipe.algo.upper())(
        "MultiInputPolicy" if is_dict else "MlpPolicy",
        env,
        learning_rate=rate_of(recipe.rate),
        policy_kwargs=policy,
        seed=seed,
        device=device,
        **settings,
    )
    worlds.seed((seed + 1) * SEEDS)  # the algorithm has set other seeds
    return model


def rate_of(rate: Rate) -> float | Callable[[float], float]:
    """Return the learning rate as Stable-Baselines3 takes it: a function if it falls in a line."""
    if rate.schedule != "linear":
        return rate.initial
    return lambda left: rate.initial * (rate.final + (1.0 - rate.final) * min(max(left, 0.0), 1.0))


def adapted(rate: Rate, now: float, divergence: float) -> float:
    """Return the adaptive learning rate after an update.

    Args:
        rate: How it changes.
        now: What it was.
        divergence: Of the new policy from the old one.
    """
    if divergence > 2.0 * rate.target_kl:
        return max(now / 1.5, rate.lowest)
    return min(now * 1.5, rate.highest) if divergence < rate.target_kl / 2.0 else now


# --- checkpoints ----------------------------------------------------------------------------------

COUNTERS = ("num_timesteps", "_episode_num", "_n_updates", "_current_progress_remaining")


def checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints of a run, the last one at the end."""
    found = [path for path in folder.glob("checkpoints/*.pt") if path.stem.isdecimal()]
    return sorted(found, key=lambda path: int(path.stem))


def write_checkpoint(model: Any, worlds: Episodes, more: Mapping[str, Any], folder: Path) -> None:
    """Write everything that a training resumes from, whole or not at all; keep the last two.

    It is read with ``torch.load(weights_only=True)``, which executes nothing.

    Raises:
        UnwritableFolder: There is no room, or no permission; those before are still there.
    """
    kind, keys, *numpy_rest = np.random.get_state()  # noqa: NPY002 # SB3 draws from it
    version, python_words, gauss = random.getstate()
    buffer = getattr(model, "replay_buffer", None)
    scale = model.get_vec_normalize_env()
    data = {
        "more": json.dumps(more),
        "parameters": model.get_parameters(),
        "entropy": getattr(model, "log_ent_coef", None),
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "rate": None if callable(model.learning_rate) else model.learning_rate,
        "starts": model._last_episode_starts,
        "recent": json.dumps([[*model.ep_info_buffer], [*model.ep_success_buffer]], default=float),
        "episodes": worlds.state(),
        "scale": None
        if scale is None
        else [scale.returns, *map(float, vars(scale.ret_rms).values())],
        "memory": None if buffer is None else {k: v.copy() for k, v in _memory(buffer).items()},
        "place": None if buffer is None else [buffer.pos, buffer.full],
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state() if torch.cuda.is_available() else None,
        "numpy": [str(kind), [*map(int, keys)], *numpy_rest],
        "python": [version, list(python_words), gauss],
        "actions": json.dumps(model.action_space.np_random.bit_generator.state),
    }
    stream = io.BytesIO()
    torch.save(_tensors(data), stream)
    place = made(folder / "checkpoints")
    write_durably(place / f"{model.num_timesteps}.pt", stream.getvalue())
    for old in checkpoints(folder)[:-2]:
        with suppress(OSError):
            old.unlink()


def resume(model: Any, worlds: Episodes, path: Path) -> dict[str, Any]:
    """Take a model and its worlds to where a checkpoint was written, bit for bit.

    Returns:
        What else was written.

    Raises:
        UnreadableFile: It is damaged, or of another network.
    """
    try:
        with zipfile.ZipFile(path) as file:
            if (damaged := file.testzip()) is not None:  # torch does not look
                raise ValueError(damaged)
        data = torch.load(path, map_location="cpu", weights_only=True)
        model.set_parameters(data["parameters"], exact_match=True)
        if data["entropy"] is not None:
            model.log_ent_coef.data.copy_(data["entropy"])
        for name, value in data["counters"].items():
            setattr(model, name, value)
        if data["rate"] is not None:
            model.learning_rate = data["rate"]
            model._setup_lr_schedule()
        model._last_obs = worlds.resume(data["episodes"])
        model._last_episode_starts = data["starts"].numpy()
        recent = (deque(rows, model._stats_window_size) for rows in json.loads(data["recent"]))
        model.ep_info_buffer, model.ep_success_buffer = recent
        if (scale := model.get_vec_normalize_env()) is not None:
            returns, scale.ret_rms.mean, scale.ret_rms.var, scale.ret_rms.count = data["scale"]
            scale.returns = returns.numpy()
        if data["memory"] is not None:
            model.replay_buffer.pos, model.replay_buffer.full = data["place"]
            for name, array in _memory(model.replay_buffer).items():
                array[...] = data["memory"][name].numpy()
        torch.set_rng_state(data["torch"])
        if data["cuda"] is not None and torch.cuda.is_available():
            torch.cuda.set_rng_state(data["cuda"])
        np.random.set_state(tuple(data["numpy"]))  # noqa: NPY002
        version, python_words, gauss = data["python"]
        random.setstate((version, tuple(python_words), gauss))
        model.action_space.np_random.bit_generator.state = json.loads(data["actions"])
        return dict(json.loads(data["more"]))
    except Exception as error:  # of many kinds: torch, pickle, zip, Stable-Baselines3
        advice = "remove this file to go on from the checkpoint before it, or from the beginning"
        raise UnreadableFile(
            str(path), f"it is damaged or of another training: {error}", advice
        ) from None


def _memory(buffer: Any) -> dict[str, Any]:
    """List the arrays of a replay buffer, as far as they are filled."""
    filled = slice(0, buffer.size())
    found: dict[str, Any] = {}
    for name, value in vars(buffer).items():
        for part, array in value.items() if isinstance(value, dict) else [("", value)]:
            if isinstance(array, np.ndarray) and array.dtype != object:
                rows = array[filled] if len(array) == buffer.buffer_size else array
                found[f"{name}.{part}"] = rows
    return found


def _tensors(data: Any) -> Any:
    """Replace arrays by tensors, all the way down."""
    if isinstance(data, dict):
        return {name: _tensors(value) for name, value in data.items()}
    if isinstance(data, list):
        return [_tensors(value) for value in data]
    return torch.from_numpy(np.ascontiguousarray(data)) if isinstance(data, np.ndarray) else data


# --- between the rounds ---------------------------------------------------------------------------


@final
class Watch(BaseCallback):
    """Writes curves, evaluations, policies and checkpoints between the rounds of a training.

    Args:
        recipe: How the agent is trained.
        worlds: In which it learns.
        folder: Of the run.
        backend: Name of the backend, for evaluations.
        card: What is said of the policy.
        progress: Called with how many steps are done.
        tell: Called with a sentence about each event.
        every: Seconds between checkpoints.

    Attributes:
        stop: Whether the training has to end after the present round.
        score: The best one so far, if there was an evaluation.
    """

    def __init__(
        self,
        recipe: Recipe,
        worlds: Episodes,
        folder: Path,
        *,
        backend: str,
        card: Mapping[str, Any],
        progress: Progress | None,
        tell: Callable[[str], None],
        every: float,
    ) -> None:
        super().__init__()
        self.recipe, self._worlds, self._folder, self._backend = recipe, worlds, folder, backend
        self._card, self._progress, self._tell, self._every = dict(card), progress, tell, every
        self._kept, self._seen, self._tries = time.perf_counter(), 0, 0
        self._told = time.perf_counter(), 0
        self.score: float | None = None
        self.stop = False

    def resume(self, model: Any, path: Path) -> None:
        """Resume from a checkpoint, perhaps with more steps than before."""
        self.score = resume(model, self._worlds, path)["score"]
        self._seen, self._tries = model.num_timesteps, self._due(model.num_timesteps)
        self._told = time.perf_counter(), model.num_timesteps

    # --- called by Stable-Baselines3 ---

    def _on_training_start(self) -> None:
        self._prepare()

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps > self._seen:
            self._look(is_last=False)
        if self.stop:
            raise KeyboardInterrupt

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._look(is_last=True)

    # --- parts of that ---

    def _look(self, *, is_last: bool) -> None:
        """Look at what a round has learned, and keep it if it is time."""
        steps, recipe = self.model.num_timesteps, self.recipe
        self._seen = steps
        if not self.is_finite:
            raise Diverged(steps)
        divergence = self.logger.name_to_value.get("train/approx_kl")
        if recipe.rate.schedule == "adaptive" and divergence is not None and self._learns:
            now = adapted(recipe.rate, self.model.learning_rate, float(divergence))
            self.model.learning_rate = now
            self.model._setup_lr_schedule()
        self._prepare()
        recent = self.model.ep_info_buffer
        if recent and FRACTION in recent[0]:
            found = float(np.mean([episode[FRACTION] for episode in recent]))
            self.logger.record(f"rollout/{FRACTION}", found)
        self.logger.record("time/cpu_seconds", time.process_time())
        if self._progress is not None:
            self._progress(min(steps, recipe.steps), recipe.steps)
        now = time.perf_counter()
        if now - self._told[0] >= LINES and steps > self._told[1]:
            rate = (steps - self._told[1]) / (now - self._told[0])
            self._told = now, steps
            self._tell(self._line(steps, rate))
        if recipe.trials.protocols and self._due(steps) > self._tries:
            self._tries = self._due(steps)
            begun = time.perf_counter()
            self._evaluate(steps)
            self._told = self._told[0] + time.perf_counter() - begun, self._told[1]
        if is_last or self.stop or time.perf_counter() - self._kept >= self._every:
            self._keep()

    @property
    def is_finite(self) -> bool:
        """Whether all weights of the policy, and its standard deviations, are finite."""
        parts = list(self.model.policy.parameters())
        if hasattr(self.model.policy, "log_std"):
            parts += [self.model.policy.log_std.exp(), (-self.model.policy.log_std).exp()]
        return all(bool(part.isfinite().all()) for part in parts)

    @property
    def _learns(self) -> bool:
        """Whether the policy was learned in the last round, and not the value alone."""
        return bool(self.model.policy.action_net.bias.requires_grad)

    def _prepare(self) -> None:
        """Freeze PPO's policy while only the value is learned; lower its standard deviations."""
        recipe, policy, steps = self.recipe, self.model.policy, self.model.num_timesteps
        if recipe.critic_warmup:
            for part in (policy.mlp_extractor.policy_net, policy.action_net, policy.log_std):
                part.requires_grad_(steps >= recipe.critic_warmup)
        if recipe.network.log_std_end is not None:
            first, done = recipe.network.log_std, min(steps / recipe.steps, 1.0)
            with torch.no_grad():
                policy.log_std.clamp_(max=first + done * (recipe.network.log_std_end - first))

    def _line(self, steps: int, rate: float) -> str:
        """Say what the last episodes of training gave, and how fast it is.

        Args:
            steps: That are done.
            rate: Of them in a second.
        """
        episodes, solved, said = self.model.ep_info_buffer, self.model.ep_success_buffer, []
        if episodes:
            said.append(f"return {np.mean([episode['r'] for episode in episodes]):.3g}")
        if solved:
            said.append(f"success {np.mean(solved):.2f}")
        left = max(self.recipe.steps - steps, 0) / rate
        said.append(f"{rate:,.0f} steps per second, about {clock(left)} left")
        return f"{steps:,} of {self.recipe.steps:,} steps: {', '.join(said)}"

    def _due(self, steps: int) -> int:
        """Return how many evaluations there should have been after so many steps."""
        return self.recipe.trials.times * steps // self.recipe.steps

    def _policy(self, **more: Any) -> Any:
        card = {**self._card, "steps": self.model.num_timesteps, **more}
        return exported(self.model, self.recipe, card)

    def _evaluate(self, steps: int) -> None:
        """Evaluate, and keep the policy if none was better."""
        recipe = self.recipe
        policy = self._policy()
        metric, scores = scored(policy, recipe.task, recipe.options, recipe.trials, self._backend)
        score = mean(scores)
        found = {"steps": steps, "metric": metric, "mean": score, "scores": scores}
        path = made(self._folder / "evaluations") / f"{steps}.json"
        write_whole(json.dumps(found, indent=2), path)
        self._tell(f"{steps:,} steps: {words(scores)}")
        for name, value in scores.items():
            self.logger.record(f"evaluation/{name}", value)
        if score is not None and (self.score is None or score > self.score):
            self.score = score
            about = policy.about.with_card(trial={"steps": steps, "scores": scores})
            save_policy(self._folder / "best.safetensors", policy, about)

    def _keep(self) -> None:
        """Write the policy, and a checkpoint: after the last one nothing is left to do."""
        save_policy(self._folder / "policy.safetensors", self._policy())
        begun = time.perf_counter()
        write_checkpoint(self.model, self._worlds, {"score": self.score}, self._folder)
        self._kept = time.perf_counter()
        if self._kept - begun > 0.05 * self._every > 0.0:  # of a large replay buffer
            self._every = 20.0 * (self._kept - begun)
