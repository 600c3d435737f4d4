"""CausalWorld 1.2, in an environment and a process of its own, measured in turns with ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, final

import numpy as np

from benchmarks.speed.scenes import ENGINES, GENERAL, PUSHING, SEED, TOWER, Case, actions
from benchmarks.speed.timing import MICRO, Settings, busy, in_turns, medians, micros, ratio
from scm_world.env import ScmWorldEnv

ALONE = ("causal-world==1.2", "gym==0.17.3")  # their own requirements cannot be met any more
NEEDED = ("pybullet==3.2.7", "numpy", "scipy", "matplotlib", "psutil", "cloudpickle", "pyglet")
HERE = Path(__file__).parent
COMPLETE = "complete"
STEPS, ROUNDS = 250, 7
PIXEL_STEPS = 20
RESETS, BETWEEN = 10, 5  # resets in a round, and control steps before each
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
WORKS = "import causal_world.envs"


def found_or_made() -> str | None:
    """Give an interpreter that has CausalWorld; make its environment in the cache if need be.

    Returns:
        None, after a message, if it cannot be had.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = root / "scm_world" / f"causal-world-1.2-python{sys.version_info.minor}"
    python = folder / "bin" / "python"
    if not (folder / COMPLETE).exists():
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        print(f"making an environment for CausalWorld in {folder}", flush=True)
        try:
            _run([sys.executable, "-m", "venv", "--clear", str(folder)])
            _run([*pip, "--no-deps", *ALONE])
            _run([*pip, *NEEDED])
            _run([str(python), "-c", WORKS])
        except (subprocess.CalledProcessError, OSError) as error:
            print(f"the predecessor is left out, its environment could not be made: {error}")
            return None
        (folder / COMPLETE).touch()
    return str(python)


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 # our own words


@final
class Predecessor:
    """A process that has CausalWorld and does what it is asked.

    Args:
        python: The interpreter.
    """

    def __init__(self, python: str) -> None:
        quiet = {**os.environ, **dict.fromkeys(THREADS, "1")}
        self._complaints = TemporaryFile("w+")  # noqa: SIM115 # as long as the process
        self._process = subprocess.Popen(  # noqa: S603 # our own script
            [python, str(HERE / "predecessor_server.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            text=True,
            env=quiet,
        )

    def ask(self, what: str, **given: Any) -> Any:
        """Ask for something and wait for it.

        Raises:
            RuntimeError: The process ended; the message has what it complained of last.
        """
        asked, answers = self._pipes()
        asked.write(json.dumps({"what": what, **given}) + "\n")
        asked.flush()
        line = answers.readline()
        if not line:
            self._process.wait()
            self._complaints.seek(0)
            raise RuntimeError(f"the predecessor ended: {self._complaints.read()[-2000:]}")
        return json.loads(line)

    def _pipes(self) -> tuple[IO[str], IO[str]]:
        asked, answers = self._process.stdin, self._process.stdout
        if asked is None or answers is None:
            raise RuntimeError("the predecessor has no pipes")
        return asked, answers

    def close(self) -> None:
        """End the process."""
        asked, answers = self._pipes()
        asked.close()
        self._process.wait()
        answers.close()
        self._complaints.close()


@contextmanager
def running(settings: Settings) -> Iterator[Predecessor | None]:
    """Start the predecessor if there is one, and end it."""
    if settings.predecessor is None:
        yield None
        return
    process = Predecessor(settings.predecessor)
    try:
        yield process
    finally:
        process.close()


def comparing(settings: Settings) -> dict[str, Any]:
    """Compare steps, pictures, resets and an intervention, in turns, with the same actions."""
    with running(settings) as its:
        if its is None:
            return {}
        compared = (PUSHING, GENERAL) if settings.quick else (PUSHING, TOWER, GENERAL)
        steps = settings.steps(STEPS)
        found: dict[str, Any] = {"versions": its.ask("versions")}
        for case in compared:
            found[f"step: {case.name}"] = turns(its, case, settings, _stepping(steps))
        views = _stepping(settings.steps(PIXEL_STEPS))
        how = {"observation_mode": "pixel"}
        # Its general task breaks with pictures: it draws a goal before it has cameras.
        for case in (PUSHING,) if settings.quick else (PUSHING, TOWER):
            found[f"pixels: {case.name}"] = turns(its, case, settings, views, **how)
        for case in (PUSHING,) if settings.quick else (PUSHING, GENERAL):
            found[f"reset: {case.name}"] = turns(its, case, settings, _resetting)
        found["do mass: pushing"] = turns(its, PUSHING, settings, _doing)
    return found


Side = Callable[[], float]
Sides = Callable[[ScmWorldEnv], Side]
Task = Callable[..., tuple[dict[str, Any], Sides]]


def turns(
    its: Predecessor, case: Case, settings: Settings, measured: Task, **how: Any
) -> dict[str, float]:
    """Let the predecessor and both engines take turns."""
    request, ours = measured()
    its.ask("make", task=case.task, options=_theirs(case), seed=SEED, **how)
    sides: dict[str, Side] = {"predecessor": lambda: float(its.ask(**request))}
    envs = {engine: case.env(engine, **how) for engine in ENGINES}
    sides.update({engine: ours(env) for engine, env in envs.items()})
    rows = in_turns(sides, settings.rounds(ROUNDS))
    its.ask("close")
    for env in envs.values():
        env.close()
    ratios = {f"{engine}: ratio": ratio(rows, "predecessor", engine) for engine in ENGINES}
    return {**{f"{side} [µs]": time for side, time in medians(rows).items()}, **ratios}


def _theirs(case: Case) -> dict[str, Any]:
    """Give the arguments of the same task there."""
    return {name: list(value) for name, value in case.options.items()}


def _stepping(steps: int) -> Task:
    given = actions(steps)

    def ours(env: ScmWorldEnv) -> Side:
        def live() -> float:
            env.reset(seed=SEED)
            return busy(env.step, given) / steps * MICRO

        return live

    return lambda: ({"what": "step", "actions": given.tolist()}, ours)


def _resetting() -> tuple[dict[str, Any], Sides]:
    rest = np.zeros(9, dtype=np.float32)

    def ours(env: ScmWorldEnv) -> Side:
        def begin() -> float:
            total = 0.0
            for _ in range(RESETS):
                for _ in range(BETWEEN):
                    env.step(rest)
                total += micros(env.reset)
            return total / RESETS

        return begin

    return {"what": "reset", "times": RESETS, "between": BETWEEN}, ours


def _doing() -> tuple[dict[str, Any], Sides]:
    masses = np.random.default_rng(SEED).uniform(0.02, 0.09, RESETS).tolist()
    rest = np.zeros(9, dtype=np.float32)

    def ours(env: ScmWorldEnv) -> Side:
        def do() -> float:
            total = 0.0
            for mass in masses:
                env.step(rest)
                total += micros(lambda mass=mass: env.do({"tool_block.mass": mass}))  # type: ignore[misc]
            return total / len(masses)

        return do

    return {"what": "do", "block": "tool_block", "masses": masses}, ours
