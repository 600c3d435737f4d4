"""Facts about policies of Stable-Baselines 2."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.errors import UnreadableFile
from scm_world.training import load_sb2

GOLDEN: dict[str, tuple[float, list[float], float, list[float]]] = {
    "reaching_ppo_curr1.zip": (
        37,
        [-1.1971, -0.4105, -2.9751, -2.0924, -0.9688, -4.1334, -2.878, -0.2502, -4.4673],
        106.825,
        [-0.3, 1.342, -1.231, 0.353, -1.013, -1.233, -0.309, 0.849, 0.187],
    ),
    "pushing_ppo_curr1.zip": (
        56,
        [8.2181, -13.8183, -12.5696, -15.2828, -8.8798, -4.9008, 18.004, -43.9157, -13.6006],
        3.11942,
        [1.123, 2.649, -0.653, -2.007, 4.831, -1.269, -0.962, 7.967, -2.182],
    ),
    "picking_ppo_curr1.zip": (
        56,
        [-10.2063, -34.3096, -6.6974, -11.863, -31.2926, -6.3192, -12.8778, -32.2954, -4.541],
        2.67351,
        [-0.231, -1.933, 0.683, -0.029, -4.108, 0.157, -0.793, -1.556, -0.52],
    ),
    "pick_and_place_ppo_curr0.zip": (
        67,
        [-9.5555, -25.5714, -15.6383, -10.1954, -1.4352, 6.2151, 7.6467, -34.6115, -11.3867],
        2.54372,
        [0.67, 2.753, -0.122, 1.598, -1.678, -0.544, -0.493, -0.642, -0.591],
    ),
    "stacking2_ppo_curr1.zip": (
        84,
        [-2.9266, -23.0091, -19.9542, -14.9895, -27.2184, -16.0165, -10.0254, -5.9751, -18.601],
        2.96593,
        [-1.082, 0.558, -0.222, 0.96, 0.164, 0.26, -0.398, 0.153, -1.206],
    ),
}
"""Observed numbers; mean action and value at the default start; mean action for zeros."""

FOLDER = os.environ.get("CAUSAL_WORLD_ACTORS", "")


def tensors(n: int = 5, hidden: tuple[int, int] = (8, 6)) -> dict[str, np.ndarray]:
    """Draw the weights of a small policy."""
    generator = np.random.default_rng(0)
    sizes = {
        "shared_fc0": (n, hidden[0]),
        "shared_fc1": hidden,
        "pi": (hidden[1], 9),
        "vf": (hidden[1], 1),
    }
    found = {}
    for name, shape in sizes.items():
        found[f"model/{name}/w:0"] = generator.normal(size=shape).astype(np.float32)
        found[f"model/{name}/b:0"] = generator.normal(size=shape[1]).astype(np.float32)
    found["model/pi/logstd:0"] = np.full((1, 9), -1.0, dtype=np.float32)
    return found


def archive(path: Path, arrays: dict[str, Any], *, member: str = "parameters") -> Path:
    """Write an archive as Stable-Baselines 2 does."""
    raw = io.BytesIO()
    np.savez(raw, **arrays)
    with zipfile.ZipFile(path, "w") as written:
        written.writestr("data", json.dumps({"policy": {":serialized:": "not to be opened"}}))
        written.writestr("parameter_list", json.dumps(list(arrays)))
        written.writestr(member, raw.getvalue())
    return path


def test_the_policy_is_the_plain_forward_pass(tmp_path: Path) -> None:
    """Two layers with hyperbolic tangents, a mean that is clipped, batches included."""
    own = tensors()
    policy = load_sb2(archive(tmp_path / "p.zip", own))
    x = np.random.default_rng(1).normal(size=(4, 3, 5)).astype(np.float32)
    features = x
    for layer in ("shared_fc0", "shared_fc1"):
        features = np.tanh(features @ own[f"model/{layer}/w:0"] + own[f"model/{layer}/b:0"])
    mean = features @ own["model/pi/w:0"] + own["model/pi/b:0"]
    given = np.random.default_rng(1).normal(size=(4, 3, 5))
    np.testing.assert_allclose(policy(given), np.clip(mean, -1, 1), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(policy.predict(given)[0], policy(given))
    assert policy(given).dtype == np.float32


def test_noise_comes_from_the_generator_alone(tmp_path: Path) -> None:
    """The same generator gives the same actions; another one gives others."""
    policy = load_sb2(archive(tmp_path / "p.zip", tensors()))
    x = np.zeros(5)
    drawn = [policy(x, np.random.default_rng(seed)) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    assert (np.abs(drawn) <= 1.0).all()
    with pytest.raises(ValueError, match="generator"):
        policy.predict(x, deterministic=False)


def test_another_observation_is_refused(tmp_path: Path) -> None:
    """The error says how many numbers the policy observes."""
    policy = load_sb2(archive(tmp_path / "p.zip", tensors()))
    with pytest.raises(ValueError, match="observes 5 numbers"):
        policy(np.zeros(6))


class _Bomb:
    def __reduce__(self) -> Any:
        return (print, ("executed",))


def test_nothing_is_unpickled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An array of objects, which would run code when it is loaded, is refused unopened."""
    bad = {**tensors(), "model/pi/b:0": np.array([_Bomb()], dtype=object)}
    with pytest.raises(UnreadableFile, match="plain arrays"):
        load_sb2(archive(tmp_path / "p.zip", bad))
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"model/pi/w:0": np.zeros((7, 9), np.float32)}, "do not fit"),
        ({"model/pi/b:0": np.zeros(8, np.float32)}, "of no use"),
        ({"model/shared_fc1/b:0": None}, "no layer 'model/shared_fc1'"),
        ({"model/pi/logstd:0": np.zeros(3, np.float32)}, "standard deviations"),
        ({"model/shared_fc0/w:0": None, "model/shared_fc1/w:0": None}, "no layer 'model/sh"),
    ],
)
def test_what_is_no_such_policy_is_named(tmp_path: Path, change: Any, match: str) -> None:
    """Missing and misshapen tensors are errors that say which."""
    changed = {key: value for key, value in {**tensors(), **change}.items() if value is not None}
    with pytest.raises(UnreadableFile, match=match):
        load_sb2(archive(tmp_path / "p.zip", changed))


def test_what_is_no_archive_is_named(tmp_path: Path) -> None:
    """A text file, an archive without weights, and no file at all."""
    (tmp_path / "text.zip").write_text("no")
    with pytest.raises(UnreadableFile, match="no zip"):
        load_sb2(tmp_path / "text.zip")
    with pytest.raises(UnreadableFile, match="no member"):
        load_sb2(archive(tmp_path / "p.zip", tensors(), member="other"))
    with pytest.raises(FileNotFoundError):
        load_sb2(tmp_path / "none.zip")


@pytest.mark.skipif(not FOLDER, reason="needs CAUSAL_WORLD_ACTORS, a folder with the actors")
@pytest.mark.parametrize("name", GOLDEN)
def test_the_published_actors_say_what_they_said(name: str) -> None:
    """For an observation of zeros, to the digits that are published."""
    policy = load_sb2(Path(FOLDER) / name)
    n, _, _, zeros = GOLDEN[name]
    assert policy.n_observed == n
    mean = policy.mean(policy.features(np.zeros(int(n))))
    np.testing.assert_allclose(mean, zeros, atol=6e-4)
