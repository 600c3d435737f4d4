"""The algorithms of Stable-Baselines3, made as a recipe says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

from scm_world.errors import UnknownOption
from scm_world.graph.exchange.libraries import load
from scm_world.training.recipe import Recipe
from scm_world.training.scaling import extractor, scales_of
from scm_world.training.settings import Rate

DEVICES = ("auto", "cpu", "cuda")
FACTOR = 1.5
"""By which an adaptive learning rate changes."""


def library(module: str = "") -> Any:
    """Import Stable-Baselines3, or a module of it.

    Raises:
        MissingExtra: It is not installed.
    """
    return load(".".join(filter(None, ("stable_baselines3", module))), "stable-baselines3", "train")


def torch() -> Any:
    """Import torch.

    Raises:
        MissingExtra: It is not installed.
    """
    return load("torch", "torch", "train")


@final
class LearningRate:
    """The learning rate of a moment; Stable-Baselines3 calls it.

    Args:
        rate: What it is, and how it changes.

    Attributes:
        now: The present one, where it is adaptive.
    """

    def __init__(self, rate: Rate) -> None:
        self._rate = rate
        self.now = rate.initial

    def __call__(self, left: float) -> float:
        """Give the rate.

        Args:
            left: Share of the training that is left.
        """
        rate = self._rate
        if rate.schedule == "linear":
            left = min(max(left, 0.0), 1.0)
            return rate.initial * (rate.final + (1.0 - rate.final) * left)
        return self.now

    def adapt(self, divergence: float) -> None:
        """Change it after an update.

        Args:
            divergence: Of the new policy from the old one.
        """
        rate = self._rate
        if rate.schedule != "adaptive":
            return
        if divergence > 2.0 * rate.target_kl:
            self.now = max(self.now / FACTOR, rate.lowest)
        elif divergence < rate.target_kl / 2.0:
            self.now = min(self.now * FACTOR, rate.highest)


def make_learner(
    recipe: Recipe, vec_env: Any, *, seed: int, length: int, device: str = "auto"
) -> Any:
    """Make the algorithm of a recipe.

    Args:
        recipe: How an agent is trained.
        vec_env: The worlds.
        seed: Of the weights, and of what is drawn while it learns.
        length: Control steps of an episode.
        device: ``"cpu"``, ``"cuda"``, or ``"auto"``: the GPU for SAC and TD3 if there is one; the
            networks of PPO are too small to gain from it.

    Returns:
        A ``PPO``, ``SAC`` or ``TD3`` of Stable-Baselines3, with ``lr_schedule`` a
        ``LearningRate``.

    Raises:
        MissingExtra: Stable-Baselines3 is not installed.
        UnknownOption: There is no such device.
    """
    size = int(vec_env.action_space.shape[0])
    own = {"ppo": _of_ppo, "sac": _of_sac, "td3": _of_td3}[recipe.algo](recipe, size)
    if recipe.hindsight is not None:
        own |= _of_hindsight(recipe, length)
    kind = getattr(library(), recipe.algo.upper())
    is_dict = hasattr(vec_env.observation_space, "spaces")
    return kind(
        "MultiInputPolicy" if is_dict else "MlpPolicy",
        vec_env,
        learning_rate=LearningRate(recipe.rate),
        policy_kwargs=_network(recipe, vec_env),
        seed=seed,
        device=device_for(recipe, device),
        **own,
    )


def device_for(recipe: Recipe, device: str) -> str:
    """Choose where networks are computed; see ``make_learner``."""
    if device not in DEVICES:
        raise UnknownOption("device", device, DEVICES)
    has_gpu = device != "cpu" and bool(torch().cuda.is_available())
    if device == "cuda" and not has_gpu:
        raise UnknownOption("device", device, ("cpu: torch finds no GPU here",))
    if device == "auto":
        return "cuda" if has_gpu and recipe.algo != "ppo" else "cpu"
    return device


def _network(recipe: Recipe, vec_env: Any) -> dict[str, Any]:
    network = recipe.network
    functions = {"tanh": torch().nn.Tanh, "relu": torch().nn.ReLU}
    found: dict[str, Any] = {
        "net_arch": list(network.hidden),
        "activation_fn": functions[network.activation],
    }
    if recipe.algo == "ppo":
        found |= {"log_std_init": network.log_std, "ortho_init": network.orthogonal}
    if network.scaled:
        found["features_extractor_class"] = extractor()
        found["features_extractor_kwargs"] = {"scale": scales_of(vec_env, recipe.options)}
    return found


def _of_ppo(recipe: Recipe, size: int) -> dict[str, Any]:
    kept: Mapping[str, Any] = recipe.settings.model_dump()
    return dict(kept)


def _of_sac(recipe: Recipe, size: int) -> dict[str, Any]:
    return _sums(recipe)


def _of_td3(recipe: Recipe, size: int) -> dict[str, Any]:
    found = _sums(recipe)
    sigma = found.pop("noise")
    noise = library("common.noise").NormalActionNoise
    import numpy as np

    found["action_noise"] = noise(np.zeros(size), np.full(size, sigma)) if sigma else None
    return found


def _sums(recipe: Recipe) -> dict[str, Any]:
    """Leave out that rewards are summed over one step, which older versions do not know."""
    found = recipe.settings.model_dump()
    if found["n_steps"] == 1:
        del found["n_steps"]
    return found


def _of_hindsight(recipe: Recipe, length: int) -> dict[str, Any]:
    """Give what hindsight needs: it learns when the first episodes of all worlds are over."""
    kept: Any = recipe.settings
    return {
        "replay_buffer_class": library().HerReplayBuffer,
        "replay_buffer_kwargs": recipe.hindsight.model_dump() if recipe.hindsight else {},
        "learning_starts": max(kept.learning_starts, recipe.worlds * length),
    }
