"""Mechanisms put together with their arguments, so that a control step evaluates them quickly."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from inspect import signature
from operator import is_, itemgetter
from typing import Any, final

import numpy as np

from scm_world._types import Floats, Value
from scm_world.geometry.gather import gather_into, places
from scm_world.graph import SCM
from scm_world.variables import Measured
from scm_world.variables.mechanisms import Stacked

Now = dict[str, Value]

_Step = tuple[str, Callable[..., Any], tuple[Any, ...] | None, tuple[str, ...], tuple[Any, ...]]
"""A variable, its function, its arguments; or None, names of arguments, and constants."""


@final
class Bound:
    """Some mechanisms in causal order, with their arguments.

    A state is a view of the vector that physics writes, and a parameter the same object until an
    intervention: arguments like these are looked up once. Only what is computed is looked up in
    every step.

    Args:
        model: That declares the mechanisms.
        now: Present values.
        names: What is computed, causes before effects.
    """

    def __init__(self, model: SCM, now: Now, names: Iterable[str]) -> None:
        self._model, self._now = model, now
        self._names = tuple(names)
        parents = {p.name for name in self._names for p in model.declared(name).all_parents}
        parents -= set(self._names)
        self._kept = tuple(name for name in parents if _is_kept(model, name))
        self._pick = itemgetter(*self._kept) if len(self._kept) > 1 else self._kept_list
        self._known: Any = ()
        self._steps: tuple[_Step, ...] = ()

    def _kept_list(self, now: Now) -> tuple[Value, ...]:
        return tuple(now[name] for name in self._kept)

    def check(self) -> None:
        """Look arguments up again if one of them is another object."""
        found = self._pick(self._now)
        if not (self._steps and all(map(is_, found, self._known))):
            self.renew()

    def renew(self) -> None:
        """Look all arguments up again."""
        self._known = self._pick(self._now)
        self._steps = tuple(self._step(name) for name in self._names)

    def run(self) -> None:
        """Compute everything, into the present values."""
        now = self._now
        for name, function, given, keys, constants in self._steps:
            if given is None:
                given = (*[now[key] for key in keys], *constants)
            now[name] = function(*given)

    def _step(self, name: str) -> _Step:
        variable: Any = self._model.declared(name)
        parents = variable.all_parents
        function, constants = positional(variable.mechanism.bind(), len(parents))
        keys = tuple(p.name if p.lag == 0 else earlier(p.name) for p in parents)
        lasting = {*self._kept, *(earlier(p.name) for p in parents)}
        if isinstance(function, Stacked):
            return name, _Stack(function, self._now, keys, lasting, constants), (), (), ()
        if lasting.issuperset(keys):
            return name, function, (*[self._now[key] for key in keys], *constants), (), ()
        return name, function, None, keys, constants


@final
class _Stack:
    """The parents of a stacked function, collected into one vector.

    Args:
        function: The function.
        now: Present values.
        keys: Of the parents.
        lasting: Those that stay the same object.
        constants: What else the function is given.
    """

    def __init__(
        self,
        function: Stacked,
        now: Now,
        keys: tuple[str, ...],
        lasting: set[str],
        constants: tuple[Any, ...],
    ) -> None:
        self._kernel, self._now, self._constants = function.kernel, now, constants
        ends = np.cumsum([np.size(now[key]) for key in keys]).tolist()
        where = {
            key: slice(end - np.size(now[key]), end) for key, end in zip(keys, ends, strict=True)
        }
        self._numbers = np.concatenate([np.ravel(now[key]).astype(float) for key in keys])
        moving = [key for key in keys if key in lasting and now[key].base is not None]
