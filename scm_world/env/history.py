"""The last observations and actions, as a part of what is observed."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, Self, final

import gymnasium
import numpy as np

from scm_world._types import Floats, Integers, Observation
from scm_world.env.vector import box
from scm_world.policies.cards import HISTORY


@final
class History:
    """The present observation and the last k pairs of observation and action of n environments.

    A pair has the observation of an instant and the action that was taken there. The newest is
    first, and the numbers of steps that have not been are 0.

    Args:
        present: The space of an observation.
        layout: Where each variable stands in it.
        ends: The least and the greatest number of each part of an action.
        steps: How many pairs.
        stacked: Whether pairs are observed beside the present observation, shape (k, n).

    Attributes:
        rows: A row for each environment, at first for one, 32-bit floats: the present observation
            and its pairs. It is an array, or a tensor of torch.
        size: How many numbers an observation has.
        spaces: Of what is observed, by name.
        layout: Where each variable stands, if not stacked also in each pair.
    """

    def __init__(
        self,
        present: Any,
        layout: Mapping[str, slice],
        ends: tuple[Floats, Floats],
        steps: int,
        *,
        stacked: bool,
    ) -> None:
        pair = [np.concatenate(one) for one in zip((present.low, present.high), ends, strict=True)]
        low, high = np.minimum(pair[0], 0.0), np.maximum(pair[1], 0.0)
        self.size, self._width, self._stacked = present.low.size, low.size, stacked
        self.rows: Any = np.zeros((1, self.size + steps * low.size), np.float32)
        self.spaces: dict[str, gymnasium.Space[Any]] = {"observation": present}
        self.layout = dict(layout)
        if stacked:
            self.spaces[HISTORY] = box(np.tile(low, (steps, 1)), np.tile(high, (steps, 1)))
            return
        least, most = [present.low, *[low] * steps], [present.high, *[high] * steps]
        self.spaces["observation"] = box(np.concatenate(least), np.concatenate(most))
        names = {**layout, "agent.action": slice(self.size, low.size)}
        for lag in range(steps):
            at = self.size + lag * low.size
            places = {n: slice(at + one.start, at + one.stop) for n, one in names.items()}
            self.layout |= {f"{name}@-{lag + 1}": place for name, place in places.items()}

    def on(self, rows: Any) -> Self:
        """Return the same on other rows, which are not copied."""
        other = copy.copy(self)
        other.rows = rows
        return other

    def push(self, which: Any, actions: Any) -> None:
        """Add the present observations and the actions taken there, shape (m, n_actions).

        Args:
            which: Numbers of the environments, shape (m,), an array of the kind of the rows.
            actions: As the agents gave them, in the space of the actions.
        """
        rows, size, width = self.rows, self.size, self._width
        rows[which, size + width :] = rows[which, size : rows.shape[1] - width]
        rows[which, size : 2 * size] = rows[which, :size]
        rows[which, 2 * size : size + width] = actions

    def observe(self, present: Observation, which: int | Integers) -> Observation:
        """Keep the present observation of one environment or several, and return it with the past.

        Args:
            present: Without the past: a vector, or its parts by name.
            which: The number of the environment, or those of several, shape (m,).
        """
        parts = dict(present) if isinstance(present, Mapping) else {"observation": present}
        self.rows[which, : self.size] = parts["observation"]
        whole = self.rows.take(which, axis=0)
        if not self._stacked:
            return {**parts, "observation": whole} if isinstance(present, Mapping) else whole
        past = whole[..., self.size :].reshape(*whole.shape[:-1], -1, self._width)
        return {**parts, HISTORY: past}
