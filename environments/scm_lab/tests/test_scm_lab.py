"""The environment, over a local server, with the client and the validator of OpenEnv."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest

pytest.importorskip("openenv")
HERE = Path(__file__).parents[1]
sys.path.insert(0, str(HERE))

from scm_lab import CallToolAction, ListToolsAction, ScmLabEnv  # noqa: E402
from scm_lab.example import Room, play  # noqa: E402

from scm_world import lab  # noqa: E402


@contextmanager
def served() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A server of its own process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "scm_lab.server.app", "--port", str(port)]
    with subprocess.Popen(command) as process:
        url = f"http://127.0.0.1:{port}"
        try:
            for _ in range(600):
                try:
                    urllib.request.urlopen(f"{url}/health", timeout=5).close()
                    break
                except OSError:
                    assert process.poll() is None
                    time.sleep(0.2)
            yield url, process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """The address of a server."""
    with served() as (address, _):
        yield address


def step(env: Any, tool: str, **arguments: Any) -> Any:
    """Call a tool."""
    return env.step(CallToolAction(tool_name=tool, arguments=arguments))


def test_validator_of_openenv_passes(url: str) -> None:
    """The package, and a running server."""
    for target in ([str(HERE), "--level", "static"], ["--url", url]):
        command = [str(Path(sys.executable).parent / "openenv"), "validate", *target, "--json"]
        found = subprocess.run(command, capture_output=True, text=True, check=False)
        assert found.returncode == 0, found.stdout + found.stderr
        report = json.loads(found.stdout)
        assert report.get("passed", report.get("verdict") == "pass"), report


def test_a_scripted_agent_has_the_score_that_it_has_without_a_server(url: str) -> None:
    """The reward comes with the answer; every step before has the reward 0."""
    question = lab.question("effect", seed=1)
    room = lab.play("ideal", question)
    assert room.score is not None
    assert play(url, "ideal", 1, kind="effect") == room.score["score"]
    with ScmLabEnv(base_url=url).sync() as env:
        result = env.reset(seed=1, kind="effect")
        expected = question.describe() | {"remaining": question.budget}
        assert result.observation.result == json.loads(json.dumps(expected))
        result = step(env, "observe", n=3)
        assert (result.reward, result.done) == (0.0, False)
        assert result.observation.result == lab.Laboratory(question).observe(3)
        result = step(env, "submit", answer=question.answer, confidence=1.0)
        assert (result.reward, result.done) == (1.0, True)
        assert env.state().seed == 1
        again = step(env, "submit", answer=0.0, confidence=0.0)
        assert (again.reward, again.done, again.observation.error.error_type) == (
            0.0,
            True,
            "invalid_args",
        )


def test_the_class_for_trl_is_played_by_a_script(url: str) -> None:
    """That of the README: it sets the cause to both values, and submits the difference."""
    (block,) = re.findall(r"^```python\n(.*?)^```$", (HERE / "README.md").read_text(), re.M | re.S)
    names: dict[str, Any] = {}
    exec(block, names)  # noqa: S102 # our own text
    names["URL"] = url
    episode = names["Episode"]()
    query = json.loads(episode.reset(seed=0))["query"]
    means = []
    for end in ("from", "to"):
        table = json.loads(episode.experiment({query["cause"]: query[end]}, 200))["columns"]
        means.append(fmean(table[query["outcome"]]))
    score = json.loads(episode.submit(means[1] - means[0], 0.9))["score"]
    assert names["reward"]([episode]) == [score]
    assert score == lab.question("effect", seed=0).grade(means[1] - means[0])


def test_tools_are_listed(url: str) -> None:
    """As the laboratory lists them, and as openenv.yaml declares them."""
    with ScmLabEnv(base_url=url).sync() as env:
        names = [tool.name for tool in env.step(ListToolsAction()).observation.result]
    assert names == [tool["name"] for tool in lab.tools()]
    assert f"declared_tools: [{', '.join(names)}]" in (HERE / "openenv.yaml").read_text()


HOSTILE = [
    ("observe", {"n": -1}),
    ("observe", {"n": 10**30}),
    ("observe", {"n": float("nan")}),
    ("observe", {"n": True}),
    ("observe", {"n": 1, "seed": 3}),
    ("experiment", {"do": {}}),
    ("experiment", {"do": {"nobody": 1.0}}),
    ("experiment", {"do": {"x0": float("inf")}}),
    ("experiment", {"do": {"x0": [0.0] * 10**4}}),
    ("experiment", {"do": "__import__('os').system('true')"}),
    ("experiment", {"do": {"x0": 0.0}, "n": 10**6}),
    ("note", {"text": "x" * 500_000}),
    ("submit", {"answer": 0.0}),
    ("submit", {"answer": 0.0, "confidence": 2.0}),
    ("submit", {"answer": "open('/etc/passwd').read()", "confidence": 0.5}),
    ("submit", {"answer": {"a": [[[[1]]]]}, "confidence": 0.5}),
    ("__class__", {}),
    ("save", {"path": "x"}),
    ("", {}),
]


def test_hostile_calls_change_and_cost_nothing(url: str) -> None:
    """Each is refused with a typed error, and the next reading is that of a fresh laboratory."""
    question = lab.question("effect", seed=2)
    with ScmLabEnv(base_url=url).sync() as env:
        result = step(env, "observe", n=1)
        assert result.observation.error.error_type == "execution_error"  # there is no episode yet
        env.reset(seed=2, kind="effect")
        for tool, arguments in HOSTILE:
            result = step(env, tool, **arguments)
            known = tool in {"observe", "experiment", "note", "submit"}
            kind = "invalid_args" if known else "tool_not_found"
            assert result.observation.error.error_type == kind, (tool, result)
            assert result.observation.error.message
            assert (result.reward, result.done) == (0.0, False)
        assert env.state().step_count == 0
        assert step(env, "observe", n=2).observation.result == lab.Laboratory(question).observe(2)


def test_many_sessions_at_once_are_apart(url: str) -> None:
    """Each episode has the readings that it has alone."""

    def first(seed: int) -> Any:
        with ScmLabEnv(base_url=url).sync() as env:
            room = Room(env, seed, kind="effect")
            return [room.observe(1) for _ in range(5)]

    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(first, [3, 4, 3, 4, 3, 4]))
    for seed, rows in zip([3, 4, 3, 4, 3, 4], found, strict=True):
        alone = lab.Laboratory(lab.question("effect", seed=seed))
        assert rows == [alone.observe(1) for _ in range(5)]


def test_a_killed_server_ends_the_episode_and_leaves_nothing(tmp_path: Path) -> None:
    """The client raises; a new server has the same question."""
    with served() as (url, process):
        env = ScmLabEnv(base_url=url).sync()
        env.connect()
        question = env.reset(seed=3, kind="effect").observation.result
        process.kill()
        process.wait()
        with pytest.raises(Exception, match=r"[Cc]onnect|closed|frame"):
            step(env, "observe", n=1)
        env.close()
    with served() as (url, _), ScmLabEnv(base_url=url).sync() as env:
        assert env.reset(seed=3, kind="effect").observation.result == question
