"""Policy files as ONNX networks, for whoever reads nothing else."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.errors import MissingExtra
from scm_world.evaluation.policies.cards import KEY
from scm_world.evaluation.policies.weights import NetworkPolicy, load_policy
from scm_world.output.durable import write_durably

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
    try:
        onnx: Any = importlib.import_module("onnx")
    except ImportError as error:
        raise MissingExtra("onnx", "onnx") from error
    given = policy if isinstance(policy, NetworkPolicy) else load_policy(policy)
    made = _model(onnx, given)
    made.metadata_props.add(key=KEY, value=given.about.text())
    onnx.checker.check_model(made)
    target = Path(path)
    write_durably(target, made.SerializeToString())
    return target


def _model(onnx: Any, policy: NetworkPolicy) -> Any:
    helper, types = onnx.helper, onnx.TensorProto
    inputs, nodes, seen = _observed(helper, types, policy)
    weights: list[Any] = []
    last = len(policy.layers) - 1
    for number, layer in enumerate(policy.layers):
        names = [f"weight_{number}", f"bias_{number}"]
        arrays = (np.ascontiguousarray(layer.weight), layer.bias)
        weights += [onnx.numpy_helper.from_array(a, n) for a, n in zip(arrays, names, strict=True)]
        nodes.append(helper.make_node("Gemm", [seen, *names], [f"sum_{number}"]))
        seen = f"sum_{number}"
        if number < last:
            kind = FUNCTIONS[policy.about.activation]
            nodes.append(helper.make_node(kind, [seen], [f"hidden_{number}"]))
            seen = f"hidden_{number}"
    if policy.about.output == "tanh":
        nodes.append(helper.make_node("Tanh", [seen], ["action"]))
    else:
        ends = {"low": np.float32(-1.0), "high": np.float32(1.0)}
        weights += [onnx.numpy_helper.from_array(np.array(end), n) for n, end in ends.items()]
        nodes.append(helper.make_node("Clip", [seen, *ends], ["action"]))
    output = helper.make_tensor_value_info("action", types.FLOAT, [None, policy.n_actions])
    graph = helper.make_graph(nodes, "policy", inputs, [output], weights)
    opset = helper.make_opsetid("", OPSET)
    return helper.make_model(
        graph, opset_imports=[opset], ir_version=FORMAT, producer_name="scm_world"
    )


def _observed(helper: Any, types: Any, policy: NetworkPolicy) -> tuple[list[Any], list[Any], str]:
    """Give the inputs, what joins them, and the name of the joined observation."""
    if policy.about.inputs is None:
        shape = [None, policy.n_observed]
        return [helper.make_tensor_value_info("observation", types.FLOAT, shape)], [], "observation"
    inputs, nodes, parts = [], [], []
    for name in policy.about.inputs:
        kind = types.DOUBLE if name in GOALS else types.FLOAT
        inputs.append(helper.make_tensor_value_info(name, kind, [None, None]))
        nodes.append(helper.make_node("Cast", [name], [f"{name}_single"], to=types.FLOAT))
        parts.append(f"{name}_single")
    nodes.append(helper.make_node("Concat", parts, ["joined"], axis=1))
    return inputs, nodes, "joined"
