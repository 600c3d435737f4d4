"""The command that shows a world in a browser: ``studio``."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated

import typer

from scm_world._arguments import load
from scm_world.cli import console, options
from scm_world.cli.arguments import parse_assignments


def studio(
    task: options.System = "pushing",
    *,
    host: str = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8700,
    open_: bool = False,
    opening: options.Opening,
) -> None:
    """Serve a page: the causal graph, interventions and the moving world side by side.

    It works without a network. Ctrl-C ends it.
    Example: scm-world studio pushing --open

    Args:
        host: Address to serve on; for one that other machines reach, the printed address has a
            token.
        port: Port to serve on; 0 for any that is free.
        open_: Open the page in the usual browser.
    """
    from scm_world.studio.spec import PipedProcess, Spec, session

    given = parse_assignments(opening.option, "'--option'")
    spec = Spec(
        system=task,
        options={name: tuple(v) if isinstance(v, list) else v for name, v in given.items()},
        settings={name: value for name, value in opening.settings.items() if value is not None},
    )
    with closing(PipedProcess(session, spec)) as first:  # imports and reads, too
        for package in ("starlette", "uvicorn", "websockets"):
            load(package, package, "studio")
        from scm_world.studio.server import serve

        serve(spec, first, host=host, port=port, open_=open_, say=console.say)
