"""Train reaching with PPO, then ask in which protocols it holds, and draw the radar.

It needs the extra ``train``. ``python examples/train_and_evaluate.py 1000000 my-reacher`` is a
whole training; if it is interrupted, the same call goes on. Without arguments it is a short one.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from scm_world.evaluation import evaluate
from scm_world.evaluation.figures import radar_figure, save
from scm_world.training.loop import train
from scm_world.training.recipe import recipe

SEEN = [  # in protocols with obstacles the published vector is longer; a network wants one shape
    "time_left_for_task",
    "joint_positions",
    "joint_velocities",
    "end_effector_positions",
    *(f"goal_{finger}.cartesian_position" for finger in (60, 120, 300)),
]


def main(steps: str = "100000", out: str = "", episodes: str = "20") -> None:
    """Train on goals from space A, and compare with doing nothing, protocol by protocol."""
    seen = {"observation_mode": "custom", "observe": SEEN}
    few = {"episodes": int(episodes)}  # of each trial meanwhile
    made = recipe("reaching", steps=int(steps), curriculum=1, env=seen, trials=few)
    folder = Path(out or tempfile.mkdtemp())
    trained = train(made, out=folder / "run", seed=0, tell=print)
    print(f"{trained.steps} steps; the best policy: {trained.best}, score {trained.score}")

    agents = {"trained": trained.best, "still": "still"}
    found = evaluate(agents, task="reaching", n=int(episodes), out=folder / "evaluation")
    found.save(folder / "evaluation")
    for protocol in found.protocols:
        print(f"{protocol}: {found.score(protocol, agent='trained')}")
    print("better than nothing in P5 by", found.difference("trained", "still", "P5"))
    save(radar_figure(found), folder / "radar.png")
    print(f"run, evaluation and radar.png are in {folder}")


if __name__ == "__main__":
    main(*sys.argv[1:])
