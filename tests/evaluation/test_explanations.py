"""Facts about explanations: which variable decides, and what would have been."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas
import pytest
from evaluation_samples import (
    MASS,
    SHORT,
    START,
    by_hand,
    small,
)

from scm_world.errors import (
    UnknownOption,
)
from scm_world.evaluation import Evaluation, Protocol, evaluate, why
from scm_world.evaluation.explanation import Otherwise


def test_a_planted_cause_is_found() -> None:
    """Of two variables that vary, the one that decides the score; over several runs their mean."""
    rng = np.random.default_rng(0)
    drawn = {"tool_block.mass": rng.random(120), "floor_friction": rng.random(120)}
    noise = 0.1 * rng.random((2, 120))
    rows = [
        row
        for run in (0, 1)
        for row in by_hand(0.9 * (drawn["tool_block.mass"] < 0.5) + noise[run], drawn, run=run)
    ]
    found = Evaluation({"task": "pushing"}, pandas.DataFrame(rows)).causes("P1")
    first, second = found.ranked()
    assert (first.variable, second.variable) == ("tool_block.mass", "floor_friction")
    assert first.p_holm < 0.01
    assert first.share.value > 0.7
    assert first.column.contrast.high < -0.5
    assert [cause.variable for cause in found.found()] == ["tool_block.mass"]


def test_where_a_block_begins_decides_what_it_reaches() -> None:
    """With physics: nobody moves, so success is a matter of the two positions alone."""
    found = evaluate("still", "P7", n=60, env={"max_episode_length": 1})
    causes = found.causes("P7")
    assert {cause.variable for cause in causes.found()} <= {START, START.replace("tool", "goal")}
    assert causes.found()
    (mass,) = (cause for cause in causes.causes if cause.variable == MASS)
    assert mass.p > 0.05


def test_why_replaces_one_cause_at_a_time() -> None:
    """The others keep what was drawn; A gives a value of A, and the default the usual one."""
    found = small("still", "P8", n=4, env={"max_episode_length": 2})
    drawn = {n: v[1] for n, v in found.drawn().items()}
    told = []
    seen = why(found, "P8", 1, progress=lambda done, planned: told.append((done, planned)))
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert {other.variable for other in seen.others} == set(drawn)
    by_name = {other.variable: other for other in seen.others}
    assert by_name[MASS].was == tuple(drawn[MASS])
    assert 0.015 <= by_name[MASS].would_be[0] <= 0.045
    assert by_name[START].would_be[0] <= 0.11
    assert by_name[MASS].gain == 0.0
    usual = why(found, "P8", 1, versus="default")
    by_name = {other.variable: other for other in usual.others}
    assert by_name[MASS].would_be == (0.02,)
    assert "instead of" in str(usual)


def test_why_finds_what_broke_an_episode() -> None:
    """A block that begins far from where it should be: had it begun there, it had succeeded."""
    there = [0.0, 0.08, 0.0325]
    start = {f"{body}.cartesian_position": there for body in ("goal_block", "tool_block")}
    away = Protocol("away", act={"tool_block.cartesian_position": [0.0, -0.1, 0.0325], MASS: 0.05})
    found = small("still", away, n=1, env={**SHORT, "start": start})
    assert found.score("away").value < 0.5
    told = why(found, "away", 0, versus="default")
    best, other = told.others
    assert best.variable == "tool_block.cartesian_position"
    assert best.would_succeed
    assert best.gain > 0.5
    assert (other.variable, other.gain) == (MASS, 0.0)
    assert told.left_out == {"goal_block.cartesian_position": "the protocol does not set it"}


def test_why_within_an_episode_and_where_bodies_come() -> None:
    """What was drawn after some steps is told at that step; bodies that come are no obstacle."""
    late = why(small("still", "P8@3", n=2), "P8@3", 1, versus="default")
    assert {other.variable for other in late.others} >= {MASS}
    objects = Protocol("objects", ["nums_objects", "blocks_mass"], "B")
    many = small("still", objects, task="general", n=1, env={"max_episode_length": 2})
    found = why(many, "objects", 0)
    assert {o.variable for o in found.others} | set(found.left_out) == {
        "nums_objects",
        "blocks_mass",
    }


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        ({"protocol": "P6", "episode": 9}, "episode"),
        ({"protocol": "P9", "episode": 0}, "protocol"),
        ({"protocol": "P0", "episode": 0}, "something is drawn"),
        ({"protocol": "P6", "episode": 0, "versus": "C"}, "versus"),
        ({"protocol": "P6", "episode": 0, "metric": "beauty"}, "metric"),
        ({"protocol": "P6", "episode": 0, "policy": {"typo": "still"}}, "policy"),
    ],
)
def test_why_refuses_what_there_is_not(ask: dict[str, Any], said: str) -> None:
    """Episodes, protocols and metrics that do not exist, and episodes without causes."""
    with pytest.raises(UnknownOption, match=said):
        why(small("still"), **ask)


def test_why_asks_of_which_agent() -> None:
    """Where several have played the episode."""
    several = small({"one": "still", "two": "random"}, "P6", n=1)
    with pytest.raises(UnknownOption, match="one, two"):
        why(several, "P6", 0)


@pytest.mark.parametrize(
    ("did", "would", "words"),
    [
        (False, True, "it would have succeeded: 1 (+1)"),
        (True, True, "it would have succeeded, as it did: 1 (+0)"),
        (True, False, "it would have failed: 0 (-1)"),
        (False, False, "it would have failed, as it did: 0 (+0)"),
        (None, None, "it would have scored: 0 (+0)"),
    ],
)
def test_an_explanation_says_whether_anything_is_different(
    did: bool | None, would: bool | None, words: str
) -> None:
    """An episode that succeeded would have done so too: it is not the variable that decides."""
    scores = float(bool(did)), float(bool(would))
    other = Otherwise("block.mass", (0.1,), (0.05,), *scores, did, would)
    assert str(other) == f"with block.mass = 0.05 instead of 0.1 {words}"
