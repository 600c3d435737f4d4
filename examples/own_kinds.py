"""A kind of intervention and a kind of variable of one's own: each is one class.

Run it with ``python examples/own_kinds.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
from functools import cached_property
from typing import Any, Literal, final

import numpy as np

import scm_world as sw
from scm_world.variables import Function, Moment, Soft, Variable

PENDULUM = """
<mujoco>
  <worldbody>
    <body name="pole"><joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 .5" size=".02" mass=".1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="hinge" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


@final
class Clip(Soft):
    """Keep a variable within limits: a draw of nature, a mechanism or a given value."""

    kind: Literal["clip"] = "clip"  # the name of the kind, in files
    low: float
    high: float

    def __init__(self, low: float, high: float, **fields: Any) -> None:
        super().__init__(low=low, high=high, **fields)  # ``fields`` has the time

    def moved(self, value: np.ndarray, variable: Variable, at: Moment) -> np.ndarray:
        """Return what it makes of the value that the variable would have."""
        return np.clip(value, self.low, self.high)


def played(drive: np.ndarray, before: np.ndarray, *, half: float) -> np.ndarray:
    """Compute the output of a gear with play: it moves once the slack is taken up."""
    return np.clip(before, drive - half, drive + half)


@final
class Backlash(Variable):
    """The output of a gear with play, which remembers where it was one control step ago."""

    kind: Literal["backlash"] = "backlash"
    drive: str  # the name of the input
    width: float

    @property
    def all_parents(self) -> tuple[sw.Parent, ...]:
        """The causes: the input now, and the output of the control step before."""
        return sw.Parent(self.drive), sw.Parent(self.name, 1)

    @cached_property
    def equation(self) -> Function:
        """The function of these causes, in this order."""
        return Function(played, constants={"half": 0.5 * self.width})


def main(backend: str = "mujoco") -> None:
    """Use both in equations and in a world."""
    gear = Backlash(name="gear", drive="hinge.position", unit="rad", width=0.2)
    nature = {"pole.mass": sw.Draw(0.05, 0.2)}
    world = sw.World(PENDULUM, backend=backend, outcomes=[gear], control_dt=0.05).given(nature)
    limited = world.rollout("random", seed=1, do={"pole.mass": Clip(0.1, 0.12)})
    print(f"mass {float(limited['pole.mass'][-1]):.3f} kg within the limits")


if __name__ == "__main__":
    main(*sys.argv[1:2])
