"""Policy files as ONNX networks, for whoever reads nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scm_world._arguments import load
from scm_world.output.durable import write_durably
from scm_world.policies import NetworkPolicy, load_policy
from scm_world.policies.cards import KEY

OPSET, FORMAT = 17, 8
"""Versions that onnxruntime has known since 2022."""

GOALS = ("achieved_goal", "desired_goal")
"""Parts of an observation that are 64-bit floats."""

FUNCTIONS = {"tanh": "Tanh", "relu": "Relu"}


def to_onnx(policy: NetworkPolicy | Path | str, path: Path | str) -> Path:
    """Write a policy as an ONNX network, which takes a batch of observations.

    Actions are computed in 32-bit floats there, and so differ in the last digits. What the policy
    was made for stands in the metadata, as in the policy file.

    Args:
        policy: A policy, or its file.
        path: Of the ONNX file.

    Returns:
        The path.

    Raises:
        MissingExtra: The package onnx is not installed.
        UnreadableFile: The file is no policy.
        UnwritableFolder: There is no room, or no permission.
    """
    onnx: Any = load("onnx", "onnx")
    given = policy if isinstance(policy, NetworkPolicy) else load_policy(policy)
    made = _model(onnx, given)
    made.metadata_props.add(key=KEY, value=given.about.text())
    onnx.checker.check_model(made)
    target = Path(path)
    write_durably(target, made.SerializeToString())
    return target


def _model(onnx: Any, policy: NetworkPolicy) -> Any:
    helper, single, double = onnx.helper, onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE
    nodes: list[Any] = []
    arrays: dict[str, Any] = {}
    inputs: dict[str, tuple[Any, int | None]]

    def node(kind: str, names: list[str], output: str, **how: Any) -> str:
        nodes.append(helper.make_node(kind, names, [output], **how))
        return output

    about = policy.about
    if about.inputs is None:
        inputs, seen = {"observation": (single, policy.n_observed)}, "observation"
    else:
        inputs = {name: (double if name in GOALS else single, None) for name in about.inputs}
        parts = [node("Cast", [name], f"{name}_single", to=single) for name in inputs]
        seen = node("Concat", parts, "joined", axis=1)
    for number, layer in enumerate(policy.layers):
        names = [f"weight_{number}", f"bias_{number}"]
        arrays |= zip(names, (np.ascontiguousarray(layer.weight), layer.bias), strict=True)
        seen = node("Gemm", [seen, *names], f"sum_{number}")
        if number < len(policy.layers) - 1:
            seen = node(FUNCTIONS[about.activation], [seen], f"hidden_{number}")
    if about.output == "tanh":
        node("Tanh", [seen], "action")
    else:
        arrays |= {"low": np.array(-1.0, np.float32), "high": np.array(1.0, np.float32)}
        node("Clip", [seen, "low", "high"], "action")
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(n, k, [None, size]) for n, (k, size) in inputs.items()],
        [helper.make_tensor_value_info("action", single, [None, policy.n_actions])],
        [onnx.numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )
    opset = [helper.make_opsetid("", OPSET)]
    how = {"opset_imports": opset, "ir_version": FORMAT, "producer_name": "scm_world"}
    return helper.make_model(graph, **how)
