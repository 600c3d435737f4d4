"""Two worlds that differ in one variable: what does the mass of a block change, and when?

Run it with ``python examples/interventions.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys

import numpy as np

from scm_world import World


def push(world: World, mass: float) -> list[float]:
    """Push a block of some mass with one scripted motion; give its x coordinate over time [m]."""
    start = {"tool_block.mass": mass, "tool_block.cartesian_position": [0.0, 0.0, 0.0325]}
    world.reset(seed=0, do=start)
    path = []
    for step in range(40):
        target = np.array(world["end_effector_positions"])
        target[3:6] = [0.09 - 0.003 * step, 0.0, 0.035]  # the second finger comes from +x
        world.step(target)
        path.append(float(world["tool_block.cartesian_position"][0]))
    return path


def main(backend: str = "mujoco") -> None:
    """Push a light and a heavy block, and say where their paths part."""
    world = World("pushing", backend=backend, action_mode="end_effector_positions")
    light, heavy = push(world, 0.02), push(world, 0.09)
    pairs = enumerate(zip(light, heavy, strict=True))
    apart = next((step for step, (a, b) in pairs if abs(a - b) > 1e-6), None)
    print(f"light block: {1000 * light[-1]:.1f} mm, heavy block: {1000 * heavy[-1]:.1f} mm")
    print(f"their paths part by a micrometer after {apart} control steps, when the finger arrives")

    colored = World("pushing", backend=backend, action_mode="end_effector_positions")
    colored.reset(seed=0)
    print(colored.do({"tool_block.color": [0.0, 0.0, 1.0], "floor_friction": 0.3}))


if __name__ == "__main__":
    main(*sys.argv[1:2])
