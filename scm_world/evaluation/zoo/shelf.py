"""Where the policies lie that come with this package."""

from __future__ import annotations

from pathlib import Path

from scm_world.errors import UnknownOption

PREFIX = "zoo:"
SUFFIX = ".safetensors"
FOLDER = Path(__file__).parent


def names() -> tuple[str, ...]:
    """Name all of them, as ``"zoo:pushing"``, in the order of the alphabet."""
    return tuple(f"{PREFIX}{path.stem}" for path in sorted(FOLDER.glob(f"*{SUFFIX}")))


def path_of(name: str) -> Path:
    """Give the file of one.

    Args:
        name: ``"zoo:pushing"``, or ``"pushing"``.

    Raises:
        UnknownOption: There is none of this name.
    """
    full = f"{PREFIX}{name.removeprefix(PREFIX)}"
    if full not in names():
        raise UnknownOption("policy of the zoo", name, names())
    return FOLDER / f"{full.removeprefix(PREFIX)}{SUFFIX}"
