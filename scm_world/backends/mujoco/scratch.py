"""Models and data to compute on, in which no state is kept; they end with their structure."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar
from weakref import ReferenceType, ref

import mujoco

from scm_world.models.model import Model

T = TypeVar("T")

KEPT = 64
"""How many there are at most in a process."""

_RECENT: OrderedDict[tuple[int, Any], ReferenceType[Any]] = OrderedDict()


def scratch(owner: object, kind: object, make: Callable[[], T]) -> T:
    """Return what is computed on for a structure, made once for each thread.

    Args:
        owner: The structure, which keeps it.
        kind: What it is for.
        make: Makes it.
    """
    mine, key = vars(owner).setdefault("_scratch", {}), (kind, threading.get_ident())
    if key not in mine:
        mine[key] = make()
    found: T = mine[key]
    place = id(owner), key
    _RECENT[place] = ref(owner)
    _RECENT.move_to_end(place)
    while len(_RECENT) > KEPT:
        (_, oldest), least = _RECENT.popitem(last=False)
        alive = least()
        if alive is not None:
            vars(alive).get("_scratch", {}).pop(oldest, None)
    return found


def kept(function: Callable[[Any], T]) -> Callable[[Any], T]:
    """Return a function of a model whose results end with the source of the model."""

    @wraps(function)
    def found(model: Model) -> T:
        known: dict[Any, T] = vars(model.source).setdefault(f"_{function.__name__}", {})
        if model not in known:
            known[model] = function(model)  # in two threads at once, both find the same
        return known[model]

    return found


def silent(data: mujoco.MjData) -> mujoco.MjData:
    """Suppress warnings of MuJoCo about data: it prints the first one of each kind."""
    data.warning.number[:] = 1
    return data


def forget(owner: object) -> None:
    """Drop all that a structure has to compute on."""
    vars(owner).pop("_scratch", None)
