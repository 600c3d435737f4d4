"""Discovery and verification in a process of their own."""

from __future__ import annotations

import multiprocessing
import os
import signal
from multiprocessing.connection import Connection
from typing import Any, final

from scm_world.errors import in_one_line
from scm_world.studio.spec import Spec


@final
class StudioJob:
    """``"discover"`` or ``"verify"`` in a process of its own; its pipe is closed at the end."""

    def __init__(self, spec: Spec, kind: str, probes: int, seed: int) -> None:
        self.kind = kind
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe(duplex=False)
        given = spec, kind, probes, seed, other
        self._process = context.Process(target=_experiment, args=given, daemon=True)
        self._process.start()
        other.close()

    def interrupt(self) -> None:
        """Ask it to report the finished part, and to end."""
        if self._process.pid is not None and self._process.is_alive():
            os.kill(self._process.pid, signal.SIGINT)

    def end(self) -> None:
        """End it, finished or not."""
        self._process.terminate()
        self._process.join()
        self.pipe.close()


def _experiment(spec: Spec, kind: str, probes: int, seed: int, pipe: Connection) -> None:
    """Run experiments and report their results."""
    from scm_world.discovery import discover
    from scm_world.queries import verify

    signal.signal(signal.SIGINT, signal.default_int_handler)  # the session ignores it
    about = {"type": "job", "kind": kind}
    edges: set[Any] = set()

    def found(now: set[Any]) -> None:
        new = sorted(now - edges)
        edges.update(new)
        pipe.send({**about, "edges": [list(edge) for edge in new]})

    def progress(done: int, planned: int) -> None:
        pipe.send({**about, "done": done, "planned": planned})

    try:
        with spec.make() as world:
            common: dict[str, Any] = {"probes": probes, "seed": seed, "found": found}
            if kind == "discover":
                report = discover(world, progress=progress, **common)
                score = report.score
                facts: dict[str, Any] = {
                    "outcome": report.outcome,
                    "probe states": report.probes,
                    "precision": score.precision,
                    "recall": score.recall,
                    "F1": score.f1,
                    "SHD": score.shd,
                    "noise floor": report.floor,
                }
                missed, extra = score.missed, score.undeclared
            else:
                checked = verify(world, progress=progress, **common)
                facts = {"outcome": checked.headline}
                facts |= {name: said for name, said, _ in checked.rows()}
                missed = checked.never_fired
                extra = tuple((u.cause, u.effect, u.lag) for u in checked.undeclared)
            pipe.send(
                {
                    **about,
                    "facts": facts,
                    "missed": [list(edge) for edge in missed],
                    "extra": [list(edge) for edge in extra],
                }
            )
    except KeyboardInterrupt:
        pipe.send({**about, "error": "cancelled before the first probe state was finished"})
    except Exception as error:
        pipe.send({**about, "error": in_one_line(error)})
    finally:
        pipe.close()
