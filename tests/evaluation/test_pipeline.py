"""Facts about evaluations: the same bits every time, whatever happens in between."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_samples import Counting, Noisy, Waning, linear, opposite

from scm_world import World
from scm_world.errors import (
    EvaluationError,
    ModelError,
    ScmWorldError,
    SnapshotMismatch,
    UnknownOption,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.evaluation import METRICS, Evaluation, Protocol, check, evaluate, merge, why
from scm_world.evaluation import files as files_module
from scm_world.evaluation.arena import Row, scored
from scm_world.output import durable
from scm_world.queries import save_episode

SHORT = {"max_episode_length": 16}
MASS, START = "tool_block.mass", "tool_block.cylindrical_position"


def small(policy: Any = "random", protocols: Any = "P0,P6", **options: Any) -> Evaluation:
    """Evaluate a few short episodes without physics."""
    return evaluate(policy, protocols, **{"n": 3, "backend": "fake", "env": SHORT, **options})


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def by_hand(
    scores: Any, drawn: Any = None, *, agent: str = "a", protocol: str = "P1", run: int = 0
) -> list[Row]:
    """Make rows with given scores of success."""
    return [
        Row(
            agent,
            run,
            "fake",
            protocol,
            0,
            episode,
            10,
            {**dict.fromkeys(METRICS, 0.0), "last_fractional_success": float(score)},
            {} if drawn is None else {n: [float(v[episode])] for n, v in drawn.items()},
            f"{agent}{run}{episode}",
        )
        for episode, score in enumerate(scores)
    ]


# --- the same bits --------------------------------------------------------------------------------


def test_workers_and_order_change_nothing(tmp_path: Path) -> None:
    """Two processes, one process, other orders: the same rows, bit for bit."""
    how: Any = {"n": 27, "backend": "mujoco", "env": {"max_episode_length": 4}}
    policies = {"one": linear, "other": opposite}
    alone = evaluate(policies, "P0,P9", **how)
    shared = evaluate(policies, "P0,P9", workers=2, out=tmp_path, **how)
    assert shared == alone
    assert len(alone) == 2 * 2 * 27
    turned = evaluate({"other": opposite, "one": linear}, "P9,P0", **how)
    for agent in policies:
        for protocol in ("P0", "P9"):
            mine, its = (e.only(agent=agent, protocol=protocol).columns for e in (alone, turned))
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
        assert len({tuple(table.columns["hash"]) for table in tables}) == 4
    assert found.gap("mujoco", "bullet", "P8", agent="one").n == 3


def test_seeds_are_other_episodes() -> None:
    """Each seed has its own draws; both together are the two apart."""
    both = small(seeds=(4, 7))
    assert both.only(seed=7).digest == small(seeds=7).digest
    one, other = (both.only(seed=seed, protocol="P6").drawn()[START] for seed in (4, 7))
    assert np.all(one[:, 0] != other[:, 0])


PROGRAM = """
import sys, time
sys.path.insert(0, {tests!r})
from pathlib import Path
from evaluation_samples import linear
from scm_world.evaluation import evaluate
def told(done, planned):
    time.sleep(0.05)  # so that there is time to interrupt it
evaluate({{"mine": linear}}, "P0,P6", n=150, backend="fake", env={{"max_episode_length": 3}},
         workers={workers}, out={out!r}, progress=told)
"""


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGINT], ids=["kill", "ctrl-c"])
def test_interrupted_and_resumed_is_uninterrupted(
    sent: signal.Signals, workers: int, tmp_path: Path
) -> None:
    """Whenever it is stopped, the same call goes on and gives the same rows and files."""
    how: Any = {"n": 150, "backend": "fake", "env": {"max_episode_length": 3}}
    whole = evaluate({"mine": linear}, "P0,P6", out=tmp_path / "whole", **how)
    out = tmp_path / "parts"
    text = PROGRAM.format(tests=str(Path(__file__).parent), out=str(out), workers=workers)
    process = subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE)  # noqa: S603 # ours
    deadline = time.monotonic() + 120.0
    while len([*out.glob("parts/*.json")]) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(sent)
    process.communicate()
    assert process.returncode == -sent
    assert 2 <= len([*out.glob("parts/*.json")]) < 12
    again = evaluate({"mine": linear}, "P0,P6", out=out, **how)
    assert again == whole
    kept = {name: data for name, data in contents(out).items() if not name.endswith(".part")}
    assert kept == contents(tmp_path / "whole")


def test_what_is_there_is_used_again(tmp_path: Path) -> None:
    """More episodes, protocols, engines and agents: only what is new is played."""
    counts = tmp_path / "count"
    out = tmp_path / "out"

    def played(*policies: str, tried: int, **options: Any) -> int:
        counts.write_text("")
        agents = dict.fromkeys(policies, Counting(counts))
        small(agents, out=out, **options)
        return len(counts.read_text().splitlines()) - tried * len(policies)

    assert played("a", tried=2, protocols="P0", n=25) == 25
    assert played("a", tried=2, protocols="P0", n=25) == 0
    assert played("a", tried=2, protocols="P0", n=50) == 25
    assert played("a", tried=2, protocols="P1,P0", n=50) == 50
    assert played("a", tried=2, protocols="P1,P0", n=50, seeds=(0, 1)) == 100
    assert played("b", "a", tried=2, protocols="P0", n=25) == 25
    assert played("a", tried=2, protocols="P0", n=25, backend="fake,mujoco") == 25
    assert played("a", tried=2, protocols="P0", n=25, env={"max_episode_length": 15}) == 25


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


def test_policies_that_draw_for_themselves_are_told() -> None:
    """Its results cannot be repeated, and the results say so."""
    found = small({"noisy": Noisy(), "calm": linear})
    assert [agent["policy"].get("repeats") for agent in found.about["agents"]] == ["no", None]
    again = check(found, policy={"noisy": Noisy(), "calm": linear}, episodes=99, seed=0)
    assert all("two actions for one observation" in line for line in again.wrong)
    assert len(again.wrong) == 6


# --- damage ---------------------------------------------------------------------------------------


def spoiled(path: Path, how: str) -> None:
    """Damage a part."""
    text = path.read_text()
    data = json.loads(text)
    match how:
        case "cut":
            path.write_text(text[: len(text) // 2])
        case "score":
            data["rows"][0]["scores"]["success"] = 1.0
            path.write_text(json.dumps(data))
        case "fewer":
            del data["rows"][0]
            path.write_text(json.dumps(data))
        case "other":
            path.write_text("[]")
        case "bytes":
            path.write_bytes(b"\xff\xfe")


@pytest.mark.parametrize("how", ["cut", "score", "fewer", "other", "bytes"])
def test_a_damaged_part_is_refused_by_name(how: str, tmp_path: Path) -> None:
    """Nothing is played instead of it, and nothing of it is used."""
    found = small(out=tmp_path)
    part = sorted(tmp_path.glob("parts/*.json"))[0]
    spoiled(part, how)
    with pytest.raises(UnreadableFile, match=rf"{part.name}.*damaged.*delete this file"):
        small(out=tmp_path)
    part.unlink()
    assert small(out=tmp_path) == found


def test_a_part_of_another_shard_is_refused(tmp_path: Path) -> None:
    """A file under the name of another one does not pass for it."""
    small(out=tmp_path)
    one, other = sorted(tmp_path.glob("parts/*.json"))
    other.write_bytes(one.read_bytes())
    with pytest.raises(UnreadableFile, match=other.name):
        small(out=tmp_path)


def test_a_full_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says so; with room again the same call goes on."""
    calls = iter(range(100))

    def full(handle: int) -> None:
        if next(calls) == 2:  # the first part and its folder, then the second part
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(durable.os, "fsync", full)
        with pytest.raises(UnwritableFolder, match="No space left"):
            small(out=tmp_path)
    assert len(contents(tmp_path)) == 1
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
    with durable.locked(tmp_path), pytest.raises(UnreadableFile, match="another process"):
        small(out=tmp_path)


# --- policies that go wrong -----------------------------------------------------------------------


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("how", ["nan", "shape"])
def test_bad_actions_are_told_with_their_place(how: str, workers: int, tmp_path: Path) -> None:
    """Agent, engine, protocol, seed, episode and control step; what was finished is kept."""
    bad = {"good": linear, "bad": Waning(how, 5)}
    with pytest.raises(EvaluationError, match="gave") as caught:
        small(bad, "P0", n=4, seeds=3, workers=workers, out=tmp_path)
    assert caught.value.place == {
        "agent": "bad",
        "engine": "fake",
        "protocol": "P0",
        "seed": 3,
        "episode": 3,
        "control step": 12,
    }
    assert len(contents(tmp_path)) == (1 if workers == 1 else len(contents(tmp_path)))


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_a_policy_stay_what_they_are(workers: int) -> None:
    """Their class, their text, the traceback into the policy, and the place as a note."""
    with pytest.raises(ZeroDivisionError, match="by the policy") as caught:
        small({"bad": Waning("error", 3)}, "P6", n=4, workers=workers)
    said = "\n".join(caught.value.__notes__) + "".join(
        str(entry.path) for entry in caught.traceback
    )
    assert "agent bad, engine fake, protocol P6, seed 0, episode" in said
    assert "evaluation_samples.py" in said


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
        ({"backend": None}, "backend"),
        ({"env": {"backend": "bullet"}}, "option of the environment"),
        ({"env": {"frame_skp": 3}}, "did you mean 'frame_skip'"),
        ({"env": {"frame_skip": 0}}, "frame_skip"),
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
        ({"policy": "nowhere.onnx"}, "nowhere.onnx"),
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


# --- scores ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fractions", "last", "ends", "full"),
    [
        ([0.5], 0.5, 0.5, 0.5),
        ([1.0, 0.0, 0.5], 0.5, 0.5, 0.5),
        ([1.0] + [0.0] * 19, 0.0, 0.05, 0.05),
        ([1.0] + [0.0] * 20, 0.0, 0.0, 1 / 21),
        ([0.0] * 80 + [1.0] * 20, 1.0, 1.0, 0.2),
        ([0.0] * 81 + [1.0] * 19, 1.0, 0.95, 0.19),
    ],
)
def test_d12_the_last_steps_are_the_last_ones(
    fractions: list[float], last: float, ends: float, full: float
) -> None:
    """The mean over the last twenty control steps, or over fewer where there are fewer."""
    found = scored(fractions, success=False, total=0.0)
    assert found["last_fractional_success"] == last
    assert found["last_integrated_fractional_success"] == pytest.approx(ends, abs=1e-15)
    assert found["full_integrated_fractional_success"] == pytest.approx(full, abs=1e-15)


def test_published_names_and_figures() -> None:
    """Means and population standard deviations, as the predecessor writes them."""
    found = Evaluation.of({"task": "pushing"}, by_hand([0.0, 0.5, 1.0])).published()
    scores = found["P1"]
    assert sorted(scores) == sorted(
        f"{how}_{what}_fractional_success"
        for how in ("mean", "std")
        for what in ("last", "last_integrated", "full_integrated")
    )
    assert scores["mean_last_fractional_success"] == 0.5
    assert scores["std_last_fractional_success"] == pytest.approx(np.std([0.0, 0.5, 1.0]))


def test_paired_differences_are_surer() -> None:
    """Where episodes decide most, the paired interval is far narrower than two apart."""
    hard = np.random.default_rng(0).random(100)
    rows = by_hand(hard, agent="a") + by_hand(hard + 0.02, agent="b")
    found = Evaluation.of({"task": "pushing"}, rows)
    difference = found.difference("b", "a", "P1")
    assert difference.value == pytest.approx(0.02)
    assert difference.excludes(0.0)
    assert difference.width < 0.1 * found.score("P1", agent="a").width
    with pytest.raises(UnknownOption, match="both have played"):
        Evaluation.of({}, rows[:-1]).difference("b", "a", "P1")


def test_several_runs_are_strata() -> None:
    """A list of policies is one agent; IQM and the rest are over its runs."""
    found = small({"mine": ["still", "random", "sweep"], "other": linear})
    assert found.runs("mine") == (0, 1, 2)
    assert found.scores(agent="mine").shape == (3, 2, 3)
    assert set(found.overall(agent="mine")) == {
        "mean",
        "median",
        "interquartile_mean",
        "optimality_gap",
    }
    assert found.score("P0", agent="mine").n == 9
    assert found.difference("mine", "other", "P0").n == 3


def test_what_is_asked_for_must_exist() -> None:
    """Agents, protocols, metrics, engines and columns, by name."""
    found = small({"a": "still", "b": "random"})
    for ask, said in [
        (lambda: found.score("P0"), "agent"),
        (lambda: found.score("P0", agent="c"), "agent"),
        (lambda: found.score("P7", agent="a"), "protocol"),
        (lambda: found.score("P0", "succes", agent="a"), "did you mean 'success'"),
        (lambda: found.score("P0", agent="a", engine="bullet"), "engine"),
        (lambda: found.only(color="red"), "column"),
        (lambda: found.gap("fake", "bullet", "P0", agent="a"), "engine"),
        (lambda: found.causes("P7", agent="a"), "protocol"),
    ]:
        with pytest.raises(UnknownOption, match=said):
            ask()


# --- causes, and what would have been -------------------------------------------------------------


def test_a_planted_cause_is_found() -> None:
    """Of two variables that vary, the one that decides the score; over several runs their mean."""
    rng = np.random.default_rng(0)
    drawn = {"tool_block.mass": rng.random(120), "floor_friction": rng.random(120)}
    noise = 0.1 * rng.random((2, 120))
    rows = [
        row
        for run in (0, 1)
        for row in by_hand((drawn["tool_block.mass"] < 0.5) + noise[run], drawn, run=run)
    ]
    found = Evaluation.of({"task": "pushing"}, rows).causes("P1")
    first, second = found.ranked()
    assert (first.variable, second.variable) == ("tool_block.mass", "floor_friction")
    assert first.p_holm < 0.01
    assert first.share.value > 0.7
    assert first.column.contrast.high < -0.5
    assert [cause.variable for cause in found.found()] == ["tool_block.mass"]


def test_where_a_block_begins_decides_what_it_reaches() -> None:
    """With physics: nobody moves, so success is a matter of the two positions alone."""
    found = evaluate("still", "P7", n=60, env={"max_episode_length": 1})
    causes = found.causes("P7")
    assert {cause.variable for cause in causes.found()} <= {START, START.replace("tool", "goal")}
    assert causes.found()
    (mass,) = (cause for cause in causes.causes if cause.variable == MASS)
    assert mass.p > 0.05


def test_why_replaces_one_cause_at_a_time() -> None:
    """The others keep what was drawn; A gives a value of A, and the default the usual one."""
    found = small("still", "P8", n=4, env={"max_episode_length": 2})
    drawn = {n: v[1] for n, v in found.drawn().items()}
    told = []
    seen = why(found, "P8", 1, progress=lambda done, planned: told.append((done, planned)))
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert {other.variable for other in seen.others} == set(drawn)
    by_name = {other.variable: other for other in seen.others}
    assert by_name[MASS].was == tuple(drawn[MASS])
    assert 0.015 <= by_name[MASS].would_be[0] <= 0.045
    assert by_name[START].would_be[0] <= 0.11
    assert by_name[MASS].gain == 0.0
    usual = why(found, "P8", 1, versus="default")
    by_name = {other.variable: other for other in usual.others}
    assert by_name[MASS].would_be == (0.02,)
    assert "instead of" in str(usual)


def test_why_finds_what_broke_an_episode() -> None:
    """A block that begins far from where it should be: had it begun there, it had succeeded."""
    there = [0.0, 0.08, 0.0325]
    start = {f"{body}.cartesian_position": there for body in ("goal_block", "tool_block")}
    away = Protocol("away", act={"tool_block.cartesian_position": [0.0, -0.1, 0.0325], MASS: 0.05})
    found = small("still", away, n=1, env={**SHORT, "start": start})
    assert found.score("away").value < 0.5
    told = why(found, "away", 0, versus="default")
    best, other = told.others
    assert best.variable == "tool_block.cartesian_position"
    assert best.would_succeed
    assert best.gain > 0.5
    assert (other.variable, other.gain) == (MASS, 0.0)
    assert told.left_out == {"goal_block.cartesian_position": "it would have been the same"}


def test_why_within_an_episode_and_where_bodies_come() -> None:
    """What was drawn after some steps is told at that step; bodies that come are no obstacle."""
    late = why(small("still", "P8@3", n=2), "P8@3", 1, versus="default")
    assert {other.variable for other in late.others} >= {MASS}
    objects = Protocol("objects", ["nums_objects", "blocks_mass"], "B")
    many = small("still", objects, task="general", n=1, env={"max_episode_length": 2})
    found = why(many, "objects", 0)
    assert {o.variable for o in found.others} | set(found.left_out) == {
        "nums_objects",
        "blocks_mass",
    }


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        ({"protocol": "P6", "episode": 9}, "episode"),
        ({"protocol": "P9", "episode": 0}, "protocol"),
        ({"protocol": "P0", "episode": 0}, "varies something"),
        ({"protocol": "P6", "episode": 0, "versus": "C"}, "versus"),
        ({"protocol": "P6", "episode": 0, "metric": "beauty"}, "metric"),
        ({"protocol": "P6", "episode": 0, "run": 3}, "run"),
        ({"protocol": "P6", "episode": 0, "policy": {"typo": "still"}}, "policy"),
    ],
)
def test_why_refuses_what_there_is_not(ask: dict[str, Any], said: str) -> None:
    """Episodes, protocols and metrics that do not exist, and episodes without causes."""
    with pytest.raises(UnknownOption, match=said):
        why(small("still"), **ask)


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["parquet", "csv"])
def test_files_keep_every_bit(kind: str, tmp_path: Path) -> None:
    """Of integers, floats, texts and NaN; the summary has every score with its interval."""
    found = small({"a": linear, "b": ["random", "still"]}, "P0,P10")
    summary, table = found.save(tmp_path / "out", kind=kind)
    for path in (tmp_path / "out", summary):
        again = Evaluation.load(path)
        assert again == found
        assert again.about == json.loads(json.dumps(dict(found.about)))
        assert {n: c.dtype.kind for n, c in again.columns.items()} == {
            n: c.dtype.kind for n, c in found.columns.items()
        }
    data = json.loads(summary.read_text())
    assert [*data["scores"][0]] == ["agent", "engine", "protocol", *METRICS]
    assert len(data["scores"]) == 4
    assert {"python", "scm-world", "numpy", "fake"} <= set(data["about"]["versions"]["fake"])
    assert table.suffix == f".{kind}"


def test_saving_over_results_is_whole_or_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full leaves no file half-written."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left")

    monkeypatch.setattr(durable.os, "fsync", full)
    with pytest.raises(UnwritableFolder, match="No space left"):
        small().save(tmp_path)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("kind", ["parquet", "csv"])
@pytest.mark.parametrize(
    "how", ["no table", "cut", "other table", "no json", "list", "format", "about", "row", "text"]
)
def test_damaged_results_are_not_read(how: str, kind: str, tmp_path: Path) -> None:
    """The error names the file and says what to give."""
    summary, table = small().save(tmp_path, kind=kind)
    data = json.loads(summary.read_text())
    match how:
        case "no table":
            table.unlink()
        case "cut":
            table.write_bytes(table.read_bytes()[:-20])
        case "other table":
            small(seeds=9).save(tmp_path / "other", kind=kind)
            table.write_bytes((tmp_path / "other" / table.name).read_bytes())
        case "no json":
            summary.write_text("{")
        case "list":
            summary.write_text("[]")
        case "format":
            summary.write_text(json.dumps({**data, "format": "something/1"}))
        case "about":
            summary.write_text(json.dumps({**data, "about": {"task": "pushing"}}))
        case "row":
            summary.write_text(json.dumps({**data, "table": {"file": table.name}}))
        case "text":
            table.write_text("agent\nme\n\0\n")
    with pytest.raises(UnreadableFile, match=r"results\.json"):
        Evaluation.load(tmp_path)


def test_what_is_not_there_is_not_read(tmp_path: Path) -> None:
    """Folders without results, files that do not exist, and formats that do not."""
    for path in (tmp_path, tmp_path / "none", tmp_path / "none.json"):
        with pytest.raises(UnreadableFile):
            Evaluation.load(path)
    with pytest.raises(UnknownOption, match="did you mean 'parquet'"):
        small().save(tmp_path / "new", kind="parket")
    assert not (tmp_path / "new").exists()


# --- again ----------------------------------------------------------------------------------------


def test_results_pass_the_check(tmp_path: Path) -> None:
    """Named policies, functions and arrays, from the files alone or with the policy at hand."""
    found = small({"named": "random", "function": linear})
    found.save(tmp_path)
    read = Evaluation.load(tmp_path)
    told: list[int] = []
    again = check(
        read,
        episodes=99,
        trusted=["evaluation_samples"],
        progress=lambda done, _: told.append(done),
    )
    assert again
    assert (again.episodes, told) == (12, [*range(1, 13)])
    assert check(read, episodes=4, seed=1, policy={"named": "random", "function": linear})
    with pytest.raises(ModelError, match="trusted"):
        check(read, episodes=99)


@pytest.mark.parametrize("column", ["hash", "return", "steps", f"drawn {START}[0]"])
def test_a_changed_number_fails_the_check(column: str) -> None:
    """Whichever column it is in."""
    found = small("random", "P6")
    values = found.columns[column].copy()
    values[1] = "0" * 32 if column == "hash" else values[1] + 1
    again = check(Evaluation(found.about, {**found.columns, column: values}), episodes=99, seed=0)
    assert not again
    assert len(again.wrong) == 1
    assert "protocol P6, seed 0, episode 1" in again.wrong[0]


def test_another_policy_fails_the_check() -> None:
    """Given under the name of the one that acted."""
    found = small({"mine": linear})
    assert not check(found, policy=opposite)
    assert check(found, policy={"mine": linear})
    for wrong in ({"typo": linear}, {"mine": [linear, linear]}):
        with pytest.raises(UnknownOption, match="policy"):
            check(found, policy=wrong)
    unknown = small({"mine": lambda observation: np.zeros(9)})
    with pytest.raises(UnknownOption, match="policy"):
        check(unknown)


def test_other_versions_are_not_compared() -> None:
    """The error says which version the results were made with, and which one is here."""
    found = small()
    versions = {"fake": {**found.about["versions"]["fake"], "numpy": "0.1"}}
    changed = Evaluation({**found.about, "versions": versions}, found.columns)
    with pytest.raises(SnapshotMismatch, match=r"numpy 0\.1 \(here"):
        check(changed)


# --- merging --------------------------------------------------------------------------------------


def test_parts_of_several_machines_are_one_evaluation() -> None:
    """Agents, engines, protocols and seeds of several; the same row may be in two of them."""
    whole = small({"a": "random", "b": "still"}, "P0,P6", seeds=(0, 1))
    a, b = small({"a": "random"}, "P0,P6", seeds=(0, 1)), small({"b": "still"}, "P6", seeds=(1, 0))
    rest = small({"b": "still"}, "P0,P6", seeds=(0, 1))
    merged = merge([a, b, rest])
    for agent in ("a", "b"):
        for metric in METRICS:
            mine, its = (e.scores(metric, agent=agent) for e in (merged, whole))
            np.testing.assert_array_equal(mine, its)
    assert check(merged, episodes=99)
    assert merged.difference("a", "b", "P6") == whole.difference("a", "b", "P6")


def changed(found: Evaluation, **about: Any) -> Evaluation:
    """Give the same rows with something else said of them."""
    return Evaluation({**found.about, **about}, found.columns)


def test_what_differs_is_not_merged() -> None:
    """Tasks, options, versions, policies and protocols; all problems are told together."""
    found = small({"a": "random"}, [Protocol("mine", "*.mass")])
    versions = {"fake": {**found.about["versions"]["fake"], "numpy": "0.1", "python": "2.7"}}
    for other, said in [
        (
            small({"a": "random"}, [Protocol("mine", "*.mass", "B")]),
            "protocol mine is not the same",
        ),
        (small({"a": "still"}, [Protocol("mine", "*.mass")]), "agent a, run 0 is not the same"),
        (small({"b": "random"}, "P0", task="picking"), "task is 'pushing' in one and 'picking'"),
        (small({"b": "random"}, "P0", env={"max_episode_length": 9}), "env is"),
        (changed(found, versions=versions), r"numpy is .* and 0\.1(.|\n)*python is"),
    ]:
        with pytest.raises(ModelError, match=said):
            merge([found, other])
    hashes = found.columns["hash"].copy()
    hashes[0] = "0" * 32
    with pytest.raises(ModelError, match="episode 0 did not happen alike"):
        merge([found, Evaluation(found.about, {**found.columns, "hash": hashes})])
    with pytest.raises(ModelError, match="no evaluation"):
        merge([])


def test_one_file_in_two_places_is_one_policy(tmp_path: Path) -> None:
    """Where a machine keeps a policy does not matter, its content does."""
    episode = World("pushing", backend="fake").rollout("sweep", seed=0, steps=4)
    tables = []
    for name in ("here", "there"):
        (tmp_path / name).mkdir()
        save_episode(episode, tmp_path / name / "policy.npz")
        tables.append(small(str(tmp_path / name / "policy.npz"), out=tmp_path / "out"))
    assert len(contents(tmp_path / "out")) == 2
    assert merge(tables) == tables[0]


def test_the_formats_are_those_that_are_documented() -> None:
    """A new one needs a test above."""
    assert [*files_module.CODECS] == ["parquet", "csv"]
