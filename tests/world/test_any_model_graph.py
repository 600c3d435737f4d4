"""Graphs that were generated from models nobody here wrote hold to the last bit."""

from __future__ import annotations

import importlib.util
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scm_world import ModelTask, World, discover, verify
from scm_world.backends import read_model
from scm_world.queries.experiments.effects import Effects
from scm_world.queries.experiments.paired import Paired
from scm_world.queries.experiments.probes import probes
from scm_world.queries.verification import Verification

FOLDERS = {"gymnasium": "envs/mujoco/assets", "dm_control": "suite", "robosuite": "models/assets"}

FAST = (
    "gymnasium/inverted_double_pendulum.xml",
    "gymnasium/reacher.xml",
    "gymnasium/half_cheetah.xml",
    "dm_control/cartpole.xml",
    "dm_control/ball_in_cup.xml",
)
SLOW = (
    "gymnasium/pusher.xml",
    "gymnasium/ant.xml",
    "gymnasium/hopper.xml",
    "gymnasium/humanoid.xml",
    "gymnasium/swimmer.xml",
    "gymnasium/walker2d_v5.xml",
    "dm_control/acrobot.xml",
    "dm_control/cheetah.xml",
    "dm_control/finger.xml",
    "dm_control/fish.xml",
    "dm_control/humanoid.xml",
    "dm_control/manipulator.xml",
    "dm_control/point_mass.xml",
    "robosuite/robots/panda/robot.xml",
    "robosuite/robots/baxter/robot.xml",
    "robosuite/robots/ur5e/robot.xml",
)


def asset(name: str) -> str:
    """Find a model file of an installed package; the test is skipped where it is not."""
    package, _, rest = name.partition("/")
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        pytest.skip(f"{package} is not installed")
    return str(Path(found.origin).parent / FOLDERS[package] / rest)


def holds(found: Verification) -> None:
    """Check that nothing but declared edges showed, and that undoing left no trace."""
    assert found.floor == 0.0
    assert found.undeclared == ()
    assert found.outcome != "refuted"


@pytest.mark.parametrize("name", FAST)
def test_nothing_undeclared_shows(name: str) -> None:
    """From four drawn states, and four of another seed, whatever differs has an edge."""
    found = verify(World(asset(name)), probes=4, held_out=4)
    holds(found)
    assert found.share > 0.7
    assert found.generated
    assert (found.probes, found.held_out) == (4, 4)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_nothing_undeclared_shows_in_larger_models(name: str) -> None:
    """Likewise, until nothing new is seen."""
    found = verify(World(asset(name)), probes=24)
    holds(found)
    assert found.probes >= 16


def test_the_first_graph_of_a_file_takes_seconds() -> None:
    """From the file of a cart-pole to a verified graph."""
    started = time.perf_counter()
    path = asset("dm_control/cartpole.xml")
    world = World(path)
    report, found = discover(world, probes=16), verify(world)
    assert time.perf_counter() - started < 15.0
    assert report.floor == found.floor == 0.0
    assert set(report.found) <= set(report.declared) == set(found.declared)
    assert set(found.found) <= set(found.declared)
    assert found.seconds < 15.0


# --- what shows where -----------------------------------------------------------------------------

TWO = """
<mujoco model="two">
  <option timestep="0.01"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="one" pos="0 0 .2"><freejoint/><geom name="one" size=".1" mass="1"/></body>
    <body name="other" pos="0 .4 .2"><freejoint/><geom name="other" size=".1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def two() -> Verification:
    """Verify two balls on a floor."""
    return verify(World(TWO))


def test_what_touches_acts(two: Verification) -> None:
    """Each ball acts on itself in the first state, and on the other one where they touch."""
    after = {edge.key: edge.after for edge in two.fired}
    assert after["one.mass", "other.linear_velocity", 1] > 1
    assert after["one.linear_velocity", "one.cartesian_position", 1] == 1
    assert two.planned == 200
    assert not two.interrupted


def test_an_edge_that_never_shows_is_a_finding() -> None:
    """The mass of what falls freely moves nothing: the graph is neither confirmed nor refuted."""
    falls = TWO.replace('<geom name="floor" type="plane" size="5 5 .1"/>', "")
    found = verify(World(falls.replace("size=", 'contype="0" size=')), probes=4)
    assert ("one.mass", "one.linear_velocity", 1) in found.never_fired
    assert ("gravity", "one.linear_velocity", 1) in {edge.key for edge in found.fired}
    assert found.held_out > 0
    assert found.outcome == "not refuted"
    assert "not refuted" in str(found).splitlines()[0]
    reasons = {edge.key: edge.reason for edge in found.unseen}
    assert "changed in 12" in reasons["one.mass", "one.linear_velocity", 1]


def test_a_missing_edge_is_caught() -> None:
    """A table that says that a mass acts on nothing is contradicted, in held-out states, too."""
    model = read_model(TWO)
    rows = tuple(
        replace(row, always=frozenset(), contact=frozenset()) if row.name == "one.mass" else row
        for row in model.parameters
    )
    found = verify(World(ModelTask(replace(model, parameters=rows))), probes=8)
    wrong = {edge.key: edge for edge in found.undeclared}
    assert {cause for cause, _, _ in wrong} == {"one.mass"}
    assert ("one.mass", "one.linear_velocity", 1) in wrong
    assert found.outcome == "refuted"
    assert "one.mass -> one.linear_velocity (lag 1): " in str(found)


def test_probe_states_of_a_model_do_not_depend_on_how_many() -> None:
    """Probe i of a seed is the same in a longer run, a later one, and another world."""
    world = World(TWO)
    long = list(probes(world, 8, 5))
    kinds = [probe.kind for probe in long]
    assert kinds[:4] == ["start", "touching", "onward, touching", "anywhere"]
    for again in (list(probes(world, 3, 5)), list(probes(World(TWO), 3, 5))):
        for one, other in zip(long, again, strict=False):
            assert _state(world, one.snapshot) == _state(world, other.snapshot)
    (late,) = probes(world, 7, 5, first=6)
    assert _state(world, late.snapshot) == _state(world, long[6].snapshot)


def _state(world: World, snapshot: object) -> bytes:
    world.restore(snapshot)  # type: ignore[arg-type]
    return world.vector.tobytes()


def test_some_probe_states_have_other_parameters() -> None:
    """Values of declared spaces, or near those of the file."""
    spaces = {"one.mass": {"a": (2.0, 3.0), "b": (4.0, 5.0)}}
    world = World(TWO, spaces=spaces)
    masses = {"one.mass": set(), "other.mass": set()}  # type: dict[str, set[float]]
    for probe in probes(world, 24, 0):
        world.restore(probe.snapshot)
        for name, found in masses.items():
            found.add(float(world[name]))
        if "others" not in probe.kind:
            assert world["one.mass"] == world["other.mass"] == 1.0
    assert len(masses["one.mass"]) > 2
    assert all(m == 1.0 or 2.0 <= m <= 5.0 for m in masses["one.mass"])
    assert all(0.8 <= m <= 1.2 for m in masses["other.mass"])


def test_an_action_without_bounds_is_varied() -> None:
    """Each actuator is moved by itself, and its effects are its own."""
    arms = "".join(
        f'<body name="{n}" pos="{x} 0 0"><joint name="{n}" axis="0 1 0"/>'
        '<geom size=".01" fromto="0 0 0 0 0 .5" type="capsule"/></body>'
        for n, x in (("left", -2), ("right", 2))
    )
    motors = "".join(f'<motor name="{n}_motor" joint="{n}"/>' for n in ("left", "right"))
    world = World(f"<mujoco><worldbody>{arms}</worldbody><actuator>{motors}</actuator></mujoco>")
    paired, left = Paired(world, 0), "left_motor.control"
    effects = Effects()
    for number, probe in enumerate(probes(world, 2, 0)):
        effects.add(paired.run(number, probe))
    moved = {
        effect for (cause, effect, _), size in effects.largest.items() if cause == left and size
    }
    assert moved == {"action", "left.position", "left.velocity"}  # action is both controls
    assert all(np.isfinite(size) for size in effects.largest.values())
