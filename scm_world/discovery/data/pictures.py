"""Pictures in files: which are taken, and rows with pictures as Parquet."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, final

from scm_world._arguments import typed, whole_number
from scm_world.backends.renderer import png, render, scene_camera
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene

Row = dict[str, Any]
"""Numbers, lists of numbers or of words, and pictures as the bytes of a PNG, by column."""


@typed
@final
@dataclass(frozen=True)
class Pictures:
    """Which pictures are taken.

    Attributes:
        cameras: Names of cameras, of the robot or of the model; None is the usual one.
        size: Height and width [pixels].
        goals: Whether to take pictures of the goals, too: without what moves.

    Raises:
        UnknownOption: A size is not a positive number.
    """

    cameras: tuple[str | None, ...] = (None,)
    size: tuple[int, int] = (64, 64)
    goals: bool = False

    def __post_init__(self) -> None:
        height, width = (whole_number("size", side, least=1) for side in self.size)
        cameras = (self.cameras,) if isinstance(self.cameras, str) else tuple(self.cameras)
        object.__setattr__(self, "cameras", cameras or (None,))
        object.__setattr__(self, "size", (height, width))

    def take(self, scene: Scene, placed: Iterable[Camera], label: str = "image") -> Row:
        """Take the pictures of a scene with the software renderer, alike on all machines.

        Cameras that are ``placed`` are variables. ``label`` is the name of the column; with several
        cameras ``.CAMERA`` follows.
        """
        own: dict[str | None, Camera] = {camera.name: camera for camera in placed}
        found: Row = {}
        for goals_only in (False, True) if self.goals else (False,):
            name = f"goal_{label}" if goals_only else label
            for camera in self.cameras:
                from_ = scene_camera(scene, own.get(camera, camera), self.size)
                column = f"{name}.{camera}" if len(self.cameras) > 1 else name
                found[column] = png(render(scene, from_, goals_only=goals_only).rgb)
        return found


def encoded_pictures(rows: Sequence[Row]) -> bytes:
    """Return rows of the same columns as Parquet, in its metadata the features of ``datasets``."""
    import pyarrow as arrow
    from pyarrow import parquet

    image = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    columns, features = dict[str, Any](), dict[str, Any]()
    for name, first in rows[0].items() if rows else ():
        values = [row[name] for row in rows]
        if isinstance(first, bytes):
            cells = [{"bytes": value, "path": None} for value in values]
            columns[name], features[name] = arrow.array(cells, image), {"_type": "Image"}
            continue
        several = isinstance(first, list)
        kind = next((type(x) for value in values for x in (value if several else (value,))), str)
        here, there = {int: ("int64",) * 2, float: ("double", "float64")}.get(kind, ("string",) * 2)
        plain = {"dtype": there, "_type": "Value"}
        features[name] = {"_type": "List", "feature": plain} if several else plain
        cell = arrow.type_for_alias(here)
        columns[name] = arrow.array(values, arrow.list_(cell) if several else cell)
    about = {"huggingface": json.dumps({"info": {"features": features}})}
    sink = io.BytesIO()
    table = arrow.table(columns).replace_schema_metadata(about)
    parquet.write_table(table, sink, compression="none")  # pictures are compressed already
    return sink.getvalue()
