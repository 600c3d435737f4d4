"""Model files, read and compiled into bytes that need no files."""

from __future__ import annotations

import copy
import hashlib
import mmap
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, final
from weakref import WeakValueDictionary
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.costs import Costs, tags
from scm_world.backends.mujoco.fields import BALL, FREE, HINGE, SLIDE, element_names
from scm_world.backends.mujoco.scratch import silent
from scm_world.backends.mujoco.trees import Couplings
from scm_world.errors import ModelError, ScmWorldError, UnknownOption, UnreadableFile, some
from scm_world.runs.files import read_bytes

_UNNAMED = "MuJoCo Model"
_CHOICES = ("integrator", "solver", "cone", "jacobian")
FEW, MANY, MANY_LS = 50, 100, 50
"""Below so many iterations, a solver depends on where it begins; MuJoCo's usual numbers."""
LEAST = 1e-300
"""Damping that changes no number, for each unit of squared velocity."""
_NUMBERS = ("timestep", "iterations", "tolerance", "ls_iterations", "noslip_iterations", "impratio")


@final
@dataclass(frozen=True)
class Source:
    """A compiled model with the options that were asked for. It needs no files.

    Equal sources of one process are one object, so that worlds share its models.

    Attributes:
        whole: The model of the file, which nobody changes; pictures show it.
        head: What ``mj_saveModel`` writes (MJB) before the arrays.
        content: Hash of all that it writes.
        settings: Those of ``realized``: ``"exact"``, or ``"file"`` with the warm start of the file.
        drop: Features of ``DROPPED`` that ``realized`` leaves out.
        effort: How hard its solver works; see ``strain``.
    """

    whole: mujoco.MjModel = field(repr=False, compare=False)
    head: bytes = field(repr=False, compare=False)
    content: str
    settings: Literal["exact", "file"] = "exact"
    drop: tuple[str, ...] = ()
    effort: int = 0

    @cached_property
    def digest(self) -> str:
        """Hash of the model and of its options."""
        own = " ".join((self.settings.removeprefix("exact"), *self.drop, "+" * self.effort)).strip()
        return hashlib.sha256(f"{self.content} {own}".encode()).hexdigest()

    def __deepcopy__(self, memo: object) -> Source:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        saved = bytes_of(self.whole).tobytes()
        return _opened, (mujoco.__version__, saved, self.settings, self.drop, self.effort)

    def lean(self) -> mujoco.MjModel:
        """Copy the model of the file without what only pictures have."""
        return _lean(self.whole, self.head)

    @cached_property
    def realized(self) -> mujoco.MjModel:
        """The model without pictures, with settings under which trees do not tie one another.

        Trees that do not touch leave one another alone to the last bit. The causes of leaks, as
        measured: one solve for all constraints instead of one for each island, a warm start that is
        chosen for all, sleep, the reset of everything after a number that is not finite, and the
        dense inverse inertia of all constraints, which PGS and the noslip solver work with. Euler's
        implicit damping begins for all trees with the first damped joint: one has damping that
        changes no number. Without a warm start a solver needs more iterations than files give it
        that count on one.
        """
        mj, off = self.lean(), mujoco.mjtDisableBit
        options = mj.opt
        for feature in self.drop:
            _leave_out(mj, feature)
        options.disableflags |= int(off.mjDSBL_AUTORESET)
        options.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        if self.settings == "file":
            return mj
        if not options.disableflags & int(off.mjDSBL_WARMSTART) and options.iterations < FEW:
            options.iterations = MANY
            options.ls_iterations = max(options.ls_iterations, MANY_LS)
        strain(options, self.effort)
        options.disableflags |= int(off.mjDSBL_WARMSTART)
        options.disableflags &= ~int(off.mjDSBL_ISLAND)
        if len(Couplings(mj).roots) < 2:
            return mj
        mj.dof_dampingpoly[0, 0] = max(mj.dof_dampingpoly[0, 0], LEAST)
        dual = options.solver == int(mujoco.mjtSolver.mjSOL_PGS) or options.noslip_iterations > 0
        if dual and not mujoco.mj_isSparse(mj):
            options.jacobian = int(mujoco.mjtJacobian.mjJAC_SPARSE)
        return mj


_SOURCES: WeakValueDictionary[tuple[Any, ...], Source] = WeakValueDictionary()
"""The sources of this process, by their content and options."""


Asked = tuple[Literal["exact", "file"], tuple[str, ...], int]
"""Settings, features that are dropped, and effort of a source."""


def _sealed(mj: mujoco.MjModel, saved: NDArray[np.uint8], *asked: *Asked) -> Source:
    """Return the source of a model and its MJB: the one that there is, if there is one."""
    key = hashlib.sha256(saved.data).hexdigest(), *asked
    found = _SOURCES.get(key)
    if found is None:
        fields = mj._all_fields[len(mj._size_fields) :]
        arrays = (getattr(mj, name) for name in fields)
        size = sum(len(one) if type(one) is bytes else one.nbytes for one in arrays)
        found = _SOURCES[key] = Source(mj, saved[: len(saved) - size].tobytes(), *key)
    return found


def _opened(version: str, saved: bytes, *asked: *Asked) -> Source:
    """Return a source that was pickled."""
    if version != mujoco.__version__:
        versions = f"{version}, and MuJoCo {mujoco.__version__} does not read it"
        raise ModelError([f"the model was compiled by MuJoCo {versions}; read its file again"])
    mj = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": saved})
    return _sealed(mj, np.frombuffer(saved, np.uint8), *asked)


EFFORTS = 2
"""The highest effort of a solver."""


def strain(options: mujoco.MjOption, effort: int) -> None:
    """Raise the effort of a solver: 1 meets its tolerance, 2 ends when hardly anything improves."""
    if effort > 0:
        options.iterations = max(options.iterations, 10 * MANY)
        options.ls_iterations = max(options.ls_iterations, MANY_LS)
    if effort > 1:
        options.tolerance = min(options.tolerance, 1e-15)


def bytes_of(mj: mujoco.MjModel) -> NDArray[np.uint8]:
    """Return what ``mj_saveModel`` writes."""
    room = mmap.mmap(-1, mujoco.mj_sizeModel(mj))  # goes back to the system, not to the heap
    saved = np.frombuffer(room, np.uint8)
    mujoco.mj_saveModel(mj, None, saved)
    return saved


_SURFACES = ("RANGEFINDER", "TACTILE", "GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "INSIDESITE")
"""Sensors of surfaces, of those that touch nothing, too."""


def _lean(mj: mujoco.MjModel, head: bytes) -> mujoco.MjModel:
    """Copy a model without what only pictures and rays need; all else is the same, to the bit.

    That are pixels, and of meshes faces, normals, texture coordinates and bounding volumes, and
    vertices and hulls where a mesh collides with nothing: mostly 90 to 99 % of a robot. An MJB is
    five numbers, the sizes, the options and the arrays, in the order of MuJoCo's bindings; where it
    is not, everything is copied. Source: MuJoCo, ``mj_saveModel``.
    """
    fields: tuple[str, ...] = mj._size_fields  # there is no public list
    sizes = {name: int(getattr(mj, name)) for name in fields}
    values = {name: getattr(mj, name) for name in mj._all_fields[len(sizes) :]}
    arrays = {n: np.frombuffer(v, np.uint8) if type(v) is bytes else v for n, v in values.items()}
    before = {**arrays}

    def cut(which: str, size: str, rows: slice | NDArray[np.bool_]) -> None:
        for name in which.split():
            arrays[name] = arrays[name][rows]
            sizes[size] = len(arrays[name])

    def length(parts: Iterable[NDArray[Any]]) -> int:
        found = 0
        for part in parts:
            found += -found % 64 + part.nbytes  # each begins at a multiple of 64 bytes
        return found

    cut("tex_data", "ntexdata", slice(0))
    for name in ("tex_adr", "tex_height", "tex_width"):
        arrays[name] = np.zeros_like(arrays[name])
    kinds, geoms = mujoco.mjtSensor.__members__, mujoco.mjtGeom
    sensors = [int(kinds[f"mjSENS_{name}"]) for name in _SURFACES if f"mjSENS_{name}" in kinds]
    surfaces = np.isin(mj.sensor_type, sensors).any() or (mj.geom_type == geoms.mjGEOM_SDF).any()
    if mj.nmesh and not surfaces and not mj.nflex:
        touches = (mj.geom_contype != 0) | (mj.geom_conaffinity != 0)
        touches[mj.pair_geom1] = touches[mj.pair_geom2] = True
        collides = np.zeros(mj.nmesh, dtype=np.bool_)
        collides[mj.geom_dataid[touches & (mj.geom_type == geoms.mjGEOM_MESH)]] = True
        for part, names, kept in (
            ("vert", "mesh_vert mesh_polymapadr mesh_polymapnum", collides),
            ("normal", "mesh_normal", ~collides & False),
            ("texcoord", "mesh_texcoord", ~collides & False),
            ("face", "mesh_face mesh_facenormal mesh_facetexcoord", ~collides & False),
            ("poly", "mesh_polynormal mesh_polyvertadr mesh_polyvertnum", collides),
        ):
            first, count = arrays[f"mesh_{part}adr"], arrays[f"mesh_{part}num"]
            rows = np.zeros(sizes[f"nmesh{part}"], dtype=np.bool_)
            for mesh in np.flatnonzero(kept):
                rows[first[mesh] : first[mesh] + count[mesh]] = True
            cut(names, f"nmesh{part}", rows)
            count = arrays[f"mesh_{part}num"] = np.where(kept, count, 0).astype(np.int32)
            arrays[f"mesh_{part}adr"] = (np.cumsum(count) - count).astype(np.int32)
        for name in ("mesh_texcoordadr", "mesh_bvhadr"):
            arrays[name] = np.full_like(arrays[name], -1)
        arrays["mesh_graphadr"] = np.where(collides, arrays["mesh_graphadr"], -1).astype(np.int32)
        bodies = int((mj.body_bvhadr + mj.body_bvhnum).max())  # theirs come first
        cut("bvh_depth bvh_child bvh_nodeid", "nbvh", slice(bodies))
        cut("bvh_aabb", "nbvhstatic", slice(bodies))
        arrays["mesh_bvhnum"] = np.zeros_like(arrays["mesh_bvhnum"])
    sizes["nbuffer"] += length(arrays.values()) - length(before.values())
    numbers = np.array([*sizes.values()], dtype=np.int64).tobytes()
    parts = (np.ascontiguousarray(part).tobytes() for part in arrays.values())
    saved = b"".join((head[:20], numbers, head[20 + len(numbers) :], *parts))
    try:
        found = mujoco.MjModel.from_binary_path("lean.mjb", {"lean.mjb": saved})
    except ValueError:
        return copy.copy(mj)
    same = (
        getattr(found, n) == values[n]
        if type(values[n]) is bytes
        else np.array_equal(getattr(found, n), part)
        for n, part in arrays.items()
    )
    return found if all(same) else copy.copy(mj)


_ODD = [int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("ELLIPSOID", "HFIELD", "SDF")]
DROPPED: Mapping[str, tuple[tuple[str, str, Callable[[mujoco.MjModel], Any]], ...]] = {
    "armature": (
        ("joint", "dof_armature", lambda mj: slice(None)),
        ("actuator", "actuator_armature", lambda mj: slice(None)),
        ("tendon", "tendon_armature", lambda mj: slice(None)),
    ),
    "frictionloss": (
        ("joint", "dof_frictionloss", lambda mj: np.isin(mj.jnt_type[mj.dof_jntid], (FREE, BALL))),
        ("tendon", "tendon_frictionloss", lambda mj: slice(None)),
    ),
    "limits": (
        ("joint", "jnt_limited", lambda mj: np.isin(mj.jnt_type, (FREE, BALL))),
        ("tendon", "tendon_limited", lambda mj: slice(None)),
    ),
    "equalities": (("equality", "eq_active0", lambda mj: slice(None)),),
    "shapes": (
        ("geom", "geom_contype", lambda mj: np.isin(mj.geom_type, _ODD)),
        ("geom", "geom_conaffinity", lambda mj: np.isin(mj.geom_type, _ODD)),
    ),
    "surfaces": (
        ("geom", "geom_adhesion", lambda mj: slice(None)),
        ("geom", "geom_surfacevel", lambda mj: slice(None)),
    ),
}
"""Features that a model can be read without: kinds, arrays that become 0, and where in them.

All that Bullet cannot honour is among them, but for adhesion, pairs, mocap bodies and flexes.
"""


def _leave_out(mj: mujoco.MjModel, feature: str) -> list[str]:
    """Leave a feature out of a model; return the names of the elements that had it."""
    had, names = dict[str, None](), element_names.__wrapped__(mj)
    for kind, array, where in DROPPED[feature]:
        values = getattr(mj, array)
        mask = np.zeros(len(values), dtype=np.bool_)
        mask[where(mj)] = True
        mask &= (values != 0).any(axis=tuple(range(1, values.ndim)))
        owners = mj.dof_jntid[mask] if array.startswith("dof_") else np.flatnonzero(mask)
        had |= dict.fromkeys(names[kind][int(owner)] for owner in owners)
        values[mask] = 0
    if had:
        mujoco.mj_setConst(mj, mujoco.MjData(mj))
    return [*had]


def read_source(
    source: Any,
    *,
    fixed_base: bool,
    options: Mapping[str, Any],
    exact: bool = True,
    keyframe: str | int | None = None,
    self_collision: bool = True,
    ground: bool = False,
    drop: Iterable[str] = (),
) -> tuple[Source, str, str, tuple[str, ...]]:
    """Read and compile a model; see ``reading.read_model``.

    The result is the source, a name, how to call it in errors, and notes.
    """
    notes, plugins = tuple[str, ...](), ""
    if isinstance(source, mujoco.MjModel):
        where, stem, mj = "the MjModel", "", copy.copy(source)
        for option, asked in (("self_collision", not self_collision), ("ground", ground)):
            if asked:
                allowed = ("left out: an MjModel is compiled; give its file or its MjSpec",)
                raise UnknownOption("option of a compiled model", option, allowed)
    else:
        spec, where, stem, urdf, warned = _specified(source)
        if urdf:
            _complete(spec, where, fixed_base=fixed_base)
        with understood(where) as more:
            mj = spec.compile()
            warned |= more
            notes = *(f"MuJoCo warns: {text}." for text in warned), *_replaced_inertia(spec, mj)
            if ground:
                notes += (_add_ground(spec, mj, start_of(mj, keyframe)),)
            if not self_collision:
                notes += (_exclude_own(spec, mj, urdf),)
            if ground or not self_collision:
                mj = spec.compile()
            notes += tuple(_strong_motors(mj, start_of(mj, keyframe))) if urdf else ()
        plugins = f" ({', '.join(sorted({plugin.plugin_name for plugin in spec.plugins}))})"
    with understood(where):
        mj.names.decode()  # names in included files that are not UTF-8
    if mj.nplugin:
        what = f"{where} uses {mj.nplugin} plugin(s){plugins}"
        raise ModelError([f"{what}: their targets are unknown; remove them"])
    for option, value in options.items():
        _set_option(mj.opt, option, value)
    name = mj.names.split(b"\0", 1)[0].decode()
    name = stem if name in ("", _UNNAMED) else name
    left = tuple(sorted({drop} if isinstance(drop, str) else {*drop}))
    sealed = _sealed(mj, bytes_of(mj), "exact" if exact else "file", left, 0)
    for feature in left:
        if feature not in DROPPED:
            raise UnknownOption("drop", feature, DROPPED)
        had = _leave_out(sealed.lean(), feature)
        notes += (f"drop={feature!r} leaves that out of: {', '.join(had) or 'nothing'}.",)
    return sealed, name, where, notes


def start_of(mj: mujoco.MjModel, keyframe: str | int | None) -> mujoco.MjData:
    """Return the state in which episodes begin."""
    data = mujoco.MjData(mj)
    if keyframe is not None:
        names = keyframes(mj)
        by_name = {str(i): i for i in range(mj.nkey)} | {name: i for i, name in enumerate(names)}
        if str(keyframe) not in by_name:
            allowed = names or ("none, because the file has no keyframe",)
            raise UnknownOption("keyframe", keyframe, allowed)
        mujoco.mj_resetDataKeyframe(mj, data, by_name[str(keyframe)])
    return data


def keyframes(mj: mujoco.MjModel) -> tuple[str, ...]:
    """Name the keyframes; one without a name has its number."""
    return tuple(mj.key(i).name or str(i) for i in range(mj.nkey))


def _add_ground(spec: mujoco.MjSpec, mj: mujoco.MjModel, start: mujoco.MjData) -> str:
    """Add a plane at z = 0, or below all that moves and collides in the start pose."""
    if spec.geom("ground") is not None:
        raise UnknownOption("ground", True, ("False: the file has a geom of that name",))
    plane = spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0),
        contype=2**31 - 1, conaffinity=2**31 - 1,
    )  # fmt: skip
    below = 1e3  # [m], where it is for the measurement
    plane.pos = (0.0, 0.0, -below)
    trial = spec.compile()
    number, data = trial.geom("ground").id, mujoco.MjData(trial)
    data.qpos[:], data.mocap_pos[:] = start.qpos, start.mocap_pos
    data.mocap_quat[:] = start.mocap_quat
    mujoco.mj_kinematics(trial, data)
    meets = np.flatnonzero(Couplings(trial).touches[number]).tolist()
    heights = (mujoco.mj_geomDistance(trial, data, number, g, 9.0 * below, None) for g in meets)
    plane.pos = (0.0, 0.0, min([0.0, *(height - below for height in heights)]))
    return f"The file has no plane called 'ground'; one is added at z = {plane.pos[2]:.4g} m."


def _exclude_own(spec: mujoco.MjSpec, mj: mujoco.MjModel, urdf: bool) -> str:
    """Leave out contacts between bodies of one kinematic tree, and declared pairs of them.

    All of a URDF is one robot: MuJoCo makes its fixed base a part of the world, and each branch a
    tree.
    """
    bodies = {body.id: body for body in spec.bodies}
    for number, name in enumerate(element_names.__wrapped__(mj)["body"]):
        bodies[number].name = bodies[number].name or name
    shapes = np.argwhere(np.triu(Couplings(mj).touches))
    pairs = {tuple(sorted(pair)) for pair in mj.geom_bodyid[shapes].tolist()}
    if urdf:
        own = pairs
        for geom in spec.geoms:  # they still touch a ground, whose contype has all bits
            geom.contype = geom.contype if geom.name == "ground" else 0
    else:
        own = {pair for pair in pairs if len(set(mj.body_rootid[[*pair]].tolist())) == 1}
        for one, other in sorted(own):
            spec.add_exclude(bodyname1=bodies[one].name, bodyname2=bodies[other].name)
    ends = mj.geom_bodyid[np.stack([mj.pair_geom1, mj.pair_geom2], axis=1)].tolist()
    for pair in [pair for pair in spec.pairs if tuple(sorted(ends[pair.id])) in own]:
        spec.delete(pair)
    return f"self_collision=False leaves out contacts of {len(own)} pairs of bodies of one tree."


def _set_option(options: mujoco.MjOption, name: str, value: float | str) -> None:
    """Set an option to a number, or to a word of MJCF."""
    if name not in (*_CHOICES, *_NUMBERS):
        raise UnknownOption("setting", name, (*_CHOICES, *_NUMBERS))
    if name in _CHOICES:
        members = getattr(mujoco, f"mjt{name.capitalize()}").__members__.items()
        words = {member.partition("_")[2].lower(): int(kind) for member, kind in members}
        if str(value).lower() not in words:
            raise UnknownOption(name, value, words)
        value = words[str(value).lower()]
    setattr(options, name, type(getattr(options, name))(float(value)))


def _specified(source: object) -> tuple[mujoco.MjSpec, str, str, bool, dict[str, None]]:
    """Return a specification, how to call it, the stem of its file, and whether it is a URDF.

    The last part are MuJoCo's warnings.
    """
    if isinstance(source, mujoco.MjSpec):
        return source.copy(), "the MjSpec", "", False, {}
    path = Path()
    if isinstance(source, str) and source.lstrip().startswith("<"):
        where, text = "the XML text", source
        costs = Costs(where, path)
    elif isinstance(source, str | os.PathLike):
        path = Path(source)
        costs = Costs(str(path), path.parent)
        if path.is_file():
            costs.regular(path, "")
        where, text = str(path), _contents(path)
    else:
        kinds = "an .xml, .mjcf or .urdf file, XML text, a mujoco.MjSpec or a mujoco.MjModel"
        raise ModelError([f"{source!r} is not a model: give the path of {kinds}"])
    tag = next(tags(text), ("",))[0]
    if tag not in ("mujoco", "robot"):
        kinds = "MJCF, which begins with <mujoco>, or URDF, which begins with <robot>"
        raise ModelError([f"{where} begins with <{tag}>: give {kinds}"])
    costs.check(text)
    if tag == "robot":
        _check_names(text, where)
    with understood(where) as warned:
        if path.name:  # MuJoCo finds what it includes, and knows the kind of a file by its name
            name = str(path.with_suffix(".xml"))
            spec = mujoco.MjSpec.from_file(name, include={name: text.encode()})
        else:
            spec = mujoco.MjSpec.from_string(text)
    return spec, where, path.stem, tag == "robot", warned


def _contents(path: Path) -> str:
    """Read a model file as UTF-8, as MuJoCo does; other bytes become U+FFFD, and count in names."""
    advice = "give the path of an MJCF (.xml, .mjcf) or URDF (.urdf) file in UTF-8, or XML text"
    try:
        text = read_bytes(path).decode("utf-8-sig", "replace").rstrip("\0")
    except OSError as error:
        raise UnreadableFile(str(path), (error.strerror or str(error)).lower(), advice) from error
    if "\0" in text:
        raise UnreadableFile(str(path), "it is not text", advice)
    return text.replace("\r\n", "\n")


@contextmanager
def understood(where: str) -> Iterator[dict[str, None]]:
    """Turn MuJoCo's complaints about a model into one error; collect its warnings unprinted."""
    said, printed = dict[str, None](), mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: said.setdefault(" ".join(text.split())))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield said
    except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
        if isinstance(error, ScmWorldError):
            raise
        what = " ".join(str(error).split())
        remedy = "correct the model"
        if "opening file" in what:
            remedy = "put the file there, or correct the path to it"
        elif "memory" in what or "unknown exception" in what:
            remedy = "it asks for more memory than there is: correct the sizes in it"
        elif "decoder" in what:
            remedy = "convert it to .stl, .obj or .msh, the meshes that MuJoCo reads"
        raise ModelError([f"MuJoCo cannot read {where}: {what}; {remedy}"]) from error
    finally:
        mujoco.set_mju_user_warning(printed)


# --- URDF --------------------------------------------------------------------------------------


def _complete(spec: mujoco.MjSpec, where: str, *, fixed_base: bool) -> None:
    """Add to a URDF what MuJoCo leaves out: a free root, files of packages, motors, repairs."""
    for body in () if fixed_base else spec.worldbody.bodies:
        if not body.joints:  # MuJoCo fixes the root link to the world
            body.add_freejoint()
    for mesh in spec.meshes:
        path = _packaged(mesh.file, Path(spec.modelfiledir)) if "://" in mesh.file else None
        if path is not None:
            mesh.file = str(path)
    spec.compiler.balanceinertia = True
    try:
        with understood(where):
            spec.copy().compile()
    except ModelError as error:
        if "inertia" not in str(error):
            raise
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9
    _add_motors(spec)


def _packaged(name: str, folder: Path) -> Path | None:
    """Find a file in a package beside the model, or in a folder above it."""
    plain = Path(re.sub(r"^\w+://", "", name))
    above = (folder, *folder.resolve().parents)
    candidates = (root / part for part in (plain, Path(*plain.parts[1:])) for root in above)
    return next((path for path in candidates if path.is_file()), None)


def _check_names(text: str, where: str) -> None:
    """Refuse links and moving joints of a URDF that share a name, which MuJoCo would leave out."""
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 # expat bounds what entities become
    except ElementTree.ParseError:  # MuJoCo accepts more, or says which line is wrong
        return
    parts = [(part.tag, part.get("name")) for part in root if part.get("type") != "fixed"]
    problems = [
        f"{where} has {n} {kind}s called {name!r}; give each its own name"
        for (kind, name), n in Counter(parts).items()
        if kind in ("link", "joint") and (n > 1 or not name)
    ]
    if problems:
        raise ModelError(problems)


def _replaced_inertia(spec: mujoco.MjSpec, mj: mujoco.MjModel) -> Iterator[str]:
    """List which masses [kg] and moments of inertia [kg m²] of a file its compiler replaces."""
    compiler, found = spec.compiler, list[str]()
    for body in spec.bodies[1:] if compiler.balanceinertia or compiler.boundmass else ():
        number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_BODY, body.name)
        mass, now = body.mass, float(mj.body_mass[number])
        if number < 1 or now not in (mass, compiler.boundmass):
            continue  # it is part of its parent, or has the mass of its shapes or of its parts
        given, moments = np.sort(body.inertia), np.sort(mj.body_inertia[number])
        if not np.isnan(body.fullinertia[0]):
            xx, yy, zz, xy, xz, yz = body.fullinertia
            given = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        if now != mass or (body.explicitinertial and not np.allclose(moments, given, 1e-9, 0.0)):
            old, new = (
                "{:.3g}; {:.3g} {:.3g} {:.3g}".format(*n) for n in ((mass, *given), (now, *moments))
            )
            found.append(f"{body.name} ({old}, now {new})")
    if found:
        yield (
            "No body has such a mass or such moments of inertia, so that the compiler replaced "
            f"those [kg; kg m²] of {some(found)}."
        )


def _add_motors(spec: mujoco.MjSpec) -> None:
    """Add a motor for every hinge and slide of a URDF that does not mimic another one.

    The control is the torque or force of the joint [N m] or [N], within the effort that the URDF
    allows; it is not limited where there is none.
    """
    mimics = {equality.name1 for equality in spec.equalities}
    for joint in spec.joints:
        if joint.type not in (HINGE, SLIDE) or joint.name in mimics:
            continue
        low, high = joint.actfrcrange
        motor = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_motor()
        if low < high:
            motor.ctrllimited, motor.ctrlrange = True, (low, high)


VIOLENT = {HINGE: (5e3, "N m", "rad/s²"), SLIDE: (5e2, "N", "m/s²")}
"""Largest acceleration that a motor should give, which leads to 100 rad/s or 10 m/s in 0.02 s."""
GENTLE = 0.2  # of that, for a proposed limit


def _strong_motors(mj: mujoco.MjModel, start: mujoco.MjData) -> Iterator[str]:
    """List the motors of a URDF whose limits accelerate their joints violently at the start pose.

    An acceleration is the difference that the command at its limit makes to that without commands,
    with contacts and constraints.
    """
    data, found = silent(copy.copy(start)), list[tuple[float, str, str]]()

    def accelerations(**commands: float) -> Floats:
        data.ctrl[:] = 0.0
        for name, command in commands.items():
            data.actuator(name).ctrl[0] = command
        data.qacc_warmstart[:] = 0.0
        mujoco.mj_forward(mj, data)
        found: Floats = data.qacc.copy()
        return found

    rest = accelerations()
    for motor in np.flatnonzero(mj.actuator_ctrllimited).tolist():
        name, joint = mj.actuator(motor).name, int(mj.actuator_trnid[motor, 0])
        ends = mj.actuator_ctrlrange[motor].tolist()
        least, force, unit = VIOLENT[int(mj.jnt_type[joint])]
        dof = mj.jnt_dofadr[joint]
        sizes = [float(abs(accelerations(**{name: end})[dof] - rest[dof])) for end in ends]
        limit, size = max(map(abs, ends)), max(sizes)  # one of them may press on a limit
        if size > least:
            bound = float(f"{limit * GENTLE * least / size:.2g}")
            text = f"{name} (effort {limit:g} {force}: {size:.2g} {unit})"
            option = f"{{'{name}.control': {{'bounds': (-{bound:g}, {bound:g})}}}}"
            found.append((size / least, text, option))
    if found:
        found.sort(reverse=True)
        texts = some([text for _, text, _ in found])
        yield (
            f"At the start pose the efforts of the URDF accelerate {texts}, so that random "
            "commands can lead to speeds far beyond those of a robot: limit the commands, such as "
            f"spaces={found[0][2]}, or give rotors their inertia, armature."
        )
