"""The server of the page: static files, and a websocket for each session."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import json
import mimetypes
import re
import secrets
import signal
import threading
import webbrowser
from base64 import b64encode
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from socket import socket
from typing import Any, final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from scm_world.errors import UnknownOption, in_one_line
from scm_world.studio.spec import FRAME, PipedProcess, Spec
from scm_world.studio.spec import session as begin

PAGE = Path(__file__).parent / "page"
LOCAL = ("127.0.0.1", "localhost", "::1")
MOST_SESSIONS = 8
KEPT = 120.0  # [s] how long a world waits for its page to come back
LARGEST = 1 << 20  # [characters] of a message from a page
MOST_WAITING = 4 * LARGEST  # [characters] of messages that a busy worker has not taken yet

MODULES = {
    "three": "vendor/three.js",
    "cytoscape": "vendor/cytoscape.js",
    "studio": "main.js",
    "studio/ask": "ask.js",
    "studio/graph": "graph.js",
    "studio/panel": "panel.js",
    "studio/plots": "plots.js",
    "studio/view": "view.js",
}
"""The modules of the page and their files; the only ones that are served."""


@cache
def read(name: str) -> str:
    """Return a file of the page."""
    return (PAGE / name).read_text(encoding="utf-8")


def page(name: str, parts: Mapping[str, str]) -> Response:
    """Return a page with its parts, whose own scripts alone may run."""
    text = re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], read(name))
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", text, flags=re.DOTALL)
    hashes = (b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts if s)
    sources = " ".join(f"'sha256-{one}'" for one in hashes)
    headers = {
        "Content-Security-Policy": (
            f"default-src 'none'; script-src 'self' {sources}; style-src 'unsafe-inline'; "
            "img-src 'self' data: blob:; media-src blob:; connect-src 'self' ws: wss:; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        ),
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
    }
    return Response(text, media_type="text/html", headers=headers)


def allowed(request: Request | WebSocket, host: str, needed: str = "") -> bool:
    """Return whether a request comes from our page: no other page may reach this one.

    Args:
        request: The request.
        host: Address that is bound.
        needed: Token of the address; none if empty.
    """
    token = request.query_params.get("token", "")
    if needed and not hmac.compare_digest(token.encode(), needed.encode()):
        return False
    given = request.headers.get("host", "")
    name = re.sub(r":\d+$", "", given).strip("[]")
    if host in LOCAL and name not in LOCAL:
        return False  # the name of another site that leads here
    origin = request.headers.get("origin")
    return origin is None or origin.partition("://")[2] == given


@final
class _Session:
    """A worker process, and the page that is connected to it."""

    def __init__(self, worker: PipedProcess, loop: asyncio.AbstractEventLoop) -> None:
        self.worker, self._loop = worker, loop
        self.socket: WebSocket | None = None  # None while the page is away
        self.left = loop.time()  # when it went
        self._messages: deque[str | bytes] = deque()
        self._frames: dict[int, bytes] = {}  # the last one of each lane: a slow page skips some
        self._something = asyncio.Event()
        self._asked: SimpleQueue[Any] = SimpleQueue()  # until the worker has room for them
        self._received = self._passed = 0  # [characters] of them
        self.ended = False
        self._fatal = False
        for work in (self._read, self._write):
            threading.Thread(target=work, daemon=True).start()

    def _read(self) -> None:
        """Read the messages of the worker, until it ends."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                given = self.worker.pipe.recv()
                self._loop.call_soon_threadsafe(self._take, given)
        self._asked.put(None)
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._end)

    def _write(self) -> None:
        """Pass messages on, until the worker ends; a busy one takes no more than fit the pipe."""
        with contextlib.suppress(OSError):
            while (asked := self._asked.get()) is not None:
                message, size = asked
                self.worker.pipe.send(message)
                self._passed += size

    def _take(self, given: Exception | bytes | dict[str, Any]) -> None:
        if isinstance(given, Exception):
            given = {"type": "fatal", "error": in_one_line(given)}
        if isinstance(given, bytes) and given[0] == FRAME:
            self._frames[given[4]] = given
        elif isinstance(given, bytes):
            self._messages.append(given)
        elif self.socket is not None or given["type"] == "fatal":
            self._fatal = self._fatal or given["type"] == "fatal"
            self._messages.append(json.dumps(given, allow_nan=False))
        self._something.set()

    def _end(self) -> None:
        self.ended = True
        if not self._fatal:
            said = "the world has ended; load the page again to begin anew"
            self._take({"type": "fatal", "error": said})

    def ask(self, message: object, size: int = 0) -> None:
        """Queue a message for the worker. This never blocks: all sessions share the loop."""
        self._received += size
        self._asked.put((message, size))

    async def serve(self, socket: WebSocket) -> None:
        """Carry messages between page and worker, until the page goes away."""
        if self.socket is not None:
            with contextlib.suppress(RuntimeError):
                await self.socket.close(4001, "the page is open elsewhere")
        self.socket = socket
        self._messages.clear()
        self._frames.clear()
        self.ask({"op": "greet", "coarse": "coarse" in socket.query_params})
        sender = asyncio.create_task(self._send(socket))
        try:
            while True:
                text = await socket.receive_text()
                try:
                    message = json.loads(text, parse_constant=int)  # NaN is not JSON
                except (ValueError, RecursionError) as error:
                    self._take({"type": "reply", "id": None, "error": f"no JSON: {error}"})
                    continue
                if self._received - self._passed + len(text) > MOST_WAITING:
                    number = message.get("id") if isinstance(message, dict) else None
                    said = "the world is busy, and too many messages wait; ask again later"
                    self._take({"type": "reply", "id": number, "error": said})
                    continue
                self.ask(message, len(text))
        except (WebSocketDisconnect, RuntimeError, KeyError):
            pass
        finally:
            sender.cancel()
            if self.socket is socket:
                self.socket, self.left = None, self._loop.time()
                self.ask({"op": "pause"})

    async def _send(self, socket: WebSocket) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await self._something.wait()
                self._something.clear()
                while self._messages or self._frames:
                    if not self._messages:
                        await socket.send_bytes(self._frames.pop(next(iter(self._frames))))
                        continue
                    message = self._messages.popleft()
                    form = "bytes" if isinstance(message, bytes) else "text"
                    await socket.send({"type": "websocket.send", form: message})


@final
class Studio:
    """The application: a page, and sessions. A token has to be in the address of every request."""

    def __init__(self, spec: Spec, first: PipedProcess, host: str, token: str) -> None:
        self.spec, self.host, self.token = spec, host, token
        self._started = [first]  # that no page has yet
        self._sessions: dict[str, _Session] = {}
        imports = {name: f"./{file}" for name, file in MODULES.items()}
        parts = {"imports": json.dumps({"imports": imports}), "style": read("studio.css")}
        self._page = page("index.html", parts)
        routes = [
            Route("/", self._index),
            Route("/{file:path}", self._file),
            WebSocketRoute("/session/{name}", self._socket),
        ]
        self.app = Starlette(routes=routes, lifespan=self._life)

    @contextlib.asynccontextmanager
    async def _life(self, _: Starlette) -> AsyncIterator[None]:
        watch = asyncio.create_task(self._watch())
        yield
        watch.cancel()
        closing = (asyncio.to_thread(one.worker.close) for one in self._sessions.values())
        await asyncio.gather(*closing)

    async def _watch(self) -> None:
        """End worlds whose page does not come back."""
        while True:
            await asyncio.sleep(5.0)
            now = asyncio.get_running_loop().time()
            for name, one in [*self._sessions.items()]:
                if one.ended or (one.socket is None and now - one.left > KEPT):
                    del self._sessions[name]
                    await asyncio.to_thread(one.worker.close)

    async def _index(self, request: Request) -> Response:
        if not allowed(request, self.host, self.token):
            return PlainTextResponse("open the address that the command printed", 403)
        return self._page

    async def _file(self, request: Request) -> Response:
        name = request.path_params["file"]
        if name not in MODULES.values():
            return PlainTextResponse("the file does not exist", 404)
        kind = mimetypes.guess_type(name)[0] or "text/javascript"
        return Response(read(name), media_type=kind, headers={"Cache-Control": "no-cache"})

    async def _socket(self, socket: WebSocket) -> None:
        name = socket.path_params["name"]
        if not allowed(socket, self.host, self.token) or not re.fullmatch(r"[0-9a-f]{32}", name):
            await socket.close(4003, "not allowed")
            return
        await socket.accept()
        session = self._sessions.get(name)
        if session is not None and session.ended:
            self._sessions.pop(name)
            await asyncio.to_thread(session.worker.close)
            session = None
        if session is None:
            away = [key for key, one in self._sessions.items() if one.socket is None]
            if len(self._sessions) >= MOST_SESSIONS and away:
                oldest = min(away, key=lambda key: self._sessions[key].left)
                await asyncio.to_thread(self._sessions.pop(oldest).worker.close)
            if len(self._sessions) >= MOST_SESSIONS:
                said = f"{MOST_SESSIONS} pages are open already; close one of them"
                await socket.send_text(json.dumps({"type": "fatal", "error": said}))
                await socket.close(4002, said)
                return
            await socket.send_text(json.dumps({"type": "building", "system": self.spec.system}))
            worker = self._started.pop() if self._started else PipedProcess(begin, self.spec)
            session = _Session(worker, asyncio.get_running_loop())
            self._sessions[name] = session
        await session.serve(socket)


def bind(config: Any) -> tuple[socket, str]:
    """Return a socket at the address of a configuration of uvicorn, and the address as a URL.

    Raises:
        UnknownOption: The address is taken, or is not of this machine.
    """
    try:
        bound = config.bind_socket()
    except (OSError, SystemExit) as error:
        allowed = (f"an address of this machine with a free port: {error}",)
        raise UnknownOption("--port", f"{config.host}:{config.port}", allowed) from None
    host = f"[{config.host}]" if ":" in config.host else config.host
    return bound, f"http://{host}:{bound.getsockname()[1]}"


def serve(
    spec: Spec,
    first: PipedProcess,
    *,
    host: str = "127.0.0.1",
    port: int = 8700,
    open_: bool = False,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the page until Ctrl-C, in the main thread.

    Args:
        spec: What worlds are made of.
        first: The process of the first page; it reads the system while the page opens.
        host: Address to bind; one that others can reach gets a token.
        port: Number of the port; any free one if 0.
        open_: Whether to open a browser.
        say: Called with the address.

    Raises:
        UnknownOption: The address is taken, or is not of this machine.
        ScmWorldError: The system cannot be read.
    """
    import uvicorn

    token = "" if host in LOCAL else secrets.token_urlsafe(24)
    studio = Studio(spec, first, host, token)
    config = uvicorn.Config(
        studio.app,
        host=host,
        port=port,
        log_level="warning",
        ws="websockets-sansio",
        ws_max_size=LARGEST,
        ws_per_message_deflate=False,  # on one machine it costs more time than it saves
    )
    bound, shown = bind(config)
    read = first.pipe.recv()
    if isinstance(read, Exception):
        raise read
    bound.listen()  # a page that is opened at once waits until the server answers
    address = f"{shown}/" + (f"?token={token}" if token else "")
    server = uvicorn.Server(config)

    def end(*_: object) -> None:
        server.should_exit = True  # and nothing more, however often it comes

    server.handle_exit = end  # type: ignore[method-assign,assignment] # while it serves
    before = signal.signal(signal.SIGINT, end)  # and before that
    try:
        say(address)
        if open_:
            webbrowser.open(address)
        server.run(sockets=[bound])
    finally:
        signal.signal(signal.SIGINT, before)
