"""Declarations of several kinds, to which a program can add kinds of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

from pydantic_core import core_schema

from scm_world.errors import ModelError
from scm_world.variables.mechanisms import Function
from scm_world.variables.spaces import Frozen


def _kind_of(declared: type[Frozen]) -> str | None:
    field = getattr(declared, "__pydantic_fields__", {}).get("kind")
    return field.default if field is not None and isinstance(field.default, str) else None


class OpenKinds(Frozen):
    """A base class of declarations. A subclass with a ``kind`` of its own is a kind.

    A field or a file that has a declaration of the base class takes every kind whose class has
    been defined or imported.
    """

    kinds: ClassVar[dict[str, type[Any]]]

    @classmethod
    def __pydantic_init_subclass__(cls, **_: object) -> None:
        """Make a kind known by its name."""
        if (kind := _kind_of(cls)) is None:
            return
        known = cls.kinds.setdefault(kind, cls)
        if known.__qualname__ != cls.__qualname__:  # else it was defined again, as in a notebook
            raise ModelError(
                [f"{cls.__name__}: {known.__name__} has the kind {kind!r} already: choose another"]
            )
        cls.kinds[kind] = cls

    @classmethod
    def __get_pydantic_core_schema__(cls, source: object, handler: object) -> Any:
        """Return the schema of a kind; that of the base class takes every one."""
        if _kind_of(cls) is not None:
            return super().__get_pydantic_core_schema__(source, handler)
        any_kind = core_schema.simple_ser_schema("any")
        return core_schema.no_info_plain_validator_function(cls._read, serialization=any_kind)

    @classmethod
    def _read(cls, given: object) -> object:
        """Return a declaration, or read it from plain data."""
        if isinstance(given, cls):
            return given
        kind = given.get("kind") if isinstance(given, Mapping) else None
        found = cls.kinds.get(kind) if isinstance(kind, str) else None
        if found is None:
            known = ", ".join(map(repr, cls.kinds))
            said = "import the module that defines it first" if isinstance(kind, str) else "give it"
            raise ValueError(f"the kind {kind!r} is not known; {said}; there are {known}")
        return found.model_validate(given)

    def functions(self) -> Iterator[Function]:
        """Yield the Python functions of the declaration."""
        for name in type(self).model_fields:
            if isinstance(value := getattr(self, name), Function):
                yield value
