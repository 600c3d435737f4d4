"""How well a ranking puts what is there before what is not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from scm_world._types import Floats

Bools = NDArray[np.bool_]


def auroc(sureness: Floats, present: Bools) -> float | None:
    """Compute the area under the curve of recall over false alarms.

    It is the probability that something present ranks before something absent; ties count half.

    Args:
        sureness: Of each candidate, shape (n,); the larger, the surer.
        present: Whether it is there, shape (n,).

    Returns:
        In [0, 1]; 0.5 for a blind guess. None if all are present, or none is.

    Source:
        Hanley and McNeil, *The meaning and use of the area under a receiver operating
        characteristic (ROC) curve*, Radiology 1982.

    Example:
        >>> auroc(np.array([0.9, 0.5, 0.5, 0.1]), np.array([True, True, False, False]))
        0.875
    """
    positives = int(present.sum())
    negatives = len(present) - positives
    if not positives or not negatives:
        return None
    above = rankdata(sureness)[present].sum() - positives * (positives + 1) / 2.0
    return float(above / (positives * negatives))


def auprc(sureness: Floats, present: Bools) -> float | None:
    """Compute the average precision: precision at each recall, summed over the steps in recall.

    Candidates with the same sureness are accepted together.

    Args:
        sureness: Of each candidate, shape (n,); the larger, the surer.
        present: Whether it is there, shape (n,).

    Returns:
        In (0, 1]; the share of what is present for a blind guess. None if all are present, or
        none is.

    Source:
        Davis and Goadrich, *The relationship between precision-recall and ROC curves*, ICML 2006,
        on why not to interpolate linearly.

    Example:
        >>> auprc(np.array([0.9, 0.5, 0.5, 0.1]), np.array([True, True, False, False]))
        0.833...
    """
    positives = int(present.sum())
    if not positives or positives == len(present):
        return None
    levels, at = np.unique(-sureness, return_inverse=True)
    accepted = np.cumsum(np.bincount(at, minlength=len(levels)))
    hits = np.cumsum(np.bincount(at, weights=present, minlength=len(levels)))
    steps = np.diff(hits, prepend=0.0) / positives
    return float((steps * hits / accepted).sum())


__all__ = ["auprc", "auroc"]
