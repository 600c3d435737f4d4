"""A scripted agent of scm_world plays episodes on a server: ``python example.py --url URL``."""

from __future__ import annotations

import argparse
from typing import Any

from scm_lab import CallToolAction, ScmLabEnv
from scm_world import lab


class Room:
    """The tools of an episode as functions: what the scripted agents of ``lab.AGENTS`` call."""

    def __init__(self, env: Any, seed: int, **question: Any) -> None:
        self._env = env
        self.result = env.reset(seed=seed, **question)
        self.remaining: int = self.result.observation.result["remaining"]

    def call(self, tool: str, **arguments: Any) -> Any:
        """Call a tool, and return its result."""
        self.result = self._env.step(CallToolAction(tool_name=tool, arguments=arguments))
        if self.result.observation.error:
            raise ValueError(self.result.observation.error.message)
        found = self.result.observation.result
        self.remaining = found.get("remaining", self.remaining)
        return found

    def describe(self) -> Any:
        """Return what is known."""
        return self.call("describe")

    def observe(self, n: int = 1) -> Any:
        """Observe episodes."""
        return self.call("observe", n=n)

    def experiment(self, do: dict[str, Any], at: int = 0, n: int = 1) -> Any:
        """Set variables in episodes."""
        return self.call("experiment", do=do, at=at, n=n)

    def submit(self, answer: Any, confidence: float) -> Any:
        """Submit the answer."""
        return self.call("submit", answer=answer, confidence=confidence)


def play(url: str, agent: str, seed: int, **question: Any) -> float:
    """Let a scripted agent play one episode in a session of its own; return the reward."""
    with ScmLabEnv(base_url=url).sync() as env:
        room: Any = Room(env, seed, **question)
        lab.AGENTS[agent](room)
        assert room.result.done
        return float(room.result.reward)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--agent", default="ideal")
    parser.add_argument("--kind", default="effect")
    parser.add_argument("--n", type=int, default=3)
    args = parser.parse_args()
    for seed in range(args.n):
        print(args.kind, seed, play(args.url, args.agent, seed, kind=args.kind))
