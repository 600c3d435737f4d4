"""ONNX networks, computed on one thread and always in the same order."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world._arguments import load
from scm_world.errors import ActionError, ModelError, UnreadableFile
from scm_world.output.reading import read_bytes
from scm_world.policies.cards import KEY, PolicyAbout

_TYPES = {"tensor(float)": "float32", "tensor(double)": "float64", "tensor(uint8)": "uint8"}
_ELSEWHERE = b"\x0a\x08location\x12"  # how ONNX says that weights lie in another file
_ADVICE = (
    "give an ONNX network that takes the observations of the environment, each with a first "
    "dimension of 1 or of any length, and gives the action first"
)


@final
class OnnxPolicy:
    """A network that takes a batch of observations and gives a batch of actions.

    An observation that is an array goes to its only input; one that is arrays by name goes to
    inputs of the same names. The first output is the action, shape (1, n) or (n,).

    Args:
        path: Of the ONNX file.
        content: That was read from it; if None it is read.

    Attributes:
        made_for: What it was trained for: the metadata entry ``"scm_world"``, if there is one.
        library: Name and version of the library that computes it.

    Raises:
        MissingExtra: onnxruntime is not installed.
        UnreadableFile: It is no network, or its metadata entry is no ``PolicyAbout``.
    """

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        runtime: Any = load("onnxruntime", "onnxruntime", "train")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = runtime.ExecutionMode.ORT_SEQUENTIAL
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # it raises what it would print
        self._path, self.library = path, f"onnxruntime {runtime.__version__}"
        try:
            content = read_bytes(path) if content is None else content
            if _ELSEWHERE in content:
                raise ValueError("its weights lie in another file; save it as one file")
            self._content = content
            cpu = ["CPUExecutionProvider"]
            self._session = runtime.InferenceSession(content, options, providers=cpu)
        except Exception as error:  # its errors have no class of their own in common
            raise UnreadableFile(str(path), f"it is no network ({error})", _ADVICE) from None
        self._inputs = {node.name: node for node in self._session.get_inputs()}
        self._output = self._session.get_outputs()[0].name
        text = self._session.get_modelmeta().custom_metadata_map.get(KEY)
        try:
            self.made_for = None if text is None else PolicyAbout.of(text)
        except ModelError as error:
            reason = f"its metadata {KEY!r}: {'; '.join(error.problems)}"
            raise UnreadableFile(str(path), reason, _ADVICE) from None
        if self.made_for is not None and self.made_for.memory:
            raise UnreadableFile(str(path), "its metadata says that it has a memory", _ADVICE)

    def __reduce__(self) -> Any:
        """Pickle what was read: the file may change meanwhile."""
        return type(self), (self._path, self._content)

    def check(self, observation: Any, n_actions: int) -> None:
        """Check that the network takes an observation; its action is checked when it acts.

        Raises:
            UnreadableFile: It takes another shape or type, or other inputs.
        """
        feed = self._feed(observation)
        if feed.keys() != self._inputs.keys():
            reason = f"it takes {[*self._inputs]}, and the environment gives {[*feed]}"
            raise UnreadableFile(str(self._path), reason, _ADVICE)
        for name, array in feed.items():
            node = self._inputs[name]
            same = len(node.shape) == array.ndim and all(
                not isinstance(wanted, int) or wanted == length  # else any length will do
                for wanted, length in zip(node.shape, array.shape, strict=True)
            )
            if not same or _TYPES.get(node.type) != array.dtype:
                reason = (
                    f"its input {name!r} takes {node.type} of shape {tuple(node.shape)}, and the "
                    f"environment gives {array.dtype} of shape {array.shape}"
                )
                raise UnreadableFile(str(self._path), reason, _ADVICE)

    def __call__(self, observation: Any) -> Any:
        """Compute the action, shape (n_actions,).

        Raises:
            ActionError: The network does not take the observation.
        """
        try:
            found = self._session.run([self._output], self._feed(observation))[0]
        except Exception as error:  # as above
            message = f"the policy {self._path.name!r} cannot act on what it observes: {error}"
            raise ActionError(message, None) from None
        return found[0] if np.ndim(found) == 2 and len(found) == 1 else found

    def _feed(self, observation: Any) -> dict[str, Any]:
        if isinstance(observation, dict):
            return {name: np.asarray(part)[None] for name, part in observation.items()}
        return {next(iter(self._inputs)): np.asarray(observation)[None]}
