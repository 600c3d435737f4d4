"""Parameters of shapes, of declared pairs of them, and of sites."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import mujoco

from scm_world.backends.mujoco.fields.rows import (
    OFF,
    Field,
    Scope,
    Slots,
    at,
    least,
    solver_rows,
    turn_at,
)
from scm_world.backends.mujoco.slots import Color
from scm_world.backends.mujoco.trees import NOTHING, Effect

_GEOM = mujoco.mjtGeom
_SIZES = {
    int(_GEOM.mjGEOM_SPHERE): (1, "Radius"),
    int(_GEOM.mjGEOM_CAPSULE): (2, "Radius, and half length of the cylinder part,"),
    int(_GEOM.mjGEOM_CYLINDER): (2, "Radius and half length"),
    int(_GEOM.mjGEOM_ELLIPSOID): (3, "Radii along the axes"),
    int(_GEOM.mjGEOM_BOX): (3, "Half edge lengths"),
}
_FRICTIONS = (
    ("friction", 3, "1", "Coefficient of sliding friction; a contact has the larger of two."),
    ("torsional_friction", 4, "m", "Coefficient of friction against turning on a spot."),
    ("rolling_friction", 6, "m", "Coefficient of friction against rolling."),
)
_SHOWN = 3
"""MuJoCo draws the first groups of shapes unless it is asked for others."""


def shapes(scope: Scope) -> Iterator[Field]:
    """List the fields of all shapes, pairs and sites."""
    for geom in range(scope.mj.ngeom):
        yield from _contact(scope, geom)
        yield from _form(scope, geom)
    for pair in range(scope.mj.npair):
        yield from _pair(scope, pair)
    for site in range(scope.mj.nsite):
        yield from _pose("site", site, scope.rows("site", site, _site(scope, site)))


def _site(scope: Scope, site: int) -> Callable[[], Effect]:
    return lambda: scope.trees.site(site)


def _pose(kind: str, index: int, row: Callable[..., Field]) -> Iterator[Field]:
    what = {"geom": "shape"}.get(kind, kind)
    yield row(
        "position", "m", f"Place of the {what} in the frame of its body.",
        at(f"{kind}_pos", index, constant=True), usual=False,
    )  # fmt: skip
    yield row(
        "orientation", "1", f"Orientation of the {what} in the frame of its body.",
        turn_at(f"{kind}_quat", index), low=-1.0, high=1.0, nature="rotation", usual=False,
    )  # fmt: skip


def _contact(scope: Scope, geom: int) -> Iterator[Field]:
    """Give how a shape behaves in contact."""
    mj, condim = scope.mj, scope.trees.highest_condim(geom)
    row = scope.rows("geom", geom, lambda: scope.trees.contact_of(geom))
    alone = "" if condim else "acts on nothing: the shape touches nothing"
    for column, (attribute, needed, unit, doc) in enumerate(_FRICTIONS):
        low = f"acts on nothing: its contacts have a condim below {needed}"
        yield row(
            attribute, unit, doc, at("geom_friction", geom, column), low=0.0,
            refusal=alone or (low if condim < needed else ""),
        )  # fmt: skip
    margin, adhesion = float(mj.geom_margin[geom]), bool(mj.geom_adhesion[geom])
    moving = bool(mj.geom_surfacevel[geom].any())
    for attribute, unit, minimum, usual, doc in (
        ("margin", "m", min(0.0, margin), margin != 0.0, "How far around it contacts act."),
        ("gap", "m", 0.0, False, "How much further contacts are found without acting."),
        ("adhesion", "N", 0.0, adhesion, "Force with which its contacts hold on."),
    ):
        yield row(
            attribute, unit, doc, at(f"geom_{attribute}", geom, constant=True), low=minimum,
            usual=usual, refusal=alone,
        )  # fmt: skip
    yield row(
        "surfacevel", "1", "Velocity of its surface in its frame: linear [m/s], angular [rad/s].",
        at("geom_surfacevel", geom, constant=True), usual=moving, refusal=alone,
    )  # fmt: skip
    yield row(
        "solmix", "1", "Weight of this shape when the solref of a contact is mixed.",
        at("geom_solmix", geom), low=0.0, usual=False, refusal=alone,
    )  # fmt: skip
    yield from solver_rows(row, mj, "geom", geom, usual=False, refusal=alone)


def _form(scope: Scope, geom: int) -> Iterator[Field]:
    """Give the size, color and place of a shape."""
    mj, kind = scope.mj, int(scope.mj.geom_type[geom])
    row = scope.rows("geom", geom, lambda: scope.trees.shape(geom))
    word = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
    if kind in _SIZES:
        used, what = _SIZES[kind]
        index = (geom, 0) if used == 1 else (geom, slice(used))
        acts = any(scope.trees.shape(geom))
        yield row(
            "size", "m", f"{what} of the {word}; mass and inertia stay as they are.",
            at("geom_size", *index, constant=True), low=least(mj.geom_size[index]), usual=acts,
            visual=not acts,
        )  # fmt: skip
    else:
        reason = f"is that of a {word}: only another file can change it"
        yield row("size", "m", "", None, refusal=reason)
    yield row(
        "color", "1", "Red, green, blue and opacity of the shape.",
        _color(geom, int(mj.geom_matid[geom])), effect=lambda: NOTHING, low=0.0, high=1.0,
        usual=mj.geom_group[geom] < _SHOWN, visual=True,
    )  # fmt: skip
    yield from _pose("geom", geom, row)
    for attribute in ("contype", "conaffinity", "condim", "type"):
        reason = "is a whole number that only another file can change"
        yield row(attribute, "1", "", None, refusal=reason)


def _color(geom: int, material: int) -> Slots:
    return lambda mj, _: Color(mj.geom_rgba[geom], mj.mat_rgba[material] if material >= 0 else None)


def _pair(scope: Scope, pair: int) -> Iterator[Field]:
    row = scope.rows("pair", pair, lambda: scope.trees.pair(pair))
    off = scope.off(OFF.mjDSBL_CONTACT, "contact")
    yield row(
        "friction", "1", "Friction of the pair: sliding (2), torsional [m] and rolling [m] (2).",
        at("pair_friction", pair), low=0.0, refusal=off,
    )  # fmt: skip
    for attribute in ("margin", "gap"):
        low = min(0.0, float(getattr(scope.mj, f"pair_{attribute}")[pair]))
        yield row(
            attribute, "m", f"The {attribute} of contacts of the pair.",
            at(f"pair_{attribute}", pair, constant=True), low=low, usual=False, refusal=off,
        )  # fmt: skip
    yield from solver_rows(row, scope.mj, "pair", pair, usual=False, refusal=off)
