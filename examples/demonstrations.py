"""Demonstrations that behavior cloning learns pushing from, in twenty lines of torch.

Run it with ``python examples/demonstrations.py [EPISODES] [UPDATES] [SEED] [TRIALS]
[MINARI-ID]``; it needs torch and pyarrow, and minari for the last argument.
"""

import sys

import gymnasium
import numpy as np
import torch
from torch import nn

from scm_world.evaluation import evaluate
from scm_world.evaluation.recording import Recording, record

ENV = {"action_mode": "delta_joint_positions", "delta_scale": 0.1, "delta_origin": "measured"}
SCORE = "fractional_success"


def demonstrations(episodes: int, seed: int) -> Recording:
    """Record the scripted teacher, with noise in the played and not in the recorded actions."""
    env = gymnasium.make("scm_world/Pushing-v0", **ENV)
    shown = record("feedback", env, episodes, noise=0.02, labels="teacher", seed=seed)
    good = [episode for episode in shown if episode.infos[SCORE][-1] > 0.9]
    return Recording(shown.environment, tuple(good), shown.versions, shown.policy)


def cloned(shown: Recording, updates: int, seed: int) -> nn.Module:
    """Fit a network to pairs of observations and labels."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    seen, done = map(torch.from_numpy, shown.pairs())
    mean, spread = seen.mean(dim=0), seen.std(dim=0).clamp(min=1e-4)
    network = nn.Sequential(
        *(nn.Linear(seen.shape[1], 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU()),
        nn.Linear(256, done.shape[1]),
    )
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    for _ in range(updates):
        rows = torch.randint(len(seen), (256,))
        loss = nn.functional.l1_loss(network((seen[rows] - mean) / spread), done[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        falling.step()
    network[0].bias.data -= network[0].weight.data @ (mean / spread)
    network[0].weight.data /= spread
    return network


def main(
    episodes: str = "240",
    updates: str = "16000",
    seed: str = "0",
    trials: str = "25",
    dataset: str = "",
) -> None:
    """Record, learn, and evaluate on 25 episodes, without noise and with it."""
    n = int(trials)
    shown = demonstrations(int(episodes), int(seed))
    print(f"{len(shown)} of {episodes} demonstrations solved the task")
    network = cloned(shown, int(updates), int(seed))

    def policy(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(network(torch.from_numpy(observation)))

    found = evaluate(policy, "P0", task="pushing", n=n, seeds=1_000, env=ENV)
    print(f"success in P0, where all episodes begin alike: {found.score('P0', 'success')}")
    env = gymnasium.make("scm_world/Pushing-v0", **ENV)
    for name, one in (("clone", policy), ("teacher", "feedback")):
        pushed = record(one, env, n, noise=0.02, seed=1_000)
        solved = [episode.infos[SCORE][-1] > 0.9 for episode in pushed]
        print(f"with noise in the actions of the {name}: {sum(solved)} of {n}")
    if dataset:  # whose scores are 0 for a robot that keeps still, and 1 for the teacher
        both = evaluate("still,feedback", "P0", task="pushing", n=n, seeds=1_000, env=ENV)
        low, high = (both.score("P0", "return", agent=name).value for name in both.agents)
        about = {"author": "scm_world", "author_email": "-", "code_permalink": "examples"}
        scores = {"ref_min_score": float(low), "ref_max_score": float(high)}
        made = shown.to_minari(dataset, **scores, **about)
        print(f"{made.spec.dataset_id}: returns from {low:.2f} to {high:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
