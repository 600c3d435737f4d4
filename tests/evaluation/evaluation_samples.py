"""Small evaluations, and policies that other processes can import."""

from __future__ import annotations

import os
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from numpy.typing import NDArray

from scm_world.evaluation import METRICS, Evaluation, evaluate
from scm_world.evaluation.pipeline import ShardRunner
from scm_world.evaluation.preparation import again
from scm_world.evaluation.setups import Shard

rng = np.random.default_rng(0)
WEIGHTS = rng.normal(size=(56, 9)).astype(np.float32)


def linear(observation: Any) -> NDArray[np.float32]:
    """Act by a fixed network of one layer."""
    return np.tanh(observation @ WEIGHTS)


def opposite(observation: Any) -> NDArray[np.float32]:
    """Do the opposite."""
    return -linear(observation)


class Waning:
    """Goes wrong in mid-episode: at the twelfth control step after so many episodes."""

    def __init__(self, how: str, after: int) -> None:
        self.how, self.after, self.episodes, self.steps = how, after, 0, 0

    def reset(self) -> None:
        """Begin an episode."""
        self.episodes += 1
        self.steps = 0

    def __call__(self, observation: Any) -> Any:
        """Act, or go wrong."""
        self.steps += 1
        if self.episodes <= self.after or self.steps <= 12:
            return np.zeros(9)
        if self.how == "nan":
            return np.array([np.nan] * 9)
        if self.how == "shape":
            return np.zeros(8)
        raise ZeroDivisionError("by the policy")


class Counting:
    """Notes in a file how often it has begun an episode."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def reset(self) -> None:
        """Begin an episode."""
        with self.path.open("a") as stream:
            stream.write(f"{os.getpid()}\n")

    def __call__(self, observation: Any) -> Any:
        """Stay."""
        return np.zeros(9)


SHORT = {"max_episode_length": 16}
MASS, START = "tool_block.mass", "tool_block.cylindrical_position"


def small(policy: Any = "random", protocols: Any = "P0,P6", **options: Any) -> Evaluation:
    """Evaluate a few short episodes without physics."""
    return evaluate(policy, protocols, **{"n": 3, "backend": "fake", "env": SHORT, **options})


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def by_hand(
    scores: Any, drawn: Any = None, *, agent: str = "a", protocol: str = "P1", run: int = 0
) -> list[dict[str, Any]]:
    """Make rows with given scores of success."""
    return [
        {
            "agent": agent,
            "run": run,
            "engine": "fake",
            "protocol": protocol,
            "seed": 0,
            "episode": episode,
            "steps": 10,
            **dict.fromkeys(METRICS, 0.0),
            "last_fractional_success": float(score),
            "hash": f"{agent}{run}{episode}",
            **{f"drawn {name}": float(values[episode]) for name, values in (drawn or {}).items()},
        }
        for episode, score in enumerate(scores)
    ]


def played_again(found: Evaluation, **options: Any) -> list[str]:
    """Play every episode of an evaluation again; list what is another number."""
    wrong = []
    with closing(ShardRunner(again(found, **options))) as runner:
        for place in range(len(found)):
            row = found.frame.iloc[place].to_dict()
            where = (row[name] for name in ("agent", "run", "engine", "protocol", "seed"))
            shard = Shard(*where, row["episode"], row["episode"] + 1)
            repeated = pandas.DataFrame(runner(shard))
            wrong += [
                f"{place}: {name}"
                for name, value in row.items()
                if value == value and repeated[name][0] != value  # NaN: was not drawn
            ]
    return wrong
