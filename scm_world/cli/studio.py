"""The command that shows a world in a browser: ``studio``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from scm_world._arguments import load
from scm_world.cli import console, options
from scm_world.cli.arguments import WORDS, load_system, parse_assignments, refuse_settings


def studio(
    task: Annotated[
        str,
        typer.Argument(
            metavar="SYSTEM",
            help="A task (see 'scm-world list'), a model.xml, model.urdf or model.json, or "
            "module:name.",
        ),
    ] = "pushing",
    backend: options.Backend = None,
    preset: options.Preset = None,
    resolution: options.Resolution = None,
    host: str = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8700,
    open_: Annotated[
        bool, typer.Option("--open", help="Open the page in the usual browser.")
    ] = False,
    option: options.Option = None,
) -> None:
    """Serve a page: the causal graph, interventions and the moving world side by side.

    It works without a network. Ctrl-C ends it.
    Example: scm-world studio pushing --open

    Args:
        host: Address to serve on; for one that other machines reach, the printed address has a
            token.
        port: Port to serve on; 0 for any that is free.
    """
    for package in ("starlette", "uvicorn", "websockets"):
        load(package, package, "studio")
    from scm_world.queries import SCM
    from scm_world.studio.reading import Spec
    from scm_world.studio.server import serve

    system = load_system(task, option)  # what is wrong with it is said at once
    if isinstance(system, SCM):
        refuse_settings(backend=backend, preset=preset, resolution=resolution)
    given = parse_assignments(option, "'--option'")
    for key, value in given.items():
        given[key] = WORDS.get(value.lower(), value) if isinstance(value, str) else value
    settings: dict[str, Any] = {"backend": backend, "preset": preset, "resolution": resolution}
    settings = {name: value for name, value in settings.items() if value is not None}
    spec = Spec(system=task, options=given, settings=settings)
    serve(spec, host=host, port=port, open_=open_, say=console.say)
