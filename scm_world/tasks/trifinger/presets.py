"""How finely time is cut, and how hard contacts are."""

from __future__ import annotations

from dataclasses import dataclass

from scm_world.errors import UnknownOption


@dataclass(frozen=True)
class Preset:
    """Numerical settings that every engine understands in its own way.

    Attributes:
        name: ``"fast"`` or ``"precise"``.
        timestep: Physics step [s].
    """

    name: str
    timestep: float


FAST = Preset("fast", 0.004)
PRECISE = Preset("precise", 0.002)

PRESETS = {preset.name: preset for preset in (FAST, PRECISE)}

PRESET_NAMES = tuple(PRESETS)
"""What the categories of ``timestep_preset`` stand for."""


def preset(name: str) -> Preset:
    """Look a preset up by its name.

    Raises:
        UnknownOption: There is no such preset.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise UnknownOption("preset", name, PRESETS) from None
