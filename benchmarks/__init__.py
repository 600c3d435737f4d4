"""Scripts that measure the package; see docs/benchmarks."""

from __future__ import annotations

import json
from typing import Any


def as_json(document: Any, depth: int = 3) -> str:
    """Return results as JSON with a row of each table on one line.

    Args:
        document: Plain data: dicts of results, and lists of rows.
        depth: How many levels of dicts have lines of their own.
    """
    if isinstance(document, dict) and document and depth:
        parts = (
            f"{json.dumps(str(name))}: {as_json(value, depth - 1)}"
            for name, value in document.items()
        )
        return "{\n" + ",\n".join(parts) + "\n}"
    if isinstance(document, list) and any(isinstance(row, dict) for row in document):
        return "[\n" + ",\n".join(map(_row, document)) + "\n]"
    return _row(document)


def _row(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, default=str)
