"""The page on which a person answers the question of a laboratory."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the extra 'studio' is not installed")
uvicorn = pytest.importorskip("uvicorn", reason="the extra 'studio' is not installed")

from studio_pages import browser, until  # noqa: E402

from scm_world import lab  # noqa: E402
from scm_world.lab.questions import build  # noqa: E402
from scm_world.studio.lab import HOST, application  # noqa: E402
from scm_world.studio.server import bind  # noqa: E402


@contextmanager
def served(room: lab.Laboratory) -> Iterator[str]:
    """Serve the page in a thread; return its address."""
    config = uvicorn.Config(application(room), host=HOST, port=0, log_level="warning")
    bound, address = bind(config)
    bound.listen()
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, args=([bound],))
    thread.start()
    yield f"{address}/"
    server.should_exit = True
    thread.join()


def test_a_person_answers_on_a_page_that_knows_no_more_than_an_agent() -> None:
    """What is asked at the end appears then; no answer of the network has the graph or means."""
    asked = build("prediction", "springs", 1, "L1", lab.Knobs(), 0, None)
    room, texts = lab.Laboratory(asked), list[str]()
    with served(room) as address, browser() as chromium:
        page = chromium.new_page()
        page.on("pageerror", lambda error: pytest.fail(str(error)))

        def passed_on(route: Any) -> None:
            response = route.fetch()
            texts.append(response.text())
            route.fulfill(response=response)

        page.route("**", passed_on)
        page.goto(address)
        until(page, "document.body.dataset.ready")
        assert "when the budget is spent" in page.inner_text("#question")
        assert page.locator("form").count() == len(lab.tools()) - 1
        page.fill("#experiment [name=n]", "60")
        page.fill("#experiment [data-variable='left.mass']", "0.4, 1.2")
        page.fill("#experiment [data-variable='left.velocity']", "1")
        page.click("#experiment button")
        until(page, "document.querySelectorAll('#results tr').length === 61")
        page.fill("#observe [name=n]", str(room.remaining + 1))
        page.click("#observe button")
        until(page, "document.querySelector('.refused')")
        page.fill("#observe [name=n]", str(room.remaining))
        page.click("#observe button")
        until(page, "document.getElementById('question').textContent.includes('each of these')")
        assert "0 episodes are left" in page.inner_text("#remaining")
        page.reload()
        until(page, "document.body.dataset.ready")
        assert page.locator("#results article").count() == 2
        said = "".join(texts)
        assert "remaining" in said
        for secret in ("edges", "certificate", "digest", "seed", *map(str, asked.answer)):
            assert secret not in said
        page.fill("#submit [name=answer]", json.dumps(asked.answer))
        page.fill("#submit [name=confidence]", "0.9")
        page.click("#submit button")
        until(page, "document.getElementById('score').textContent.startsWith('Score 1;')")
    assert [one["tool"] for one in room.calls if one["tool"] != "describe"] == [
        "experiment",
        "observe",
        "submit",
    ]
    assert room.calls[1]["arguments"]["do"] == {"left.mass": [0.4, 1.2], "left.velocity": 1}


def test_other_pages_and_bad_messages_are_refused() -> None:
    """They change nothing."""
    room = lab.Laboratory(build("effect", "equations", 3, "L2", lab.Knobs(), 0, None))

    def got(path: str, data: bytes | None = None, **headers: str) -> tuple[int, Any]:
        request = urllib.request.Request(address + path, data, headers)  # noqa: S310 # our server
        try:
            with urllib.request.urlopen(request, timeout=20) as answer:  # noqa: S310
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as error:
            with error:
                return error.code, None

    with served(room) as address:
        for path, data in (("state", None), ("call", b'{"tool": "observe", "arguments": {}}')):
            assert got(path, data, Host="elsewhere.example")[0] == 403
            assert got(path, data, Origin="http://elsewhere.example")[0] == 403
        for bad in (b"", b"{", b"[]", b"3", b'{"tool": "observe"}', b"[" * 9000, b"\xff"):
            assert "refused" in got("call", bad)[1], bad
        for tool in ("record", "save", "_run", ["observe"], None):
            message = json.dumps({"tool": tool, "arguments": {}}).encode()
            assert "refused" in got("call", message)[1], tool
        assert got("call", b"{}", **{"Content-Length": str(2 << 20)})[0] == 413
        assert got("record")[0] == 404
        assert (room.calls, room.remaining) == ([], room.question.budget)
        assert got("state")[1]["score"] is None
