"""What a session is made of; light, so that the command serves the page at once."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from socket import SHUT_WR, socket
from typing import TYPE_CHECKING, Any, final

from scm_world.runs.processes import piped

if TYPE_CHECKING:
    from scm_world.queries import World
    from scm_world.tasks import WorldSource

FRAME, PACKED = 1, 2  # the first numbers of binary messages to the page
GRACE = 3.0  # [s] in which a worker has to end by itself


@final
@dataclass(frozen=True)
class Spec:
    """What a world is made of: a source, with options of it and of ``World``."""

    system: str
    options: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)

    def read(self) -> WorldSource:
        """Read the source."""
        from scm_world.tasks import read_source

        return read_source(self.system, self.options)

    def make(self, source: WorldSource | None = None) -> World:
        """Return the world."""
        from scm_world.queries import World

        return World(self.read() if source is None else source, **self.settings)

    @property
    def title(self) -> str:
        """The system in few words: of a file, its name."""
        home, _, function = self.system.rpartition(":")
        is_file = not home or self.system.endswith((".xml", ".urdf", ".json"))
        return Path(self.system).name if is_file else f"{Path(home).stem}:{function}"

    def code(self) -> list[str]:
        """Return the lines of Python that make it."""
        given = "".join(f", {n}={v!r}" for n, v in {**self.options, **self.settings}.items())
        imported = ["import scm_world as sw", "from scm_world.evaluation import in_world"]
        return [*imported, "", f"world = sw.World({self.system!r}{given})"]


@final
class PipedProcess:
    """A process that calls a function, and the pipe to it, which is the last argument."""

    def __init__(self, target: Callable[..., None], *given: object, daemon: bool = False) -> None:
        self._process, self.pipe = piped(target, *given, daemon=daemon)

    def interrupt(self) -> None:
        """Ask it to report the finished part, and to end."""
        with suppress(OSError):  # it has ended
            self.pipe.send("end")

    def close(self, grace: float = GRACE) -> None:
        """Close the way to it, which it reads to the end; end it by force after some time [s].

        Nothing is sent: that would wait for a process that is busy and whose pipe is full.
        """
        if sys.platform == "win32":  # no socket there, so that both ways are closed
            self.pipe.close()
        else:
            with suppress(OSError), socket(fileno=os.dup(self.pipe.fileno())) as way:
                way.shutdown(SHUT_WR)
        self._process.join(grace)
        for end in (self._process.terminate, self._process.kill):
            if self._process.is_alive():
                end()
                self._process.join(GRACE)
        self.pipe.close()


def session(spec: Spec, pipe: Connection) -> None:
    """Run a session; over the pipe come first an error, or that the system was read."""
    if spec.system.endswith((".xml", ".urdf")):
        from scm_world.backends.mujoco.sources import read_source  # a thread imports nothing

        # No daemon: the process would crash if it ended while a thread is in MuJoCo.
        threading.Thread(target=_compile, args=(read_source, spec.system)).start()
    from scm_world.studio.worker import work  # only here is all imported

    work(spec, pipe)


def _compile(read_source: Callable[..., Any], path: str) -> None:
    """Compile a file while all is imported: MuJoCo keeps its meshes, for when it is read."""
    with suppress(Exception):  # whatever reads it reports the error
        read_source(path, fixed_base=False, options={})
