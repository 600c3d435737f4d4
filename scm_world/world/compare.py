"""Telling quickly whether two values are the same."""

from __future__ import annotations

from scm_world._types import Value


def same(a: Value, b: Value) -> bool:
    """Tell whether two arrays of one shape hold the same numbers."""
    return a is b or bool((a == b).all())
