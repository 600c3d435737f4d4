"""The MuJoCo engine. It is checked and imported when ``MujocoBackend`` is first asked for.

Beside a package that asks for ``mujoco``, pip may put ``mujoco`` 3.17 over ``mujoco-core`` 4.0.1
into one folder, without a complaint from ``pip check``. The mixture fails on import, or worse,
does not. So it is looked at first whether there is one MuJoCo, and whether it is recent enough.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from scm_world.errors import MissingEngine, MixedInstallation

if TYPE_CHECKING:
    from scm_world.backends.mujoco.backend import MujocoBackend

OLDEST = (3, 17)
REQUIREMENT = "mujoco>=3.17,<5"
REPAIR = f"pip uninstall -y mujoco mujoco-core mujoco-studio && pip install '{REQUIREMENT}'"
DISTRIBUTIONS = ("mujoco", "mujoco-core", "mujoco-studio")


def __getattr__(name: str) -> object:
    if name != "MujocoBackend":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    check_installation()
    from scm_world.backends.mujoco.backend import MujocoBackend

    globals()[name] = MujocoBackend
    return MujocoBackend


def check_installation() -> None:
    """Look at the metadata and at the libraries, without importing MuJoCo.

    Raises:
        MissingEngine: It is not installed, or older than 3.17.
        MixedInstallation: Versions differ within one folder.
    """
    spec = importlib.util.find_spec("mujoco")
    folders = list(spec.submodule_search_locations or ()) if spec else []
    libraries = [path.name for folder in folders for path in Path(folder).glob("libmujoco*")]
    installed = {}
    for name in DISTRIBUTIONS:
        with suppress(metadata.PackageNotFoundError):
            installed[name] = metadata.version(name)
    judge(installed, libraries)


def judge(distributions: Mapping[str, str], libraries: list[str]) -> None:
    """Decide whether these parts make one MuJoCo.

    Args:
        distributions: Version of each installed distribution.
        libraries: File names of the shared libraries in its folder.

    Raises:
        MissingEngine: There is nothing, or it is older than 3.17.
        MixedInstallation: Versions differ.

    Example:
        >>> judge({"mujoco": "4.0.0", "mujoco-core": "4.0.0"}, ["libmujoco.so.4.0.0"])
        >>> judge({"mujoco": "3.17.0", "mujoco-core": "4.0.1"}, ["libmujoco.so.3.17.0"])
        Traceback (most recent call last):
        scm_world.errors.MixedInstallation: the mujoco installation mixes versions ...
    """
    if not distributions:
        raise MissingEngine("mujoco", f"pip install '{REQUIREMENT}'")
    numbered = {name: re.search(r"\d+\.\d+\.\d+", name) for name in libraries}
    found = {**distributions, **{name: match[0] for name, match in numbered.items() if match}}
    versions = {tuple(map(int, re.findall(r"\d+", text)[:3])) for text in found.values()}
    if len(versions) > 1:
        raise MixedInstallation("mujoco", found, REPAIR)
    version = min(versions)
    if version < OLDEST:
        readable = ".".join(map(str, version))
        raise MissingEngine("mujoco", f"pip install '{REQUIREMENT}'", f"{readable} is too old")


__all__ = ["MujocoBackend", "check_installation"]
