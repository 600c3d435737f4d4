"""The commands about laboratories for agents."""

from __future__ import annotations

import asyncio
import secrets
from contextlib import suppress
from typing import Annotated

import typer

from scm_world._arguments import load, one_of
from scm_world.cli import console, options


def serve(
    kinds: Annotated[str, typer.Argument(metavar="KIND,...")],
    *,
    world: str = "equations",
    level: str = "L2",
    n: options.N = 1,
    seed: options.NotNegative = 0,
    key: Annotated[str | None, typer.Option(envvar="SCM_LAB_KEY")] = None,
    out: options.Text = None,
    mcp: bool = False,
    http: bool = False,
    host: str = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8710,
    token: Annotated[str | None, typer.Option(envvar="SCM_LAB_TOKEN")] = None,
) -> None:
    """Serve laboratories to agents over the Model Context Protocol (MCP).

    It serves on standard input and output, for a client that starts this command, or with --http
    on an address. Ctrl-C ends it.
    Example: scm-world lab serve effect,graph --world equations --n 3 --mcp

    Args:
        kinds: Kinds of questions, such as effect,graph.
        world: World of the questions.
        level: What agents know beforehand: L1, L2, L3 or L4.
        n: How many questions of each kind.
        seed: Seed of the first one; the others follow.
        key: A secret, by which the questions are private.
        out: Folder in which every call is recorded. With the same folder a new server continues
            unfinished runs.
        mcp: Serve the Model Context Protocol; there is no other one.
        http: Serve streamable HTTP on an address instead of standard input and output.
        host: Address to serve on; one that other machines reach has a token.
        port: Port to serve on; 0 for any that is free.
        token: Token that requests have to carry; a new one if it is left out and needed.
    """
    from scm_world.lab import mcp as serving
    from scm_world.lab import offers

    one_of("--mcp", mcp, (True,))
    for kind in options.split(kinds):
        one_of("--world", world, offers(kind))
    asked = [
        {"kind": kind, "world": world, "seed": seed + i, "level": level}
        for kind in options.split(kinds)
        for i in range(n)
    ]
    rooms = serving.Laboratories(asked, key, out)
    if not http:
        with suppress(KeyboardInterrupt):
            asyncio.run(serving.stdio(rooms))
        return
    uvicorn = load("uvicorn", "mcp", "lab")
    from scm_world.studio.server import LOCAL, bind

    if host not in LOCAL and token is None:
        token = secrets.token_urlsafe(24)
        console.say(f"Authorization: Bearer {token}")
    config = uvicorn.Config(
        serving.http(rooms, token or ""), host=host, port=port, log_level="warning"
    )
    bound, address = bind(config)
    bound.listen()  # a client that is told at once waits until the server answers
    console.say(f"{address}/mcp")
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[bound])
