"""Strengths of edges: effects in units of how much the effect varies in free motion."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

from scm_world import World, discover, verify
from scm_world.discovery.data import Design, collect
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.graph import SCM, to_digraph
from scm_world.queries.verification import Verification
from scm_world.variables import Action, Box, Derived, Exogenous, Linear, Measured, Normal

ENGINES = ["mujoco"] + ["bullet"] * (importlib.util.find_spec("pybullet") is not None)
ARM = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping=".1"/>
    <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass="1"/></body>
</worldbody><actuator><motor name="motor" joint="hinge" gear="2"/></actuator></mujoco>
"""


def rocker(scale: float) -> World:
    """Make a world whose state follows two pushes and a hardly noticeable third cause."""

    def step(p: Any, s: Any, a: Any, noise: Any) -> dict[str, Any]:
        pushed = a["push"] + p["bias"] + 1e-5 * p["faint"]
        return {"x": 0.8 * s["x"] + scale * pushed, "rigid": 0.0 * s["rigid"] + p["bias"]}

    box = Box(-1.0, 1.0)
    return World(
        step,
        parameters=[Exogenous(name=name, default=0.0, bounds=box) for name in ("bias", "faint")],
        states=[
            Measured(name="x", parents=("x", "push", "bias", "faint"), bounds=Box(-9e3, 9e3)),
            Measured(name="rigid", parents=("bias",), bounds=box),
        ],
        actions=[Action(name="push", bounds=box)],
        control_dt=0.1,
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_every_edge_that_was_seen_has_a_strength(engine: str) -> None:
    """It is the effect over the spread, both in the unit of the effect; the strongest is first."""
    found = discover(World(ARM, backend=engine), probes=6)
    table = found.table
    assert len(table) == len(found.edges)
    seen = table[table.status == "fired"]
    moved = seen[seen.spread > 0.0]
    assert np.allclose(moved.largest * moved.spread, moved.largest_raw)
    assert np.allclose(moved["median"] * moved.spread, moved.median_raw)
    assert (moved["median"] <= moved.largest).all()
    assert (moved.seen <= 6).all()
    assert moved.largest.is_monotonic_decreasing
    units = table.set_index("effect").unit
    assert set(units[["hinge.position", "hinge.velocity"]]) == {"rad", "rad/s"}
    strength = found.strength
    assert (
        strength["hinge.position", "hinge.position", 1] > strength["gravity", "hinge.position", 1]
    )
    assert "spreads of free motion" in str(found)
    assert type(found).from_json(found.to_json()).table.equals(table)


def test_strengths_do_not_depend_on_units() -> None:
    """A state in millimeters has the strengths of one in meters, and raw effects of its own."""
    one, other = (discover(rocker(scale), probes=4) for scale in (1.0, 1000.0))
    for cause in ("bias", "push", "faint"):
        edge = cause, "x", 1
        assert other.strength[edge] == pytest.approx(one.strength[edge], rel=1e-6)
    raw = (report.table.set_index(["cause", "effect"]).largest_raw for report in (one, other))
    first, second = (sizes["bias", "x"] for sizes in raw)
    assert second == pytest.approx(1000.0 * first)


def test_what_does_not_move_by_itself_has_no_strength_and_stays() -> None:
    """Its spread is zero, so that no effect is weak; the raw effect is there."""
    found = discover(rocker(1.0), probes=2, at_least=1e9)
    row = found.table.set_index(["cause", "effect"]).loc["bias", "rigid"]
    assert row.spread == 0.0
    assert row.largest_raw > 0.0
    assert np.isnan(row.largest)
    assert ("bias", "rigid", 1) not in found.weak(1e9)
    assert "1 edges into variables that do not move by themselves" in str(found)


def test_weak_edges_are_not_scored_and_listed_apart() -> None:
    """Neither missed nor found, in reports, in a truth and in a graph."""
    world, faint = rocker(1.0), ("faint", "x", 1)
    whole, part = discover(world, probes=4), discover(world, probes=4, at_least=1e-3)
    assert part.weak(1e-3) == {faint}
    assert faint in part.found
    assert (part.score.shd, part.score.declared) == (0, whole.score.declared - 1)
    assert "not scored: weaker than" in str(part)
    table = collect(world, Design(), 1, steps=4, every_step=True, causes=["bias", "faint"])
    assert table.truth is not None
    truth = table.truth.marked(part, at_least=1e-3)
    assert truth.unseen == (faint,)
    assert truth.strength[faint] == part.strength[faint] > 0.0
    assert table.truth.marked(part).unseen == ()
    graph = to_digraph(world.graph, strength=part.strength, at_least=1e-3)
    assert not graph.has_edge(*faint)
    assert graph.has_edge("bias", "rigid", 1)
    assert graph.edges["bias", "x", 1]["strength"] == part.strength["bias", "x", 1]
    assert [*to_digraph(graph, at_least=1e9).edges] == [("bias", "rigid", 1)]
    with pytest.raises(UnknownOption, match="at_least"):
        discover(world, probes=1, at_least=-1.0)


def test_equations_move_by_their_noise() -> None:
    """The spread of a variable of equations is the deviation of its draws."""
    model = SCM(
        [
            Exogenous(name="a", distribution=Normal(std=2.0)),
            Derived(name="b", parents=("a",), mechanism=Linear(weights=(3.0,))),
        ]
    )
    found = verify(model)
    (edge,) = found.edges
    assert edge.spread == pytest.approx(6.0, rel=0.25)
    text = found.to_json()
    assert Verification.from_json(text).strength == found.strength
    with pytest.raises(UnreadableFile):
        Verification.from_json(text.replace('"spread"', '"other"'))
