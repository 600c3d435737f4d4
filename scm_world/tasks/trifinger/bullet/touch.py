"""Contacts, from the engine's numbers to the names of the scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from scm_world.backends.base import Contact
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.bullet.description import LINKS_IN_ENGINE
from scm_world.tasks.trifinger.bullet.dynamics import LOWER, Bodies


def contacts(engine: Any, client: int, bodies: Bodies) -> tuple[Contact, ...]:
    """List the points that touch or press.

    The engine also keeps points of bodies that only came near; they are left out.
    """
    points = engine.getContactPoints(physicsClientId=client)
    return tuple(_contact(point, bodies) for point in points if point[8] <= 0.0 or point[9] > 0.0)


def _contact(point: tuple[Any, ...], bodies: Bodies) -> Contact:
    return Contact(
        bodies=(_name(bodies, point[1], point[3]), _name(bodies, point[2], point[4])),
        position=(np.array(point[5]) + np.array(point[6])) / 2,
        normal=-np.array(point[7]),  # the engine's points to the first body
        depth=-point[8],
        force=point[9],
    )


def _name(bodies: Bodies, body: int, link: int) -> str:
    if body == bodies.robot:
        finger, part = divmod(link, LINKS_IN_ENGINE)
        return hardware.link_name(hardware.FINGERS[finger], min(part, LOWER))
    if body in (bodies.floor, bodies.ground):
        return "floor"
    boxes = (*bodies.blocks.items(), *bodies.obstacles.items())
    return next((name for name, number in boxes if number == body), "stage")
