"""The page on which a person answers the question of a laboratory with the tools of an agent."""

from __future__ import annotations

import asyncio
import json
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from scm_world.lab import Laboratory, tools
from scm_world.studio.server import LARGEST, allowed, bind, page

HOST = "127.0.0.1"


def application(room: Laboratory) -> Starlette:
    """Return the page, and what it asks: the tools with the calls so far, and calls.

    An answer says no more than the tools do.
    """
    shown = page("lab.html", {})

    async def index(request: Request) -> Response:
        return shown if allowed(request, HOST) else PlainTextResponse("not allowed", 403)

    async def state(request: Request) -> Response:
        if not allowed(request, HOST):
            return PlainTextResponse("not allowed", 403)
        found = {"tools": tools(), "calls": room.calls, "remaining": room.remaining}
        return JSONResponse({**found, "score": room.score})

    async def call(request: Request) -> Response:
        if not allowed(request, HOST):
            return PlainTextResponse("not allowed", 403)
        length = request.headers.get("content-length", "")
        if not (length.isdigit() and int(length) <= LARGEST):
            return PlainTextResponse(f"at most {LARGEST} bytes, of a stated length", 413)
        try:
            given: Any = json.loads(await request.body(), parse_constant=int)  # NaN is not JSON
            tool, arguments = given["tool"], given["arguments"]
        except (ValueError, RecursionError, KeyError, TypeError):
            return JSONResponse({"refused": 'give {"tool": name, "arguments": {…}} as JSON'})
        return JSONResponse(await asyncio.to_thread(room.call, tool, arguments))

    routes = [Route("/", index), Route("/state", state), Route("/call", call, methods=["POST"])]
    return Starlette(routes=routes)


def serve(
    room: Laboratory,
    *,
    port: int = 8730,
    open_: bool = False,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the page on this machine until Ctrl-C.

    Args:
        room: The laboratory.
        port: Number of the port; any free one if 0.
        open_: Whether to open a browser.
        say: Called with the address.

    Raises:
        UnknownOption: The port is taken.
    """
    import uvicorn

    config = uvicorn.Config(application(room), host=HOST, port=port, log_level="warning")
    bound, address = bind(config)
    bound.listen()  # a page that is opened at once waits until the server answers
    say(f"{address}/")
    if open_:
        webbrowser.open(f"{address}/")
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[bound])
