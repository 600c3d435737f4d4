"""Archives of Stable-Baselines 2, read with numpy alone.

Such a file is a zip of three members. ``parameters`` is a numpy archive of plain arrays, and
``parameter_list`` names them. ``data`` holds pickled Python objects: it is never opened.

Source:
    Stable-Baselines 2.10, ``common/base_class.py``; the tensors are those of its ``MlpPolicy``
    for PPO2 in CausalWorld 1.2.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from itertools import pairwise
from os import PathLike, fspath

import numpy as np

from scm_world.errors import UnreadableFile
from scm_world.evaluation.policies.mlp import Layer, MlpPolicy, Weights

MEMBER = "parameters"
LARGEST = 2**28  # [bytes] of the weights: more is no policy, and might be a trap


def load_sb2(path: str | PathLike[str]) -> MlpPolicy:
    """Load a policy that was trained with PPO2 of Stable-Baselines 2.

    Nothing in the file is executed.

    Args:
        path: Of the ``.zip`` archive.

    Raises:
        UnreadableFile: It is no such archive, or the policy in it is no multilayer perceptron.
        FileNotFoundError: There is no such file.
    """
    name = fspath(path)
    tensors = _tensors(name)
    hidden: list[Layer] = []
    while (f"model/shared_fc{len(hidden)}/w:0") in tensors:
        hidden.append(_layer(name, tensors, f"model/shared_fc{len(hidden)}"))
    mean = _layer(name, tensors, "model/pi")
    value = _layer(name, tensors, "model/vf") if "model/vf/w:0" in tensors else None
    if not hidden:
        raise UnreadableFile(name, "it has no layer 'model/shared_fc0'", _ADVICE)
    log_std = tensors.get("model/pi/logstd:0")
    if log_std is None or log_std.size != mean.bias.size or not _finite(log_std):
        raise UnreadableFile(name, "it has no standard deviations 'model/pi/logstd:0'", _ADVICE)
    heads = [mean] if value is None else [mean, value]
    pairs = [*pairwise(hidden), *((hidden[-1], head) for head in heads)]
    if any(before.bias.size != after.weight.shape[0] for before, after in pairs):
        raise UnreadableFile(name, "its layers do not fit one another", _ADVICE)
    return MlpPolicy(tuple(hidden), mean, log_std.reshape(-1), value)


_ADVICE = "only multilayer perceptrons of PPO2 (MlpPolicy) can be loaded"


def _tensors(name: str) -> dict[str, Weights]:
    try:
        with zipfile.ZipFile(name) as archive:
            _refuse_huge(name, archive.getinfo(MEMBER).file_size)
            raw = archive.read(MEMBER)
        with zipfile.ZipFile(io.BytesIO(raw)) as inner:
            _refuse_huge(name, sum(info.file_size for info in inner.infolist()))
        with np.load(io.BytesIO(raw), allow_pickle=False) as arrays:
            return {key: np.asarray(arrays[key], dtype=np.float32) for key in arrays.files}
    except KeyError:
        raise UnreadableFile(name, f"it has no member {MEMBER!r}", _ADVICE) from None
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:  # or encrypted
        raise UnreadableFile(name, f"it is no zip archive, or damaged ({error})", _ADVICE) from None
    except UnreadableFile:
        raise
    except (ValueError, TypeError) as error:  # pickled objects, or no numbers at all
        raise UnreadableFile(name, f"its weights are no plain arrays ({error})", _ADVICE) from None


def _refuse_huge(name: str, size: int) -> None:
    if size > LARGEST:
        raise UnreadableFile(name, f"its weights have more than {LARGEST} bytes", _ADVICE)


def _layer(name: str, tensors: dict[str, Weights], key: str) -> Layer:
    weight, bias = tensors.get(f"{key}/w:0"), tensors.get(f"{key}/b:0")
    if weight is None or bias is None:
        raise UnreadableFile(name, f"it has no layer {key!r}", _ADVICE)
    if weight.ndim != 2 or bias.shape != weight.shape[1:] or not _finite(weight, bias):
        raise UnreadableFile(name, f"the layer {key!r} has weights of no use", _ADVICE)
    return Layer(weight, bias)


def _finite(*arrays: Weights) -> bool:
    return all(bool(np.isfinite(array).all()) for array in arrays)
