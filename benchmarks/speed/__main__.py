"""Measure what the package costs, beside the bare engines and beside the predecessor.

::

    python -m benchmarks.speed                    # all of it, a quarter of an hour on one core
    python -m benchmarks.speed --only step,batch  # some of it; the other figures stay
    python -m benchmarks.speed --quick            # everything in two minutes, rough, elsewhere
    python -m benchmarks.speed --quick --record   # and a line of benchmarks/history.jsonl

It stays on one core (but where threads and workers are compared), writes ``results.json`` and
``speed.png``, and tables of goals and of the predecessor into ``docs/benchmarks/speed.md``. Sides
that are compared take turns; ratios are medians over rounds. The predecessor, CausalWorld 1.2, gets
an environment of its own in the cache, unless ``--predecessor`` names an interpreter that has it.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import as_json
from benchmarks.speed import history
from benchmarks.speed.adapter import adapting
from benchmarks.speed.batches import batching
from benchmarks.speed.changing import changing, making
from benchmarks.speed.growth import growing
from benchmarks.speed.memory import importing, remembering
from benchmarks.speed.parts import profiling
from benchmarks.speed.plots import draw
from benchmarks.speed.predecessor import comparing, found_or_made
from benchmarks.speed.scenes import SEED
from benchmarks.speed.seeing import seeing
from benchmarks.speed.stepping import stepping
from benchmarks.speed.tables import goals, page, put
from benchmarks.speed.timing import Settings, on
from scm_world.queries.experiments.versions import versions
from scm_world.runs.files import write_whole

HERE = Path(__file__).parent
DOCS = HERE.parents[1] / "docs"
SECTIONS: dict[str, Callable[[Settings], dict[str, Any]]] = {
    "step": stepping,
    "predecessor": comparing,
    "batch": batching,
    "adapter": adapting,
    "pixels": seeing,
    "changes": changing,
    "build": making,
    "profile": profiling,
    "growth": growing,
    "memory": remembering,
    "import": importing,
}
NEEDING = ("predecessor", "batch")
"""What is compared with the predecessor."""


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", help=f"some of {','.join(SECTIONS)}")
    parser.add_argument("--quick", action="store_true", help="rough figures in two minutes")
    parser.add_argument("--record", action="store_true", help="add them to the history")
    parser.add_argument("--predecessor", metavar="PYTHON", help="interpreter that has CausalWorld")
    parser.add_argument("--no-predecessor", action="store_true", help="leave it out")
    parser.add_argument("--sb3", metavar="PYTHON", help="interpreter with Stable-Baselines3")
    parser.add_argument("--core", type=int, help="the core to stay on; the last one by default")
    parser.add_argument("--out", type=Path, help="folder of the results; a new one if quick")
    parser.add_argument("--page", type=Path, help="the page with the tables")
    found = parser.parse_args(given)
    found.only = tuple(SECTIONS) if found.only is None else tuple(found.only.split(","))
    unknown = set(found.only) - SECTIONS.keys()
    if unknown:
        parser.error(f"there is no {min(unknown)!r}; there are {', '.join(SECTIONS)}")
    if found.out is None:
        found.out = Path(tempfile.mkdtemp(prefix="speed-")) if found.quick else HERE
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    if found.record and load > history.BUSY:
        most = f"{history.BUSY:g} a core are the most that is recorded"
        parser.error(f"other programs run: the load is {load:.2f} a core, {most}")
    if found.page is None and found.out == HERE:
        found.page = DOCS / "benchmarks" / "speed.md"
    return found


def about() -> dict[str, Any]:
    """Describe the machine and what runs on it."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    engines = {name: importlib.metadata.version(name) for name in ("mujoco", "pybullet")}
    return {
        "processor": next(models, platform.machine()),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {**versions(), **engines},
        "seed": SEED,
    }


def measured(name: str, settings: Settings, core: int, document: Any) -> bool:
    """Measure a section and put it into the document; tell whether that went well.

    What breaks is shown and left as it was, so that it does not take the rest with it.
    """
    print(f"{name} …", flush=True)
    started = time.perf_counter()
    try:
        with on({core}):
            found = SECTIONS[name](settings)
    except Exception:  # shown, and told by the exit code
        traceback.print_exc()
        return False
    how = {
        "load": round(os.getloadavg()[0], 2),
        "seconds": round(time.perf_counter() - started, 1),
        "quick": settings.quick,
    }
    print(f"{name}: {how['seconds']} s, load {how['load']}", flush=True)
    if found:
        document["results"][name], document["when"][name] = found, how
    return True


def main(given: list[str] | None = None) -> None:
    """Measure, and write everything; what is not measured now stays as it was."""
    asked = arguments(given)
    cores = frozenset(range(os.cpu_count() or 1))
    python = asked.predecessor
    if python is None and not asked.no_predecessor and set(asked.only) & set(NEEDING):
        python = found_or_made()
    settings = Settings(quick=asked.quick, predecessor=python, sb3=asked.sb3, cores=cores)
    asked.out.mkdir(parents=True, exist_ok=True)
    path = asked.out / "results.json"
    document: dict[str, Any] = {"about": {}, "when": {}, "results": {}}
    if path.exists():
        document = json.loads(path.read_text(encoding="utf-8"))
    document["about"] = about()
    core = max(os.sched_getaffinity(0)) if asked.core is None else asked.core
    before, broken = {**document["results"]}, []
    for name in asked.only:
        if not measured(name, settings, core, document):
            broken.append(name)
        write_whole(path, (as_json(document) + "\n").encode())
    if asked.record:
        now = {n: found for n, found in document["results"].items() if found is not before.get(n)}
        path = HERE.parent / "history.jsonl"
        rows = history.record(document["about"], now, quick=asked.quick, path=path)
        history.publish(rows, DOCS / "benchmarks" / "speed.md", DOCS / "images" / "history.png")
    draw(document["results"], (DOCS / "images" if asked.out == HERE else asked.out) / "speed.png")
    if asked.page is not None:
        put(page(document), asked.page)
    print("\n".join(goals(document["results"])))
    print(f"written to {asked.out}")
    if broken:
        raise SystemExit(f"these broke: {', '.join(broken)}")


if __name__ == "__main__":
    main()
