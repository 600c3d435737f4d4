"""What was asked for, and where it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

Figures = dict[str, Any]


@dataclass(frozen=True)
class Goal:
    """A bound for one figure.

    Attributes:
        title: What it is.
        read: How to read it from all results; None or ``KeyError`` if it was not measured.
        least: It must not be smaller.
        most: It must not be larger.
        unit: Written after the numbers.
        digits: After the point.
    """

    title: str
    read: Callable[[Figures], float]
    least: float | None = None
    most: float | None = None
    unit: str = ""
    digits: int = 1

    def bound(self) -> str:
        """Write the goal."""
        sign, value = ("≥", self.least) if self.least is not None else ("≤", self.most)
        return f"{sign} {value:,g}{self.unit}"

    def measured(self, results: Figures) -> float | None:
        """Read the figure; None if it is not there."""
        try:
            return self.read(results)
        except (KeyError, ValueError):  # not measured; the least of nothing
            return None

    def met(self, value: float) -> bool:
        """Say whether a figure is good enough."""
        return (self.least is None or value >= self.least) and (
            self.most is None or value <= self.most
        )


def at(*path: str) -> Callable[[Figures], float]:
    """Give what reads one figure."""

    def read(results: Figures) -> float:
        found: Any = results
        for key in path:
            found = found[key]
        return float(found)

    return read


def least_of(figure: str, engine: str, blocks: int = 10) -> Callable[[Figures], float]:
    """Give what reads the smallest figure of all scenes with up to so many blocks."""

    def rows(results: Figures) -> Iterable[float]:
        for row in results["step"][engine].values():
            if row["blocks"] <= blocks:
                yield float(row[figure])

    return lambda results: min(rows(results))


SHARE, LOGGED = "share of raw", "share of raw, with the log"
FIRST = "64, each beyond the first"

GOALS = (
    *(
        Goal(
            f"`env.step` on MuJoCo, {case}: times as fast as the predecessor",
            at("predecessor", f"step: {case}", "mujoco: ratio"),
            least=least,
        )
        for case, least in (("pushing", 8), ("towers, 5", 6), ("general", 6))
    ),
    *(
        Goal(
            f"`env.step` on Bullet, {case}: times as fast as the predecessor",
            at("predecessor", f"step: {case}", "bullet: ratio"),
            least=2.5,
        )
        for case in ("pushing", "towers, 5", "general")
    ),
    *(
        Goal(
            f"steps with pixels, {case}, MuJoCo: times as fast",
            at("predecessor", f"pixels: {case}", "mujoco: ratio"),
            least=50,
        )
        for case in ("pushing", "towers, 5")
    ),
    Goal(
        "`env.reset`, pushing, MuJoCo: times as fast",
        at("predecessor", "reset: pushing", "mujoco: ratio"),
        least=400,
        digits=0,
    ),
    *(
        Goal(
            f"share of the raw physics rate on {title}, the least of all scenes of 1–10 blocks",
            least_of(SHARE, engine),
            least=0.90,
            digits=3,
        )
        for engine, title in (("mujoco", "MuJoCo"), ("bullet", "Bullet"))
    ),
    *(
        Goal(
            f"the same with the experiment log, {title}",
            least_of(LOGGED, engine),
            least=0.85,
            digits=3,
        )
        for engine, title in (("mujoco", "MuJoCo"), ("bullet", "Bullet"))
    ),
    Goal(
        "64 pushing worlds on two threads: times as fast as on one, wall",
        at("batch", "mujoco", "pushing", "2 threads to 1: ratio"),
        least=1.7,
        digits=2,
    ),
    Goal(
        "64 pushing worlds on two threads: times as fast as the predecessor",
        at("batch", "mujoco", "pushing", "predecessor: ratio"),
        least=15,
    ),
    *(
        Goal(
            f"64 worlds of {case} with observation, reward and autoreset, per CPU-second",
            at("batch", "mujoco", case, "control steps per CPU-second"),
            least=least,
            unit=" steps",
            digits=0,
        )
        for case, least in (("pushing", 5000), ("general", 2000))
    ),
    *(
        Goal(
            f"cost that the vector layer adds to raw physics, 64 worlds of {case}",
            at("batch", "mujoco", case, "vector layer, of raw"),
            most=0.20,
            digits=3,
        )
        for case in ("pushing", "general")
    ),
    Goal(
        "Stable-Baselines3 adapter, a step of a world",
        at("adapter", "added to a step of a world [µs]"),
        most=15,
        unit=" µs",
    ),
    *(
        Goal(
            f"memory of another world of one block, {title}",
            at("memory", engine, "pushing: worlds [MB]", FIRST),
            most=3,
            unit=" MB",
            digits=2,
        )
        for engine, title in (("mujoco", "MuJoCo"), ("bullet", "Bullet"))
    ),
    *(
        Goal(
            f"memory over 10,000 resets, a reset, {title}",
            at("memory", engine, "resets", "slope [bytes/reset]"),
            most=10,
            unit=" bytes",
        )
        for engine, title in (("mujoco", "MuJoCo"), ("bullet", "Bullet"))
    ),
    *(
        Goal(f"`import {name}`", at("import", f"{name} [s]"), most=1.5, unit=" s", digits=2)
        for name in ("scm_world", "scm_world.env")
    ),
    Goal(
        "cost over steps is a straight line: R², pushing",
        at("growth", "steps: pushing", "R²"),
        least=0.99,
        digits=4,
    ),
    Goal(
        "cost over worlds is a straight line: R², pushing",
        at("batch", "cost over worlds: pushing", "R²"),
        least=0.99,
        digits=4,
    ),
)
