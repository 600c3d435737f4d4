"""What questions to a world cost, and what pairing pays.

``python benchmarks/queries.py`` takes about two minutes and prints two tables; with
``--picture FILE`` it draws how the intervals shrink.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from scm_world.queries import Effect, Episode, World
from scm_world.queries.samples import difference
from scm_world.variables import Box, Draw

PUSHED = Draw(Box((0.2, -0.2, 0.0), (0.5, 0.2, 0.0)))
SLIDING = {
    "tool_block.mass": "A",
    "tool_block.friction": "A",
    "tool_block.cylindrical_position": "A",
    "tool_block.linear_velocity": PUSHED,
}
STANDING = {"tool_block.mass": "A", "tool_block.cylindrical_position": "A"}
PAIRS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "floor_friction 0.6 → 0.4": ({"floor_friction": 0.4}, {"floor_friction": 0.6}),
    "gravity 9.81 → 8": ({"gravity": [0.0, 0.0, -8.0]}, {"gravity": [0.0, 0.0, -9.81]}),
    "tool_block.mass 0.02 → 0.1": ({"tool_block.mass": 0.1}, {"tool_block.mass": 0.02}),
}


def slid(episode: Episode) -> float:
    """Measure how far the block moved on the floor [m]."""
    place = episode["tool_block.cartesian_position"][:, :2]
    return float(np.linalg.norm(place[-1] - place[0]))


def push(world: Any) -> Any:
    """Let the nearest fingertip go towards the block."""
    tips = world["end_effector_positions"].reshape(3, 3)
    block = world["tool_block.cartesian_position"]
    nearest = int(np.argmin(np.linalg.norm(tips - block, axis=1)))
    tips[nearest] += 0.3 * (block - tips[nearest])
    return tips.ravel()


def cases(engine: str) -> dict[str, Callable[..., Effect]]:
    """Give, for each way of acting, what estimates an effect."""
    world = World("pushing", backend=engine)
    hand = World("pushing", backend=engine, action_mode="end_effector_positions")

    def sliding(**options: Any) -> Effect:
        return world.effect(slid, nature=SLIDING, steps=15, policy=None, **options)

    def pushing(**options: Any) -> Effect:
        return hand.effect(slid, nature=STANDING, steps=25, policy=push, **options)

    def random(**options: Any) -> Effect:
        return world.effect(slid, nature=STANDING, steps=25, **options)

    return {"a sliding block": sliding, "a finger pushes": pushing, "random actions": random}


def effects(engines: list[str], n: int) -> None:
    """Print how many times fewer units pairs need."""
    print("| engine | what happens | intervention | effect [m] | unpaired : paired |")
    print("|---|---|---|---|---|")
    for engine in engines:
        for what, ask in cases(engine).items():
            for name, (do, versus) in PAIRS.items():
                found = ask(do=do, versus=versus, n=n)
                interval = f"{found.mean:.4f} [{found.low:.4f}, {found.high:.4f}]"
                ratio = f"{float(found.variance_ratio):.3g}"
                print(f"| {engine} | {what} | {name} | {interval} | {ratio} |", flush=True)


def counterfactuals(engines: list[str]) -> None:
    """Print how long 64 counterfactuals of one second take."""
    print("| engine | threads | 64 counterfactuals of 1 s [s] |\n|---|---|---|")
    for engine in engines:
        episode = World("pushing", backend=engine).rollout("random", seed=3, steps=25)
        dos = [{"tool_block.mass": float(mass)} for mass in np.linspace(0.02, 0.2, 64)]
        for workers in (1, 2):
            episode.worlds(dos[:4], workers=workers)
            times = []
            for _ in range(7):
                start = time.perf_counter()
                episode.worlds(dos, workers=workers)
                times.append(time.perf_counter() - start)
            print(f"| {engine} | {workers} | {statistics.median(times):.3f} |", flush=True)


def draw(path: Path) -> None:
    """Draw the length of the interval over the number of episodes, paired and not."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    world = World("pushing")
    acts, n = PAIRS["floor_friction 0.6 → 0.4"], 400
    columns = [
        world.sample(n, do, first=first, outcomes=[slid], nature=SLIDING, steps=15, policy=None)[
            "slid"
        ]
        for do, first in ((acts[0], 0), (acts[1], 0), (acts[1], n))
    ]
    counts = np.unique(np.geomspace(5, n, 25).astype(int))
    figure = Figure(figsize=(8, 4.5), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for paired, color, label in ((True, "#1f6fb4", "paired"), (False, "#f28e2b", "unpaired")):
        other = columns[1] if paired else columns[2]
        ends = [difference(columns[0][:k], other[:k], paired=paired)[1:3] for k in counts]
        low, high = np.array(ends).T
        axes.loglog(2 * counts, 1e3 * (high - low) / 2, color=color, label=label, marker="o", ms=3)
    axes.set_xlabel("episodes simulated")
    axes.set_ylabel("half of the 95 % interval [mm]")
    axes.set_title("Effect of floor_friction 0.6 → 0.4 on how far a block slides", loc="left")
    axes.grid(visible=True, which="both", color="#e2e6ec")
    axes.legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--engines", nargs="+", default=["mujoco", "bullet"])
    parser.add_argument("--units", type=int, default=100)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    if options.picture is not None:
        draw(options.picture)
        return
    counterfactuals(options.engines)
    effects(options.engines, options.units)


if __name__ == "__main__":
    main()
