"""Executors: one door, the same results behind it."""

from __future__ import annotations

import multiprocessing
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from work_samples import Bench, Task, make, no_bench

from scm_world.errors import ActionError, EngineFailure, MissingExtra, UnknownOption
from scm_world.work.executors import Executor, Processes, Serial, engine_of, opened
from scm_world.work.processes import cores

# --- results --------------------------------------------------------------------------------------


def test_results_do_not_depend_on_engine_and_workers() -> None:
    """To the last bit: in this process, in one other, and in two."""
    jobs = [Task(number, "product") for number in range(5)]
    found = []
    for executor in (Serial(), Processes(1), Processes(2)):
        with executor:
            found.append(dict(executor.run(make, jobs)))
    assert found[0] == found[1] == found[2]
    assert sorted(found[0]) == list(range(5))


def test_this_process_needs_no_pickle() -> None:
    """Functions without a name are done in their order, with what was made once."""
    made = []

    def build() -> Any:
        made.append(os.getpid())
        return lambda job: job()

    with Serial() as executor:
        executor.check("anything", lambda: 0)
        for _ in range(2):
            assert list(executor.run(build, [lambda: "a", lambda: "b"])) == [(0, "a"), (1, "b")]
    assert made == [os.getpid()]


def test_what_was_made_here_is_closed() -> None:
    """When something else is made, and in the end."""
    closed = []

    class Closing:
        def __init__(self, name: str) -> None:
            self.name = name

        def __call__(self, job: int) -> int:
            return job

        def close(self) -> None:
            closed.append(self.name)

    with Serial() as executor:
        list(executor.run(partial(Closing, "one"), [1]))
        assert closed == []
        list(executor.run(partial(Closing, "two"), [1]))
        assert closed == ["one"]
    assert closed == ["one", "two"]


def test_a_poison_job_is_in_nobody_s_way() -> None:
    """In this process, too, it is told when the rest is done."""
    found: dict[int, int] = {}
    with Serial() as executor, pytest.raises(ActionError, match="no 0") as caught:
        found.update(executor.run(make, [Task(0, "refuse"), Task(5), Task(6)]))
    assert found == {1: 25, 2: 36}
    assert caught.value.__notes__[-1] == "2 of 3 jobs are done"


def test_many_poison_jobs_are_listed_in_short() -> None:
    """Five beside the first one, and how many more there are."""
    with Serial() as executor, pytest.raises(ActionError, match="no 0") as caught:
        list(executor.run(make, [Task(number, "refuse") for number in range(9)]))
    notes = caught.value.__notes__
    assert [note.split(",")[0] for note in notes[1:6]] == [f"so did job {n}" for n in range(1, 6)]
    assert notes[6:] == ["and 3 more", "0 of 9 jobs are done"]


def test_an_error_of_make_ends_it_here_as_well() -> None:
    """No job is tried."""
    with Serial() as executor, pytest.raises(ActionError, match="there is no room") as caught:
        list(executor.run(no_bench, [Task(0), Task(1)]))  # type: ignore[arg-type] # gives nothing
    assert not hasattr(caught.value, "__notes__")


def test_processes_stay_for_the_same_make(tmp_path: Path) -> None:
    """Another one gets others, but not while there is work."""
    with Processes(1) as executor:
        pids = [next(executor.run(_Pid, [0]))[1] for _ in range(1)]
        pids += [pid for _ in range(2) for _, pid in executor.run(_Pid, [0, 1])]
        assert len(set(pids[1:])) == 1
        running = executor.run(partial(make, tmp_path), [Task(0), Task(1)])
        next(running)
        with pytest.raises(EngineFailure, match="at work"):
            next(executor.run(_Pid, [0]))
        assert list(running) == [(1, 1)]


class _Pid:
    """Tells which process it is in."""

    def __call__(self, job: int) -> int:
        """Tell."""
        return Bench().pid()


# --- which ----------------------------------------------------------------------------------------


def test_engines_are_chosen_by_name_or_by_workers() -> None:
    """One worker is this process, several are others."""
    assert isinstance(engine_of(), Serial)
    assert isinstance(engine_of(workers=1), Serial)
    assert isinstance(engine_of("serial", workers=1), Serial)
    kinds = {engine_of(workers=3).where, engine_of("process", workers=3).where}
    assert kinds == {"in 3 processes of this machine"}
    assert engine_of("process").workers == cores() >= 1
    assert engine_of("process", workers=1).where == "in 1 process of this machine"
    assert engine_of().where == "in this process"


@pytest.mark.parametrize(
    ("engine", "given", "said"),
    [
        ("dask", {}, "no engine of work is named 'dask'; there are: serial, process, ray"),
        ("serial", {"workers": 2}, "workers of the engine 'serial' cannot be 2"),
        (None, {"workers": 0}, "workers cannot be 0"),
        ("process", {"workers": True}, "workers cannot be True"),
        ("process", {"address": "auto"}, "None with the engine 'process'; 'ray' has one"),
        (None, {"address": "auto"}, "None with the engine 'serial'; 'ray' has one"),
    ],
)
def test_what_does_not_fit_is_refused(engine: str | None, given: Any, said: str) -> None:
    """With what there is."""
    with pytest.raises(UnknownOption) as caught:
        engine_of(engine, **given)
    assert said in str(caught.value)


def test_an_executor_is_left_open() -> None:
    """What is given is used as it is, and has its workers; what is named is closed."""
    others = set(multiprocessing.active_children())  # that another test of this process left
    with Serial() as executor:
        list(executor.run(make, [Task(1)]))
        with opened(executor) as same:
            assert same is executor
        assert executor._do is not None
        with pytest.raises(UnknownOption, match="has its own"), opened(executor, 2):
            pass
    with opened("process", 1) as other:
        assert isinstance(other, Executor)
        list(other.run(make, [Task(1)]))
    assert set(multiprocessing.active_children()) <= others


def test_ray_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, the error says how it is installed."""
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"scm-world\[cloud\]"):
        engine_of("ray")
