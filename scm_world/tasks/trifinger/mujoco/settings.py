"""What a preset means to MuJoCo.

Stock settings cannot lift a block with three fingers, let it creep on a slope and make a fast one
hover. A softer friction reference for contacts without fingers, elliptic cones and a high
``impratio`` mend all three. Fingers keep the hard reference: they have to grip.

Source:
    Measured; see the parity table in ``docs/design``.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from scm_world.tasks.trifinger.presets import Preset


@dataclass(frozen=True)
class Settings:
    """Numbers of one preset.

    Attributes:
        contact: Time constant [s] and damping ratio of contacts.
        sliding: The same for friction between blocks, floor and stage.
        impratio: Stiffness of friction over stiffness of the normal.
    """

    contact: tuple[float, float]
    sliding: tuple[float, float]
    impratio: float = 100.0


_SETTINGS = {
    "fast": Settings((0.010, 1.0), (0.04, 1.0)),
    "precise": Settings((0.004, 1.0), (0.02, 1.0)),
}


def settings(preset: Preset) -> Settings:
    """Look up what a preset means."""
    return _SETTINGS[preset.name]


MANY = 8
"""From more blocks than this on, the Jacobian of the constraints is a sparse matrix."""


def write_options(spec: mujoco.MjSpec, preset: Preset, n_blocks: int) -> None:
    """Write everything that concerns the whole simulation."""
    chosen = settings(preset)
    option = spec.option
    option.timestep = preset.timestep
    # The only one besides Euler in which bodies that do not touch are solved apart, to the last
    # digit; ``discrete`` scales by the masses of all of them.
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.impratio = chosen.impratio
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # MuJoCo 4.0.0 factors the Hessian wrongly where the Jacobian is sparse (#3767). The price of a
    # dense one: its sums are grouped by the numbers of the degrees of freedom, so one block more
    # changes the last digits of the others. Parameters of what does not touch still do nothing.
    # With many blocks it is 17 times faster in a built wall; there, in 48 states, accelerations
    # differed by less than 1e-6 from those of a dense one, as much as either did from the truth.
    sparse, dense = mujoco.mjtJacobian.mjJAC_SPARSE, mujoco.mjtJacobian.mjJAC_DENSE
    option.jacobian = sparse if n_blocks > MANY else dense
    # A simulation that explodes must say so instead of starting again. A warm start is accepted
    # or rejected for all islands together, so that bodies that do not touch would act on each
    # other's last digits; without it, a step is a function of positions, velocities and command
    # alone, and a parameter of what does not touch does exactly nothing.
    off = mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    option.disableflags = int(off)
    option.enableflags = 0  # sleeping islands, in particular, cannot be restored exactly
