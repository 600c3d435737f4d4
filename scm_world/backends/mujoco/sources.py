"""Model files, read into something self-contained that can be compiled anywhere."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final
from xml.etree import ElementTree

import mujoco
import numpy as np

from scm_world.errors import ModelError, UnknownOption, UnreadableFile

_CHOICES = {
    "integrator": mujoco.mjtIntegrator,
    "solver": mujoco.mjtSolver,
    "cone": mujoco.mjtCone,
    "jacobian": mujoco.mjtJacobian,
}
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
            ValueError: MuJoCo refuses it.
        """
        if self.binary:
            mj = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": self.binary})
        else:
            mj = mujoco.MjSpec.from_string(self.text, assets=dict(self.assets)).compile()
        for name, value in self.options:
            setattr(mj.opt, name, type(getattr(mj.opt, name))(value))
        return mj


def read_source(
    source: Any, *, fixed_base: bool, options: Mapping[str, Any]
) -> tuple[Source, str, str]:
    """Read a model.

    Args:
        source: A path, XML text, an ``MjSpec`` or an ``MjModel``.
        fixed_base: Whether the root link of a URDF is fixed to the world.
        options: Options of MJCF that are set to something else.

    Returns:
        The source, a name for the model, and how to call it in errors.

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
        return _sealed("", {}, binary.tobytes(), chosen), name, "the MjModel"
    if isinstance(source, mujoco.MjSpec):
        spec, where = source.copy(), "the MjSpec"
        folder, given = source.modelfiledir, dict(source.assets)
    elif _is_text(source):
        spec, where = _parsed(str(source), None, fixed_base), "the XML text"
        folder, given = "", {}
    elif isinstance(source, str | os.PathLike):
        path = Path(source)
        spec, where = _parsed(_contents(path), path, fixed_base), str(path)
        folder, given = str(path.parent), {}
    else:
        raise ModelError(
            [
                f"{source!r} is no model: give the path of an .xml, .mjcf or .urdf file, XML text, "
                "a mujoco.MjSpec or a mujoco.MjModel"
            ]
        )
    name = spec.modelname or (Path(where).stem if isinstance(source, str | os.PathLike) else "")
    assets = _collected(spec, folder, given, where)
    return _sealed(_written(spec, where), assets, b"", chosen), name, where


def _is_text(source: Any) -> bool:
    return isinstance(source, str) and source.lstrip().startswith("<")


def _contents(path: Path) -> str:
    """Read a model file.

    Raises:
        UnreadableFile: There is none, or it is no text.
    """
    advice = "give the path of an MJCF (.xml, .mjcf) or URDF (.urdf) file, or XML text"
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or f"it is no text ({error})"
        raise UnreadableFile(str(path), reason, advice) from error


def _parsed(text: str, path: Path | None, fixed_base: bool) -> mujoco.MjSpec:
    """Parse MJCF or URDF.

    Raises:
        ModelError: It is neither, or MuJoCo does not understand it.
    """
    where = "the XML text" if path is None else str(path)
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 # only its outermost tags are looked at
    except ElementTree.ParseError as error:
        raise ModelError([f"{where} is not well-formed XML: {error}; correct it there"]) from error
    if root.tag == "robot":
        return _urdf(root, path, fixed_base, where)
    if root.tag != "mujoco":
        raise ModelError([f"{where} begins with <{root.tag}>, not with <mujoco> or <robot>"])
    try:
        if path is not None:
            return mujoco.MjSpec.from_file(str(path))
        return mujoco.MjSpec.from_string(text)
    except (ValueError, mujoco.FatalError) as error:
        raise _refused(where, error) from error


def _refused(where: str, error: Exception) -> ModelError:
    said = " ".join(str(error).split())
    hint = "correct the file"
    if "opening file" in said or "not found" in said.lower():
        hint = "put the file there, or correct the path to it (meshdir, texturedir, include)"
    return ModelError([f"MuJoCo cannot read {where}: {said}; {hint}"])


# --- URDF --------------------------------------------------------------------------------------


def _urdf(
    root: ElementTree.Element, path: Path | None, fixed_base: bool, where: str
) -> mujoco.MjSpec:
    """Parse a URDF with the paths of its meshes relative to the file.

    Inertias that no body can have are balanced, and masses that are missing bounded, as MuJoCo's
    compiler does when it is asked to.
    """
    folder = Path() if path is None else path.parent
    problems = []
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        found = _mesh_path(name, folder)
        if found is None:
            problems.append(
                f"{where} names the mesh {name!r}, which is not there; put it beside the file, or "
                "write its path relative to the file"
            )
        else:
            mesh.set("filename", str(found.resolve()))
    if problems:
        raise ModelError(list(dict.fromkeys(problems)))
    extension = root.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(root, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    compiler.set("strippath", "false")
    for name in ("meshdir", "texturedir"):
        compiler.attrib.pop(name, None)
    compiler.attrib.setdefault("balanceinertia", "true")
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        if not fixed_base:
            for body in spec.worldbody.bodies:  # MuJoCo fixes the root link to the world
                if not body.joints:
                    body.add_freejoint()
        _bound_masses(spec)
    except (ValueError, mujoco.FatalError) as error:
        raise _refused(where, error) from error
    return spec


def _mesh_path(name: str, folder: Path) -> Path | None:
    """Find a mesh: where it is said to be, or below a folder above the file."""
    plain = re.sub(r"^(package|model|file)://", "", name)
    candidates = [folder / plain]
    candidates += [above / plain for above in (folder, *folder.resolve().parents)]
    if plain != name:  # a package is often the folder that the file is in
        inside = Path(*Path(plain).parts[1:])
        candidates += [above / inside for above in (folder, *folder.resolve().parents)]
    candidates.append(folder / Path(plain).name)
    return next((path for path in candidates if path.is_file()), None)


def _bound_masses(spec: mujoco.MjSpec) -> None:
    """Give links without mass a small one, if the model cannot be compiled without."""
    try:
        spec.copy().compile()
    except ValueError as error:
        if "mass and inertia" not in str(error):
            raise
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-6, 1e-9


# --- sealing -----------------------------------------------------------------------------------


def _collected(
    spec: mujoco.MjSpec, folder: str, given: Mapping[str, bytes], where: str
) -> dict[str, bytes]:
    """Read the files that a specification names, and let it name them without folders.

    Raises:
        ModelError: Some are not there.
    """
    found: dict[str, bytes] = {}
    numbers: dict[str, str] = {}
    problems = []

    def keep(name: str, directory: str) -> str:
        if not name:
            return name
        full = os.path.join(folder, directory, name)
        if full not in numbers:
            base = os.path.basename(name)
            numbers[full] = f"{len(numbers)}_{base}"
            content = _content(name, directory, full, given)
            if content is None:
                problems.append(
                    f"{where} names the file {name!r}, which is not at {full!r}; put it there, or "
                    "correct the path (meshdir, texturedir)"
                )
            else:
                found[numbers[full]] = content
        return numbers[full]

    for element, directory in _with_files(spec):
        element.file = keep(element.file, directory)
    for texture in spec.textures:
        files = list(texture.cubefiles)
        if any(files):
            for i, name in enumerate(files):
                texture.cubefiles[i] = keep(name, spec.texturedir)
    if problems:
        raise ModelError(problems)
    spec.meshdir = spec.texturedir = ""
    return found


def _with_files(spec: mujoco.MjSpec) -> Iterator[tuple[Any, str]]:
    """List what may be read from a file, and the folder in which that is."""
    for element in (*spec.meshes, *spec.hfields, *spec.skins):
        yield element, spec.meshdir
    for texture in spec.textures:
        yield texture, spec.texturedir


def _content(name: str, directory: str, full: str, given: Mapping[str, bytes]) -> bytes | None:
    for key in (name, os.path.join(directory, name), os.path.basename(name)):
        if key in given:
            return given[key]
    try:
        return Path(full).read_bytes()
    except OSError:
        return None


def _written(spec: mujoco.MjSpec, where: str) -> str:
    """Write a specification as MJCF that compiles to the same model, to the last bit."""
    if hasattr(spec.compiler, "savecompiled"):
        spec.compiler.savecompiled = False
    try:
        try:
            return str(spec.to_xml())
        except (ValueError, mujoco.FatalError):  # it has to be compiled before it is written
            spec.compile()
            return str(spec.to_xml())
    except (ValueError, mujoco.FatalError) as error:
        raise _refused(where, error) from error


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
            prefix = {"integrator": "mjINT_", "solver": "mjSOL_", "cone": "mjCONE_"}
            words = {
                member.removeprefix(prefix.get(name, "mjJAC_")).lower(): int(kind)
                for member, kind in _CHOICES[name].__members__.items()
            }
            if str(value).lower() not in words:
                raise UnknownOption(name, value, words)
            found.append((name, float(words[str(value).lower()])))
        elif name in _NUMBERS:
            found.append((name, float(value)))
        else:
            raise UnknownOption("setting", name, (*_CHOICES, *_NUMBERS))
    return tuple(found)
