"""Counterfactual data augmentation: what does not act on one another is swapped.

Where robot and block go their own ways, the robot of one control step and the block of another
make a third one that never happened, and is true (CoDA: Pitis, Creager and Garg, NeurIPS 2020).
Run it with ``python examples/augmentation.py [EPISODES [SWAPS]]``.
"""

import sys

import numpy as np

from scm_world import Draw, World
from scm_world.errors import Infeasible
from scm_world.queries.local import local_graph

MOTION = ("cartesian_position", "orientation", "linear_velocity", "angular_velocity")
NAMES = ("joint_positions", "joint_velocities", *(f"tool_block.{name}" for name in MOTION))
BLOCK = [*range(18, 31), *range(58, 71)]  # in a row: state, action, next state, whether apart


def transition(world: World, action: np.ndarray) -> np.ndarray:
    """Take a control step; the local graph says whether robot and block are apart in it."""
    apart = not any("tool_block" in edge for edge in local_graph(world, action).edges)
    before = [world[name] for name in NAMES]
    world.step(action)
    return np.concatenate([*before, action, *(world[name] for name in NAMES), [apart]])


def collect(world: World, episodes: int, seed: int, follow: float) -> np.ndarray:
    """Let blocks slide and fingers wave; with ``follow`` they wave as the block slides."""
    rng, wave, rows = np.random.default_rng(seed), np.random.default_rng(0).normal(size=(9, 2)), []
    for step in range(6 * episodes):
        if step % 6 == 0:
            world.reset(seed=seed, episode=step, do={"tool_block.cylindrical_position": Draw("A")})
            world.do({"tool_block.linear_velocity": [*rng.uniform(-0.7, 0.7, 2), 0.0]})
        aim = follow * wave @ world[NAMES[4]][:2] + (1.0 - follow) * rng.normal(0.0, 0.5, 9)
        rows.append(transition(world, world["joint_positions"] + aim))
    return np.array(rows)


def error(rows: np.ndarray, unseen: np.ndarray) -> float:
    """Fit a ridge regression; where is the block after a step? Root mean square error [mm]."""
    x, t = ((data[:, :40] - rows[:, :40].mean(axis=0)) for data in (rows, unseen))
    y, u = (data[:, 58:61] - data[:, 18:21] for data in (rows, unseen))
    told = t @ np.linalg.solve(x.T @ x + 1e-3 * np.eye(40), x.T @ (y - y.mean(axis=0)))
    return float(1e3 * np.sqrt(np.square(told + y.mean(axis=0) - u).sum(axis=1).mean()))


def main(episodes: str = "20", swaps: str = "1000") -> None:
    """Swap, hold what was made against the simulation, and learn from it."""
    world, rng, made, off = World("pushing"), np.random.default_rng(0), [], {True: [], False: []}
    rows = collect(world, int(episodes), seed=0, follow=0.95)
    print(f"{len(rows)} control steps; robot and block are apart in {rows[:, 71].sum():.0f}")
    for i, j in rng.integers(len(rows), size=(int(swaps), 2)):
        mixed = rows[i].copy()
        mixed[BLOCK] = rows[j, BLOCK]
        world.reset(seed=0)
        try:  # make exactly this state, and see what really follows
            world.do(dict(zip(NAMES, np.split(mixed[:31], [9, 18, 21, 25, 28]), strict=True)))
        except Infeasible:  # two bodies in one place
            continue
        true = transition(world, mixed[31:40])
        apart = bool(rows[i, 71] and rows[j, 71] and true[71])
        made += [mixed] if apart else []
        off[apart].append(1e3 * np.abs(mixed - true)[58:61].max())
    for apart, errors in off.items():
        kind = "locally independent" if apart else "other"
        middle, worst = np.median(errors), max(errors)
        print(f"{len(errors)} {kind} swaps: block off by {middle:.1e} mm, at most {worst:.1e} mm")
    unseen = collect(world, 20, seed=1, follow=0.0)
    for name, more in {"as collected": [], "augmented": made}.items():
        data = np.array([*rows[rows[:, 71] > 0.0], *more])
        print(f"trained on {len(data)} {name}: {error(data, unseen[unseen[:, 71] > 0.0]):.2f} mm")


if __name__ == "__main__":
    main(*sys.argv[1:])
