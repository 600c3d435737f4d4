"""Laboratories behind the Model Context Protocol: the one module that knows its library."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import threading
from collections.abc import AsyncIterator, Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, final

from scm_world._arguments import load, one_of
from scm_world.errors import ScmWorldError, UnknownOption, UnreadableFile
from scm_world.lab.laboratory import Laboratory, repeated, tools
from scm_world.lab.questions import question

LARGEST = 1 << 20
"""The most bytes of a request."""


@final
class Laboratories:
    """Laboratories by name; each is made when it is first called, and once only.

    Args:
        asked: Arguments of ``question``, without the key: one entry for each laboratory.
        key: The key of private questions.
        out: Folder in which each call is recorded. A new process continues the runs of that folder,
            so that a server that was killed gives no budget back. None records nothing.
    """

    def __init__(
        self,
        asked: Iterable[Mapping[str, Any]],
        key: str | None = None,
        out: str | PathLike[str] | None = None,
    ) -> None:
        self._asked = {"-".join(str(part) for part in one.values()): one for one in asked}
        if not self._asked:
            raise UnknownOption("asked", [], ("at least one question",))
        self._key, self._out = key, None if out is None else Path(out)
        self._rooms = dict[str, Laboratory]()
        self._locks = {name: threading.Lock() for name in self._asked}

    def tools(self) -> list[dict[str, Any]]:
        """Return name, description and JSON schema of the arguments of each tool."""
        which = {"laboratory": {"type": "string", "enum": [*self._asked]}}
        found = tools()
        for schema in (tool["input_schema"] for tool in found):
            schema["properties"] = which | schema["properties"]
            schema["required"] = ["laboratory", *schema["required"]]
        return found

    def call(self, tool: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Call a tool of a laboratory; a refusal is ``{"refused": why}``, and costs nothing."""
        given = dict(arguments)
        name = given.pop("laboratory", None)
        try:
            one_of("tool", tool, [one["name"] for one in tools()])
            one_of("laboratory", name, tuple(self._asked))
            with self._locks[name]:
                if name not in self._rooms:
                    self._rooms[name] = self._opened(name)
                found = self._rooms[name].call(tool, given)
                if self._out is not None and "refused" not in found:
                    self._rooms[name].save(self._out / f"{name}.json")
        except ScmWorldError as error:
            return {"refused": str(error)}
        return found

    def _opened(self, name: str) -> Laboratory:
        path = None if self._out is None else self._out / f"{name}.json"
        if path is None or not path.exists():
            return Laboratory(question(**self._asked[name], key=self._key))
        room, differ = repeated(path, self._key)
        if differ:
            why = f"its calls give other results now: {', '.join(differ)}"
            raise UnreadableFile(str(path), why, "choose another folder for the runs")
        return room


def server(rooms: Laboratories) -> Any:
    """Return a server of the library ``mcp``, of its first or second major version."""
    types: Any = load("mcp.types", "mcp", "lab")
    of = load("mcp.server.lowlevel", "mcp", "lab").Server
    listed = [
        types.Tool(name=t["name"], description=t["description"], inputSchema=t["input_schema"])
        for t in rooms.tools()
    ]

    async def called(tool: str, arguments: Mapping[str, Any] | None) -> Any:
        found = await asyncio.to_thread(rooms.call, tool, arguments or {})
        pictures = found.get("pictures", ())
        found = {part: value for part, value in found.items() if part != "pictures"}
        content = [{"type": "text", "text": json.dumps(found, allow_nan=False)}] + [
            {"type": "image", "data": one, "mimeType": "image/png"} for one in pictures
        ]
        result = {"content": content, "structuredContent": found, "isError": "refused" in found}
        return types.CallToolResult.model_validate(result)

    async def tools_of(*_: Any) -> Any:
        return types.ListToolsResult(tools=listed)

    async def call_of(_: Any, params: Any) -> Any:
        return await called(params.name, params.arguments)

    if not hasattr(of, "list_tools"):  # mcp 2
        return of("scm-world-lab", on_list_tools=tools_of, on_call_tool=call_of)
    made = of("scm-world-lab")
    made.list_tools()(tools_of)
    made.call_tool(validate_input=False)(called)
    return made


async def stdio(rooms: Laboratories) -> None:
    """Serve laboratories on standard input and output, until the input ends."""
    made = server(rooms)
    async with load("mcp.server.stdio", "mcp", "lab").stdio_server() as streams:
        await made.run(*streams, made.create_initialization_options())


def http(rooms: Laboratories, token: str = "") -> Any:
    """Return an ASGI application: streamable HTTP at ``/mcp``, without sessions.

    With a token, each request has to carry it (``Authorization: Bearer …``). Without one, the host
    that a request names has to be this machine.
    """
    managing: Any = load("mcp.server.streamable_http_manager", "mcp", "lab")  # needs starlette
    security: Any = load("mcp.server.transport_security", "mcp", "lab")
    from starlette.applications import Starlette
    from starlette.routing import Route

    local = ["127.0.0.1:*", "localhost:*", "[::1]:*"]
    settings = security.TransportSecuritySettings(
        enable_dns_rebinding_protection=not token, allowed_hosts=local
    )
    manager = managing.StreamableHTTPSessionManager(
        server(rooms), json_response=True, stateless=True, security_settings=settings
    )

    @contextlib.asynccontextmanager
    async def life(_: Any) -> AsyncIterator[None]:
        async with manager.run():
            yield

    return Starlette(routes=[Route("/mcp", _Guarded(manager, token))], lifespan=life)


@final
class _Guarded:
    """An ASGI application that refuses requests without the token, and those that are too large."""

    def __init__(self, manager: Any, token: str) -> None:
        self._manager, self._token = manager, token

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        headers = dict(scope["headers"])
        length, given = headers.get(b"content-length", b""), headers.get(b"authorization", b"")
        fits = scope["method"] != "POST" or (length.isdigit() and int(length) <= LARGEST)
        if self._token and not hmac.compare_digest(given, f"Bearer {self._token}".encode()):
            code, why = 401, "this server needs its token: Authorization: Bearer …"
        elif not fits:
            code, why = 413, f"at most {LARGEST} bytes, of a stated length"
            if length.isdigit() and int(length) <= 2 * LARGEST:  # else the sender may not hear it
                while (await receive()).get("more_body"):
                    pass
        else:
            await self._manager.handle_request(scope, receive, send)
            return
        from starlette.responses import PlainTextResponse

        await PlainTextResponse(why, code)(scope, receive, send)
