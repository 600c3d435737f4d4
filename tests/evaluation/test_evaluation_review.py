"""What a hostile reader of evaluations found, and how it is now."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.curricula import timed
from scm_world.errors import ModelError, UnknownOption
from scm_world.evaluation import Evaluation, Protocol, evaluate, why
from scm_world.evaluation.figures import write_figures
from scm_world.evaluation.preparation import again
from scm_world.policies import WorldPolicy
from scm_world.tasks import Pushing

SHORT: dict[str, Any] = {"max_episode_length": 3}


def tiny(policy: Any = "still", protocols: Any = "P0", **options: Any) -> Evaluation:
    """Evaluate on the fake engine."""
    given = {"n": 2, "backend": "fake", "env": SHORT, **options}
    return evaluate(policy, protocols, **given)


def test_what_else_would_have_been_drawn_is_no_answer() -> None:
    """Where another block would have been elsewhere, too, nothing is said about the first."""
    found = tiny(task="stacking2", protocols="P6", n=10, backend="mujoco")
    told = why(found, "P6", 9)
    reasons = told.left_out.values()
    assert any("would have been drawn again with it" in reason for reason in reasons)
    assert {one.variable for one in told.others}.isdisjoint(told.left_out)


def test_a_value_that_was_used_is_told() -> None:
    """A protocol that acts within episodes is explained with the values of that step."""
    often = Protocol("often", act=timed({"every": 2, "at": 2}, {"tool_block.mass": "B"}))
    (one,) = why(tiny(protocols=often), "often", 0).others
    assert one.was[0] >= 0.045
    assert 0.015 <= one.would_be[0] <= 0.045
    assert one.would_be[0] != 0.02  # its default, which the episode had before


def test_what_the_protocol_does_not_set_is_not_explained() -> None:
    """A value that the environment sets is told apart from what it draws."""
    start = {**SHORT, "start": {"floor_friction": "A", "tool_block.mass": 0.03}}
    told = why(tiny(protocols="P5", env=start), "P5", 0)
    assert told.left_out["tool_block.mass"] == "the protocol does not set it"
    assert "floor_friction" in {other.variable for other in told.others}


class Bigger(Pushing):
    """A task of the user's own, under the name of another one."""

    rest = tuple(0.9 * angle for angle in Pushing.rest)


def test_a_task_of_ones_own_is_another_one(tmp_path: Path) -> None:
    """Its results are not those of the task whose name it has; in its process it is known."""
    usual = tiny(task=Pushing(), out=tmp_path)
    own = tiny(task=Bigger(), out=tmp_path)
    assert own != usual
    assert type(again(own).task) is type(again(own.only(episode=1)).task) is Bigger
    elsewhere = deepcopy(own)  # as what comes out of a pickle or a file
    with pytest.raises(UnknownOption, match="task="):
        again(elsewhere)
    again(elsewhere, task=Bigger())
    with pytest.raises(UnknownOption, match="class of the task differ"):
        again(own, task=Pushing())


def test_a_file_does_not_decide_what_is_called() -> None:
    """Neither by its policies nor by what its environment begins with."""
    found = tiny()
    function = {"kind": "function", "reference": "os:getcwd", "constants": {}}
    act = {"kind": "mechanism", "function": function, "parents": []}
    env = {**found.about["env"], "start": {"floor_friction": act}}
    with pytest.raises(ModelError, match=r"os:getcwd.*trusted"):
        again(Evaluation({**found.about, "env": env}, found.frame))


class Noisy:
    """Draws from a noise of its own."""

    def __init__(self, mean: float) -> None:
        self.mean, self.noise = mean, np.random.default_rng(0)

    def __call__(self, observation: Any) -> Any:
        """Act by chance."""
        return self.noise.uniform(-0.1, 0.1, 9) + self.mean


def test_what_another_policy_did_is_not_used_again(tmp_path: Path) -> None:
    """Another one could have its name, and differ in an attribute only."""
    first = tiny({"x": Noisy(-0.5)}, out=tmp_path)
    assert tiny({"x": Noisy(0.5)}, out=tmp_path) != first


def test_episodes_without_noise_have_no_interval() -> None:
    """There is one episode, however often it was played; of several there is."""
    found = tiny(protocols="P0,P2", n=8)
    still, drawn = (found.score(protocol, "success") for protocol in ("P0", "P2"))
    assert (still.low, still.high, str(still)) == (still.value, still.value, f"{still.value:.2f}")
    assert drawn.width > 0.0
    both = tiny({"a": "still", "b": "sweep"}, protocols="P0,P2", n=8)
    assert both.difference("a", "b", "P0").width == 0.0 < both.difference("a", "b", "P2").width


def test_fractions_that_never_vary_have_an_interval() -> None:
    """Eight times nothing may be followed by something."""
    found = tiny(protocols="P2", n=8)
    score = found.score("P2", "last_fractional_success")
    assert (score.value, score.low) == (0.0, 0.0)
    assert score.high == pytest.approx(0.1 + 2.2622 * 0.1, abs=1e-4)  # t of nine degrees


def test_a_list_is_one_agent() -> None:
    """Also if it has no name."""
    found = tiny(["still", "sweep"])
    assert found.agents == ("still",)
    assert found.runs("still") == (0, 1)


def test_one_episode_is_enough_for_figures(tmp_path: Path) -> None:
    """What cannot be said of one episode is left out."""
    files = {path.name for path in write_figures(tiny(n=1, protocols="P0,P2"), tmp_path)}
    assert files == {"bars.png"}


def test_nothing_of_an_earlier_evaluation_stays(tmp_path: Path) -> None:
    """Pictures that are not made again are deleted."""
    for found in (tiny(protocols="P0,P1,P2"), tiny()):
        found.save(tmp_path)
        write_figures(found, tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert "radar.png" not in left
    assert Evaluation.load(tmp_path) == found


@WorldPolicy
def middle(world: Any) -> Any:
    """Hold the joints in the middle."""
    return 0.5 * (world.action_low + world.action_high)


def test_long_names_are_refused_before_anything_is_played() -> None:
    """They could not stand in the names of files."""
    with pytest.raises(UnknownOption, match="80 letters"):
        tiny({"x" * 300: middle})
