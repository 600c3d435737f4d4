"""An engine-free description of what stands in the world."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from scm_world._types import Floats
from scm_world.scene import trifinger
from scm_world.scene.controller import ControllerSpec
from scm_world.scene.presets import FAST, Preset
from scm_world.scene.state import PhysicalState

ParameterKey = tuple[str, str]
"""A body and a property of it, for example ``("tool_block", "mass")``."""

Parameters = Mapping[ParameterKey, Floats]
"""Physical parameters: scalars have shape (), sizes, colors and gravity shape (3,)."""

ARENA_HALF_WIDTH = 0.15  # [m]
ARENA_HEIGHT = 0.3  # [m]
WALL_RADIUS = 0.242  # [m] inner radius of the ring
WALL_HEIGHT = 0.25  # [m]
WALL_THICKNESS = 0.02  # [m] outward, so that nothing tunnels through it
WALL_SEGMENTS = 24

SPINNING_FRICTION = 0.001  # torsional coefficient of every contact


@final
@dataclass(frozen=True)
class Structure:
    """What has to be compiled: it changes only when bodies come or go.

    Attributes:
        blocks: Names of the movable blocks, in the order of the state.
        preset: Numerical settings.
        controller: The joint controller.
    """

    blocks: tuple[str, ...] = ()
    preset: Preset = FAST
    controller: ControllerSpec = field(default_factory=ControllerSpec)


@final
@dataclass(frozen=True)
class Goal:
    """A place where something should be. Goals are never bodies: nothing can touch them.

    Attributes:
        name: Of the entity.
        shape: ``"box"`` or ``"sphere"``.
        size: Full edge lengths, or three times the diameter, shape (3,) [m].
        position: Center, shape (3,) [m].
        orientation: Quaternion (x, y, z, w).
        color: Red, green, blue in [0, 1].
    """

    name: str
    shape: str
    size: Floats
    position: Floats
    orientation: Floats
    color: Floats


@final
@dataclass(frozen=True)
class Scene:
    """Everything an engine needs to know, and everything a picture shows.

    Attributes:
        structure: The bodies there are.
        parameters: Their properties, complete (see ``parameter_keys``).
        state: Where everything is and how it moves.
        goals: Silhouettes, for pictures and rewards.
    """

    structure: Structure
    parameters: Parameters
    state: PhysicalState
    goals: tuple[Goal, ...] = ()

    def with_(self, **changes: object) -> Scene:
        """Copy the scene with some fields replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]


def parameter_keys(structure: Structure) -> Iterator[ParameterKey]:
    """List every parameter that a scene of this structure has.

    ======================  ==========================================
    body                    properties
    ======================  ==========================================
    ``world``               ``gravity`` (3,) [m/s²]
    ``robot``               ``height`` [m], ``friction``
    ``robot_finger_F_link_i``  ``mass`` [kg], ``color`` (3,)
    ``floor``, ``stage``    ``friction``, ``color`` (3,)
    every block             ``mass`` [kg], ``size`` (3,) [m], ``friction``, ``color`` (3,)
    ======================  ==========================================

    The friction of a contact is the product of the frictions of its two bodies.
    """
    yield ("world", "gravity")
    yield ("robot", "height")
    yield ("robot", "friction")
    for link in trifinger.LINK_NAMES:
        yield (link, "mass")
        yield (link, "color")
    for surface in ("floor", "stage"):
        yield (surface, "friction")
        yield (surface, "color")
    for block in structure.blocks:
        for name in ("mass", "size", "friction", "color"):
            yield (block, name)


def default_parameters(structure: Structure) -> dict[ParameterKey, Floats]:
    """Give the published default of every parameter."""
    surface = {"floor": (0.31, 0.27, 0.25), "stage": (0.95, 0.95, 0.95)}
    values: dict[ParameterKey, object] = {
        ("world", "gravity"): (0.0, 0.0, -9.81),
        ("robot", "height"): trifinger.NOMINAL_HEIGHT,
        ("robot", "friction"): 0.5,
    }
    for finger in trifinger.FINGERS:
        for index, mass in enumerate(trifinger.LINK_MASS):
            values[trifinger.link_name(finger, index), "mass"] = mass
            values[trifinger.link_name(finger, index), "color"] = trifinger.LINK_COLORS[finger]
    for name, color in surface.items():
        values[name, "friction"] = 0.5
        values[name, "color"] = color
    for block in structure.blocks:
        values[block, "mass"] = 0.02
        values[block, "size"] = (0.065, 0.065, 0.065)
        values[block, "friction"] = 1.0
        values[block, "color"] = (1.0, 0.0, 0.0)
    return {key: np.asarray(values[key], dtype=np.float64) for key in parameter_keys(structure)}


def default_scene(structure: Structure) -> Scene:
    """Stand the blocks in a row on the table, with the robot in its rest pose."""
    state = PhysicalState(len(structure.blocks))
    state.joint_positions[:] = trifinger.REST
    state.positions[:, 2] = 0.0325
    places = np.arange(len(structure.blocks)) - (len(structure.blocks) - 1) / 2
    state.positions[:, 0] = 0.1 * places
    return Scene(structure, default_parameters(structure), state)
