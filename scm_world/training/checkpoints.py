"""Instants of a training on disk: whole or absent, in formats that run no code.

A checkpoint is a folder named by the number of control steps, with ``state.json`` and
``tensors.safetensors``. It is written beside its place and then renamed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, final

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output.durable import made, synced, write_durably

FORMAT = "scm_world/checkpoint/2"
KEPT = 2
STATE, TENSORS = "state.json", "tensors.safetensors"


@final
@dataclass(frozen=True)
class Checkpoint:
    """Everything that decides how a training goes on.

    Attributes:
        steps: Control steps so far.
        tensors: Arrays by name.
        state: Plain data.
    """

    steps: int
    tensors: Mapping[str, NDArray[Any]]
    state: Mapping[str, Any]


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint, whole or not at all, and remove all but the last ones.

    Args:
        folder: In which checkpoints are.
        checkpoint: What is written.

    Returns:
        Its folder.

    Raises:
        UnwritableFolder: There is no room, or no permission; those before are still there.
    """
    made(folder)
    for left in folder.glob(".*.part"):  # somebody was killed while it was written
        shutil.rmtree(left, ignore_errors=True)
    target = folder / str(checkpoint.steps)
    draft = target.with_name(f".{target.name}.part")
    arrays = {name: np.ascontiguousarray(array) for name, array in checkpoint.tensors.items()}
    data = safetensors.numpy.save(arrays)
    state = {"format": FORMAT, "steps": checkpoint.steps, **checkpoint.state}
    signed = json.dumps({"sum": _sum(data, state), **state}, allow_nan=False)
    try:
        made(draft)
        write_durably(draft / TENSORS, data)
        write_durably(draft / STATE, signed.encode())
        shutil.rmtree(target, ignore_errors=True)
        draft.replace(target)
        synced(folder)
    except OSError as error:
        if isinstance(error, UnwritableFolder):
            raise
        raise UnwritableFolder(str(folder), error.strerror or str(error)) from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    for old in checkpoints(folder)[:-KEPT]:
        with suppress(OSError):
            shutil.rmtree(old)
    return target


def checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints of a folder, the last one at the end."""
    found = [path for path in folder.glob("*") if path.name.isdecimal() and path.is_dir()]
    return sorted(found, key=lambda path: int(path.name))


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Nothing in it is executed.

    Raises:
        UnreadableFile: It is damaged, or of another kind.
    """
    try:
        state = json.loads((path / STATE).read_text(encoding="utf-8"))
        data = (path / TENSORS).read_bytes()
        if not isinstance(state, dict) or state.get("format") != FORMAT:
            raise ValueError(f"{STATE} is not of the format {FORMAT!r}")
        if state.pop("sum", None) != _sum(data, state):
            raise ValueError(f"{TENSORS} or {STATE} is not what was written")
        del state["format"]
        tensors = safetensors.numpy.load(data)
        return Checkpoint(int(state.pop("steps")), tensors, state)
    except (OSError, ValueError, TypeError, KeyError, SafetensorError) as error:
        raise UnreadableFile(str(path), str(error), ADVICE) from None


def _sum(data: bytes, state: Mapping[str, Any]) -> str:
    """Compute the sum over both files; JSON that was read is written as it was before."""
    return blake2b(data + json.dumps(state).encode(), digest_size=16).hexdigest()


ADVICE = "remove this folder to go on from the checkpoint before it, or from the beginning"
