"""Patterns of names, and relative draws, wherever interventions are accepted."""

import json
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world as sw
from scm_world.curricula import CurriculumEnv
from scm_world.curricula.curriculum import as_curriculum
from scm_world.discovery.data import sweep
from scm_world.errors import (
    ConflictingTargets,
    InterventionError,
    ModelError,
    OutOfBounds,
    SeveralProblems,
    UnknownOption,
    UnknownVariable,
)
from scm_world.queries.laboratory import Laboratory
from scm_world.queries.plans import Plan
from scm_world.variables import (
    Action,
    Box,
    Draw,
    Exogenous,
    Hard,
    Linear,
    Measured,
    Normal,
    Scale,
    Shift,
)
from scm_world.variables.kinds import Derived

ARM = """
<mujoco model="arm">
  <option timestep="0.01"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.5"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.2"/>
        <geom name="lower" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" ctrlrange="-1 1"/>
    <motor name="elbow" joint="elbow" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
MASSES, DAMPINGS = ("upper.mass", "lower.mass"), ("shoulder.damping", "elbow.damping")


def slow(speed: Any) -> float:
    """Reward rest."""
    return -abs(float(speed))


TWICE, DRAWN = Scale(2.0), Scale(Draw(0.8, 1.2))


@pytest.fixture(scope="module")
def arm() -> Iterator[sw.World]:
    """Build one world for all tests, which reset it."""
    with sw.World(ARM) as world:
        yield world


def ratios(world: Any, names: tuple[str, ...] = MASSES) -> Any:
    """Return present values in units of their defaults."""
    return np.array([world[n] / world.model.declared(n).default for n in names])


def test_a_pattern_stands_for_the_variables_that_fit(arm: Any) -> None:
    """All that fits is set, and undone without a trace."""
    arm.reset(seed=0)
    before = arm.values()
    audit = arm.do({"*.damping": TWICE})
    assert {*audit.targets} == {*DAMPINGS}
    assert ratios(arm, DAMPINGS).tolist() == [2.0, 2.0]
    arm.do({"*.damping": sw.Natural()})
    after = arm.values()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_a_name_counts_more_than_a_pattern(arm: Any) -> None:
    """Where both set a variable, its name decides."""
    arm.reset(seed=0, do={"*.mass": TWICE, "lower.mass": 0.7})
    assert [float(arm[name]) for name in MASSES] == [2.0, 0.7]


def test_what_fits_nothing_or_two_patterns_is_refused(arm: Any) -> None:
    """Errors name what is near, or the two patterns."""
    arm.reset(seed=0)
    with pytest.raises(UnknownVariable, match=r"did you mean '\*\.damping'"):
        arm.do({"*.dampin": 1.0})
    with pytest.raises(ConflictingTargets, match=r"'upper\.m\*' and '\*\.mass' both set"):
        arm.do({"upper.m*": 1.0, "*.mass": 2.0})
    with pytest.raises(UnknownVariable):
        arm.rollout("random", steps=2, do={"*.damp": Hard(1.0, at=1)})
    with pytest.raises(InterventionError, match=r"'upper\.mass' alone: .* scale:2"):
        arm.do({"upper.mass*": 2.0})  # upper.mass*=2 on a command line
    assert ratios(arm).tolist() == [1.0, 1.0]


def test_a_name_with_the_letters_of_a_pattern_is_a_name() -> None:
    """A variable may be called as a pattern is written."""
    model = sw.SCM([Exogenous(name="x[0]"), Exogenous(name="x*"), Exogenous(name="xy")])
    assert {*model.do({"x[0]": 1.0}).interventions} == {"x[0]"}
    assert {*model.do({"x*": 1.0}).interventions} == {"x*"}
    assert {*model.do({"?y": 1.0}).interventions} == {"xy"}


def test_of_several_names_of_one_quantity_a_pattern_means_its_own() -> None:
    """Other coordinates of a quantity are left out."""
    with sw.World("pushing", backend="fake") as world:
        world.reset(seed=0)
        audit = world.do({"tool_block.*position": Shift(0.0)})
        assert {*audit.targets} == {"tool_block.cartesian_position"}


def test_each_variable_has_a_draw_of_its_own_or_all_share_one(arm: Any) -> None:
    """By default draws are independent; ``shared=True`` makes them one."""
    arm.reset(seed=4)
    arm.do({"*.mass": DRAWN})
    one, other = ratios(arm)
    assert one != other
    assert min(one, other) >= 0.8
    assert max(one, other) <= 1.2
    again = arm.do({"*.mass": DRAWN})  # at the same instant: drawn anew
    assert ratios(arm)[0] != one
    assert isinstance(again.targets["upper.mass"].requested.by, float)
    arm.do({"*.mass": Scale(Draw(0.8, 1.2), shared=True)})
    assert np.ptp(ratios(arm)) < 1e-15
    arm.do({"*.mass": Scale(Draw(0.8, 1.2), shared=True), "*.damping": Scale(Draw(0.8, 1.2))})
    assert abs(ratios(arm)[0] - ratios(arm, DAMPINGS)[0]) > 1e-6
    arm.reset(seed=4, do={"*.mass": DRAWN})
    assert ratios(arm).tolist() == [one, other]


def test_drawn_vectors_have_a_number_for_each_component_or_one_for_all(arm: Any) -> None:
    """The same holds for components."""
    arm.reset(seed=1, do={"upper.color": Scale(Draw(0.5, 1.0))})
    color = np.asarray(arm.model.declared("upper.color").default)
    assert len({*(arm["upper.color"] / color).round(12)}) == 4
    arm.reset(seed=1, do={"upper.inertia": Scale(Draw(0.8, 1.2), shared=True)})
    moments = np.asarray(arm.model.declared("upper.inertia").default)
    assert np.ptp(arm["upper.inertia"] / moments) < 1e-12


def test_plans_and_counterfactuals_replay_draws_exactly(arm: Any) -> None:
    """Draws belong to seed, episode, step and name."""
    plan = {
        "*.mass": DRAWN,
        "*.damping": Scale(Draw(0.5, 2.0), shared=True, every=3),
        "*.position": Shift(Draw(-0.1, 0.1), at=4),
    }
    episode = arm.rollout("random", seed=2, steps=8, do=plan)
    damping = episode["elbow.damping"]
    assert damping[0] == damping[2] != damping[3] == damping[5] != damping[6]
    assert damping.min() >= 0.1  # of 0.2: factors do not compound
    assert damping.max() <= 0.4
    assert episode.counterfactual({}) == episode
    assert Plan.from_json(episode.plan.to_json()) == episode.plan
    heavy = episode.counterfactual({"upper.mass": 3.0}, at=5)
    assert (heavy["lower.mass"] == episode["lower.mass"]).all()
    assert (heavy["elbow.damping"] == damping).all()
    assert (heavy["elbow.position"][:6] == episode["elbow.position"][:6]).all()
    assert heavy["elbow.position"][-1] != episode["elbow.position"][-1]


def test_a_live_episode_with_draws_is_replayed(arm: Any) -> None:
    """Repeated draws at one instant are replayed, too."""
    live = arm.live("random", seed=3)
    live.do({"*.mass": DRAWN})
    live.do({"*.mass": DRAWN})
    live.step()
    live.do({"*.velocity": Shift(Draw(-1.0, 1.0))})
    live.step()
    episode = live.episode()
    assert episode.counterfactual({}) == episode


def test_a_draw_on_actions_is_one_in_every_step(arm: Any) -> None:
    """So it is noise of an actuator."""
    plan = {"*.control": Shift(Draw(Normal(0.0, 0.1)))}
    noisy = arm.rollout(None, seed=5, steps=6, do=plan)
    again = arm.rollout(None, seed=5, steps=6, do=plan)
    assert noisy == again
    assert noisy.counterfactual({}) == noisy
    assert len({*noisy["elbow.position"]}) == 7


def test_one_seed_has_the_same_draws_with_any_number_of_worlds_and_workers(arm: Any) -> None:
    """Draws depend on neither."""
    plan = {"*.mass": DRAWN, "*.damping": Scale(Draw(0.5, 2.0), shared=True)}
    found = arm.sample(3, plan, outcomes=MASSES, steps=1, seed=7)
    table = np.array([[*found["upper.mass"]], [*found["lower.mass"]]]).T
    with sw.World(ARM, num_worlds=2) as worlds:
        for row in range(2):
            worlds.world(row).reset(seed=7, episode=row, do=plan)
            assert [float(worlds.world(row)[n]) for n in MASSES] == table[row].tolist()
        worlds.do({"*.mass": [1.5, 2.5]})
        assert worlds["lower.mass"].tolist() == [1.5, 2.5]
    two = arm.sample(3, plan, outcomes=MASSES, steps=1, seed=7, workers=2)
    assert (two["lower.mass"] == found["lower.mass"]).all()
    how = {"outcomes": MASSES, "nature": {"*.mass": DRAWN}, "steps": 1, "seed": 7}
    natural, again = arm.sample(3, **how), arm.sample(3, workers=2, **how)
    assert (natural["lower.mass"] == again["lower.mass"]).all()
    assert (natural["lower.mass"] != found["lower.mass"]).all()  # the context has its own noise


def test_environments_and_curricula_take_patterns(arm: Any) -> None:
    """Resets, ``do``, parts of curricula and their files."""
    env = gymnasium.make("scm_world/Model-v0", model=ARM, reward=(slow, "elbow.velocity"))
    env.reset(seed=1, options={"do": {"*.mass": DRAWN}})
    world = env.unwrapped.world
    first = ratios(world).tolist()
    assert len({*first}) == 2
    env.unwrapped.do({"*.damping": 0.3})
    assert [float(world[name]) for name in DAMPINGS] == [0.3, 0.3]
    taught = CurriculumEnv(env, {"*.mass": DRAWN, "*.damping": Scale(Draw(0.5, 2.0), shared=True)})
    taught.reset(seed=1)
    assert ratios(world).tolist() != first  # noise streams of its own
    assert np.ptp(ratios(world, DAMPINGS)) < 1e-15
    drawn = ratios(world).tolist()
    copy = as_curriculum(json.loads(taught.curriculum.to_json()))
    assert copy == taught.curriculum
    again = CurriculumEnv(env, copy)
    again.reset(seed=1)
    assert ratios(world).tolist() == drawn
    CurriculumEnv(env, lambda _: {"*.mass": 2.0}).reset(seed=0)
    assert [float(world[name]) for name in MASSES] == [2.0, 2.0]
    with pytest.raises(UnknownVariable):
        CurriculumEnv(env, {"*.mss": DRAWN})
    env.close()


def test_model_environments_begin_as_those_of_tasks_do() -> None:
    """``start`` of ``Model-v0`` takes values, distributions and interventions."""
    start = {
        "*.position": (-0.1, 0.1),  # a state of the model
        "*.mass": DRAWN,  # an intervention at every reset
        "elbow.damping": "A",
        "shoulder.damping": 0.7,
        "gravity": Box((0.0, 0.0, -11.0), (0.0, 0.0, -9.0)),
    }
    options = {"spaces": {"elbow.damping": {"a": (0.3, 0.4)}}, "reward": (slow, "elbow.velocity")}
    env = gymnasium.make("scm_world/Model-v0", model=ARM, start=start, **options)
    found = []
    for _ in range(2):
        env.reset(seed=0 if not found else None)
        world = env.unwrapped.world
        found.append([*ratios(world), world["elbow.damping"], world["elbow.position"]])
        assert 0.3 <= world["elbow.damping"] <= 0.4
        assert world["shoulder.damping"] == 0.7
        assert -11.0 < world["gravity"][2] < -9.0
    assert not np.isclose(*found).any()
    env.reset(seed=0)
    before = ratios(world)
    env.reset(seed=0, options={"do": {"*.mass": TWICE}})  # of what ``start`` drew
    assert ratios(world) == pytest.approx(2.0 * before, rel=1e-12)
    env.close()


def test_spaces_and_start_take_patterns() -> None:
    """A name counts more there, too."""
    spaces = {"*.control": {"bounds": (-0.3, 0.3)}, "elbow.control": {"bounds": (-0.2, 0.2)}}
    with sw.World(ARM, spaces=spaces, start={"*.position": (-0.1, 0.1)}) as world:
        assert world.action_high.tolist() == [0.3, 0.2]
        world.reset(seed=0)
        angles = [float(world[f"{joint}.position"]) for joint in ("shoulder", "elbow")]
        assert angles[0] != angles[1]
        assert max(map(abs, angles)) <= 0.1
    for option in ({"spaces": {"*.contrl": {"bounds": (-1, 1)}}}, {"start": {"*.positon": 0.1}}):
        with pytest.raises(UnknownOption, match=r"did you mean '\*\."):
            sw.World(ARM, **option)


def test_equations_draw_summands_and_factors() -> None:
    """Also in batches, where each row has its draw."""
    model = sw.SCM(
        [
            Exogenous(name="a.mass", default=2.0),
            Exogenous(name="b.mass", default=3.0),
            Derived(name="sum", parents=("a.mass", "b.mass"), mechanism=Linear(weights=(1.0, 1.0))),
        ]
    )
    own = model.do({"*.mass": DRAWN}).draw(4, seed=0)
    assert own["sum"].shape == (4,)
    assert (own["a.mass"] / 2.0 != own["b.mass"] / 3.0).all()
    one = model.do({"*.mass": Scale(Draw(0.8, 1.2), shared=True)}).draw(4, seed=0)
    assert np.allclose(one["a.mass"] / 2.0, one["b.mass"] / 3.0, rtol=1e-15)
    assert len({*one["a.mass"]}) == 4
    assert (model.do({"*.mass": DRAWN}).draw(1, seed=0, first=2)["sum"] == own["sum"][2]).all()
    world = sw.World(model)
    episode = world.rollout(seed=1, do={"*.mass": DRAWN})
    assert episode.counterfactual({}) == episode
    with pytest.raises(ModelError, match="needs a noise key"):
        model.do({"*.mass": DRAWN}).solve()


def test_step_functions_take_patterns_and_relative_draws() -> None:
    """As do their starts."""

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
        flow = parameters["leak.rate"] * state["level"] - action["pump.flow"]
        return {"level": state["level"] - 0.1 * flow}

    with sw.World(
        step,
        parameters=[Exogenous(name="leak.rate", default=0.5, bounds=Box(0.0, 2.0))],
        states=[Measured(name="level", default=1.0)],
        actions=[Action(name="pump.flow", bounds=Box(0.0, 1.0))],
        start={"lev*": (0.5, 1.5)},
    ) as world:
        episode = world.rollout("random", seed=0, steps=5, do={"*.rate": DRAWN})
        assert 0.4 <= episode["leak.rate"][0] <= 0.6
        assert episode["level"][0] != 1.0
        assert episode.counterfactual({}) == episode


def test_wrong_relative_draws_are_refused(arm: Any) -> None:
    """Each error says what is allowed; nothing is changed."""
    with pytest.raises(UnknownOption, match=r"Draw\(low, high\)"):
        Scale(Draw("A"))
    with pytest.raises(UnknownOption, match="a number is the same for all"):
        Scale(2.0, shared=True)
    arm.reset(seed=0)
    with pytest.raises(InterventionError, match="does not fit its shape"):
        arm.do({"upper.mass": Scale(Draw(Box((0.8, 0.8), (1.2, 1.2))))})
    with pytest.raises(OutOfBounds):
        arm.do({"upper.mass": Scale(Draw(-2.0, -1.0))})
    assert ratios(arm).tolist() == [1.0, 1.0]


def test_a_laboratory_means_what_may_be_set(arm: Any) -> None:
    """Patterns do not reach further."""
    lab = Laboratory(arm, settable=["upper.*"], steps=1)
    found = lab.do({"*.mass": 2.0}, n=1)
    assert {*found.plan} == {"upper.mass"}


def test_the_command_takes_patterns_and_draws() -> None:
    """Texts stand for the same interventions."""
    from scm_world.cli.options import parse_value

    assert parse_value("scale:draw:0.8,1.2") == DRAWN
    assert parse_value("shift:shared:-0.1,0.1") == Shift(Draw(-0.1, 0.1), shared=True)
    assert parse_value("draw:0.1,0.2") == Draw(0.1, 0.2)


def test_patterns_name_what_is_observed_begun_and_swept() -> None:
    """States first, then parameters; the names of an observation are in the order asked for."""
    how: dict[str, Any] = {"model": ARM, "reward": (slow, "elbow.velocity")}
    names = ["*.velocity", "shoulder.position"]
    env: Any = gymnasium.make("scm_world/Model-v0", **how, observe=names)
    assert [*env.unwrapped.layout] == ["shoulder.velocity", "elbow.velocity", "shoulder.position"]
    custom = {"observation_mode": "custom", "observe": ["*.damping", "elbow.position"]}
    env = gymnasium.make("scm_world/Model-v0", **how, **custom)
    assert [*env.unwrapped.layout] == [*DAMPINGS[:1], "elbow.damping", "elbow.position"]
    with sw.World(ARM, start={"*.position": 0.1, "*.damping": (0.1, 0.2)}) as world:
        world.reset(seed=0)
        assert world["elbow.position"] == 0.1
        assert 0.1 < world["elbow.damping"] < 0.2
    with sw.World(ARM) as world:
        over = {"*.damping": [0.1, 1.0], "gravity": [[0, 0, -9.0], [0, 0, -5.0]]}
        found = sweep(world, over, ["elbow.position"], n=2, steps=1)
    assert len(found.points) == 4
    assert all(point["elbow.damping"] == point["shoulder.damping"] for point in found.points)
    lines = [line.get_label() for line in found.picture().axes[0].lines]
    assert lines == ["gravity[2] = -9", "gravity[2] = -5"]


@pytest.mark.parametrize("option", ["start", "spaces", "noise", "delay", "observe"])
def test_a_pattern_that_fits_nothing_names_its_option(option: str) -> None:
    """The error lists what is allowed; of many names those that are near, and their number."""
    given: Any = "*.dampin" if option == "observe" else {"*.dampin": {}}
    with pytest.raises(
        UnknownOption, match=r"did you mean '\*\.damping'|there are: .*\*\.velocity"
    ) as caught:
        sw.World(ARM, **{option: given})
    assert (caught.value.option, caught.value.value) == (option, "*.dampin")
    many = str(UnknownOption("variable", "n7", [f"n{i}" for i in range(1000)]))
    assert "n7, " in many
    assert many.endswith("and 992 more")


def test_many_problems_are_counted_by_kind(arm: Any) -> None:
    """The first eight are listed."""
    arm.reset(seed=0)
    with pytest.raises(SeveralProblems) as caught:
        arm.do({name: "heavy" for name in arm.model if name.startswith(("upper", "lower", "sh"))})
    said = str(caught.value).splitlines()
    assert len(said) == 10
    assert "more" in said[-1]
    assert len(caught.value.problems) > 8
