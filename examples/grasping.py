"""A scripted policy as an upper reference: it picks blocks up, and its episodes are kept.

Run it with ``python examples/grasping.py [EPISODES]``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import gymnasium

import scm_world  # noqa: F401 # registers the environments
from scm_world.evaluation import evaluate
from scm_world.evaluation.recording import Recording, record

ENV = {"action_mode": "end_effector_positions"}


def main(episodes: str = "3") -> None:
    """Evaluate it beside random actions, then record demonstrations for learners."""
    found = evaluate(
        {"feedback": "feedback", "random": "random"},
        "P0,P1,P5",
        task="picking",
        n=int(episodes),
        backend="mujoco,bullet",
        env=ENV,
    )
    for engine in found.engines:
        for protocol in found.protocols:
            grasp, chance = (
                found.score(protocol, "success", agent=agent, engine=engine)
                for agent in ("feedback", "random")
            )
            print(f"{engine} {protocol}: success {grasp}, by chance {chance}")
    gap = found.difference("mujoco", "bullet", "P5", agent="feedback")
    print("MuJoCo minus Bullet in P5:", gap)

    env = gymnasium.make("scm_world/Picking-v0", **ENV)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demonstrations.parquet"
        record("feedback", env, 2, do={"tool_block.mass": "A", "goal_block.height": "A"}, out=path)
        seen, done = Recording.load(path).pairs()
    print(f"{len(seen)} pairs of an observation, {seen.shape}, and an action, {done.shape}")
    env.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
