"""Laboratories over the Model Context Protocol, as a client without its library meets them.

Both major versions of the library are run by hand: ``docs/lab_hosts.md`` has the commands.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scm_world import lab
from scm_world.cli.app import app
from scm_world.errors import UnreadableFile
from scm_world.lab.mcp import LARGEST, Laboratories

pytest.importorskip("mcp")

from scm_world.lab.mcp import http

ASKED = [{"kind": "effect", "world": "equations", "seed": seed, "level": "L2"} for seed in (0, 1)]
FIRST, SECOND = "effect-equations-0-L2", "effect-equations-1-L2"
HELLO = {
    "protocolVersion": "2025-06-18",
    "capabilities": {},
    "clientInfo": {"name": "test", "version": "1"},
}
Ask = Callable[..., dict[str, Any]]


def request(method: str, **params: Any) -> bytes:
    """Return a message of JSON-RPC."""
    message = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
    return json.dumps(message).encode() + b"\n"


def result_of(text: bytes | str) -> dict[str, Any]:
    """Return what a tool returned; content and structured content are the same."""
    found = json.loads(text)["result"]
    structured: dict[str, Any] = found["structuredContent"]
    assert json.loads(found["content"][0]["text"]) == structured
    assert found["isError"] == ("refused" in structured)
    return structured


# --- standard input and output --------------------------------------------------------------------


@contextmanager
def stdio(folder: Path) -> Iterator[tuple[Ask, subprocess.Popen[bytes]]]:
    """Run the command, as a client does; call its tools."""
    command = [sys.executable, "-m", "scm_world", "lab", "serve", "effect", "--n", "2", "--mcp"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([*command, "--out", str(folder)], **pipes) as process:  # type: ignore[call-overload] # noqa: S603 # our own command

        def ask(tool: str, /, **arguments: Any) -> dict[str, Any]:
            process.stdin.write(request("tools/call", name=tool, arguments=arguments))
            process.stdin.flush()
            return result_of(process.stdout.readline())

        process.stdin.write(request("initialize", **HELLO))
        process.stdin.write(b'{"jsonrpc": "2.0", "method": "notifications/initialized"}\n')
        process.stdin.flush()
        assert b"scm-world-lab" in process.stdout.readline()
        try:
            yield ask, process
        finally:
            process.kill()


def test_a_killed_server_gives_no_budget_back(tmp_path: Path) -> None:
    """A new one goes on with the same bits; the file of the run is repeated by ``replay``."""
    question = lab.question("effect", seed=0)
    alone = lab.Laboratory(question)
    with stdio(tmp_path) as (ask, process):
        assert ask("observe", laboratory=FIRST, n=2) == alone.observe(2)
        process.kill()
        process.wait()
    with stdio(tmp_path) as (ask, process):
        assert ask("observe", laboratory=FIRST, n=2) == alone.observe(2)
        assert "refused" in ask("observe", laboratory=FIRST, n=-1)
        score = ask("submit", laboratory=FIRST, answer=question.answer, confidence=1.0)
        assert score == alone.submit(question.answer, 1.0)
        process.stdin.close()  # type: ignore[union-attr]
        assert process.wait(60) == 0  # it ends with its client
    (path,) = tmp_path.iterdir()  # no other file is left
    assert lab.replay(path) == []
    again = Laboratories(ASKED, out=tmp_path)
    assert "submitted" in again.call("observe", {"laboratory": FIRST})["refused"]
    path.write_text(path.read_text().replace('"n": 2', '"n": 3'))
    with pytest.raises(UnreadableFile, match="other results"):
        Laboratories(ASKED, out=tmp_path)._opened(FIRST)


# --- streamable HTTP ------------------------------------------------------------------------------


@contextmanager
def served(rooms: Laboratories, token: str = "") -> Iterator[Ask]:
    """Serve on a free port; send requests."""
    import uvicorn

    config = uvicorn.Config(http(rooms, token), port=0, log_level="warning")
    bound = config.bind_socket()
    bound.listen()  # requests wait until it answers
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
    thread.start()

    def post(data: bytes, **headers: str) -> tuple[int, str]:
        usual = {
            "Content-Type": "application/json",
            "Accept": "application/json, text/event-stream",
        }
        url = f"http://127.0.0.1:{bound.getsockname()[1]}/mcp"
        asked = urllib.request.Request(url, data, usual | headers)  # http
        try:
            with urllib.request.urlopen(asked, timeout=120) as answer:  # noqa: S310
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()

    try:
        yield post  # type: ignore[misc]
    finally:
        server.should_exit = True
        thread.join()


def test_many_clients_at_once_spend_each_episode_once() -> None:
    """Two laboratories, twenty calls each, at once: each reading is one of a single client."""
    rooms = Laboratories(ASKED)
    with served(rooms) as post:
        assert "2025" in post(request("initialize", **HELLO))[1]
        listed = json.loads(post(request("tools/list"))[1])["result"]["tools"]
        assert [tool["name"] for tool in listed] == [tool["name"] for tool in lab.tools()]
        assert listed[0]["inputSchema"]["properties"]["laboratory"]["enum"] == [FIRST, SECOND]

        def observe(name: str) -> str:
            text = post(request("tools/call", name="observe", arguments={"laboratory": name}))[1]
            return json.dumps(result_of(text))

        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(observe, [FIRST, SECOND] * 20))
    for offset, seed in enumerate((0, 1)):
        alone = lab.Laboratory(lab.question("effect", seed=seed))
        expected = sorted(json.dumps(alone.observe()) for _ in range(20))
        assert sorted(found[offset::2]) == expected


def test_pictures_are_images() -> None:
    """They are content of their own; everything else is text, and structured."""

    class Rooms:
        tools = staticmethod(lab.tools)

        def call(self, tool: str, arguments: Any) -> dict[str, Any]:
            return {"steps": [0, 4], "pictures": ["AAAA", "AAAB"]}

    with served(Rooms()) as post:  # type: ignore[arg-type]
        text = post(request("tools/call", name="look", arguments={}))[1]
    assert result_of(text) == {"steps": [0, 4]}
    images = json.loads(text)["result"]["content"][1:]
    assert [(one["type"], one["data"]) for one in images] == [("image", "AAAA"), ("image", "AAAB")]


def test_an_address_that_others_reach_needs_a_token() -> None:
    """Without it nothing is served; without a token, only requests of this machine are."""
    rooms = Laboratories(ASKED)
    with served(rooms, "secret") as post:
        assert post(request("tools/list"))[0] == 401
        assert post(request("tools/list"), Authorization="Bearer other")[0] == 401
        assert post(request("tools/list"), Authorization="Bearer secret")[0] == 200
    with served(rooms) as post:
        assert post(request("tools/list"), Host="example.org")[0] == 421
        assert post(request("tools/list"), Origin="http://example.org")[0] == 403
        assert post(request("tools/list"))[0] == 200


# --- hostile calls --------------------------------------------------------------------------------

HOSTILE = [
    ("describe", {"laboratory": "../../etc/passwd"}),
    ("describe", {"laboratory": [FIRST]}),
    ("describe", {"laboratory": None}),
    ("describe", {}),
    ("describe", {"laboratory": FIRST, "key": ""}),
    ("observe", {"laboratory": FIRST, "n": -5}),
    ("observe", {"laboratory": FIRST, "n": 0}),
    ("observe", {"laboratory": FIRST, "n": 1e300}),
    ("observe", {"laboratory": FIRST, "n": float("nan")}),
    ("observe", {"laboratory": FIRST, "n": "1"}),
    ("observe", {"laboratory": FIRST, "n": [1]}),
    ("observe", {"laboratory": FIRST, "n": None}),
    ("experiment", {"laboratory": FIRST}),
    ("experiment", {"laboratory": FIRST, "do": {}}),
    ("experiment", {"laboratory": FIRST, "do": []}),
    ("experiment", {"laboratory": FIRST, "do": {"h": 0.0}}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": float("inf")}}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": 1e9}}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": [1.0, -1.0]}}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": [[0.0, 1.0]]}}),
    ("experiment", {"laboratory": FIRST, "do": {f"x{i}": 0.0 for i in range(5000)}}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": "__import__('os')"}}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": 0.0}, "at": 5}),
    ("experiment", {"laboratory": FIRST, "do": {"x0": 0.0}, "n": 201}),
    ("note", {"laboratory": FIRST, "text": "x" * 100_000}),
    ("note", {"laboratory": FIRST, "text": {"a": 1}}),
    ("submit", {"laboratory": FIRST, "answer": 0.0}),
    ("submit", {"laboratory": FIRST, "answer": 0.0, "confidence": -0.1}),
    ("submit", {"laboratory": FIRST, "answer": 0.0, "confidence": float("nan")}),
    ("submit", {"laboratory": FIRST, "answer": float("nan"), "confidence": 0.5}),
    ("submit", {"laboratory": FIRST, "answer": "open('/etc/passwd')", "confidence": 0.5}),
    ("submit", {"laboratory": FIRST, "answer": {"edges": []}, "confidence": 0.5}),
    ("submit", {"laboratory": FIRST, "answer": [0.0] * 5000, "confidence": 0.5}),
    ("save", {"laboratory": FIRST, "path": "here"}),
    ("__init__", {"laboratory": FIRST}),
    ("question", {"laboratory": FIRST}),
    ("", {"laboratory": FIRST}),
    ("reset", {"laboratory": FIRST}),
]
BROKEN = [
    b"",
    b"{",
    b"[]",
    b"null",
    b"\xff\xfe",
    b"[" * 100_000,
    request("tools/call"),
    b'{"id": 1}',
]


def test_hostile_calls_change_and_cost_nothing(tmp_path: Path) -> None:
    """Each is refused with a reason; then the next reading is that of a fresh laboratory."""
    rooms = Laboratories(ASKED, out=tmp_path)
    with served(rooms) as post:
        for tool, arguments in HOSTILE:
            code, text = post(request("tools/call", name=tool, arguments=arguments))
            assert code == 200, (tool, arguments, text)
            assert result_of(text)["refused"], (tool, arguments)
        for data in BROKEN:
            code, text = post(data)
            assert code >= 400 or "error" in json.loads(text), data[:40]
        assert post(b" " * (LARGEST + 1))[0] == 413
        call = request("tools/call", name="observe", arguments={"laboratory": FIRST, "n": 2})
        found = result_of(post(call)[1])
    assert found == lab.Laboratory(lab.question("effect", seed=0)).observe(2)
    assert [path.name for path in tmp_path.iterdir()] == [f"{FIRST}.json"]


def test_the_command_refuses_what_it_cannot_serve() -> None:
    """Before it serves anything."""
    for wrong, named in (
        (("effect",), "--mcp"),
        (("effects", "--mcp"), "effects"),
        (("graph", "--world", "nowhere", "--mcp"), "nowhere"),
    ):
        found = CliRunner().invoke(app, ["lab", "serve", *wrong])
        assert found.exit_code == 2
        assert named in found.output
