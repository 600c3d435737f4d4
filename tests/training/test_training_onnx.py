"""Policies as ONNX networks; nothing of this needs torch."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.errors import MissingExtra, UnknownOption, UnreadableFile
from scm_world.policies import MlpPolicy, save_policy
from scm_world.training.export import to_onnx

SIZES = {"achieved_goal": 10, "desired_goal": 10, "observation": 36}


def policy(**about: Any) -> MlpPolicy:
    """Make up a policy of 56 numbers."""
    rng = np.random.default_rng(1)
    tensors = {}
    for number, (outputs, inputs) in enumerate(((16, 56), (8, 16), (9, 8))):
        tensors[f"layers.{number}.weight"] = rng.normal(0, 0.5, (outputs, inputs))
        tensors[f"layers.{number}.bias"] = rng.normal(0, 0.5, outputs)
    arrays = {name: array.astype(np.float32) for name, array in tensors.items()}
    return MlpPolicy.of(arrays, {"task": "pushing", **about})


FORMS: list[dict[str, Any]] = [
    {"activation": "tanh", "output": "clip"},
    {"activation": "relu", "output": "tanh"},
    {"activation": "relu", "output": "tanh", "inputs": [*SIZES], "env": {"goal_env": True}},
]


@pytest.mark.parametrize("form", FORMS)
def test_networks_act_as_policies(form: dict[str, Any], tmp_path: Path) -> None:
    """For batches of any size; and what they are made for is in the file."""
    runtime = pytest.importorskip("onnxruntime")
    made = policy(**form)
    file = save_policy(tmp_path / "policy.safetensors", made)
    path = to_onnx(file, tmp_path / "policy.onnx")
    session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    for n in (1, 7):
        if "inputs" in form:
            seen: Any = {
                name: rng.normal(0, 1, (n, k)).astype(np.float32 if k == 36 else np.float64)
                for name, k in SIZES.items()
            }
            feed = seen
        else:
            seen = rng.normal(0, 1, (n, 56)).astype(np.float32)
            feed = {"observation": seen}
        (found,) = session.run(None, feed)
        np.testing.assert_allclose(found, made(seen), atol=2e-6)
    kept = session.get_modelmeta().custom_metadata_map["scm_world"]
    assert json.loads(kept) == json.loads(made.about.text())


def test_what_cannot_be_written_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No policy, or no library."""
    pytest.importorskip("onnx")
    with pytest.raises(UnknownOption, match="memory of an ONNX network"):
        to_onnx(MlpPolicy.of(policy().tensors(), {"memory": 1, "task": "any"}), tmp_path / "p.onnx")
    with pytest.raises(UnreadableFile, match="nothing"):
        to_onnx(tmp_path / "nothing.safetensors", tmp_path / "policy.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtra, match=r"scm-world\[train\]"):
        to_onnx(policy(), tmp_path / "policy.onnx")
