"""How a parameter of the scene is written to the engine and read back from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.backends.bullet.arena import COLLIDING_LINKS
from scm_world.backends.bullet.description import link_index
from scm_world.scene import trifinger
from scm_world.scene.scene import ParameterKey

TIP, LOWER = 4, 3  # links of a finger

LINKS = {
    trifinger.link_name(name, link): (finger, link)
    for finger, name in enumerate(trifinger.FINGERS)
    for link in range(trifinger.LINKS_PER_FINGER)
}
"""Finger and number of every link, by its published name."""


@final
@dataclass(frozen=True)
class Bodies:
    """The engine's numbers of all bodies.

    Attributes:
        robot: One body with fifteen links.
        floor: The plane.
        stage: The segments of the wall.
        blocks: By name, in the order of the state.
        sizes: Full edge lengths of the blocks [m].
    """

    robot: int
    floor: int
    stage: tuple[int, ...]
    blocks: dict[str, int] = field(default_factory=dict)
    sizes: list[list[float]] = field(default_factory=list)

    def place(self, name: str) -> tuple[int, int]:
        """Give body and link of a block, link or surface."""
        if name in LINKS:
            return self.robot, link_index(*LINKS[name])
        if name in self.blocks:
            return self.blocks[name], -1
        return {"floor": self.floor, "stage": self.stage[0]}[name], -1

    def places(self, name: str) -> list[tuple[int, int]]:
        """Give all bodies and links that a name stands for."""
        if name == "robot":
            return [(self.robot, link) for link in COLLIDING_LINKS]
        if name == "stage":
            return [(body, -1) for body in self.stage]
        if name in LINKS and LINKS[name][1] == LOWER:
            return [self.place(name), (self.robot, link_index(LINKS[name][0], TIP))]
        return [self.place(name)]


def write(engine: Any, client: int, bodies: Bodies, key: ParameterKey, value: Any) -> None:
    """Set one parameter of live bodies, and the inertia that follows from a mass."""
    name, quantity = key
    match quantity:
        case "gravity":
            engine.setGravity(*value, physicsClientId=client)
        case "friction":
            for body, link in bodies.places(name):
                engine.changeDynamics(body, link, lateralFriction=value, physicsClientId=client)
        case "color":
            for body, link in bodies.places(name):
                engine.changeVisualShape(
                    body, link, rgbaColor=[*value, 1.0], physicsClientId=client
                )
        case "mass":
            body, link = bodies.place(name)
            engine.changeDynamics(
                body,
                link,
                mass=value,
                localInertiaDiagonal=moments(bodies, name, value),
                physicsClientId=client,
            )


def moments(bodies: Bodies, name: str, mass: float) -> list[float]:
    """Compute the principal moments of inertia of a block (a solid box) or of a link [kg m²]."""
    if name in LINKS:
        return [mass * moment for moment in trifinger.INERTIAL[LINKS[name][1]].per_mass]
    x, y, z = bodies.sizes[list(bodies.blocks).index(name)]
    return [mass / 12 * (y * y + z * z), mass / 12 * (x * x + z * z), mass / 12 * (x * x + y * y)]


def read(engine: Any, client: int, bodies: Bodies, key: ParameterKey) -> Floats:
    """Ask the engine for one parameter, in the units of the scene."""
    name, quantity = key
    match quantity:
        case "gravity":
            physics = engine.getPhysicsEngineParameters(physicsClientId=client)
            return np.array([physics[f"gravityAcceleration{axis}"] for axis in "XYZ"])
        case "height":
            pose = engine.getBasePositionAndOrientation(bodies.robot, physicsClientId=client)
            return np.array(pose[0][2] + trifinger.TABLE_OFFSET)
        case "color":
            body, link = bodies.place(name)
            shapes = engine.getVisualShapeData(body, physicsClientId=client)
            return np.array(next(shape[7][:3] for shape in shapes if shape[1] == link))
        case "size":
            shapes = engine.getCollisionShapeData(bodies.blocks[name], -1, physicsClientId=client)
            return np.array(shapes[0][3])
        case _:
            body, link = bodies.places(name)[0]
            info = engine.getDynamicsInfo(body, link, physicsClientId=client)
            return np.array(info[0] if quantity == "mass" else info[1])
