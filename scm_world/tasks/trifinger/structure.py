"""A backend-free description of what stands in the world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, final

import numpy as np

from scm_world._types import Floats
from scm_world.geometry.hulls import Hull
from scm_world.models.scene import (
    ParameterKey,
    Parameters,
    Scene,
    State,
    StateLayout,
)
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.hardware import FAST, ControllerSpec, Preset
from scm_world.tasks.trifinger.state import BLOCK_SIZE, ROBOT_SIZE, PhysicalState, state_layout

ARENA_HALF_WIDTH = 0.15  # [m]
ARENA_HEIGHT = 0.3  # [m]
WALL_RADIUS = 0.242  # [m] inner radius of the ring
WALL_HEIGHT = 0.25  # [m]
WALL_THICKNESS = 0.02  # [m] outward, so that nothing tunnels through it
WALL_SEGMENTS = 24

SPINNING_FRICTION = 0.001  # torsional coefficient of every contact


@final
@dataclass(frozen=True)
class TriFingerStructure:
    """What has to be compiled: it changes only when bodies come or go.

    Attributes:
        blocks: Names of the movable blocks, in the order of the state.
        preset: Numerical settings.
        obstacles: Names of boxes that never move by themselves. Blocks, middle and lower links
            and fingertips collide with them.
        hulls: The movable blocks that are no boxes, each with its convex shape.
        published: Whether Bullet realises all bodies as the predecessor does; see
            ``bullet.published``.
    """

    blocks: tuple[str, ...] = ()
    preset: Preset = FAST
    obstacles: tuple[str, ...] = ()
    hulls: tuple[tuple[str, Hull], ...] = ()
    published: bool = False

    @property
    def timestep(self) -> float:
        """Physics step [s]."""
        return self.preset.timestep

    @property
    def n_commands(self) -> int:
        """How many numbers a command has."""
        return hardware.N_JOINTS

    @property
    def layout(self) -> StateLayout:
        """Where each state stands in the vector."""
        return state_layout(len(self.blocks))

    def empty_state(self) -> PhysicalState:
        """Give a state to read into."""
        return PhysicalState(len(self.blocks))

    def default_scene(self) -> Scene:
        """Give the scene in which every parameter and every state has its default."""
        return default_scene(self)

    def carried(self, state: State, before: Scene) -> None:
        """Copy the robot and the blocks that another structure has too."""
        state.vector[:ROBOT_SIZE] = before.state.vector[:ROBOT_SIZE]
        blocks = state.vector[ROBOT_SIZE:].reshape(-1, BLOCK_SIZE)
        for index, name in enumerate(self.blocks):
            if name in before.structure.blocks:
                blocks[index] = before.state.blocks[before.structure.blocks.index(name)]

    def realization(self, backend: str) -> Any:
        """Return how the robot is realised on a backend, or seen."""
        return _realization("published" if self.published and backend == "bullet" else backend)

    def hull(self, block: str) -> Hull | None:
        """Give the shape of a block that is no box; None for a box."""
        return next((hull for name, hull in self.hulls if name == block), None)


_REALIZATIONS = {
    "mujoco": ("mujoco.realization", "TriFinger"),
    "bullet": ("bullet.client", "TriFingerClient"),
    "published": ("bullet.published", "PublishedClient"),
    "fake": ("fake", None),
    "renderer": ("cameras", "VIEWS"),
}


@cache
def _realization(backend: str) -> Any:
    """Import a realisation, so that no backend is loaded before it is used."""
    if backend not in _REALIZATIONS:
        return None
    module, name = _REALIZATIONS[backend]
    found = import_module(f"scm_world.tasks.trifinger.{module}")
    return found if name is None else getattr(found, name)


SURFACE = ("size", "friction", "color")
"""Parameters of every obstacle without its pose, and of every box without its mass."""


def parameter_keys(structure: TriFingerStructure) -> Iterator[ParameterKey]:
    """List every parameter that a scene of this structure has.

    ======================  ==========================================
    body                    properties
    ======================  ==========================================
    ``world``               ``gravity`` (3,) [m/s²], ``restitution``, ``spinning_friction``
    ``robot``               ``height`` [m], ``friction``, ``joint_damping`` [N m s/rad]
    ``controller``          ``position_gains`` (3,) [N m/rad], ``velocity_gains`` (3,)
                            [N m s/rad], ``safety_damping`` (3,) [N m s/rad],
                            ``torque_limit`` [N m]; see ``ControllerSpec``
    ``robot_finger_F_link_i``  ``mass`` [kg], ``color`` (3,)
    ``floor``, ``stage``    ``friction``, ``color`` (3,)
    every block             ``mass`` [kg], ``size`` (3,) [m], ``friction``, ``color`` (3,);
                            one that is a hull has no ``size``
    every obstacle          ``size`` (3,) [m], ``friction``, ``color`` (3,), ``position`` (3,)
                            [m], ``orientation`` (4,)
    ======================  ==========================================

    The friction of a contact is the product of the frictions of its two bodies; restitution and
    spinning friction are the same for every contact.
    """
    yield from (("world", name) for name in ("gravity", "restitution", "spinning_friction"))
    yield from (("robot", name) for name in ("height", "friction", "joint_damping"))
    yield from (("controller", name) for name in CONTROLLER)
    for link in hardware.LINK_NAMES:
        yield (link, "mass")
        yield (link, "color")
    for surface in ("floor", "stage"):
        yield (surface, "friction")
        yield (surface, "color")
    for block in structure.blocks:
        yield (block, "mass")
        yield from (
            (block, name) for name in SURFACE if name != "size" or not structure.hull(block)
        )
    for obstacle in structure.obstacles:
        yield from ((obstacle, name) for name in (*SURFACE, "position", "orientation"))


CONTROLLER = ("position_gains", "velocity_gains", "safety_damping", "torque_limit")
"""The parameters of the joint controller, in the order of the fields of ``ControllerSpec``."""


def controller_spec(parameters: Parameters) -> ControllerSpec:
    """Read the joint controller from the parameters of a scene."""
    *gains, limit = (parameters["controller", name] for name in CONTROLLER)
    kp, kd, safety = (tuple(gain.tolist()) for gain in gains)
    return ControllerSpec(kp, kd, safety, float(limit))


def default_parameters(structure: TriFingerStructure) -> dict[ParameterKey, Floats]:
    """Give the published default of every parameter."""
    surface = {"floor": (0.31, 0.27, 0.25), "stage": (0.95, 0.95, 0.95)}
    spec = ControllerSpec()
    values: dict[ParameterKey, object] = {
        ("world", "gravity"): (0.0, 0.0, -9.81),
        ("world", "restitution"): 0.0,
        ("world", "spinning_friction"): SPINNING_FRICTION,
        ("robot", "height"): hardware.NOMINAL_HEIGHT,
        ("robot", "friction"): 0.5,
        ("robot", "joint_damping"): 0.0,
        ("controller", "position_gains"): spec.kp,
        ("controller", "velocity_gains"): spec.kd,
        ("controller", "safety_damping"): spec.safety,
        ("controller", "torque_limit"): spec.limit,
    }
    for finger in hardware.FINGERS:
        for index, mass in enumerate(hardware.LINK_MASS):
            values[hardware.link_name(finger, index), "mass"] = mass
            values[hardware.link_name(finger, index), "color"] = hardware.LINK_COLORS[finger]
    for name, color in surface.items():
        values[name, "friction"] = 0.5
        values[name, "color"] = color
    for block in structure.blocks:
        values[block, "mass"] = 0.02
        values[block, "size"] = (0.065, 0.065, 0.065)
        values[block, "friction"] = 1.0
        values[block, "color"] = (1.0, 0.0, 0.0)
    for index, obstacle in enumerate(structure.obstacles):
        values[obstacle, "size"] = (0.01, 0.01, 0.01)
        values[obstacle, "friction"] = 0.5
        values[obstacle, "color"] = (0.0, 0.0, 0.0)
        values[obstacle, "position"] = (0.02 * index - 0.1, 0.15, 0.005)
        values[obstacle, "orientation"] = (0.0, 0.0, 0.0, 1.0)
    return {key: np.asarray(values[key], dtype=np.float64) for key in parameter_keys(structure)}


COLUMNS, ROWS = 3, 2
SPACING = 0.1  # [m] between the centers of blocks that stand side by side
LAYER = 0.07  # [m] between the centers of blocks that stand on one another


def default_scene(structure: TriFingerStructure) -> Scene:
    """Stand the blocks on the table, in rows and then in layers, with the robot at rest.

    Fingers and blocks keep clear of each other up to twelve blocks.
    """
    n = len(structure.blocks)
    state = PhysicalState(n)
    state.joint_positions[:] = hardware.REST
    layer, place = np.divmod(np.arange(n), COLUMNS * ROWS)
    row, column = np.divmod(place, COLUMNS)
    state.positions[:, 0] = SPACING * (column - (min(n, COLUMNS) - 1) / 2)
    state.positions[:, 1] = 0.09 * row
    state.positions[:, 2] = 0.0325 + LAYER * layer
    return Scene(structure, default_parameters(structure), state)
