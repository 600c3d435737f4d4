"""What the predecessor published, and terms evaluated outside a world."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world.graph import SCM

_HEAD = [
    *[1.0, *[0.22179, 0.433501, -0.261799] * 3, *[0.0] * 9],
    *[-0.1189, 0.317274, -0.776549, 0.334217, -0.055666, -0.776549],
    *[-0.215317, -0.261608, -0.776549],
]


def _box(kind: float, x: float, y: float, z: float) -> list[float]:
    return [kind, 0.0, 0.0, 0.0, x, y, z, 0.0, 0.0, 0.0, 0.1]


def _tool(x: float, y: float) -> list[float]:
    return [*_box(1.0, x, y, -0.87), *[0.0] * 6]


OBSERVATIONS = {
    "picking": [*_HEAD, *_tool(0.0, 0.0), *_box(20.0, 0.0, 0.0, -0.4)],
    "pick_and_place": [
        *[*_HEAD, *_tool(0.0, -0.18), *_box(20.0, 0.0, 0.18, -0.87)],
        *[10.0, 12.428571, -1.428571, 0.0, 0.0, 0.0, -0.87, 0.0, 0.0, 0.0, 0.1],
    ],
    "stacking2": [
        *[*_HEAD, *_tool(0.0, 0.0), *_tool(0.02, 0.16)],
        *[*_box(20.0, -0.12, -0.12, -0.87), *_box(20.0, -0.12, -0.12, -0.61)],
    ],
}
"""Normalised observations at reset (CausalWorld 1.2)."""

Instant = dict[str, Any]


def instants(model: SCM, term: str, seed: int, spread: float = 0.1) -> tuple[Instant, Instant]:
    """Draw the causes of a term: their values now and one control step ago."""
    random = np.random.default_rng(seed)
    both: tuple[Instant, Instant] = ({}, {})
    for parent in sorted({parent.name for parent in model[term].all_parents}):
        for values in both:
            value = random.uniform(-spread, spread, model[parent].shape)
            if parent.endswith("orientation"):
                value /= np.linalg.norm(value)
            values[parent] = np.abs(value) if parent.endswith("size") else value
    return both


def evaluate(model: SCM, term: str, now: Instant, before: Instant) -> float:
    """Evaluate a term as the model declares it."""
    declared: Any = model[term]
    causes = [(before if p.lag else now)[p.name] for p in declared.all_parents]
    return float(declared.mechanism.bind()(*causes))


def norm(vector: Any) -> float:
    """Measure a vector, or a matrix by Frobenius."""
    return float(np.linalg.norm(vector))


def tips_from(instant: Instant, block: str = "tool_block") -> float:
    """Measure how far the tips are from a block."""
    tips = instant["end_effector_positions"].reshape(3, 3)
    return norm(tips - instant[f"{block}.cartesian_position"])


def angle_left(instant: Instant, goal: Any) -> float:
    """Measure the angle between block and goal by its cosine."""
    return float(2.0 * np.arccos(min(1.0, abs(instant["tool_block.orientation"] @ goal))))


def speed_change(now: Instant, before: Instant) -> float:
    """Measure by how much the joint velocities changed."""
    return norm(now["joint_velocities"] - before["joint_velocities"])
