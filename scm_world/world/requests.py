"""Interventions put over one another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scm_world.world.declaration import Declaration


def merged(declaration: Declaration, *requests: Mapping[str, Any]) -> dict[str, Any]:
    """Put interventions over one another; the last one that sets a quantity counts.

    Args:
        declaration: Knows which names are coordinates of one quantity.
        requests: With dotted names.
    """
    merged_acts: dict[str, Any] = {}
    for acts in requests:
        mine = {_target(declaration, name) for name in acts}
        kept = {n: act for n, act in merged_acts.items() if _target(declaration, n) not in mine}
        merged_acts = {**kept, **acts}
    return merged_acts


def _target(declaration: Declaration, name: str) -> str:
    return declaration.model.target(name) if name in declaration.model else name
