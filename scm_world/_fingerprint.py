"""Fingerprints: hashes of everything that decides the results of a system, by name.

Results that come from one system must not be mixed with those of another. A file of results carries
the fingerprint of its system, and the two are compared before rows are added.
"""

from __future__ import annotations

import dis
import functools
import inspect
import re
import site
import sys
import sysconfig
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from hashlib import blake2b
from pathlib import Path, PurePath
from types import (
    BuiltinFunctionType,
    CodeType,
    EllipsisType,
    FunctionType,
    GetSetDescriptorType,
    MemberDescriptorType,
    ModuleType,
    NoneType,
)
from typing import Any

import numpy as np

Fingerprint = dict[str, str]
"""A hash for each part of a system, by its name, and the version of each library that it uses."""

PACKAGE = __name__.partition(".")[0]
_PLAIN = (bool, int, float, complex, str, bytes, NoneType, EllipsisType, range, slice, PurePath)
_SLOTS = MemberDescriptorType | GetSetDescriptorType

_LIBRARIES = (
    *(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    *site.getsitepackages(),
    site.getusersitepackages(),
)
"""Folders of Python and of installed packages."""

_SHORT = 60  # characters of two values, up to which both are shown
_NO_EFFECT = {"CACHE", "EXTENDED_ARG", "NOP", "PRECALL", "RESUME"}


def fingerprint(parts: object, *, libraries: bool = True) -> Fingerprint:
    """Compute a hash of each part of a system: of each value of a dictionary, or of an object.

    The hash of a part is the same in any process in which it has the same values and its functions
    compute the same. For a function of the user's project, its code with the constants, its
    defaults, its closure and the globals that it uses count, with their contents in turn; lines,
    comments and docstrings do not. Functions and classes of installed libraries, and of this
    package, count by name and by the version of the library. An object with a method
    ``__fingerprint__`` counts as its result; other objects count by their attributes.

    ``"version of …"`` follows for each library that is used, unless results are compared bit for
    bit anyhow. After the hash of a part, ``"unread: …"`` names objects in it that cannot be
    compared, such as an open file.

    Example:
        >>> before = fingerprint({"gain": 2.0, "colors": {"red", "blue"}})
        >>> differing(before, fingerprint({"gain": 2.5, "colors": {"blue", "red"}}))
        ['gain']
    """
    found: Fingerprint = {}
    versions: dict[str, str] = {}
    named: Any = getattr(parts, "__fingerprint__", lambda: parts)()
    for name, part in named.items():
        reader = _Reader(versions)
        text = reader.text(part)
        unread = "".join(f" unread: {what}" for what in dict.fromkeys(reader.unread))
        found[name] = _hash([text]) + unread
    met = sorted(versions) if libraries else ()
    return found | {f"version of {name}": versions[name] for name in met}


def differing(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Name the parts in which two fingerprints differ; of libraries with both versions."""
    found = []
    for name in dict.fromkeys((*one, *other)):
        here, there = one.get(name), other.get(name)
        if here != there:
            both = f" ({here or 'none'}, {there or 'none'})" * name.startswith("version of ")
            found.append(name + both)
    return found


def changes(there: Mapping[str, Any], here: Mapping[str, Any], within: str = "") -> list[str]:
    """Name the settings in which two runs differ, with both values, and parts of fingerprints."""
    found = []
    for name in dict.fromkeys((*there, *here)):
        before, now, shown = there.get(name), here.get(name), f"{within}{name}"
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            is_hash = name == "fingerprint"
            found += differing(before, now) if is_hash else changes(before, now, f"{shown}.")
        elif before != now:
            values = f"{before!r} there, {now!r} here"
            found.append(f"{shown} ({values})" if len(values) < _SHORT else shown)
    return list(dict.fromkeys(found))


def digest(parts: Mapping[str, str]) -> str:
    """Return one hash for a fingerprint."""
    text = "\n".join(f"{name}\0{part}" for name, part in parts.items())
    return blake2b(text.encode(), digest_size=16).hexdigest()


def _hash(parts: Iterable[str | memoryview]) -> str:
    found = blake2b(digest_size=12)
    for part in parts:
        data = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        found.update(len(data).to_bytes(8, "little"))
        found.update(data)
    return found.hexdigest()


class _Reader:
    """Computes texts of objects from their parts, and notes the versions of libraries."""

    def __init__(self, libraries: dict[str, str]) -> None:
        self.unread: list[str] = []
        self._libraries = libraries
        # By id, each with the object, so that no other one gets its id.
        self._open: dict[int, tuple[int, Any]] = {}  # with its depth
        self._done: dict[int, tuple[str, Any]] = {}  # with its text

    def text(self, value: object) -> str:
        """Return an object itself if it is plain, else a hash of its parts.

        One object met twice counts like two equal ones.
        """
        if isinstance(value, _PLAIN):
            return f"{type(value).__name__} {value!r}"
        if id(value) in self._open:
            return f"above {self._open[id(value)][0]}"
        if id(value) not in self._done:
            self._open[id(value)] = len(self._open), value
            parts = self._parts(value)
            texts = (one if isinstance(one, memoryview) else self.text(one) for one in parts)
            self._done[id(value)] = _hash(texts), value
            del self._open[id(value)]
        return self._done[id(value)][0]

    def _parts(self, value: object) -> Iterable[Any]:
        own: Mapping[str, Any] = {}
        with suppress(Exception):  # a class may raise anything when it is asked for a name
            own = vars(value)
        cached = isinstance(value, functools._lru_cache_wrapper)
        inner = own.get("__wrapped__" if cached else "py_func")  # the latter is of numba
        match value:
            case _ if isinstance(inner, FunctionType):
                return [inner]
            case list() | tuple() if type(value) in (list, tuple):
                return [type(value).__name__, *value]
            case set() | frozenset():  # which each process has in an order of its own
                return ["set", *sorted(map(self.text, value))]
            case np.ndarray() | np.generic() if not value.dtype.hasobject:
                data = memoryview(np.ascontiguousarray(value).tobytes())
                return ["array", value.dtype.str, value.shape, data]
            case dict() if type(value) is dict:
                return ["dict", *(part for item in value.items() for part in item)]
            case ModuleType():
                return self._name(value.__name__, "")
            case CodeType():
                return _code(value)
            case FunctionType():
                return self._function(value)
            case classmethod() | staticmethod() | property() | functools.cached_property():
                held = ("__func__", "func", "fget", "fset")
                return [type(value).__name__, *(getattr(value, name, None) for name in held)]
            case type():
                return self._class(value)
            case BuiltinFunctionType() | np.ufunc():
                return self._name(getattr(value, "__module__", None) or "builtins", value.__name__)
        return self._object(value)

    def _name(self, module: str, name: str) -> list[Any]:
        """Return the name of a thing of a library, and note the library's version."""
        top = module.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in ("builtins", "__main__"):
            version = getattr(sys.modules.get(top), "__version__", "unknown")
            self._libraries.setdefault(top, str(version))
        return ["named", module, name]

    def _function(self, function: FunctionType) -> list[Any]:
        if not _is_project(function.__module__, function.__code__.co_filename):
            # The closure of a decorator of a library holds the user's function.
            return [*self._name(function.__module__, function.__qualname__), *_cells(function)]
        names = sorted(_names_in(function.__code__))
        parts: list[Any] = [function.__code__, *(_used(one, names) for one in _cells(function))]
        parts += [function.__defaults__, function.__kwdefaults__]
        for name in names:
            if name in function.__globals__:
                parts += [name, _used(function.__globals__[name], names)]
        return parts

    def _class(self, kind: type) -> list[Any]:
        if not _is_project(kind.__module__):
            return self._name(kind.__module__, kind.__qualname__)
        parts = ["class", kind.__qualname__, *kind.__bases__]
        for name, value in sorted(vars(kind).items()):
            # Data that Python and pydantic keep in classes repeat others, or have no effect.
            hidden = name.startswith("__") and not hasattr(value, "__get__")
            if not (hidden or name == "_abc_impl" or isinstance(value, _SLOTS)):
                parts += [name, value]
        return parts

    def _object(self, value: Any) -> list[Any]:
        kind: Any = type(value)
        if hasattr(kind, "__fingerprint__"):
            return [kind, kind.__fingerprint__(value)]
        parts = [kind]
        if isinstance(value, list | tuple):  # such as a named tuple
            parts += iter(value)
        elif isinstance(value, Mapping):
            parts += [part for item in value.items() for part in item]
        top = kind.__module__.partition(".")[0]
        if is_dataclass(value):
            names = [one.name for one in fields(value)]
        elif _has(value, "__dict__") and (_is_project(kind.__module__) or top == PACKAGE):
            slots = (vars(each).get("__slots__", ()) for each in kind.__mro__)
            lists = [(one,) if isinstance(one, str) else one for one in slots]
            names = sorted({*vars(value)}.union(*lists) - _lazy(kind) - {"__dict__"})
        else:
            try:  # its pickle, except for tensors of torch, whose pickles differ
                tensor = hasattr(value, "detach") and hasattr(value, "numpy")
                state = value.detach().cpu().numpy() if tensor else value.__reduce_ex__(4)
            except Exception:  # whatever the class raises
                self.unread.append(f"{kind.__module__}.{kind.__qualname__}")
                return parts
            listed = state if isinstance(state, tuple) else (state,)
            return parts + [list(part) if isinstance(part, Iterator) else part for part in listed]
        there = [name for name in names if _has(value, name)]
        return parts + [part for name in there for part in (name, getattr(value, name))]


def _code(code: CodeType) -> list[Any]:
    """Return the instructions of code, but not its place and its name."""
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
    flags = code.co_flags & (inspect.CO_VARARGS | inspect.CO_VARKEYWORDS)
    parts = ["code", counts, flags, code.co_varnames[: sum(counts)], code.co_exceptiontable]
    for step in dis.get_instructions(code):
        if step.opname not in _NO_EFFECT:
            parts += [step.opname] if step.opname == "MAKE_CELL" else [step.opname, step.argval]
    return parts


def _used(value: object, names: list[str], within: tuple[ModuleType, ...] = ()) -> Any:
    """Return a value; in place of a module of the project, its members of the given names."""
    if not isinstance(value, ModuleType) or value in within or not _is_project(value.__name__):
        return value
    there, inside = vars(value), (*within, value)
    return [_used(there[name], names, inside) for name in names if name in there]


def _cells(function: FunctionType) -> list[Any]:
    """List the contents of a function's closure; an empty cell counts as None."""
    found = []
    for cell in function.__closure__ or ():
        try:
            found.append(cell.cell_contents)
        except ValueError:
            found.append(None)
    return found


def _names_in(code: CodeType) -> set[str]:
    """Return the names that code and the code inside of it look up."""
    inner = [_names_in(part) for part in code.co_consts if isinstance(part, CodeType)]
    return set(code.co_names).union(*inner)


@functools.cache
def _lazy(kind: type) -> frozenset[str]:
    """Return the attributes of a class that are computed when they are first asked for."""
    every = {name: value for each in reversed(kind.__mro__) for name, value in vars(each).items()}
    lazy = functools.cached_property
    return frozenset(name for name, value in every.items() if isinstance(value, lazy))


@functools.cache
def _is_project(module: str | None, file: str | None = None) -> bool:
    """Return whether a module is neither of this package, nor of Python, nor installed."""
    top = (module or "").partition(".")[0]
    if top in ("__main__", "__mp_main__"):
        return True
    if top == PACKAGE or top in sys.builtin_module_names:
        return False
    name = module if module in sys.modules else top
    place = getattr(sys.modules.get(name or ""), "__file__", None) or file
    if place is None or place.startswith("<"):
        return top not in sys.stdlib_module_names
    if place.startswith(_LIBRARIES):
        return False
    folders = Path(place).absolute().parents
    depth = (name or "").count(".") + (Path(place).stem == "__init__")
    return depth >= len(folders) or top not in _distributed(folders[depth])


@functools.cache
def _distributed(folder: Path) -> frozenset[str]:
    """Return the modules that distributions installed in a folder, such as by ``pip --target``."""
    found: set[str] = set()
    for record in folder.glob("*.dist-info/RECORD"):
        with suppress(OSError, ValueError):
            paths = record.read_text(encoding="utf-8").splitlines()
            found.update(re.split(r"[/,.]", path, maxsplit=1)[0] for path in paths)
    return frozenset(found)


def _has(value: object, name: str) -> bool:
    """Return whether an object has an attribute, whatever its class raises for others."""
    try:
        return hasattr(value, name)
    except Exception:
        return False
