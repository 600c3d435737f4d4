"""What ``discover`` has found so far, in a file, so that it can be gone on with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, final

from scm_world.errors import DAMAGED, UnreadableFile
from scm_world.output.durable import made, removed, write_durably
from scm_world.output.locations import Location, located
from scm_world.output.reading import read_text
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.paired import Paired

FORMAT = "scm_world/discovery-progress/2"
ADVICE = "delete it to begin anew, or give another folder"


@final
class Checkpoint:
    """A file that is written after each probe state, whole or not at all.

    Args:
        path: Of the file.
        terms: Everything that decides the result; what is there has to be of the same.
    """

    def __init__(self, path: Location | str, terms: Mapping[str, Any]) -> None:
        self._path = located(path)
        self._terms = json.loads(json.dumps(terms))

    def read(self, paired: Paired) -> int:
        """Go on from what is there; tell how many probe states are finished.

        Raises:
            UnreadableFile: It is damaged, or of another discovery.
        """
        try:
            data = json.loads(read_text(self._path))
            if data["format"] != FORMAT:
                raise ValueError(f"expected the format {FORMAT!r}")
            if data["terms"] != self._terms:
                other = [key for key, value in self._terms.items() if data["terms"][key] != value]
                raise ValueError(f"it is of another discovery: {', '.join(other)} differ")
            effects = Effects(
                largest={(str(c), str(e), int(lag)): float(x) for c, e, lag, x in data["largest"]},
                states={(str(c), str(e), int(lag)): int(n) for c, e, lag, n in data["states"]},
                floor=float(data["floor"]),
                exact=paired.effects.exact,
                undone=set(map(str, data["undone"])),
                rollouts=int(data["rollouts"]),
                refused={str(name): int(n) for name, n in data["refused"].items()},
            )
            paired.remember(effects, data["memory"])
            return int(data["done"])
        except FileNotFoundError:
            return 0
        except DAMAGED as error:
            raise UnreadableFile(str(self._path), str(error), ADVICE) from None

    def write(self, effects: Effects, done: int, paired: Paired) -> None:
        """Write down what was found in the probe states that are finished."""
        data = {
            "format": FORMAT,
            "terms": self._terms,
            "done": done,
            "largest": [[*key, size] for key, size in effects.largest.items()],
            "states": [[*key, count] for key, count in effects.states.items()],
            "floor": effects.floor,
            "undone": sorted(effects.undone),
            "rollouts": effects.rollouts,
            "refused": effects.refused,
            "memory": paired.memory(),
        }
        made(self._path.parent)
        write_durably(self._path, json.dumps(data).encode())

    def end(self) -> None:
        """Remove the file: there is a result now."""
        removed(self._path)
