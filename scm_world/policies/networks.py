"""Multilayer perceptrons in safetensors files and in archives of Stable-Baselines 2.

A safetensors file has the tensors ``layers.<i>.weight`` (outputs, inputs) and ``layers.<i>.bias``,
from the observation to the action, each followed by the memory if there is one; it may have
``log_std``, and ``value.layers.<i>…`` of a second network for the value of the state. Of a
recurrent policy an LSTM comes before the layers: ``lstm.0`` takes the observation, ``lstm.1`` the
output of the step before; both give the input, forget, cell and output gates, one after another, as
in torch. Its value may have ``value.lstm``. The metadata has a ``PolicyAbout`` under
``"scm_world"``.

An archive of Stable-Baselines 2 is a zip file. Its member ``parameters`` is a numpy archive of
plain arrays; its member ``data`` holds pickled Python objects and is never opened. Reading a file
of either kind runs no code in it.

Actions are computed in 64-bit floats, always in the same order, and rounded to 32 bits at the end:
they depend neither on the size of the batch nor on the number of threads.

Source:
    Stable-Baselines 2.10, ``common/base_class.py``; the tensors are those of its ``MlpPolicy`` for
    PPO2 in CausalWorld 1.2.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple, Self, final

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from scm_world._arguments import true_or_false, typed, whole_number
from scm_world._types import ArrayLike, Floats
from scm_world.errors import ActionError, ModelError, UnknownOption, reading
from scm_world.geometry.numbers import njit
from scm_world.policies.cards import ANY, HISTORY, KEY, PolicyAbout
from scm_world.runs.files import Location, located, read_arrays, read_bytes, write_whole
from scm_world.tasks import tasks

Weights = NDArray[np.float32]
Observed = ArrayLike | Mapping[str, ArrayLike]
"""An observation, or a batch of some: one array, or arrays by name."""

NETWORKS = ("layers", "value.layers", "lstm", "value.lstm")
"""Names of the networks in a file."""

_ANY = PolicyAbout(task=ANY)  # tanh, clip, one array
_SAVED = "give a file that scm_world.policies.save_policy has written"
_ARCHIVE = "only multilayer perceptrons of PPO2 (MlpPolicy) can be loaded"
_ENV = (
    "use the observation that it was trained with: of a policy file "
    "gymnasium.make(…, **policy.about.env)"
)


class Layer(NamedTuple):
    """A layer of a network: weight, shape (inputs, outputs), and bias, shape (outputs,)."""

    weight: Weights
    bias: Weights


@final
@typed
@dataclass(frozen=True, eq=False)
class MlpPolicy:
    """A normal distribution over actions whose mean is a multilayer perceptron.

    Attributes:
        layers: From the observation to the action, each followed by the memory if there is one; all
            but the last are hidden.
        log_std: Logarithm of the standard deviations of the actions, shape (n,), if known.
        value: The layers of the network for the value of the state, if known.
        made_for: Metadata of its training, if known.
        lstm: The two layers of an LSTM before these layers, of a recurrent policy.
        value_lstm: Likewise of the value.

    Raises:
        ModelError: Layers do not fit one another, or are no finite numbers; all problems.
    """

    layers: tuple[Layer, ...]
    log_std: Weights | None = field(default=None, repr=False)
    value: tuple[Layer, ...] = field(default=(), repr=False)
    made_for: PolicyAbout | None = None
    lstm: tuple[Layer, ...] = field(default=(), repr=False)
    value_lstm: tuple[Layer, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        kind = tasks().get(self.about.task)
        wanted = None if kind is None else kind.n_actions
        memory = self.about.memory
        problems = [*_lstm_misfits("lstm", self.lstm)]
        width = len(self.lstm[1].weight) if self.lstm and not problems else None
        problems += _misfits("layers", self.layers, width, wanted and wanted + memory)
        if memory and not problems and min(self.n_observed, self.n_actions) < 1:
            problems = [f"layers: too narrow for a memory of {memory} numbers"]
        if memory and (self.value or self.log_std is not None):
            problems.append("a policy with a memory has neither log_std nor value.layers")
        if memory and self.lstm:
            problems.append("a policy with an LSTM has no other memory")
        if self.value and not problems:
            problems = [*_lstm_misfits("value.lstm", self.value_lstm)]
            if bool(self.lstm) != bool(self.value_lstm):
                problems.append("lstm and value.lstm: one is there without the other")
        if self.value and not problems:
            first = len(self.value_lstm[1].weight) if self.lstm else self.n_observed
            problems = [*_misfits("value.layers", self.value, first, 1)]
        if self.log_std is not None and not problems:
            shape = (self.n_actions,)
            if self.log_std.shape != shape or not np.isfinite(self.log_std).all():
                problems = [f"log_std: expected shape {shape} and finite numbers"]
        if problems:
            raise ModelError(problems)

    @property
    def about(self) -> PolicyAbout:
        """Metadata of its training, or the usual metadata if that is not known."""
        return self.made_for or _ANY

    @property
    def n_observed(self) -> int:
        """Number of components of an observation."""
        return int((self.lstm or self.layers)[0].weight.shape[0]) - self.about.memory

    @property
    def n_actions(self) -> int:
        """Number of components of an action."""
        return int(self.layers[-1].weight.shape[1]) - self.about.memory

    @property
    def n_remembered(self) -> int:
        """Number of components of its state from step to step: of a memory, or of an LSTM."""
        return 2 * len(self.lstm[1].weight) if self.lstm else self.about.memory

    def __call__(
        self, observation: Observed, *, generator: np.random.Generator | None = None
    ) -> Weights:
        """Choose the action.

        Args:
            observation: Shape (..., n), or arrays by name, those of ``made_for.inputs``.
            generator: Draws the action from the distribution; None: the action is the mean.

        Returns:
            Shape (..., n_actions), in [-1, 1], dtype float32; each observation of a batch gets, bit
            for bit, the action that it gets alone.
        """
        found = self.mean(observation)
        if generator is not None:
            if self.log_std is None:
                raise UnknownOption("generator", generator, ("None: log_std is not known",))
            found = found + np.exp(self.log_std) * generator.standard_normal(found.shape)
        return self._bounded(found)

    def _bounded(self, found: Floats) -> Weights:
        found = np.tanh(found) if self.about.output == "tanh" else np.clip(found, -1.0, 1.0)
        return found.astype(np.float32)

    def mean(self, observation: Observed) -> Floats:
        """Compute the mean before it is bounded, shape (..., n_actions); errors as above."""
        if self.n_remembered:
            advice = "call policy.predict(observation, state=…, episode_start=…)"
            raise ActionError(f"the policy has a memory; {advice}", None)
        return self._computed("layers", self.joined(observation))

    def values(self, observation: Observed) -> Floats:
        """Compute the value of the state, shape (..., 1).

        Raises:
            ActionError: As above.
            UnknownOption: The network of the value is not known, or is recurrent.
        """
        if not self.value or self.value_lstm:
            raise UnknownOption("policy", self, ("one with a value network that is not recurrent",))
        return self._computed("value.layers", self.joined(observation))

    def hidden(self, observation: Observed, state: ArrayLike | None = None) -> Floats:
        """Compute the activations of the last hidden layer, shape (..., k).

        Where there is no hidden layer it is the input of the only layer.

        Args:
            observation: As above.
            state: The memory before this observation, as in ``predict``.

        Raises:
            ActionError: As in ``predict``.
        """
        return self._computed("layers", self._inputs(observation, state)[0], stop=-1)

    def untrained(self, seed: int = 0) -> MlpPolicy:
        """Return a policy of equal shapes and metadata whose weights are random.

        A weight is normal, with the standard deviation ``1 / sqrt(inputs)``; a bias is 0.
        """
        rng = np.random.default_rng(whole_number("seed", seed, least=0))
        tensors = {
            name: np.zeros_like(tensor)
            if tensor.ndim == 1
            else (rng.normal(size=tensor.shape) / math.sqrt(tensor.shape[1])).astype(np.float32)
            for name, tensor in self.tensors().items()
        }
        return self.of(tensors, self.made_for)

    def _computed(self, name: str, seen: NDArray[Any], stop: int | None = None) -> Floats:
        layers = self._doubles[name]
        x = np.ascontiguousarray(seen.reshape(-1, len(layers[0][0])), dtype=np.float64)
        hidden = 1 if self.about.activation == "tanh" else 2
        for number, (weight, bias) in enumerate(layers[:stop], start=1):
            x = _dense(x, weight, bias, hidden if number < len(layers) else 0)
        return x.reshape(*seen.shape[:-1], x.shape[1])

    def _recurrent(self, seen: NDArray[Any], state: Floats) -> tuple[Floats, Floats]:
        """Return the output of the LSTM, and its next state: output and cell, (..., 2 hidden)."""
        rows = np.ascontiguousarray(state.reshape(-1, state.shape[-1]))
        x = np.ascontiguousarray(seen.reshape(len(rows), -1), dtype=np.float64)
        (weight, bias), (back, more) = self._doubles["lstm"]
        gates = _dense(x, weight, bias, 0)
        gates += _dense(np.ascontiguousarray(rows[:, : len(back)]), back, more, 0)
        found = _gated(gates, rows).reshape(state.shape)
        return found[..., : len(back)], found

    @cached_property
    def _doubles(self) -> dict[str, list[tuple[Floats, Floats]]]:
        """The layers of each network, as 64-bit floats."""
        return {
            name: [
                (np.ascontiguousarray(weight, np.float64), bias.astype(np.float64))
                for weight, bias in layers
            ]
            for name, layers in self._networks.items()
        }

    @property
    def _networks(self) -> dict[str, tuple[Layer, ...]]:
        """The layers of each network, by its name in a file."""
        found = self.layers, self.value, self.lstm, self.value_lstm
        return dict(zip(NETWORKS, found, strict=True))

    def joined(self, observation: Observed) -> NDArray[Any]:
        """Join the parts of an observation, shape (..., n); errors as above."""
        inputs = self.about.inputs
        if isinstance(observation, Mapping):
            if inputs is None or not observation.keys() >= set(inputs):
                wanted = "one array" if inputs is None else f"the parts {[*inputs]}"
                raise ActionError(
                    f"the policy observes {wanted}, got the parts {[*observation]}; {_ENV}", None
                )
            arrays = {name: np.asarray(observation[name]) for name in inputs}
            if HISTORY in inputs and arrays[HISTORY].ndim > 1:  # a row for each step
                past = arrays[HISTORY]
                arrays[HISTORY] = past.reshape(*past.shape[:-2], -1)
            seen = np.concatenate([*arrays.values()], axis=-1)
        elif inputs is not None:
            raise ActionError(f"the policy observes the parts {[*inputs]} by name; {_ENV}", None)
        else:
            seen = np.asarray(observation)
        if seen.ndim == 0 or seen.shape[-1] != self.n_observed or seen.dtype.kind not in "fiub":
            wanted = f"the policy observes {self.n_observed} numbers"
            raise ActionError(f"{wanted}, got the shape {seen.shape}; {_ENV}", None)
        return seen

    def check(self, observation: Observed, n_actions: int) -> None:
        """Check that observations and actions have the right numbers of components.

        Raises:
            ActionError: They have not.
        """
        self.joined(observation)
        if self.n_actions != n_actions:
            wrong = f"the policy gives {self.n_actions} numbers, and an action has {n_actions}"
            raise ActionError(wrong, None)

    def predict(
        self,
        observation: Observed,
        state: ArrayLike | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Weights, NDArray[Any] | None]:
        """Choose the action, with the signature of Stable-Baselines3.

        Args:
            observation: As above.
            state: The memory that the last call returned, shape (..., n_remembered); None: it is
                empty.
            episode_start: Whether it is emptied first, a truth value or shape (...); not if None.
            deterministic: Must be true; draws need a generator: ``policy(…, generator=…)``.

        Returns:
            The action, shape (..., n_actions), and the memory: the values -1 and 1, or output and
            cell of an LSTM in 64-bit floats; None if the policy has none.

        Raises:
            ActionError: As above, or the memory has another shape.
            UnknownOption: ``deterministic`` is false.
        """
        if not true_or_false("deterministic", deterministic):
            raise UnknownOption("deterministic", deterministic, ("True",))
        if not self.n_remembered:
            return self(observation), None
        given, kept = self._inputs(observation, state, episode_start)
        found = self._computed("layers", given)
        if self.lstm:
            return self._bounded(found), kept
        action, said = np.split(found, [self.n_actions], axis=-1)
        return self._bounded(action), np.where(said > 0.0, 1.0, -1.0).astype(np.float32)

    def _inputs(
        self,
        observation: Observed,
        state: ArrayLike | None = None,
        episode_start: ArrayLike | None = None,
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the input of the layers, and the memory, of an LSTM after this observation."""
        seen = self.joined(observation)
        shape = (*seen.shape[:-1], self.n_remembered)
        try:
            kept = np.zeros(shape) if state is None else np.array(state, np.float64)
            first = np.asarray(False if episode_start is None else episode_start, bool)
            first = first.reshape(shape[:-1] if first.size > 1 else ())
        except (TypeError, ValueError) as error:
            raise ActionError(f"no memory of shape {shape}: {error}", None) from None
        fits = np.isfinite(kept) if self.lstm else np.isin(kept, (-1.0, 0.0, 1.0))
        if kept.shape != shape or not fits.all():
            values = "finite numbers" if self.lstm else "the values -1, 0 and 1"
            wanted = f"the memory has shape {shape} and {values}"
            raise ActionError(f"{wanted}, got {np.array(state)}", None)
        kept[np.broadcast_to(first, shape[:-1])] = 0.0
        return self._recurrent(seen, kept) if self.lstm else (np.append(seen, kept, axis=-1), kept)

    def tensors(self) -> dict[str, Weights]:
        """Return the tensors of a file, by name."""
        found: dict[str, Weights] = {}
        for prefix, layers in self._networks.items():
            for number, (weight, bias) in enumerate(layers):
                found[f"{prefix}.{number}.weight"] = np.ascontiguousarray(weight.T)
                found[f"{prefix}.{number}.bias"] = np.ascontiguousarray(bias)
        if self.log_std is not None:
            found["log_std"] = np.ascontiguousarray(self.log_std)
        return found

    def content(self) -> bytes:
        """Return the content of a safetensors file."""
        text = {KEY: self.made_for.text()} if self.made_for else None
        return safetensors.numpy.save(self.tensors(), text)

    @property
    def sha256(self) -> str:
        """Digest of the weights and the metadata."""
        return hashlib.sha256(self.content()).hexdigest()

    @classmethod
    def of(
        cls,
        tensors: Mapping[str, Any],
        about: PolicyAbout | Mapping[str, Any] | str | None = None,
    ) -> Self:
        """Make a policy from the tensors, and the metadata, of a file.

        Args:
            tensors: By name, 32-bit floats; a weight has shape (outputs, inputs).
            about: Metadata of its training, if known: a ``PolicyAbout``, its fields, or its JSON.

        Raises:
            ModelError: There are others, or they do not fit; all problems.
        """
        made_for = None if about is None else PolicyAbout.of(about)
        wrong = [
            f"{name}: expected an array of float32, "
            f"got {getattr(array, 'dtype', type(array).__name__)}"
            for name, array in tensors.items()
            if not isinstance(array, np.ndarray) or array.dtype != np.float32
        ]
        left, networks = dict(tensors), dict[str, tuple[Layer, ...]]()
        for prefix in NETWORKS:
            layers: list[Layer] = []
            while (name := f"{prefix}.{len(layers)}.weight") in left:
                bias = f"{prefix}.{len(layers)}.bias"
                if bias not in left:
                    raise ModelError([f"the tensor {bias!r} is missing"])
                layers.append(Layer(left.pop(name).T, left.pop(bias)))
            networks[prefix] = tuple(layers)
        log_std = left.pop("log_std", None)
        wrong += [f"{name!r} is not a tensor of a policy" for name in left]
        if wrong:
            raise ModelError(wrong)
        mean, value, *lstms = networks.values()
        return cls(mean, log_std, value, made_for, *lstms)


@typed
def save_policy(
    path: Location | str,
    network: MlpPolicy | Mapping[str, Any],
    about: PolicyAbout | Mapping[str, Any] | str | None = None,
) -> Location:
    """Write a trained policy, whole or not at all.

    Args:
        path: The file; it ends in ``.safetensors``.
        network: A policy, or its tensors by name; see ``MlpPolicy.of``.
        about: Metadata of its training; that of the policy if None.

    Returns:
        The path.

    Raises:
        ModelError: The tensors or the metadata do not fit the format.
        UnknownOption: The path has another ending.
        UnwritableFolder: The disk is full, or permission is missing.
    """
    target = located(path)
    if target.suffix != ".safetensors":
        raise UnknownOption("ending of a policy file", target.suffix, (".safetensors",))
    tensors = network.tensors() if isinstance(network, MlpPolicy) else network
    said = network.made_for if about is None and isinstance(network, MlpPolicy) else about
    write_whole(target, MlpPolicy.of(tensors, {} if said is None else said).content())
    return target


@typed
def load_policy(path: Path | str) -> MlpPolicy:
    """Read a trained policy. Nothing in the file is executed.

    Args:
        path: The file; ``"zoo:pushing"``; or the folder of a training run, see ``file_of``.

    Raises:
        UnknownOption: The zoo has no policy of this name.
        UnreadableFile: It is damaged, of another kind, or not there.
    """
    from scm_world.policies.zoo import file_of  # which reads cards by this function

    name = str(file_of(path))
    with reading(name, _SAVED):
        return policy_in(read_bytes(Path(name)))


def policy_in(data: bytes) -> MlpPolicy:
    """Return the policy whose file has this content; any error if it is not one."""
    tensors = safetensors.numpy.load(data)
    size = int.from_bytes(data[:8], "little")  # of the header, which is JSON
    text = json.loads(data[8 : 8 + size]).get("__metadata__", {}).get(KEY)
    if text is None:
        raise ModelError([f"its metadata has no {KEY!r}, the description of the policy"])
    return MlpPolicy.of(tensors, text)


@typed
def load_sb2(path: str | PathLike[str]) -> MlpPolicy:
    """Read a policy that was trained with PPO2 of Stable-Baselines 2.

    Nothing in the file is executed.

    Args:
        path: The ``.zip`` archive.

    Raises:
        UnreadableFile: It is not such an archive, or its policy is not a multilayer perceptron.
    """
    with reading(fspath(path), _ARCHIVE):
        with zipfile.ZipFile(io.BytesIO(read_bytes(Path(path)))) as archive:
            arrays = read_arrays(archive.read("parameters"))
        found = {key: np.asarray(array, dtype=np.float32) for key, array in arrays.items()}
        hidden = ["shared_fc0"]
        while f"model/shared_fc{len(hidden)}/w:0" in found:
            hidden.append(f"shared_fc{len(hidden)}")
        tensors = {"log_std": found["model/pi/logstd:0"].reshape(-1)}
        for prefix, last in (("layers", "pi"), ("value.layers", "vf")):
            if last == "vf" and "model/vf/w:0" not in found:
                continue
            for number, layer in enumerate((*hidden, last)):
                tensors[f"{prefix}.{number}.weight"] = found[f"model/{layer}/w:0"].T
                tensors[f"{prefix}.{number}.bias"] = found[f"model/{layer}/b:0"]
        return MlpPolicy.of(tensors)


def _misfits(
    name: str, layers: tuple[Layer, ...], width: int | None, last: int | None
) -> Iterator[str]:
    """Name the problems of the layers of a network, from ``width`` numbers to ``last`` ones."""
    if not layers:
        yield f"the tensor '{name}.0.weight' is missing"
    for number, (weight, bias) in enumerate(layers):
        is_good = isinstance(weight, np.ndarray) and isinstance(bias, np.ndarray)
        is_good = (
            is_good and weight.ndim == 2 and weight.size > 0 and bias.shape == weight.shape[1:]
        )
        if not (is_good and np.isfinite(weight).all() and np.isfinite(bias).all()):
            yield (
                f"{name}.{number}: weight (outputs, inputs) and bias (outputs,) are no finite "
                f"numbers of these shapes, got {np.shape(weight)[::-1]} and {np.shape(bias)}"
            )
            return
        inputs, outputs = weight.shape
        if width not in (None, inputs):
            yield f"{name}.{number}: it takes {inputs} numbers, and gets {width}"
        width = outputs
    if layers and last not in (None, width):
        yield f"{name}: the last one has to give {last} numbers, not {width}"


def _lstm_misfits(name: str, lstm: tuple[Layer, ...]) -> Iterator[str]:
    """Name the problems of the two layers of an LSTM, if there is one."""
    n = np.shape(lstm[1].weight)[:1] if len(lstm) == 2 else ()
    width = 4 * n[0] if n else 0
    is_good = width > 0 and np.ndim(lstm[0].weight) == np.ndim(lstm[1].weight) == 2
    for weight, bias in lstm:
        is_good = is_good and weight.shape[1:] == np.shape(bias) == (width,)
        is_good = is_good and bool(np.isfinite(weight).all() and np.isfinite(bias).all())
    if lstm and not is_good:
        given = [(np.shape(weight)[::-1], np.shape(bias)) for weight, bias in lstm]
        yield (
            f"{name}: expected two layers of finite numbers, with weights (4 n, inputs) and "
            f"(4 n, n) and biases (4 n,), got {given}"
        )


@njit(cache=True)
def _gated(gates: Floats, state: Floats) -> Floats:
    """Compute output and cell of an LSTM, shape (rows, 2 n), from its gates, shape (rows, 4 n)."""
    found = np.empty_like(state)
    n = state.shape[1] // 2
    for row in range(len(state)):
        for j in range(n):
            entry, forget = _sigmoid(gates[row, j]), _sigmoid(gates[row, n + j])
            cell = forget * state[row, n + j] + entry * math.tanh(gates[row, 2 * n + j])
            found[row, j] = _sigmoid(gates[row, 3 * n + j]) * math.tanh(cell)
            found[row, n + j] = cell
    return found


@njit(cache=True)
def _sigmoid(x: float) -> float:
    return 0.5 * (1.0 + math.tanh(0.5 * x))


@njit(cache=True)
def _dense(x: Floats, weight: Floats, bias: Floats, after: int) -> Floats:
    """Compute a layer of rows of inputs, every sum in the order of the inputs.

    ``after`` is 1 for a hyperbolic tangent, 2 for a rectifier, 0 for neither.
    """
    rows, inputs, outputs = x.shape[0], weight.shape[0], weight.shape[1]
    found = np.empty((rows, outputs))
    for row in range(rows):
        total = found[row]
        for j in range(outputs):
            total[j] = bias[j]
        for i in range(inputs):
            share = x[row, i]
            for j in range(outputs):
                total[j] += share * weight[i, j]
        for j in range(outputs):
            if after == 1:
                total[j] = math.tanh(total[j])
            elif after == 2:
                total[j] = max(total[j], 0.0)
    return found
