"""Run the published actors of the predecessor here, and hold the scores against the published ones.

The actors are not part of this package. They lie in the wheel of CausalWorld 1.2, which need not be
installed::

    pip download causal-world==1.2 --no-deps -d wheel
    unzip -j wheel/causal_world-1.2-*.whl 'causal_world/assets/baseline_actors/*.zip' -d actors
    python benchmarks/causal_world_actors.py --actors actors --backend bullet

The protocol is P0: the default task, without any intervention. This world is deterministic, so
the mean of the policy needs one episode; the others draw its actions, with seeds of their own.
Every row is a setting for which a score of the original is known. ``time`` says what the policy
sees of the time left: ``seconds`` runs from 1 to -1, ``steps`` (an explicit length) stays near 1,
because the original takes seconds from a number of steps, and ``held`` is 1 throughout.
"""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from scm_world.env import IDS
from scm_world.policies import MlpPolicy, load_sb2
from scm_world.queries.experiments.versions import versions

TIME = "time_left_for_task"


@dataclass(frozen=True)
class Setting:
    """An actor, the environment that it ran in, and what the original gave.

    Attributes:
        length: The length that is asked for [control steps]; the default of the task if None.
        held: Whether the policy is told that no time has passed.
        steps: Of the episode in the original [control steps].
        last: Fractional success at the end of it.
        best: The largest fractional success in it.
        total: The sum of its rewards.
    """

    task: str
    actor: str
    frame_skip: int
    length: int | None
    held: bool
    steps: int
    last: float
    best: float
    total: float

    @property
    def time(self) -> str:
        """What the policy sees of the time left."""
        return "held" if self.held else "seconds" if self.length is None else "steps"


SETTINGS = (
    Setting("reaching", "reaching_ppo_curr1", 1, 1000, False, 1001, 1.000, 1.000, 127.0),
    Setting("reaching", "reaching_ppo_curr1", 3, None, False, 417, 0.489, 1.000, 294.4),
    Setting("reaching", "reaching_ppo_curr1", 3, None, True, 417, 1.000, 1.000, 373.7),
    Setting("pushing", "pushing_ppo_curr1", 3, None, False, 834, 1.000, 1.000, 11.43),
    Setting("pushing", "pushing_ppo_curr1", 3, 833, False, 834, 1.000, 1.000, 10.99),
    Setting("picking", "picking_ppo_curr1", 3, None, False, 834, 0.923, 1.000, 10.83),
    Setting("pick_and_place", "pick_and_place_ppo_curr0", 3, None, False, 1667, 0.990, 1.000, 1.67),
    Setting("stacking2", "stacking2_ppo_curr1", 3, None, False, 1667, 0.489, 0.839, 48.56),
)
"""One deterministic episode each in CausalWorld 1.2."""
TASKS = tuple(dict.fromkeys(setting.task for setting in SETTINGS))


@dataclass(frozen=True)
class Score:
    """How an episode went, or several on average.

    Attributes:
        last: Fractional success after the last step.
        integrated: Mean of the fractional success over all steps.
        best: The largest fractional success.
        total: The sum of the rewards.
        steps: Length [control steps].
    """

    last: float
    integrated: float
    best: float
    total: float
    steps: float


def episode(
    env: Any, policy: MlpPolicy, setting: Setting, generator: np.random.Generator | None
) -> Score:
    """Run one episode, with the mean of the policy if there is no generator."""
    observation, _ = env.reset(seed=0)
    when = env.unwrapped.layout[TIME]
    fractions, rewards, over = [], [], False
    while not over:
        if setting.held:
            observation = observation.copy()
            observation[when] = 1.0
        action = policy(observation, generator=generator)
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        fractions.append(info["fractional_success"])
        rewards.append(reward)
    last, mean, best = fractions[-1], float(np.mean(fractions)), max(fractions)
    return Score(last, mean, best, float(np.sum(rewards)), len(fractions))


def average(scores: Sequence[Score]) -> dict[str, dict[str, float]]:
    """Give the mean and the population standard deviation of every figure."""
    table = np.array([list(asdict(score).values()) for score in scores])
    return {
        name: {"mean": float(column.mean()), "std": float(column.std())}
        for name, column in zip(asdict(scores[0]), table.T, strict=True)
    }


def measure(
    setting: Setting, actors: Path, *, backend: str, preset: str, episodes: int, seed: int
) -> tuple[dict[str, Any], str]:
    """Run one setting, and name the engine that ran it."""
    policy = load_sb2(actors / f"{setting.actor}.zip")
    env: Any = gymnasium.make(
        next(name for name, task in IDS.items() if task == setting.task),
        backend=backend,
        preset=preset,
        conventions="causal_world",
        frame_skip=setting.frame_skip,
        max_episode_length=setting.length,
        disable_env_checker=True,
    )
    generators = [np.random.default_rng([seed, i]) for i in range(1, episodes)]
    mean = episode(env, policy, setting, None)
    drawn = [episode(env, policy, setting, generator) for generator in generators]
    engine = env.unwrapped.world.backend
    name = f"{engine.name} {engine.version}"
    env.close()
    row = {"setting": {**asdict(setting), "time": setting.time}, "deterministic": asdict(mean)}
    return {**row, "drawn": average(drawn) if drawn else None, "episodes_drawn": len(drawn)}, name


COLUMNS = ("task", "skip", "time", "steps", "last", "published", "integrated", "max", "published")
MORE = ("return", "published", "last, drawn", "integrated, drawn")


def line(row: dict[str, Any]) -> str:
    """Write one row of a table in Markdown."""
    setting, mean, drawn = row["setting"], row["deterministic"], row["drawn"]
    cells = [
        setting["task"],
        str(setting["frame_skip"]),
        setting["time"],
        f"{mean['steps']} ({setting['steps']})",
        f"{mean['last']:.3f}",
        f"{setting['last']:.3f}",
        f"{mean['integrated']:.3f}",
        f"{mean['best']:.3f}",
        f"{setting['best']:.3f}",
        f"{mean['total']:.2f}",
        f"{setting['total']:.2f}",
    ]
    for name in ("last", "integrated"):
        figure = drawn and drawn[name]
        cells.append(f"{figure['mean']:.3f} ± {figure['std']:.3f}" if figure else "")
    return f"| {' | '.join(cells)} |"


def arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--actors", type=Path, required=True, help="folder with the .zip files")
    parser.add_argument("--backend", choices=("bullet", "mujoco"), default="bullet")
    parser.add_argument("--preset", choices=("fast", "precise"), default="fast")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--episodes", type=int, default=20, help="the first takes the mean")
    parser.add_argument("--seed", type=int, default=0, help="of the draws of the policy")
    parser.add_argument("--out", type=Path, help="default: causal_world_actors_<backend>.json")
    found = parser.parse_args()
    if found.episodes < 1:
        parser.error(f"--episodes is at least 1, got {found.episodes}")
    return found


def main() -> None:
    """Run every setting of the tasks that are asked for."""
    asked = arguments()
    print(f"| {' | '.join(COLUMNS + MORE)} |\n{'|---' * len(COLUMNS + MORE)}|")
    rows, engine = [], ""
    for setting in SETTINGS:
        if setting.task in asked.tasks:
            row, engine = measure(
                setting,
                asked.actors,
                backend=asked.backend,
                preset=asked.preset,
                episodes=asked.episodes,
                seed=asked.seed,
            )
            rows.append(row)
            print(line(row), flush=True)
    about = {"machine": platform.machine(), "system": platform.system(), **versions(engine)}
    about |= {"preset": asked.preset, "policy_seed": str(asked.seed)}
    out = asked.out or Path(__file__).with_name(f"causal_world_actors_{asked.backend}.json")
    out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")
    print(f"\nwritten to {out}")


if __name__ == "__main__":
    main()
