"""Facts about evaluations: the same bits every time, whatever happens in between."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_samples import (
    START,
    Counting,
    Waning,
    contents,
    linear,
    opposite,
    small,
)

from scm_world.errors import (
    EvaluationError,
    FunctionFailure,
    ScmWorldError,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.evaluation import Evaluation, evaluate
from scm_world.runs import files

# --- the same bits --------------------------------------------------------------------------------


def test_workers_and_order_change_nothing(tmp_path: Path) -> None:
    """Two processes, one process, other orders: the same rows, bit for bit."""
    how: Any = {"n": 27, "backend": "mujoco", "env": {"max_episode_length": 4}}
    policies = {"one": linear, "other": opposite}
    alone = evaluate(policies, "P0,P9", **how)
    assert len(alone) == 2 * 2 * 27
    turned = evaluate(dict(reversed(policies.items())), "P9,P0", workers=2, out=tmp_path, **how)
    assert len(turned) == len(alone)
    for agent in policies:
        for protocol in ("P0", "P9"):
            mine, its = (e.only(agent=agent, protocol=protocol).frame for e in (alone, turned))
            assert all(
                np.array_equal(its[name], mine[name], equal_nan=name[0] == "d") for name in mine
            )


def test_pairs_meet_the_same_draws_on_both_engines() -> None:
    """Episode i of a protocol has the same draws for every policy, on every engine."""
    found = evaluate(
        {"one": linear, "other": "still"},
        "P8,P11",
        n=3,
        backend="mujoco,bullet",
        env={"max_episode_length": 2},
    )
    for protocol in found.protocols:
        tables = [
            found.only(agent=agent, engine=engine, protocol=protocol)
            for agent in found.agents
            for engine in found.engines
        ]
        drawn = [table.drawn() for table in tables]
        assert len(drawn[0]) >= 3
        assert all(
            np.array_equal(other[name], drawn[0][name], equal_nan=True)
            for other in drawn[1:]
            for name in drawn[0]
        )
        assert len({tuple(table.frame["hash"]) for table in tables}) == 4
    assert found.difference("mujoco", "bullet", "P8", agent="one").n == 3


def test_seeds_are_other_episodes() -> None:
    """Each seed has its own draws; both together are the two apart."""
    both = small(seeds=(4, 7))
    assert both.only(seed=7) == small(seeds=7)
    one, other = (both.only(seed=seed, protocol="P6").drawn()[START] for seed in (4, 7))
    assert np.all(one[:, 0] != other[:, 0])


PROGRAM = """
import sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
from evaluation_samples import linear
from scm_world.evaluation import Evaluation, evaluate
def told(done, planned):
    time.sleep(0.2)  # so that there is time to interrupt it
evaluate({{"mine": linear}}, "P0,P6", n=100, backend="fake", env={{"max_episode_length": 3}},
         workers={workers}, out={out!r}, progress=told)
"""
HOW: dict[str, Any] = {"n": 100, "backend": "fake", "env": {"max_episode_length": 3}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Evaluation, dict[str, bytes]]:
    """Give the rows and files of one that nothing interrupts: eight parts."""
    out = tmp_path_factory.mktemp("whole")
    return evaluate({"mine": linear}, "P0,P6", out=out, **HOW), contents(out)


@pytest.mark.parametrize(("sent", "workers"), [(signal.SIGKILL, 2), (signal.SIGINT, 1)])
def test_interrupted_and_resumed_is_uninterrupted(
    sent: signal.Signals,
    workers: int,
    whole: tuple[Evaluation, dict[str, bytes]],
    tmp_path: Path,
) -> None:
    """Whenever it is stopped, the same call goes on and gives the same rows and files."""
    out = tmp_path / "parts"
    text = PROGRAM.format(tests=str(Path(__file__).parent), out=str(out), workers=workers)
    process = subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE)  # noqa: S603 # ours
    deadline = time.monotonic() + 120.0
    while len([*out.glob("parts/*.json")]) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(sent)
    process.communicate()
    assert process.returncode == -sent
    assert 2 <= len([*out.glob("parts/*.json")]) < 8
    again = evaluate({"mine": linear}, "P0,P6", out=out, **HOW)
    kept = {name: data for name, data in contents(out).items() if not name.endswith(".part")}
    assert (again, kept) == whole


def test_what_is_there_is_used_again(tmp_path: Path) -> None:
    """More episodes, protocols, engines and agents: only what is new is played."""
    counts = tmp_path / "count"
    out = tmp_path / "out"

    def played(*policies: str, **options: Any) -> int:
        counts.write_text("")
        agents = dict.fromkeys(policies, Counting(counts))
        small(agents, out=out, **options)
        return len(counts.read_text().splitlines()) - len(policies)  # each is tried once

    assert played("a", protocols="P0", n=25) == 25
    assert played("a", protocols="P0", n=25) == 0
    assert played("a", protocols="P0", n=50) == 25
    assert played("a", protocols="P1,P0", n=50) == 50
    assert played("a", protocols="P1,P0", n=50, seeds=(0, 1)) == 100
    assert played("b", "a", protocols="P0", n=25) == 25
    assert played("a", protocols="P0", n=25, backend="fake,mujoco") == 25
    assert played("a", protocols="P0", n=25, env={"max_episode_length": 15}) == 25


def test_another_policy_of_the_same_name_is_played(tmp_path: Path) -> None:
    """What a policy does counts, not what it is called: objects, functions and files."""
    first = small({"mine": linear}, out=tmp_path)
    other = small({"mine": opposite}, out=tmp_path)
    assert first != other
    assert other == small({"mine": opposite})
    assert small({"mine": linear}, out=tmp_path) == first
    actions = np.zeros((20, 9))
    by_array = small({"mine": actions}, out=tmp_path)
    assert small({"mine": actions + 0.5}, out=tmp_path) != by_array
    late = actions.copy()
    late[15] = 0.5  # the last action only
    assert small({"mine": late}, out=tmp_path) != by_array


# --- damage ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", [b'[{"agent": "mi', b"[3]", b"\xff\xfe"])
def test_a_cut_or_foreign_part_is_refused_by_name(content: bytes, tmp_path: Path) -> None:
    """Nothing is played instead of it, and nothing of it is used."""
    found = small(out=tmp_path)
    part = sorted(tmp_path.glob("parts/*.json"))[0]
    part.write_bytes(content)
    with pytest.raises(UnreadableFile, match=rf"{part.name}.*delete this file"):
        small(out=tmp_path)
    part.unlink()
    assert small(out=tmp_path) == found


def test_a_full_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says so; with room again the same call goes on."""
    calls = iter(range(100))

    def full(handle: int) -> None:
        if next(calls) == 2:  # the settings, the first part, then the second one
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(files.os, "fsync", full)
        with pytest.raises(UnwritableFolder, match="No space left"):
            small(out=tmp_path)
    assert len(contents(tmp_path)) == 2
    assert small(out=tmp_path) == small()


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    """Before anything is played."""
    tmp_path.chmod(0o500)
    with pytest.raises(UnwritableFolder, match="cannot be written to"):
        small(Waning("error", 0), out=tmp_path / "out")


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    """For the results, for the parts, and for what is saved."""
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UnwritableFolder, match="cannot be written to"):
            small(out=folder)
        with pytest.raises(UnwritableFolder, match="cannot be written to"):
            small().save(folder)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "parts").write_text("")
    with pytest.raises((UnwritableFolder, UnreadableFile), match="parts"):
        small(out=tmp_path / "out")


def test_two_do_not_write_to_one_folder(tmp_path: Path) -> None:
    """The second one is told to wait."""
    with files.locked(tmp_path), pytest.raises(UnreadableFile, match="another process"):
        small(out=tmp_path)


# --- policies that go wrong -----------------------------------------------------------------------


@pytest.mark.parametrize("how", ["nan", "shape"])
def test_bad_actions_are_told_with_their_place(how: str, tmp_path: Path) -> None:
    """Agent, engine, protocol, seed, episode and control step; what was finished is kept."""
    bad = {"good": linear, "bad": Waning(how, 4)}
    with pytest.raises(EvaluationError, match="gave") as caught:
        small(bad, "P0", n=4, seeds=3, out=tmp_path)
    assert caught.value.place == {
        "agent": "bad",
        "run": 0,
        "engine": "fake",
        "protocol": "P0",
        "seed": 3,
        "episode": 3,
        "control step": 12,
    }
    assert len([*tmp_path.glob("parts/*.json")]) == 1


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_a_policy_are_named_with_their_place(workers: int) -> None:
    """Their class and text, the place, and the traceback into the policy."""
    with pytest.raises(EvaluationError, match=r"ZeroDivisionError: .*by the policy") as caught:
        small({"bad": Waning("error", 2)}, "P6", n=4, workers=workers)
    assert {**caught.value.place, "agent": "bad", "protocol": "P6"} == caught.value.place
    assert "control step" in caught.value.place
    whole = "".join(traceback.format_exception(caught.value))
    assert "evaluation_samples.py" in whole


@pytest.mark.parametrize(
    "policy", [lambda observation: np.zeros(3), lambda observation: np.full(9, np.nan), np.sum]
)
def test_policies_that_do_not_fit_are_refused_at_once(
    policy: Callable[[Any], Any], tmp_path: Path
) -> None:
    """Wrong shapes and NaN: by name, before any episode."""
    with pytest.raises(EvaluationError, match=r"agent mine.*shape \(9,\)"):
        small({"mine": policy}, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_errors_at_the_first_try_name_the_agent(tmp_path: Path) -> None:
    """A policy that fails at once: what it raised, with the name that it has here."""
    with pytest.raises(EvaluationError, match=r"agent mine, run 0: .*ZeroDivisionError") as caught:
        small({"mine": lambda observation: 1 / 0}, out=tmp_path / "out")
    assert isinstance(caught.value.__cause__, FunctionFailure)
    assert isinstance(caught.value.__cause__.__cause__, ZeroDivisionError)
    assert not (tmp_path / "out").exists()


def test_what_other_processes_cannot_have_is_refused_at_once(tmp_path: Path) -> None:
    """A function of this test alone: nothing is begun."""
    with pytest.raises(UnknownOption, match=r"policy 'mine' with several workers.*module"):
        small({"mine": lambda observation: np.zeros(9)}, workers=2, out=tmp_path)
    assert contents(tmp_path) == {}
    assert len(small({"mine": lambda observation: np.zeros(9)}, workers=1)) == 6


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"task": "pushng"}, "did you mean 'pushing'"),
        ({"task": 3}, "task"),
        ({"n": 0}, "n cannot be 0"),
        ({"n": 2.5}, "n cannot be 2.5"),
        ({"n": True}, "n cannot be True"),
        ({"seeds": -1}, "seed"),
        ({"seeds": None}, "seed"),
        ({"seeds": 1.5}, "seed"),
        ({"seeds": ()}, "seeds"),
        ({"seeds": (1, 1)}, "each once"),
        ({"backend": "physx"}, "backend"),
        ({"backend": "fake,fake"}, "each once"),
        ({"backend": 3}, "backend"),
        ({"env": {"backend": "bullet"}}, "option of the environment"),
        ({"env": {"frame_skp": 3}}, "did you mean 'frame_skip'"),
        ({"env": {"frame_skip": 0}}, "frame_skip"),
        ({"env": 5}, "env"),
        ({"seeds": 2**63}, "from 0 to 9,223,372"),
        ({"workers": 0}, "workers"),
        ({"workers": 1.5}, "workers"),
        ({"policy": {}}, "policy"),
        ({"policy": []}, "one policy or more"),
        ({"policy": {"mine": []}}, "policies of mine"),
        ({"policy": {"a/b": "still"}}, "name of an agent"),
        ({"policy": {"": "still"}}, "name of an agent"),
        ({"policy": {3: "still"}}, "name of an agent"),
        ({"policy": "stil"}, "policy"),
        ({"policy": None}, "policy"),
        ({"policy": "nowhere.zip"}, "nowhere.zip"),
    ],
)
def test_wrong_arguments_are_refused_at_once(
    options: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """By one of our errors, which names what was given; nothing is written."""
    with pytest.raises((ScmWorldError, TypeError), match=said) as caught:
        small(**{"out": tmp_path / "out", **options})
    assert isinstance(caught.value, ScmWorldError)
    assert not list((tmp_path / "out").rglob("*.json"))
