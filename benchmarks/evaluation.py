"""Time an evaluation beside the predecessor's, and check that nothing about it is by chance.

::

    python -m benchmarks.evaluation --predecessor /path/to/environment/bin/python

Twelve protocols of pushing on MuJoCo, 200 episodes each, played by a small network. First the two
pipelines take turns on one core: this one, and CausalWorld 1.2 in the environment of its own that
``--predecessor`` names::

    pip install --no-deps causal-world==1.2 gym==0.17.3
    pip install pybullet==3.2.7 numpy scipy matplotlib psutil cloudpickle pyglet

It plays a fraction of the episodes, as its cost is linear in them. Then the whole evaluation is
played three times: on one core, with two workers, and with two workers that are killed on the way
and called again. All tables must be the same, bit for bit.

It prints what it finds and writes it as JSON.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import signal
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

from benchmarks import as_json
from benchmarks.evaluation_policy import Mlp
from benchmarks.evaluation_steps import shares
from scm_world.evaluation.pipeline import ShardRunner, evaluate
from scm_world.evaluation.preparation import prepare
from scm_world.evaluation.protocols import protocols_of
from scm_world.evaluation.setups import SHARD

TASK = "pushing"
PUBLISHED = 200  # episodes of a protocol in the predecessor's benchmark
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
EPISODES = 10  # of each protocol in a turn of ours: about as long as one of the predecessor's
CLOCKS = ("seconds", "processor")  # of the wall, and of the processor alone
HERE = Path(__file__).parent


@contextmanager
def pinned(core: int) -> Iterator[None]:
    """Stay on one core, and so do processes that are started meanwhile."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def timed(function: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """Call a function; give what it gives, and the seconds of the clock and of the processor."""
    started, busy = time.perf_counter(), time.process_time()
    found = function()
    return found, {
        "seconds": time.perf_counter() - started,
        "processor": time.process_time() - busy,
    }


# --- beside the predecessor -----------------------------------------------------------------------


def its_turn(python: str, fraction: float, network: int) -> dict[str, Any]:
    """Let the predecessor play."""
    script = str(HERE / "evaluation_predecessor.py")
    command = [python, script, "--fraction", str(fraction), "--network", str(network)]
    quiet = {**os.environ, **dict.fromkeys(THREADS, "1")}
    done = subprocess.run(  # noqa: S603 # our own script
        command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=quiet
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def our_turn(network: int, n: int) -> dict[str, Any]:
    """Play some episodes of each protocol; as for the predecessor, the start-up is told apart."""
    setup, start = timed(lambda: prepare(Mlp(network), None, TASK, n, 0, "mujoco", None, None))
    with closing(ShardRunner(setup)) as runner:
        rows, times = timed(lambda: [row for shard in setup.shards() for row in runner(shard)])
    return {**times, "start-up": start["seconds"], "episodes": len(rows)}


def compared(python: str, fraction: float, networks: int, repeats: int) -> dict[str, Any]:
    """Let both play with several networks, in turns."""
    our_turn(0, 1)  # compiled code is read
    rows = [_row(python, fraction, network, repeats) for network in range(networks)]
    return {
        "fraction": fraction,
        "networks": rows,
        "ratio, median": {c: statistics.median(row["ratio"][c] for row in rows) for c in CLOCKS},
        "ratio, least": {c: min(row["ratio"][c] for row in rows) for c in CLOCKS},
    }


def _row(python: str, fraction: float, network: int, repeats: int) -> dict[str, Any]:
    """Compare the best of each side."""
    sides: dict[str, list[dict[str, Any]]] = {"predecessor": [], "ours": []}
    for _ in range(repeats):
        sides["predecessor"].append(its_turn(python, fraction, network))
        sides["ours"].append(our_turn(network, EPISODES))
    best = {
        side: {c: min(turn[c] / turn["episodes"] for turn in turns) for c in CLOCKS}
        for side, turns in sides.items()
    }
    ratio = {c: best["predecessor"][c] / best["ours"][c] for c in CLOCKS}
    print(f"  network {network}: {ratio['processor']:.1f} times faster", flush=True)
    return {"network": network, "ratio": ratio, "an episode [s]": best, "turns": sides}


# --- the whole evaluation -------------------------------------------------------------------------


def whole(n: int, core: int) -> dict[str, Any]:
    """Play it three times, and compare the tables."""
    with pinned(core):
        one, single = timed(lambda: evaluate(Mlp(), task=TASK, n=n))
    two, double = timed(lambda: evaluate(Mlp(), task=TASK, n=n, workers=2))
    again, kept = interrupted(n)
    tables = {"one worker": one, "two workers": two, "killed and resumed": again}
    digests = {
        name: sha256(found.frame.to_csv().encode()).hexdigest() for name, found in tables.items()
    }
    return {
        "episodes": len(one),
        "versions": one.about["versions"],
        "control steps": int(one.frame["steps"].sum()),
        "one worker": single,
        "two workers": {"seconds": double["seconds"]},
        "shards": len(one.protocols) * -(-n // SHARD),
        "shards kept after the kill": kept,
        "digests": digests,
        "all equal": len(set(digests.values())) == 1 and one == two == again,
        "last fractional success": {
            name: float(table["last_fractional_success"].mean())
            for name, table in one.frame.groupby("protocol")
        },
    }


def ratios(its: dict[str, float], ours: dict[str, Any]) -> dict[str, float]:
    """Compare with what as many episodes cost the predecessor, which has no workers."""
    found = {
        f"{who}, {clock}": its[clock] * ours["episodes"] / seconds
        for who in ("one worker", "two workers")
        for clock, seconds in ours[who].items()
    }
    return {"the predecessor, all episodes [s]": its["seconds"] * ours["episodes"], **found}


def interrupted(n: int) -> tuple[Any, int]:
    """Kill an evaluation with two workers once a third is on the disk, and call it again."""
    with tempfile.TemporaryDirectory() as folder:
        options: dict[str, Any] = {"task": TASK, "n": n, "workers": 2, "out": folder}
        start = multiprocessing.get_context("spawn").Process
        process = start(target=evaluate, args=(Mlp(),), kwargs=options)
        process.start()
        third = len(protocols_of(TASK)) * -(-n // SHARD) // 3
        while process.is_alive() and _parts(folder) < third:
            time.sleep(0.05)
        process.kill()
        process.join()
        if process.exitcode != -signal.SIGKILL:
            raise SystemExit(f"it ended before it was killed, with exit code {process.exitcode}")
        kept = _parts(folder)
        return evaluate(Mlp(), **options), kept


def _parts(folder: str) -> int:
    return len(list(Path(folder, "parts").glob("*.json")))


# --- all of it ------------------------------------------------------------------------------------


def arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--predecessor", metavar="PYTHON", help="interpreter that has CausalWorld")
    parser.add_argument("--fraction", type=float, default=0.005, help="of 200 episodes, for it")
    parser.add_argument("--networks", type=int, default=3, help="with how many to compare")
    parser.add_argument("--turns", type=int, default=4, help="of each side with each of them")
    parser.add_argument("--episodes", type=int, default=PUBLISHED, help="of each protocol")
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=HERE / "evaluation" / "results.json")
    found = parser.parse_args()
    if min(found.turns, found.networks, found.episodes, int(PUBLISHED * found.fraction)) < 1:
        parser.error("one network, one turn and one episode at least")
    return found


def main() -> None:
    """Measure everything."""
    asked = arguments()
    results: dict[str, Any] = {}
    turns: dict[str, Any] | None = None
    with pinned(asked.core):
        if asked.predecessor is None:
            print("CausalWorld is left out: --predecessor PYTHON names an interpreter that has it")
        else:
            print("in turns, on one core:")
            turns = compared(asked.predecessor, asked.fraction, asked.networks, asked.turns)
            results["beside the predecessor"] = turns
        results["a control step [µs]"] = shares(TASK, episodes=3)
    found = results["whole"] = whole(asked.episodes, asked.core)
    if turns is not None:
        its = turns["networks"][0]["an episode [s]"]["predecessor"]
        found["ratio"] = ratios(its, found)
    print(json.dumps(results, indent=1, ensure_ascii=False))
    about = {"machine": platform.machine(), "system": platform.system(), "cores": os.cpu_count()}
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    asked.out.write_text(as_json({"about": about, "results": results}) + "\n")
    print(f"\nwritten to {asked.out}")
    if not results["whole"]["all equal"]:
        raise SystemExit("the tables differ")


if __name__ == "__main__":
    main()
