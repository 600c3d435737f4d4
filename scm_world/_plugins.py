"""Tasks, models, learners and backends that installed packages declare by entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar, final

from scm_world.errors import EngineError, MissingExtra, ModelError, in_one_line

Made = TypeVar("Made")


@cache
def declared(group: str) -> Mapping[str, tuple[tuple[str, EntryPoint], ...]]:
    """Return the entry points of the group ``scm_world.GROUP`` by name, with their packages."""
    found = dict[str, tuple[tuple[str, EntryPoint], ...]]()
    for entry in entry_points(group=f"scm_world.{group}"):
        package = entry.dist.name if entry.dist else "without a name"
        found[entry.name] = (*found.get(entry.name, ()), (package, entry))
    return found


@final
class Plugins(Mapping[str, Made]):
    """What is known by name: first ``known``, then what installed packages declare.

    The module of a package is imported when its name is looked up, not when names are listed.

    Args:
        group: The last part of the name of the group.
        known: What needs no entry point.
        check: ``check(name, loaded)`` returns the entry, or raises what is wrong with it.
    """

    def __init__(
        self, group: str, known: Mapping[str, Made], check: Callable[[str, Any], Made]
    ) -> None:
        self.group, self.known, self._check = group, known, check

    def __getitem__(self, name: str) -> Made:
        """Return an entry.

        Raises:
            KeyError: Nothing has this name.
            ModelError: It cannot be loaded, is not what the group holds, or two packages have it.
            EngineError: The engine that it needs is not installed.
            MissingExtra: A library that it needs is not installed.
        """
        if name in self.known:
            return self.known[name]
        (package, entry), *others = declared(self.group)[name]
        if others:
            both = " and ".join((package, *(other for other, _ in others)))
            raise ModelError([f"{self.group}: {both} declare {name!r}; uninstall all but one"])
        try:
            return self._check(name, entry.load())
        except (EngineError, MissingExtra):
            raise
        except Exception as error:
            where = f"the package {package!r} declares {name!r} in scm_world.{self.group}"
            said = f"{where}, but {entry.value!r} fails: {in_one_line(error)}"
            raise ModelError([said]) from error

    def __contains__(self, name: object) -> bool:
        """Return whether something has this name; nothing is imported."""
        return name in self.known or name in declared(self.group)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(dict.fromkeys((*self.known, *declared(self.group))))

    def __len__(self) -> int:
        """Return the number of names."""
        return len({*self.known, *declared(self.group)})

    def described(self, describe: Callable[[Made], str]) -> dict[str, str]:
        """Return a sentence about each entry: what is wrong with it, if it cannot be loaded."""
        found, known = dict[str, str](), {*self.known}
        for name in self:
            try:
                found[name] = describe(self[name])
            except (ModelError, EngineError, MissingExtra) as error:
                found[name] = f"not available: {error}"
            packages = ", ".join(package for package, _ in declared(self.group).get(name, ()))
            ignored = ", which is not used: the name was taken" if name in known else ""
            found[name] += f" (package {packages}{ignored})" if packages else ""
        return found
