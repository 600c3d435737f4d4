"""The physics engines, behind one interface. None of them is imported before it is used."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from typing import Any, TypeVar

import numpy as np

from scm_world._arguments import enter, one_of, typed
from scm_world._plugins import Plugins
from scm_world.backends.base import (
    ROUNDING,
    Backend,
    BackendWrapper,
    Capabilities,
    ContactPoint,
    EngineSnapshot,
    OneScene,
    Scenes,
    SeparateScenes,
)
from scm_world.errors import (
    InexactEngine,
    MissingEngine,
    ModelError,
    ScmWorldError,
    UnknownOption,
)
from scm_world.models import Model, Structure

_CLASSES = {
    "mujoco": ("MujocoBackend", "mujoco>=3.17,<5"),
    "bullet": ("BulletBackend", "pybullet==3.2.7"),
    "warp": ("WarpBackend", "scm-world[warp]"),
    "step": ("StepFunction", "scm-world"),
    "fake": ("FakeBackend", "scm-world"),
}

BACKENDS = tuple(_CLASSES)
"""Names of the engines of this package."""
WITH_DEVICES = ("warp",)
"""Those that compute on a CPU or a GPU."""

_REGISTERED: dict[str, type[Backend]] = {}

Kind = TypeVar("Kind", bound=type[Backend])


def register(kind: Kind) -> Kind:
    """Register a custom backend by its ``name``, for every place that takes the name of a backend.

    It can decorate the class. New processes know it if the module that
    registers it is imported there: put it at the top level of that module. What an installed
    package declares as an entry point of the group ``scm_world.backends`` is known everywhere.

    Args:
        kind: A class that passes ``scm_world.testing.backend.BackendConformance``, or as much of
            it as its use needs; made without arguments.

    Returns:
        The same class.

    Raises:
        ModelError: It is not a class of backends, methods are missing, or it has no name.
        UnknownOption: Another one has this name.
    """
    enter(_REGISTERED, kind, Backend, what="backend", taken=BACKENDS, check=lambda kind: ())
    return kind


def backends() -> tuple[str, ...]:
    """Name all backends that ``make_backend`` knows: of this package, then the others."""
    return tuple(known())


def known() -> Plugins[Callable[[], Backend]]:
    """Return what makes each of them."""
    ours = {name: partial(_ours, name) for name in BACKENDS}
    return Plugins("backends", {**ours, **_REGISTERED}, _declared)


def _declared(name: str, found: Any) -> Callable[[], Backend]:
    """Return what makes the backend that an installed package declares."""
    made = found() if callable(found) else found
    if not isinstance(made, Backend):
        raise ModelError([f"it does not make a Backend for {name!r}, but {made!r}"])
    return lambda: made


@typed
def make_backend(name: str) -> Backend:
    """Create an empty backend; ``build`` puts a scene into it.

    Args:
        name: One of ``backends()``. An engine that computes on several kinds of devices takes the
            name of one after a colon: ``"warp:cpu"``, ``"warp:cuda"``.

    Raises:
        UnknownOption: There is no such backend, or no such device.
        ModelError: What an installed package declares by this name is not a backend, or fails.
        MissingEngine: Its engine is not installed, or two versions of it lie in one folder.

    Example:
        >>> make_backend("fake").name
        'fake'
    """
    require_backend(name)
    if name == EQUATIONS:
        raise UnknownOption("backend of bodies", name, backends())
    name, _, device = name.partition(":")
    return _ours(name, device) if device else known()[name]()


def _ours(name: str, device: str = "") -> Backend:
    """Create a backend of this package."""
    class_name, requirement = _CLASSES[name]
    try:
        module = importlib.import_module(f"scm_world.backends.{name}")
        found = getattr(module, class_name)
    except MissingEngine:
        raise
    except ImportError as error:
        raise MissingEngine(name, f"pip install {requirement!r}", str(error)) from error
    made_here: Backend = found(device) if device else found()
    return made_here


EQUATIONS = "equations"
"""The name in place of a backend for worlds without one: their equations are solved."""


def require_backend(name: object) -> None:
    """Refuse a text that is not the name of a backend, or names a device of an engine without any.

    Raises:
        UnknownOption: There is no such backend, or it has no devices.
    """
    kind, colon, device = name.partition(":") if isinstance(name, str) else (name, "", "")
    one_of("backend", kind, (*backends(), EQUATIONS))
    if colon and (kind not in WITH_DEVICES or not device):
        raise UnknownOption(f"device of backend {kind!r}", device, ("left out",))


def require_exact(
    backend: Backend,
    question: str,
    takes: Callable[[Backend], object],
    *,
    independent: Structure | None = None,
) -> None:
    """Refuse a question that compares equal runs bit for bit, if the engine is not exact.

    Args:
        backend: The backend that is asked.
        question: What was asked.
        takes: Raises an error for a new backend that cannot be used instead.
        independent: The structure, if what does not follow from a change must stay as it is, too.

    Raises:
        InexactEngine: It names the backends that can answer.
    """

    def apart(of: Backend) -> float:
        floor, rounding = of.capabilities.floor, of.capabilities.rounding
        if floor or independent is None:
            return floor
        size = float(np.max(rounding(of, independent, 1)))
        return size if size > ROUNDING else 0.0

    floor = apart(backend)
    if not floor:
        return
    exact = list[str]()
    for name in backends():
        with suppress(ScmWorldError), closing(make_backend(name)) as other:
            takes(other)
            exact += [other.name] * (apart(other) == 0.0)
    couples = not backend.capabilities.floor
    raise InexactEngine(question, backend.name, floor, exact, couples=couples)


def read_model(source: Any, **options: Any) -> Model:
    """Read a model from a file; see ``scm_world.backends.mujoco.reading.read_model``.

    Raises:
        MissingEngine: MuJoCo, which reads the files for all engines, is not installed.
        UnreadableFile: There is no such file, or it is not text.
        ModelError: It is not a model, or one that cannot be a causal model.

    Example:
        >>> ball = "<body name='ball'><freejoint/><geom size='0.1'/></body>"
        >>> read_model(f"<mujoco><worldbody>{ball}</worldbody></mujoco>").layout.names[:2]
        ('ball.cartesian_position', 'ball.orientation')
    """
    from scm_world.backends.mujoco.reading import read_model as read

    return read(source, **options)


__all__ = [
    "BACKENDS",
    "Backend",
    "BackendWrapper",
    "Capabilities",
    "ContactPoint",
    "EngineSnapshot",
    "OneScene",
    "Scenes",
    "SeparateScenes",
    "backends",
    "make_backend",
    "read_model",
    "register",
]
