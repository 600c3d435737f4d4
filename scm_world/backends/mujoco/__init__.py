"""The MuJoCo engine. Its installation is checked before it is imported.

Beside a package that asks for ``mujoco``, pip may put ``mujoco`` 3.17 over ``mujoco-core`` 4.0.1
into one folder, without a complaint from ``pip check``. The mixture fails on import, or worse,
does not. So the versions are compared first.
"""

from __future__ import annotations

import re
from contextlib import suppress
from importlib import metadata

from scm_world.errors import MissingEngine

REQUIREMENT = "mujoco>=3.17,<5"
REPAIR = f"pip uninstall -y mujoco mujoco-core mujoco-studio && pip install '{REQUIREMENT}'"
DISTRIBUTIONS = ("mujoco", "mujoco-core", "mujoco-studio")


def check_installation() -> None:
    """Compare the versions of the installed distributions, without importing MuJoCo."""
    found = {}
    for name in DISTRIBUTIONS:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    versions = {tuple(map(int, re.findall(r"\d+", text)[:3])) for text in found.values()}
    if len(versions) > 1:
        mixed = ", ".join(f"{name} {version}" for name, version in found.items())
        raise MissingEngine("mujoco", REPAIR, f"versions are mixed: {mixed}")


check_installation()

from scm_world.backends.mujoco.backend import MujocoBackend  # noqa: E402 # see above

__all__ = ["MujocoBackend", "check_installation"]
