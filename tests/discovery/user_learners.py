"""Learners as users write them, good and bad ones, for the tests of benchmarks."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.discovery.data import Dataset
from scm_world.discovery.learners import EstimatedGraph
from scm_world.errors import ModelError

MARK = "SCM_WORLD_TEST_MARK"
"""Names the folder in which ``marked`` leaves a file for each of its runs."""


def correlated(data: Dataset, *, seed: int = 0) -> Any:
    """Connect what is correlated."""
    del seed
    strong = np.abs(np.corrcoef(data.values.T)) > 0.3
    return np.triu(strong, 1)


def marked(data: Dataset, *, seed: int = 0) -> Any:
    """Write down that it works, and with which process, and take its time."""
    Path(os.environ[MARK], f"{os.getpid()}-{len(data)}-{seed}-{time.time_ns()}").touch()
    time.sleep(0.3)
    return correlated(data)


def sleeper(data: Dataset, *, seed: int = 0) -> Any:
    """Take far too long."""
    if MARK in os.environ:
        Path(os.environ[MARK], f"{os.getpid()}-asleep").touch()
    time.sleep(600.0)
    return correlated(data, seed=seed)


def busy(data: Dataset, *, seed: int = 0) -> Any:
    """Take far too long, without a pause."""
    Path(os.environ[MARK], f"{os.getpid()}-busy").touch()
    end = time.monotonic() + 600.0
    while time.monotonic() < end:
        np.linalg.svd(np.ones((40, 40)))
    return correlated(data, seed=seed)


def refuses(data: Dataset, *, seed: int = 0) -> Any:
    """Find the data wrong."""
    raise ModelError([f"{len(data)} rows of seed {seed} are not to its liking"])


def confused(data: Dataset, *, seed: int = 0) -> Any:
    """Have a mistake of its own."""
    return {"a": len(data) + seed}["b"]


def hungry(data: Dataset, *, seed: int = 0) -> Any:
    """Need more memory than there is."""
    raise MemoryError


def dies(data: Dataset, *, seed: int = 0) -> Any:
    """Take its process with it."""
    os._exit(3)


def leaves(data: Dataset, *, seed: int = 0) -> Any:
    """Think that it is a program."""
    raise SystemExit(4)


def unwritable(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Find nothing, with a setting that no file can hold."""
    return EstimatedGraph.of_edges(data.names, [], settings={"what": print})


def infinite(data: Dataset, *, seed: int = 0) -> Any:
    """Be infinitely sure."""
    return np.full((len(data.names),) * 2, np.inf)


def rightward(data: Dataset, *, seed: int = 0) -> Any:
    """Let every column act on those to the right of it; use no data."""
    return np.triu(np.ones((len(data.names),) * 2), 1)
