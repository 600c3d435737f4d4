"""The TriFinger as CausalWorld 1.2 has it in Bullet, so that policies from there act here alike.

What differs was found by comparing states step by step: the links are the convex hulls of their
meshes, the table is a plate, the wall has more sides, everything that can touch does, robot and
blocks lose speed as they move, spinning friction belongs to blocks and obstacles alone, the solver
may end early, and torques are those before a step.

``meshes.npz`` has the corners of hulls and plate, from CausalWorld 1.2 (MIT license), in the frames
of the bodies [m].
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.tasks.trifinger.hardware import FINGERS, WALL_HEIGHT, WALL_RADIUS, WALL_THICKNESS

DAMPING = (0.5, 0.04)
"""What robot and blocks lose of their speed in a second; see ``backends.bullet.build.custom``."""
EARLY_END = 1e-7  # residual at which the solver ends
MARGIN = 0.001  # [m] by which the engine inflates the hulls, so that the table begins below zero
SIDES = 37  # of the ring, whose inner edges lie on its circle
TABLE = "table"
LINKS = ("upper", "middle", "lower")


@cache
def meshes() -> dict[str, Floats]:
    """Return the corners of the hulls of links and table, shape (n, 3) [m]."""
    with np.load(Path(__file__).with_name("meshes.npz")) as file:
        return {name: file[name] for name in (*LINKS, TABLE)}


def alter(spec: mujoco.MjSpec) -> None:
    """Make a robot that of the predecessor; its contacts are ``touching``."""
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    spec.add_numeric(name="bullet_damping", size=2, data=DAMPING)
    spec.add_numeric(name="bullet_early_end", size=1, data=[EARLY_END])
    for name, corners in meshes().items():
        spec.add_mesh(name=name, uservert=corners.ravel().tolist())
        shapes = ["floor"] if name == TABLE else [f"{finger}/{name}" for finger in FINGERS]
        for shape in map(spec.geom, shapes):
            shape.type, shape.meshname = mujoco.mjtGeom.mjGEOM_MESH, name
            shape.pos, shape.quat = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
            shape.fromto, shape.margin = [np.nan] * 6, MARGIN
    spec.body("floor").pos = (0.0, 0.0, -MARGIN)
    stage, half_turn = spec.body("stage"), math.pi / SIDES
    stage.pos = (0.0, 0.0, -MARGIN)
    middle = WALL_RADIUS * math.cos(half_turn) + WALL_THICKNESS / 2.0
    for side in range(SIDES):
        name, angle = f"stage/{side}", math.pi / 2.0 + (2 * side + 1) * half_turn
        shape = spec.geom(name) or stage.add_geom(name=name, contype=0, conaffinity=0)
        shape.type, shape.size = mujoco.mjtGeom.mjGEOM_BOX, spec.geom("stage/0").size
        shape.pos = (middle * math.cos(angle), middle * math.sin(angle), WALL_HEIGHT / 2.0)
        shape.quat = (math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0))


def restore(mj: mujoco.MjModel) -> None:
    """Put corners back to the last digit: compiling turns meshes, in numbers of 32 bits."""
    for name, corners in meshes().items():
        mesh = mj.mesh(name)
        first, shapes = int(mesh.vertadr[0]), mj.geom_dataid == mesh.id
        mj.mesh_vert[first : first + len(corners)] = corners
        mj.geom_pos[shapes], mj.geom_quat[shapes] = 0.0, (1.0, 0.0, 0.0, 0.0)


def touching(
    blocks: tuple[str, ...], obstacles: tuple[str, ...]
) -> Iterator[tuple[str, str, bool]]:
    """List which shapes can touch: all that are not fixed, but for links that a joint joins."""
    fixed = ["floor", *(f"stage/{segment}" for segment in range(SIDES)), *obstacles]
    links = [(finger, index) for finger in range(len(FINGERS)) for index in range(len(LINKS))]
    shapes = {link: f"{FINGERS[link[0]]}/{LINKS[link[1]]}" for link in links}
    yield from ((one, other, False) for one in fixed for other in (*shapes.values(), *blocks))
    yield from ((one, other, False) for one in shapes.values() for other in blocks)
    yield from ((one, other, False) for one, other in combinations(blocks, 2))
    for (finger, index), (its, other) in combinations(links, 2):
        if finger != its or other - index > 1:
            yield shapes[finger, index], shapes[its, other], False


def spinning_weights(
    mj: mujoco.MjModel, blocks: tuple[str, ...], obstacles: tuple[str, ...]
) -> Floats:
    """Return how many times the spinning friction of the scene each shape has, shape (ngeom,).

    Only blocks and obstacles have one. Beside ``backends.bullet.client.spinning_shares``, which
    are 1/2 and 3/4 for their frictions of 1 and 1/2, all of it is left. The bases, which touch
    nothing, keep the number itself.
    """
    weights = np.zeros(mj.ngeom)
    for names, weight in ((blocks, 2.0), (obstacles, 4.0 / 3.0)):
        weights[[mj.geom(name).id for name in names]] = weight
    weights[[mj.geom(f"{finger}/base").id for finger in FINGERS]] = 1.0
    return weights
