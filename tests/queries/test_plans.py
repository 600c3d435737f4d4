"""Facts about plans: interventions with a time, as values."""

from __future__ import annotations

import json

import numpy as np
import pytest

from scm_world.errors import InterventionError, ModelError, ScmWorldError, UnknownOption
from scm_world.queries import SCM, Plan, World, do
from scm_world.variables import (
    Box,
    Contact,
    Draw,
    Exogenous,
    Function,
    Hard,
    Mechanism,
    Natural,
    Normal,
    Reaches,
    Scale,
    Shift,
)

EVERYTHING = Plan(
    {
        "tool_block": {"mass": 0.05, "friction": Shift(0.1)},
        "floor_friction": Scale(0.5, at=10),
        "gravity": Draw("A"),
        "stage_friction": Draw(Box(0.1, 0.2)),
        "action": (Hard([0.1] * 9, at=3), Hard([0.2] * 9, during=(5, 8))),
        "joint_positions": Hard([0.0, 0.9, -1.7] * 3, during=(20, None)),
        "tool_block.cartesian_position": Hard(
            [0.1, 0.0, 0.0325], when=Contact("robot", "tool_block")
        ),
        "restitution": Natural(when=Reaches("reward", below=-1.0)),
        "finger_friction": Mechanism(Function("numpy:mean"), ["floor_color"]),
    }
)


def test_plans_go_to_json_and_back() -> None:
    """Everything without a Python function of one's own survives, as text."""
    text = EVERYTHING.to_json()
    json.loads(text)
    assert Plan.from_json(text, trusted=("numpy",)) == EVERYTHING
    with pytest.raises(ModelError, match="trusted"):
        Plan.from_json(text)
    with pytest.raises(ModelError, match="cannot be found"):
        Plan({"floor_friction": Mechanism(lambda c: c[0], ["floor_color"])}).to_json()
    for wrong in ("", "[]", '{"format": "scm_world/plan/1", "do": {"x": [{"kind": "no"}]}}'):
        with pytest.raises(ModelError, match="not a plan"):
            Plan.from_json(wrong)


def test_later_wins_and_nothing_changes() -> None:
    """do(a).do(b) == do({**a, **b}), in every order, and a stays a."""
    a, b = {"floor_friction": 0.3, "gravity": Draw("A")}, {"floor_friction": Hard(0.4, at=3)}
    first = do(a)
    assert first.do(b) == do({**a, **b})
    assert first == do(a)
    assert do(b).do(a) == do({**b, **a})
    assert do(a).do({}) == do(a) == do({}).do(a)
    assert do({"tool_block": {"mass": 1.0}}) == do({"tool_block.mass": 1.0})
    assert hash(first) == hash(do(dict(reversed(a.items()))))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Hard(0.1, at=-1),
        lambda: Hard(0.1, at=1.5),
        lambda: Hard(0.1, during=(5, 5)),
        lambda: Reaches("reward"),
        lambda: do({"floor_friction": "much"}),
    ],
)
def test_what_is_no_plan_is_refused(make) -> None:  # type: ignore[no-untyped-def] # a table
    """At once, with what it can be."""
    with pytest.raises(ScmWorldError, match="can be"):
        make()


def test_a_parameter_is_held_for_a_window_and_handed_back() -> None:
    """After it, it is what it would have been."""
    world = World("pushing", backend="fake")
    plan = {"floor_friction": Hard(0.2, during=(2, 5)), "block.size": Hard([0.07] * 3, at=3)}
    episode = world.rollout(steps=8, do=plan)
    assert episode["floor_friction"].tolist() == [0.5] * 2 + [0.2] * 3 + [0.5] * 4
    assert episode["tool_block.size"][:, 0].tolist() == [0.065] * 3 + [0.07] * 6
    assert sorted(episode.audits) == [2, 3, 5]


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_a_state_is_held_for_a_window(backend: str) -> None:
    """At the beginning of every step it is where it should be; then it falls."""
    world = World("pushing", backend=backend)
    place = [0.0, -0.08, 0.2]
    episode = world.rollout(
        steps=10, do={"tool_block.cartesian_position": Hard(place, during=(2, 6))}
    )
    found = episode["tool_block.cartesian_position"]
    np.testing.assert_array_equal(found[2:6], [place] * 4)
    assert found[6][2] < 0.2
    with pytest.raises(InterventionError, match="held at a value"):
        world.rollout(steps=3, do={"tool_block.cartesian_position": Shift(0.1, during=(0, None))})


def test_an_action_is_replaced_for_a_window() -> None:
    """The policy acts before and after."""
    world = World("pushing", backend="fake")
    episode = world.rollout([0.0] * 9, steps=6, do={"action": Hard([0.2] * 9, during=(2, 4))})
    assert episode["action"][:-1, 0].tolist() == [0.0, 0.0, 0.2, 0.2, 0.0, 0.0]


def test_an_intervention_is_repeated() -> None:
    """Every few steps, each time from what the present is; in a counterfactual from there on."""
    world = World("pushing", backend="fake")
    episode = world.rollout(steps=9, do={"floor_friction": Draw("A", every=3, at=1)})
    friction = episode["floor_friction"]
    changes = np.flatnonzero(np.diff(friction))
    assert changes.tolist() == [0, 3, 6]
    other = episode.counterfactual({"floor_friction": Draw("B", every=2)}, at=5)
    assert np.flatnonzero(np.diff(other["floor_friction"])).tolist() == [0, 3, 5, 7]
    with pytest.raises(InterventionError, match="counts in the plan of an episode"):
        world.model.do({"floor_friction": Hard(0.3, at=3)})


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_an_event_is_waited_for(backend: str) -> None:
    """At the first touch the block gets another place; it happens once, and the step is told."""
    world = World("pushing", backend=backend)
    place, fall = "tool_block.cartesian_position", [0.0, -0.08, 0.1]
    touch = Shift(0.3, when=Contact("tool_block", "floor"))
    plan = {place: Hard(fall, at=0), "tool_block.friction": touch}
    episode = world.rollout(steps=12, do=plan)
    step = episode.events["tool_block.friction"]
    assert 2 < step < 9
    friction = episode["tool_block.friction"]
    assert friction.tolist() == [1.0] * step + [1.3] * (13 - step)
    assert episode[place][step][2] < 0.04
    assert episode.counterfactual({}, at=step) == episode
    low = world.rollout(
        steps=12,
        do={place: fall, "restitution": Hard(0.2, when=Reaches(place, component=2, below=0.09))},
    )
    assert low.events["restitution"] == int(np.argmax(low[place][:, 2] < 0.09))


def test_plans_of_the_past_are_refused() -> None:
    """A counterfactual cannot do something before it begins."""
    episode = World("pushing", backend="fake").rollout(steps=6)
    with pytest.raises(InterventionError, match="is over"):
        episode.counterfactual({"floor_friction": Hard(0.1, at=2)}, at=4)
    with pytest.raises(UnknownOption, match="at cannot be 6"):
        episode.counterfactual({}, at=6)


def test_a_mechanism_adds_a_cause() -> None:
    """Color becomes a cause of friction: the graph has the edge, and the floor follows."""
    world = World("pushing", backend="fake")
    tie = Mechanism(lambda color: 0.2 + 0.5 * color[0], ["floor_color"])
    with world.given({"floor_friction": tie}) as tied:
        tied.reset(seed=0, do={"floor_color": [0.4, 0.0, 0.0]})
        assert tied.graph.parents("floor_friction") == ("floor_color",)
        assert float(tied["floor_friction"]) == pytest.approx(0.4)
        audit = tied.do({"floor_color": [1.0, 0.0, 0.0]})
        assert "floor_friction" in audit.followed
        assert float(tied["floor_friction"]) == pytest.approx(0.7)
        tied.do({"floor_friction": Shift(0.1)})
        assert float(tied["floor_friction"]) == pytest.approx(0.8)
        tied.do({"floor_friction": Natural()})  # it shows the context, and leaves it
        assert float(tied["floor_friction"]) == pytest.approx(0.7)
    assert world.graph.parents("floor_friction") == ()


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"floor_friction": Mechanism(np.sum, "joint_positions")}, "a parameter can follow"),
        ({"floor_friction": Mechanism(np.sum, "nobody")}, "no variable is named"),
        ({"floor_friction": Mechanism(np.asarray, "floor_color")}, "expected shape"),
        ({"floor_friction": Mechanism(lambda m: m + 5.0, "tool_block.mass")}, "outside"),
        ({"gravity": Mechanism(np.asarray, "gravity")}, "follow itself"),
        ({"tool_block.mass": Mechanism(np.asarray, "reward")}, "a parameter can follow"),
        ({"tool_block.linear_velocity": Mechanism(np.asarray, "reward")}, "a state can follow"),
    ],
    ids=repr,
)
def test_a_mechanism_that_cannot_be_is_refused(request_, words: str) -> None:  # type: ignore[no-untyped-def] # a table
    """The world is as it was."""
    world = World("pushing", backend="fake")
    world.reset(seed=0)
    before = world.values()
    with pytest.raises(InterventionError, match=words):
        world.do(request_)
    assert all(np.array_equal(before[n], value) for n, value in world.values().items())


def test_a_mechanism_of_the_action_is_a_policy() -> None:
    """It sees what it names, at every step."""
    world = World("pushing", backend="fake")
    world.reset(seed=0)
    world.do(
        {"action": Mechanism(lambda q, t: q + 0.001 * t, ["joint_positions", "control_index"])}
    )
    assert set(world.graph.parents("action")) == {"joint_positions", "control_index"}
    for step in range(3):
        before = world["joint_positions"]
        world.step(np.zeros(9))
        np.testing.assert_allclose(world["action"], before + 0.001 * step)


def test_worlds_are_given_more_and_more() -> None:
    """Each is another one; the last word counts; the first is as it was."""
    world = World("pushing", backend="fake")
    light = world.given({"tool_block.mass": 0.03})
    late = light.given({"tool_block.mass": 0.04, "floor_friction": Hard(0.1, at=2)})
    assert late.plan == do({"tool_block.mass": 0.04, "floor_friction": Hard(0.1, at=2)})
    found = [w.rollout(seed=1, steps=4) for w in (world, light, late)]
    assert [float(e["tool_block.mass"][0]) for e in found] == pytest.approx([0.02, 0.03, 0.04])
    late.reset(seed=1)
    for _ in range(3):
        late.step(late["joint_positions"])
    assert float(late["floor_friction"]) == 0.1
    assert world.given({}).rollout(seed=1, steps=4) == found[0]


def test_a_plan_without_times_is_an_intervention() -> None:
    """Wherever something is done at once; one with times is refused where no episode follows it."""
    world = World("pushing", backend="fake")
    plain, later = do({"floor_friction": 0.2}), do({"floor_friction": Hard(0.2, at=3)})
    both = {"floor_friction": (Hard(0.2), Hard(0.3, at=3))}
    world.reset(seed=0, do=plain)
    assert world["floor_friction"] == 0.2
    world.reset(seed=0)
    world.do(plain)
    assert world.graph.do(plain).interventions["floor_friction"].value == 0.2
    for wrong in (later, both):
        with pytest.raises(InterventionError, match=r"count.* in the plan of an episode"):
            world.do(wrong)


def test_models_of_one_instant_know_no_later_one() -> None:
    """A time that never comes is refused, and so is an event."""
    model = SCM([Exogenous(name="a", distribution=Normal(0.0, 1.0))])
    for late in (Hard(0.0, at=2), Hard(0.0, when=Contact("x", "y"))):
        with pytest.raises(UnknownOption, match="has one instant"):
            model.rollout(do={"a": late})
    assert model.rollout(do={"a": Hard(0.5, at=0)}).final("a") == 0.5


def test_a_plain_number_beside_an_intervention_is_a_hard_one() -> None:
    """In a tuple of several as by itself."""
    both = Plan({"floor_friction": (0.3, Hard(0.2, at=5), "A")})
    assert both == Plan({"floor_friction": (Hard(0.3), Hard(0.2, at=5), Draw("A"))})
    assert Plan.from_json(both.to_json()) == both


def test_names_are_text() -> None:
    """Anything else is refused with what is allowed."""
    for request in ({1: 2.0}, {None: 2.0}, {("a", "b"): 2.0}):
        with pytest.raises(UnknownOption, match=r"name of a variable .* text"):
            Plan(request)  # type: ignore[arg-type]


def test_what_is_not_finite_is_not_written() -> None:
    """All such variables are named; doing it is refused, too."""
    plan = Plan({"a": float("nan"), "b": Shift([1.0, float("inf")], at=2), "c": 1.0})
    with pytest.raises(ModelError, match=r"do\(a\).*not finite") as refused:
        plan.to_json()
    assert len(refused.value.problems) == 2
