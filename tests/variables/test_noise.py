"""Facts about noise: it is a value, not an event."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scm_world.variables import Noise

PROGRAM = """
from scm_world.variables import Noise
print(Noise(11).uniforms("tool_block.mass", n=5, episode=3, step=7, count=4).tobytes().hex())
"""


@settings(max_examples=40, deadline=None)
@given(
    n=st.integers(1, 9),
    chunks=st.lists(st.integers(1, 7), min_size=1, max_size=5),
    first=st.integers(0, 2**40),
)
def test_chunks_do_not_matter(n: int, chunks: list[int], first: int) -> None:
    """Episodes drawn in pieces, in any order, equal those drawn at once."""
    noise, total = Noise(4), sum(chunks)
    whole = noise.uniforms("x", n=n, episode=first, count=total)
    starts = np.cumsum([0, *chunks[:-1]])
    pieces = [
        noise.uniforms("x", n=n, episode=first + int(start), count=count)
        for start, count in reversed(list(zip(starts, chunks, strict=True)))
    ]
    np.testing.assert_array_equal(np.concatenate(pieces[::-1]), whole)


def test_another_process_draws_the_same() -> None:
    """Noise depends on its key only, not on hash seeds or on the process."""
    run = subprocess.run(  # noqa: S603 our own interpreter
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    )
    here = Noise(11).uniforms("tool_block.mass", n=5, episode=3, step=7, count=4)
    assert run.stdout.strip() == here.tobytes().hex()


def test_the_global_generator_plays_no_part() -> None:
    """Seeding numpy changes nothing, and drawing leaves its state alone."""
    np.random.seed(0)  # noqa: NPY002 that is the point
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    first = Noise(1).uniforms("x", n=3)
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    np.testing.assert_array_equal(Noise(1).uniforms("x", n=3), first)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({}, {"seed": 1}),
        ({}, {"variable": "y"}),
        ({}, {"episode": 5_000}),
        ({}, {"step": 1}),
        ({"seed": 1, "step": 0}, {"seed": 0, "step": 1}),
        ({"step": 1, "episode": 0}, {"step": 0, "episode": 1}),
    ],
)
def test_other_keys_give_independent_noise(first: dict, second: dict) -> None:
    """Streams of other variables, seeds, episodes and steps are not correlated."""

    def stream(seed: int = 0, variable: str = "x", episode: int = 0, step: int = 0) -> np.ndarray:
        return Noise(seed).uniforms(variable, n=4, episode=episode, step=step, count=2_000)

    a, b = stream(**first).ravel(), stream(**second).ravel()
    assert not np.isin(a[:100], b).any()
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.04


def test_uniforms_are_uniform() -> None:
    """Numbers lie in [0, 1), fill ten bins evenly, and the bits below are no pattern."""
    values = Noise(0).uniforms("x", n=5, count=20_000)
    assert values.min() >= 0.0
    assert values.max() < 1.0
    counts = np.histogram(values, bins=10, range=(0.0, 1.0))[0]
    assert np.abs(counts / 10_000 - 1.0).max() < 0.05
    assert np.corrcoef(values.T)[np.triu_indices(5, 1)].max() < 0.03


def test_no_numbers_are_an_empty_array() -> None:
    """A draw that takes no numbers is possible."""
    assert Noise(0).uniforms("x", n=0, count=3).shape == (3, 0)


def test_noise_is_compared_by_its_seed() -> None:
    """Two noises of one seed are one value."""
    assert Noise(3) == Noise(3) != Noise(4)
    assert len({Noise(3), Noise(3)}) == 1
    assert repr(Noise(3)) == "Noise(seed=3)"
