"""The replay buffer of a training on disk: what was added since the last time, in files of its own.

Row i of all that was ever added stands in the file ``<first>-<stop>.safetensors`` with
first <= i < stop. Files are written whole and never changed; those whose rows are overwritten in
the buffer by now are removed when no checkpoint needs them any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, final

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from scm_world.errors import UnreadableFile
from scm_world.output.durable import made, write_durably

COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""What a buffer keeps of every control step; observations may be arrays by name."""

EPISODES = ("ep_start", "ep_length")
"""What hindsight keeps besides, and changes later."""


@final
class Memory:
    """The replay buffer of a model, and its files.

    Args:
        model: Of Stable-Baselines3.
        folder: Of the files.
    """

    def __init__(self, model: Any, folder: Path) -> None:
        self._buffer: Any = model.replay_buffer
        self._folder = folder
        self._model = model
        self._written = 0  # rows that are in files

    @property
    def _size(self) -> int:
        return int(self._buffer.buffer_size)

    @property
    def count(self) -> int:
        """How many rows were ever added: one for each step of all worlds."""
        return int(self._model.num_timesteps) // int(self._buffer.n_envs)

    def write(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Write what is new.

        Returns:
            For the checkpoint: arrays, and plain data.

        Raises:
            UnwritableFolder: There is no room, or no permission.
        """
        first = max(self._written, self.count - self._size)
        if first < self.count:
            rows = np.arange(first, self.count) % self._size
            arrays = {name: column[rows] for name, column in self._columns()}
            path = made(self._folder) / f"{first}-{self.count}.safetensors"
            write_durably(path, safetensors.numpy.save(arrays))
        self._written = self.count
        arrays = {name: getattr(self._buffer, name).copy() for name in self._episodes}
        if arrays:
            arrays["current"] = self._buffer._current_ep_start.copy()
        return arrays, {"count": self.count}

    def forget(self, oldest: int) -> None:
        """Remove files that no checkpoint needs.

        Args:
            oldest: How many rows there were at the oldest checkpoint that is kept.
        """
        for _, stop, path in self._files():
            if stop <= oldest - self._size:
                with suppress(OSError):
                    path.unlink()

    def clear(self) -> None:
        """Remove all files: nothing was added yet."""
        for _, _, path in self._files():
            path.unlink()

    def resume(self, arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> None:
        """Fill the buffer as it was at a checkpoint.

        Raises:
            UnreadableFile: A file is missing, damaged, or of another buffer.
        """
        count = int(state["count"])
        needed = max(0, count - self._size)
        for first, stop, path in sorted(self._files()):
            if stop > count:
                path.unlink()  # written after the checkpoint
            elif stop > needed:
                if first > needed:
                    break
                self._fill(path, first, stop, needed)
                needed = stop
        if needed != count:
            reason = f"rows {needed} to {count} of the replay buffer are missing"
            raise UnreadableFile(str(self._folder), reason, "begin in another folder")
        self._written = count
        self._buffer.pos, self._buffer.full = count % self._size, count >= self._size
        for name in self._episodes:
            getattr(self._buffer, name)[...] = arrays[name]
        if self._episodes:
            self._buffer._current_ep_start[...] = arrays["current"]

    def _fill(self, path: Path, first: int, stop: int, needed: int) -> None:
        begin = max(first, needed)
        rows = np.arange(begin, stop) % self._size
        try:
            given = safetensors.numpy.load_file(path)
            for name, column in self._columns():
                column[rows] = given[name][begin - first :]
        except (OSError, KeyError, ValueError, IndexError, SafetensorError) as error:
            advice = "begin in another folder"
            raise UnreadableFile(str(path), f"it is damaged ({error})", advice) from None

    @property
    def _episodes(self) -> tuple[str, ...]:
        return tuple(name for name in EPISODES if hasattr(self._buffer, name))

    def _columns(self) -> Iterator[tuple[str, NDArray[Any]]]:
        for name in COLUMNS:
            column = getattr(self._buffer, name)
            if isinstance(column, dict):
                yield from ((f"{name}.{part}", array) for part, array in column.items())
            else:
                yield name, column

    def _files(self) -> list[tuple[int, int, Path]]:
        found = []
        for path in self._folder.glob("*-*.safetensors"):
            first, _, stop = path.stem.partition("-")
            if first.isdecimal() and stop.isdecimal():
                found.append((int(first), int(stop), path))
        return found
