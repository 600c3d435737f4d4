"""From the space of training to one that was never seen: what a policy loses there, and to what.

Run it with ``python examples/transfer_a_to_b.py [POLICY [TASK [EPISODES]]]``. A policy is a file, a
folder of ``scm-world train``, one of the zoo such as ``zoo:pushing``, or a scripted one.
"""

from __future__ import annotations

import sys

from scm_world.evaluation import evaluate
from scm_world.evaluation.statistics import unpaired_interval
from scm_world.policies.zoo import zoo

PAIRS = (("P1", "P2"), ("P7", "P8"))  # mass; goal, start and mass: from A, and from B
LEARNED = "zoo:picking" if "picking" in zoo() else "feedback"


def main(policy: str = LEARNED, task: str = "picking", episodes: str = "30") -> None:
    """Play the same protocols in both spaces, beside a policy that does nothing."""
    agents = {"agent": policy, "still": "still"}
    wanted = [protocol for pair in PAIRS for protocol in pair]
    found = evaluate(agents, wanted, task=task, n=int(episodes))
    for protocol in found.protocols:
        more = found.difference("agent", "still", protocol)  # the same draws for both
        print(f"{protocol}: {found.score(protocol, agent='agent')}, more than nothing by {more}")
    for a, b in PAIRS:
        scores = [
            found.only(agent="agent", protocol=name).frame["last_fractional_success"]
            for name in (a, b)
        ]
        print(f"{a} in A minus {b} in B: {unpaired_interval(*scores)}")
    spread = found.scores(agent="agent").std(axis=(0, 2))  # runs, protocols, episodes
    uneven = found.protocols[int(spread.argmax())]
    print(f"\nWhat decides the score in {uneven}, where it scatters most:")
    print(found.causes(uneven, agent="agent"))


if __name__ == "__main__":
    main(*sys.argv[1:])
