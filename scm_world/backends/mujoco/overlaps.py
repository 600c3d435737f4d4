"""Which bodies are in one place: MuJoCo's collision detection, on a model of its own.

A scene is looked at where it would be, before any engine realises it. What can touch is what is
compared: pairs that the file excludes, parents and their children, and fixed bodies are not.
"""

from __future__ import annotations

import threading
from collections.abc import Container, Mapping
from functools import lru_cache
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.backend import realize
from scm_world.models.scene import SURFACES, Overlap, ParameterKey, Scene

Shapes = tuple[int, int]
"""Numbers of two shapes: the geoms of the model, then its flexes."""


@final
class _Scratch:
    """A compiled structure, to put scenes into one after another."""

    def __init__(self, structure: Any) -> None:
        default = structure.default_scene().parameters
        self._written: dict[ParameterKey, Floats] = {
            key: value for key, value in default.items() if key[1] in SURFACES
        }
        self._now = realize(structure, self._written)
        model, self.owners = self._now.model, self._now.owners
        kinds = np.ones(model.ngeom + model.nflex, dtype=np.int64)
        roots = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        kinds[: model.ngeom][np.isin(model.body_rootid[model.geom_bodyid], roots)] = 0
        kinds[: model.ngeom][model.body_weldid[model.geom_bodyid] == 0] = 2
        self.ranks: dict[str, tuple[int, int]] = {}
        for shape, (owner, kind) in enumerate(zip(self.owners, kinds.tolist(), strict=True)):
            self.ranks.setdefault(owner, (kind, shape))

    def touching(self, scene: Scene, tolerance: float) -> dict[Shapes, float]:
        """Find the shapes that lie deeper in one another than a tolerance [m]."""
        now, written, parameters = self._now, self._written, scene.parameters
        changed = {k: parameters[k] for k, old in written.items() if parameters[k] is not old}
        if changed:
            now.edit(changed)
            written |= changed
        now.place(scene.state.vector.copy())
        model, data = now.model, now.data
        mujoco.mj_kinematics(model, data)
        if model.nflex:
            mujoco.mj_flex(model, data)
        mujoco.mj_collision(model, data)
        found: dict[Shapes, float] = {}
        if not data.ncon:
            return found
        contact = data.contact
        deep = np.flatnonzero(contact.dist < -tolerance)
        if len(deep):
            shapes = contact.geom[deep]
            if model.nflex:
                shapes = np.where(shapes < 0, model.ngeom + contact.flex[deep], shapes)
            for (one, other), distance in zip(
                shapes.tolist(), contact.dist[deep].tolist(), strict=True
            ):
                found[one, other] = max(found.get((one, other), 0.0), -distance)
        return found


@lru_cache(maxsize=32)
def _scratch(structure: Any, thread: int) -> _Scratch:
    """Compile a structure once in each thread."""
    return _Scratch(structure)


def touching(scene: Scene, tolerance: float) -> Mapping[Shapes, float]:
    """Find the shapes that lie deeper in one another than a tolerance [m], with their depths."""
    return _scratch(scene.structure, threading.get_ident()).touching(scene, tolerance)


def overlaps(
    scene: Scene, tolerance: float, besides: Container[Shapes] = ()
) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance.

    Args:
        scene: With complete parameters.
        tolerance: How deep is too deep [m].
        besides: Pairs of shapes that may lie in one another.

    Returns:
        One entry for each pair of names, with its greatest depth. First come bodies that move
        freely, last those that never move; in a pair, too.

    Example:
        >>> from scm_world.tasks.trifinger.structure import TriFingerStructure, default_scene
        >>> scene = default_scene(TriFingerStructure(blocks=("tool_block",)))
        >>> overlaps(scene, 1e-4)
        ()
        >>> scene.state.positions[0, 2] = 0.03
        >>> print(*overlaps(scene, 1e-4))
        'tool_block' lies 2.5 mm deep in 'floor'
    """
    scratch = _scratch(scene.structure, threading.get_ident())
    owners, ranks = scratch.owners, scratch.ranks
    deepest: dict[tuple[str, ...], float] = {}
    for shapes, depth in scratch.touching(scene, tolerance).items():
        names = tuple(sorted({owners[shape] for shape in shapes}, key=ranks.__getitem__))
        if len(names) == 2 and shapes not in besides:
            deepest[names] = max(depth, deepest.get(names, 0.0))
    found = (Overlap((one, other), depth) for (one, other), depth in deepest.items())
    return tuple(sorted(found, key=lambda overlap: [*map(ranks.__getitem__, overlap.bodies)]))
