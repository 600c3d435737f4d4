"""Questions that compare equal runs bit for bit are asked of engines that are exact, only."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

from scm_world import World, discover, verify
from scm_world.backends import Backend, BackendWrapper, Capabilities, make_backend
from scm_world.discovery.data import sweep
from scm_world.env import ScmWorldEnv
from scm_world.errors import InexactEngine
from scm_world.evaluation import Recorder, evaluate
from scm_world.models import Difference
from scm_world.queries import Laboratory, consequences, load_episode, save_episode
from scm_world.queries.twins import EQUAL, Twins
from scm_world.testing.model import check_undo

FLOOR = 1e-6
SHORT = {"max_episode_length": 2}


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
        "consequences": lambda world: consequences(world, {"tool_block.mass": 0.04}, steps=1),
        "fit": lambda world: world.fit(world.rollout(steps=2), ["tool_block.mass"]),
        "laboratory": imagine,
        "file": reread,
        "recording": replay,
    }[question]


def imagine(world: World) -> Any:
    """Ask a laboratory for a counterfactual."""
    laboratory = Laboratory(world, outcomes=["tool_block.mass"], steps=1)
    laboratory.see(1)
    return laboratory.counterfactual(0, {"tool_block.mass": 0.04})


def reread(world: World) -> Any:
    """Write an episode, and read it."""
    with TemporaryDirectory() as folder:
        save_episode(world.rollout(steps=1), Path(folder) / "one.npz")
        return load_episode(Path(folder) / "one.npz")


def replay(world: World) -> Any:
    """Record an environment, and replay the recording."""
    env = Recorder(ScmWorldEnv(task="pushing", backend="loose", max_episode_length=2))
    env.reset(seed=0)
    for _ in range(2):
        env.step(env.action_space.sample())
    return env.recording().replay()


@pytest.mark.parametrize(
    "question",
    [
        *("counterfactual", "counterfactuals", "branch", "replay", "verify", "discover", "undo"),
        *("consequences", "fit", "laboratory", "file", "recording"),
    ],
)
def test_what_needs_bits_names_engines_that_have_them(loose: Any, question: str) -> None:
    """The error says why, and which backend answers; the world is as it was."""
    loose.reset(seed=3)
    before = loose.vector.copy()
    with pytest.raises(InexactEngine, match="use a backend that is exact") as refused:
        asked(question)(loose)
    error = pickle.loads(pickle.dumps(refused.value))  # noqa: S301 # our own
    assert (error.engine, error.floor) == ("loose", FLOOR)
    may = {"bullet", "trifinger_platform", "warp:cpu"}  # they may not be installed
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


def test_a_floor_stands_beside_every_effect(loose: Any) -> None:
    """It is measured by equal runs, in the unit of the outcome; less is not seen."""
    mass, where = {"tool_block.mass": 0.04}, "tool_block.cartesian_position"
    nothing = loose.effect(where, do=mass, n=30, steps=3)
    assert nothing.floor.shape == (3,)
    assert (nothing.floor > 0.1 * FLOOR).all()
    assert (nothing.floor < 3.0 * FLOOR).all()
    assert (np.abs(nothing.mean) < nothing.floor).all()
    assert nothing.is_below_floor
    assert not nothing.excludes_zero
    assert "not seen" in str(nothing)
    assert json.loads(nothing.to_json())["floor"] == nothing.floor.tolist()
    assert json.loads(nothing.to_json())["not_seen"] is True

    moved = {f"{where[:10]}.cylindrical_position": [0.05, 0.0, 0.0325]}
    clear = loose.effect(where, do=moved, n=30, steps=3)
    assert clear.excludes_zero
    assert not clear.is_below_floor
    assert "equal runs are up to" in str(clear)
    assert "not seen" not in str(clear)
    longer = loose.effect(where, do=mass, n=30, steps=30)
    assert (longer.floor > nothing.floor).all()  # over its own horizon
    small = loose.effect("tool_block.mass", do=mass, n=3, steps=1)
    assert small.floor == 0.0
    assert small.excludes_zero

    exact = World("pushing", backend="fake").effect(where, do=mass, n=3, steps=1)
    assert not exact.floor.any()
    assert "equal runs" not in str(exact)
    assert not exact.is_below_floor


def test_equal_runs_are_made_once(loose: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The floor is kept with the world, until more units are asked for."""
    made: list[int] = []
    run = Twins.run

    def counted(self: Twins, units: Any, *rest: Any) -> Any:
        made.append(len(units))
        return run(self, units, *rest)

    monkeypatch.setattr(Twins, "run", counted)
    for n, expected in ((4, [4, 4]), (4, [4]), (3, [3]), (100, [100, EQUAL]), (90, [90])):
        made.clear()
        found = loose.sample(n, outcomes=["tool_block.cartesian_position"], steps=2)
        assert made == expected
    assert (found.floors["tool_block.cartesian_position"] > 0.0).all()
    laboratory = Laboratory(loose, outcomes=["tool_block.cartesian_position"], steps=1)
    assert laboratory.see(3).floors  # whoever compares two experiments has it


def test_gaps_are_those_after_so_many_steps(loose: Any) -> None:
    """The object is pushed once in each control step, by half of the floor on average.

    Each gap is the largest of three components, of three starts.
    """
    fake = World("pushing", backend="fake")
    found = fake.compare("loose", probes=3, steps=[1, 10, 200])
    gaps = {(gap.variable, gap.steps): gap for gap in found.gaps}
    for steps in (1, 10, 200):
        gap = gaps["tool_block.cartesian_position", steps]
        assert gap.unit == "m"
        assert 0.3 * steps * FLOOR < gap.median <= gap.largest < steps * FLOOR
        assert gaps["joint_positions", steps].largest == 0.0
    assert abs(gaps["tool_block.cartesian_position", 200].median / (100.0 * FLOOR) - 1.0) < 0.3


def test_a_sweep_has_the_floor(loose: Any) -> None:
    """A column beside each change, and data of the engine say so."""
    over, name = {"tool_block.mass": [0.02, 0.08]}, "tool_block.cartesian_position[0]"
    found = sweep(loose, over, ["tool_block.cartesian_position"], n=5, steps=2)
    row = found.rows()[1]
    assert 0.0 < row[f"{name}.floor"] == found.floors[name] < 3.0 * FLOOR
    assert found.data.about["floor"] == FLOOR
    exact = sweep(World("pushing", backend="fake"), over, ["reward"], n=2, steps=1)
    assert not exact.floors
    assert "floor" not in exact.data.about
    assert not any(key.endswith(".floor") for key in exact.rows()[1])


def test_environments_and_scores_need_no_bits(loose: Any) -> None:
    """Many of them are stepped, and policies are evaluated."""
    with closing(gymnasium.make_vec("scm_world/Pushing-v0", 2, backend="loose")) as envs:
        envs.reset(seed=0)
        assert envs.step(envs.action_space.sample())[1].shape == (2,)
    found = evaluate("random", "P0", task="pushing", n=2, backend="loose", env={**SHORT})
    assert len(found.frame) == 2


def test_a_wrapper_is_no_more_exact_than_its_engine() -> None:
    """Whatever the class declares."""
    inside: Backend = Loose()
    assert Around(inside).capabilities == Capabilities(
        physics=False,
        floor=FLOOR,
        supports=Around.capabilities.supports,
        rounding=Around.capabilities.rounding,
        remarks=Around.capabilities.remarks,
    )
    assert Around(make_backend("fake")).capabilities.floor == 0.0
