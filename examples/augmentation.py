"""Counterfactual data augmentation: what does not act on one another is swapped.

Where robot and block are apart, the robot of one control step and the block of another make a
third one that never happened, and is true (CoDA: Pitis, Creager and Garg, NeurIPS 2020).
Run it with ``python examples/augmentation.py [STEPS [SWAPS]]``.
"""

import sys
from contextlib import suppress

import numpy as np

from scm_world import Draw, World
from scm_world.errors import Infeasible

MOTION = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
NAMES = ("joint_positions", "joint_velocities", *(f"tool_block.{name}" for name in MOTION))
BLOCK = np.isin(np.arange(72), [*range(18, 31), *range(58, 71)])  # (state, action, next, apart)


def transition(world: World, action: np.ndarray) -> np.ndarray:
    """Take a control step; the local graph says whether robot and block are apart in it."""
    causes = world.local_graph(action).predecessors("tool_block.linear_velocity")
    apart = {"joint_positions", "action"}.isdisjoint(causes)
    before = [world[name] for name in NAMES]
    world.step(action)
    return np.concatenate([*before, action, *(world[name] for name in NAMES), [apart]])


def collect(world: World, seed: int, steps: int, follow: float) -> np.ndarray:
    """Let blocks slide and fingers move apart; with ``follow`` they move as the block slides."""
    rng, wave, rows = np.random.default_rng(seed), np.random.default_rng(0).normal(size=(9, 2)), []
    for step in range(steps):
        world.reset(seed=seed, episode=step, do={"tool_block.cylindrical_position": Draw("A")})
        world.do({NAMES[4]: [*rng.uniform(-0.7, 0.7, 2), 0.0], NAMES[1]: rng.normal(size=9)})
        aim = follow * wave @ world[NAMES[4]][:2] + (1.0 - follow) * rng.normal(0.0, 0.5, 9)
        rows.append(transition(world, world["joint_positions"] + aim))
    return np.array([row for row in rows if row[-1]])


def main(steps: str = "120", swaps: str = "1000") -> None:
    """Swap, compare the swapped rows with the simulation, and learn how the block moves."""
    world, made = World("pushing"), []
    rows, unseen = collect(world, 0, int(steps), 0.95), collect(world, 1, 120, 0.0)
    for i, j in np.random.default_rng(0).integers(len(rows), size=(int(swaps), 2)):
        mixed = np.where(BLOCK, rows[j], rows[i])
        with suppress(Infeasible):  # two bodies in one place; else see what really follows
            world.do(dict(zip(NAMES, np.split(mixed[:31], [9, 18, 21, 25, 28]), strict=True)))
            made.append([mixed, transition(world, mixed[31:40])])
    mixed, true = np.moveaxis([pair for pair in made if pair[1][-1]], 1, 0)  # apart, both of them
    print(f"{len(mixed)} swaps; blocks off by {1e3 * np.abs(mixed - true)[:, 58:61].max():.0e} mm")
    for name, data in {"as collected": rows, "augmented": np.vstack([rows, mixed])}.items():
        gains = np.linalg.lstsq(data[:, :40], data[:, 58:61] - data[:, 18:21], rcond=1e-3)[0]
        off = unseen[:, :40] @ gains - (unseen[:, 58:61] - unseen[:, 18:21])
        print(f"trained on {len(data)} {name}: {1e3 * np.linalg.norm(off, axis=1).mean():.2f} mm")


if __name__ == "__main__":
    main(*sys.argv[1:])
