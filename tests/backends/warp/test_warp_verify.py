"""Graphs on Warp's CPU device: bodies that do not touch change one another, and are no causes."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("mujoco_warp")

import scm_world as sw
from scm_world.backends import make_backend, read_model
from scm_world.errors import InexactEngine
from scm_world.graph import Edge
from scm_world.models import State
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes
from scm_world.queries.verification import _reasons, verify
from scm_world.testing.backend import MODEL


def test_reaching_is_confirmed() -> None:
    """Equal runs are equal, and rounding is no effect; by how much follows from the solver."""
    found = verify("reaching", backend="warp:cpu", probes=12, held_out=3)
    assert (found.floor, found.undeclared, found.outcome) == (0.0, (), "confirmed")
    assert max(found.rounding, key=found.rounding.get) == "joint_velocities"
    assert 1e-3 < found.rounding["joint_velocities"] < 2e-3
    assert "bodies that do not touch change one another" in str(found)
    assert "no effect on this engine" not in str(verify("reaching", backend="fake", probes=1))


def test_bodies_that_no_contact_joins_are_no_causes() -> None:
    """In this state another friction of the arm makes a box far away turn, by 0.01 rad/s.

    On MuJoCo, it is exactly 0.
    """
    cause = "shoulder.frictionloss"
    key, seen = (cause, "falling.angular_velocity", 1), {}
    for backend in ("mujoco", "warp:cpu"):
        with closing(sw.World(MODEL, backend=backend)) as world:
            (probe,) = probes(world, 6, 0, first=5)
            for by_contact in (True, False):
                paired = Paired(world, 0)
                if not by_contact:
                    paired._by_contact = frozenset()
                effects = paired.run(5, probe)
                seen[backend, by_contact] = effects.largest.get(key), key in effects.edges({key})
    assert seen["mujoco", True] == (0.0, False)
    assert seen["warp:cpu", True] == (None, False)
    size, is_edge = seen["warp:cpu", False]
    assert is_edge, "mujoco-warp now solves islands apart: drop this rule"
    assert size > 1e-3


def test_pairs_of_episodes_are_refused() -> None:
    """There the differences grow; engines that can answer are named."""
    with closing(sw.World("reaching", backend="warp:cpu")) as world:
        world.require_exact("a replay")
        with pytest.raises(InexactEngine, match=r"leave one another alone.*mujoco"):
            world.require_exact("a paired experiment", independent=True)
    with closing(sw.World("reaching")) as world:
        world.require_exact("a paired experiment", independent=True)
    assert make_backend("warp:cpu").capabilities.scenes is None


def test_shapes_that_move_are_read_back_after_steps() -> None:
    """A change of a place writes the poses of all shapes; steps change those that can move."""
    with closing(sw.World("reaching", backend="warp:cpu")) as world:
        world.reset(seed=0)
        world.do({"robot_height": world["robot_height"] + 0.01})
        world.step(world.action_space.sample() * 0.0)
        world.do({"floor_friction": 0.4})
        assert float(world["floor_friction"]) == 0.4


BOXES = """<mujoco><option timestep="0.002"/><worldbody>
<body name="light" pos="0 0 1"><freejoint/><inertial pos="0 0 0" mass="0.001" diaginertia="1 1 1"/>
</body><body name="heavy" pos="0 0 3"><freejoint/><inertial pos="0 0 0" mass="8"
diaginertia="4 4 4"/></body></worldbody></mujoco>"""


def test_how_far_bodies_move_one_another_follows_from_where_the_solver_stops() -> None:
    """Its tolerance is 1e-6 of the trace of the mass matrix, in each of five steps of 2 ms."""
    structure, backend = read_model(BOXES), make_backend("warp:cpu")
    found = State(structure.layout, backend.capabilities.rounding(backend, structure, 5))
    last = 10.0 * np.finfo(np.float32).eps
    trace = 3 * (0.001 + 1.0 + 8.0 + 4.0)
    for body, mass, inertia in (("light", 0.001, 1.0), ("heavy", 8.0, 4.0)):
        slow, spin = (2.0 * 5 * 0.002 * np.sqrt(2e-6 * trace / of) for of in (mass, inertia))
        assert found[f"{body}.linear_velocity"] == pytest.approx([slow] * 3)
        assert found[f"{body}.angular_velocity"] == pytest.approx([spin] * 3)
        assert found[f"{body}.cartesian_position"] == pytest.approx(
            [max(slow * 0.006, spin * 0.006, last)] * 3
        )
    one = read_model(BOXES.split("</body>")[0] + "</body></worldbody></mujoco>")
    alone = backend.capabilities.rounding(backend, one, 5)
    assert np.array_equal(alone, np.full(13, last))


def test_a_smaller_effect_is_not_seen_and_named() -> None:
    """The reason has its size, and what others change the effect by."""
    key, effects = ("gap", "speed", 1), Effects(rounding={"speed": 1e-3}, least=1.0)
    effects.changed["gap"] = 3
    for size, is_edge in ((9e-4, False), (2e-3, True)):
        effects.see(key, np.array(size), np.array(0.0))
        assert (key in effects.edges({key})) == is_edge
        if not is_edge:
            found = _reasons(None, effects)(Edge("gap", "speed", lag=1))
            said = "and bodies that do not touch change speed by 0.001"
            assert found == f"it changed by 0.0009 of it or of 1, {said}"
