"""Backends of one's own: registered by name, or made of another engine."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from robot_scenes import busy_scene, play

import scm_world  # noqa: F401 # registers the environments
from scm_world.backends import (
    BACKENDS,
    Backend,
    BackendWrapper,
    Capabilities,
    backends,
    make_backend,
    register,
)
from scm_world.errors import ModelError, SnapshotMismatch, UnknownOption
from scm_world.evaluation import evaluate
from scm_world.testing.backend import BackendConformance

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "own_backend.py"


def _example() -> Any:
    """Import the example, as a module of the user's would be."""
    spec = importlib.util.spec_from_file_location("own_backend", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["own_backend"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[Backend]]:
    """Provide a registry that is forgotten after the test."""
    mine: dict[str, type[Backend]] = {}
    monkeypatch.setattr("scm_world.backends._REGISTERED", mine)
    return mine


class Twin(BackendWrapper):
    """The fake under another name."""

    name: ClassVar[str] = "twin"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False)

    def __init__(self) -> None:
        super().__init__(make_backend("fake"))


class TestWrapper(BackendConformance):
    """An engine in an engine keeps what the one inside promises."""

    def make(self) -> Backend:
        """Create it."""
        return Twin()


def test_what_is_registered_is_known_by_its_name(registry: dict[str, type[Backend]]) -> None:
    """Environments and evaluations take the name, and it does what the engine inside does."""
    assert register(Twin) is Twin
    assert register(Twin) is Twin  # a second time, as when a module is run again
    assert backends()[: len(BACKENDS) + 1] == (*BACKENDS, "twin")
    seen = []
    for engine in ("fake", "twin"):
        env: Any = gymnasium.make("scm_world/Pushing-v0", backend=engine)
        env.reset(seed=0)
        seen.append(env.step(np.ones(9, np.float32))[0])
    np.testing.assert_array_equal(*seen)
    short = {"max_episode_length": 3}
    found = evaluate("random", "P5", n=2, backend=("fake", "twin"), env=short)
    assert found.difference("fake", "twin", "P5").value == 0.0


def test_a_name_belongs_to_one(registry: dict[str, type[Backend]]) -> None:
    """Names of this package and of others are not taken over."""
    register(Twin)
    for name in ("twin", "mujoco"):
        other = type("Other", (Twin,), {"name": name})
        with pytest.raises(UnknownOption, match="a name that is not taken"):
            register(other)
    assert registry == {"twin": Twin}
    with pytest.raises(UnknownOption, match="twin"):
        make_backend("twins")
    names: Any = (["mujoco"], None)
    for name in names:
        with pytest.raises(UnknownOption, match="of type str"):
            make_backend(name)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (Twin(), "is not a class derived from"),
        (int, "is not a class derived from"),
        (type("Nameless", (BackendWrapper,), {}), "has no name"),
        (type("Half", (Backend,), {"name": "half"}), "does not define 'apply'"),
    ],
    ids=["instance", "int", "nameless", "half"],
)
def test_what_is_no_backend_is_refused(
    registry: dict[str, type[Backend]], given: Any, said: str
) -> None:
    """The error says what is missing, all of it."""
    with pytest.raises(ModelError, match=said):
        register(given)
    assert not registry


def test_snapshots_of_the_engine_inside_are_others() -> None:
    """What the engine took alone does not say what the one around it remembers."""
    inside, around = make_backend("fake"), Twin()
    for backend in (inside, around):
        backend.build(busy_scene())
    with pytest.raises(SnapshotMismatch, match="twin fake 1"):
        around.restore(inside.snapshot())
    with pytest.raises(SnapshotMismatch):
        inside.restore(around.snapshot())


def test_the_example_moves_more_slowly(registry: dict[str, type[Backend]]) -> None:
    """Its motors do not go as far in a control step, and go on bit for bit after a snapshot."""
    module = _example()
    slow, fast = make_backend("slow_motors"), make_backend("mujoco")
    for backend in (slow, fast):
        backend.build(busy_scene())
    before = slow.read().joint_positions.copy()
    kept = slow.snapshot()
    moved = [np.abs(play(backend, 1)[-1][:9] - before).max() for backend in (slow, fast)]
    assert module.AHEAD < moved[0] < 2 * module.AHEAD < moved[1]
    once = play(slow, 5)
    slow.restore(kept)
    play(slow, 1)
    assert np.array_equal(play(slow, 5), once)
