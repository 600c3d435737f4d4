"""What a sweep has found: a table with a row for each point of its grid."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.discovery.data.dataset import Column, Dataset, Ints
from scm_world.discovery.data.levels import Point
from scm_world.output.durable import made, write_whole
from scm_world.output.locations import Location
from scm_world.queries.estimates import CONFIDENCE, difference

FORMAT = "scm_world/sweep/1"
TABLE, SUMMARY = "sweep.csv", "sweep.json"
ENDS = ("", ".low", ".high")


@final
@dataclass(frozen=True)
class Swept:
    """Episodes at the points of a grid.

    Attributes:
        points: What was done at each.
        data: All episodes; number k is unit ``k // p`` at point ``k % p`` of p points.
    """

    points: tuple[Point, ...]
    data: Dataset

    @cached_property
    def measured(self) -> tuple[Column, ...]:
        """What was measured: all columns but those that were set."""
        return tuple(c for c in self.data.columns if c.variable not in self.points[0])

    def values(self, point: int, name: str) -> Floats:
        """Give what was measured at a point, one number for each unit that was not refused."""
        return np.asarray(self.data[name][self._rows(point)])

    def units(self, point: int) -> Ints:
        """Give the numbers of these units."""
        return np.asarray(self.data.episode[self._rows(point)] // len(self.points))

    def _rows(self, point: int) -> Ints:
        return np.flatnonzero(self.data.episode % len(self.points) == point)

    def rows(self) -> list[dict[str, Any]]:
        """Write the table down: a row for each point, in which None is what nobody knows.

        Its columns are the values that were set (``name``, or ``name[i]`` of a vector), ``n``, the
        number of ``refused`` episodes, and for each number that was measured its mean with the
        ends of a 95 % interval (``name``, ``name.low``, ``name.high``), and its mean difference
        to the first point in the units that both have (``name.change`` with its ends).
        """
        refused = self.data.about.get("refused", {})
        lost = np.array([int(number) % len(self.points) for number in refused], dtype=np.int64)
        return [
            {
                **_flat(point),
                "n": len(self._rows(place)),
                "refused": int((lost == place).sum()),
                **self._means(place),
            }
            for place, point in enumerate(self.points)
        ]

    def _means(self, place: int) -> dict[str, float | None]:
        found: dict[str, float | None] = {}
        mine, first = self.units(place), self.units(0)
        _, here, there = np.intersect1d(mine, first, assume_unique=True, return_indices=True)
        for column in self.measured:
            values, base = (self.values(at, column.name) for at in (place, 0))
            found |= _mean(column.name, values, np.zeros_like(values))
            found |= _mean(f"{column.name}.change", values[here], base[there])
        return found

    def save(self, folder: Location) -> tuple[Location, Location]:
        """Write the table as CSV, and with where it comes from as JSON.

        Raises:
            UnwritableFolder: There is no room, or no permission.
        """
        made(folder)
        rows = self.rows()
        stream = io.StringIO(newline="")
        writer = csv.DictWriter(stream, [*rows[0]], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_whole(stream.getvalue(), folder / TABLE)
        data = {
            "format": FORMAT,
            "confidence": CONFIDENCE,
            "units": {c.name: c.unit for c in self.measured},
            "points": [dict(point) for point in self.points],
            "rows": rows,
            "about": self.data.about,
        }
        write_whole(json.dumps(data, indent=1, allow_nan=False) + "\n", folder / SUMMARY)
        return folder / TABLE, folder / SUMMARY


def _flat(point: Point) -> dict[str, float]:
    """Write values down, the components of vectors apart.

    Example:
        >>> _flat({"x": 1.0, "g": [0.0, -9.81]})
        {'x': 1.0, 'g[0]': 0.0, 'g[1]': -9.81}
    """
    return {
        f"{name}[{i}]" if isinstance(value, Sequence) else name: part
        for name, value in point.items()
        for i, part in enumerate(np.ravel(value).tolist())
    }


def _mean(name: str, values: Floats, base: Floats) -> dict[str, float | None]:
    """Estimate the mean difference of paired numbers; one number alone has no interval."""
    found: list[float | None] = [None, None, None]
    if len(values) > 1:
        found = [float(end) for end in difference(values, base, paired=True)[:3]]
    elif len(values):
        found[0] = float(values[0] - base[0])
    return {name + end: value for end, value in zip(ENDS, found, strict=True)}
