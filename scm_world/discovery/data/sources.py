"""The rows of some episodes, as they are in a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, final

from scm_world.discovery.data.dataset import Dataset

FORMAT = "scm_world/dataset/1"


@final
@dataclass(frozen=True)
class SourceRows:
    """The rows of some episodes.

    Attributes:
        table: The rows.
        refused: Numbers of the episodes that could not be, and why.
        pictures: The file with the pictures beside the rows, if there are any.
        touching: Which bodies touched, by number of the episode, where that is recorded: ``pairs``,
            and ``runs`` of control steps: how many, and the numbers of the pairs that touch.
    """

    table: Dataset
    refused: tuple[tuple[int, str], ...] = ()
    pictures: bytes = b""
    touching: dict[str, Any] = field(default_factory=dict)
