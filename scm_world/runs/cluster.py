"""Jobs as tasks of Ray: on a cluster, or in processes that Ray starts on this machine."""

from __future__ import annotations

import logging
import os
import pickle
import socket
import sys
import warnings
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any, final

from scm_world._arguments import load
from scm_world.errors import EngineFailure, UnknownOption
from scm_world.runs.processes import answered, pickled, single_threaded

RAY = "ray"
PATIENCE = 10.0  # [s] for the head of a cluster to answer; Ray itself would wait for minutes


@final
class Cluster:
    """A connection to Ray; one that this process has already is used, and left open.

    ``address`` is ``"auto"`` or ``host:port`` of the head; None is ``RAY_ADDRESS`` if it is set,
    and else processes that are started on this machine.
    """

    def __init__(self, address: str | None, workers: int | None) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anybody
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else Ray warns of it
        self._ray = load("ray", "ray", "cloud")
        address = address or os.environ.get("RAY_ADDRESS")
        self._is_mine = not self._ray.is_initialized()
        if self._is_mine:
            self._connect(address, workers)
        self.address = self._ray.get_runtime_context().gcs_address
        if address not in (None, "auto", self.address) and not self._is_mine:
            raise UnknownOption("executor", address, (f"{self.address}: it is connected there",))
        self.workers = workers or max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def _connect(self, address: str | None, workers: int | None) -> None:
        how: dict[str, Any] = {"address": address}
        if address is None:
            how = {"address": "local", "num_cpus": workers, "include_dashboard": False}
        host, _, port = (address or "").rpartition(":")
        try:
            if port.isdecimal():
                socket.create_connection((host, int(port)), timeout=PATIENCE).close()
            self._ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, OverflowError, RuntimeError, ValueError) as error:
            hint = "if the cluster asks for a token, set RAY_AUTH_MODE=token"
            said = f"Ray does not answer at {address or 'this machine'}: {error}; {hint}"
            raise EngineFailure(said, RAY) from None

    @property
    def where(self) -> str:
        """Where the work is done, in words."""
        nodes = sum(node["Alive"] for node in self._ray.nodes())
        workers = f"{self.workers} worker{'s' * (self.workers > 1)}"
        return f"on Ray at {self.address}, {workers} on {nodes} node{'s' * (nodes > 1)}"

    def pickled(self, what: str, thing: object) -> bytes:
        """Pickle an object for a worker; it may be defined in the main module."""
        return pickled(what, thing, self._ray.cloudpickle.dumps)

    def workers_for(self, work: bytes, count: int) -> list[RayWorker]:
        """Return workers; ``put`` sends the work once to each node."""
        context = self._ray.put((work, tuple(sys.path), os.getcwd()))
        return [RayWorker(self._ray, context) for _ in range(count)]

    def ready(self, jobs: list[Any]) -> list[Any]:
        """Wait for one of some jobs."""
        found: list[Any] = self._ray.wait(jobs, num_returns=1)[0]
        return found

    def close(self) -> None:
        """End Ray, or the connection to the cluster, if it was begun here."""
        if self._is_mine and self._ray.is_initialized():
            with warnings.catch_warnings():
                # It does not wait for the processes that it ends.
                warnings.simplefilter("ignore", ResourceWarning)
                self._ray.shutdown()


@final
class RayWorker:
    """One job at a time, as a task of one core; see ``Worker``."""

    def __init__(self, ray: ModuleType, context: object) -> None:
        self._ray, self._context, self._job = ray, context, None
        self._task = ray.remote(num_cpus=1, max_retries=0)(_answered)

    def begin(self, job: bytes) -> Any:
        """Submit a job; return its reference, for ``ready``."""
        self._job = self._task.remote(self._context, job)
        return self._job

    def answer(self) -> tuple[Any, Exception | None]:
        """Return the result or the error of the job; ``BrokenProcessPool`` without one."""
        faults, (job, self._job) = self._ray.exceptions, (self._job, None)
        try:
            found: tuple[Any, Exception | None] = pickle.loads(self._ray.get(job))  # noqa: S301
        except (faults.RayTaskError, faults.RuntimeEnvSetupError) as error:
            raise EngineFailure(f"a worker of Ray cannot work: {error}", RAY) from None
        except faults.RayError as error:
            raise BrokenProcessPool(f"its worker ended: {error}") from None
        return found

    def close(self) -> None:
        """End the job that is done."""
        if self._job is not None:
            self._ray.cancel(self._job, force=True)


# --- in a worker ----------------------------------------------------------------------------------


_KEPT: dict[bytes, list[Any]] = {}
_HELD = ExitStack()  # one thread for each library, until the worker ends


def _answered(context: tuple[Any, ...], job: bytes) -> bytes:
    """Do a job; the work is kept for the next one."""
    work, paths, folder = context
    if work not in _KEPT:
        if not _KEPT:
            _HELD.enter_context(single_threaded())
        # Modules and files are looked for where the process that asks does, if that is here.
        sys.path += [path for path in paths if path not in sys.path and Path(path).exists()]
        if Path(folder).is_dir():
            os.chdir(folder)
        _KEPT.clear()
        _KEPT[work] = [work]
    return answered(_KEPT[work], job)
