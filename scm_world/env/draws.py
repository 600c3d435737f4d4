"""Values that environments draw at their resets, judged by the values after many of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.env.answers import Answer, missing, numbers
from scm_world.world.simulation import READ_BACK

DRIFT = 0.5  # correlation of values of consecutive resets from which on they depend on one another
SIGMAS = 5.0  # standard deviations of the correlation of independent draws that are chance
OFTEN = 50  # an end is cut off to if one in so many values is the same
FEW = 3  # repeated values that are chance
CHANCE = 1e-9  # uniform draws keep to so small a part of their range less often than this


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
    room = READ_BACK * np.maximum(np.abs(low), np.abs(high))  # also of 32-bit floats
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
    elif found["applied"].status == "passed" and draws:
        shares, size = np.ptp(values, axis=(0, 1)) / (high - low), values[..., 0].size
        narrow = np.isfinite(high - low) & (shares < 0.5) & (size * shares ** (size - 1) < CHANCE)
        for c in np.flatnonzero(narrow).tolist()[:1]:
            said = f"values keep to {shares[c]:.0%} of the range; they go from "
            said += f"{numbers(values[..., c].min())} to {numbers(values[..., c].max())}"
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
    said = _alike(values) or _skipped(values)
    if said:
        return Answer(status="fault", said=said)
    share = (np.ptp(values, axis=(0, 1)) / (high - low)).min()
    said = f"{min(1.0, share):.0%} of the range was seen" + _often(values)
    return Answer(status="passed", said=said * draws)


def _kinds(values: Floats) -> NDArray[np.int_]:
    """Return how many different values each number of each world has, shape (n, k)."""
    found: NDArray[np.int_] = (np.diff(np.sort(values, axis=0), axis=0) != 0.0).sum(axis=0) + 1
    return found


def _alike(values: Floats) -> str:
    """Return which world keeps its value, or has those of another, where others draw; or none.

    Only beside values that all differ, so that it is no chance.
    """
    kinds = _kinds(values)
    new = kinds == len(values)
    for world, c in np.argwhere((kinds == 1) & new.any(axis=0)).tolist()[:1]:
        return f"it is {numbers(values[0, world, c])} after each reset in world {world}"
    for c in range(values.shape[2]):
        first: dict[bytes, int] = {}
        for world in np.flatnonzero(new[:, c]).tolist():
            other = first.setdefault(values[:, world, c].tobytes(), world)
            if other != world:
                return f"worlds {other} and {world} have the same value after each reset"
    return ""


def _skipped(values: Floats) -> str:
    """Return at how many resets nothing is drawn, where each other one gives a new value."""
    kinds = _kinds(values)
    kept = (values[1:] == values[:-1]).sum(axis=0)
    for world, c in np.argwhere((kept + kinds == len(values)) & (kept > FEW) & (kinds > FEW))[:1]:
        return f"nothing is drawn at {kept[world, c]} of {len(values) - 1} resets in world {world}"
    return ""


def _often(values: Floats) -> str:
    """Return which value a world has at many resets, where each other one differs; or none."""
    one, counts = np.unique(values[:, 0, 0], return_counts=True)
    if counts.max() <= FEW or len(one) <= FEW or len(one) + counts.max() != len(values) + 1:
        return ""
    said = f"{counts.max()} of {len(values)} resets in world 0"
    return f"; it is {numbers(one[counts.argmax()])} after {said}"


def _is_cut(values: Floats) -> bool:
    """Return whether an end of the values, and no value inside, occurs again and again."""
    kinds, counts = np.unique(values, return_counts=True)
    often = max(counts[0], counts[-1]) >= max(3, values.size // OFTEN)
    return len(kinds) > FEW and bool(often and (counts[1:-1] == 1).all())


def _link(values: Floats) -> float:
    """Return the rank correlation of the values of consecutive resets, shape (resets, n)."""
    ranks = np.stack([np.unique(one, return_inverse=True)[1] for one in values.T], axis=1)
    ranks = ranks - ranks.mean(axis=0)
    return float((ranks[1:] * ranks[:-1]).sum() / ((ranks**2).sum() or 1.0))
