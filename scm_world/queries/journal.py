"""The log of a laboratory: a line of JSON for each experiment that has ended."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world.errors import ModelError, UnreadableFile
from scm_world.queries.plans import Plan
from scm_world.queries.samples import Samples

FORMAT = "scm_world/laboratory/1"


@final
@dataclass(frozen=True)
class Record:
    """One experiment.

    Attributes:
        kind: ``"see"``, ``"do"`` or ``"counterfactual"``, after ``"refused "`` where it failed.
        samples: What was done, to which units, and what came out.
        at: From which control step a counterfactual differs.
        row: Of a protocol, if it belongs to one.
    """

    kind: str
    samples: Samples
    at: int = 0
    row: int | None = None

    @property
    def episodes(self) -> int:
        """How many episodes it cost."""
        return len(self.samples.numbers)


@final
class Journal:
    """Remembers experiments, in a file if there is one.

    Args:
        path: Of the file; what is in it is read.
        terms: What has to be the same in the file.
        trusted: Packages whose functions may be mechanisms of its plans.

    Raises:
        UnreadableFile: The file is no log, or one on other terms.
    """

    def __init__(
        self, path: Path | str | None, terms: dict[str, Any], trusted: Sequence[str] = ()
    ) -> None:
        self._path = None if path is None else Path(path)
        self._trusted = tuple(trusted)
        self._size = 0
        self.records: list[Record] = []
        head = json.loads(json.dumps({"format": FORMAT, **terms}))
        if self._path is None:
            return
        if self._path.exists() and self._path.stat().st_size:
            self._read(head)
        else:
            self._append(head)

    @property
    def next_unit(self) -> int:
        """Number of the first episode that was not lived yet."""
        return sum(r.episodes for r in self.records if not r.kind.endswith("counterfactual"))

    @property
    def is_written(self) -> bool:
        """Whether there is a file."""
        return self._path is not None

    def write(self, kind: str, samples: Samples, *, at: int = 0, row: int | None = None) -> None:
        """Add an experiment; it is on the disk when this returns."""
        record = Record(kind, samples, at, row)
        if self._path is not None:
            self._append(
                {
                    "kind": kind,
                    "at": at,
                    "row": row,
                    "units": list(samples.numbers),
                    "seed": samples.seed,
                    "plan": samples.plan.as_dict(),
                    "values": {name: values.tolist() for name, values in samples.items()},
                }
            )
        self.records.append(record)

    def refuse_others(self) -> None:
        """Refuse to go on if another laboratory has written to the file.

        Raises:
            UnreadableFile: The file is not as it was left.
        """
        if self._path is None:
            return
        size = self._path.stat().st_size if self._path.exists() else 0
        if size != self._size:
            reason = "another laboratory has written to it"
            raise UnreadableFile(str(self._path), reason, "open it again to go on with all of it")

    def _append(self, line: dict[str, Any]) -> None:
        if self._path is None:
            return
        self.refuse_others()
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line, allow_nan=False) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        self._size = self._path.stat().st_size

    def _read(self, head: dict[str, Any]) -> None:
        path = self._path
        if path is None:
            return
        text = path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        try:
            first, *lines = (json.loads(line) for line in whole.splitlines())
            if first != head:
                other = [key for key in head if first.get(key) != head[key]]
                reason = f"it is the log of other experiments: {', '.join(other)} differ"
                raise UnreadableFile(str(path), reason, "give the laboratory another log")
            self.records = [_record(line, self._trusted) for line in lines]
        except (ValueError, KeyError, TypeError, AttributeError, ModelError) as error:
            if isinstance(error, UnreadableFile):
                raise
            advice = "give the laboratory another log"
            raise UnreadableFile(str(path), f"it is no log: {error}", advice) from None
        if whole != text:  # the process was killed while it wrote
            path.write_text(whole, encoding="utf-8")
        self._size = path.stat().st_size


def _record(line: dict[str, Any], trusted: Sequence[str]) -> Record:
    columns = {name: np.array(values, dtype=float) for name, values in line["values"].items()}
    plan = Plan.from_dict(line["plan"], trusted=trusted)
    samples = Samples(columns, tuple(line["units"]), line["seed"], plan)
    return Record(line["kind"], samples, line["at"], line["row"])
