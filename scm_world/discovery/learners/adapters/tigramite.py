"""PCMCI+ of tigramite, for rows in their order of time.

Source:
    Runge, *Discovering contemporaneous and lagged causal relations in autocorrelated nonlinear time
    series datasets*, UAI 2020.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Dataset
from scm_world.discovery.learners.adapters.borrowed import borrowed
from scm_world.discovery.learners.adapters.settings import Settings, chosen, count, level
from scm_world.discovery.learners.adapters.table import prepare
from scm_world.discovery.learners.found import Found
from scm_world.errors import ModelError

PCMCI_PLUS: Settings = {"alpha": level(0.01), "tau_max": count(1, least=1)}

STILL = 1e-12
"""A standardised column that moves less than this within each episode does not change there."""

Bools = NDArray[np.bool_]


def pcmci_plus(data: Dataset, *, seed: int = 0, **settings: Any) -> Found:
    """Find a graph within the instant and over time by tests of partial correlation.

    Columns that never change within an episode are the same at every lag. They act with lag 1 on
    those that do, which do not act on them.

    Args:
        data: Rows of episodes in time; those in which something is done are left out, and what
            comes after begins anew.
        seed: Of nothing: it draws nothing.
        settings: ``alpha``, level of the tests; ``tau_max``, the longest lag in control steps.

    Raises:
        ModelError: Too few rows follow one another.
    """
    used = chosen("pcmci+", PCMCI_PLUS, settings)
    table = prepare("pcmci+", data)
    tau = used["tau_max"]
    parts = [part for part in runs(table.data) if len(part) > 2 * tau]
    if len(table.kept) == 0:
        return table.found(np.zeros((tau + 1, 0, 0), bool), np.zeros((tau + 1, 0, 0)), **used)
    whole = sum(len(part) - 2 * tau for part in parts)
    if whole <= len(table.kept) * (tau + 1):
        needed = f"more than {len(table.kept) * (tau + 1)} rows with {2 * tau} rows before them"
        raise ModelError([f"'pcmci+' needs {needed}, for as many columns and lags; got {whole}"])
    with borrowed("pcmci+", seed):
        result = _search(parts, used["alpha"], tau)
    edges = edges_of(result["graph"])
    sure = -np.log10(np.clip(np.moveaxis(result["p_matrix"], 2, 0), 1e-300, 1.0))
    sure[0] = np.where(edges[0].T & ~edges[0], 0.0, sure[0])
    contrary = int(np.sum(result["graph"] == "x-x")) // 2
    note = f"{contrary} edges have no direction, since tests contradict each other"
    return table.found(edges, sure, note if contrary else "", **used)


def _search(parts: list[Floats], alpha: float, tau_max: int) -> dict[str, NDArray[Any]]:
    frames = import_module("tigramite.data_processing")
    tests = import_module("tigramite.independence_tests.parcorr")
    several = len(parts) > 1
    frame = frames.DataFrame(
        dict(enumerate(parts)) if several else parts[0],
        analysis_mode="multiple" if several else "single",
    )
    search = import_module("tigramite.pcmci").PCMCI(frame, tests.ParCorr(), verbosity=0)
    still = np.all([np.ptp(part, axis=0) < STILL for part in parts], axis=0)
    result: dict[str, NDArray[Any]] = search.run_pcmciplus(
        link_assumptions=assumed(still, tau_max), tau_max=tau_max, pc_alpha=alpha
    )
    return result


def runs(data: Dataset) -> list[Floats]:
    """Cut rows where they do not follow one another; parts have shape (n, p)."""
    follows = (np.diff(data.episode) == 0) & (np.diff(data.step) == 1)
    return np.split(data.values, np.flatnonzero(~follows) + 1)


def assumed(still: Bools, tau_max: int) -> dict[int, dict[tuple[int, int], str]]:
    """Say which links may be, in the words of tigramite.

    Args:
        still: Which columns do not change within an episode, shape (p,).
        tau_max: The longest lag.

    Returns:
        For each effect, by cause and lag (negative): ``"o?o"`` for an edge that may be, in any
        direction, ``"-?>"`` for one towards the effect.
    """
    links: dict[int, dict[tuple[int, int], str]] = {}
    for j, j_still in enumerate(still):
        links[j] = {(i, 0): "o?o" for i in np.flatnonzero(still == j_still).tolist() if i != j}
        for i, i_still in enumerate(still):
            longest = 0 if j_still else 1 if i_still else tau_max
            links[j].update({(i, -lag): "-?>" for lag in range(1, longest + 1)})
    return links


def edges_of(graph: Any) -> Bools:
    """Read the words of tigramite.

    Args:
        graph: Shape (p, p, lags + 1): ``"-->"`` at [i, j, lag] if i acts on j, ``"<--"`` if j acts
            on i; ``"o-o"`` and ``"x-x"`` have no direction, and neither has ``"<->"``.

    Returns:
        Shape (lags + 1, p, p): where i may act on j.

    Example:
        >>> edges_of(np.array([[["", ""], ["x-x", "-->"]], [["x-x", ""], ["", ""]]])).tolist()
        [[[False, True], [True, False]], [[False, True], [False, False]]]
    """
    words = np.moveaxis(np.array(graph, dtype=str), 2, 0)
    edges: Bools = (words != "") & (~np.char.startswith(words, "<") | (words == "<->"))
    return edges
