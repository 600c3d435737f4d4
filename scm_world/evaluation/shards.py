"""Files of finished shards of an evaluation: whole or absent."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from hashlib import blake2b
from typing import Any

from scm_world.errors import DAMAGED, UnreadableFile
from scm_world.evaluation.episodes import EpisodeRow
from scm_world.output.durable import made, write_whole
from scm_world.output.locations import Location
from scm_world.output.reading import read_text

FORMAT = "scm_world/evaluation-part/1"
FOLDER = "parts"


def part_path(folder: Location, key: str) -> Location:
    """Name the file of a shard.

    Args:
        folder: Of the evaluation.
        key: Of the shard.
    """
    return folder / FOLDER / f"{key}.json"


def write_part(folder: Location, key: str, rows: Sequence[EpisodeRow]) -> None:
    """Write the episodes of a shard.

    Raises:
        UnwritableFolder: There is no room, or no permission.
    """
    path = part_path(folder, key)
    made(path.parent)
    plain = [asdict(row) for row in rows]
    text = json.dumps({"format": FORMAT, "key": key, "sum": _sum(plain), "rows": plain})
    write_whole(text + "\n", path)


def read_part(folder: Location, key: str, count: int) -> list[EpisodeRow] | None:
    """Read the episodes of a shard; None if it has not been played.

    Args:
        folder: Of the evaluation.
        key: Of the shard.
        count: How many episodes it has.

    Raises:
        UnreadableFile: The file is damaged, or not of this shard.
    """
    path = part_path(folder, key)
    advice = "delete this file; its episodes are then played again"
    try:
        data = json.loads(read_text(path))
        found = (data["format"], data["key"], data["sum"], len(data["rows"]))
        if found != (FORMAT, key, _sum(data["rows"]), count):
            raise ValueError("its content is not what was written")
        return [EpisodeRow(**row) for row in data["rows"]]
    except FileNotFoundError:
        return None
    except DAMAGED as error:
        raise UnreadableFile(str(path), f"it is damaged ({error})", advice) from None


def _sum(rows: Any) -> str:
    text = json.dumps(rows, sort_keys=True)
    return blake2b(text.encode(), digest_size=12).hexdigest()
