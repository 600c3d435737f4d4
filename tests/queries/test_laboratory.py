"""Facts about laboratories: permissions, budgets, logs, protocols."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.errors import (
    BudgetExhausted,
    Forbidden,
    InterventionError,
    UnknownOption,
    UnknownVariable,
    UnreadableFile,
    UnwritableFolder,
)
from scm_world.queries import Laboratory, Outcome, World
from scm_world.variables import Hard, Mechanism, Reaches

OUTCOMES = ("tool_block.mass", "floor_friction", Outcome("reward", "sum"))


def lab(**options: Any) -> Laboratory:
    """Open a small laboratory on an engine without physics."""
    given: dict[str, Any] = {"outcomes": OUTCOMES, "steps": 3, "nature": {"tool_block.mass": "A"}}
    return Laboratory(World("pushing", backend="fake"), **{**given, **options})


def test_experiments_are_of_new_units() -> None:
    """Each episode is another one, and all are in the books."""
    mine = lab(budget=10)
    seen, done = mine.see(3), mine.do({"floor_friction": 0.3}, n=4)
    assert (seen.numbers, done.numbers) == ((0, 1, 2), (3, 4, 5, 6))
    assert (mine.spent, mine.remaining) == (7, 3)
    assert [record.kind for record in mine.records] == ["see", "do"]
    assert done["floor_friction"].tolist() == [0.3] * 4


def test_the_budget_is_never_exceeded() -> None:
    """What costs more than is left is refused before it begins."""
    mine = lab(budget=5)
    mine.see(3)
    with pytest.raises(BudgetExhausted, match="2 are left"):
        mine.do({"floor_friction": 0.3}, n=3)
    with pytest.raises(BudgetExhausted):
        mine.run([{"floor_friction": 0.3}] * 3)
    assert mine.spent == 3
    mine.counterfactual(1, {"floor_friction": 0.3})
    mine.do({"floor_friction": 0.3})
    with pytest.raises(BudgetExhausted):
        mine.counterfactual(1, {})


@pytest.mark.parametrize(
    "request_",
    [
        {"gravity": [0.0, 0.0, -5.0]},
        {"floor_friction": Mechanism(np.sum, "gravity")},
        {"floor_friction": Hard(0.2, when=Reaches("joint_positions", above=1.0))},
    ],
    ids=repr,
)
def test_what_is_not_allowed_is_refused(request_: dict[str, Any]) -> None:
    """Setting, following and waiting need permission; a refusal costs nothing."""
    mine = lab(settable=["*friction"], visible=["tool_block.*", "floor_friction", "reward"])
    with pytest.raises(Forbidden, match="does not let you"):
        mine.do(request_)
    assert mine.spent == 0
    mine.do({"floor_friction": Hard(0.2, during=(1, 2))})


def test_questions_need_permission_too() -> None:
    """As does seeing; the graph is not there at all."""
    mine = lab(allow=["see"])
    for ask in (lambda: mine.do({"floor_friction": 0.3}), lambda: mine.counterfactual(0, {})):
        with pytest.raises(Forbidden):
            ask()
    with pytest.raises(Forbidden, match="see reward"):
        lab(visible=["tool_block.*"], outcomes=["reward"])
    with pytest.raises(UnknownOption, match="question"):
        lab(allow=["look"])
    with pytest.raises(UnknownOption, match="visible"):
        lab(visible=["nobody.*"])
    assert not [name for name in dir(mine) if "graph" in name or "model" in name]


def test_units_that_were_seen_can_be_imagined_otherwise() -> None:
    """The same unit, exactly, under another intervention; strangers cannot be."""
    mine = lab()
    done = mine.do({"floor_friction": 0.3}, n=2)
    same = mine.counterfactual(1, {})
    assert all(same[name] == done[name][1] for name in done)
    assert mine.counterfactual(1, {"floor_friction": 0.4})["floor_friction"] == 0.4
    with pytest.raises(Forbidden, match="never seen"):
        mine.counterfactual(2, {})


def test_a_refused_intervention_costs_nothing() -> None:
    """The books are as they were."""
    mine = lab(budget=3)
    with pytest.raises(InterventionError):
        mine.do({"floor_friction": -1.0}, n=2)
    assert mine.spent == 0


def test_a_laboratory_goes_on_with_its_log(tmp_path: Path) -> None:
    """All that had ended is there, half a line is not, and other terms are refused."""
    log = tmp_path / "log.jsonl"
    first = lab(log=log, budget=6)
    first.see(2)
    first.do({"floor_friction": 0.3}, n=2)
    with log.open("a") as stream:
        stream.write('{"kind": "do", "uni')
    again = lab(log=log, budget=6)
    assert again.remaining == 2
    for mine, its in zip(first.records, again.records, strict=True):
        assert mine.samples.plan == its.samples.plan
        for name in mine.samples:
            np.testing.assert_array_equal(mine.samples[name], its.samples[name])
    assert again.see(1).numbers == (4,)
    assert len(log.read_text().splitlines()) == 4
    with pytest.raises(UnreadableFile, match="seed"):
        lab(log=log, seed=1)
    log.write_text("no\n")
    with pytest.raises(UnreadableFile, match="no log"):
        lab(log=log)


def test_a_log_that_is_no_file_is_refused(tmp_path: Path) -> None:
    """A pipe is not waited for; a folder, a device and a missing folder are typed errors."""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", Path("/dev/full")):
        with pytest.raises(UnreadableFile, match=r"directory|no regular file"):
            lab(log=path)
    with pytest.raises(UnwritableFolder, match="No such file"):
        lab(log=tmp_path / "missing" / "log.jsonl")


def test_a_killed_process_loses_no_finished_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is killed in the middle of the third."""
    log = tmp_path / "log.jsonl"
    (tmp_path / "killed_policy.py").write_text(
        """
import os

def policy(world):
    calls = int(os.environ.get("CALLS", "0")) + 1
    os.environ["CALLS"] = str(calls)
    if calls > 10:
        os.kill(os.getpid(), 9)
    return world["joint_positions"]
"""
    )
    script = f"""
import sys
sys.path.insert(0, {str(tmp_path)!r})
from killed_policy import policy
from scm_world.queries import Laboratory, World
lab = Laboratory(World("pushing", backend="fake"), outcomes=["reward"], steps=2, log={str(log)!r},
                 policy=policy)
for _ in range(9):
    lab.see(2)
"""
    killed = subprocess.run([sys.executable, "-c", script], check=False)  # noqa: S603 # our own
    assert killed.returncode == -9
    monkeypatch.syspath_prepend(tmp_path)
    policy = importlib.import_module("killed_policy").policy
    world = World("pushing", backend="fake")
    again = Laboratory(world, outcomes=["reward"], steps=2, log=log, policy=policy)
    assert again.spent == 4
    with pytest.raises(UnreadableFile, match="policy differ"):
        Laboratory(world, outcomes=["reward"], steps=2, log=log, policy=lambda w: w["action"])


def test_a_protocol_is_a_table(tmp_path: Path) -> None:
    """Settings in, a data set out; what the log has is not done again."""
    table = tmp_path / "protocol.csv"
    table.write_text(
        "floor_friction,gravity[0],gravity[1],gravity[2],n\n0.3,,,,2\n,0,0,-5,1\n,,,,2\n"
    )
    log = tmp_path / "log.jsonl"
    found = lab(log=log, budget=5).run(table)
    assert [len(samples.numbers) for samples in found] == [2, 1, 2]
    assert found[0]["floor_friction"].tolist() == [0.3, 0.3]
    assert found[1].targets == ("gravity",)
    assert found[2].targets == ()
    again = lab(log=log, budget=5)
    for mine, its in zip(found, again.run(table), strict=True):
        np.testing.assert_array_equal(mine["sum reward"], its["sum reward"])
    assert again.remaining == 0
    with pytest.raises(UnknownOption, match="row 0"):
        again.run([{"floor_friction": 0.4}])


@pytest.mark.parametrize(
    ("rows", "error"),
    [
        ([{"nobody": 1.0}], UnknownVariable),
        ([{"floor_friction": "much"}], UnknownOption),
        ([{"gravity[2]": -5.0}], UnknownOption),
        ([{"floor_friction": 0.3, "n": 0}], UnknownOption),
        ("missing.csv", UnreadableFile),
    ],
    ids=repr,
)
def test_a_table_that_is_none_is_refused(rows: Any, error: type[Exception]) -> None:
    """Before anything is done."""
    mine = lab()
    with pytest.raises(error):
        mine.run(rows)
    assert mine.spent == 0
