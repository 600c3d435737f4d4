"""PPO of rsl-rl in thousands of worlds: networks, storage and updates stay on the device."""

from __future__ import annotations

import csv
import io
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import missing
from scm_world.env.observer import FAILED
from scm_world.env.tensors import HostEnvs, TensorEnvs, has_device
from scm_world.errors import Diverged, UnknownOption
from scm_world.policies import MlpPolicy, PolicyAbout, load_policy, save_policy
from scm_world.policies.cards import OPTIONS
from scm_world.queries.progress import Progress, Tell
from scm_world.runs.files import make_folder, write_whole
from scm_world.runs.study import Study
from scm_world.training.export import begin_tensors
from scm_world.training.logs import Log
from scm_world.training.recipe import Recipe
from scm_world.training.rounds import Rounds, restore_last
from scm_world.training.settings import Ppo
from scm_world.training.worlds import SEEDS, SUCCESS, actor_columns, make_envs, scales

try:
    import torch
    from rsl_rl.algorithms import PPO
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage
    from tensordict import TensorDict
except ImportError as error:
    raise missing(error, "rsl_rl", "rsl-rl-lib", "scale") from error

SEEN = "seen"
"""The group of observations."""

ALL = "all"
"""The group of observations of a critic that observes more."""

BOUND = 10.0
"""Largest size of a scaled reward."""

RECENT = 100
"""Number of episodes of which curves are means."""


@final
class ManyPpo:
    """PPO of rsl-rl in the worlds of a recipe.

    Where the engine has its states on a device, observations, rewards and commands are computed
    there, by ``TensorEnvs``; else by the environments, on the host. Where an episode is cut off,
    the value of its last observation takes the place of the rewards that are left.

    Args:
        recipe: How it is trained.
        backend: Name of the engine.
        seed: Seed of all that is drawn.
        device: Where networks are computed.
        threads: Threads of the engine.

    Attributes:
        num_timesteps: Number of control steps so far, in all worlds together.
        news: Sentences about where control steps are computed; the caller empties it.

    Source:
        Rudin et al., *Learning to Walk in Minutes Using Massively Parallel Deep Reinforcement
        Learning*, CoRL 2021.
    """

    def __init__(
        self, recipe: Recipe, *, backend: str, seed: int, device: str, threads: int | None
    ) -> None:
        self.recipe, self.device, self.num_timesteps = recipe, device, 0
        self._envs: Any = make_envs(recipe, backend=backend, threads=threads, seed=seed)
        try:
            self._build(seed)
        except BaseException:
            self.close()
            raise

    def _build(self, seed: int) -> None:
        recipe, envs, kept = self.recipe, self._envs, self.recipe.settings
        assert isinstance(kept, Ppo)  # noqa: S101 # the recipe has checked it
        space = envs.single_observation_space
        if hasattr(space, "spaces"):
            raise UnknownOption(
                "observations", space, ("one vector: goal environments have parts",)
            )
        (self.world, *_) = envs.get_attr("world")
        (self._length, *_) = envs.get_attr("limit")
        (layout, *_) = envs.get_attr("layout")
        (appended, *_) = envs.get_attr("appended")
        scale = np.ones(space.shape)
        if recipe.network.scaled:
            scale = scales(layout, space, recipe.options)
        self._columns = actor_columns(recipe, layout, appended)
        self.scale = np.asarray(scale, np.float32)[self._columns]
        self._scale = torch.as_tensor(scale, dtype=torch.float32, device=self.device)
        self._seed = (seed + 1) * SEEDS
        torch.manual_seed(seed)
        n, n_actions = recipe.worlds, envs.single_action_space.shape[0]
        first = self._seen(np.zeros((n, *space.shape), np.float32))
        groups = {"actor": [SEEN], "critic": [ALL if recipe.observations == "critic" else SEEN]}
        network = recipe.network
        shape: dict[str, Any] = {"hidden_dims": [*network.hidden], "activation": network.activation}
        normal = {
            "class_name": "GaussianDistribution",
            "init_std": float(np.exp(network.log_std)),
            "std_type": "log",
        }
        self._actor = MLPModel(first, groups, "actor", n_actions, distribution_cfg=normal, **shape)
        self._critic = MLPModel(first, groups, "critic", 1, **shape)
        if network.orthogonal:
            gains = [*[2.0**0.5] * 2 * len(network.hidden), 1.0]
            self._actor.mlp.init_weights((*gains[:-1], 0.01))
            self._critic.mlp.init_weights(tuple(gains))
        self._ppo = PPO(
            self._actor,
            self._critic,
            RolloutStorage("rl", n, kept.n_steps, first, [n_actions], self.device),
            num_learning_epochs=kept.n_epochs,
            num_mini_batches=max(1, n * kept.n_steps // kept.batch_size),
            clip_param=kept.clip_range,
            gamma=kept.gamma,
            lam=kept.gae_lambda,
            value_loss_coef=kept.vf_coef,
            entropy_coef=kept.ent_coef,
            learning_rate=recipe.rate.initial,
            max_grad_norm=kept.max_grad_norm,
            use_clipped_value_loss=kept.clip_range_vf is not None,
            schedule="adaptive" if recipe.rate.schedule == "adaptive" else "fixed",
            desired_kl=recipe.rate.target_kl,
            normalize_advantage_per_mini_batch=True,
            device=self.device,
        )
        # Of rewards: mean, variance and number of discounted returns, and those under way.
        self._moments = torch.tensor([0.0, 1.0, 1e-4], dtype=torch.float64, device=self.device)
        self._returns = torch.zeros(n, dtype=torch.float64, device=self.device)
        self._now: TensorDict | None = None
        self.ended = deque[dict[str, float]](maxlen=RECENT)
        self.over = self.failed = 0  # episodes
        self.news: list[str] = []

    def close(self) -> None:
        """Free the engine."""
        self._envs.close()

    # --- worlds ---------------------------------------------------------------------------------

    def _seen(self, observation: Any) -> TensorDict:
        rows = torch.as_tensor(observation, device=self.device) * self._scale
        seen = {SEEN: rows}
        if self.recipe.observations == "critic":
            seen = {SEEN: rows[:, self._columns], ALL: rows}
        return TensorDict(seen, batch_size=[len(rows)], device=self.device)

    def _begin(self) -> TensorDict:
        """Begin all episodes; staggered, world i of n begins i / n of an episode later."""
        envs, n = self._envs, self.recipe.worlds
        seen, _ = envs.reset(seed=self._seed)
        self._worlds: TensorEnvs | HostEnvs = HostEnvs(envs, seen)
        if has_device(envs):
            self._worlds = TensorEnvs(envs)
            self._stay_or_leave()
            hosted = ", ".join(self._worlds.on_host)
            if hosted:
                self.news.append(f"computed on the host, in each step: {hosted}")
        begin = self._length * np.arange(n) // n
        idle = torch.zeros(envs.action_space.shape)
        for step in range(1, int(begin[-1]) + 1 if self.recipe.staggered else 0):
            self._worlds.step(idle)
            if (late := begin == step).any():
                self._worlds.reset(late)
            self._stay_or_leave()
        # Of the episodes under way: their returns and lengths.
        self._sums, self._lengths = torch.zeros((2, n), dtype=torch.float64, device=self.device)
        return self._seen(self._worlds.seen)

    def _stay_or_leave(self) -> None:
        """Compute control steps on the host from now on, if the device cannot."""
        if self._worlds.why_not:
            self.news.append(f"control steps are computed on the host: {self._worlds.why_not}")
            self._worlds.leave()
            self._worlds = HostEnvs(self._envs, self._worlds.seen)

    def _scaled(self, rewards: torch.Tensor, done: torch.Tensor) -> torch.Tensor:
        """Divide rewards by the running standard deviation of the discounted return."""
        if not self.recipe.scale_rewards:
            return rewards
        self._returns = self._returns * self.recipe.settings.gamma + rewards
        mean, variance, count = self._moments
        n, apart = len(rewards), self._returns.mean() - mean
        total = count + n
        spread = self._returns.var(correction=0) * n + apart**2 * count * n / total
        self._moments = torch.stack(
            (mean + apart * n / total, (variance * count + spread) / total, total)
        )
        self._returns[done] = 0.0
        return (rewards / (self._moments[1] + 1e-8).sqrt()).clip(-BOUND, BOUND)

    def _step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor]:
        """Take a control step in all worlds: observations, scaled rewards, and which are over."""
        now = self._worlds.step(actions.clamp(-1.0, 1.0))
        rewards, terminated = now.rewards.to(self.device), now.terminated.to(self.device)
        done = terminated | now.truncated.to(self.device)
        self._sums += rewards
        self._lengths += 1.0
        earned = self._scaled(rewards, done).float()
        if len(rows := now.rows):
            value = self._critic(self._seen(now.last))[:, 0]
            earned[rows] += self.recipe.settings.gamma * value * ~terminated[rows]
            facts = {"return": self._sums[rows], "length": self._lengths[rows], **now.facts}
            table = {name: np.asarray(column.tolist(), float) for name, column in facts.items()}
            self.failed += int(table.pop(FAILED).sum())
            self.over += len(rows)
            columns = (zip(table, row, strict=True) for row in zip(*table.values(), strict=True))
            self.ended.extend(map(dict, columns))
            self._sums[rows], self._lengths[rows] = 0.0, 0.0
            self._stay_or_leave()
        return self._seen(now.seen), earned, done

    def round(self) -> dict[str, float]:
        """Play ``n_steps`` in all worlds, and update the networks; return the losses."""
        self._ppo.train_mode()
        rate = self.recipe.rate
        if rate.schedule == "linear":
            left = 1.0 - min(self.num_timesteps / self.recipe.steps, 1.0)
            self._set_rate(rate.initial * (rate.final + (1.0 - rate.final) * left))
        with torch.inference_mode():
            now = self._begin() if self._now is None else self._now
            for _ in range(self._ppo.storage.num_transitions_per_env):
                actions = self._ppo.act(now)
                now, rewards, done = self._step(actions)
                self._ppo.process_env_step(now, rewards, done, {})
            self._ppo.compute_returns(now)
        self._now = now
        self.num_timesteps += self.recipe.round
        losses: dict[str, float] = self._ppo.update()
        if rate.schedule == "adaptive":
            self._set_rate(min(max(self._ppo.learning_rate, rate.lowest), rate.highest))
        if self.recipe.network.log_std_end is not None:
            first, done_share = self.recipe.network.log_std, self.num_timesteps / self.recipe.steps
            most = first + min(done_share, 1.0) * (self.recipe.network.log_std_end - first)
            with torch.no_grad():
                self._actor.distribution.log_std_param.clamp_(max=most)
        if not all(bool(one.isfinite().all()) for one in self.tensors().values()):
            raise Diverged(self.num_timesteps)
        return {**losses, "learning_rate": self._ppo.learning_rate}

    def _set_rate(self, rate: float) -> None:
        self._ppo.learning_rate = rate
        for group in self._ppo.optimizer.param_groups:
            group["lr"] = rate

    # --- files ----------------------------------------------------------------------------------

    def tensors(self) -> dict[str, Any]:
        """Return the tensors of policy and value, by their names in a policy file."""
        found = {"log_std": self._actor.distribution.log_std_param}
        for name, model in (("layers", self._actor), ("value.layers", self._critic)):
            linear = [part for part in model.mlp if hasattr(part, "weight")]
            for number, layer in enumerate(linear):
                found[f"{name}.{number}.weight"] = layer.weight
                found[f"{name}.{number}.bias"] = layer.bias
        return found

    def policy(self, card: Mapping[str, Any]) -> MlpPolicy:
        """Return the policy, without torch."""
        tensors = {name: one.detach().cpu().numpy().copy() for name, one in self.tensors().items()}
        if self.recipe.observations == "critic":  # the value observes more
            tensors = {name: one for name, one in tensors.items() if not name.startswith("value")}
        for name in tensors:
            if name.endswith("layers.0.weight"):
                tensors[name] *= self.scale
        env = {name: value for name, value in self.recipe.options.items() if name in OPTIONS}
        about = PolicyAbout(task=self.recipe.task, env=env, card=dict(card))
        form = {"activation": self.recipe.network.activation, "output": "clip", "inputs": None}
        return MlpPolicy.of(tensors, {**about.model_dump(), **form})

    def state(self) -> bytes:
        """Return weights, optimizer, scale of rewards and random numbers, as a file of torch."""
        torch.save({**self._ppo.save(), "rewards": self._moments}, file := io.BytesIO())
        return file.getvalue()

    def restore(self, content: bytes, steps: int) -> str:
        """Restore what ``state`` returned, after so many control steps; episodes begin anew.

        Only tensors are read, which runs no code. Nothing else is to be said of it.
        """
        found = torch.load(io.BytesIO(content), map_location=self.device, weights_only=True)
        self._ppo.load(found, None, strict=True)
        self._moments = found["rewards"]
        self.num_timesteps = steps
        torch.manual_seed(self._seed + steps)
        self._seed += steps  # other episodes than those before
        return ""


@contextmanager
def opened(
    recipe: Recipe, *, backend: str, seed: int, device: str, threads: int | None
) -> Iterator[tuple[ManyPpo, Any]]:
    """Make the algorithm of a recipe with its worlds; yield it, and one of them."""
    how: dict[str, Any] = {"seed": seed, "device": device, "threads": threads}
    with closing(ManyPpo(recipe, backend=backend, **how)) as model:
        yield model, model.world


def begin_with(model: ManyPpo, recipe: Recipe, start: Path | str) -> None:
    """Initialise policy and value with the weights of a policy file."""
    mine = model.policy({})
    tensors = {name: one for name, one in model.tensors().items() if name in mine.tensors()}
    begin_tensors(load_policy(start), mine, start, tensors, model.scale)


def learn(
    model: ManyPpo,
    recipe: Recipe,
    study: Study,
    *,
    backend: str,
    card: Mapping[str, Any],
    progress: Progress | None,
    tell: Tell,
    begun: bool,  # whether the weights are those of a policy
    log: Log,
) -> float | None:
    """Learn the remaining steps; write the curve, checkpoints, evaluations and the policy.

    Returns:
        The best score in the evaluations; None without any.

    Raises:
        Diverged: Weights are not finite any more.
        UnwritableFolder: The disk is full, or permission is missing.
    """
    folder = Path(str(study.folder))
    make_folder(study.path("checkpoints"))

    def policy() -> MlpPolicy:
        return model.policy({**card, "steps": model.num_timesteps})

    def save() -> None:
        study.keep(f"checkpoints/run_{model.num_timesteps}_steps.zip", model.state())
        save_policy(folder / "policy.safetensors", policy())

    restore_last(study, model.restore, tell)
    first = model.num_timesteps
    curve, rows = folder / (f"progress-{first}.csv" if first else "progress.csv"), []
    how: dict[str, Any] = {"backend": backend, "progress": progress, "tell": tell}
    how["seed"] = card["seed"]
    rounds = Rounds(recipe, study, **how, save=save, policy=policy)
    rounds.begin(first)
    try:
        while model.num_timesteps < recipe.steps:
            losses, recent = model.round(), dict(_recent(model))
            while model.news:
                tell(model.news.pop(0))
            steps = model.num_timesteps
            rows.append({**recent, **{f"train/{n}": v for n, v in losses.items()}})
            rows[-1] |= {"time/total_timesteps": steps, "time/cpu_seconds": time.process_time()}
            means = {name.partition("/")[2]: value for name, value in recent.items()}
            scores = rounds.look(steps, (f"{name} {value:.3g}" for name, value in means.items()))
            rows[-1] |= {f"evaluation/{name}": value for name, value in scores.items()}
            log(rows[-1], steps)
    finally:  # also after Ctrl-C
        if rows:
            _write(curve, rows)
            save()
    if model.failed:
        tell(f"{model.failed:,} of {model.over:,} episodes ended as states grew beyond all bounds")
    return rounds.scores.best


def _recent(model: ManyPpo) -> Iterator[tuple[str, float]]:
    names = {
        "return": "rollout/ep_rew_mean",
        "length": "rollout/ep_len_mean",
        SUCCESS: "rollout/success_rate",
        "fractional_success": "rollout/fractional_success",
    }
    for name, column in names.items():
        values = [one[name] for one in model.ended if name in one]
        if values:
            yield column, float(np.mean(values))


def _write(path: Path, rows: list[dict[str, float]]) -> None:
    """Write the learning curve, whole or not at all."""
    columns = dict.fromkeys(name for row in rows for name in row)
    table = csv.DictWriter(text := io.StringIO(), [*columns], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_whole(path, text.getvalue())
