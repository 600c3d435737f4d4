"""The stage: gravity, floor and ring wall; light and cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from scm_world.geometry.rotations import from_rotation_vector, to_rotation_vector
from scm_world.models import Light
from scm_world.models.camera import Camera
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.cameras import CAMERAS, POSES
from scm_world.tasks.trifinger.hardware import PRESETS, SPINNING_FRICTION
from scm_world.variables import Box, Variable
from scm_world.variables.reserved import PRESET, SENSOR_NOISE


def stage(preset: str) -> Entity:
    """Describe what the robot and the blocks stand in, with the settings that a preset names."""
    frictions = (
        numbers.FRICTION.root(
            f"{surface}_friction",
            numbers.SURFACE_FRICTION,
            f"Friction of {what}; a contact has the product of two frictions.",
        )
        for surface, what in (("floor", "the table"), ("stage", "the ring wall"))
    )
    variables = (
        numbers.GRAVITIES.root("gravity", (0.0, 0.0, -9.81)),
        *frictions,
        numbers.COLOR.root("floor_color", (0.31, 0.27, 0.25)),
        numbers.COLOR.root("stage_color", (0.95, 0.95, 0.95)),
        numbers.RESTITUTION.root("restitution", 0.0),
        numbers.SPINNING.root("spinning_friction", SPINNING_FRICTION),
        numbers.PRESETS.root(PRESET, [*PRESETS].index(preset)),
        numbers.NOISE.root(
            SENSOR_NOISE,
            0.0,
            "Standard deviation of every observed number, as a fraction of half its range.",
        ),
    )
    return Entity("stage", variables)


_DEFAULT = Light()
_NEAR, _FAR = 0.01, 0.03  # [m] how far a camera is moved in A and in B
_TURN = 0.02  # [rad] how far it is turned in A, about each axis


def light_and_cameras() -> Entity:
    """Describe where the light comes from, how bright shade is, and the three cameras."""
    light = (
        numbers.Range(
            Box((-1.0, -1.0, 0.05), (1.0, 1.0, 1.0)),
            Box((0.0, -1.0, 0.5), (1.0, 0.0, 1.0)),
            Box((-1.0, 0.0, 0.5), (0.0, 1.0, 1.0)),
            shape=(3,),
        ).root(
            "light_direction",
            _DEFAULT.direction,
            "Direction towards the light, of any length; only pictures depend on it.",
        ),
        numbers.Range(Box(0.0, 1.0), Box(0.2, 0.4), Box(0.4, 0.7)).root(
            "light_ambient",
            _DEFAULT.ambient,
            "Brightness of what the light does not reach; only pictures depend on it.",
        ),
    )
    cameras = (variable for camera in CAMERAS for variable in _camera(camera))
    return Entity("looks", (*light, *cameras))


def _camera(camera: Camera) -> Iterable[Variable]:
    """Declare the pose of a camera, and its opening angle; A and B are near the usual ones."""
    name = f"camera_{camera.name}"
    position, orientation = (pose.tolist() for pose in POSES[camera.name])
    x, y, z = position
    a = Box((x - _NEAR, y - _NEAR, z - _NEAR), (x + _NEAR, y + _NEAR, z + _NEAR))
    b = Box((x - _NEAR, y - _NEAR, z + _NEAR), (x + _NEAR, y + _NEAR, z + _FAR))
    yield numbers.Range(Box(-2.0, 2.0), a, b, "m", (3,)).root(
        f"{name}.position",
        tuple(position),
        "Where the camera stands; only pictures depend on it.",
    )
    yield numbers.ORIENTATIONS.root(
        f"{name}.orientation",
        tuple(orientation),
        "Quaternion (x, y, z, w) of its axes right, down and forward.",
    )
    usual = to_rotation_vector(orientation)
    low, high = usual - _TURN, usual + _TURN
    far_low, far_high = (*low[:2], high[2]), (*high[:2], usual[2] + 3.0 * _TURN)
    a, b = Box(tuple(low), tuple(high)), Box(far_low, far_high)
    yield replace(numbers.YAWS, a=a, b=b).derived(
        f"{name}.euler_orientation",
        (to_rotation_vector, f"{name}.orientation"),
        inverse=from_rotation_vector,
    )
    yield numbers.Range(Box(5.0, 150.0), Box(50.0, 54.0), Box(54.0, 60.0), "deg").root(
        f"{name}.field_of_view",
        camera.field_of_view,
        "Vertical opening angle; only pictures depend on it.",
    )
