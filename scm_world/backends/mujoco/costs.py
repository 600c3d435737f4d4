"""What a model file may cost, bounded before MuJoCo reads it.

MuJoCo makes whatever its files ask for, and opens whatever they name. Their tags are read here as
its XML reader finds them, with those of all files that they include; see docs/models.md.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from scm_world.errors import ModelError, UnreadableFile
from scm_world.runs.files import read_bytes

ELEMENTS = 50_000
"""How many elements a model may have, copies and vertices of flexes included."""
NUMBERS = 2**28
"""How many numbers: heights, pixels, outputs of sensors, and what users add."""
BYTES = 2**28
"""How large each file may be [bytes]."""

_TAG = re.compile(
    r"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<![^>]*>"
    r"|<\s*(?P<end>/?)\s*(?P<name>[^\s/>!?]+)(?P<rest>(?:[^\"'>]|\"[^\"]*\"|'[^']*')*)>",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"([^\s=]+)(?:\s*=\s*(?:\"([^\"]*)\"|'([^']*)'))?")
_REFERENCE = re.compile(r"&(?:#\w+|quot|amp|apos|lt|gt);")  # MuJoCo knows no others
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_PNG = b"\x89PNG\r\n\x1a\n"

Tag = tuple[str, Mapping[str, str], bool, bool]


def tags(text: str) -> Iterator[Tag]:
    """Yield the tags of a text up to the first that is malformed, which MuJoCo refuses.

    Each has a name, attributes, whether it begins an element, and whether it ends one.
    """
    place = text.find("<")
    while place >= 0 and (found := _TAG.match(text, place)):
        if found["name"]:
            parts = _ATTRIBUTE.findall(found["rest"])
            values = {name: _REFERENCE.sub(_meant, one or other) for name, one, other in parts}
            ends, whole = bool(found["end"]), found["rest"].endswith("/")  # </a/> is whole, too
            yield found["name"], values, whole or not ends, whole or ends
        place = text.find("<", found.end())


def _meant(reference: re.Match[str]) -> str:
    return html.unescape(reference[0])


def _product(text: str, most: int = 3) -> float:
    """Return the product of the first numbers of an attribute; each counts as one at least."""
    return math.prod(max(float(number), 1.0) for number in _NUMBER.findall(text)[:most])


@final
@dataclass
class Costs:
    """What a text of MJCF or URDF, and all files that it names, ask for.

    Attributes:
        where: How to call the model in errors.
        folder: Folder of the model.
        numbers: How many numbers they ask for.
        users: How many numbers each element gets from users, at most.
        folders: Where files may be looked for.
        names: Names of files of data, as they are given.
        known: Elements of each file that has been read, or is being read.
    """

    where: str
    folder: Path
    numbers: float = 0.0
    users: float = 0.0
    folders: dict[Path, None] = field(default_factory=dict)
    names: dict[str, None] = field(default_factory=dict)
    known: dict[Path, float] = field(default_factory=dict)

    def elements(self, text: str, folder: Path) -> float:
        """Return how many elements a text asks for."""
        total, attached, models, inside = 0.0, 0.0, 0.0, [1.0]
        dirs = [""]
        for name, values, begins, ends in tags(text):
            times = inside[-1]
            if begins:
                own = self._own(name, values)
                total += times * own
                count = _product(values.get("count", ""), 1) if name == "replicate" else 1.0
                inside.append(times * count)
                file = values.get("file", "")
                if name == "include":
                    total += times * self._included(file, folder)
                elif name == "model" and file:
                    models += self._included(file, folder)
                elif name == "attach":
                    attached += times
                elif name == "compiler":
                    dirs += [v for key, v in values.items() if key.endswith("dir")]
                else:
                    kept = (v for key, v in values.items() if key.startswith("file") and v)
                    self.names |= dict.fromkeys(kept)
            if ends and len(inside) > 1:
                inside.pop()
            self._check("elements", total, ELEMENTS)
        self.folders |= dict.fromkeys(
            root / path for root in (self.folder, folder) for path in dirs
        )
        total += attached * models
        self._check("elements", total, ELEMENTS)
        return total

    def _own(self, name: str, values: Mapping[str, str]) -> float:
        """Return how many elements an element stands for; count the numbers that it asks for."""
        self.users = max(self.users, len(values.get("user", "")) / 2)
        asked = [values.get(size, "") for size in ("nrow", "ncol")]
        if name == "texture":
            flat = values.get("type", "cube") == "2d"  # others have six squares
            asked = [values.get(size, "") for size in ("width", "height" if flat else "width")]
            asked.append("3" if flat else "18")
        elif name == "size":
            asked.append(values.get("nuserdata", ""))
            kept = (v for key, v in values.items() if key.startswith(("nuser_", "nkey")))
            self.users = max([self.users, *(_product(value, 1) for value in kept)])
        else:
            asked += [
                values[key] for key in ("dim", "num", "nsample", "resolution") if key in values
            ]
        self.numbers += math.prod(map(_product, asked))
        kind = values.get("builtin", "")
        if name == "mesh" and kind and kind != "sphere":
            params = values.get("params", "")
            return _product(params, 1) ** 2 if kind.startswith("super") else _product(params, 2)
        return _product(values.get("count", "")) if name == "flexcomp" else 1.0

    def _included(self, name: str, folder: Path) -> float:
        """Return how many elements a file of MJCF asks for, which is read once."""
        for root in (self.folder, folder) if name else ():
            path = root / name
            if path in self.known:
                return self.known[path]
            if self.regular(path, "include a file of MJCF"):
                self.known[path] = 0.0
                text = read_bytes(path).decode("utf-8", "replace")
                self.known[path] = self.elements(text, path.parent)
                return self.known[path]
        return 0.0

    def regular(self, path: Path, advice: str) -> bool:
        """Return whether there is a file; refuse one that is not regular, or too large."""
        try:
            is_one, is_there = path.is_file(), path.exists()
            size = path.stat().st_size if is_one else 0
        except (OSError, ValueError):
            return False
        if is_there and not is_one:
            raise UnreadableFile(str(path), "not a regular file", advice)
        self._check(f"bytes of {path}", size, BYTES)
        return is_one

    def check_data(self) -> None:
        """Check the files of data, wherever MuJoCo may look for them."""
        for name in self.names:
            for one in dict.fromkeys((name, re.split(r"[\\/]", name)[-1])):
                for root in self.folders:
                    path = root / one
                    if not self.regular(path, "give the file itself"):
                        continue
                    with path.open("rb") as file:
                        head = file.read(24)
                    if head.startswith(_PNG):
                        width, height = (int.from_bytes(head[i : i + 4]) for i in (16, 20))
                        self.numbers += 4.0 * width * height

    def _check(self, what: str, asked: float, most: int) -> None:
        if asked > most:
            raise ModelError(
                [
                    f"{self.where} asks for {asked:.3g} {what}, more than {most:,}; reduce it, or "
                    "compile it yourself and give the MjModel"
                ]
            )

    def check(self, text: str) -> None:
        """Refuse a text that asks for too much, or that names what is not a file.

        Raises:
            ModelError: There are too many elements or numbers, or a file is too large.
            UnreadableFile: A file that it names is a pipe, a device, a socket or a folder.
        """
        self._check("bytes of text", len(text), BYTES)
        elements = self.elements(text, self.folder)
        self.check_data()
        self._check("numbers", self.numbers + self.users * max(elements, 1000.0), NUMBERS)
