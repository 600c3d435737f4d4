"""Questions that compare equal runs bit for bit are asked of engines that are exact, only."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest

from scm_world import World, discover, verify
from scm_world.backends import Backend, BackendWrapper, Capabilities, make_backend
from scm_world.errors import InexactEngine
from scm_world.models import Difference
from scm_world.testing.model import check_undo

FLOOR = 1e-6


class Loose(BackendWrapper):
    """The fake, with an object that is pushed at random: no two runs are equal."""

    name: ClassVar[str] = "loose"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False, floor=FLOOR)

    def __init__(self) -> None:
        super().__init__(make_backend("fake"))

    def step(self, command: Any, substeps: int) -> None:
        """Push the object."""
        super().step(command, substeps)
        state = self.engine.read()
        where = state.layout.slices["tool_block.cartesian_position"]
        state.vector[where] += FLOOR * np.random.default_rng().uniform(size=3)
        self.engine.apply(Difference(state=state))


class Around(BackendWrapper):
    """What wraps an engine that is not exact."""

    name: ClassVar[str] = "around"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False)


@pytest.fixture
def loose(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Provide a world on it."""
    monkeypatch.setattr("scm_world.backends._REGISTERED", {"loose": Loose})
    return World("pushing", backend="loose", max_episode_length=3)


def asked(question: str) -> Callable[[Any], Any]:
    """Return a function that asks a world."""
    return {
        "counterfactual": lambda world: world.rollout(steps=2).counterfactual({"stage_color": 0.5}),
        "counterfactuals": lambda world: world.rollout(steps=2).worlds([{}, {}], workers=2),
        "branch": lambda world: world.live().split({}, at=0),
        "replay": lambda world: world.rollout(steps=2)["reward"],
        "verify": lambda world: verify(world, probes=1, held_out=0),
        "discover": lambda world: discover(world, probes=1),
        "undo": check_undo,
    }[question]


@pytest.mark.parametrize(
    "question",
    ["counterfactual", "counterfactuals", "branch", "replay", "verify", "discover", "undo"],
)
def test_what_needs_bits_names_engines_that_have_them(loose: Any, question: str) -> None:
    """The error says why, and which backend answers; the world is as it was."""
    loose.reset(seed=3)
    before = loose.vector.copy()
    with pytest.raises(InexactEngine, match="use a backend that is exact") as refused:
        asked(question)(loose)
    error = pickle.loads(pickle.dumps(refused.value))  # noqa: S301 # our own
    assert (error.engine, error.floor) == ("loose", FLOOR)
    may = {"bullet", "trifinger_platform"}  # they may not be installed
    assert {*error.exact} - may == {"mujoco", "fake"}
    assert np.array_equal(loose.vector, before)


def test_what_needs_no_bits_is_answered(loose: Any) -> None:
    """Samples, recorded episodes and effects with intervals."""
    mass = {"tool_block.mass": 0.04}
    episode = loose.rollout(steps=2, record=["reward"])
    assert episode["reward"].shape == (3,)
    assert not np.array_equal(episode.vectors[2], loose.rollout(steps=2).vectors[2])
    versus = {"tool_block.mass": 0.03}
    effect = loose.effect("tool_block.mass", do=mass, versus=versus, n=3, steps=1)
    assert effect.mean == pytest.approx(0.01)
    loose.reset(seed=0)
    loose.do(mass)
    assert loose["tool_block.mass"] == 0.04


def test_a_wrapper_is_no_more_exact_than_its_engine() -> None:
    """Whatever the class declares."""
    inside: Backend = Loose()
    assert Around(inside).capabilities == Capabilities(
        physics=False,
        floor=FLOOR,
        supports=Around.capabilities.supports,
        remarks=Around.capabilities.remarks,
    )
    assert Around(make_backend("fake")).capabilities.floor == 0.0
