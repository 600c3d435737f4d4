"""The stage: gravity, floor and ring wall."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import final

from scm_world.models import ParameterKey
from scm_world.tasks.composition import Entity
from scm_world.tasks.trifinger import catalogue as numbers
from scm_world.tasks.trifinger.entities.blocks import color
from scm_world.tasks.trifinger.hardware import PRESET_NAMES
from scm_world.variables import Categories, Exogenous, Variable
from scm_world.variables.reserved import PRESET, SENSOR_NOISE


@final
class Stage(Entity):
    """What the robot and the blocks stand in.

    Args:
        preset: Numerical settings at the start: ``"fast"`` or ``"precise"``.
    """

    name = "stage"

    def __init__(self, preset: str = "fast") -> None:
        self._preset = preset

    def variables(self) -> Iterable[Variable]:
        """Declare gravity, frictions and colors."""
        yield Exogenous(
            name="gravity",
            unit="m/s^2",
            shape=(3,),
            bounds=numbers.GRAVITY_BOUNDS,
            a=numbers.GRAVITY_A,
            b=numbers.GRAVITY_B,
            default=numbers.GRAVITY,
            doc="Acceleration of free fall; it pulls the fingers too.",
        )
        for surface, what in (("floor", "the table"), ("stage", "the ring wall")):
            yield Exogenous(
                name=f"{surface}_friction",
                bounds=numbers.FRICTION_BOUNDS,
                a=numbers.FRICTION_A,
                b=numbers.FRICTION_B,
                default=numbers.SURFACE_FRICTION,
                doc=f"Friction of {what}; a contact has the product of two frictions.",
            )
        yield color("floor_color", numbers.FLOOR_COLOR)
        yield color("stage_color", numbers.STAGE_COLOR)
        yield from self._hidden()

    def _hidden(self) -> Iterable[Variable]:
        """Declare what the predecessor keeps to itself."""
        yield Exogenous(
            name="restitution",
            bounds=numbers.RESTITUTION_BOUNDS,
            a=numbers.RESTITUTION_A,
            b=numbers.RESTITUTION_B,
            default=0.0,
            doc="Speed after a head-on impact over speed before it, for every contact.",
        )
        yield Exogenous(
            name="spinning_friction",
            unit="m",
            bounds=numbers.SPINNING_BOUNDS,
            a=numbers.SPINNING_A,
            b=numbers.SPINNING_B,
            default=numbers.SPINNING_FRICTION,
            doc="Friction of every contact against turning about its normal.",
        )
        yield Exogenous(
            name=PRESET,
            dtype="categorical",
            bounds=numbers.PRESET_BOUNDS,
            a=Categories((0,)),
            b=Categories((1,)),
            default=PRESET_NAMES.index(self._preset),
            doc="How finely time is cut: 0 is fast (4 ms), 1 is precise (2 ms).",
        )
        yield Exogenous(
            name=SENSOR_NOISE,
            bounds=numbers.NOISE_BOUNDS,
            a=numbers.NOISE_A,
            b=numbers.NOISE_B,
            default=0.0,
            doc="Standard deviation of every observed number, as a fraction of half its range.",
        )

    def inputs(self) -> Iterable[str]:
        """Gravity, frictions, restitution and the time step."""
        yield from ("gravity", "floor_friction", "stage_friction")
        yield from ("restitution", "spinning_friction", PRESET)

    def parameters(self) -> Mapping[str, ParameterKey]:
        """Say which variable sets which physical parameter."""
        return {
            "gravity": ("world", "gravity"),
            "floor_friction": ("floor", "friction"),
            "stage_friction": ("stage", "friction"),
            "floor_color": ("floor", "color"),
            "stage_color": ("stage", "color"),
            "restitution": ("world", "restitution"),
            "spinning_friction": ("world", "spinning_friction"),
        }
