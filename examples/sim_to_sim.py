"""From one simulator to another: how much of a policy is skill, and how much is MuJoCo?

The gap is known to be there between a simulator and the world; here both sides can be measured,
with the same draws. Run it with ``python examples/sim_to_sim.py [POLICY [TASK [EPISODES]]]``.
"""

from __future__ import annotations

import sys

from scm_world.evaluation import evaluate
from scm_world.policies.zoo import zoo

ENGINES = ("mujoco", "bullet")
LEARNED = "zoo:picking" if "picking" in zoo() else "feedback"


def main(policy: str = LEARNED, task: str = "picking", episodes: str = "10") -> None:
    """Play the same episodes on both engines; print the gap and where it comes from."""
    found = evaluate(policy, "P0,P1,P5,P8", task=task, n=int(episodes), backend=ENGINES)
    print(f"{policy} in {task}, last fractional success with 95 % intervals")
    for protocol in found.protocols:
        scores = [f"{engine} {found.score(protocol, engine=engine)}" for engine in ENGINES]
        print(f"{protocol}: {', '.join(scores)}; gap {found.difference(*ENGINES, protocol)}")
    values = [
        found.only(engine=engine, protocol="P8").frame["last_fractional_success"]
        for engine in ENGINES
    ]
    apart = int(abs(values[0] - values[1]).argmax())
    told = ", ".join(f"{v[apart]:.2f} on {e}" for e, v in zip(ENGINES, values, strict=True))
    print(f"where they differ most, episode {apart} of P8: {told}; `scm-world evaluate` draws it")


if __name__ == "__main__":
    main(*sys.argv[1:])
