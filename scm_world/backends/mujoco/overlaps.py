"""Which bodies are in one place: MuJoCo's collision detection, on a model of its own.

A scene is checked before any engine realises it. Shapes that can touch are those that are
compared: pairs that the file excludes, parents and their children, and fixed bodies are not.
"""

from __future__ import annotations

import threading
from collections.abc import Set
from functools import lru_cache
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.mujoco.contacts import shapes_of
from scm_world.backends.mujoco.realization import Realization
from scm_world.models.scene import SURFACES, Overlap, ParameterKey, Scene

Shapes = tuple[int, int]
"""Numbers of two shapes: the geoms of the model, then its flexes."""


@lru_cache(maxsize=32)
@final
class _Scratch:
    """A compiled structure of a thread, to put scenes into one after another."""

    def __init__(self, structure: Any, thread: int) -> None:
        default = structure.default_scene().parameters
        self._written: dict[ParameterKey, Floats] = {
            key: value for key, value in default.items() if key[1] in SURFACES
        }
        self._now = Realization(structure, self._written)
        model, self.owners = self._now.model, structure.owners
        kinds = np.ones(model.ngeom + model.nflex, dtype=np.int64)
        roots = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]
        kinds[: model.ngeom][np.isin(model.body_rootid[model.geom_bodyid], roots)] = 0
        kinds[: model.ngeom][model.body_weldid[model.geom_bodyid] == 0] = 2
        self.ranks: dict[str, tuple[int, int]] = {}
        for shape, (owner, kind) in enumerate(zip(self.owners, kinds.tolist(), strict=True)):
            self.ranks.setdefault(owner, (kind, shape))

    def contacts(self, scene: Scene) -> tuple[Integers, Floats]:
        """Find the shapes that touch, shape (n, 2), and their depths, shape (n,) [m]."""
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
        return shapes_of(model, data), -data.contact.dist


def touching(scene: Scene, tolerance: float) -> frozenset[Shapes]:
    """Return the shapes that lie deeper in one another than a tolerance [m]."""
    shapes, depths = _Scratch(scene.structure, threading.get_ident()).contacts(scene)
    return frozenset((one, other) for one, other in shapes[depths > tolerance].tolist())


def overlaps(
    scene: Scene, tolerance: float, besides: Set[Shapes] = frozenset()
) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance [m].

    There is one entry for each pair of names, with its greatest depth. First come bodies that move
    freely, last those that never move; in a pair, too. Pairs of shapes ``besides`` these count.
    """
    scratch = _Scratch(scene.structure, threading.get_ident())
    shapes, depths = scratch.contacts(scene)
    if not len(depths):
        return ()
    found: dict[tuple[str, ...], Overlap] = {}
    listed, owners, ranks = depths > tolerance, scratch.owners, scratch.ranks
    for (one, other), depth in zip(shapes[listed].tolist(), depths[listed].tolist(), strict=True):
        names = owners[one], owners[other]
        if names[0] == names[1] or (one, other) in besides:
            continue
        names = names if ranks[names[0]] < ranks[names[1]] else names[::-1]
        if names not in found or found[names].depth < depth:
            found[names] = Overlap(names, depth)
    ordered = sorted(found, key=lambda names: [ranks[name] for name in names])
    return tuple(map(found.__getitem__, ordered))
