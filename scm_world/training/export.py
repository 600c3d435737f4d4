"""Networks of Stable-Baselines3 as policy files, and policy files as beginnings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world.errors import UnreadableFile
from scm_world.evaluation.policies.cards import FORM, OPTIONS, PolicyAbout
from scm_world.evaluation.policies.weights import NetworkPolicy, load_policy
from scm_world.training.learners import torch
from scm_world.training.recipe import Recipe

Tensors = dict[str, NDArray[Any]]


def exported(model: Any, recipe: Recipe, card: Mapping[str, Any]) -> NetworkPolicy:
    """Give what a trained policy is, without torch.

    Args:
        model: Of Stable-Baselines3.
        recipe: How it was trained.
        card: What is said of it, as plain data.
    """
    spaces = getattr(model.observation_space, "spaces", None)
    about = PolicyAbout(
        task=recipe.task,
        env={name: value for name, value in recipe.options.items() if name in OPTIONS},
        activation=recipe.network.activation,
        output="clip" if recipe.algo == "ppo" else "tanh",
        inputs=None if spaces is None else tuple(spaces),
        card=dict(card),
    )
    tensors: Tensors = {}
    for name, layers in _networks(model, recipe).items():
        for number, layer in enumerate(layers):
            factor = _scale(model, recipe, number)
            tensors[f"{name}.{number}.weight"] = _array(layer.weight) * factor
            tensors[f"{name}.{number}.bias"] = _array(layer.bias)
    if recipe.algo == "ppo":
        tensors["log_std"] = _array(model.policy.log_std)
    return NetworkPolicy.of(tensors, about)


def begin_with(model: Any, recipe: Recipe, start: Path | str) -> None:
    """Let a model begin with the weights of a policy file.

    The standard deviations and the value come from it if it has them.

    Args:
        model: Of Stable-Baselines3.
        recipe: How it is trained.
        start: The file.

    Raises:
        UnreadableFile: It is no policy, or one that observes, acts or is built in another way.
    """
    given = load_policy(start)
    wrong = _differences(exported(model, recipe, {}), given)
    if wrong:
        advice = "begin with a policy of the same form, or change the recipe to its form"
        raise UnreadableFile(str(start), "; ".join(wrong), advice)
    tensors = given.tensors()
    with torch().no_grad():
        for name, layers in _networks(model, recipe).items():
            for number, layer in enumerate(layers):
                if f"{name}.{number}.weight" in tensors:
                    factor = _scale(model, recipe, number)
                    _fill(layer.weight, tensors[f"{name}.{number}.weight"] / factor)
                    _fill(layer.bias, tensors[f"{name}.{number}.bias"])
        if "log_std" in tensors and recipe.algo == "ppo":
            _fill(model.policy.log_std, tensors["log_std"])
        if recipe.algo == "td3":
            model.actor_target.load_state_dict(model.actor.state_dict())


def _differences(mine: NetworkPolicy, given: NetworkPolicy) -> list[str]:
    """Say in what a policy file is not what a recipe trains."""
    pairs: dict[str, tuple[Any, Any]] = {
        name: (given.about.option(name), mine.about.option(name)) for name in FORM
    }
    for name in ("task", "activation", "output", "inputs"):
        pairs[name] = getattr(given.about, name), getattr(mine.about, name)
    del pairs["task"]  # what was learned in one task may be a beginning in another one
    theirs, ours = given.tensors(), mine.tensors()
    for name in sorted({*theirs, *ours}):
        if name in theirs and name in ours:
            pairs[f"shape of {name}"] = theirs[name].shape, ours[name].shape
        elif name.startswith("layers"):
            pairs[name] = name in theirs, name in ours
    return [
        f"{name} is {theirs!r} there and {ours!r} here"
        for name, (theirs, ours) in pairs.items()
        if theirs != ours
    ]


def _networks(model: Any, recipe: Recipe) -> dict[str, list[Any]]:
    """List the layers of the policy, and of the value if there is one, by the names in a file."""
    policy = model.policy
    match recipe.algo:
        case "ppo":
            body = policy.mlp_extractor
            return {
                "layers": [*_linear(body.policy_net), policy.action_net],
                "value.layers": [*_linear(body.value_net), policy.value_net],
            }
        case "sac":
            return {"layers": [*_linear(policy.actor.latent_pi), policy.actor.mu]}
    return {"layers": _linear(policy.actor.mu)}


def _scale(model: Any, recipe: Recipe, layer: int) -> NDArray[np.float32]:
    """Give what observations are multiplied by before a layer: a policy file has it in its weights.

    Returns:
        Shape (inputs,), or shape () for layers that see no observations.
    """
    if layer > 0 or not recipe.network.scaled:
        return np.ones((), np.float32)
    owner = model.policy if recipe.algo == "ppo" else model.policy.actor
    return _array(owner.features_extractor.scale)


def _linear(network: Any) -> list[Any]:
    return [part for part in network if hasattr(part, "weight")]


def _array(tensor: Any) -> NDArray[np.float32]:
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


def _fill(tensor: Any, array: NDArray[Any]) -> None:
    tensor.copy_(torch().from_numpy(np.ascontiguousarray(array)))
