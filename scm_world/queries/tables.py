"""Protocols as data: tables of settings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from scm_world.errors import UnknownOption
from scm_world.graph import SCM

_COMPONENT = re.compile(r"(.+)\[(\d+)\]")

Row = tuple[dict[str, Any], int]
"""The intervention, and in how many episodes."""


def read_protocol(protocol: Iterable[Mapping[str, Any]], model: SCM) -> list[Row]:
    """Read a table of settings.

    Its columns are variables, or components ``name[i]`` of them (all of them then), and ``n``, the
    number of episodes, which is 1 without it.
    """
    rows = list(protocol) if isinstance(protocol, Iterable) else [protocol]
    for number, row in enumerate(rows):
        if not isinstance(row, Mapping) or not all(isinstance(column, str) for column in row):
            allowed = ("a dictionary of variables and numbers", "as many cells as columns")
            raise UnknownOption(f"row {number}", row, allowed)
    return [_row(dict(row), model, number) for number, row in enumerate(rows)]


def _row(cells: dict[str, Any], model: SCM, number: int) -> Row:
    n = cells.pop("n", None)
    count = 1 if n in (None, "") else _number(n, f"n of row {number}")
    if not np.isfinite(count) or count < 1 or count != int(count):
        raise UnknownOption(f"n of row {number}", n, ("a whole number from 1 on",))
    whole: dict[str, Any] = {}
    for column, cell in cells.items():
        if cell is None or (isinstance(cell, str) and not cell.strip()):
            continue
        value = _number(cell, f"{column} of row {number}") if isinstance(cell, str) else cell
        match = _COMPONENT.fullmatch(column)
        variable = model.declared(column if match is None else match[1])
        if match is None:
            whole[column] = value
            continue
        size, place = int(np.prod(variable.shape)), int(match[2])
        if place >= size:
            raise UnknownOption(f"column of row {number}", column, (f"0 to {size - 1}",))
        whole.setdefault(variable.name, [None] * size)[place] = value
    for name, value in whole.items():
        if isinstance(value, list) and None in value:
            allowed = (f"all of {name}[0…{len(value) - 1}]",)
            raise UnknownOption(f"columns of {name}", value, allowed)
    return whole, int(count)


def _number(cell: Any, where: str) -> float:
    try:
        return float(cell)
    except (TypeError, ValueError):
        raise UnknownOption(where, cell, ("a number", "nothing")) from None
