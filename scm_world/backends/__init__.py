"""The physics engines, behind one interface. None of them is imported before it is used."""

from __future__ import annotations

import importlib

from scm_world.backends.base import Backend, Capabilities, Contact, EngineSnapshot
from scm_world.errors import MissingEngine, UnknownOption

BACKENDS = ("mujoco", "bullet", "fake")
"""Names that ``make_backend`` knows."""

_CLASSES = {
    "mujoco": ("scm_world.backends.mujoco", "MujocoBackend", "mujoco>=3.17,<5"),
    "bullet": ("scm_world.backends.bullet", "BulletBackend", "pybullet==3.2.7"),
    "fake": ("scm_world.backends.fake", "FakeBackend", "scm-world"),
}


def make_backend(name: str) -> Backend:
    """Create an empty backend; ``build`` puts a scene into it.

    Raises:
        UnknownOption: There is no such backend.
        MissingEngine: Its engine is not installed.
        MixedInstallation: Two versions of its engine lie in one folder.

    Example:
        >>> make_backend("fake").name
        'fake'
    """
    if name not in BACKENDS:
        raise UnknownOption("backend", name, BACKENDS)
    module, class_name, requirement = _CLASSES[name]
    try:
        backend: Backend = getattr(importlib.import_module(module), class_name)()
    except MissingEngine:
        raise
    except ImportError as error:
        raise MissingEngine(name, f"pip install {requirement!r}", str(error)) from error
    return backend


__all__ = [
    "BACKENDS",
    "Backend",
    "Capabilities",
    "Contact",
    "EngineSnapshot",
    "make_backend",
]
