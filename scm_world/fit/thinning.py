"""Rows that a fit uses: of recordings at high rates, as many as the motion needs."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from scm_world._types import Floats
from scm_world.fit.problem import SHORT
from scm_world.fit.recordings import Measurements, RecordedRun

ENOUGH = 250  # rows that are left at least
MOST = 50  # rows of which one is left, at most
QUIET = 0.01  # largest noise, in the spread, of a column that shows how fast the motion is
STRAIGHT = 0.003  # largest distance to the line between rows, in the spread, beyond the noise
SLACK = 1.05  # relative error of the noise
SELDOM = 0.5  # share of the rows; of a column that was measured in fewer, all are left


def thinned(measured: Measurements, every: int | None = None) -> Measurements:
    """Return a recording of which every n-th row is used, under the same commands.

    The number n is the largest one with which all rows are as close to the lines between those that
    are used as their noise and a small share of their spread; at least 250 rows are left. Columns
    of which most is noise do not count if others are quiet. Rows of a column that was measured in
    few rows stay.

    Args:
        measured: The recording.
        every: The number n, if it is known.
    """
    n = _needed(measured) if every is None else every
    if n == 1:
        return measured
    seldom = np.isfinite(measured.values).mean(axis=0) < SELDOM
    runs = tuple(_used(run, n, run.values[:, seldom]) for run in measured.runs)
    return replace(measured, runs=runs, every=n)


def _used(run: RecordedRun, n: int, seldom: Floats) -> RecordedRun:
    """Return a run of which every n-th row is left, and those of columns measured seldom."""
    rows = np.arange(len(run.instants))
    step = min(n, max(1, len(rows) // SHORT))
    kept = (rows % step == 0) | np.isfinite(seldom).any(axis=1)
    instants = run.instants[kept]
    sent = run.commands[: int(instants[-1])]
    return replace(run, commands=sent, instants=instants, values=run.values[kept])


def _needed(measured: Measurements) -> int:
    """Return of how many rows one shows the motion."""
    most = min(len(measured.values) // ENOUGH, MOST)
    often = np.isfinite(measured.values).mean(axis=0) >= SELDOM
    spread = np.maximum(np.nanstd(measured.values, axis=0), measured.least)
    noise = measured.noise / spread
    quiet = often & (noise < QUIET)
    columns = np.flatnonzero(quiet if quiet.any() else often)
    scaled = [run.filled[:, columns] / spread[columns] for run in measured.runs]
    for n in range(2, most + 1):
        off = np.concatenate([_off(values, n) for values in scaled])
        share = np.arange(1, n) / n
        beside = np.mean(1.0 + share**2 + (1.0 - share) ** 2)  # variance of noise off the line
        allowed = SLACK * beside * noise[columns] ** 2 + STRAIGHT**2
        if len(off) and (np.nanmean(off**2, axis=0) > allowed).any():
            return n - 1
    return max(most, 1)


def _off(values: Floats, n: int) -> Floats:
    """Return how far values are from the lines between every n-th of them, (m, columns)."""
    kept = np.arange(0, len(values), n)
    within = [slice(first + 1, last) for first, last in pairwise(kept)]
    rows = np.array([row for one in within for row in range(one.start, one.stop)], int)
    first, share = rows // n * n, (rows % n / n)[:, None]
    return np.asarray(values[rows] - (1 - share) * values[first] - share * values[first + n])
