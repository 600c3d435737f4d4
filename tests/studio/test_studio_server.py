"""The server of ``scm-world studio``: who may ask it, and what bad messages do."""

from __future__ import annotations

import json
import secrets
import struct
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the extra 'studio' is not installed")
pytest.importorskip("uvicorn", reason="the extra 'studio' is not installed")
client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")

from studio_pages import PUSHER, Server, unpacked  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from scm_world.studio.server import MODULES, PAGE  # noqa: E402
from scm_world.studio.spec import FRAME  # noqa: E402

VENDORED = ("three", "cytoscape")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server of a small model."""
    folder = tmp_path_factory.mktemp("studio")
    (folder / "pusher.xml").write_text(PUSHER)
    made = Server("pusher.xml", folder=folder)
    yield made
    assert made.stop() == (0, "")  # no page is open any more


def got(url: str, **headers: str) -> tuple[int, str]:
    """Return status and text of a request."""
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 # our own server
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:  # noqa: S310
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


class Page:
    """What a page does: it asks, and takes what comes."""

    def __init__(self, socket: Any) -> None:
        self.socket, self.count = socket, 0
        self.news: dict[str, Any] = {}
        self.frames: list[bytes] = []

    def take(self) -> dict[str, Any]:
        """Return the next message that is no frame; of frames, nothing but that it came."""
        message = self.socket.recv(timeout=60)
        if isinstance(message, bytes) and message[0] == FRAME:
            self.frames.append(message)
            return {"type": "frame"}
        is_packed = isinstance(message, bytes)
        found: dict[str, Any] = unpacked(message) if is_packed else json.loads(message)
        self.news[found["type"]] = found
        return found

    def reply(self, number: int | None) -> dict[str, Any]:
        """Return the reply to a message."""
        while True:
            found = self.take()
            if found["type"] == "reply" and found["id"] == number:
                return found

    def ask(self, op: str, **given: Any) -> dict[str, Any]:
        """Ask for something, and return the reply."""
        self.count += 1
        self.socket.send(json.dumps({"op": op, "id": self.count, **given}))
        return self.reply(self.count)

    def values(self, *names: str) -> Any:
        """Return what the world is like now."""
        assert "ok" in self.ask("plot", names=list(names))
        while self.take()["type"] != "news":
            pass
        return self.news["news"]["values"], self.news["news"]["steps"], self.news["news"]["held"]


@contextmanager
def session(server: Server, name: str = "", **options: Any) -> Iterator[Page]:
    """Open a session, as a page does."""
    address = server.address.replace("http", "ws").partition("?")
    url = f"{address[0]}session/{name or secrets.token_hex(16)}{address[1]}{address[2]}"
    with client.connect(url, max_size=None, **options) as socket:
        yield Page(socket)


BAD = (
    {"op": "explode"},
    {"op": "__init__"},
    {"op": ["do"]},
    {"op": "do"},
    {"op": "do", "name": "cube.mass"},
    {"op": "do", "name": "cube.mass", "act": {"kind": "mechanism", "value": "os:system"}},
    {"op": "do", "name": "cube.mass", "act": {"kind": "hard"}},
    {"op": "do", "name": "cube.mass", "act": {"value": [1, 2, 3]}},
    {"op": "do", "name": "cube.mass", "act": {"value": "heavy"}},
    {"op": "do", "name": "cube.mass", "act": {"value": -1}},
    {"op": "do", "name": "cube.mass", "act": {"value": 1, "more": 2}},
    {"op": "do", "name": "cube.mass", "act": {"value": 1}, "lane": 1},
    {"op": "do", "name": "no.such", "act": {"value": 1}},
    {"op": "do", "name": "cube.mass", "act": {"value": 1, "window": True, "start": 9, "stop": 3}},
    {"op": "release", "name": "cube.mass"},
    {"op": "step", "n": 0},
    {"op": "step", "n": 1e9},
    {"op": "look", "step": 7},
    {"op": "play", "speed": -1},
    {"op": "policy", "name": "/etc/passwd"},
    {"op": "policy", "name": "zoo:../../secret"},
    {"op": "policy", "action": [1, 2]},
    {"op": "reset", "seed": -1},
    {"op": "split", "at": 99},
    {"op": "save", "what": "/etc/passwd"},
    {"op": "save", "what": "episode", "lane": 1},
    {"op": "plot", "names": ["no.such"]},
    {"op": "discover", "probes": 0},
    {"op": "cancel"},
    ["do"],
    17,
    None,
)


def test_bad_messages_get_an_error_and_change_nothing(server: Server) -> None:
    """Whatever is wrong: the reply says it, and the world is as it was."""
    with session(server) as page:
        assert "ok" in page.ask("step", n=2)
        before = page.values("cube.cartesian_position", "cube.mass", "slider.position")
        for message in BAD:
            given = {**message, "id": 77} if isinstance(message, dict) else message
            page.socket.send(json.dumps(given))
            reply = page.reply(77 if isinstance(message, dict) else None)
            assert reply["error"], message
        for text in ("", "{", "[" * 100_000, '{"op": "step", "id": NaN}'):
            page.socket.send(text)
            assert "no JSON" in page.reply(None)["error"]
        values = page.values("cube.cartesian_position", "cube.mass", "slider.position")
        assert values[0] == before[0]
        assert values[2] == before[2] == [[]]


def test_the_first_messages_describe_the_world(server: Server) -> None:
    """Variables, edges and shapes come first, then poses as 32-bit floats."""
    with session(server) as page:
        assert "ok" in page.ask("step")
        while not (page.frames and page.news.keys() >= {"hello", "scene"}):
            page.take()
        hello, scene = page.news["hello"], page.news["scene"]
        names = [variable["name"] for variable in hello["variables"]]
        assert "cube.mass" in names
        assert {shape["kind"] for shape in scene["shapes"]} == {"plane", "mesh", "box", "ellipsoid"}
        head = struct.unpack("<6I", page.frames[-1][:24])
        assert head[:2] == (1, 0)
        assert head[4] == len(scene["shapes"])
        assert len(page.frames[-1]) == 24 + 28 * (head[4] + head[5])


def test_a_world_waits_for_its_page(server: Server) -> None:
    """The same session continues; it is taken over by the page that came last."""
    name = secrets.token_hex(16)
    with session(server, name) as page:
        page.ask("step", n=3)
    with session(server, name) as page:
        assert page.values("cube.mass")[1] == 3
        with session(server, name) as other:
            assert other.values("cube.mass")[1] == 3
            with pytest.raises(ConnectionClosed, match="elsewhere"):
                page.ask("pause")


def test_a_busy_world_does_not_stop_the_others(tmp_path: Path) -> None:
    """More than its pipe holds waits for it, and a second page still opens; Ctrl-C ends both."""
    (tmp_path / "pusher.xml").write_text(PUSHER)
    server = Server("pusher.xml", folder=tmp_path)
    with session(server) as page:
        for _ in range(2000):  # for many minutes
            page.socket.send(json.dumps({"op": "step", "n": 1000}))
        for number in range(10):
            page.socket.send(json.dumps({"op": "x" * 900_000, "id": number}))
        assert "the world is busy" in page.reply(9)["error"]
    with session(server) as other:
        assert other.values("cube.mass")[1] == 0
        assert got(server.address)[0] == 200
    began = time.monotonic()
    assert server.stop()[0] == 0
    assert time.monotonic() - began < 20.0


def test_only_files_of_the_page_are_served(server: Server) -> None:
    """No path leads out of the page, and the page allows no foreign script."""
    status, text = got(server.address)
    assert status == 200
    assert "importmap" in text
    for file in MODULES.values():
        assert got(server.address + file) == (200, (PAGE / file).read_text(encoding="utf-8"))
    for path in ("../server.py", "%2e%2e/server.py", "index.html", "pusher.xml", "/etc/passwd"):
        assert got(f"{server.address}{path}")[0] == 404
    with urllib.request.urlopen(server.address) as answer:  # noqa: S310 # our own server
        policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe-eval" not in policy


def test_other_sites_are_refused(server: Server) -> None:
    """A page of another site can neither load this one nor open its websocket."""
    assert got(server.address, Host="evil.example")[0] == 403
    assert got(server.address, Origin="http://evil.example")[0] == 403
    with pytest.raises(InvalidStatus, match="403"), session(server, origin="http://evil.example"):
        pass
    with pytest.raises(InvalidStatus, match="403"), session(server, "not-a-session"):
        pass


def test_others_need_the_token(tmp_path: Path) -> None:
    """Bound elsewhere, the address has a token, and nothing is shown without it."""
    (tmp_path / "pusher.xml").write_text(PUSHER)
    server = Server("pusher.xml", "--host", "0.0.0.0", folder=tmp_path)  # noqa: S104
    here, _, token = server.address.replace("0.0.0.0", "127.0.0.1").partition("?token=")  # noqa: S104
    assert len(token) >= 32
    assert got(f"{here}?token={token}")[0] == 200
    assert got(here)[0] == got(f"{here}?token=wrong")[0] == 403
    server.address = here
    with pytest.raises(InvalidStatus, match="403"), session(server):
        pass
    server.stop()


def test_ctrl_c_ends_it_quietly(tmp_path: Path) -> None:
    """Nothing is printed with a page open, however often the keys are pressed."""
    (tmp_path / "pusher.xml").write_text(PUSHER)
    server = Server("pusher.xml", folder=tmp_path)
    with session(server) as page:
        page.ask("step", n=1)
        assert server.stop(times=3) == (0, "")


def test_a_taken_port_is_one_line(server: Server, tmp_path: Path) -> None:
    """The error says what to do."""
    with pytest.raises(AssertionError, match="free port"):
        Server("pushing", folder=tmp_path, port=server.port)


def test_a_system_that_does_not_exist_is_one_line(tmp_path: Path) -> None:
    """The command ends before anything is served."""
    with pytest.raises(AssertionError, match=r"missing\.xml"):
        Server("missing.xml", folder=tmp_path)


def test_a_world_that_cannot_be_built_says_why(tmp_path: Path) -> None:
    """The page gets the reason, and not only that the world has ended."""
    server = Server("pushing", "--backend", "step", folder=tmp_path)
    with session(server) as page:
        while "fatal" not in page.news:
            page.take()
        assert "world has ended" not in page.news["fatal"]["error"]
    server.stop()


def test_licences_lie_beside_what_is_vendored() -> None:
    """And all of it is small."""
    folder = PAGE / "vendor"
    for name in VENDORED:
        assert (folder / f"{name}.js").is_file()
        assert "Copyright" in (folder / f"LICENSE.{name}").read_text()
    size = sum(file.stat().st_size for file in PAGE.parent.rglob("*") if file.suffix != ".pyc")
    assert size < 4e6
