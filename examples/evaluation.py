"""Compare two agents in protocols, and ask what broke one of them.

Run it with ``python examples/evaluation.py [mujoco|bullet]``.
"""

from __future__ import annotations

import sys
import tempfile
from typing import Any

from scm_world.evaluation import Evaluation, Protocol, evaluate, why
from scm_world.policies import WorldPolicy

STEPS = 100


@WorldPolicy
def raised(world: Any) -> Any:
    """Hold all joints in the middle of their range."""
    return 0.5 * (world.action_low + world.action_high)


def main(backend: str = "mujoco") -> None:
    """Sweep blocks of all masses, near and far; hold still for comparison."""
    far = Protocol("far", "*.cylindrical_position", "B", doc="block and goal far from the middle")
    found = evaluate(
        {"sweep": "sweep", "raised": raised},
        ["P0", "P5", "P8", far],
        n=12,
        backend=backend,
        env={"max_episode_length": STEPS},
    )
    for protocol in found.protocols:
        scores = [f"{agent} {found.score(protocol, agent=agent)}" for agent in found.agents]
        print(f"{protocol}:", ", ".join(scores))
        print(
            "  difference, the same draws for both:", found.difference("sweep", "raised", protocol)
        )

    print("\nWhat decides the score of the sweep in P8:")
    print(found.causes("P8", agent="sweep"))
    scores = found.only(agent="sweep", protocol="P8").frame["last_fractional_success"]
    print("\nIts worst episode:")
    print(why(found.only(agent="sweep"), "P8", int(scores.argmin())))

    with tempfile.TemporaryDirectory() as folder:
        found.save(folder)
        print("\nread again, the same:", Evaluation.load(folder) == found)


if __name__ == "__main__":
    main(*sys.argv[1:2])
