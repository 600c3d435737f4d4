"""What ``scm_world.check`` asks of many environments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal

import numpy as np

from scm_world._types import ArrayLike, Floats, Mask
from scm_world.errors import UnknownOption

UNBOUNDED = 1e3  # an action without a bound goes so far


class Checkable(ABC):
    """Many environments that ``check`` can ask. A subclass writes four methods, or five.

    Parameters are read, episodes begin in some worlds, all worlds are stepped and observed; with
    ``set``, parameters are written. Masks have shape (n,), bool. All other methods say more about
    the worlds; a question that needs what is not said is not asked.

    Attributes:
        num_envs: Number of worlds n.
        n_actions: Number of actions.
        by: ``"set"`` if values are set from outside, ``"reset"`` if the environments draw them at
            their resets; ``check(by=…)`` decides. Without ``set`` it is ``"reset"``.
        draws: Whether a reset draws values. Else each world has its own from the beginning.
        steps: Whether time passes in them.
        follows: Whether constants are derived from a value that is set; ``check`` says so.
        title: What they are, in words; the name of the class if empty.
    """

    num_envs: int
    n_actions: int
    by: Literal["set", "reset"] = "set"
    draws: bool = True
    steps: bool = True
    follows: bool = False
    title: str = ""

    @abstractmethod
    def get(self, name: str) -> ArrayLike:
        """Read a parameter in the engine of each world, shape (n, …)."""

    def set(self, name: str, values: Floats, mask: Mask) -> None:
        """Write a parameter in the worlds of a mask, now; ``values`` has shape (n, …)."""
        raise UnknownOption("by", "set", (f"'reset': {type(self).__name__} cannot set {name}",))

    @abstractmethod
    def reset(self, seed: int, mask: Mask) -> object:
        """Begin episodes in the worlds of a mask; world i has the seed ``seed + i``."""

    @abstractmethod
    def step(self, actions: Floats) -> ArrayLike | None:
        """Advance all worlds, with actions in [-1, 1], shape (n, n_actions).

        Returns:
            Which of them ended an episode, shape (n,), or None.
        """

    @abstractmethod
    def observe(self) -> ArrayLike:
        """Return the states of all worlds, shape (n, k)."""

    def declared(self, ranges: Mapping[str, Any] | None) -> Mapping[str, Any]:
        """Return declared ranges by the names that ``get`` knows; the usual ones if None."""
        return {} if ranges is None else ranges

    def reference(self, name: str) -> ArrayLike:
        """Return the values without randomisation, shape (n, …)."""
        return self.get(name)

    def values(self, world: int) -> Mapping[str, Any]:
        """Return values of one world that a range may depend on, by name."""
        del world
        return {}

    def target(self, name: str) -> str:
        """Return what is set: coordinates set a pose."""
        return name

    def columns(self) -> list[tuple[str, str]]:
        """Return name and unit of each number of ``observe``."""
        count = np.reshape(self.observe(), (self.num_envs, -1)).shape[1]
        return [(f"observation[{number}]", "") for number in range(count)]

    def unit(self, name: str) -> str:
        """Return the unit of a parameter."""
        del name
        return ""

    def rounding(self) -> ArrayLike:
        """Return differences after one step that are no effects, of all numbers or of each."""
        return 0.0

    def idle(self, name: str, *, ran: bool) -> str:
        """Return why a parameter has no effect, or nothing.

        Args:
            name: The parameter.
            ran: Whether it was tried, and had none: why none was seen.
        """
        del name, ran
        return ""

    def stale(self, name: str) -> Mapping[str, float] | None:
        """Return derived constants that are not those of a fresh compilation of a value.

        Returns:
            The relative difference of each by name; None if nothing can be compiled.
        """
        del name
        return None

    def refresh(self) -> Callable[[], object] | None:
        """Derive all constants anew; return what undoes this, or None if that is not possible."""
        return None

    def keep(self, names: Collection[str]) -> Callable[[], object]:
        """Return what writes the present values of parameters again, whatever a reset draws."""
        if type(self).set is Checkable.set:
            return int
        kept = {name: np.array(self.get(name)) for name in names}

        def back() -> None:
            for name, values in kept.items():
                self.set(name, values, np.ones(self.num_envs, dtype=bool))

        return back

    def outdated(self) -> Floats | None:
        """Return by how much observations differ from those computed anew, shape (n,), or None."""
        return None

    def remark(self, name: str) -> str:
        """Return what a user may not expect of a range, or nothing."""
        del name
        return ""


def commands(actions: Floats, low: Floats, high: Floats) -> Floats:
    """Return commands from actions in [-1, 1] between two ends, shape (n, n_actions)."""
    low, high = np.maximum(low, -UNBOUNDED), np.minimum(high, UNBOUNDED)
    return np.asarray(low + (actions + 1.0) / 2.0 * (high - low))
