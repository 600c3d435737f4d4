"""Whether rows stand in the order that a table promises."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


def disorder(episode: Ints, step: Ints) -> list[str]:
    """Say where rows of one episode do not stand together, with rising steps.

    Example:
        >>> disorder(np.array([4, 4, 7]), np.array([0, 1, 0]))
        []
        >>> disorder(np.array([4, 4, 7]), np.array([1, 0, 0]))[0]
        'the rows of episode 4 do not stand together in time: sort the rows by episode and step'
    """
    starts = np.flatnonzero(np.diff(episode, prepend=episode[:1] - 1))
    _, begun = np.unique(episode[starts], return_index=True)
    again = np.delete(starts, begun)
    back = np.flatnonzero((np.diff(episode) == 0) & (np.diff(step) <= 0)) + 1
    if not again.size and not back.size:
        return []
    pairs, times = np.unique(np.stack([episode, step]), axis=1, return_counts=True)
    if times.max() > 1:
        number, instant = pairs[:, times.argmax()]
        return [
            f"two rows are step {instant} of episode {number}: if two tables have the same episode "
            "numbers, give one of them others; if not, give each row of an episode its own step"
        ]
    number = episode[min([*again, *back])]
    return [
        f"the rows of episode {number} do not stand together in time: sort the rows by episode "
        "and step"
    ]
