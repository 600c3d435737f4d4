"""Discovery and verification in a process of their own."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from scm_world.discovery import discover
from scm_world.errors import in_one_line
from scm_world.queries import verify
from scm_world.studio.spec import Spec


def experiment(spec: Spec, kind: str, probes: int, seed: int, pipe: Connection) -> None:
    """Run ``"discover"`` or ``"verify"`` and report results; the pipe is closed at the end."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have it ignored
    about = {"type": "job", "kind": kind}
    edges: set[Any] = set()

    def found(now: set[Any]) -> None:
        new = sorted(now - edges)
        edges.update(new)
        pipe.send({**about, "edges": [list(edge) for edge in new]})

    def progress(done: int, planned: int) -> None:
        pipe.send({**about, "done": done, "planned": planned})

    try:
        threading.Thread(target=_listen, args=(pipe,), daemon=True).start()
        with spec.make() as world:
            common: dict[str, Any] = {"probes": probes, "seed": seed, "found": found}
            found_by: Callable[..., Any] = discover if kind == "discover" else verify
            report = found_by(world, progress=progress, **common)
        of = report.score if kind == "discover" else report
        missed = of.missed if kind == "discover" else of.never_fired
        extra = ((u.cause, u.effect, u.lag) if kind == "verify" else u for u in of.undeclared)
        facts = {"outcome": getattr(report, "headline", report.outcome), **dict(report.rows())}
        marked = {"missed": [*map(list, missed)], "extra": [*map(list, extra)]}
        pipe.send({**about, "facts": facts, **marked})
    except KeyboardInterrupt:
        pipe.send({**about, "error": "cancelled before the first probe state was finished"})
    except Exception as error:
        pipe.send({**about, "error": in_one_line(error)})
    finally:
        pipe.close()


def _listen(pipe: Connection) -> None:
    """Interrupt the work once something comes over the pipe."""
    with suppress(EOFError, OSError):
        pipe.recv()
        _thread.interrupt_main()
