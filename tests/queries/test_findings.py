"""What a hostile reader found, and what holds now."""

from __future__ import annotations

import copy
import pickle
import threading
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest

from scm_world.errors import (
    ActionError,
    Forbidden,
    InterventionError,
    ModelError,
    ScmWorldError,
    UnknownVariable,
    UnreadableFile,
)
from scm_world.queries import (
    Laboratory,
    Outcome,
    Random,
    World,
    but_for,
    compare,
    do,
    identify,
    load_episode,
    nature_graph,
    save_episode,
)
from scm_world.variables import Contact, Hard, Mechanism, Null, Reaches

FLOOR = "floor_friction"


@pytest.fixture
def world() -> World:
    """Give a world without physics."""
    return World("pushing", backend="fake")


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
@pytest.mark.parametrize("at", [0, 9, 10])
def test_a_later_plan_takes_over_at_once(tmp_path: Path, backend: str, at: int) -> None:
    """Wherever snapshots are, branch, replay, file and branch of the branch agree."""
    world = World("pushing", backend=backend)
    episode = world.rollout("random", seed=1, steps=14, do={FLOOR: Hard(0.1, at=at)})
    other = episode.counterfactual({FLOOR: Hard(0.9, at=12)}, at=at)
    assert other[FLOOR].tolist() == [0.5] * 12 + [0.9] * 3
    assert other.replay().values[FLOOR] == other[FLOOR].tolist()
    assert other.counterfactual({}, at=3) == other
    assert load_episode(save_episode(other, tmp_path / "a.b")) == other
    assert [path.name for path in tmp_path.iterdir()] == ["a.b.npz"]


def test_what_appears_or_goes_within_an_episode_is_written_as_far_as_it_is_there() -> None:
    """In rollouts and branches, whether it was asked for beforehand or not."""
    reaching, name = World("reaching", backend="fake"), "obstacle_1.cartesian_position"
    episode = reaching.rollout(steps=6, do={"number_of_obstacles": Hard(2, at=4)}, record=[name])
    assert episode[name].shape == (3, 3)
    assert episode.counterfactual({}, at=5, record=name)[name].shape == (3, 3)
    with pytest.raises(UnknownVariable):
        _ = reaching.rollout(steps=2, record="nobody")["nobody"]
    pushing = World("pushing", backend="fake")
    gone = pushing.rollout(steps=3, do={"tool_block": Null(at=1)}, record=["tool_block.mass"])
    assert gone["tool_block.mass"].shape == (1,)


def test_every_question_knows_what_is_given(world: World) -> None:
    """Effects over values, laboratories and graphs of nature, too."""
    given = world.given({"tool_block.mass": 0.2})
    over = given.effect_over("tool_block.mass", name=FLOOR, values=[0.2, 0.4], n=2, steps=1)
    assert over[0].treated == 0.2
    lab = Laboratory(given, outcomes=["tool_block.mass"], steps=1)
    assert lab.see(1)["tool_block.mass"] == [0.2]
    assert lab.counterfactual(0, {})["tool_block.mass"] == 0.2


def test_nature_acts_at_the_beginning_in_any_spelling(world: World) -> None:
    """Later it is refused: the graph of one episode could not tell it."""

    def tie(**time: Any) -> Mechanism:
        return Mechanism(lambda m: 0.2 + m, ["tool_block.mass"], **time)

    for act in (tie(), tie(at=0), tie(during=(0, None))):
        graph = nature_graph(world.model, {FLOOR: act}, ["reward"])
        assert set(graph.predecessors(FLOOR)) == {"tool_block.mass"}
    with pytest.raises(ModelError, match="at the beginning"):
        nature_graph(world.model, {FLOOR: tie(at=2)}, ["reward"])


def test_a_mechanism_cannot_change_its_causes(world: World) -> None:
    """What it writes into is a copy."""

    def greedy(color: Any) -> float:
        color[0] = 0.9
        return 0.3

    before = world.rollout(steps=2)["floor_color"]
    world.rollout(steps=2, do={FLOOR: Mechanism(greedy, ["floor_color"])})
    np.testing.assert_array_equal(world.rollout(steps=2)["floor_color"], before)


def test_no_column_is_lost(world: World) -> None:
    """Functions of one name get numbers."""
    found = world.see(2, outcomes=[lambda _: 1.0, lambda _: 2.0], steps=1)
    assert [values.tolist() for values in found.values()] == [[1.0, 1.0], [2.0, 2.0]]
    same = Laboratory(world, outcomes=["reward", "reward"], steps=1).see(1)
    assert len(same) == 1
    groups = world.effect_by(lambda _: 1.0, do={}, by=lambda _: 2.0, bins=1, n=4, steps=1)
    assert groups[0][0] == (2.0, 2.0)


def test_snapshots_remember_which_events_have_happened(world: World) -> None:
    """Back before it, an event is waited for again."""
    given = world.given({FLOOR: Hard(0.2, when=Reaches("joint_positions", below=-0.2))})
    given.reset(seed=0)
    start, stay = given.snapshot(), np.array(given["joint_positions"])
    for _ in range(12):
        given.step(given.action_low * 0.5)
    assert given[FLOOR] == 0.2
    given.restore(start)
    for _ in range(12):
        given.step(stay)
    assert given[FLOOR] == 0.5


def test_a_reset_takes_timed_interventions(world: World) -> None:
    """Of a world that is given something, and of any other; the later word counts."""
    for other in (world, world.given({"tool_block.mass": 0.05})):
        other.reset(seed=0, do={FLOOR: Hard(0.2, at=2)})
        for _ in range(3):
            other.step(other["joint_positions"])
        assert other[FLOOR] == 0.2
        other.reset(seed=0)
        for _ in range(3):
            other.step(other["joint_positions"])
        assert other[FLOOR] == 0.5
    held = World("pushing", backend="fake").given({FLOOR: Hard(0.2, during=(1, 2))})
    held.reset(seed=0, do={FLOOR: 0.7})
    for _ in range(3):
        held.step(held["joint_positions"])
        assert held[FLOOR] == 0.7


def test_the_last_name_of_a_quantity_counts(world: World) -> None:
    """Cartesian or cylindrical, given, done, or imagined."""
    a = {"tool_block.cartesian_position": [0.05, 0.0, 0.0325]}
    b = {"tool_block.cylindrical_position": [0.1, 0.0, 0.0325]}
    found = [
        world.given(a).rollout(steps=1, do=b),
        world.rollout(steps=1, do=a).counterfactual(b),
        world.given(a).given(b).rollout(steps=1),
    ]
    for episode in found:
        np.testing.assert_allclose(episode["tool_block.cartesian_position"][0], [0.1, 0.0, 0.0325])


def test_names_of_a_quantity_may_meet_by_different_times(world: World) -> None:
    """The last of them counts at that step; at one time it is not known which, and an error."""
    a = Hard([0.05, 0.0, 0.0325], every=2)
    b = Hard([0.1, 0.0, 0.0325], at=4)
    names = "tool_block.cartesian_position", "tool_block.cylindrical_position"
    found = world.rollout(steps=6, do=dict(zip(names, (a, b), strict=True)))[names[0]][:, 0]
    np.testing.assert_allclose(found, [0.05] * 4 + [0.1] * 3)
    with pytest.raises(InterventionError, match="give one of them"):
        world.rollout(steps=6, do=dict.fromkeys(names, b))


def test_nature_counts_until_something_is_done(world: World) -> None:
    """The treatment does not change the past of its units."""
    options: dict[str, Any] = {"nature": {FLOOR: "A"}, "steps": 3}
    first = Outcome(FLOOR, "first")
    done = world.sample(3, {FLOOR: Hard(0.3, at=1)}, outcomes=[first, FLOOR], **options)
    seen = world.see(3, outcomes=[first], **options)
    np.testing.assert_array_equal(done["first floor_friction"], seen["first floor_friction"])
    assert done[FLOOR].tolist() == [0.3] * 3


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([Hard(0.4, during=(3, 5)), Hard(0.2, during=(1, 3))], [0.5, 0.2, 0.2, 0.4, 0.4, 0.5]),
        ([Hard(0.2, during=(1, 3)), Hard(0.4, during=(3, 5))], [0.5, 0.2, 0.2, 0.4, 0.4, 0.5]),
        ([Hard(0.2, during=(1, 5)), Hard(0.4, during=(2, 3))], [0.5, 0.2, 0.4, 0.2, 0.2, 0.5]),
    ],
)
def test_windows_may_meet_and_lie_in_one_another(
    world: World, parts: list[Hard], expected: list[float]
) -> None:
    """In any order: where one ends, the one around it goes on."""
    found = world.rollout(steps=6, do={FLOOR: parts})[FLOOR]
    assert found.tolist() == [*expected, 0.5]


def test_but_for_an_absence(world: World) -> None:
    """What would have been, had the block been there."""
    episode = world.rollout(steps=2, do={"tool_block": Null()})
    found = but_for(episode, lambda e: len(e.names))
    assert found.causes.tolist() == [("tool_block",)]
    assert found.mattered.all()


def test_policies_act_and_episodes_travel(world: World) -> None:
    """A policy that intervenes is refused; an episode can be pickled and copied."""

    def cheat(there: World) -> Any:
        there.do({FLOOR: 0.1})
        return there["joint_positions"]

    with pytest.raises(ActionError, match="through its action only"):
        world.rollout(cheat, steps=2)
    episode = world.rollout(seed=1, steps=3)
    for again in (pickle.loads(pickle.dumps(episode)), copy.deepcopy(episode)):  # noqa: S301
        assert again == episode
        assert again.counterfactual({}) == episode
    live = world.live(seed=1)
    for copied in (pickle.dumps, copy.deepcopy):
        with pytest.raises(ScmWorldError, match="a live one"):
            copied(live)


def test_threads_share_one_budget(world: World) -> None:
    """Of two that ask for all of it, one gets it."""
    lab = Laboratory(world, outcomes=["reward"], steps=2, budget=2)
    refused: list[Exception] = []

    def ask() -> None:
        try:
            lab.do({FLOOR: 0.3}, 2)
        except Forbidden as error:
            refused.append(error)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (lab.remaining, len(refused)) == (0, 3)


def test_a_refusal_in_the_middle_is_paid(world: World) -> None:
    """It would tell for nothing what is not to be seen; one beforehand is free."""
    lab = Laboratory(world, outcomes=["reward"], steps=3, budget=3)
    with pytest.raises(InterventionError):
        lab.do({FLOOR: 99.0})
    with pytest.raises(InterventionError):
        lab.do({FLOOR: Hard(99.0, when=Reaches("tool_block.mass", above=0.0))})
    assert lab.remaining == 3
    with pytest.raises(InterventionError):
        lab.do({"tool_block.cartesian_position": Hard([0.0, 0.0, 0.001], at=1)})
    assert lab.remaining == 2
    assert lab.see(1).numbers == (1,)


def test_contacts_of_the_invisible_are(world: World) -> None:
    """Who may not see the fingers may not wait for them."""
    lab = Laboratory(world, visible=["tool_block.*"], settable=["*friction"], steps=2)
    lab.do({FLOOR: Hard(0.3, when=Contact("tool_block", "floor"))})
    with pytest.raises(Forbidden, match="contacts"):
        lab.do({FLOOR: Hard(0.3, when=Contact("tool_block", "robot"))})


def test_plans_may_be_made_of_anything_that_is_a_plan() -> None:
    """Names of spaces, tuples of timed parts, plans themselves."""
    plan = do({FLOOR: "A", "action": (Hard([0.1] * 9, at=1), Hard([0.2] * 9, at=3))})
    assert do(plan) == plan == do({}).do(plan)


@pytest.mark.parametrize(
    "ask",
    [
        lambda w: Random(every=0),
        lambda w: Reaches("reward", above="a"),
        lambda w: Reaches("reward", above=0.0, component=-1),
        lambda w: Contact(1, 2),  # type: ignore[arg-type] # that is the point
        lambda w: Hard(3.0, when="touch"),
        lambda w: w.rollout(
            steps=2, do={FLOOR: Hard(1, when=Reaches("reward", above=0.0, component=9))}
        ),
        lambda w: compare(1, 2),  # type: ignore[arg-type] # that is the point
        lambda w: identify(nx.DiGraph([("a", "b"), ("b", "a")]), "a", "b"),
        lambda w: identify(nx.Graph([("a", "b")]), "a", "b"),
        lambda w: identify(nx.DiGraph([("a", "b")]), "a", "a"),
        lambda w: identify(nx.DiGraph([("a", "b")]), "a", "b", observed=["c"]),
        lambda w: identify(w, "a", "b"),  # type: ignore[arg-type] # that is the point
    ],
)
def test_what_is_no_question_is_answered_with_what_is(world: World, ask: Any) -> None:
    """An error of this package, not of Python, numpy or pydantic."""
    with pytest.raises(ScmWorldError):
        ask(world)


def test_other_files_are_no_episodes(tmp_path: Path) -> None:
    """An array, an archive of something else, a description with holes."""
    np.save(tmp_path / "a.npy", np.zeros(3))
    np.savez(tmp_path / "b.npz", about=np.array("{}"), actions=0, states=0, lengths=0)
    for name in ("a.npy", "b.npz"):
        with pytest.raises(UnreadableFile, match="save_episode"):
            load_episode(tmp_path / name)
