"""Algorithms of Stable-Baselines3, as a recipe says, and the callback between their rounds."""

from __future__ import annotations

import io
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, final

import gymnasium
import numpy as np

from scm_world._arguments import load, missing
from scm_world._types import Floats
from scm_world.env.observer import FAILED
from scm_world.errors import (
    Diverged,
    ScmWorldError,
    UnwritableFolder,
    in_one_line,
)
from scm_world.policies import MlpPolicy, save_policy
from scm_world.queries.progress import Progress, Tell
from scm_world.runs.files import make_folder, read_arrays
from scm_world.runs.study import Study
from scm_world.training.export import begin_with, exported
from scm_world.training.logs import Log
from scm_world.training.recipe import Recipe
from scm_world.training.rounds import Rounds, restore_last
from scm_world.training.sb3 import Sb3VecEnv
from scm_world.training.settings import Ppo, Rate
from scm_world.training.worlds import SEEDS, SUCCESS, actor_columns, make_envs, scales

try:
    import stable_baselines3
    import tensorboard  # noqa: F401 # its logger asks for it late
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import KVWriter, Logger, make_output_format
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.save_util import load_from_zip_file, recursive_setattr
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
    from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize
except ImportError as error:
    raise missing(error, "stable_baselines3", "stable-baselines3", "train") from error

__all__ = ["begin_with", "learn", "opened"]

FRACTION = "fractional_success"


# --- worlds ---------------------------------------------------------------------------------------


@final
class Episodes(VecMonitor):
    """Counts episodes; worlds may begin at different steps of their episodes.

    If they are ``staggered``, world i of n begins an episode i / n of its ``length`` later than the
    first one, with actions of zero until then: else a batch shows one place of all episodes only.
    """

    def __init__(self, env: Sb3VecEnv, length: int, *, staggered: bool) -> None:
        super().__init__(env, info_keywords=env.names)
        self.length, self._staggered = length, staggered

    def reset(self) -> Any:
        """Begin an episode in all worlds."""
        seen = super().reset()
        begin = self.length * np.arange(self.num_envs) // self.num_envs
        idle = np.zeros((self.num_envs, *self.action_space.shape), np.float32)
        for step in range(1, int(begin[-1]) + 1 if self._staggered else 0):
            self.step(idle)
            if (late := begin == step).any():
                seen, _ = self.venv.worlds.reset(options={"reset_mask": late})
                self.episode_returns[late], self.episode_lengths[late] = 0.0, 0
        return seen


def make_worlds(
    recipe: Recipe, *, backend: str, threads: int | None = None, seed: int = 0
) -> Episodes:
    """Make the worlds of a recipe for Stable-Baselines3; see ``make_envs``."""
    envs = make_envs(recipe, backend=backend, threads=threads, seed=seed)
    try:
        vec_env = Sb3VecEnv(envs, [])
        (there,) = vec_env.get_attr("info_shapes", 0)
        vec_env.names = tuple(name for name in (SUCCESS, FRACTION, FAILED) if name in there)
        (length,) = vec_env.get_attr("limit", 0)
        return Episodes(vec_env, length, staggered=recipe.staggered)
    except BaseException:
        envs.close()
        raise


# --- algorithms -----------------------------------------------------------------------------------


@final
class Scaled(BaseFeaturesExtractor):
    """Observations, one part after another, times fixed scales."""

    def __init__(self, space: gymnasium.Space[Any], scale: Floats) -> None:
        super().__init__(space, len(scale))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32), persistent=False)

    def forward(self, observations: torch.Tensor | dict[str, torch.Tensor]) -> torch.Tensor:
        """Scale a batch of observations."""
        if isinstance(observations, dict):
            observations = torch.cat([part.flatten(1) for part in observations.values()], 1)
        return observations.float() * self.scale


@final
class Columns(torch.nn.Module):
    """Some of the numbers of an observation."""

    def __init__(self, columns: Any) -> None:
        super().__init__()
        self.register_buffer("which", torch.as_tensor(columns), persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Choose them from a batch of observations."""
        return observations[:, self.which]


@final
class BlindActor(ActorCriticPolicy):
    """A policy of which the actor observes some numbers only, and the critic all."""

    def __init__(self, *given: Any, columns: Any, **options: Any) -> None:
        self.columns = columns
        super().__init__(*given, **options)

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        how = self.net_arch, self.activation_fn, self.device
        body = MlpExtractor(len(self.columns), *how).policy_net
        self.mlp_extractor.policy_net = torch.nn.Sequential(Columns(self.columns), *body)


def make_learner(
    recipe: Recipe, worlds: Episodes, *, seed: int, device: str = "cpu"
) -> BaseAlgorithm:
    """Make the algorithm of a recipe: ``PPO``, ``SAC``, … of Stable-Baselines3."""
    network, settings = recipe.network, recipe.settings.model_dump()
    policy: dict[str, Any] = {
        "net_arch": list(network.hidden),
        "activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[network.activation],
    }
    library, kind, suffix = stable_baselines3, recipe.algo.upper(), "Policy"
    if recipe.algo == "recurrent_ppo":
        library = load("sb3_contrib", "sb3-contrib", "train")
        kind, suffix = "RecurrentPPO", "LstmPolicy"
        policy["lstm_hidden_size"] = network.recurrent
    if isinstance(recipe.settings, Ppo):
        policy |= {"log_std_init": network.log_std, "ortho_init": network.orthogonal}
    if network.scaled:
        (layout,) = worlds.get_attr("layout", 0)
        scale = scales(layout, worlds.observation_space, recipe.options)
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
    env: VecEnv = worlds
    if recipe.scale_rewards:
        env = VecNormalize(worlds, norm_obs=False, gamma=settings["gamma"])
    is_dict = hasattr(worlds.observation_space, "spaces")
    networks: Any = ("MultiInput" if is_dict else "Mlp") + suffix
    if recipe.observations == "critic":
        (layout,), (appended,) = worlds.get_attr("layout", 0), worlds.get_attr("appended", 0)
        networks, policy["columns"] = BlindActor, actor_columns(recipe, layout, appended)
    model = getattr(library, kind)(
        networks,
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
    """Return the adaptive learning rate after an update, of a divergence from the old policy."""
    if divergence > 2.0 * rate.target_kl:
        return max(now / 1.5, rate.lowest)
    return min(now * 1.5, rate.highest) if divergence < rate.target_kl / 2.0 else now


# --- checkpoints ----------------------------------------------------------------------------------


def save_checkpoint(model: BaseAlgorithm, study: Study) -> None:
    """Write the weights, the optimizers, and the memory of the model, of which one file is kept.

    The memory is a file of arrays: reading it runs no code, other than the pickle of
    ``save_replay_buffer``.
    """
    place = Path(str(make_folder(study.path("checkpoints"))))
    memory = place / f"memory_{model.num_timesteps}.npz"
    if parts := _remembered(model):
        np.savez(draft := place / "draft.npz", **parts)
        draft.replace(memory)
    model.save(archive := io.BytesIO())
    study.keep(f"checkpoints/run_{model.num_timesteps}_steps.zip", archive.getvalue())
    for old in {*place.glob("memory_*.npz")} - {memory}:
        old.unlink()


def _remembered(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the filled rows of the replay buffer, as views, and the scale of rewards, by name."""
    found: dict[str, Any] = {}
    if (scaled := model.get_vec_normalize_env()) is not None:
        rewards = scaled.ret_rms
        found["rewards"] = np.array([rewards.mean, rewards.var, rewards.count])
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        return found
    for name, value in vars(buffer).items():
        for key, part in value.items() if isinstance(value, dict) else [("", value)]:
            if isinstance(part, np.ndarray) and part.dtype != object:  # else empty dictionaries
                is_long = len(part) == buffer.buffer_size
                found[f"buffer.{name}.{key}"] = part[: buffer.size()] if is_long else part
    return {**found, "at": np.array([buffer.pos, buffer.full])}


def _remember(model: BaseAlgorithm, path: Path) -> None:
    """Restore the arrays of ``_remembered``; episodes that were under way are cut off."""
    file = read_arrays(path)
    if "rewards" in file:
        scale = model.get_vec_normalize_env().ret_rms
        scale.mean, scale.var, scale.count = file["rewards"]
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        return
    buffer.pos, buffer.full = int(file["at"][0]), bool(file["at"][1])
    for name, part in _remembered(model).items():
        part[...] = file[name]  # views of its arrays; the others are copies
    if hasattr(buffer, "truncate_last_trajectory"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            buffer.truncate_last_trajectory()
    elif buffer.size():
        begun = buffer.dones[buffer.pos - 1] == 0.0
        buffer.dones[buffer.pos - 1, begun] = buffer.timeouts[buffer.pos - 1, begun] = 1.0


def restore(model: BaseAlgorithm, content: bytes, steps: int, memory: Path) -> str:
    """Restore what ``save_checkpoint`` wrote, and the number of steps; other episodes follow.

    Only tensors and arrays are read, which runs no code.

    Returns:
        What is not as before, in words.
    """
    _, parameters, variables = load_from_zip_file(
        io.BytesIO(content), device="cpu", load_data=False
    )
    model.set_parameters(parameters, exact_match=True, device=model.device)
    for name, tensor in (variables or {}).items():
        recursive_setattr(model, f"{name}.data", tensor.data.to(model.device))
    model.num_timesteps = steps
    model.set_random_seed(((seed := model.seed or 0) + steps) % 2**32)
    model.get_env().seed((seed + 1) * SEEDS + steps)
    if hasattr(model, "clip_range") and not callable(model.learning_rate):
        model.learning_rate = model.policy.optimizer.param_groups[0]["lr"]  # it may adapt
        model._setup_lr_schedule()
    if not _remembered(model):
        return ""
    try:
        _remember(model, memory)
    except Exception as error:
        said = f" without its memory ({in_one_line(error)}), which is filled anew"
        if hasattr(model, "learning_starts"):
            said += f" by {model.learning_starts:,} random steps"
            model.learning_starts += steps
        return said
    return ""


def resume(model: BaseAlgorithm, study: Study, tell: Tell) -> None:
    """Restore the last checkpoint."""
    place = Path(str(study.path("checkpoints")))
    restore_last(study, lambda it, at: restore(model, it, at, place / f"memory_{at}.npz"), tell)


@contextmanager
def opened(
    recipe: Recipe, *, backend: str, seed: int, device: str, threads: int | None
) -> Iterator[tuple[BaseAlgorithm, Any]]:
    """Make the algorithm of a recipe with its worlds; yield it, and one of them."""
    with closing(make_worlds(recipe, backend=backend, threads=threads, seed=seed)) as worlds:
        (world,) = worlds.get_attr("world", 0)
        yield make_learner(recipe, worlds, seed=seed, device=device), world


def learn(
    model: BaseAlgorithm,
    recipe: Recipe,
    study: Study,
    *,
    backend: str,
    card: Mapping[str, Any],
    progress: Progress | None,
    tell: Tell,
    begun: bool,
    log: Log,
    callback: BaseCallback | None,
    tensorboard: bool,
) -> float | None:
    """Learn the steps that are left since the last checkpoint; return the best score.

    ``begun`` is whether the weights are those of a policy; ``log`` takes the numbers of each round.

    Raises:
        UnwritableFolder: The disk is full, or permission is missing.
        Diverged: Weights are not finite any more.
    """
    resume(model, study, tell)
    begins_late = getattr(model, "learning_starts", 0)
    if model.num_timesteps == 0 and begins_late >= recipe.steps:
        tell(f"nothing will be learned: learning starts after {begins_late:,} steps")
    elif model.num_timesteps == 0 and recipe.critic_warmup and not begun:
        said = "this recipe is for a policy that can act (critic_warmup)"
        tell(f"{said}: give it with --start; now the weights are random")
    watch = Watch(recipe, study, backend=backend, card=card, progress=progress, tell=tell)
    if recipe.steps > model.num_timesteps:
        folder, before = Path(str(study.folder)), model.num_timesteps
        outputs = [
            make_output_format("csv", str(folder), f"-{before}" if before else ""),
            Numbers(log),
        ]
        if tensorboard:
            place = str(make_folder(folder / "tensorboard"))
            outputs.append(make_output_format("tensorboard", place))
        model.set_logger(Logger(str(folder), outputs))
        _learn(model, watch, callback, folder)
    return watch.score


@final
class Numbers(KVWriter):
    """Passes the numbers of a round on."""

    def __init__(self, log: Log) -> None:
        self._log = log

    def write(self, key_values: dict[str, Any], key_excluded: object, step: int = 0) -> None:
        """Pass them on."""
        self._log(key_values, step)

    def close(self) -> None:
        """Leave them to who has opened them."""


def _learn(model: BaseAlgorithm, watch: Watch, callback: BaseCallback | None, folder: Path) -> None:
    """Learn the remaining steps; write curves, checkpoints and the policy.

    Raises:
        UnwritableFolder: The disk is full, or permission is missing.
        Diverged: Weights are not finite any more.
    """
    recipe, before = watch.recipe, model.num_timesteps
    every = 1 if isinstance(recipe.settings, Ppo) else recipe.worlds  # rounds, or episodes
    try:
        model.learn(
            recipe.steps - before,
            callback=[watch] if callback is None else [watch, callback],
            reset_num_timesteps=False,
            log_interval=every,
        )
    except KeyboardInterrupt:
        watch.save()
        raise
    except OSError as error:
        if isinstance(error, ScmWorldError):
            raise
        raise UnwritableFolder(str(folder), str(error)) from error
    except ValueError:
        if not hasattr(watch, "model") or watch.is_finite:  # it has none before the first reset
            raise
        raise Diverged(model.num_timesteps) from None  # torch found it before a round was over
    finally:
        model.logger.close()


# --- between the rounds ---------------------------------------------------------------------------


@final
class Watch(BaseCallback):
    """Adapts rates, and writes curves, evaluations and policies between rounds."""

    def __init__(
        self,
        recipe: Recipe,
        study: Study,
        *,
        backend: str,
        card: Mapping[str, Any],
        progress: Progress | None,
        tell: Tell,
    ) -> None:
        super().__init__()
        self.recipe, self._study, self._card, self._tell = recipe, study, dict(card), tell
        self._over = self._failed = 0  # episodes since the training began or was resumed
        about: dict[str, Any] = {"backend": backend, "progress": progress, "tell": tell}
        about["seed"] = self._card["seed"]
        self._rounds = Rounds(recipe, study, **about, save=self.save, policy=self._policy)

    @property
    def score(self) -> float | None:
        """The best score so far."""
        return self._rounds.scores.best

    def _on_training_start(self) -> None:
        self._seen = self.model.num_timesteps
        self._rounds.begin(self._seen)
        self._prepare()

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps > self._seen:
            self._look()

    def _on_step(self) -> bool:
        ends = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self._over += len(ends)
        self._failed += sum(end.get(FAILED, False) for end in ends)
        return True

    def _on_training_end(self) -> None:
        self._look()
        steps = self.model.num_timesteps
        self.logger.record("time/total_timesteps", steps, exclude="tensorboard")
        self.logger.dump(steps)  # with the last evaluation
        self.save()
        if self._failed:
            where = "env={'on_failure': 'raise'} ends the training there and says why"
            self._tell(f"{self._failures}; {where}")

    @property
    def _failures(self) -> str:
        """How many episodes ended since the engine could not go on, in words."""
        return f"{self._failed:,} of {self._over:,} episodes ended as states grew beyond all bounds"

    def save(self) -> None:
        """Write a checkpoint and the policy."""
        save_checkpoint(self.model, self._study)
        save_policy(Path(str(self._study.folder)) / "policy.safetensors", self._policy())

    def _look(self) -> None:
        """Check a round; adapt the rate, write curves and checkpoints, evaluate if it is time."""
        steps, recipe = self.model.num_timesteps, self.recipe
        self._seen = steps
        if not self.is_finite:
            raise Diverged(steps)
        divergence = self.logger.name_to_value.get("train/approx_kl")
        # While only the value is learned, nothing is known of the policy.
        is_adaptive = recipe.rate.schedule == "adaptive" and divergence is not None
        if is_adaptive and self.model.policy.action_net.bias.requires_grad:
            now = adapted(recipe.rate, self.model.learning_rate, float(divergence))
            self.model.learning_rate = now
            self.model._setup_lr_schedule()
        self._prepare()
        recent = self.model.ep_info_buffer
        for name in (FRACTION, FAILED):
            if recent and name in recent[0]:
                found = float(np.mean([episode[name] for episode in recent]))
                self.logger.record(f"rollout/{name}", found)
        self.logger.record("time/cpu_seconds", time.process_time())
        for name, value in self._rounds.look(steps, self._about()).items():
            self.logger.record(f"evaluation/{name}", value)

    @property
    def is_finite(self) -> bool:
        """Whether all weights of the policy, and its standard deviations, are finite."""
        parts = list(self.model.policy.parameters())
        if hasattr(self.model.policy, "log_std"):
            parts += [self.model.policy.log_std.exp(), (-self.model.policy.log_std).exp()]
        return all(bool(part.isfinite().all()) for part in parts)

    def _prepare(self) -> None:
        """Freeze PPO's policy while only the value is learned; lower its standard deviations."""
        recipe, policy, steps = self.recipe, self.model.policy, self.model.num_timesteps
        if recipe.critic_warmup:
            actor = policy.mlp_extractor.policy_net, policy.action_net, policy.log_std
            for part in (*actor, getattr(policy, "lstm_actor", policy.log_std)):
                part.requires_grad_(steps >= recipe.critic_warmup)
        if recipe.network.log_std_end is not None:
            first, done = recipe.network.log_std, min(steps / recipe.steps, 1.0)
            with torch.no_grad():
                policy.log_std.clamp_(max=first + done * (recipe.network.log_std_end - first))

    def _about(self) -> Iterator[str]:
        """Describe the last episodes."""
        episodes, solved = self.model.ep_info_buffer, self.model.ep_success_buffer
        if episodes:
            yield f"return {np.mean([episode['r'] for episode in episodes]):.3g}"
        if solved:
            yield f"success {np.mean(solved):.2f}"
        if self._failed:
            yield self._failures

    def _policy(self) -> MlpPolicy:
        card = {**self._card, "steps": self.model.num_timesteps}
        return exported(self.model, self.recipe, card)
