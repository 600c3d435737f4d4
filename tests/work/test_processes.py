"""A process of its own: what is asked of it, what goes wrong in it, and how it ends."""

from __future__ import annotations

import os
import signal
import threading
from functools import partial

import pytest
from work_samples import Bench, no_bench, product

from scm_world.errors import ActionError, EngineFailure, UnknownOption
from scm_world.work.processes import (
    THREADS,
    Ended,
    TookTooLong,
    Worker,
    children_single_threaded,
    single_threaded,
)


def is_gone(pid: int) -> bool:
    """Tell whether a process of ours is no more."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.fixture(scope="module")
def worker() -> Worker:
    """One process for all that does not end it."""
    return Worker(partial(Bench, 100))


# --- asked ----------------------------------------------------------------------------------------


def test_it_keeps_what_it_made(worker: Worker) -> None:
    """The thing is made once, with its arguments, in another process, and remembers."""
    first = worker.ask("add", 1)
    assert [worker.ask("add", 1), worker.ask("add", 5)] == [first + 1, first + 6]
    assert first > 100
    assert worker.ask("pid") == worker.ask("pid") != os.getpid()


def test_errors_of_ours_arrive_as_they_are(worker: Worker) -> None:
    """Class, message and attributes."""
    with pytest.raises(ActionError, match="too strong") as caught:
        worker.ask("refuse", "too strong")
    assert caught.value.action == {"torque": 3}


def test_other_errors_say_where_they_were_raised(worker: Worker) -> None:
    """Their class is the same, and the lines of the other process are a note."""
    with pytest.raises(KeyError) as caught:
        worker.ask("stumble")
    assert caught.value.args == ("b",)
    assert 'raise KeyError("b")' in "".join(caught.value.__notes__)


def test_what_cannot_travel_is_told(worker: Worker) -> None:
    """An error that cannot be read again keeps its words; so does a result that cannot be sent."""
    with pytest.raises(EngineFailure, match="Fussy: this and that"):
        worker.ask("fuss")
    with pytest.raises(Exception, match="pickle"):
        worker.ask("secret")
    assert worker.ask("add", 0) >= 100


def test_an_error_can_be_a_result(worker: Worker) -> None:
    """What a method gives is given, of whatever kind."""
    assert isinstance(worker.ask("error"), EOFError)


def test_what_cannot_be_sent_is_refused_before_anything_starts() -> None:
    """A function without a name, as what makes the thing and as an argument."""
    with pytest.raises(UnknownOption, match=r"make cannot be <function .*lambda"):
        Worker(lambda: [1])
    made = Worker(Bench)
    with pytest.raises(UnknownOption, match=r"argument of add cannot be .* a function or class"):
        made.ask("add", lambda: 0)
    assert made._process is None


def test_a_thing_that_cannot_be_made_is_told() -> None:
    """With the error of whoever makes it, each time."""
    with Worker(no_bench) as worker:
        for _ in range(2):
            with pytest.raises(ActionError, match="there is no room"):
                worker.ask("add", 1)


# --- ended ----------------------------------------------------------------------------------------


def test_a_process_that_ends_is_told_and_replaced() -> None:
    """By its exit code; the next question goes to a new one, which remembers nothing."""
    with Worker(Bench) as worker:
        worker.ask("add", 7)
        with pytest.raises(Ended, match="exit code 3") as caught:
            worker.ask("leave", 3)
        assert (caught.value.code, caught.value.was_interrupted) == (3, False)
        assert worker.ask("add", 1) == 1
        os.kill(worker.ask("pid"), signal.SIGKILL)
        with pytest.raises(Ended, match="exit code -9"):
            worker.ask("add", 1)


def test_who_takes_too_long_is_ended() -> None:
    """The process is no more, and a new one answers."""
    with Worker(Bench) as worker:
        pid = worker.ask("pid")
        with pytest.raises(TookTooLong):
            worker.ask("sleep", timeout=0.05)
        assert is_gone(pid)
        assert worker.ask("pid") != pid


def test_another_thread_can_interrupt() -> None:
    """Who waits gets an error, and so does who asks afterwards."""
    with Worker(Bench) as worker:
        pid = worker.ask("pid")
        timer = threading.Timer(0.1, worker.interrupt)
        timer.start()
        for _ in range(2):
            with pytest.raises(Ended, match="interrupted") as caught:
                worker.ask("sleep")
            assert caught.value.was_interrupted
        timer.join()
        assert is_gone(pid)


def test_ctrl_c_while_waiting_leaves_no_answer_behind() -> None:
    """The process is ended; otherwise its answer would be taken for that to the next question."""
    with Worker(Bench) as worker:
        pid = worker.ask("pid")
        with pytest.raises(KeyboardInterrupt):
            worker.ask("press_ctrl_c")
        assert is_gone(pid)
        assert worker.ask("add", 2) == 2


# --- threads --------------------------------------------------------------------------------------


def test_libraries_have_one_thread(worker: Worker, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the other process; the settings of this one are as they were, though it uses two."""
    monkeypatch.setenv(THREADS[0], "2")
    monkeypatch.delenv(THREADS[1], raising=False)
    assert worker.ask("settings") == dict.fromkeys(THREADS, "1")
    assert (os.environ[THREADS[0]], THREADS[1] in os.environ) == ("2", False)


def test_here_and_there_the_same_bits_come_out(worker: Worker) -> None:
    """A large product, with one thread in this process as well."""
    with single_threaded():
        here = product(3)
    assert here == worker.ask("product", 3)


def test_settings_are_undone_by_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads that hold them in turns leave nothing behind."""
    monkeypatch.setenv(THREADS[0], "5")
    inner, outer = children_single_threaded(), single_threaded()
    inner.__enter__()
    outer.__enter__()
    inner.__exit__(None, None, None)
    assert os.environ[THREADS[0]] == "1"
    outer.__exit__(None, None, None)
    assert os.environ[THREADS[0]] == "5"


def test_blas_has_one_thread_meanwhile() -> None:
    """Of as many as there were before, and as there are again afterwards."""
    from threadpoolctl import threadpool_info, threadpool_limits

    def threads() -> set[int]:
        return {library["num_threads"] for library in threadpool_info()}

    with threadpool_limits(limits=2):
        before = threads()
        with single_threaded():
            assert threads() == {1}
        assert threads() == before != {1}
