"""A laboratory as a Gymnasium environment: an experiment is an action."""

from __future__ import annotations

from functools import cache
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from scm_world._arguments import one_of, typed, whole_number
from scm_world._types import Floats
from scm_world.errors import Forbidden, UnknownOption
from scm_world.lab.laboratory import ROWS, Laboratory
from scm_world.lab.questions import Question, question

LEAVE, LOW, HIGH, RANDOM = range(4)
"""What an experiment does to a variable; low and high are 20% and 80% of its range."""


@cache
def _questions(kind: str, world: str, level: str, first: int, n: int) -> tuple[Question, ...]:
    return tuple(question(kind, world, seed, level) for seed in range(first, first + n))


@final
@typed
class LabEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.int64]]):
    """Choose experiments; a fixed estimator answers the question from their readings.

    An action says for each settable variable whether it is left, set low, set high or drawn at
    random, in ``n`` episodes of the world. After the last experiment the reward is the score of the
    answer; before, it is 0. The estimator of an effect is the difference of the outcome's means
    where the cause was high and where it was low. That of a graph regresses each variable, where it
    was left, on all others, and keeps coefficients beyond 4 standard errors.

    An observation, in [-1, 1], is of each settable variable the share of experiments in which it
    was low, high and random, and whether it is the cause that is asked for; of each readable one
    whether it is the outcome; tanh(t / 10) of the t statistic of each pair; and the share of
    experiments that is left.

    Args:
        kind: ``"effect"`` or ``"graph"``.
        world: A name of ``lab.WORLDS`` that has questions of the kind.
        level: What is known beforehand.
        seeds: How many questions there are; ``reset`` draws one of them, or takes the one of
            ``options={"question": number}``.
        first: Seed of the first one.
        experiments: Experiments in an episode.
        n: Episodes of the world in one experiment.

    Raises:
        UnknownOption: An argument is not allowed, or the budget is too small.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 # as Gymnasium declares it

    def __init__(
        self,
        kind: str = "effect",
        world: str = "equations",
        level: str = "L2",
        *,
        seeds: int = 8,
        first: int = 0,
        experiments: int = 8,
        n: int = 10,
    ) -> None:
        one_of("kind", kind, ("effect", "graph"))
        self.seeds = whole_number("seeds", seeds, least=1)
        first = whole_number("first", first, least=0)
        self.experiments = whole_number("experiments", experiments, least=1)
        self.n = whole_number("n", n, least=1, most=ROWS)
        self.questions = _questions(kind, world, level, first, self.seeds)
        if self.experiments * self.n > (budget := self.questions[0].budget):
            raise UnknownOption("experiments", experiments, (f"at most {budget // n} of {n}",))
        self.kind, about = kind, self.questions[0].describe()["variables"]
        settable = [one["name"] for one in about if one["settable"]]
        readable = [one["name"] for one in about if one["readable"]]
        self.action_space = gymnasium.spaces.MultiDiscrete([4] * len(settable))
        size = 4 * len(settable) + len(readable) * (1 + len(settable)) + 1
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (size,), np.float32)
        self._room = Laboratory(self.questions[0])
        self._begun = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode with one of the questions."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(self.seeds))
        number = whole_number(
            "question", (options or {}).get("question", drawn), least=0, most=self.seeds - 1
        )
        self._room, self._begun = Laboratory(self.questions[number]), True
        about = self._room.describe()
        self._query, variables = about["query"], about["variables"]
        self._ends = {one["name"]: one["settable"] for one in variables if one["settable"]}
        self._readable = [one["name"] for one in variables if one["readable"]]
        self._rows = np.zeros((0, len(self._readable)))  # readings
        self._how = np.zeros((0, len(self._ends)), int)  # what was done to the settable variables
        return self._observation(), {"question": number}

    def step(
        self, action: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Run an experiment; after the last one, answer."""
        if not self._begun or self._room.finished:
            raise Forbidden("step after the end of an episode", ("after reset",))
        if not self.action_space.contains(np.asarray(action)):
            raise UnknownOption("action", action, (str(self.action_space),))
        do: dict[str, Any] = {}
        for (name, (low, high)), how in zip(self._ends.items(), action, strict=True):
            values = {
                LOW: 0.8 * low + 0.2 * high,
                HIGH: 0.2 * low + 0.8 * high,
                RANDOM: [low, high],
            }
            if how != LEAVE:
                do[name] = values[int(how)]
        found = self._room.experiment(do, n=self.n) if do else self._room.observe(self.n)
        rows = np.array([found["columns"][name] for name in self._readable]).T
        self._rows = np.vstack([self._rows, rows])
        self._how = np.vstack([self._how, np.tile(np.asarray(action, int), (len(rows), 1))])
        last = self._room.spent >= self.experiments * self.n
        if last:
            self._room.submit(self._answer(), 0.5)
        reward = self._room.score["score"] if self._room.score else 0.0
        return self._observation(), reward, last, False, dict(self._room.score or {})

    def _answer(self) -> Any:
        if self.kind == "graph":
            known = [list(edge) for edge in self._query["known"]]
            pairs = zip(*np.nonzero(np.abs(self._evidence()) > 4.0), strict=True)
            names = [*self._ends]
            edges = [[names[cause], self._readable[outcome]] for cause, outcome in pairs]
            return {"edges": [edge for edge in edges if edge not in known], "hidden": []}
        y = self._rows[:, self._readable.index(self._query["outcome"])]
        how = self._how[:, [*self._ends].index(self._query["cause"])]
        if not (LOW in how and HIGH in how):
            return 0.0
        return float(y[how == HIGH].mean() - y[how == LOW].mean())

    def _evidence(self) -> Floats:
        """Return a t statistic by settable and readable variable; 0 where it cannot be computed."""
        found, x = np.zeros((len(self._ends), len(self._readable))), self._rows
        for j, outcome in enumerate(self._readable):
            kept, columns = np.ones(len(x), bool), []
            for i, name in enumerate(self._ends):
                if name == outcome:
                    kept = self._how[:, i] == LEAVE
                elif name in self._readable:
                    columns.append((i, x[:, self._readable.index(name)]))
            basis = np.stack([np.ones(len(x)), *(column for _, column in columns)], axis=1)[kept]
            if (free := len(basis) - basis.shape[1]) < 1:
                continue
            inverse = np.linalg.pinv(basis.T @ basis)
            weights = inverse @ basis.T @ x[kept, j]
            variance = np.sum((x[kept, j] - basis @ weights) ** 2) / free
            error = np.sqrt(np.maximum(variance * np.diag(inverse), 1e-12))
            for k, (i, _) in enumerate(columns, 1):
                found[i, j] = weights[k] / error[k]
        return found

    def _observation(self) -> NDArray[np.float32]:
        done = max(len(self._how), 1)
        shares = [np.sum(self._how == how, axis=0) / done for how in (LOW, HIGH, RANDOM)]
        cause, outcome = self._query.get("cause"), self._query.get("outcome")
        parts = [
            *shares,
            [name == cause for name in self._ends],
            [name == outcome for name in self._readable],
            np.tanh(self._evidence().ravel() / 10.0),
            [1.0 - self._room.spent / (self.experiments * self.n)],
        ]
        return np.concatenate([np.asarray(part, np.float32) for part in parts])
