"""Measure an engine with thousands of worlds, and write one JSON: made for the short loan of a GPU.

``python -m benchmarks.warp --device cuda [--budget 520] [--out FILE]`` runs all parts within a
budget [s]; ``--quick`` is for the CPU device. Each part is a process with a share of the time that
is left, and its result, or why there is none, is written before the next one begins. Parts:

- ``first``: the first step, with the compilation of kernels.
- ``rates``: physics steps per second over numbers of worlds, of the engine alone and of the world,
  with another mass in every world (``do``) every 50 control steps.
- ``cpu``: ``mujoco.rollout`` on all cores, of the same model with the same spread.
- ``floor``: run-to-run floors over horizons, and the gaps to MuJoCo.
- ``conformance``: the suite of every engine, test by test; what needs bits fails without them.
- ``collect``: rows of episodes per second.
- ``train``: PPO in many worlds, stepped on the device, for as long as there is time, and what is
  computed on the host; then protocols on MuJoCo.

A checkout is enough: ``pip install 'scm-world[warp,scale]' pytest`` from its folder, then this.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import traceback
import xml.etree.ElementTree as Xml
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import as_json

TASK = "pushing"
SPREAD = 0.3  # [rad] of the targets of the joints around the start
BETWEEN = 50  # control steps between two interventions
SUITE = """
from scm_world.backends import make_backend
from scm_world.testing.backend import BackendConformance

class TestDevice(BackendConformance):
    coupling = 1e-5

    def make(self):
        return make_backend({backend!r})
"""


def tell(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


# --- parts ----------------------------------------------------------------------------------------


def targets(now: Any, seed: int) -> Any:
    """Draw targets of the joints, shape (n, 9) [rad]."""
    rng = np.random.default_rng(seed)
    return now + rng.uniform(-SPREAD, SPREAD, np.shape(now))


def first(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Time the first step of one world."""
    import scm_world as sw

    started = time.perf_counter()
    with sw.World(TASK, backend=how.backend) as world:
        world.reset(seed=0)
        world.step(world["joint_positions"])
        yield {
            "seconds": time.perf_counter() - started,
            "engine": world.engine,
            "floor_declared": world.backend.capabilities.floor,
            "scenes_declared": world.backend.capabilities.scenes,
        }


def rates(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Step numbers of worlds; one row for each, as soon as it is known."""
    rows: list[dict[str, Any]] = []
    left = time.monotonic() + how.seconds
    for n in how.sizes:
        begun = time.monotonic()
        rows.append(rate(how, n))
        yield {"rows": rows}
        growth = 4.0 if len(rows) > 1 else 1.0  # the first one compiles, and takes longest
        if growth * (time.monotonic() - begun) > left - time.monotonic():
            break  # the next one is four times as large


def rate(how: argparse.Namespace, n: int) -> dict[str, Any]:
    """Measure one number of worlds: of the engine alone, and with everything of a world."""
    import scm_world as sw
    from scm_world.errors import EngineFailure

    clock, found = time.perf_counter, dict[str, Any](worlds=n, lost=0)
    begun = clock()
    worlds: Any = sw.World(TASK, backend=how.backend, num_worlds=n)
    found["open_s"] = clock() - begun
    begun = clock()
    worlds.reset(seed=0)
    found["reset_s"] = clock() - begun
    start, goes_on, acts = worlds["joint_positions"], np.ones(n, bool), []

    def step(number: int) -> None:
        if number % BETWEEN == 0:
            begun = clock()
            worlds.do({"tool_block.mass": np.linspace(0.02, 0.09, n)}, where=goes_on)
            acts.append(clock() - begun)
        try:
            worlds.step(targets(start, number // 5), where=goes_on)
        except EngineFailure as error:
            goes_on[[*error.lost, *error.unmoved]] = False

    for number in range(2):
        step(number)
    begun, before, steps = clock(), len(acts), how.steps
    for number in range(2, 2 + steps):
        step(number)
    whole = clock() - begun
    inside = whole - sum(acts[before:])
    substeps = worlds.world(0).substeps
    found |= {"lost": int((~goes_on).sum()), "do_first_s": acts[0], "do_s": acts[-1]}
    found["control_steps_per_s"] = n * steps / whole
    found["physics_steps_per_s"] = n * steps * substeps / whole
    found["physics_steps_per_s_without_do"] = n * steps * substeps / inside
    which = np.flatnonzero(goes_on)
    commands = np.clip(targets(start, 1), *worlds.world(0).compiled.action_bounds)
    into = np.empty((n, worlds.world(0).structure.layout.size))
    begun, turns = clock(), max(1, steps // 4)
    for _ in range(turns):
        try:
            worlds._engine.step(which, commands, substeps, into)
        except EngineFailure as error:
            which = np.setdiff1d(which, [*error.lost, *error.unmoved])
    found["engine_physics_steps_per_s"] = n * turns * substeps / (clock() - begun)
    found["lost_at_end"] = n - len(which)
    worlds.close()
    return found


def cpu(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Roll out the model of the MuJoCo backend on all cores, from the same spread."""
    import mujoco
    from mujoco import rollout

    import scm_world as sw
    from scm_world.runs.processes import cores

    with sw.World(TASK) as world:
        world.reset(seed=0)
        world.step(world["joint_positions"])
        realization: Any = world.backend.realization  # type: ignore[attr-defined] # MuJoCo's
        model, start = realization.model, np.array(world["joint_positions"])
        state = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
        numbers = np.empty((1, mujoco.mj_stateSize(model, state)))
        mujoco.mj_getState(model, realization.data, numbers[0], state)
    n, count = how.cpu_worlds, how.cpu_steps
    found = {"cores": cores(), "worlds": n}
    for name, threads in (("one_core", 1), ("all_cores", cores())):
        controls = np.zeros((n, count, model.nu))  # the other actuators are safety damping
        for i in range(0, count, 50):
            controls[:, i : i + 50, : len(start)] = targets(np.tile(start, (n, 1)), i)[:, None]
        each = [mujoco.MjData(model) for _ in range(threads)]
        rollout.rollout(model, each, numbers, controls[:, :50])
        begun = time.perf_counter()
        rollout.rollout(model, each, numbers, controls)
        found[f"physics_steps_per_s_{name}"] = n * count / (time.perf_counter() - begun)
    yield found


def floor(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Measure run-to-run floors, and an effect that is none; then the gaps to MuJoCo."""
    import scm_world as sw

    with sw.World(TASK, backend=how.backend) as world:
        found: dict[str, Any] = {"floors": []}
        names = ("tool_block.cartesian_position", "joint_positions")
        for steps in how.horizons:
            samples = world.sample(64, outcomes=names, steps=steps)
            largest = {name: float(np.max(samples.floors.get(name, 0.0))) for name in names}
            found["floors"].append({"steps": steps, **largest})
            yield found
        for name, value in (("stage_color", [0.5] * 3), ("tool_block.mass", 0.09)):
            effect = world.effect(names[0], do={name: value}, n=64, steps=how.horizons[-1])
            found[f"effect of {name}"] = json.loads(effect.to_json())
        yield found
        compared = world.compare("mujoco", probes=how.probes, steps=how.horizons)
        found["gaps"] = compared.table.to_dict("records")
        found["clear_effects_with_one_sign"] = compared.share
        yield found


def conformance(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Run the suite of every engine; list what failed, with the first line of why."""
    with tempfile.TemporaryDirectory() as folder:
        suite, report = Path(folder) / "test_device.py", Path(folder) / "report.xml"
        suite.write_text(SUITE.format(backend=how.backend))
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(suite)]
        subprocess.run(  # noqa: S603 # ours
            [*command, f"--junitxml={report}", "--rootdir", folder],
            check=False,
            timeout=how.seconds,
        )
        found: dict[str, Any] = {"passed": 0, "skipped": 0, "failed": []}
        for case in Xml.parse(report).iter("testcase"):  # noqa: S314 # pytest wrote it
            wrong = [*case.iter("failure"), *case.iter("error")]
            if wrong:
                why = str(wrong[0].get("message")).splitlines()[0][:200]
                found["failed"].append({"test": case.get("name"), "why": why})
            else:
                found["skipped" if case.find("skipped") is not None else "passed"] += 1
    yield found


def collect(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Collect episodes, in a warm process: first one batch, then as many as there is time for."""
    import scm_world as sw
    from scm_world.discovery.data import Design
    from scm_world.discovery.data import collect as collected

    design = Design("single", ("*.mass", "floor_friction"))
    with sw.World(TASK, backend=how.backend) as world:
        size = how.batch
        begun = time.perf_counter()
        collected(world, design, size, steps=25, shard=size, seed=1)
        once = time.perf_counter() - begun
        found = {"batch": size, "first_batch_s": once, "rows_per_s": size / once}
        yield found
        batches = int(min(8, (how.seconds - 1.5 * once - 20.0) // max(once, 1e-9)))
        if batches > 0:
            begun = time.perf_counter()
            collected(world, design, size * batches, steps=25, shard=size, seed=2)
            found["rows_per_s"] = size * batches / (time.perf_counter() - begun)
        yield found | {"batches": batches}


def train(how: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Train until three quarters of the time are over, then evaluate on MuJoCo."""
    from scm_world.evaluation import evaluate
    from scm_world.training.loop import train as trained
    from scm_world.training.recipe import recipe

    made = recipe(how.task, "rsl_ppo", **how.recipe, trials={"protocols": []})
    begun, done, said = time.perf_counter(), 0, list[str]()

    def note(text: str) -> None:
        tell(text)
        said.extend([text] if "on the host" in text else [])

    def watch(steps: int, _: int) -> None:
        nonlocal done
        done = steps
        if time.perf_counter() - begun > 0.75 * how.seconds:
            raise KeyboardInterrupt

    with tempfile.TemporaryDirectory() as folder:
        with suppress(KeyboardInterrupt):
            trained(made, out=folder, backend=how.backend, progress=watch, tell=note)
        spent = time.perf_counter() - begun
        curve = (Path(folder) / "progress.csv").read_text().splitlines()
        found = {
            "task": how.task,
            "worlds": made.worlds,
            "steps": done,
            "seconds": spent,
            "steps_per_s": done / spent,
            "on_the_host": said,
            "curve": [curve[0], *curve[1 :: max(1, len(curve) // 20)]],
        }
        yield found
        policy = Path(folder) / "policy.safetensors"
        agents = {"trained": str(policy), "random": "random"}
        scores = evaluate(agents, ["P0", "P5"], task=how.task, n=20)
        found["scores"] = [
            {"agent": agent, "protocol": name, "score": str(scores.score(name, agent=agent))}
            for agent in scores.agents
            for name in scores.protocols
        ]
        yield found


PARTS: dict[str, tuple[Callable[[argparse.Namespace], Iterator[dict[str, Any]]], float]] = {
    "first": (first, 0.3),
    "rates": (rates, 0.3),
    "cpu": (cpu, 0.1),
    "floor": (floor, 0.2),
    "train": (train, 0.45),
    "collect": (collect, 0.4),
    "conformance": (conformance, 1.0),
}
"""Each part with its largest share of the time that is left when it begins, in this order."""

QUICK: dict[str, Any] = {
    "sizes": [16, 64, 256],
    "steps": 20,
    "horizons": [1, 10],
    "probes": 3,
    "batch": 64,
    "cpu_worlds": 64,
    "cpu_steps": 500,
    "task": "reaching",
    "recipe": {"worlds": 64, "n_steps": 16, "batch_size": 256, "steps": 60_000},
}
WHOLE: dict[str, Any] = {
    "sizes": [1024, 4096, 16384, 65536],
    "steps": 100,
    "horizons": [1, 10, 50, 200],
    "probes": 12,
    "batch": 8192,
    "cpu_worlds": 512,
    "cpu_steps": 1000,
    "task": "pushing",
    "recipe": {"worlds": 4096},
}


# --- all of them ----------------------------------------------------------------------------------


def run_part(name: str, how: argparse.Namespace) -> None:
    """Write what a part yields, each time; then its error, if there is one."""
    path, found = Path(how.into), dict[str, Any]()
    try:
        for found in PARTS[name][0](how):
            path.write_text(json.dumps(found, default=str))
    except Exception as error:
        traceback.print_exc()
        wrong = {"error": f"{type(error).__name__}: {error}"[:1000]}
        path.write_text(json.dumps({**found, **wrong}, default=str))


def versions() -> dict[str, str]:
    """Name what computes."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version(), "machine": platform.processor()}
    for name in ("mujoco", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def main() -> None:
    """Run the parts within the budget."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--backend", help="in place of warp on the device")
    parser.add_argument("--quick", action="store_true", help="small numbers, for the CPU device")
    parser.add_argument("--budget", type=float, default=520.0, help="of all parts together [s]")
    parser.add_argument("--out", default="warp.json")
    parser.add_argument("--only", help="names of parts, with commas")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=60.0, help=argparse.SUPPRESS)
    parser.add_argument("--into", help=argparse.SUPPRESS)
    how = parser.parse_args()
    how.backend = how.backend or f"warp:{how.device}"
    for name, value in (QUICK if how.quick else WHOLE).items():
        setattr(how, name, value)
    if how.part:
        run_part(how.part, how)
        return
    end, done = time.monotonic() + how.budget, dict[str, Any]()
    about = {"backend": how.backend, "quick": how.quick, "cores": os.cpu_count(), **versions()}
    for name in how.only.split(",") if how.only else PARTS:
        left = end - time.monotonic()
        seconds = PARTS[name][1] * left
        tell(f"--- {name}: at most {seconds:.0f} s of {left:.0f} s")
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            into = Path(folder) / "part.json"
            command = [sys.executable, "-m", "benchmarks.warp", "--part", name]
            command += ["--backend", how.backend, "--into", str(into), "--seconds", str(seconds)]
            late = {}
            try:
                subprocess.run([*command, *["--quick"] * how.quick], check=False, timeout=seconds)  # noqa: S603
            except subprocess.TimeoutExpired:
                late = {"error": f"did not end within {seconds:.0f} s"}
            part = json.loads(into.read_text()) if into.exists() else {"error": "wrote nothing"}
        done[name] = {**part, **late, "wall_s": round(time.monotonic() - begun, 1)}
        Path(how.out).write_text(as_json({"about": about, "parts": done}) + "\n")
        tell(f"{name}: {done[name].get('error', 'done')}")


if __name__ == "__main__":
    main()
