"""Episodes that happen together are, bit for bit, those that happen alone."""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scm_world.backends.mujoco.batch import MujocoBatch
from scm_world.discovery.data import Design
from scm_world.discovery.data.worlds import EpisodeRows
from scm_world.errors import (
    EngineFailure,
    InterventionError,
    OutOfBounds,
    UnknownOption,
    UnknownVariable,
)
from scm_world.graph import SCM
from scm_world.queries import Outcome, World
from scm_world.queries import twins as parallel
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.samples import Setting
from scm_world.queries.together import EpisodeBatch, is_known, run_together
from scm_world.queries.twins import Twins, twins_of
from scm_world.variables import (
    Contact,
    Draw,
    Exogenous,
    Hard,
    Natural,
    Normal,
    Null,
    Reaches,
    Scale,
    Shift,
)

BULLET = pytest.mark.skipif(
    importlib.util.find_spec("pybullet") is None, reason="Bullet is not installed"
)
NAMES = (
    "reward",
    "success",
    "end_effector_positions",
    "action",
    "control_index",
    "tool_block.mass",
    "tool_block.cartesian_position",
)
FALLS = Reaches("tool_block.linear_velocity", below=-0.01, component=2)
PLANS: tuple[Mapping[str, Any], ...] = (
    {},
    {"tool_block.mass": 0.05},
    {"floor_friction": Hard(0.3, at=5)},
    {"tool_block.cartesian_position": Hard([0, 0, 0.1], during=(3, 7))},
    {"gravity": Hard([0, 0, -5.0], during=(3, 9))},
    {"tool_block.mass": Hard(0.03, when=Contact("robot", "tool_block"))},
    {"tool_block.cartesian_position": [0, 0, 0.1], "tool_block.mass": Hard(0.03, when=FALLS)},
    {"tool_block": Null(at=8)},
    {"actuator_noise": 0.1},
    {"control_index": 5},
    {"preset": 1},
    {"tool_block.size": [0.07, 0.07, 0.07]},
    {"tool_block.mass": Hard(-1.0, at=10)},
    {"tool_block.mass": -1.0},
    {"nothing": 3},
)


def units_of(world: World, plans: Sequence[Mapping[str, Any]], **setting: Any) -> list[Unit]:
    """Say what is to happen, one unit for each plan."""
    names = setting.pop("names", NAMES)
    made = Setting(**{"steps": 14, **setting})
    return [made.unit(world, plan, i, names) for i, plan in enumerate(plans)]


def alone(twins: Twins, units: Sequence[Unit]) -> list[Episode | Exception]:
    """Let units happen one after another."""
    found: list[Episode | Exception] = []
    with twins.twin() as world:
        for unit in units:
            try:
                found.append(unit.run(world))
            except Exception as error:
                found.append(error)
    return found


def together(twins: Twins, units: Sequence[Unit], threads: int = 2) -> list[Episode | Exception]:
    """Let units happen at the same time."""
    found: list[Any] = [None] * len(units)
    with twins.rows(len(units), units[0].names, threads) as batch:
        for places, result in run_together(batch, units, twins):
            for place, one in zip(
                places, [result] if isinstance(result, Exception) else result, strict=True
            ):
                found[place] = one
    return found


def same_values(one: Any, other: Any) -> bool:
    """Tell whether two values have the same type, shape and bits."""
    a, b = np.asarray(one), np.asarray(other)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def assert_same(one: Episode | Exception, other: Episode | Exception) -> None:
    """Compare all that two units leave behind, but for snapshots."""
    if not isinstance(one, Episode) or not isinstance(other, Episode):
        assert (type(one), str(one)) == (type(other), str(other))
        return
    for a, b in ((one.vectors, other.vectors), (one.taken, other.taken)):
        assert len(a) == len(b)
        assert all(map(same_values, a, b))
    for mine, its in zip(one.eras, other.eras, strict=True):
        assert (mine.step, mine.compiled.plan) == (its.step, its.compiled.plan)
        assert mine.statics.keys() == its.statics.keys()
        assert all(same_values(mine.statics[name], its.statics[name]) for name in mine.statics)
    assert one.memory.fired == other.memory.fired
    assert {at: str(a) for at, a in one.audits.items()} == {
        at: str(a) for at, a in other.audits.items()
    }
    assert one.values.keys() == other.values.keys()
    for name, values in one.values.items():
        assert len(values) == len(other.values[name])
        assert all(map(same_values, values, other.values[name])), name


SETTINGS: tuple[dict[str, Any], ...] = (
    {},
    {"policy": "across"},
    {"policy": None, "action_mode": "end_effector_positions"},
    {"action_mode": "joint_torques", "preset": "precise"},
    {"policy": np.full((3, 9), 0.1), "action_mode": "joint_torques"},
    {"policy": "sweep", "action_mode": "joint_torques"},
)
ENGINES = ["mujoco", "fake", pytest.param("bullet", marks=BULLET)]


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
@pytest.mark.parametrize("backend", ENGINES)
def test_lives_together_are_those_alone(backend: str, setting: dict[str, Any]) -> None:
    """Whatever is done, when it is done, and whether it is refused."""
    options = {key: setting[key] for key in ("action_mode", "preset") if key in setting}
    how = {"policy": setting["policy"]} if "policy" in setting else {}
    world = World("pushing", backend=backend, **options)
    plans = PLANS if backend != "bullet" else PLANS[1:8]  # making a world of Bullet takes long
    units, twins = units_of(world, plans, **how), twins_of(world)
    for one, other in zip(alone(twins, units), together(twins, units), strict=True):
        assert_same(one, other)


DRAWN: tuple[Mapping[str, Any], ...] = (
    {"floor_friction": Shift(0.05)},
    {"floor_friction": Shift(0.05, at=4), "tool_block.mass": Draw("B", at=2)},
    {"gravity": Draw("A"), "joint_damping": Hard(0.05, during=(2, 6))},
    {"tool_block.mass": Draw("A", every=3)},
    {"block.size": Draw("A"), "floor_friction": Natural(at=5)},
    {"tool_block.friction": Hard(0.4, when=FALLS)},
    {"sensor_noise": 0.1, "tool_block.mass": Hard(5.0, at=6)},
)
NATURE = {"floor_friction": "A", "tool_block.mass": Draw("A"), "stage_friction": Scale(1.1)}


@pytest.mark.parametrize("n", [1, 5, 21])
@pytest.mark.parametrize("backend", ["mujoco", "fake"])
def test_rows_of_one_plan_are_those_alone(backend: str, n: int) -> None:
    """Draws, acts in mid-episode, refusals and nature, in batches of any size; also as arrays."""
    world = World("pushing", backend=backend)
    twins = twins_of(world)
    made = Setting(steps=9, nature=NATURE, seed=3)
    of_plan = [made.unit(world, plan, 0, NAMES) for plan in DRAWN]
    units = [replace(of_plan[i % len(DRAWN)], number=40 - i) for i in range(21)]
    expected = alone(twins, units)
    assert sum(isinstance(one, Exception) for one in expected) == 3
    for first in range(0, len(units), n):
        some = slice(first, first + n)
        found = together(twins, units[some])
        for one, other in zip(expected[some], found, strict=True):
            assert_same(one, other)
    names = ("reward", "tool_block.cartesian_position", "floor_friction", "action")

    def read(episodes: EpisodeBatch) -> Any:
        assert len({len(episodes), len(episodes.vectors), len(episodes.units)}) == 1
        return zip(*(episodes.read(name) for name in names), strict=True)

    rows = twins.run(units, read, catch=OutOfBounds)
    for one, row in zip(expected, rows, strict=True):
        if isinstance(one, Episode):
            assert all(map(same_values, row, (one[name] for name in names)))
        else:
            assert str(row) == str(one)


def test_a_context_that_cannot_be_drawn_is_refused_in_rows_too() -> None:
    """Though an intervention replaces it."""
    world = World("pushing", backend="fake")
    nature = {"goal_block.cartesian_position": "A"}  # its cylindrical position has a space A
    do = {"goal_block.cylindrical_position": Draw("A")}
    for n in (2, parallel.LEAST + 5):
        with pytest.raises(InterventionError, match="no space A"):
            world.sample(n, do, outcomes=["reward"], nature=nature, steps=2)


def test_rows_that_were_drawn_have_counterfactuals() -> None:
    """What was drawn in a row is remembered where it is asked for."""
    world = World("pushing", backend="fake")
    twins = twins_of(world)
    plan = {"tool_block.mass": Draw("A"), "gravity": Draw("A", at=2)}
    units = units_of(world, [plan] * 6, names=("reward",), steps=8)
    for one, other in zip(alone(twins, units), together(twins, units), strict=True):
        assert isinstance(one, Episode)
        assert isinstance(other, Episode)
        do = {"tool_block.mass": Shift(0.01), "gravity": Natural(at=6)}
        assert pickle.loads(pickle.dumps(other)) == one  # noqa: S301 # our own
        branches = [world.rollout("random", episode=one.number, do=plan, steps=8), other]
        first, second = (branch.counterfactual(do, at=5) for branch in branches)
        assert first == second


def test_worlds_begin_episodes_by_their_numbers() -> None:
    """Rows and worlds by themselves, with a seed; without one the next episode begins."""
    one = World("pushing", backend="fake", variables_space="A")
    do = {"tool_block.mass": Draw("A")}
    worlds = World("pushing", backend="fake", num_worlds=3)
    equations = World(SCM([Exogenous(name="x", distribution=Normal())]), num_worlds=3)
    for _ in range(2):  # rows, then a world by itself among them
        worlds.reset(seed=[5, 6, 6], episode=[2, 0, 9], do=do)
        for row, (seed, number) in enumerate([(5, 2), (6, 0), (6, 9)]):
            one.reset(seed=seed, episode=number, do=do)
            assert one["tool_block.mass"] == worlds["tool_block.mass"][row]
        worlds.reset(do=do)
        one.reset(seed=6, episode=10, do=do)
        assert one["tool_block.mass"] == worlds["tool_block.mass"][2]
        worlds.world(2)
    equations.reset(seed=[4, 4, 4], episode=[0, 1, 7])
    drawn = equations.one.model.draw(8, seed=4)["x"]
    assert equations["x"].tolist() == drawn[[0, 1, 7]].tolist()
    with pytest.raises(UnknownOption, match="a list of 3"):
        worlds.reset(seed=1, episode=[1, 2])
    with pytest.raises(UnknownOption, match="any whole number"):
        equations.reset(seed=1, episode=-1)


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_lives_do_not_depend_on_threads_or_company(threads: int) -> None:
    """One, two or four threads; five worlds at once, or seven."""
    world = World("stacking2")
    twins = twins_of(world)
    units = units_of(world, [{}, {"gravity": [0, 0, -3.0]}] * 4, names=("reward",), steps=5)
    expected = alone(twins, units)
    for n in (5, 7, 8):
        for one, other in zip(expected, together(twins, units[:n], threads), strict=False):
            assert_same(one, other)


@pytest.mark.parametrize("at", [0, 1, 10, 23])
def test_branches_together_are_those_alone(at: int) -> None:
    """From any instant, with events before and after it, of an episode that had no snapshots."""
    world = World("pushing")
    twins = twins_of(world)
    event = {
        "floor_friction": Hard(0.3, when=Contact("robot", "tool_block")),
        "gravity": Hard([0, 0, -5], at=12),
    }
    (unit,) = units_of(world, [event], steps=24, policy="across")
    (episode,) = together(twins, [unit])
    assert isinstance(episode, Episode)
    lived = world.rollout("across", seed=0, do=event, steps=24)
    assert episode == lived
    assert not episode.snapshots
    dos = [{"tool_block.mass": 0.02 + 0.001 * i} for i in range(24)]
    branches = episode.worlds(dos, at=at, record=["reward"], workers=2)
    assert len(branches) == 24
    for do, branch in zip(dos[::6], branches[::6], strict=True):
        single = lived.counterfactual(do, at=at, record=["reward"])
        assert_same(single, branch)
        assert episode.counterfactual(do, at=at) == single
    again = branches[3].counterfactual({"floor_friction": 0.5}, at=at)
    first = lived.counterfactual(dos[3], at=at).counterfactual({"floor_friction": 0.5}, at=at)
    assert again == first


def sampled(world: World, n: int = 24, **setting: Any) -> Any:
    """Ask a question that is worth a batch."""
    told: list[tuple[int, int]] = []
    outcomes = ("reward", Outcome("reward", "sum"), "tool_block.mass", lambda e: e.final("action"))
    found = world.sample(
        n,
        {"floor_friction": 0.4},
        outcomes=outcomes,
        nature={"tool_block.mass": "A"},
        progress=lambda *at: told.append(at),
        **{"steps": 12, **setting},
    )
    assert told == [(i, n) for i in range(1, n + 1)]
    return found


def test_samples_are_the_same_together_and_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers, order and progress; and a batch was used for one of them only."""
    world = World("pushing")
    found = [sampled(world, workers=workers) for workers in (None, 1, 2)]
    assert twins_of(world).batched >= parallel.LEAST
    other = World("pushing")
    monkeypatch.setattr(parallel, "LEAST", 10**9)
    found.append(sampled(other))
    assert twins_of(other).batched == 0
    for samples in found[1:]:
        assert all(same_values(samples[name], found[0][name]) for name in found[0])


def test_a_policy_that_looks_at_the_world_is_not_known() -> None:
    """Its actions cannot be told beforehand; nor can all variables be written down together."""
    world = World("pushing", backend="fake")
    policies = ["random", None, "across", np.zeros(9), "feedback", lambda _: np.zeros(9)]
    known = [is_known(units_of(world, [{}], policy=policy)[0]) for policy in policies]
    assert known == [True, True, True, True, False, False]
    assert not is_known(units_of(world, [{}], names=("*",))[0])


def test_one_refusal_among_many_is_the_one_that_is_told() -> None:
    """Of several, the first; afterwards the twins are there again, and they are sound."""
    world = World("pushing")
    episode = world.rollout("random", steps=30)
    dos: list[dict[str, Any]] = [{"tool_block.mass": 0.03}] * 22
    dos[3], dos[7] = {"tool_block.mass": Hard(-1.0, at=20)}, {"nothing": 1}
    with pytest.raises(OutOfBounds, match=r"tool_block\.mass"):
        episode.worlds(dos)
    with pytest.raises(UnknownVariable, match="nothing"):
        episode.worlds(dos[4:])
    assert twins_of(world).batched >= parallel.LEAST
    assert episode.worlds([{}] * 22)[21] == episode


def test_an_interruption_loses_no_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while worlds are stepped, or while an outcome is read, leaves twins that work."""
    world = World("pushing")
    expected = sampled(world)
    step, calls = MujocoBatch.step, []

    def interrupted(self: MujocoBatch, *given: Any) -> None:
        calls.append(given)
        if len(calls) == 5:
            raise KeyboardInterrupt
        step(self, *given)

    monkeypatch.setattr(MujocoBatch, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sampled(world)
    again = sampled(world)
    assert all(same_values(again[name], expected[name]) for name in expected)


def test_a_failure_of_the_engine_ends_one_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The others are found alone."""
    world = World("pushing")
    expected = sampled(world)
    step, calls = MujocoBatch.step, []

    def failing(self: MujocoBatch, *given: Any) -> None:
        calls.append(given)
        if len(calls) == 5:
            raise EngineFailure("one state is lost", "mujoco")
        step(self, *given)

    monkeypatch.setattr(MujocoBatch, "step", failing)
    again = sampled(world)
    assert all(same_values(again[name], expected[name]) for name in expected)


def test_a_source_elsewhere_has_one_thread() -> None:
    """Workers share the cores; here a source has all of them."""
    world = World("pushing", backend="fake")
    source: Any = EpisodeRows(world, Design("single", ("tool_block.mass",)), Setting())
    assert source._setting.workers is None
    assert pickle.loads(pickle.dumps(source))._setting.workers == 1  # noqa: S301 # our own
