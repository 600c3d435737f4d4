"""Scores of representations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world.discovery.representations import DCI, dci, mcc, r2
from scm_world.errors import UnknownOption

Z = np.random.default_rng(0).uniform(-1.0, 1.0, size=(1200, 3))
MIXING = np.array([[1.0, 0.8, -0.6], [-0.7, 1.0, 0.9], [0.8, -0.6, 1.0]])


def test_permuted_and_distorted_factors_are_perfect() -> None:
    """MCC and DCI allow a permutation and a monotone function of each factor, R² does not."""
    codes = np.exp(2.0 * Z[:, [2, 0, 1]]) * [1.0, -1.0, 3.0]
    assert mcc(codes, Z) == pytest.approx(1.0)
    assert 0.7 < r2(codes, Z) < 0.95
    pytest.importorskip("sklearn")
    found = dci(codes, Z, trees=5)
    assert min(found.disentanglement, found.completeness, found.informativeness) > 0.97


def test_a_rotation_is_informative_but_not_disentangled() -> None:
    """R² is 1; each code tells of all factors."""
    codes = Z @ MIXING
    assert r2(codes, Z) == pytest.approx(1.0, abs=1e-3)
    assert mcc(codes, Z) < 0.8
    pytest.importorskip("sklearn")
    found = dci(codes, Z, trees=5)
    assert max(found.disentanglement, found.completeness) < 0.4


def test_noise_scores_by_chance() -> None:
    """Independent codes explain nothing of other rows, also where there are many."""
    codes = np.random.default_rng(1).normal(size=(1200, 3))
    assert mcc(codes, Z) < 0.1
    assert abs(r2(codes, Z)) < 0.05
    assert r2(np.random.default_rng(2).normal(size=(1200, 900)), Z) < 0.05


def test_a_factor_in_two_codes_is_not_complete() -> None:
    """But every code tells of one factor only."""
    pytest.importorskip("sklearn")
    found = dci(np.hstack([Z, Z + 1e-6]), Z, trees=10)
    assert isinstance(found, DCI)
    assert found.disentanglement > 0.97
    assert 0.4 < found.completeness < 0.75


@pytest.mark.parametrize(
    ("codes", "factors", "words"),
    [
        (Z[:, 0], Z, "codes"),
        (Z, Z[:5], "1200"),
        (Z[:, :2], Z, "3 columns"),
        (Z, np.ones_like(Z), "constant"),
        (np.full_like(Z, np.nan), Z, "finite"),
    ],
)
def test_what_cannot_be_scored_is_refused(codes: Any, factors: Any, words: str) -> None:
    """With what is wrong."""
    with pytest.raises(UnknownOption, match=words):
        mcc(codes, factors)


@pytest.mark.parametrize("constant", [slice(600), slice(600, None)])
def test_a_factor_that_is_constant_in_a_half_does_not_count(constant: slice) -> None:
    """The score is that of the other factors, and a warning lists the one that is left out."""
    factors = Z.copy()
    factors[constant, 1] = 0.1
    with pytest.warns(UserWarning, match="in a half of the rows, and do not count: columns 1;"):
        assert r2(Z[:, :1], factors) == pytest.approx(r2(Z[:, :1], Z[:, [0, 2]]))
    with pytest.warns(UserWarning, match="columns 0"):
        assert np.isnan(r2(Z, factors[:, [1]]))
    with pytest.raises(UnknownOption, match="constant column"):
        r2(Z, np.full((1200, 1), 0.1))
    pytest.importorskip("sklearn")
    with pytest.warns(UserWarning, match="columns 1"):
        assert 0.9 < dci(Z, factors, trees=5).informativeness < 1.0
