"""One writer for a folder in an object store, which knows no locks: an object says who it is."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from threading import Event, Thread
from typing import final
from uuid import uuid4

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output.remote import Remote, said

LOCK = ".scm-world-lock"
FORMAT = "scm_world/lock/1"
RENEWED = 60.0  # [s] after which the writer says again that it is alive
LEASE = 300.0  # [s] after which a writer that said nothing counts as gone

_mine: set[str] = set()  # what this process holds


@final
@dataclass(frozen=True)
class Holder:
    """Who writes to a folder.

    Attributes:
        owner: A word that nobody else has.
        host: Name of the machine.
        processes: Which numbers of processes are meant: those of a container are its own.
        process: Number of the process.
        since: When it began, in seconds since 1970.
        heard: When it was last heard of.
    """

    owner: str
    host: str
    processes: str
    process: int
    since: float
    heard: float

    def is_gone(self) -> bool:
        """Tell whether it has ended, or said nothing for long."""
        me = holder()
        if (self.host, self.processes) == (me.host, me.processes):
            if self.process == me.process:
                return self.owner not in _mine  # a number that was given again
            if not _is_alive(self.process):
                return True
        return time.time() - self.heard > LEASE

    def __str__(self) -> str:
        began = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(self.since))
        return f"another process ({self.process} on {self.host}, since {began})"


def holder() -> Holder:
    """Say who this process is, under a new word."""
    processes = ""
    with suppress(OSError):
        processes = os.readlink("/proc/self/ns/pid")
    now = time.time()
    return Holder(uuid4().hex, socket.gethostname(), processes, os.getpid(), now, now)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


@contextmanager
def leased(folder: Remote) -> Iterator[None]:
    """Be the only one who writes to a folder.

    Of two that begin at once the store chooses one, if it can create an object once only, as S3,
    Google Cloud Storage and Azure can. A writer that was killed is known by its process on the
    same machine, and elsewhere by its silence; two that follow it in the same instant may both
    write. What is written this way has to be the same, whoever writes it.

    Raises:
        UnreadableFile: Somebody else is writing to it.
        UnwritableFolder: There is no permission, or no such store.
    """
    lock, me = folder / LOCK, holder()
    _mine.add(me.owner)
    try:
        _take(folder, lock, me)
        over = Event()
        renewing = Thread(target=_renew, args=(lock, me, over), daemon=True)
        renewing.start()
        try:
            yield
        finally:
            over.set()
            renewing.join()
            with suppress(OSError, UnreadableFile):  # else it is gone after LEASE
                _let_go(lock, me)
    finally:
        _mine.discard(me.owner)


def _take(folder: Remote, lock: Remote, me: Holder) -> None:
    """Become the holder, if there is none who is alive."""
    for _ in range(2):
        there = _there(folder, lock) or _begun(folder, lock, me)
        if there.owner == me.owner:
            return
        if not there.is_gone():
            break
        with suppress(OSError):
            lock.unlink(missing_ok=True)
    advice = (
        f"wait, or give another folder; if that process is gone, delete {lock}, or call again in "
        f"{LEASE / 60:.0f} minutes"
    )
    raise UnreadableFile(str(folder), f"{there} is writing to it", advice)


def _begun(folder: Remote, lock: Remote, me: Holder) -> Holder:
    """Try to become the holder; only by reading it is known who did."""
    reason = "what was written is not there"
    try:
        lock.create(_text(me))
    except OSError as error:  # another one was faster, or nobody may
        reason = said(error)
    there = _there(folder, lock)
    if there is None:
        raise UnwritableFolder(str(folder), reason)
    return there


def _renew(lock: Remote, me: Holder, over: Event) -> None:
    """Say from time to time that this process is alive, until it lets go or has been replaced."""
    while not over.wait(RENEWED):
        with suppress(OSError):  # the store may be back next time
            there = _there(lock.parent, lock)
            if there is not None and there.owner != me.owner:
                return
            lock.put(_text(replace(me, heard=time.time())))


def _let_go(lock: Remote, me: Holder) -> None:
    there = _there(lock.parent, lock)
    if there is not None and there.owner == me.owner:
        lock.unlink(missing_ok=True)


def _text(who: Holder) -> bytes:
    return json.dumps({"format": FORMAT, **asdict(who)}).encode()


def _there(folder: Remote, lock: Remote) -> Holder | None:
    """Read who holds a folder; None if nobody does.

    Raises:
        UnreadableFile: The object is something else.
        UnwritableFolder: The store does not answer.
    """
    try:
        data = json.loads(lock.read_bytes())
        if data.pop("format") != FORMAT:
            raise ValueError("another format")
        return Holder(**data)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UnwritableFolder(str(folder), said(error)) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UnreadableFile(str(lock), f"it is no lock ({error})", "delete it") from None
