"""Values that environments draw at their resets, judged by what is read after many of them."""

from __future__ import annotations

import numpy as np

from scm_world._types import Floats
from scm_world.env.answers import ROUNDING, Answer, missing, numbers

DRIFT = 0.5  # correlation of values of consecutive resets from which on they depend on one another
SIGMAS = 5.0  # standard deviations of the correlation of independent draws that are chance
OFTEN = 50  # an end is cut off to if one in so many values is the same


def judge(values: Floats, low: Floats, high: Floats, *, draws: bool) -> dict[str, Answer]:
    """Answer the questions that the values themselves answer.

    Args:
        values: After each reset, in each world, shape (resets, n, k).
        low: Lower ends, shape (k,). A number whose ends are equal is not judged.
        high: Upper ends.
        draws: Whether a reset is expected to draw.
    """
    passed, wide = Answer(status="passed"), high > low
    values, low, high = values[..., wide], low[wide], high[wide]
    found = {"applied": _applied(values, low, high, draws=draws), "in range": passed}
    room = ROUNDING * np.maximum(np.abs(low), np.abs(high))
    outside = (values < low - room) | (values > high + room)
    cut = [c for c in range(len(low)) if _is_cut(values[..., c])]
    if outside.any():
        said = f"{outside.mean():.0%} of the values lie outside; they go from "
        said += f"{numbers(values.min())} to {numbers(values.max())}"
        found["in range"] = Answer(status="fault", said=said)
    elif cut:
        ends = values[..., cut[0]]
        said = f"values are cut off at {numbers(ends.min())} and {numbers(ends.max())}"
        found["in range"] = Answer(status="fault", said=said)
    resets, count = (values != values[:1]).any(axis=(0, 1)), len(values)
    found["second reset"] = missing("no value is drawn at a reset")
    if resets.any():
        found["second reset"] = passed
        link = max(_link(values[..., c]) for c in np.flatnonzero(resets).tolist())
        if link > max(DRIFT, SIGMAS / np.sqrt(values[..., 0].size)):
            said = f"each value follows from the last one (correlation {link:.2f}): after {count} "
            said += f"resets {numbers(values[0, 0])} has become {numbers(values[-1, 0])}"
            found["second reset"] = Answer(status="fault", said=said)
    return found


def _applied(values: Floats, low: Floats, high: Floats, *, draws: bool) -> Answer:
    """Answer whether the values vary, over resets and from world to world."""
    resets = (values != values[:1]).any(axis=(0, 1))
    worlds = (values != values[:, :1]).any(axis=(0, 1))
    still = ~(resets | worlds)
    if still.all():
        said = f"it is {numbers(values[0, 0])} after each of {len(values)} resets in every world"
        return Answer(status="fault", said=said)
    if still.any():
        return Answer(status="fault", said=f"{still.sum()} of {still.size} numbers never vary")
    if values.shape[1] > 1 and not worlds.any():
        return Answer(status="fault", said="all worlds have the same value after each reset")
    if draws and not resets.any():
        return Answer(status="passed", said="drawn once, not at a reset")
    share = (np.ptp(values, axis=(0, 1)) / (high - low)).min()
    return Answer(status="passed", said=f"{min(1.0, share):.0%} of the range was seen" * draws)


def _is_cut(values: Floats) -> bool:
    """Return whether an end of the values, and no value inside, occurs again and again."""
    kinds, counts = np.unique(values, return_counts=True)
    often = max(counts[0], counts[-1]) >= max(3, values.size // OFTEN)
    return len(kinds) > 3 and bool(often and (counts[1:-1] == 1).all())


def _link(values: Floats) -> float:
    """Return the rank correlation of the values of consecutive resets, shape (resets, n)."""
    ranks = np.stack([np.unique(one, return_inverse=True)[1] for one in values.T], axis=1)
    ranks = ranks - ranks.mean(axis=0)
    return float((ranks[1:] * ranks[:-1]).sum() / ((ranks**2).sum() or 1.0))
