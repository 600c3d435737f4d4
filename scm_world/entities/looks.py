"""How pictures look: the light. Nothing physical depends on it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import final

from scm_world._types import Values
from scm_world.entities.base import Entity
from scm_world.scene import Light
from scm_world.variables import Box, Exogenous, Variable

_DEFAULT = Light()


@final
class Looks(Entity):
    """The light."""

    name = "looks"

    def variables(self) -> Iterable[Variable]:
        """Declare where the light comes from and how bright shade is."""
        yield Exogenous(
            name="light_direction",
            shape=(3,),
            bounds=Box((-1.0, -1.0, 0.05), (1.0, 1.0, 1.0)),
            a=Box((0.0, -1.0, 0.5), (1.0, 0.0, 1.0)),
            b=Box((-1.0, 0.0, 0.5), (0.0, 1.0, 1.0)),
            default=_DEFAULT.direction,
            doc="Direction towards the light, of any length; only pictures depend on it.",
        )
        yield Exogenous(
            name="light_ambient",
            bounds=Box(0.0, 1.0),
            a=Box(0.3, 0.6),
            b=Box(0.6, 0.9),
            default=_DEFAULT.ambient,
            doc="Brightness of what the light does not reach; only pictures depend on it.",
        )

    def light(self, values: Values) -> Light:
        """Describe the light."""
        x, y, z = values["light_direction"].tolist()
        return Light((x, y, z), float(values["light_ambient"]))
