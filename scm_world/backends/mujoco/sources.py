"""Model files, read into something self-contained that can be compiled anywhere."""

from __future__ import annotations

import codecs
import hashlib
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, final
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.trees import Couplings
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.output.reading import read_bytes, regular

_CHOICES = {
    "integrator": mujoco.mjtIntegrator,
    "solver": mujoco.mjtSolver,
    "cone": mujoco.mjtCone,
    "jacobian": mujoco.mjtJacobian,
}
_UNNAMED = "MuJoCo Model"
_NUMBERS = ("timestep", "iterations", "tolerance", "ls_iterations", "noslip_iterations", "impratio")


@final
@dataclass(frozen=True, eq=False)
class Source:
    """What is compiled. It needs no files, and can be pickled.

    Attributes:
        text: MJCF; empty if the model came compiled.
        assets: Contents of the files it names.
        binary: A compiled model (MJB); empty if there is a text. Only the same version of MuJoCo
            reads it.
        options: Options that were asked for instead of those of the file.
        digest: Hash of all of that.
    """

    text: str
    assets: Mapping[str, bytes] = field(repr=False)
    binary: bytes = field(repr=False, default=b"")
    options: tuple[tuple[str, float], ...] = ()
    digest: str = ""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Source) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def compile(self) -> mujoco.MjModel:
        """Compile it, with the options that were asked for.

        Raises:
            ModelError: MuJoCo refuses it.
        """
        with understood("the model"):
            if self.binary:
                mj = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": self.binary})
            else:
                mj = mujoco.MjSpec.from_string(self.text, assets=dict(self.assets)).compile()
        for name, value in self.options:
            setattr(mj.opt, name, type(getattr(mj.opt, name))(value))
        return mj


@lru_cache(maxsize=32)
def realized(source: Source) -> tuple[mujoco.MjModel, tuple[str, ...]]:
    """Compile, and let trees that do not touch leave one another alone to the last bit.

    The causes of leaks, as measured: one solve for all constraints instead of one for each island,
    a warm start that is chosen for all, sleep, the reset of everything after a number that is not
    finite, Euler's implicit damping, which begins for all trees with the first damped joint, and
    the dense inverse inertia of all constraints, which PGS and the noslip solver work with.

    Returns:
        The model, and what is different from the file.
    """
    mj, notes, off = source.compile(), list[str](), mujoco.mjtDisableBit
    options = mj.opt
    options.disableflags |= int(off.mjDSBL_WARMSTART) | int(off.mjDSBL_AUTORESET)
    options.disableflags &= ~int(off.mjDSBL_ISLAND)
    options.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    if len(Couplings(mj).roots) < 2:
        return mj, ()
    damped = not options.disableflags & int(off.mjDSBL_EULERDAMP)
    if options.integrator == int(mujoco.mjtIntegrator.mjINT_EULER) and damped:
        reason = "Euler's implicit damping would tie trees together that do not touch"
        if mj.nflex:  # flexes do not allow for implicitfast
            options.disableflags |= int(off.mjDSBL_EULERDAMP)
            notes.append(f"Joint damping is explicit: {reason}.")
        else:
            options.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
            notes.append(f"The integrator is implicitfast instead of Euler: {reason}.")
    dual = options.solver == int(mujoco.mjtSolver.mjSOL_PGS) or options.noslip_iterations > 0
    if dual and not mujoco.mj_isSparse(mj):
        options.jacobian = int(mujoco.mjtJacobian.mjJAC_SPARSE)
        notes.append(
            "The Jacobian is sparse: PGS and the noslip solver with a dense one would tie trees "
            "together that do not touch."
        )
    return mj, tuple(notes)


def read_source(
    source: Any, *, fixed_base: bool, options: Mapping[str, Any]
) -> tuple[Source, str, str, tuple[str, ...]]:
    """Read a model.

    Args:
        source: A path, XML text, an ``MjSpec`` or an ``MjModel``.
        fixed_base: Whether the root link of a URDF is fixed to the world.
        options: Options of MJCF that are set to something else.

    Returns:
        The source, a name for the model, how to call it in errors, and what its compiler replaces.

    Raises:
        UnreadableFile: A file cannot be read.
        ModelError: It is no such thing, or MuJoCo refuses it.
        UnknownOption: An option is not one.
    """
    chosen = _options(options)
    if isinstance(source, mujoco.MjModel):
        binary = np.empty(mujoco.mj_sizeModel(source), np.uint8)
        mujoco.mj_saveModel(source, None, binary)
        name = source.names.split(b"\0", 1)[0].decode()
        name = "" if name == _UNNAMED else name
        return _sealed("", {}, binary.tobytes(), chosen), name, "the MjModel", ()
    if isinstance(source, mujoco.MjSpec):
        where, folder, stem = "the MjSpec", Path(source.modelfiledir), ""
        spec, urdf = source.copy(), False
    elif isinstance(source, str) and source.lstrip().startswith("<"):
        where, folder, stem = "the XML text", Path(), ""
        spec, urdf = _parsed(source, where), _root_tag(source) == "robot"
    elif isinstance(source, str | os.PathLike):
        path = Path(source)
        where, folder, stem = str(path), path.parent, path.stem
        text = _contents(path)
        spec, urdf = _parsed(text, where, path), _root_tag(text) == "robot"
    else:
        raise ModelError(
            [
                f"{source!r} is no model: give the path of an .xml, .mjcf or .urdf file, XML text, "
                "a mujoco.MjSpec or a mujoco.MjModel"
            ]
        )
    name = stem if spec.modelname in ("", _UNNAMED) else spec.modelname
    for body in spec.worldbody.bodies if urdf and not fixed_base else ():
        if not body.joints:  # MuJoCo fixes the root link of a URDF to the world
            body.add_freejoint()
    whole = spec.copy()
    try:
        files = _located(spec, folder, where)
    except ModelError:
        attached = _compiled_whole(whole)  # parts of other files keep their own folders
        if urdf or attached is None:
            raise
        return read_source(attached, fixed_base=fixed_base, options=options)[0], name, where, ()
    if urdf:
        _repair(spec, where)
        _add_motors(spec)
    notes = tuple(_replaced_inertia(spec, where))
    return _sealed(*_written(spec, files, where), b"", chosen), name, where, notes


def _contents(path: Path) -> str:
    """Read a model file.

    Raises:
        UnreadableFile: There is none, or it is no text.
    """
    advice = "give the path of an MJCF (.xml, .mjcf) or URDF (.urdf) file, or XML text"
    try:
        text = _decoded(read_bytes(path))
    except OSError as error:
        raise UnreadableFile(str(path), (error.strerror or str(error)).lower(), advice) from error
    if "\0" in text.rstrip("\0"):
        raise UnreadableFile(str(path), "it is no text", advice)
    return text


def _decoded(data: bytes) -> str:
    """Decode XML by its byte order mark, or by the encoding that it declares; else as UTF-8.

    Bytes without a meaning become U+FFFD, because they count in names alone.

    Source:
        *Extensible Markup Language (XML) 1.0*, appendix F.
    """
    declared = re.match(rb"\s*<\?xml[^>]*?\bencoding\s*=\s*[\"']([\w.:-]+)", data)
    encoding = declared[1].decode("ascii", "replace") if declared else "utf-8"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif encoding.lower().startswith("utf"):  # what declares UTF-16 in ASCII is not in UTF-16
        encoding = "utf-8-sig"
    try:
        text = data.decode(encoding, "replace")
    except LookupError:  # MuJoCo reads it as UTF-8, too
        text = data.decode("utf-8-sig", "replace")
    return text.replace("\r\n", "\n")


def _root_tag(text: str) -> str:
    """Give the outermost tag of an XML text; ``""`` if there is none."""
    plain = re.sub(r"<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>]*>", "", text, flags=re.DOTALL)
    found = re.search(r"<\s*([\w:.-]+)", plain)
    return found[1] if found else ""


def _parsed(text: str, where: str, path: Path | None = None) -> mujoco.MjSpec:
    """Parse MJCF or URDF.

    Raises:
        ModelError: It is neither, or MuJoCo does not understand it.
    """
    tag = _root_tag(text)
    if tag not in ("mujoco", "robot"):
        raise ModelError(
            [
                f"{where} begins with <{tag}>: give MJCF, which begins with <mujoco>, or URDF, "
                "which begins with <robot>"
            ]
        )
    if tag == "robot":
        _check_names(text, where)
    with understood(where):
        included = _included(text, Path() if path is None else path.parent)
        if path is not None and path.suffix in (".xml", ".urdf") and _is_plain(path, included):
            return mujoco.MjSpec.from_file(str(path))
        texts = {name: _decoded(data).encode() for name, data in included.items()}
        return mujoco.MjSpec.from_string(text, include={} if path is None else texts)


def _check_names(text: str, where: str) -> None:
    """Refuse links and moving joints of a URDF that share a name, which MuJoCo would leave out.

    Raises:
        ModelError: With the names.
    """
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 # expat bounds what entities become
    except ElementTree.ParseError:  # MuJoCo minds less, or says what is wrong
        return
    problems = []
    for kind in ("link", "joint"):
        found = [one.get("name", "") for one in root.findall(kind) if one.get("type") != "fixed"]
        problems += [
            f"{where} has {n} {kind}s called {name!r}; give each a name of its own"
            for name, n in Counter(found).items()
            if name and n > 1
        ]
        if "" in found:
            problems.append(f"{where} has a {kind} without a name; give it one")
    if problems:
        raise ModelError(problems)


def _is_plain(path: Path, included: Mapping[str, bytes]) -> bool:
    """Tell whether a file and those that it includes are in UTF-8, which MuJoCo reads."""
    try:
        for data in (read_bytes(path), *included.values()):
            data.decode()
    except UnicodeDecodeError:
        return False
    return True


def _included(text: str, folder: Path) -> dict[str, bytes]:
    """Read the files that an MJCF text includes, and those that they include.

    Raises:
        UnreadableFile: One cannot be read to its end.
    """
    found: dict[str, bytes] = {}
    texts = [text]
    for one in texts:  # which grows
        for name in re.findall(r"<include\b[^>]*\bfile\s*=\s*[\"']([^\"']+)", one):
            path = folder / name
            if name not in found and path.exists():
                found[name] = _part(path, read_bytes)
                texts.append(_decoded(found[name]))
    return found


def _part(path: Path, read: Callable[[Path], Any]) -> Any:
    """Read a file that a model names, or look whether it can be read.

    Raises:
        UnreadableFile: It is a folder, a device or a pipe, or too large.
    """
    try:
        return read(path)
    except OSError as error:
        advice = "correct the path that the model names"
        raise UnreadableFile(str(path), error.strerror or str(error), advice) from None


@contextmanager
def understood(where: str) -> Iterator[None]:
    """Turn MuJoCo's complaints about a model into one error, and keep its warnings.

    Raises:
        ModelError: With what MuJoCo said.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (ValueError, mujoco.FatalError) as error:
        if isinstance(error, ModelError):
            raise
        said = " ".join(str(error).split())
        lost = "opening file" in said or "decoder" in said
        remedy = "put the file there, or correct the path to it" if lost else "correct the model"
        raise ModelError([f"MuJoCo cannot read {where}: {said}; {remedy}"]) from error


def _compiled_whole(spec: mujoco.MjSpec) -> mujoco.MjModel | None:
    """Compile as MuJoCo itself finds the files; None where it does not."""
    try:
        with understood("it"):
            return spec.compile()
    except ModelError:
        return None


# --- files -------------------------------------------------------------------------------------


def _located(spec: mujoco.MjSpec, folder: Path, where: str) -> dict[str, str]:
    """Find the files that a specification names, and let it name them by absolute paths.

    Returns:
        A short name for each path. Files that a specification was given in memory keep theirs.

    Raises:
        ModelError: Some are not there.
    """
    found: dict[str, str] = {}
    problems = []

    def locate(name: str, directory: str) -> str:
        name = os.path.basename(name) if spec.strippath else name
        inner = os.path.join(directory, name)
        if not name or name in spec.assets or inner in spec.assets:
            return inner if inner in spec.assets else name
        path = _path(name, directory, folder)
        if path is None:
            problems.append(
                f"{where} names the file {name!r}, which is not in {str(folder / directory)!r}; "
                "put it there, or correct the path"
            )
            return name
        full = str(path.resolve())
        found.setdefault(full, f"{len(found)}_{path.name}")
        return full

    for element in (*spec.meshes, *spec.hfields, *spec.skins):
        element.file = locate(element.file, spec.meshdir)
    for texture in spec.textures:
        texture.file = locate(texture.file, spec.texturedir)
        for i, name in enumerate(texture.cubefiles):
            if name:
                texture.cubefiles[i] = locate(name, spec.texturedir)
    if problems:
        raise ModelError(list(dict.fromkeys(problems)))
    spec.meshdir = spec.texturedir = ""
    spec.strippath = False
    return found


def _path(name: str, directory: str, folder: Path) -> Path | None:
    """Find a file; one in a package beside the model, or in a folder above it."""
    plain = re.sub(r"^(package|model|file)://", "", name)
    candidates = [folder / directory / plain]
    if plain != name:
        above = [folder, *folder.resolve().parents]
        inside = Path(*Path(plain).parts[1:])
        candidates += [root / part for part in (plain, inside) for root in above]
    found = next((path for path in candidates if path.exists() and not path.is_dir()), None)
    return found if found is None else _part(found, regular)


def _repair(spec: mujoco.MjSpec, where: str) -> None:
    """Let the compiler balance, then bound the inertias of a URDF, as far as it has to.

    Raises:
        ModelError: MuJoCo does not compile it for another reason.
    """
    for repair in ({"balanceinertia": True}, {"boundmass": 1e-6, "boundinertia": 1e-9}):
        try:
            with understood(where):
                spec.copy().compile()
            return
        except ModelError as error:
            if "inertia" not in str(error):
                raise
        for name, value in repair.items():
            setattr(spec.compiler, name, value)


def _replaced_inertia(spec: mujoco.MjSpec, where: str) -> Iterator[str]:
    """Say which masses and moments of inertia of a file its compiler replaces."""
    compiler = spec.compiler
    if not (compiler.balanceinertia or compiler.boundmass or compiler.boundinertia):
        return
    with understood(where):
        mj = spec.copy().compile()
    masses, moments = list[str](), list[str]()
    for body in spec.bodies[1:]:
        number = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_BODY, body.name)
        if number < 1:
            continue  # it is part of its parent
        if body.mass < mj.body_mass[number] == compiler.boundmass:
            masses.append(f"{body.name} ({body.mass:g}, now {compiler.boundmass:g} kg)")
        if body.explicitinertial:
            given, now = _principal(body), np.sort(mj.body_inertia[number])
            mean = np.full(3, given.mean())
            replaced = any(
                np.allclose(now, one, 1e-9, 0.0) for one in (mean, compiler.boundinertia)
            )
            if replaced and not np.allclose(now, given, 1e-9, 0.0):
                numbers = "{:.3g} {:.3g} {:.3g}, now {:.3g} {:.3g} {:.3g} kg m²"
                moments.append(f"{body.name} ({numbers.format(*given, *now)})")
    for found, why in (
        (masses, "Nothing moves without a mass, so that the compiler gave one to"),
        (moments, "No body has such moments of inertia, so that the compiler replaced those of"),
    ):
        more = f" and {len(found) - 4} more" if len(found) > 4 else ""
        if found:
            yield f"{why} {', '.join(found[:4])}{more}."


def _principal(body: Any) -> Floats:
    """Compute the moments of inertia that a specification gives a body, in ascending order."""
    if np.isnan(body.fullinertia[0]):
        return np.sort(body.inertia)
    xx, yy, zz, xy, xz, yz = body.fullinertia
    return np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))


def _add_motors(spec: mujoco.MjSpec) -> None:
    """Give every hinge and slide of a URDF a motor, as its joints are meant to be driven.

    The control is the torque or force of the joint [N m] or [N], within the effort that the URDF
    allows; it is not limited where there is none. A joint that mimics another one has none.
    """
    mimics = {equality.name1 for equality in spec.equalities}
    for joint in spec.joints:
        driven = joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        if not driven or joint.name in mimics:
            continue
        low, high = joint.actfrcrange
        motor = spec.add_actuator(
            name=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=joint.name,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_NONE,
        )
        motor.gainprm[0] = 1.0
        if low < high:
            motor.ctrllimited, motor.ctrlrange = True, (low, high)


def _written(
    spec: mujoco.MjSpec, files: Mapping[str, str], where: str
) -> tuple[str, dict[str, bytes]]:
    """Write a specification as MJCF that compiles to the same model, to the last bit.

    Returns:
        The text, and the contents of the files it names.
    """
    if hasattr(spec.compiler, "savecompiled"):
        spec.compiler.savecompiled = False
    with understood(where):
        try:
            text = str(spec.to_xml())
        except (ValueError, mujoco.FatalError):  # some have to be compiled before
            spec.compile()
            text = str(spec.to_xml())
    assets = dict(spec.assets)
    for path, name in files.items():
        text = text.replace(f'"{escape(path)}"', f'"{name}"')
        assets[name] = _part(Path(path), read_bytes)
    return text, assets


def _sealed(
    text: str,
    assets: Mapping[str, bytes],
    binary: bytes,
    options: tuple[tuple[str, float], ...],
) -> Source:
    """Hash what is compiled."""
    digest = hashlib.sha256(text.encode())
    for name, content in sorted(assets.items()):
        digest.update(f"\0{name}\0{len(content)}\0".encode())
        digest.update(content)
    digest.update(binary)
    digest.update(repr(options).encode())
    return Source(text, assets, binary, options, digest.hexdigest())


def _options(given: Mapping[str, Any]) -> tuple[tuple[str, float], ...]:
    """Read options: numbers, or the words of MJCF.

    Raises:
        UnknownOption: There is no such option, or no such word.
    """
    found = []
    for name, value in sorted(given.items()):
        if name in _CHOICES:
            words = {
                member.partition("_")[2].lower(): float(int(kind))
                for member, kind in _CHOICES[name].__members__.items()
            }
            if str(value).lower() not in words:
                raise UnknownOption(name, value, words)
            found.append((name, words[str(value).lower()]))
        elif name in _NUMBERS:
            found.append((name, float(value)))
        else:
            raise UnknownOption("setting", name, (*_CHOICES, *_NUMBERS))
    return tuple(found)
