"""The parameters of a compiled model: names, units, bounds, and where each of them is kept.

What may be changed, and what has to follow, is MuJoCo's own table (*Programming, Simulation,
mjModel changes*); every class was tried on foreign models by writing, undoing and comparing all
arrays bit by bit. Since MuJoCo 3.16 ``mj_setConst`` derives the bounds of shapes from their sizes
and places, so that nothing here needs another compilation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache

import mujoco

from scm_world.backends.mujoco.fields.bodies import FRICTIONS, bodies, joints, shapes
from scm_world.backends.mujoco.fields.drives import (
    actuators,
    control_unit,
    equalities,
    servo,
    tendon_unit,
    tendons,
)
from scm_world.backends.mujoco.fields.rows import (
    FREE,
    HINGE,
    OFF,
    SLIDE,
    Field,
    Scope,
    Slots,
    clean,
    element_names,
    least,
)
from scm_world.backends.mujoco.slots import Slot, place
from scm_world.backends.mujoco.slots import option as option_slot
from scm_world.backends.mujoco.trees import Couplings, Effect
from scm_world.models.scene import ParameterKey

MEDIUM = ("density", "viscosity")
"""Options that make a medium act, and wind with it."""


@lru_cache(maxsize=32)
def table(mj: mujoco.MjModel, *, fluid: bool = False) -> tuple[Field, ...]:
    """List the parameters of a compiled model, each with its own name.

    Where two elements have the same name and attribute, the usual one keeps the plain name; if
    none or both are usual, both are distinguished by their kind: ``"geom:torso.color"``. So is what
    has the name of a state.

    Args:
        mj: The model, which must not be changed afterwards.
        fluid: Whether a medium may be made to act although it does not now.
    """
    fluid = fluid or mj.opt.density > 0.0 or mj.opt.viscosity > 0.0
    scope = Scope(mj, element_names(mj), Couplings(mj, fluid), fluid)
    parts = bodies, joints, shapes, tendons, equalities, actuators, options
    found = [field for part in parts for field in part(scope)]
    claims: dict[str, list[Field]] = {}
    for field in found:
        claims.setdefault(field.plain_name, []).append(field)
    states = _state_names(mj, scope.names)
    named = []
    for field in found:
        usual = [rival for rival in claims[field.plain_name] if rival.usual and not rival.refusal]
        alone = len(claims[field.plain_name]) == 1 or (len(usual) == 1 and usual[0] is field)
        plain = alone and field.plain_name not in states
        named.append(
            replace(field, name=field.plain_name if plain else f"{field.kind}:{field.plain_name}")
        )
    return tuple(named)


def _state_names(mj: mujoco.MjModel, names: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Name the states that have an attribute in common with parameters."""
    found = set()
    for joint, kind in enumerate(mj.jnt_type.tolist()):
        name, body = names["joint"][joint], names["body"][int(mj.jnt_bodyid[joint])]
        if kind in (SLIDE, HINGE):
            found.add(f"{name}.position")
        else:
            found.add(f"{body if kind == FREE else name}.orientation")
    return found


def options(scope: Scope) -> Iterator[Field]:
    """List the options that are parameters: they act on everything."""
    mj, trees = scope.mj, scope.trees

    def everything() -> Effect:
        return trees.always(trees.every)

    def option(name: str) -> Slots:
        return lambda mj, _: option_slot(mj.opt, name)

    yield Field(
        "option", "", "gravity", "m/s^2", "Acceleration that acts on every mass.",
        lambda mj, _: place(mj.opt.gravity), everything,
        refusal=scope.off(OFF.mjDSBL_GRAVITY, "gravity"),
    )  # fmt: skip
    yield Field(
        "option", "", "timestep", "s", "Physics step; a control step has a fixed number of them.",
        option("timestep"), everything, least(mj.opt.timestep),
    )  # fmt: skip
    yield Field(
        "option", "", "wind", "m/s", "Velocity of the medium.",
        lambda mj, _: place(mj.opt.wind), everything,
        refusal="" if scope.fluid else "acts on nothing: density and viscosity are zero",
    )  # fmt: skip
    for name, unit in (("density", "kg/m^3"), ("viscosity", "Pa s")):
        doc = f"The {name} of the medium."
        usual = scope.fluid
        yield Field("option", "", name, unit, doc, option(name), everything, 0.0, usual=usual)
    yield Field(
        "option", "", "impratio", "1", "Stiffness of friction in relation to that of contact.",
        option("impratio"), lambda: trees.touching(trees.every), least(mj.opt.impratio),
        usual=False,
    )  # fmt: skip


def slots(
    compiled: mujoco.MjModel,
    keys: Iterable[ParameterKey],
    mj: mujoco.MjModel,
    data: mujoco.MjData,
) -> dict[ParameterKey, Slot]:
    """Find the places of some parameters in a model.

    What is written there with ``constant`` slots takes effect with ``mj_setConst``.

    Args:
        compiled: What was compiled; it is not written.
        keys: Of the parameters.
        mj: A copy of it.
        data: Where the copy is stepped.
    """
    wanted = frozenset(keys)
    return {
        field.key: field.slot(mj, data)
        for field in table(compiled)
        if field.key in wanted and field.slot is not None
    }


__all__ = [
    "FRICTIONS",
    "MEDIUM",
    "Field",
    "clean",
    "control_unit",
    "element_names",
    "servo",
    "slots",
    "table",
    "tendon_unit",
]
