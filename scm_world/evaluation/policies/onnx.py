"""Networks in ONNX files, run one observation at a time and always in the same order."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world.env import ScmWorldEnv
from scm_world.errors import ActionError, ModelError, UnreadableFile
from scm_world.evaluation.policies.cards import KEY, PolicyAbout, refuse_other_form
from scm_world.evaluation.policies.players import About, Actions, Player, Playing
from scm_world.graph.exchange.libraries import load

TYPES = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(double)": np.dtype(np.float64),
    "tensor(uint8)": np.dtype(np.uint8),
}
"""What a network may take, and the arrays that stand for it."""


@final
class ByNetwork(Playing):
    """Asks a network that takes a batch of observations and gives a batch of actions.

    An observation that is an array goes to its only input; one that is arrays by name goes to
    inputs of the same names. The first output is the action, shape (1, n) or (n,). What the network
    was trained for stands in its metadata under ``"scm_world"``, if it is known.

    Args:
        path: Of the ONNX file.
        about: What it is.

    Raises:
        MissingExtra: onnxruntime is not installed.
        UnreadableFile: It is no network, or what it says of itself is no ``PolicyAbout``.
    """

    def __init__(self, path: Path, about: About) -> None:
        runtime: Any = load("onnxruntime", "onnxruntime", "onnx")
        super().__init__({**about, "library": f"onnxruntime {runtime.__version__}"})
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.execution_mode = runtime.ExecutionMode.ORT_SEQUENTIAL
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # it raises what it would print
        self._path = path
        try:
            content = path.read_bytes()
            if _ELSEWHERE in content:
                raise ValueError("its weights lie in another file; save it as one file")
            self._session = runtime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its errors have no class of their own in common
            raise UnreadableFile(str(path), f"it is no network ({error})", _ADVICE) from None
        self._inputs = {node.name: node for node in self._session.get_inputs()}
        self._output = self._session.get_outputs()[0].name
        text = self._session.get_modelmeta().custom_metadata_map.get(KEY)
        try:
            self._made_for = None if text is None else PolicyAbout.of(text)
        except ModelError as error:
            reason = f"its metadata {KEY!r}: {'; '.join(error.problems)}"
            raise UnreadableFile(str(path), reason, _ADVICE) from None

    def __reduce__(self) -> Any:
        """Let a copy read the file again."""
        return type(self), (self._path, self._about)

    @property
    def made_for(self) -> PolicyAbout | None:
        """What the network was trained for, if it says so."""
        return self._made_for

    @property
    def is_plain(self) -> bool:
        """Whether its actions follow from what it observes: they do."""
        return True

    def twin(self) -> Player:
        """Give itself: it remembers nothing."""
        return self

    def begin(self, env: ScmWorldEnv) -> None:
        """Check that the network takes what the environment gives.

        Raises:
            UnreadableFile: It takes another shape or type, or other inputs.
            UnknownOption: It was trained with other options of the environment.
        """
        refuse_other_form(self._made_for, env, self._name)
        self._env = env
        feed = self._feed(env.observe())
        if feed.keys() != self._inputs.keys():
            reason = f"it takes {[*self._inputs]}, and the environment gives {[*feed]}"
            raise UnreadableFile(str(self._path), reason, _ADVICE)
        for name, array in feed.items():
            node = self._inputs[name]
            if not _fits(node, array):
                reason = (
                    f"its input {name!r} takes {node.type} of shape {tuple(node.shape)}, and the "
                    f"environment gives {array.dtype} of shape {array.shape}"
                )
                raise UnreadableFile(str(self._path), reason, _ADVICE)

    def act(self, observation: Any) -> Actions:
        """Choose an action, shape (n_actions,)."""
        try:
            found = self._session.run([self._output], self._feed(observation))[0]
        except Exception as error:  # as above
            raise ActionError(
                f"the policy {self._name!r} cannot act on what it observes: {error}", None
            ) from None
        return self._checked(found[0] if np.ndim(found) == 2 and len(found) == 1 else found)

    def _feed(self, observation: Any) -> dict[str, Any]:
        if isinstance(observation, dict):
            return {name: np.asarray(part)[None] for name, part in observation.items()}
        return {next(iter(self._inputs)): np.asarray(observation)[None]}


def _fits(node: Any, array: Actions) -> bool:
    """Tell whether an input takes an array; a dimension without a number takes any length."""
    return (
        TYPES.get(node.type) == array.dtype
        and len(node.shape) == array.ndim
        and all(
            not isinstance(wanted, int) or wanted == length
            for wanted, length in zip(node.shape, array.shape, strict=True)
        )
    )


_ELSEWHERE = b"\x0a\x08location\x12"
"""How ONNX writes that weights are kept outside of the file: an entry with this key."""

_ADVICE = (
    "give an ONNX network that takes the observations of the environment, each with a first "
    "dimension of 1 or of any length, and gives the action first"
)
