"""The learning curve of a training, in a table that grows while it runs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import final

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output.durable import write_whole

COLUMNS = (
    "steps",
    "wall_s",
    "cpu_s",
    "episodes",
    "return",
    "success",
    "last_fractional_success",
    "learning_rate",
    "kl",
    "std",
)
"""Control steps and seconds so far; episodes that ended since the row before, and their means; and
what the last update said."""


@final
class Curve:
    """Writes the learning curve.

    Args:
        path: Of the file; rows of it after ``steps`` are forgotten.
        steps: With how many control steps the training goes on.

    Raises:
        UnreadableFile: What is there is no learning curve.
        UnwritableFolder: There is no room, or no permission.
    """

    def __init__(self, path: Path, steps: int = 0) -> None:
        self._path = path
        rows = [row for row in read_curve(path) if row["steps"] <= steps] if path.exists() else []
        lines = [",".join(COLUMNS), *(_line(row) for row in rows)]
        write_whole("\n".join(lines) + "\n", path)

    def add(self, row: Mapping[str, float]) -> None:
        """Add a row; what is not there stays empty."""
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(_line(row) + "\n")
        except OSError as error:
            reason = error.strerror or str(error)
            raise UnwritableFolder(str(self._path.parent), reason) from None


def read_curve(path: Path) -> list[dict[str, float]]:
    """Read a learning curve; a last line that is not whole is left out.

    Raises:
        UnreadableFile: It is something else.
    """
    advice = "give the file progress.csv of a training"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UnreadableFile(str(path), str(error), advice) from None
    whole = text[: text.rfind("\n") + 1]
    table = csv.DictReader(io.StringIO(whole))
    if tuple(table.fieldnames or ()) != COLUMNS:
        raise UnreadableFile(str(path), f"its columns are {table.fieldnames}", advice)
    try:
        return [{name: float(row[name] or "nan") for name in COLUMNS} for row in table]
    except (TypeError, ValueError) as error:
        raise UnreadableFile(str(path), str(error), advice) from None


def _line(row: Mapping[str, float]) -> str:
    """Write a row.

    Example:
        >>> _line({"steps": 4096, "wall_s": 1.25, "kl": 0.0123456})
        '4096,1.25,,,,,,,0.0123456,'
    """
    return ",".join(_word(row.get(name, math.nan)) for name in COLUMNS)


def _word(number: float) -> str:
    if math.isnan(number):
        return ""
    return str(int(number)) if number == int(number) and abs(number) < 1e15 else f"{number:.6g}"
