"""Trained policies in safetensors files, which are read without running code.

A file has the tensors ``layers.<i>.weight`` (outputs, inputs) and ``layers.<i>.bias`` of a
multilayer perceptron, from the observation to the action; it may have ``log_std``, and
``value.layers.<i>…`` of a second network that gives the value. Its metadata has a ``PolicyAbout``
under ``"scm_world"``.

Actions are computed in 64-bit floats, always in the same order, and rounded to 32 bits in the end:
they depend neither on how many observations there are at once nor on the number of threads.
"""

from __future__ import annotations

import hashlib
import math
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, final

import numpy as np
import safetensors
import safetensors.numpy
from numba import njit
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.errors import ActionError, ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation.policies.cards import KEY, PolicyAbout
from scm_world.evaluation.policies.mlp import Layer, Weights
from scm_world.output.durable import write_durably
from scm_world.output.locations import Location, located
from scm_world.tasks import tasks

LARGEST = 2**28  # [bytes] of a file: more is no policy, and might be a trap
VALUE = "value."
LOG_STD = "log_std"


@final
@dataclass(frozen=True, eq=False)
class NetworkPolicy:
    """A multilayer perceptron that gives an action for an observation.

    Attributes:
        layers: From the observation to the action; all but the last are hidden.
        about: What it was made for, and how.
        log_std: Logarithm of the standard deviations of the actions, shape (n,), if it is kept.
        value: The layers of the network that gives the value of the state, if it is kept.

    Raises:
        ModelError: Layers do not fit one another, or are no finite numbers; all that is wrong.
    """

    layers: tuple[Layer, ...]
    about: PolicyAbout
    log_std: Weights | None = field(default=None, repr=False)
    value: tuple[Layer, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        if not self.layers:
            raise ModelError(["there is no tensor 'layers.0.weight'"])
        kind = tasks().get(self.about.task)
        joints = len(kind.rest) if kind is not None else 0
        problems = [*_misfits("layers", self.layers, None, joints or None)]
        if self.value and self.layers[0].weight.ndim == 2:
            problems += _misfits(f"{VALUE}layers", self.value, self.n_observed, 1)
        shape = self.layers[-1].bias.shape
        if self.log_std is not None and not _is_good(self.log_std, shape):
            problems.append(f"{LOG_STD}: expected shape {shape} and finite numbers")
        if problems:
            raise ModelError(problems)

    @property
    def n_observed(self) -> int:
        """How many numbers it observes."""
        return int(self.layers[0].weight.shape[0])

    @property
    def n_actions(self) -> int:
        """How many numbers an action has."""
        return int(self.layers[-1].weight.shape[1])

    @cached_property
    def _doubles(self) -> list[tuple[Floats, Floats]]:
        return [
            (np.ascontiguousarray(layer.weight, np.float64), layer.bias.astype(np.float64))
            for layer in self.layers
        ]

    def __call__(self, observation: Any) -> Weights:
        """Choose the action.

        Args:
            observation: Shape (..., n), or arrays by name, those of ``about.inputs``.

        Returns:
            Shape (..., n), in [-1, 1], dtype float32; an observation among others gets, bit for
            bit, the action that it gets alone.

        Raises:
            ActionError: The observation has another number of components, or other parts.
        """
        seen = self.joined(observation)
        x = np.ascontiguousarray(seen.reshape(-1, self.n_observed), dtype=np.float64)
        last = len(self._doubles) - 1
        for number, (weight, bias) in enumerate(self._doubles):
            x = _dense(x, weight, bias, _AFTER[self.about.activation if number < last else "none"])
        x = np.tanh(x) if self.about.output == "tanh" else np.clip(x, -1.0, 1.0)
        found: Weights = x.astype(np.float32).reshape(*seen.shape[:-1], self.n_actions)
        return found

    def joined(self, observation: Any) -> NDArray[Any]:
        """Put the parts of an observation together, shape (..., n).

        Raises:
            ActionError: It has another number of components, or other parts.
        """
        inputs = self.about.inputs
        if isinstance(observation, Mapping):
            if inputs is None or not observation.keys() >= set(inputs):
                wanted = "one array" if inputs is None else f"the parts {[*inputs]}"
                raise ActionError(
                    f"the policy observes {wanted}, got the parts {[*observation]}; {_ENV}", None
                )
            parts = [np.asarray(observation[name]) for name in inputs]
            seen = np.concatenate(parts, axis=-1) if len(parts) > 1 else parts[0]
        elif inputs is not None:
            raise ActionError(f"the policy observes the parts {[*inputs]} by name; {_ENV}", None)
        else:
            seen = np.asarray(observation)
        if seen.ndim == 0 or seen.shape[-1] != self.n_observed or seen.dtype.kind not in "fiub":
            wanted = f"the policy observes {self.n_observed} numbers"
            raise ActionError(f"{wanted}, got the shape {seen.shape}; {_ENV}", None)
        return seen

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Weights, None]:
        """Choose the action, as Stable-Baselines3 asks for it.

        Args:
            observation: As above.
            state: Not used: the policy has no memory.
            episode_start: Not used either.
            deterministic: It must be true.

        Returns:
            The action, shape (..., n_actions), and no state.

        Raises:
            ActionError: As above.
            UnknownOption: ``deterministic`` is false.
        """
        if not deterministic:
            raise UnknownOption("deterministic", deterministic, ("True",))
        return self(observation), None

    @property
    def sha256(self) -> str:
        """A word that sums up the weights and what is said of them."""
        return hashlib.sha256(self._content()).hexdigest()

    def _content(self) -> bytes:
        return safetensors.numpy.save(self.tensors(), {KEY: self.about.text()})

    def tensors(self) -> dict[str, Weights]:
        """Give what is written into a file, by name."""
        found = {**_named("layers", self.layers), **_named(f"{VALUE}layers", self.value)}
        if self.log_std is not None:
            found[LOG_STD] = np.ascontiguousarray(self.log_std)
        return found

    @classmethod
    def of(
        cls, tensors: Mapping[str, Any], about: PolicyAbout | Mapping[str, Any]
    ) -> NetworkPolicy:
        """Make a policy from tensors by name, as a file has them.

        Args:
            tensors: Arrays of 32-bit floats; a weight has shape (outputs, inputs), as torch has it.
            about: What it was made for.

        Raises:
            ModelError: There are others, or they do not fit; all that is wrong.
        """
        left = dict(tensors)
        _refuse_others(left)
        layers, value = _layers(left, "layers"), _layers(left, f"{VALUE}layers")
        log_std = left.pop(LOG_STD, None)
        if left:
            raise ModelError([f"{name!r} is no tensor of a policy" for name in left])
        return cls(layers, PolicyAbout.of(about), log_std, value)


_ENV = "make the environment with gymnasium.make(…, **policy.about.env)"


def save_policy(
    path: Location | str,
    network: NetworkPolicy | Mapping[str, Any],
    about: PolicyAbout | Mapping[str, Any] | None = None,
) -> Location:
    """Write a trained policy, whole or not at all.

    Args:
        path: Of the file; it ends in ``.safetensors``.
        network: A policy, or its tensors by name; see ``NetworkPolicy.of``.
        about: What it was made for; that of the policy if None.

    Returns:
        The path.

    Raises:
        ModelError: The tensors or what is said of them do not fit the format.
        UnknownOption: The path has another ending.
        UnwritableFolder: There is no room, or no permission.
    """
    target = located(path)
    if target.suffix != ".safetensors":
        raise UnknownOption("ending of a policy file", target.suffix, (".safetensors",))
    tensors = network.tensors() if isinstance(network, NetworkPolicy) else network
    said = network.about if about is None and isinstance(network, NetworkPolicy) else about
    policy = NetworkPolicy.of(tensors, said if said is not None else {})
    write_durably(target, policy._content())
    return target


def load_policy(path: Path | str) -> NetworkPolicy:
    """Read a trained policy. Nothing in the file is executed.

    Args:
        path: Of the file.

    Raises:
        UnreadableFile: It is damaged, of another kind, too large, or not there.
    """
    name = str(path)
    try:
        status = Path(name).stat()
        if not stat.S_ISREG(status.st_mode):
            raise UnreadableFile(name, "it is no file", _ADVICE)
        if status.st_size > LARGEST:
            raise UnreadableFile(name, f"it has more than {LARGEST} bytes", _ADVICE)
        with safetensors.safe_open(name, framework="np") as file:
            text = (file.metadata() or {}).get(KEY)
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 # no mapping
    except OSError as error:
        raise UnreadableFile(name, error.strerror or str(error), _ADVICE) from None
    except (safetensors.SafetensorError, ValueError, TypeError, KeyError, AttributeError) as error:
        if isinstance(error, UnreadableFile):
            raise
        raise UnreadableFile(
            name, f"it is damaged, or of another kind ({error})", _ADVICE
        ) from None
    if text is None:
        raise UnreadableFile(name, f"its metadata has no {KEY!r}, what it is for", _ADVICE)
    try:
        return NetworkPolicy.of(tensors, PolicyAbout.of(text))
    except ModelError as error:
        raise UnreadableFile(name, "; ".join(error.problems), _ADVICE) from None


_ADVICE = "give a file that scm_world.evaluation.policies.save_policy has written"


# --- layers -----------------------------------------------------------------------------------


def _refuse_others(tensors: Mapping[str, Any]) -> None:
    """Refuse what is no array of 32-bit floats."""
    wrong = [
        f"{name}: expected an array of float32, got {getattr(array, 'dtype', type(array).__name__)}"
        for name, array in tensors.items()
        if not isinstance(array, np.ndarray) or array.dtype != np.float32
    ]
    if wrong:
        raise ModelError(wrong)


def _layers(left: dict[str, Any], prefix: str) -> tuple[Layer, ...]:
    """Take the layers of a network out of tensors."""
    found: list[Layer] = []
    while f"{prefix}.{len(found)}.weight" in left:
        name = f"{prefix}.{len(found)}"
        weight, bias = left.pop(f"{name}.weight"), left.pop(f"{name}.bias", None)
        if bias is None:
            raise ModelError([f"there is no tensor '{name}.bias'"])
        found.append(Layer(weight.T, bias))
    return tuple(found)


def _named(prefix: str, layers: Iterable[Layer]) -> dict[str, Weights]:
    found: dict[str, Weights] = {}
    for number, layer in enumerate(layers):
        found[f"{prefix}.{number}.weight"] = np.ascontiguousarray(layer.weight.T)
        found[f"{prefix}.{number}.bias"] = np.ascontiguousarray(layer.bias)
    return found


def _misfits(
    name: str, layers: Sequence[Layer], first: int | None, last: int | None
) -> Iterable[str]:
    """Say what is wrong with the layers of a network."""
    wrong = [
        f"{name}.{number}: weight (outputs, inputs) and bias (outputs,) are no finite numbers of "
        f"these shapes, got {layer.weight.T.shape} and {layer.bias.shape}"
        for number, layer in enumerate(layers)
        if layer.weight.ndim != 2
        or not _is_good(layer.weight, layer.weight.shape)
        or not _is_good(layer.bias, layer.weight.shape[1:])
    ]
    if wrong or not layers:
        return wrong
    shapes = [layer.weight.shape for layer in layers]
    wrong = [
        f"{name}: a layer gives {one[1]} numbers and the next one takes {other[0]}"
        for one, other in pairwise(shapes)
        if one[1] != other[0]
    ]
    if last is not None and shapes[-1][1] != last:
        wrong.append(f"{name}: the last one has to give {last} numbers, not {shapes[-1][1]}")
    if first is not None and shapes[0][0] != first:
        wrong.append(f"{name}: the first one has to take {first} numbers, not {shapes[0][0]}")
    return wrong


def _is_good(array: Weights, shape: tuple[int, ...]) -> bool:
    return array.shape == shape and array.size > 0 and bool(np.isfinite(array).all())


# --- arithmetic -------------------------------------------------------------------------------

_AFTER = {"none": 0, "tanh": 1, "relu": 2}


@njit(cache=True)
def _dense(x: Floats, weight: Floats, bias: Floats, after: int) -> Floats:
    """Compute a layer for rows, each on its own and every sum in the order of the inputs.

    Args:
        x: Shape (rows, inputs).
        weight: Shape (inputs, outputs).
        bias: Shape (outputs,).
        after: 1: hyperbolic tangents; 2: rectified; 0: neither.
    """
    rows, inputs, outputs = x.shape[0], weight.shape[0], weight.shape[1]
    found = np.empty((rows, outputs))
    for row in range(rows):
        total = found[row]
        total[:] = bias
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
