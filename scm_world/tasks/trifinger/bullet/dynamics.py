"""How a parameter of the scene is written to the engine and read back from it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.errors import EngineFailure
from scm_world.geometry.hulls import Hull
from scm_world.models.scene import ParameterKey
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.bullet.arena import (
    BLOCK_SPINNING,
    COLLIDING_LINKS,
    OTHER_SPINNING,
    Shape,
)
from scm_world.tasks.trifinger.bullet.description import link_index

TIP, LOWER = 4, 3  # links of a finger

LINKS = {
    hardware.link_name(name, link): (finger, link)
    for finger, name in enumerate(hardware.FINGERS)
    for link in range(hardware.LINKS_PER_FINGER)
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
        obstacles: By name.
        blocks: By name, in the order of the state.
        shapes: Of obstacles and blocks, by name.
        spinning: What robot, floor and stage, obstacles, and blocks get of the spinning friction
            of the scene; see ``BLOCK_SPINNING``.
        ground: What is under the floor, if anything is.
    """

    robot: int
    floor: int
    stage: tuple[int, ...]
    obstacles: dict[str, int] = field(default_factory=dict)
    blocks: dict[str, int] = field(default_factory=dict)
    shapes: dict[str, Shape] = field(default_factory=dict)
    spinning: tuple[float, float, float] = (OTHER_SPINNING, OTHER_SPINNING, BLOCK_SPINNING)
    ground: int = -1

    def place(self, name: str) -> tuple[int, int]:
        """Give body and link of a block, obstacle, link or surface."""
        if name in LINKS:
            return self.robot, link_index(*LINKS[name])
        if name in self.blocks:
            return self.blocks[name], -1
        if name in self.obstacles:
            return self.obstacles[name], -1
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

    def groups(self) -> tuple[list[tuple[int, int]], ...]:
        """Give bodies and links of robot, floor and stage, those of obstacles, and of blocks."""
        fixed = [*self.places("robot"), *((body, -1) for body in (self.floor, *self.stage))]
        return (
            fixed,
            [(b, -1) for b in self.obstacles.values()],
            [(b, -1) for b in self.blocks.values()],
        )


def write(engine: Any, client: int, bodies: Bodies, key: ParameterKey, value: Any) -> None:
    """Set one parameter of live bodies, and the inertia that follows from a mass.

    Nothing is to be done for those of the controller and for joint damping: see ``Client``.
    """
    name, quantity = key
    match quantity:
        case "gravity":
            engine.setGravity(*value, physicsClientId=client)
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
        case _:
            for body, link, change in _changes(bodies, name, quantity, value):
                engine.changeDynamics(body, link, physicsClientId=client, **change)


def _changes(
    bodies: Bodies, name: str, quantity: str, value: float
) -> Iterator[tuple[int, int, dict[str, float]]]:
    """List bodies, links, and what becomes of them: one property a call, see ``add_robot``."""
    match quantity:
        case "friction":
            yield from ((*place, {"lateralFriction": value}) for place in bodies.places(name))
        case "restitution":  # that of a contact is the product
            if value < 0.0:
                raise EngineFailure(f"restitution must not be negative, got {value}", "bullet")
            root = {"restitution": math.sqrt(value)}
            yield from ((*place, root) for places in bodies.groups() for place in places)
        case "spinning_friction":
            for share, places in zip(bodies.spinning, bodies.groups(), strict=True):
                change = {"spinningFriction": share * value}
                yield from ((*place, change) for place in places)


def moments(bodies: Bodies, name: str, mass: float) -> list[float]:
    """Compute the principal moments of inertia of a solid block or of a link [kg m²]."""
    if name in LINKS:
        return [mass * moment for moment in hardware.INERTIAL[LINKS[name][1]].per_mass]
    shape = bodies.shapes[name]
    if isinstance(shape, Hull):
        return [mass * moment for moment in shape.moments]
    x, y, z = shape
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
            return np.array(pose[0][2] + hardware.TABLE_OFFSET)
        case "color":
            body, link = bodies.place(name)
            shapes = engine.getVisualShapeData(body, physicsClientId=client)
            return np.array(next(shape[7][:3] for shape in shapes if shape[1] == link))
        case "size":
            return np.array(_size(engine, client, bodies, name))
        case "position" | "orientation":
            body = bodies.obstacles[name]
            pose = engine.getBasePositionAndOrientation(body, physicsClientId=client)
            return np.array(pose[0] if quantity == "position" else pose[1])
        case _:
            place = bodies.places("robot" if name == "world" else name)[0]
            info = engine.getDynamicsInfo(*place, physicsClientId=client)
            return np.array(_from_info(info, quantity))


def _size(engine: Any, client: int, bodies: Bodies, name: str) -> tuple[float, ...]:
    """Ask for the edge lengths of a box; those of a rigid body are known from its picture only."""
    if name in bodies.obstacles:
        shapes = engine.getVisualShapeData(bodies.obstacles[name], physicsClientId=client)
    else:
        shapes = engine.getCollisionShapeData(bodies.blocks[name], -1, physicsClientId=client)
    size: tuple[float, ...] = shapes[0][3]
    return size


def _from_info(info: Any, quantity: str) -> float:
    """Find a property of a body, or that of every contact from a link's share of it."""
    values = {
        "mass": info[0],
        "friction": info[1],
        "restitution": info[5] ** 2,
        "spinning_friction": info[7] / OTHER_SPINNING,
    }
    return float(values[quantity])
