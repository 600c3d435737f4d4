"""Protocols as data: tables of settings."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.graph import SCM
from scm_world.output.reading import read_text

_COMPONENT = re.compile(r"(.+)\[(\d+)\]")

Row = tuple[dict[str, Any], int]
"""What is done, and in how many episodes."""


def read_protocol(protocol: Path | str | Iterable[Mapping[str, Any]], model: SCM) -> list[Row]:
    """Read a table of settings.

    Args:
        protocol: A CSV file, or rows. Columns are variables, or components ``name[i]`` of them
            (all of them then), and ``n``, the number of episodes, which is 1 without it.
        model: Knows the shapes of the variables.

    Raises:
        UnreadableFile: There is no such table.
        UnknownOption: A cell is no number, or a component is missing.
        UnknownVariable: A column is no variable.
    """
    if isinstance(protocol, str | Path):
        try:
            text = read_text(protocol, "utf-8-sig")
            rows: list[Mapping[str, Any]] = list(csv.DictReader(io.StringIO(text, newline="")))
        except (OSError, csv.Error, UnicodeDecodeError) as error:
            advice = "give a CSV file whose first line names variables"
            raise UnreadableFile(str(protocol), str(error), advice) from None
    else:
        rows = list(protocol) if isinstance(protocol, Iterable) else [protocol]
    for number, row in enumerate(rows):
        if not isinstance(row, Mapping) or not all(isinstance(column, str) for column in row):
            allowed = ("a dictionary of variables and numbers", "as many cells as columns")
            raise UnknownOption(f"row {number}", row, allowed)
    return [_row(dict(row), model, number) for number, row in enumerate(rows)]


def _row(cells: dict[str, Any], model: SCM, number: int) -> Row:
    n = cells.pop("n", None)
    n = 1 if n in (None, "") else n
    try:
        count = int(n) if float(n) == int(n) else 0
    except (TypeError, ValueError, OverflowError):
        count = 0
    if count < 1:
        raise UnknownOption(f"n of row {number}", n, ("a whole number from 1 on",))
    whole: dict[str, Any] = {}
    parts: dict[str, dict[int, float]] = {}
    for column, cell in cells.items():
        if cell is None or (isinstance(cell, str) and not cell.strip()):
            continue
        match = _COMPONENT.fullmatch(column)
        value = _number(cell, f"{column} of row {number}")
        if match is None:
            model.declared(column)
            whole[column] = value
        else:
            model.declared(match[1])
            parts.setdefault(match[1], {})[int(match[2])] = value
    for name, found in parts.items():
        size = int(np.prod(model.declared(name).shape))
        if sorted(found) != list(range(size)):
            raise UnknownOption(
                f"columns of {name}", sorted(found), (f"all of {name}[0…{size - 1}]",)
            )
        whole[name] = [found[i] for i in range(size)]
    return whole, count


def _number(cell: Any, where: str) -> Any:
    if not isinstance(cell, str):
        return cell
    try:
        return float(cell)
    except ValueError:
        raise UnknownOption(where, cell, ("a number", "nothing")) from None
