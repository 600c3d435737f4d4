"""Interventions put over one another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scm_world.graph import SCM


def merged(model: SCM, *requests: Mapping[str, Any]) -> dict[str, Any]:
    """Put interventions over one another; the last one that sets a quantity counts.

    Args:
        model: Knows which names are coordinates of one quantity, and which are bundles.
        requests: With dotted names.
    """
    merged_acts: dict[str, Any] = {}
    for acts in requests:
        mine = {target for name in acts for target in _targets(model, name)}
        kept = {n: a for n, a in merged_acts.items() if not mine.issuperset(_targets(model, n))}
        merged_acts = {**kept, **acts}
    return merged_acts


def _targets(model: SCM, name: str) -> tuple[str, ...]:
    return model.targets(name) if name in model else (name,)
