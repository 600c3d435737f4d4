"""Options that say where a bag of jobs is done: here, in processes, or on Ray."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, final

import typer

from scm_world.cli.console import console

if TYPE_CHECKING:
    from scm_world.work.executors import Executor

Engine = Annotated[
    str | None,
    typer.Option(
        help="What does the work: serial, process or ray.",
        show_default="process, with one worker serial",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        min=0,
        help="How much is done at the same time; 0 for as many as there are cores.",
        show_default="1; with --engine as many as there are cores",
    ),
]
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

    @contextmanager
    def begun(self, *, usual: str | None = None) -> Iterator[Executor]:
        """Open what does the work, and say in a line where that is.

        Args:
            usual: The engine if none is named; by how many workers there are if None.

        Raises:
            UnknownOption: There is no such engine, or it cannot have so many workers.
        """
        from scm_world.work.executors import cores, engine_of

        workers = self.workers or None
        if self.engine is None:
            workers = 1 if self.workers is None else (self.workers or cores())
        engine = self.engine or usual
        with engine_of(engine, workers=workers, address=self.address) as executor:
            console(stderr=True).print(f"the work is done {executor.where}", soft_wrap=True)
            yield executor
