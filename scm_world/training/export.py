"""Policies of Stable-Baselines3 as policy files and ONNX: written, begun with, evaluated."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import gymnasium
import numpy as np

from scm_world._arguments import load
from scm_world.errors import (
    ModelError,
    ScmWorldError,
    UnknownOption,
    UnreadableFile,
    reading,
)
from scm_world.evaluation import Protocol, evaluate
from scm_world.policies import MlpPolicy, PolicyAbout, load_policy, save_policy
from scm_world.policies.cards import FORM, HISTORY, KEY, OPTIONS
from scm_world.policies.wrappers import LinearMap, samples, seen_through
from scm_world.runs.files import read_text, write_whole
from scm_world.training.recipe import Recipe
from scm_world.training.settings import Trials
from scm_world.training.worlds import level_seed

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.vec_env import VecEnv

SEED = 7_001
"""Of the noise of evaluations while training: evaluations by hand have other episodes."""


def exported(model: BaseAlgorithm, recipe: Recipe, card: Mapping[str, Any]) -> MlpPolicy:
    """Return the policy of a trained model, without torch."""
    env = {name: value for name, value in recipe.options.items() if name in OPTIONS}
    return _network(model, PolicyAbout(task=recipe.task, env=env, card=dict(card)))


def _network(model: BaseAlgorithm, about: PolicyAbout, seen: LinearMap | None = None) -> MlpPolicy:
    """Read the network of a model, which observes through a linear map."""
    spaces = getattr(model.observation_space, "spaces", None)
    squashes = getattr(model.policy, "actor", None) is not None
    form = {
        "activation": model.policy.activation_fn.__name__.lower(),
        "output": "tanh" if squashes else "clip",
        "inputs": None if spaces is None else tuple(spaces),
    }
    tensors = {
        name: tensor.detach().cpu().numpy().copy() for name, tensor in _tensors(model).items()
    }
    for name in _first(tensors):
        tensors[name] *= _scale(model)
        if seen is not None:
            bias = name.replace("weight", "bias")
            tensors[bias] += (tensors[name] @ seen.bias).astype(np.float32)
            tensors[name] = (tensors[name] @ seen.weight).astype(np.float32)
    return MlpPolicy.of(tensors, {**about.model_dump(), **form})


def export_sb3(
    model: BaseAlgorithm, env: gymnasium.Env[Any, Any] | VecEnv, path: Path | str, **card: object
) -> Path:
    """Write a model of Stable-Baselines3 as a policy file.

    ``evaluate``, ``load_policy``, ``to_onnx`` and ``--start`` take it, with the options of its
    environment, and without torch. Actions are compared before anything is written.

    Args:
        model: PPO, A2C, SAC, TD3 or DDPG with a multilayer perceptron of ``Tanh`` or ``ReLU``; or
            RecurrentPPO of sb3-contrib, with one LSTM for the actions and one for the value.
        env: In which it was trained: an environment, many, or a ``VecEnv`` of either.
        path: The file; it ends in ``.safetensors``.
        card: What else is said of it, as plain data.

    Returns:
        The path.

    Raises:
        UnknownOption: The model is something else; the environment is not of this package, or shows
            something else than the model observes; actions are not in [-1, 1]; or the path has
            another ending.
        ModelError: The network is of another kind, or a wrapper changes observations or actions.
            Running means, as they are now, and linear maps of observations are kept.
        UnwritableFolder: The disk is full, or permission is missing.

    Example:
        >>> model = stable_baselines3.PPO("MlpPolicy", env).learn(100_000)  # doctest: +SKIP
        >>> export_sb3(model, env, "mine.safetensors")  # doctest: +SKIP
    """
    library = load("stable_baselines3.common.base_class", "stable-baselines3", "train")
    if not isinstance(model, library.BaseAlgorithm):
        raise UnknownOption("model", model, ("a model of Stable-Baselines3, such as a PPO",))
    about = PolicyAbout.in_env(env, card=card)
    space = getattr(env, "single_observation_space", env.observation_space)
    if space != model.observation_space:
        allowed = (f"one that shows {model.observation_space}, as the model observes",)
        raise UnknownOption("environment of the model", space, allowed)
    if not (np.all(model.action_space.low == -1.0) and np.all(model.action_space.high == 1.0)):
        raise UnknownOption("actions of the model", model.action_space, ("those in [-1, 1]",))
    seen = seen_through(model.get_env() or env)
    if seen is not None:
        space = gymnasium.spaces.Box(-np.inf, np.inf, seen.weight.shape[1:])
    try:
        policy = _network(model, about, seen)
        for shown in samples(space):
            observed = shown if seen is None else seen(shown)
            wanted = model.predict(observed, deterministic=True)[0]
            if not np.allclose(policy.predict(shown)[0], wanted, rtol=1e-3, atol=1e-4):
                raise ValueError("its actions are not those of its linear layers")
    except (AttributeError, KeyError, ValueError, ScmWorldError) as error:
        kinds = "(Recurrent)PPO, A2C, SAC, TD3 or DDPG with a multilayer perceptron of Tanh or ReLU"
        problem = f"the network of the model cannot be written ({error}): give {kinds}"
        raise ModelError([problem]) from error
    return Path(str(save_policy(path, policy)))


def begin_with(model: BaseAlgorithm, recipe: Recipe, start: Path | str) -> None:
    """Initialise a model with the weights of a policy file.

    The standard deviations and the value come from it if it has them.
    """
    begin_tensors(
        load_policy(start), exported(model, recipe, {}), start, _tensors(model), _scale(model)
    )
    if recipe.algo == "td3":
        model.actor_target.load_state_dict(model.actor.state_dict())


def begin_tensors(
    given: MlpPolicy, mine: MlpPolicy, start: Path | str, tensors: Mapping[str, Any], scale: Any
) -> None:
    """Write the weights of a policy into tensors, if it has the form of another one.

    Args:
        given: The policy.
        mine: The policy of these tensors.
        start: Where the first one comes from, for the error.
        tensors: By their names in a policy file.
        scale: Factor of the observations, which a policy file has in its weights.

    Raises:
        UnreadableFile: The forms differ.
    """
    theirs, ours = given.tensors(), mine.tensors()
    pairs: dict[str, Any] = {n: (given.about.option(n), mine.about.option(n)) for n in FORM}
    for name in ("activation", "output", "inputs", "memory"):
        pairs[name] = getattr(given.about, name), getattr(mine.about, name)
    for name in sorted({*theirs, *ours}):
        if name in theirs and name in ours:
            pairs[f"shape of {name}"] = theirs[name].shape, ours[name].shape
        elif name.startswith(("layers", "lstm")):
            pairs[name] = name in theirs, name in ours
    wrong = [
        f"{n} is {one!r} there and {two!r} here" for n, (one, two) in pairs.items() if one != two
    ]
    if wrong:
        advice = "begin with a policy of the same form, or change the recipe to its form"
        raise UnreadableFile(str(start), "; ".join(wrong), advice)
    for name, tensor in tensors.items():
        if name in theirs:
            array = theirs[name] / scale if name in _first(theirs) else theirs[name]
            tensor.data.copy_(tensor.new_tensor(np.ascontiguousarray(array)))


def _tensors(model: BaseAlgorithm) -> dict[str, Any]:
    """List the tensors of the policy, and of PPO's value, by their names in a policy file."""
    policy = model.policy
    actor = getattr(policy, "actor", None)
    if actor is not None:
        parts = {"layers": [actor.mu]}  # of TD3 all layers, of SAC the last one
        if hasattr(actor, "latent_pi"):
            parts["layers"].insert(0, actor.latent_pi)
    else:
        body = policy.mlp_extractor
        parts = {
            "layers": [body.policy_net, policy.action_net],
            "value.layers": [body.value_net, policy.value_net],
        }
        if hasattr(policy, "columns"):  # the value observes more
            del parts["value.layers"]
    found = {}
    for name, networks in parts.items():
        linear = [m for network in networks for m in network.modules() if hasattr(m, "weight")]
        for number, layer in enumerate(linear):
            found[f"{name}.{number}.weight"] = layer.weight
            found[f"{name}.{number}.bias"] = layer.bias
    for name, lstm in ("lstm", "lstm_actor"), ("value.lstm", "lstm_critic"):
        if hasattr(policy, lstm):
            one = getattr(policy, lstm)
            if one is None or one.num_layers > 1:
                raise ValueError(f"it has not one layer in {lstm}")
            for number, part in enumerate(("ih", "hh")):
                found[f"{name}.{number}.weight"] = getattr(one, f"weight_{part}_l0")
                found[f"{name}.{number}.bias"] = getattr(one, f"bias_{part}_l0")
    return found if actor is not None else {**found, "log_std": policy.log_std}


def _first(tensors: Mapping[str, Any]) -> list[str]:
    """Name the weights that observations meet first."""
    first = "lstm.0.weight" if "lstm.0.weight" in tensors else "layers.0.weight"
    return [name for name in tensors if name.endswith(first)]


def _scale(model: BaseAlgorithm) -> Any:
    """Return the factor of observations, which a policy file has in its weights."""
    owner = getattr(model.policy, "actor", model.policy)
    scale = getattr(owner.features_extractor, "scale", None)
    if scale is None:
        return np.float32(1.0)
    return scale.cpu().numpy()[getattr(owner, "columns", slice(None))]


def scored(
    policy: MlpPolicy,
    task: str,
    env: Mapping[str, Any],
    trials: Trials,
    backend: str,
    **other: Any,
) -> tuple[str, dict[str, float]]:
    """Evaluate a policy while something is trained: the metric, and its means by protocol.

    ``other`` are arguments of ``evaluate`` in place of those of the trials.
    """
    form = {name: value for name, value in env.items() if name in (*OPTIONS, "task_options")}
    form["on_failure"] = env.get("on_failure", "truncate")
    protocols = list(trials.protocols)
    given: dict[str, Any] = {"task": task, "n": trials.episodes, "seeds": SEED, "env": form}
    given |= {"protocols": protocols, "backend": backend, **other}
    found = evaluate(policy, **given)
    metric = found.metric(trials.metric)
    return metric, {name: float(found.score(name, metric).value) for name in found.protocols}


def words(scores: Mapping[str, float]) -> str:
    """Return the scores of an evaluation in words."""
    return ", ".join(f"{name} {score:.3f}" for name, score in scores.items())


def mean(scores: Mapping[str, float]) -> float | None:
    """Return the mean over protocols; None without any."""
    return sum(scores.values()) / len(scores) if scores else None


@final
class Evaluations:
    """The evaluations of a training: their files, and the best policy.

    Attributes:
        best: The best mean so far, also before an interruption; None without any.
        last: The last scores, by protocol.
    """

    def __init__(self, recipe: Recipe, backend: str, folder: Path, seed: int) -> None:
        self._recipe, self._folder, self._seed = recipe, folder, seed
        self._backend = recipe.trials.backend or backend
        found = [_score_in(path) for path in folder.glob("evaluations/*.json")]
        self.best: float | None = max((one for one in found if one is not None), default=None)
        self.last: dict[str, float] = {}

    def add(self, policy: MlpPolicy, steps: int) -> str:
        """Evaluate; write the policy, also as the best one if none was better. Return the words."""
        recipe, folder = self._recipe, self._folder
        how = recipe.task, recipe.options, recipe.trials, self._backend
        metric, scores = scored(policy, *how)
        score, levels = mean(scores), self._gap(policy) if recipe.levels else {}
        self.last = {**scores, **levels}
        found = {"steps": steps, "metric": metric, "mean": score, "scores": scores, **levels}
        save_policy(folder / "policy.safetensors", policy)
        if score is not None and (self.best is None or score > self.best):
            self.best = score
            about = policy.about.with_card(trial={"steps": steps, "scores": scores, **levels})
            save_policy(folder / "best.safetensors", policy, about)
        path = folder / f"evaluations/{steps}.json"
        write_whole(path, json.dumps(found, indent=2))  # at last: a resumed training reads it
        return words(self.last)

    def _gap(self, policy: MlpPolicy) -> dict[str, float]:
        """Score the policy on levels of the training and on new draws of its curriculum."""
        recipe, trials = self._recipe, self._recipe.trials
        how = recipe.task, recipe.options, trials, self._backend
        drawn = Protocol("curriculum", act=recipe.curriculum)
        n = min(trials.episodes, recipe.levels or trials.episodes)
        known: dict[str, Any] = {"seeds": level_seed(self._seed), "n": n}
        _, old = scored(policy, *how, protocols=[drawn], **known)
        _, new = scored(policy, *how, protocols=[drawn])
        found = {"training_levels": old[drawn.name], "new_draws": new[drawn.name]}
        return {**found, "gap": found["training_levels"] - found["new_draws"]}


def _score_in(path: Path) -> float | None:
    """Return the mean score of an evaluation."""
    with reading(path, "delete it: the best policy so far is then chosen without it"):
        found = json.loads(read_text(path))["mean"]
        return None if found is None else float(found)


OPSET, FORMAT = 17, 8
"""Versions that onnxruntime has known since 2022."""

GOALS = ("achieved_goal", "desired_goal")
"""Parts of an observation that are 64-bit floats."""


def to_onnx(policy: MlpPolicy | Path | str, path: Path | str) -> Path:
    """Write a policy as an ONNX network, which takes a batch of observations.

    Actions are computed in 32-bit floats there, and so differ in the last digits. What the policy
    was made for stands in the metadata, as in the policy file.

    Args:
        policy: A policy, or its file.
        path: The ONNX file.

    Returns:
        The path.

    Raises:
        MissingExtra: The package onnx is not installed.
        UnknownOption: The policy has a memory, or is recurrent.
        UnreadableFile: The file is not a policy.
        UnwritableFolder: The disk is full, or permission is missing.
    """
    onnx = load("onnx", "onnx", "train")
    given = policy if isinstance(policy, MlpPolicy) else load_policy(policy)
    about = given.about
    if given.n_remembered:
        raise UnknownOption("memory of an ONNX network", given.n_remembered, ("0: none",))
    seen, nodes = "observation", []
    inputs = [f"float[N, {given.n_observed}] observation"]
    if about.inputs is not None:
        kinds = {**dict.fromkeys(GOALS, "double[N, ?]"), HISTORY: "float[N, ?, ?]"}
        inputs = [f"{kinds.get(name, 'float[N, ?]')} {name}" for name in about.inputs]
        nodes += [f"{name}_flat = Flatten<axis = 1>({name})" for name in about.inputs]
        nodes += [f"{name}_single = Cast<to = 1>({name}_flat)" for name in about.inputs]
        joined = ", ".join(f"{name}_single" for name in about.inputs)
        seen = "joined"
        nodes.append(f"{seen} = Concat<axis = 1>({joined})")
    arrays: dict[str, Any] = {}
    for number, layer in enumerate(given.layers):
        weight, bias = f"weight_{number}", f"bias_{number}"
        arrays |= {weight: np.ascontiguousarray(layer.weight), bias: layer.bias}
        nodes.append(f"sum_{number} = Gemm({seen}, {weight}, {bias})")
        seen = f"sum_{number}"
        if number < len(given.layers) - 1:
            nodes.append(f"hidden_{number} = {about.activation.capitalize()}({seen})")
            seen = f"hidden_{number}"
    if about.output == "tanh":
        nodes.append(f"action = Tanh({seen})")
    else:
        arrays |= {"low": np.array(-1.0, np.float32), "high": np.array(1.0, np.float32)}
        nodes.append(f"action = Clip({seen}, low, high)")
    made = onnx.parser.parse_model(
        f'<ir_version: {FORMAT}, opset_import: ["": {OPSET}], producer_name: "scm_world">'
        f"policy ({', '.join(inputs)}) => (float[N, {given.n_actions}] action) {{"
        f"{' '.join(nodes)} }}"
    )
    made.graph.initializer.extend(onnx.numpy_helper.from_array(a, n) for n, a in arrays.items())
    made.metadata_props.add(key=KEY, value=about.text())
    onnx.checker.check_model(made)
    target = Path(path)
    write_whole(target, made.SerializeToString())
    return target
