"""Options that say where a bag of jobs is done: here, in processes, or on Ray."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, final

import typer

from scm_world.cli.console import console
from scm_world.errors import UnknownOption

if TYPE_CHECKING:
    from scm_world.work.executors import Executor

Engine = Annotated[
    str | None,
    typer.Option(
        help="What does the work: serial, process or ray.",
        show_default="process, with one worker serial",
    ),
]


def _workers(usual: str) -> Any:
    told = "How much is done at the same time; 0 for as many as there are cores."
    return typer.Option(min=0, help=told, show_default=usual)


Workers = Annotated[int | None, _workers("1; with --engine as many as there are cores")]
ManyWorkers = Annotated[int | None, _workers("as many as there are cores")]
Address = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Of a Ray cluster, or 'auto'; without it, Ray is started on this machine.",
    ),
]


@final
@dataclass(frozen=True)
class Work:
    """Where the work is done, as it was typed.

    Attributes:
        engine: ``"serial"``, ``"process"``, ``"ray"``, or None.
        workers: How many; 0 for as many as there are cores.
        address: Of a Ray cluster.
    """

    engine: str | None = None
    workers: int | None = None
    address: str | None = None

    def refuse_others(self, what: str) -> None:
        """Refuse to work elsewhere than in this process.

        Args:
            what: Said in the error.

        Raises:
            UnknownOption: Another engine, several workers, or an address were typed.
        """
        typed: tuple[tuple[str, object, object], ...] = (
            ("--engine", self.engine, "serial"),
            ("--workers", self.workers, 1),
            ("--address", self.address, None),
        )
        for name, value, alone in typed:
            if value not in (None, alone):
                allowed = "left out" if alone is None else f"{alone}, or left out"
                raise UnknownOption(name, value, (f"{allowed}: {what} works in this process",))

    @contextmanager
    def begun(self, *, usual: str | None = None) -> Iterator[Executor]:
        """Open what does the work, and say in a line where that is.

        Args:
            usual: The engine if none is named; by how many workers there are if None.

        Raises:
            UnknownOption: There is no such engine, or it cannot have so many workers.
        """
        from scm_world.work.executors import engine_of
        from scm_world.work.threads import cores

        workers = self.workers or None
        if self.engine is None:
            workers = 1 if self.workers is None else (self.workers or cores())
        engine = self.engine or usual
        with engine_of(engine, workers=workers, address=self.address) as executor:
            console(stderr=True).print(f"the work is done {executor.where}", soft_wrap=True)
            yield executor
