"""One writer for a folder in a store that knows no locks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, replace
from threading import Event
from typing import Any

import pytest
from stores import Careless, fresh

from scm_world.errors import UnreadableFile, UnwritableFolder
from scm_world.output import leases
from scm_world.output.durable import locked
from scm_world.output.leases import FORMAT, LEASE, LOCK, Holder, holder
from scm_world.output.remote import Remote


def occupied(folder: Remote, **other: Any) -> Holder:
    """Let somebody else hold a folder."""
    who = replace(holder(), **{"host": "elsewhere", **other})
    (folder / LOCK).put(json.dumps({"format": FORMAT, **asdict(who)}).encode())
    return who


@pytest.mark.parametrize("protocol", ["memory", "shelf", "careless"])
def test_a_folder_has_one_writer(protocol: str) -> None:
    """While it is locked a second one is refused, and then no more; nothing is left."""
    folder = fresh(protocol)
    with locked(folder), pytest.raises(UnreadableFile, match="another process"), locked(folder):
        pass
    with locked(folder):
        assert [one.name for one in folder.iterdir()] == [LOCK]
    assert list(folder.iterdir()) == []


def test_the_lock_is_removed_after_an_error() -> None:
    """Also after one that ends the work."""
    folder = fresh()
    with pytest.raises(KeyboardInterrupt), locked(folder):
        raise KeyboardInterrupt
    assert list(folder.iterdir()) == []


def test_who_holds_it_is_told() -> None:
    """Process, machine and time, and what to do if it is gone."""
    folder = fresh()
    occupied(folder, process=41, since=0.0)
    said = (
        rf"41 on elsewhere, since 1970-01-01 00:00:00 UTC.*delete {folder}/{LOCK}, or .*5 minutes"
    )
    with pytest.raises(UnreadableFile, match=said), locked(folder):
        pass
    assert (folder / LOCK).exists()


def test_a_writer_that_is_silent_is_replaced() -> None:
    """One of another machine after a while; what it then does to the lock is seen."""
    folder = fresh()
    gone = occupied(folder)
    occupied(folder, owner=gone.owner, heard=gone.heard - 2 * LEASE)
    with locked(folder):
        there = json.loads((folder / LOCK).read_bytes())
        assert there["process"] == os.getpid()
        occupied(folder)  # it was alive after all, and says so
    assert (folder / LOCK).exists()  # it is not ours


def test_a_writer_that_was_killed_is_replaced_at_once() -> None:
    """Its process is no more; or the number is ours, and it was not us."""
    folder, me = fresh(), holder()
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for process in (ended.pid, os.getpid()):
        occupied(folder, host=me.host, processes=me.processes, process=process)
        with locked(folder):
            pass
        assert list(folder.iterdir()) == []


def test_a_living_process_of_this_machine_is_not_replaced() -> None:
    """However long it works; of other containers the numbers mean nothing."""
    folder, me = fresh(), holder()
    occupied(folder, host=me.host, processes=me.processes, process=os.getppid())
    with pytest.raises(UnreadableFile, match="another process"), locked(folder):
        pass
    occupied(folder, host=me.host, processes="another container", process=2**22)
    with pytest.raises(UnreadableFile, match="another process"), locked(folder):
        pass


def test_the_holder_says_that_it_is_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    """From time to time, until another one holds the folder."""
    folder, renewed = fresh(), Event()
    put = Remote.put

    def watched(self: Remote, data: bytes) -> None:
        put(self, data)
        renewed.set()

    monkeypatch.setattr(leases, "RENEWED", 0.001)
    monkeypatch.setattr(Remote, "put", watched)
    with locked(folder):
        first = json.loads((folder / LOCK).read_bytes())
        assert renewed.wait(60.0)
        last = json.loads((folder / LOCK).read_bytes())
    assert last["heard"] > first["heard"]
    assert {**last, "heard": first["heard"]} == first


def test_of_two_at_once_the_store_keeps_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A store that creates twice keeps the last one; the first one sees it and goes."""
    folder = fresh("careless")
    create = Careless.pipe_file

    def late(self: Careless, path: str, value: bytes, mode: str = "overwrite", **_: Any) -> None:
        create(self, path, value)
        if mode == "create":
            occupied(folder)

    monkeypatch.setattr(Careless, "pipe_file", late)
    with pytest.raises(UnreadableFile, match="another process"), locked(folder):
        pass


def test_no_permission_is_told() -> None:
    """Before anything is done."""
    with pytest.raises(UnwritableFolder, match="Access Denied"), locked(fresh("closed")):
        pass


@pytest.mark.parametrize("text", [b"", b"[]", b'{"format": "other"}'])
def test_another_file_in_its_place_is_told(text: bytes) -> None:
    """It is named, and not removed."""
    folder = fresh()
    (folder / LOCK).put(text)
    with pytest.raises(UnreadableFile, match=r"it is no lock.*delete it"), locked(folder):
        pass
    assert (folder / LOCK).read_bytes() == text
