"""The truth of a table is that of the parameters in it, with the noise that variables share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world import World, discover, verify
from scm_world.discovery.data import Design, collect
from scm_world.variables import Box, Draw, Exogenous, Linear, Measured, Mechanism, Normal

SLIDER = """<mujoco><worldbody><body name="a"><joint name="x" type="slide" axis="1 0 0"{more}/>
<geom type="sphere" size=".05" mass="1"/></body></worldbody>
<actuator><motor name="u" joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
HOW: dict[str, Any] = {"steps": 20, "every_step": True, "causes": []}
FREE = {
    ("x.position", "x.position", 1),
    ("x.velocity", "x.position", 1),
    ("x.velocity", "x.velocity", 1),
    ("u.control", "x.position", 1),
    ("u.control", "x.velocity", 1),
}
"""The edges of x'' = u: no force depends on the position."""
SPRING = ("x.position", "x.velocity", 1)


def slider(more: str = "", **options: Any) -> World:
    """Make a mass on a rail, with a motor."""
    return World(SLIDER.format(more=more), **options)


def edges(world: Any, design: Design | None = None, **how: Any) -> set[Any]:
    """Return the edges of the truth of a small table."""
    truth = collect(world, design or Design(), 2, **{**HOW, **how}).truth
    assert truth is not None
    return set(truth.edges)


def test_a_spring_that_is_not_there_has_no_edge() -> None:
    """Position acts on velocity if the stiffness of the table is not zero; the graph keeps it."""
    with slider() as world:
        assert SPRING in {edge.key for edge in world.graph.edges}
        truth = collect(world, Design(), 2, contacts=True, **HOW).truth
        assert truth is not None
        assert set(truth.edges) == set(truth.during().edges) == FREE
        assert edges(world.given({"x.stiffness": 2.0})) == FREE | {SPRING}
        assert edges(world, nature={"x.stiffness": Draw(Box(1.0, 2.0))}) == FREE | {SPRING}
        varied = edges(world, Design("single", ("x.stiffness",), Box(1.0, 2.0), 0.5))
        assert varied >= FREE | {SPRING}


@pytest.mark.parametrize("more", [' stiffness="1"', ' limited="true" range="-1 1"'])
def test_a_force_of_the_file_keeps_its_edge(more: str) -> None:
    """A spring, or an end of the range, makes velocity follow position."""
    with slider(more) as world:
        assert edges(world) == FREE | {SPRING}


def test_an_action_that_follows_others_keeps_its_edges() -> None:
    """Where a mechanism takes the place of the policy, the command still moves the mass."""
    follow = {"u.control": Mechanism(Linear(weights=(-0.5,)), parents=("x.velocity",))}
    with slider() as world:
        assert edges(world, nature=follow) >= FREE


def test_a_table_of_episodes_has_the_truth_of_its_parameters() -> None:
    """Where a free mass begins says nothing of its final velocity; on a spring it does."""
    start = {"x.position": Draw(Box(-0.5, 0.5))}
    how: dict[str, Any] = {"every_step": False, "outcomes": ["x.velocity"], "steps": 5}
    how |= {"causes": ["x.position"], "nature": start}
    with slider() as world:
        free, held = (edges(w, **how) for w in (world, world.given({"x.stiffness": 2.0})))
    assert len(held) == 1
    assert not free


def test_boxes_on_rails_act_by_contact_only() -> None:
    """Without contact no position moves a velocity; with it, all three can."""
    bodies = "".join(
        f'<body name="b{i}" pos="{0.3 * i} 0 0"><joint name="x{i}" type="slide" axis="1 0 0"/>'
        '<geom type="box" size=".05 .05 .05" mass="1"/></body>'
        for i in range(3)
    )
    with World(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>") as world:
        truth = collect(world, Design(), 2, contacts=True, **HOW).truth
    assert truth is not None
    free = {("position", "position"), ("velocity", "position"), ("velocity", "velocity")}
    alone = {(f"x{i}.{c}", f"x{i}.{e}", 1) for i in range(3) for c, e in free}
    assert set(truth.during().edges) == alone
    assert {(f"x{i}.position", f"x{i}.velocity", 1) for i in range(3)} <= set(truth.edges)


# --- step functions -------------------------------------------------------------------------------


def coupled(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let a act on b through k."""
    return {
        "a": 0.5 * state["a"] + noise["a"],
        "b": 0.5 * state["b"] + parameters["k"] * state["a"] + noise["b"],
    }


def sharing(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let the noise of a move b, too."""
    return {
        "a": 0.5 * state["a"] + noise["a"],
        "b": 0.5 * state["b"] + noise["a"] + 0.3 * noise["b"],
    }


def gusts(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let a noise with a name of its own move both."""
    return {
        "a": 0.5 * state["a"] + noise["gust"] + noise["a"],
        "b": 0.5 * state["b"] + noise["gust"] + noise["b"],
    }


def two(step: Any, *, parents: tuple[str, ...] = ("b",), **noise: Any) -> World:
    """Make a world of two states."""
    return World(
        step,
        control_dt=0.1,
        noise={"a": Normal(), "b": Normal(), **noise},
        parameters=[Exogenous(name="k", default=0.0, bounds=Box(0.0, 2.0))],
        states=[
            Measured(name="a", default=0.0, parents=("a",)),
            Measured(name="b", default=0.0, parents=parents),
        ],
    )


def test_a_parameter_that_is_zero_cuts_the_edges_through_it() -> None:
    """A declared edge through k = 0 is in the graph, and in the truth of tables with another k."""
    world, own = two(coupled, parents=("a", "b", "k")), {("a", "a", 1), ("b", "b", 1)}
    assert verify(world, probes=16).outcome == "confirmed"
    assert edges(world) == own
    assert edges(world.given({"k": 1.0})) == own | {("a", "b", 1)}
    assert edges(world, nature={"k": Draw(Box(0.5, 1.0))}) == own | {("a", "b", 1)}


def test_noise_of_one_variable_that_moves_another_is_an_effect() -> None:
    """Verification and discovery refute it, and the truth of a table names the pair."""
    world = two(sharing)
    for found in (verify(world, probes=8), discover(world, probes=8)):
        assert found.outcome == "refuted"
        assert [edge.key for edge in found.undeclared] == [("noise of a", "b", 0)]
    table = collect(world, Design(), 20, **{**HOW, "steps": 50})
    assert table.truth is not None
    assert table.truth.confounded == (("a", "b", 0),)
    before = (np.diff(table.episode) == 0).nonzero()[0]
    noise = [table[name][before + 1] - 0.5 * table[name][before] for name in ("a", "b")]
    assert np.corrcoef(noise)[0, 1] == pytest.approx(1.0 / np.sqrt(1.09), abs=0.01)
    for name in ("a", "b"):  # alone, it is confounded with nothing
        alone = table.select([name]).truth
        assert alone is not None
        assert not alone.confounded


def test_noise_of_its_own_name_is_declared_to_be_shared() -> None:
    """The graph is confirmed, and the truth of a table names the pair."""
    world = two(gusts, gust=Normal())
    assert verify(world, probes=8).outcome == "confirmed"
    truth = collect(world, Design(), 2, **HOW).truth
    assert truth is not None
    assert truth.confounded == (("a", "b", 0),)


def test_noise_of_each_variable_alone_confounds_nothing() -> None:
    """Independent noise leaves the graph confirmed, and the truth without pairs."""
    world = two(coupled, parents=("a", "b", "k"))
    truth = collect(world.given({"k": 1.0}), Design(), 2, **HOW).truth
    assert truth is not None
    assert not truth.confounded


def test_the_noise_of_a_motor_moves_position_and_velocity() -> None:
    """The pair is confounded: the residuals of the next position and velocity are proportional."""
    with slider(noise={"*.control": 0.1}) as world:
        table = collect(world, Design(), 10, **HOW)
    assert table.truth is not None
    assert table.truth.confounded == (("x.position", "x.velocity", 0),)
    before = (np.diff(table.episode) == 0).nonzero()[0]
    given = np.column_stack([table[n][before] for n in ("x.position", "x.velocity", "u.control")])
    moved = np.column_stack([table[n][before + 1] for n in ("x.position", "x.velocity")])
    left = moved - given @ np.linalg.lstsq(given, moved, rcond=None)[0]
    assert abs(np.corrcoef(left.T)[0, 1]) > 0.999


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_symmetries_leave_edges_out(integrator: str) -> None:
    """Without gravity, where the shoulder of an arm is acts on nothing but where it is next."""
    arm = f"""<mujoco><option integrator="{integrator}" gravity="0 0 0"/><worldbody>
    <geom type="plane" size="1 1 1" pos="0 0 -1"/><body><joint name="s" axis="0 0 1"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>
    <body pos=".3 0 0"><joint name="e" axis="0 0 1"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/></body></body></worldbody></mujoco>"""
    with World(arm) as world:
        truth = collect(world, Design(), 2, **HOW).truth
    assert truth is not None
    acts = {(c, e) for c, e, _ in truth.during().edges}
    assert {e for c, e in acts if c == "s.position"} == {"s.position"}
    assert {e for c, e in acts if c == "e.position"} == {*truth.names}


def test_an_edge_beyond_a_threshold_stays() -> None:
    """An effect that begins at nine tenths of a range is seen, too."""

    def step(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        a = 0.5 * state["a"] + noise["a"]
        return {"a": a, "b": 0.5 * state["b"] + max(state["a"] - 9.0, 0.0) + noise["b"]}

    world = World(
        step,
        control_dt=0.1,
        noise={"a": Normal(), "b": Normal()},
        states=[
            Measured(name="a", default=0.0, parents=("a",), bounds=Box(0.0, 10.0)),
            Measured(name="b", default=0.0, parents=("a", "b")),
        ],
    )
    assert ("a", "b", 1) in edges(world)
