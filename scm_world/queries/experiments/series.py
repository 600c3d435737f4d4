"""Experiments in one probe state after another."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, final

from scm_world.errors import UnknownOption
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.models import PairedEquations
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.progress import Progress


@final
class Series:
    """Experiments that may be interrupted (Ctrl-C) or end early.

    Args:
        paired: Does the experiments.
        planned: How many probe states there are.
        progress: Is told how far it is.
        done: How many of them were finished before.

    Attributes:
        effects: What was seen in the probe states that are finished.
        done: How many these are.
    """

    def __init__(
        self,
        paired: Paired | PairedEquations,
        planned: int,
        progress: Progress | None = None,
        *,
        done: int = 0,
    ) -> None:
        self._paired, self.planned, self._progress = paired, planned, progress
        self.effects, self.done = paired.effects, done

    def run(
        self, probes: Iterable[Any], enough: Callable[[Effects, int], bool] | None = None
    ) -> None:
        """Do all experiments.

        Args:
            probes: The probe states.
            enough: Is shown effects and how many probe states are finished after each of them;
                ends the series by returning True.

        Raises:
            KeyboardInterrupt: It was interrupted before the first probe state was finished.
        """
        try:
            for number, probe in enumerate(probes, self.done):
                self._paired.run(number, probe)
                self.done, self.effects = number + 1, self._paired.effects.copy()
                last = enough is not None and enough(self.effects, self.done)
                if self._progress is not None:
                    self._progress(self.done, self.done if last else self.planned)
                if last:
                    return
        except KeyboardInterrupt:
            if self.done == 0:
                raise


def checked_count(what: str, number: int) -> int:
    """Accept a positive whole number.

    Raises:
        UnknownOption: It is none.
    """
    if not isinstance(number, int) or number < 1:
        raise UnknownOption(what, number, ("any whole number from 1 on",))
    return number
