"""Which bodies are in one place, and which constraints do not hold, on a model of its own.

Bodies are compared by MuJoCo's collision detection. A scene is checked before any engine realises
it. Shapes that can touch are those that are compared: pairs that the file excludes, parents and
their children, and fixed bodies are not.
"""

from __future__ import annotations

from collections.abc import Set
from functools import partial
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.mujoco.contacts import shapes_of
from scm_world.backends.mujoco.equalities import SWITCHES, Violation, violations
from scm_world.backends.mujoco.realization import Realization
from scm_world.backends.mujoco.scratch import scratch
from scm_world.models import Model
from scm_world.models.scene import SURFACES, Overlap, ParameterKey, Scene

Shapes = tuple[int, int]
"""Numbers of two shapes: the geoms of the model, then its flexes."""


@final
class _Scratch:
    """A compiled structure, to put scenes into one after another."""

    def __init__(self, structure: Model) -> None:
        defaults = structure.default_scene().parameters
        self._default: dict[ParameterKey, Floats] = {
            key: value for key, value in defaults.items() if key[1] in (*SURFACES, *SWITCHES)
        }
        self._written = {**self._default}
        self._now = Realization(structure, self._written)
        model, self.owners = self._now.model, structure.owners
        kinds = np.ones(model.ngeom + model.nflex, dtype=np.int64)
        roots = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)]
        kinds[: model.ngeom][np.isin(model.body_rootid[model.geom_bodyid], roots)] = 0
        kinds[: model.ngeom][model.body_weldid[model.geom_bodyid] == 0] = 2
        self.ranks: dict[str, tuple[int, int]] = {}
        for shape, (owner, kind) in enumerate(zip(self.owners, kinds.tolist(), strict=True)):
            self.ranks.setdefault(owner, (kind, shape))

    def placed(self, scene: Scene) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the model and its data with a scene."""
        now, written, parameters = self._now, self._written, scene.parameters
        given = {k: parameters.get(k, value) for k, value in self._default.items()}
        changed = {k: value for k, value in given.items() if value is not written[k]}
        if changed:
            now.edit(changed)
            written |= changed
        now.place(scene.state.vector.copy())
        return now.model, now.data

    def contacts(self, scene: Scene) -> tuple[Integers, Floats]:
        """Find the shapes that touch, shape (n, 2), and their depths, shape (n,) [m]."""
        model, data = self.placed(scene)
        mujoco.mj_kinematics(model, data)
        if model.nflex:
            mujoco.mj_flex(model, data)
        mujoco.mj_collision(model, data)
        return shapes_of(model, data), -data.contact.dist


def _scratch(structure: Any) -> _Scratch:
    return scratch(structure, "overlaps", partial(_Scratch, structure))


def touching(scene: Scene, tolerance: float) -> frozenset[Shapes]:
    """Return the shapes that lie deeper in one another than a tolerance [m]."""
    shapes, depths = _scratch(scene.structure).contacts(scene)
    return frozenset((one, other) for one, other in shapes[depths > tolerance].tolist())


def violated(scene: Scene) -> tuple[Violation, ...]:
    """List the equality constraints that do not hold in a scene."""
    if not Model.of(scene.structure, "MuJoCo").source.realized.neq:
        return ()
    return (*violations(*_scratch(scene.structure).placed(scene)),)


def overlaps(
    scene: Scene, tolerance: float, besides: Set[Shapes] = frozenset()
) -> tuple[Overlap, ...]:
    """List all pairs of bodies that lie deeper in one another than a tolerance [m].

    There is one entry for each pair of names, with its greatest depth. First come bodies that move
    freely, last those that never move; in a pair, too. Pairs of shapes ``besides`` these count.
    """
    own = _scratch(scene.structure)
    shapes, depths = own.contacts(scene)
    if not len(depths):
        return ()
    found: dict[tuple[str, ...], Overlap] = {}
    listed, owners, ranks = depths > tolerance, own.owners, own.ranks
    for (one, other), depth in zip(shapes[listed].tolist(), depths[listed].tolist(), strict=True):
        names = owners[one], owners[other]
        if names[0] == names[1] or (one, other) in besides:
            continue
        names = names if ranks[names[0]] < ranks[names[1]] else names[::-1]
        if names not in found or found[names].depth < depth:
            found[names] = Overlap(names, depth)
    ordered = sorted(found, key=lambda names: [ranks[name] for name in names])
    return tuple(map(found.__getitem__, ordered))
