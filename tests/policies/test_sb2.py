"""Facts about policies of Stable-Baselines 2."""

from __future__ import annotations

import io
import json
import os
import pickle
import zipfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest

from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.policies import load_sb2


class Golden(NamedTuple):
    """What a published actor answers, without clipping, to five decimals.

    ``start`` and ``value`` are the mean action and the value at the beginning of the default
    episode, ``zeros`` the mean action for an observation of zeros.
    """

    file: str
    task: str
    start: list[float]
    value: float
    zeros: list[float]


GOLDEN = [
    Golden(
        file="reaching_ppo_curr1.zip",
        task="Reaching",
        start=[
            -1.19713,
            -0.41048,
            -2.9751,
            -2.09243,
            -0.96876,
            -4.13343,
            -2.878,
            -0.25019,
            -4.46735,
        ],
        value=106.825,
        zeros=[-0.29993, 1.3424, -1.23127, 0.35336, -1.01278, -1.23323, -0.30887, 0.84923, 0.18667],
    ),
    Golden(
        file="pushing_ppo_curr1.zip",
        task="Pushing",
        start=[
            8.21811,
            -13.81834,
            -12.56961,
            -15.28277,
            -8.87979,
            -4.90083,
            18.00404,
            -43.91566,
            -13.60064,
        ],
        value=3.11942,
        zeros=[1.123, 2.64885, -0.6535, -2.00652, 4.83134, -1.26885, -0.96207, 7.96673, -2.18227],
    ),
    Golden(
        file="picking_ppo_curr1.zip",
        task="Picking",
        start=[
            -10.20625,
            -34.30957,
            -6.69743,
            -11.86302,
            -31.29261,
            -6.31918,
            -12.8778,
            -32.29537,
            -4.541,
        ],
        value=2.67351,
        zeros=[
            -0.23119,
            -1.9332,
            0.68287,
            -0.02934,
            -4.10836,
            0.15653,
            -0.79263,
            -1.55587,
            -0.52014,
        ],
    ),
    Golden(
        file="pick_and_place_ppo_curr0.zip",
        task="PickAndPlace",
        start=[
            -9.5555,
            -25.57136,
            -15.63826,
            -10.19541,
            -1.43522,
            6.21512,
            7.64673,
            -34.61153,
            -11.3867,
        ],
        value=2.54372,
        zeros=[
            0.67041,
            2.75262,
            -0.1218,
            1.59799,
            -1.67784,
            -0.54375,
            -0.49318,
            -0.64226,
            -0.59129,
        ],
    ),
    Golden(
        file="stacking2_ppo_curr1.zip",
        task="Stacking2",
        start=[
            -2.92663,
            -23.00911,
            -19.95421,
            -14.98953,
            -27.2184,
            -16.01649,
            -10.02536,
            -5.9751,
            -18.60104,
        ],
        value=2.96593,
        zeros=[-1.0817, 0.55802, -0.22245, 0.95954, 0.16421, 0.25979, -0.39767, 0.15276, -1.20638],
    ),
]
ROUNDING = 6e-6  # half of the last digit, and some for single precision
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
    drawn = [policy(x, generator=np.random.default_rng(seed)) for seed in (3, 3, 4)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    assert (np.abs(drawn) <= 1.0).all()
    many = policy(np.zeros((20_000, 5)), generator=np.random.default_rng(0))
    mean = policy.mean(x)
    inside = np.clip(mean + np.exp(-1.0) * np.random.default_rng(1).normal(size=(20_000, 9)), -1, 1)
    np.testing.assert_allclose(many.mean(axis=0), inside.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(many.std(axis=0), inside.std(axis=0), atol=0.02)
    with pytest.raises(UnknownOption, match="deterministic"):
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
    with pytest.raises(UnreadableFile, match="Object arrays cannot be loaded"):
        load_sb2(archive(tmp_path / "p.zip", bad))
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"model/pi/w:0": np.zeros((7, 9), np.float32)}, "it takes 7 numbers, and gets"),
        ({"model/vf/w:0": np.zeros((7, 1), np.float32)}, "it takes 7 numbers, and gets"),
        ({"model/pi/b:0": np.full(9, np.nan, np.float32)}, "finite numbers"),
        ({"model/pi/w:0": np.full((6, 9), "text")}, "could not convert string"),
        ({"model/pi/b:0": np.zeros(8, np.float32)}, "finite numbers"),
        ({"model/shared_fc1/b:0": None}, "KeyError: 'model/shared_fc1/b:0'"),
        ({"model/pi/logstd:0": np.zeros(3, np.float32)}, "log_std: expected"),
        (
            {"model/shared_fc0/w:0": None, "model/shared_fc1/w:0": None},
            "KeyError: 'model/shared_fc0/w:0",
        ),
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
    with pytest.raises(UnreadableFile, match="not a zip") as caught:
        load_sb2(tmp_path / "text.zip")
    assert caught.value.path.endswith("text.zip")
    assert "only multilayer perceptrons" in str(caught.value)
    with pytest.raises(UnreadableFile, match="no item named"):
        load_sb2(archive(tmp_path / "p.zip", tensors(), member="other"))
    with pytest.raises(UnreadableFile, match="No such file"):
        load_sb2(tmp_path / "none.zip")


@pytest.mark.parametrize("content", [pickle.dumps({"model/pi/w:0": 1}), b"", b"PK", b"\x93NUMPY"])
def test_weights_that_are_no_numpy_archive_are_refused(tmp_path: Path, content: bytes) -> None:
    """A pickle, nothing, the beginning of a zip, and a single array in place of the weights."""
    with zipfile.ZipFile(tmp_path / "p.zip", "w") as written:
        written.writestr("parameters", content)
    with pytest.raises(UnreadableFile, match=r"p\.zip"):
        load_sb2(tmp_path / "p.zip")


@pytest.mark.skipif(not FOLDER, reason="needs CAUSAL_WORLD_ACTORS, a folder with the actors")
@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden.task)
def test_the_published_actors_say_what_they_said(golden: Golden) -> None:
    """For zeros, and for what our own environment shows at the start under the conventions."""
    policy = load_sb2(Path(FOLDER) / golden.file)
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=ROUNDING)
    close(policy.mean(np.zeros(policy.n_observed)), golden.zeros)

    env = gymnasium.make(
        f"scm_world/{golden.task}-v0",
        backend="fake",
        conventions="causal_world",
        frame_skip=3,
        disable_env_checker=True,
    )
    observation, _ = env.reset(seed=0)
    env.close()
    close(policy.mean(observation), golden.start)
    close(policy.values(observation), [golden.value])
    close(policy(observation), np.clip(golden.start, -1, 1))
