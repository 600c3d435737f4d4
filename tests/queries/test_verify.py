"""The declared graph is checked, not believed."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.cli.data import SMALL
from scm_world.cli.options import load_system
from scm_world.discovery import discover
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.queries import SCM
from scm_world.queries.comparison import Comparison
from scm_world.queries.verification import Verification, verify
from scm_world.queries.world import World
from scm_world.tasks import TASKS
from scm_world.tasks.trifinger.entities.block_world import BlockWorld
from scm_world.variables import (
    Action,
    Box,
    Derived,
    Exogenous,
    Function,
    Hard,
    Integers,
    Linear,
    Measured,
    Mechanism,
    Normal,
    Parent,
    Shift,
)
from scm_world.variables.kinds import Variable
from scm_world.world import Simulation

HAS_BULLET = importlib.util.find_spec("pybullet") is not None
ENGINES = ["mujoco"] + (["bullet"] if HAS_BULLET else [])
needs_both = pytest.mark.skipif(not HAS_BULLET, reason="Bullet is not installed")


@pytest.fixture(scope="module", params=ENGINES)
def pushing(request: pytest.FixtureRequest) -> Verification:
    """Verify pushing with few probe states."""
    return verify("pushing", backend=request.param, probes=4, held_out=2)


def test_pushing_has_no_undeclared_effect(pushing: Verification) -> None:
    """Four probe states see most of the edges, nothing else, and leave no trace."""
    assert pushing.undeclared == ()
    assert pushing.floor == 0.0
    assert pushing.share > 0.85
    assert pushing.outcome == ("not refuted" if pushing.never_fired else "confirmed")


def test_coverage_ends_with_what_was_seen(pushing: Verification) -> None:
    """The curve has one number per probe state, never falls, and ends with all that fired."""
    assert (pushing.probes, pushing.held_out) == (4, 2)
    assert len(pushing.coverage) == 6
    assert list(pushing.coverage) == sorted(pushing.coverage)
    assert pushing.coverage[-1] == len(pushing.fired)
    assert len(pushing.fired) + len(pushing.never_fired) == len(pushing.declared)


def test_kinds_of_edges_are_counted_apart(pushing: Verification) -> None:
    """The engine decides most effects; readouts and definitions have their own counts."""
    engine, readout, definition = (
        pushing.provenance[by] for by in ("engine", "readout", "definition")
    )
    assert engine[1] + readout[1] + definition[1] == len(pushing.declared)
    assert engine[1] > 200
    assert "edges by engine" in str(pushing)


def test_a_report_survives_json(pushing: Verification) -> None:
    """Written and read back, a report is the same; anything else is refused."""
    assert Verification.from_json(pushing.to_json()) == pushing
    older = pushing.to_json().replace("{", '{"local": null,', 1)  # what an earlier version wrote
    assert Verification.from_json(older) == pushing
    with pytest.raises(UnreadableFile, match="to_json"):
        Verification.from_json("{}")


def test_a_report_prints_its_numbers(pushing: Verification) -> None:
    """The table names the engine, the floor, and what was seen."""
    text = str(pushing)
    for words in (
        "noise floor, two equal runs",
        f"{len(pushing.declared)} edges were",
        f"on {pushing.backend}",
    ):
        assert words in text


@pytest.mark.slow
def test_pushing_on_one_engine_is_verified() -> None:
    """Every declared edge is seen before the probe states run out, and then the search ends."""
    found = verify("pushing")
    assert found.outcome == "confirmed", str(found)
    assert found.probes < 40


def tampered(monkeypatch: pytest.MonkeyPatch, name: str, change: Callable[..., Any]) -> Simulation:
    """Build a pushing world that declares other parents of one variable."""
    honest = BlockWorld.variables

    def variables(self: BlockWorld) -> tuple[Variable, ...]:
        return tuple(
            v.model_copy(update={"parents": tuple(change(v.all_parents))}) if v.name == name else v
            for v in honest(self)
        )

    monkeypatch.setattr(BlockWorld, "variables", variables)
    monkeypatch.setattr("scm_world.world.structures._ALIVE", {})  # honest worlds may be alive
    return Simulation("pushing")


def test_a_missing_edge_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the declaration leaves out is named, with its size and where it was seen."""
    name = "tool_block.linear_velocity"
    world = tampered(monkeypatch, name, lambda parents: [p for p in parents if p.name != "gravity"])
    found = verify(world, probes=3, held_out=0)
    (edge,) = found.undeclared
    assert edge.key == ("gravity", name, 1)
    assert edge.size > 1e-3
    assert edge.probe in range(3)
    assert len(edge.change) == 3
    assert edge.kind
    assert found.outcome == "refuted"
    assert "gravity -> tool_block.linear_velocity (lag 1): " in str(found)


def test_a_superfluous_edge_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    """An edge that physics does not have never fires."""
    name = "tool_block.linear_velocity"
    extra = Parent("tool_block.color", 1)
    found = verify(
        tampered(monkeypatch, name, lambda parents: [*parents, extra]), probes=2, held_out=0
    )
    edge = ("tool_block.color", name, 1)
    assert edge in found.never_fired
    assert found.outcome == "not refuted"
    reasons = {edge.key: str(edge) for edge in found.unseen}
    assert reasons[edge].startswith(f"tool_block.color -> {name} (lag 1): no difference")


# --- what was never seen -------------------------------------------------------------------------


def dial(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """A dial that turns, next to one that is stuck."""
    return {"turns": state["turns"] + parameters["speed"], "stuck": 1.0}


def dials(**more: Any) -> World:
    """Make the world of two dials; the stuck one declares causes, too."""
    box = Box(-10.0, 10.0)
    return World(
        dial,
        parameters=[Exogenous(name="speed", default=0.5, bounds=box)],
        states=[
            Measured(name="turns", default=0.0, parents=("turns", "speed")),
            Measured(name="stuck", default=1.0, parents=("turns", "speed")),
        ],
        control_dt=0.1,
        **more,
    )


def test_what_no_declared_cause_moves_is_named_first() -> None:
    """The graph is not refuted, and the first line begins with the variable that never changed."""
    found = verify(dials(), probes=4, held_out=2)
    assert found.never_fired == (("speed", "stuck", 1), ("turns", "stuck", 1))
    assert found.unresponsive == ("stuck",)
    assert found.outcome == "not refuted"
    first, *lines = str(found).splitlines()
    assert first == (
        "Verification of dial on step: not refuted: stuck never changed under any of its declared "
        f"causes; 2 of {len(found.declared)} edges were never seen"
    )
    assert any("speed was changed in 6 of the probe states" in line for line in lines)


def test_a_readout_that_ignores_its_cause_is_named_first() -> None:
    """A sensor that always shows zero is no confirmation of its edges."""
    shown = Measured(
        name="shown", parents=("turns",), mechanism=Function(lambda turns: 0.0 * turns)
    )
    found = verify(dials(outcomes=[shown]), probes=4, held_out=0)
    assert found.unresponsive == ("stuck", "shown")
    assert found.headline.startswith("not refuted: stuck, shown never changed under any of their")


def test_a_cause_that_could_not_be_changed_is_told_from_one_without_effect() -> None:
    """Where no other value is allowed, the reason says so, and the child is not called silent."""
    world = World(
        lambda p, s, a, n: {"x": s["x"] + p["kind"]},
        parameters=[Exogenous(name="kind", dtype="integer", default=1, bounds=Integers(1, 1))],
        states=[Measured(name="x", default=0.0, parents=("x", "kind"))],
        control_dt=0.1,
    )
    found = verify(world, probes=2, held_out=0)
    (edge,) = found.unseen
    assert (edge.key, edge.states) == (("kind", "x", 1), 0)
    assert "no probe state had another value of kind" in edge.reason
    assert found.unresponsive == ()


BALLS = """
<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="one"><joint name="x" type="slide" axis="1 0 0" range="-1 1"/>
    <geom name="one" size=".1" mass="1"/></body>
  <body name="other" pos="9 0 0"><joint name="y" type="slide" axis="1 0 0" range="-1 1"/>
    <geom name="other" size=".1" mass="1"/></body>
</worldbody></mujoco>
"""


def test_bodies_that_never_touch_are_the_reason_of_edges_by_contact() -> None:
    """Two balls that cannot reach each other may be linked by contact, and never are."""
    found = verify(World(BALLS), probes=4, held_out=0)
    reasons = {edge.key: edge.reason for edge in found.unseen}
    assert reasons["one.mass", "y.velocity", 1] == "nothing touched in any probe state"
    assert found.outcome == "not refuted"


def test_bodies_that_touch_others_only_are_the_reason_of_edges_by_contact() -> None:
    """Both balls lie on the floor, and never reach each other: in discovery, too."""
    floor = '<geom name="floor" type="plane" size="9 9 .1" pos="0 0 -.0999"/>'
    scene = BALLS.replace("<worldbody>", f"<worldbody>{floor}")
    for axis in "xy":
        scene = scene.replace(
            f'<joint name="{axis}"',
            f'<joint name="{axis}z" type="slide" axis="0 0 1"/><joint name="{axis}"',
        )
    for found in (
        verify(World(scene), probes=4, held_out=0),
        discover(World(scene), probes=4),
    ):
        reasons = {edge.key: edge.reason for edge in found.unseen}
        said = "no contacts joined their bodies in any of 4 probe states"
        assert reasons["one.mass", "y.velocity", 1] == said


def test_a_command_that_is_always_saturated_is_the_reason_of_its_gain() -> None:
    """A bang-bang drive: commands act, but a small change of one or of the gain never does."""

    def step(p: Any, s: Any, a: Any, noise: Any) -> dict[str, Any]:
        push = np.clip(1e12 * p["drive.gain"] * a["drive.control"], -1.0, 1.0)
        return {"x": 0.5 * s["x"] + push}

    world = World(
        step,
        parameters=[Exogenous(name="drive.gain", default=2.0, bounds=Box(1.0, 3.0))],
        states=[Measured(name="x", default=0.0, parents=("x", "drive.gain", "drive.control"))],
        actions=[Action(name="drive.control", bounds=Box(-1.0, 1.0))],
        control_dt=0.1,
    )
    found = verify(world, probes=4, held_out=0)
    (edge,) = found.unseen
    assert edge.key == ("drive.gain", "x", 1)
    assert edge.reason == (
        "the command drive.control was saturated in all 2 probe states in which another was sought"
    )


# --- servos --------------------------------------------------------------------------------------

SERVOS = """
<mujoco model="servos">
  <compiler angle="radian"/>
  <option timestep="0.005"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.1" range="-2 2" limited="true"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass=".5"/>
      <body pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" range="-2 2" limited="true"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.25" mass=".3" contype="0"
              conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="one" joint="shoulder" kp="200" kv="1" ctrlrange="-2 2" forcerange="-2 2"/>
    <position name="two" joint="elbow" kp="20000" ctrlrange="-2 2" forcerange="-1 1"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize("engine", ENGINES)
def test_gains_of_servos_are_seen_though_most_commands_saturate(engine: str) -> None:
    """Forces are at their limits for all but 1 % and 0.003 % of the range of commands."""
    found = verify(World(SERVOS, backend=engine))
    assert found.outcome == "confirmed", str(found)
    assert {"one.kp", "two.kp", "two.control"} <= {edge.cause for edge in found.fired}


def test_a_servo_whose_every_command_saturates_is_named_as_such() -> None:
    """Its commands lie beyond the limits of its joint: that is why its gain shows nothing."""
    beyond = SERVOS.replace('kp="20000" ctrlrange="-2 2"', 'kp="20000" ctrlrange="3 4"')
    found = verify(World(beyond), probes=6, held_out=0)
    reasons = {edge.cause: edge.reason for edge in found.unseen}
    assert reasons["two.kp"].startswith("no command of two.control acted: each was cut to a limit")


def test_results_depend_on_the_seed_alone() -> None:
    """Two runs with one seed agree in everything but the time."""
    one, two = (verify("reaching", probes=1, held_out=1, seed=5) for _ in range(2))
    same = {"seconds": 0.0}
    assert one.model_copy(update=same) == two.model_copy(update=same)


PENDULUM = """
<mujoco><worldbody><body>
  <joint name="hinge" axis="0 1 0" damping=".1"/>
  <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1"/>
</body></worldbody></mujoco>
"""


def test_it_ends_when_all_is_seen() -> None:
    """With every edge seen the search ends, and held-out states follow."""
    told: list[tuple[int, int]] = []
    world = World(PENDULUM)
    found = verify(world, probes=60, held_out=2, progress=lambda *at: told.append(at))
    assert found.never_fired == ()
    assert (found.planned, found.held_out, found.interrupted) == (60, 2, False)
    assert found.probes < 60
    assert told[0] == (1, 62)
    assert told[-1] == (found.probes + 2, found.probes + 2)


def test_interruption_keeps_what_was_found() -> None:
    """Ctrl-C gives a report of the probe states that were finished, which confirms nothing."""

    def stop(done: int, planned: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    found = verify("reaching", backend="fake", probes=5, progress=stop)
    assert (found.probes, found.interrupted, found.outcome) == (2, True, "not refuted")


@pytest.mark.parametrize("wrong", [{"probes": 0}, {"probes": 1.5}])
def test_numbers_must_be_positive(wrong: dict[str, Any]) -> None:
    """A number of probe states below one is refused."""
    with pytest.raises(UnknownOption, match="probes"):
        verify("reaching", backend="fake", **wrong)


def test_a_world_takes_no_options() -> None:
    """Options of a world that is made already would be ignored, so they are refused."""
    with pytest.raises(UnknownOption, match="with a given world"):
        verify(Simulation("reaching", backend="fake"), backend="mujoco", probes=1)


# --- two backends ---------------------------------------------------------------------------------


@needs_both
def test_backends_agree_on_the_sign_of_clear_effects() -> None:
    """What lies well above the difference of the backends has one sign on both."""
    world = World("pushing")
    world.reset(seed=5)
    before = world.vector.tobytes()
    found = world.compare("bullet", probes=4)
    assert world.vector.tobytes() == before
    assert found.outcome == "confirmed"
    assert len(found.effects) > 3
    assert all(0 < one.low <= one.ratio <= one.high < 3 for one in found.effects)
    assert Comparison.from_json(found.to_json()) == found
    assert {gap.steps for gap in found.gaps} == {1, 10, 50, 200}
    assert found.lost == 0
    assert len(found.table) == len(found.gaps)
    gaps = {gap.variable: gap for gap in found.gaps if gap.steps == 1}
    assert (gaps["joint_velocities"].unit, found.one_sided) == ("rad/s", ())
    assert all(0.0 <= gap.median <= gap.largest < 20.0 for gap in found.gaps)
    assert gaps["tool_block.cartesian_position"].largest < 0.02
    assert f"  {gaps['joint_positions']}" in str(found)
    assert "Comparison of mujoco and bullet on pushing: confirmed" in str(found)


def test_a_backend_agrees_with_itself() -> None:
    """The same backend twice: every effect is clear, with the same sign and size."""
    found = World("reaching").compare("mujoco", probes=2, steps=[20, 3])
    assert found.share == 1.0
    assert {(gap.steps, gap.largest) for gap in found.gaps} == {(3, 0.0), (20, 0.0)}
    assert {one.ratio for one in found.effects} == {1.0}
    assert len(found.effects) > 10


def test_agreement_is_withheld_where_the_start_is_in_contact_on_one_backend() -> None:
    """A ball on a floor, and a backend without contacts: it does not say that they agree."""
    floor = '<geom name="floor" type="plane" size="9 9 .1" pos="0 0 -.1"/>'
    ball = '<body name="ball"><freejoint/><geom size=".1" mass="1"/></body>'
    world = World(f"<mujoco><worldbody>{floor}{ball}</worldbody></mujoco>")
    found = world.compare("fake", probes=1)
    assert found.one_sided == (("mujoco", "ball", "world"),)
    assert found.outcome != "confirmed"
    assert "in contact at the start, on one backend only" in str(found)
    assert "ball and world on mujoco" in str(found)


@needs_both
def test_parameters_of_one_backend_alone_are_left_as_they_are() -> None:
    """A joint has an armature on MuJoCo only; all others are compared, and q with -q agrees."""
    arm = '<body name="arm"><joint name="hinge" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body>'
    ball = '<body name="ball" pos="2 0 0"><freejoint/><geom size=".1"/></body>'
    world = World(f"<mujoco><worldbody>{arm}{ball}</worldbody></mujoco>")
    found = world.compare("bullet", probes=2)
    assert (found.probes, found.outcome) == (2, "confirmed")
    assert "hinge.damping" in {one.parameter for one in found.effects}
    assert max(gap.largest for gap in found.gaps if gap.steps == 1) < 1e-3


def test_what_shows_nothing_confirms_nothing() -> None:
    """Where no parameter acts there is no effect to compare."""
    world = World(
        lambda p, s, a, n: {"x": s["x"]},
        parameters=[Exogenous(name="idle", default=1.0)],
        states=[Measured(name="x", default=0.0, parents=("x",))],
        control_dt=0.1,
    )
    found = world.compare("step", probes=1)
    assert (found.effects, found.outcome) == ((), "not refuted")


# --- commands -----------------------------------------------------------------------


@pytest.fixture
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.mark.usefixtures("_elsewhere")
def test_the_command_writes_a_report() -> None:
    """Without physics edges are never seen: it says so first, writes the file and exits 0."""
    limits = ("--probes", "1", "--held-out", "1", "--seed", "3")
    result = CliRunner().invoke(app, ("verify", "reaching", "--backend", "fake", *limits))
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("Verification of reaching on fake: not refuted: ")
    folder = Path("scm-world-results/verify-reaching-fake-seed3")
    found = Verification.from_json((folder / "report.json").read_text())
    assert (found.seed, found.probes, found.held_out) == (3, 1, 1)


@pytest.mark.usefixtures("_elsewhere")
def test_strictly_the_command_exits_0_where_the_graph_is_confirmed() -> None:
    """With --strict a system whose edges are all seen exits 0, and 1 where some are not."""
    Path("pendulum.xml").write_text(PENDULUM)
    seen = ["verify", "pendulum.xml", "--strict", "--probes", "6", "--out", "here"]
    result = CliRunner().invoke(app, seen)
    assert result.exit_code == 0, result.output
    found = Verification.from_json(Path("here/report.json").read_text())
    assert found.outcome == "confirmed"
    few = ["--backend", "fake", "--probes", "1", "--held-out", "0"]
    assert CliRunner().invoke(app, ["verify", "reaching", "--strict", *few]).exit_code == 1


@needs_both
@pytest.mark.usefixtures("_elsewhere")
def test_the_command_compares_engines() -> None:
    """With --both the report is that of two engines."""
    Path("pendulum.xml").write_text(PENDULUM)
    limits = ("--probes", "2", "--held-out", "1")
    result = CliRunner().invoke(app, ("verify", "pendulum.xml", "--both", *limits))
    folder = Path("scm-world-results/verify-pendulum-both-seed0")
    found = Comparison.from_json((folder / "comparison/report.json").read_text())
    each = [
        Verification.from_json((folder / name / "report.json").read_text())
        for name in ("mujoco", "bullet")
    ]
    assert found.backends == tuple(one.backend for one in each) == ("mujoco", "bullet")
    assert result.exit_code == int("refuted" in {one.outcome for one in (found, *each)})
    assert "Comparison of mujoco and bullet" in result.stdout


@pytest.mark.usefixtures("_elsewhere")
def test_the_command_verifies_all_tasks_and_keeps_what_is_finished(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All tasks have a folder each; Ctrl-C in the third keeps two of them, and exits 130."""
    from scm_world.queries.experiments.paired import Paired

    run = Paired.run

    def interrupted(self: Paired, number: int, probe: Any, wanted: Any = None) -> Any:
        if "goal_block.cartesian_position" in self.targets:
            seen.add(id(self))
        if len(seen) == 2:
            raise KeyboardInterrupt
        return run(self, number, probe, wanted)

    seen: set[int] = set()
    monkeypatch.setattr(Paired, "run", interrupted)
    limits = ("--probes", "1", "--held-out", "0")
    result = CliRunner().invoke(
        app, ("verify", "all", "--backend", "fake", *limits, "--out", "here")
    )
    assert result.exit_code == 130, result.output
    assert sorted(path.name for path in Path("here").iterdir()) == ["pushing", "reaching"]
    assert "All verifications" in result.stdout


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_verified_on_both_engines(task: str) -> None:
    """Two hundred probe states see 99 % of the edges, and nothing undeclared, on both backends."""
    for backend in ENGINES:
        report = verify(load_system(task, SMALL.get(task, ())), backend=backend)
        assert report.undeclared == ()
        assert report.floor == 0.0
        assert report.share >= 0.99, report.never_fired


def test_equations_are_checked_under_the_interventions_they_were_given() -> None:
    """A given value cuts edges, and a given mechanism has those of its parents."""
    model = SCM(
        [
            Exogenous(name="a", distribution=Normal(0, 1)),
            Derived(name="b", parents=("a",), mechanism=Linear(weights=(2.0,))),
            Derived(name="c", parents=("b",), mechanism=Linear(weights=(2.0,))),
        ]
    )
    for act, edges in (
        ({"b": 1.0}, {("b", "c", 0)}),
        ({"c": Mechanism(lambda a: 3.0 * a, ["a"])}, {("a", "b", 0), ("a", "c", 0)}),
        ({"b": Shift(1.0)}, {("a", "b", 0), ("b", "c", 0)}),
    ):
        for given in (World(model).given(act), model.given(act)):
            found = verify(given)
            assert ({*found.declared}, found.outcome) == (edges, "confirmed")
        assert {*discover(World(model).given(act), probes=2).declared} == edges
    with pytest.raises(ModelError, match=r"with a time.* cannot be kept here: leave out given"):
        verify(World(model).given({"b": Hard(1.0, at=0)}))


def test_a_mechanism_that_an_engine_was_given_is_not_verified() -> None:
    """Variables are set one at a time, so that its edges would count as checked without a test."""
    tie = Mechanism(lambda color: 0.2 + 0.3 * color[0], ["floor_color"])
    with World("reaching", backend="fake").given({"floor_friction": tie}) as world:
        for check in (verify, discover):
            with pytest.raises(ModelError, match=r"an engine was given .*given\(.*floor_friction"):
                check(world)
