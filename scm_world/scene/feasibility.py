"""Which bodies of a scene are in one place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from scm_world._types import Floats, Integers
from scm_world.geometry.arrays import compact, rows
from scm_world.geometry.sweep import FLOOR, OTHERS, WALL, sweep
from scm_world.scene import trifinger
from scm_world.scene.kinematics import FRAMES_PER_FINGER, link_frames
from scm_world.scene.scene import WALL_HEIGHT, WALL_RADIUS, Scene

_LINK = {"upper": 1, "middle": 2, "lower": 3, "tip": 3}
"""The link that a collision shape belongs to: the tip is a part of the lower link."""

_FRAME = {"upper": 1, "middle": 2, "lower": 3, "tip": 4}
"""The frame of a finger in which a collision shape is given."""

_FLAGS = {
    "upper": 0,
    "middle": OTHERS | FLOOR,
    "lower": OTHERS | FLOOR,
    "tip": OTHERS | FLOOR | WALL,
}


@final
@dataclass(frozen=True)
class Overlap:
    """Two bodies in one place.

    Attributes:
        bodies: Their names: blocks first, then links, ``"floor"`` and ``"stage"`` last.
        depth: How deep they lie in one another [m]; see ``scm_world.geometry.penetration``.
    """

    bodies: tuple[str, str]
    depth: float

    def __str__(self) -> str:
        first, second = self.bodies
        return f"{first!r} lies {1e3 * self.depth:.3g} mm deep in {second!r}"


def _capsules() -> tuple[Floats, Integers]:
    """Gather the collision shapes of all fingers, as ``sweep`` wants them."""
    capsules, members = [], []
    for finger in range(len(trifinger.FINGERS)):
        for part, capsule in trifinger.COLLISION.items():
            capsules.append((*capsule.start, *capsule.end, capsule.radius))
            frame = FRAMES_PER_FINGER * finger + _FRAME[part]
            body = trifinger.LINKS_PER_FINGER * finger + _LINK[part]
            members.append((frame, body, finger, _FLAGS[part]))
    return np.array(capsules), np.array(members, dtype=np.int64)


_CAPSULES, _MEMBERS = _capsules()
_WALL = (WALL_RADIUS, WALL_HEIGHT)


def overlaps(scene: Scene, *, tolerance: float) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance.

    Compared are blocks with everything; the middle and lower links of different fingers with one
    another; both with the floor; the tips with the ring, as in the engines. A block whose center
    is outside the arena lies in the stage (beyond the ring, at any height) or in the floor (below
    it). Links of the same finger, and the upper links, cannot collide with anything but blocks.

    Args:
        scene: With complete parameters.
        tolerance: How deep is too deep [m].

    Returns:
        One entry for each pair of names, blocks first.

    Example:
        >>> from scm_world.scene import Structure, default_scene
        >>> scene = default_scene(Structure(blocks=("tool_block",)))
        >>> overlaps(scene, tolerance=1e-4)
        ()
        >>> scene.state.positions[0, 2] = 0.03
        >>> print(*overlaps(scene, tolerance=1e-4))
        'tool_block' lies 2.5 mm deep in 'floor'
    """
    blocks, state = scene.structure.blocks, scene.state
    sizes = rows([scene.parameters[block, "size"] for block in blocks], 3)
    height = float(scene.parameters["robot", "height"])
    found = sweep(
        sizes,
        compact(state.positions),
        compact(state.orientations),
        _CAPSULES,
        _MEMBERS,
        *link_frames(state.joint_positions, height),
        wall=_WALL,
        tolerance=float(tolerance),
    )
    if not len(found.depths):
        return ()
    names = (*blocks, *trifinger.LINK_NAMES, "floor", "stage")
    pairs = zip(found.pairs.tolist(), found.depths.tolist(), strict=True)
    return tuple(Overlap((names[i], names[j]), depth) for (i, j), depth in pairs)
