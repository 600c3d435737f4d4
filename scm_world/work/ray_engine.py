"""Jobs on Ray: a cluster, or processes that Ray starts on this machine."""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
import pickle
import platform
import socket
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from tempfile import gettempdir
from typing import Any, TypeVar, final

from scm_world.errors import EngineFailure, MissingExtra, UnknownOption
from scm_world.work.executors import RAY, Bag, Executor
from scm_world.work.processes import DONE, UNMADE, answered, single_threaded

SAME = ("scm-world", "numpy", "numba", "mujoco", "pybullet")
"""Packages whose versions decide what comes out of a job."""


@final
@dataclass(frozen=True)
class Luggage:
    """What a worker needs beside its jobs.

    Attributes:
        key: Names ``make``.
        make: Pickled; called once in each worker.
        paths: Where the process that asks finds its modules; it is looked there, too.
        folder: Where that process works.
        versions: Of what it uses; those of a worker have to be the same.
    """

    key: str
    make: bytes
    paths: tuple[str, ...]
    folder: str
    versions: dict[str, str]


_THINGS: dict[str, list[object]] = {}
_HELD = ExitStack()  # one thread for each library, until the worker ends


def versions() -> dict[str, str]:
    """List the versions that decide what comes out of a job."""
    found = {"python": platform.python_version()}
    for package in SAME:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "none"
    return found


def answer(luggage: Luggage, job: bytes) -> bytes:
    """Do a job; what was made for it is kept for the next one.

    Args:
        luggage: Beside the job.
        job: A tuple of it alone, pickled.

    Returns:
        What ``answered`` gives.
    """
    if luggage.key not in _THINGS:
        problem = _prepared(luggage)
        if problem is not None:
            return bytes(ForkingPickler.dumps((UNMADE, problem)))
    return answered(luggage.make, _THINGS[luggage.key], "__call__", job)


def _prepared(luggage: Luggage) -> EngineFailure | None:
    """Check versions and free memory for other jobs."""
    mine = versions()
    others = [name for name, version in luggage.versions.items() if mine[name] != version]
    if others:
        said = ", ".join(f"{n} is {mine[n]} there, {luggage.versions[n]} here" for n in others)
        return EngineFailure(f"a node of Ray would give other results: {said}", "ray")
    if not _THINGS:
        _HELD.enter_context(single_threaded())
    for things in _THINGS.values():
        for thing in things:
            getattr(thing, "close", lambda: None)()
    _THINGS.clear()
    _follow(luggage)
    _THINGS[luggage.key] = []
    return None


def _follow(luggage: Luggage) -> None:
    """Look for modules and files where the process that asks does, if that is there."""
    for path in (path or luggage.folder for path in luggage.paths):
        if path not in sys.path and Path(path).exists():
            sys.path.append(path)
    if Path(luggage.folder).is_dir():
        os.chdir(luggage.folder)


Job = TypeVar("Job")
Result = TypeVar("Result")

QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is reported to anybody
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # or it warns of a change of its own
}
PATIENCE = 10.0  # [s] for the head of a cluster to answer
HINT = "; if the cluster asks for a token, set RAY_AUTH_MODE=token as well"
ADDRESSES = ("auto", "host:port of the head of a running cluster")


def connected(workers: int | None, address: str | None) -> RayEngine:
    """Connect to a cluster, or start one of this machine alone.

    Where this process is connected already, that connection is used, and left open.

    Args:
        workers: How many jobs are done at the same time; as many as there are cores if None.
        address: Of the cluster; None to start one.

    Raises:
        MissingExtra: Ray is not installed.
        UnknownOption: The address is none.
        EngineFailure: There is no cluster that one can work with.
    """
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    try:
        ray = import_module("ray")
    except ImportError as error:
        raise MissingExtra("ray", "cloud") from error
    if ray.is_initialized():
        _check_same(ray, address)
        return RayEngine(ray, workers, is_mine=False)
    _check_answers(address)
    how: dict[str, Any] = {"address": address}
    if address is None:
        how = {"address": "local", "num_cpus": workers, "include_dashboard": False}
    try:
        ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        where = "on this machine" if address is None else f"at {address}"
        raise EngineFailure(f"there is no Ray {where}: {error}{HINT}", RAY) from None
    return RayEngine(ray, workers, is_mine=True)


def _check_answers(address: str | None) -> None:
    """Refuse an address without a cluster; Ray would wait for one for long."""
    if address is None:
        return
    where = _remembered() if address == "auto" else str(address)
    host, _, port = where.rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        if address == "auto":
            return
        raise UnknownOption("address", address, ADDRESSES)
    try:
        socket.create_connection((host, int(port)), timeout=PATIENCE).close()
    except (OSError, OverflowError) as error:
        asked = "" if where == address else f", which is {address!r} here"
        raise EngineFailure(f"there is no Ray at {where}{asked}: {error}", RAY) from None


def _remembered() -> str:
    """Say which cluster Ray means by ``"auto"``; it keeps this when the cluster is no more."""
    said = os.environ.get("RAY_ADDRESS", "")
    folder = Path(os.environ.get("RAY_TMPDIR") or gettempdir())
    with suppress(OSError):
        said = said or (folder / "ray" / "ray_current_cluster").read_text().strip()
    return said


def _check_same(ray: Any, address: str | None) -> None:
    there = ray.get_runtime_context().gcs_address
    if address not in (None, "auto", there):
        raise UnknownOption("address", address, (f"{there}, where this process is connected",))


@final
class RayEngine(Executor):
    """Does jobs as tasks of Ray, one core each; a worker or a node that is lost is replaced.

    Tasks are not tried again by Ray but from here, so that a job that kills its workers is put
    aside after as many tries as anywhere else.

    Args:
        ray: The package, connected.
        workers: How many jobs are done at the same time; as many as there are cores if None.
        is_mine: Whether the connection ends with this executor.
    """

    engine = RAY

    def __init__(self, ray: Any, workers: int | None, *, is_mine: bool) -> None:
        self._ray, self._is_mine = ray, is_mine
        self.workers = workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._task = ray.remote(num_cpus=1, max_retries=0)(answer)
        self._run: object = None

    @property
    def where(self) -> str:
        """Where the work is done, in words."""
        nodes = sum(node["Alive"] for node in self._ray.nodes())
        address = self._ray.get_runtime_context().gcs_address
        workers = f"{self.workers} worker{'s' * (self.workers > 1)}"
        return f"on Ray at {address}, {workers} on {nodes} node{'s' * (nodes > 1)}"

    def check(self, what: str, thing: object) -> None:
        """Check that something can be pickled; what the main module defines can be, too."""
        self._pickled(what, thing)

    def _pickled(self, what: str, thing: object) -> bytes:
        try:
            return bytes(self._ray.cloudpickle.dumps(thing))
        except Exception as error:
            allowed = ("a function or class, functools.partial of one, or plain data",)
            raise UnknownOption(what, thing, allowed) from error

    def run(
        self, make: Callable[[], Callable[[Job], Result]], jobs: Sequence[Job]
    ) -> Iterator[tuple[int, Result]]:
        """Do jobs; see ``Executor.run``."""
        made = self._pickled("make", make)
        given = [self._pickled(f"job {number}", (job,)) for number, job in enumerate(jobs)]
        return self._results(made, given, Bag(jobs, RAY))

    def _results(self, made: bytes, given: list[bytes], bag: Bag[Job]) -> Iterator[tuple[int, Any]]:
        if self._run is not None:
            raise EngineFailure("it is at work; read all results of it first", RAY)
        mine = self._run = object()
        key = hashlib.sha256(made).hexdigest()
        luggage = self._ray.put(Luggage(key, made, tuple(sys.path), os.getcwd(), versions()))
        flying: dict[Any, int] = {}
        try:
            while bag.waiting or flying:
                self._hand_out(bag, flying, given, luggage)
                (ref,), _ = self._ray.wait(list(flying), num_returns=1)
                answered = self._answer(ref, flying.pop(ref), bag)
                self._hand_out(bag, flying, given, luggage)
                yield from answered
                if self._run is not mine:
                    raise EngineFailure("it was closed before its work was done", RAY)
        finally:
            if self._run is mine:
                self._run = None
                for ref in flying:
                    self._ray.cancel(ref, force=True)
        bag.settle()

    def _hand_out(
        self, bag: Bag[Job], flying: dict[Any, int], given: list[bytes], luggage: Any
    ) -> None:
        """Have as many jobs done as there are workers."""
        while bag.waiting and len(flying) < self.workers:
            number = bag.waiting.popleft()
            flying[self._task.remote(luggage, given[number])] = number

    def _answer(self, ref: Any, number: int, bag: Bag[Job]) -> tuple[tuple[int, Any], ...]:
        """Take a result; none if the job failed, or its worker or node was lost."""
        known = self._ray.exceptions
        try:
            said = self._ray.get(ref)
        except (known.RayTaskError, known.RuntimeEnvSetupError) as error:
            raise EngineFailure(f"a worker of Ray cannot work: {error}", RAY) from None
        except known.RayError as lost:
            bag.put_back(number, lost)
            return ()
        how, result = pickle.loads(said)  # noqa: S301 # written by our own worker
        if how == DONE:
            return ((number, result),)
        if how == UNMADE:
            raise result
        bag.put_aside(number, result)
        return ()

    def close(self) -> None:
        """End the work; Ray, too, if it was started here, and else the connection to it."""
        self._run = None
        if self._is_mine and self._ray.is_initialized():
            with warnings.catch_warnings():
                # It leaves processes to the system that it has told to end.
                warnings.simplefilter("ignore", ResourceWarning)
                self._ray.shutdown()
