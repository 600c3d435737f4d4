"""``ModelTask``: what it accepts, and what it says about what it does not."""

from __future__ import annotations

import pickle
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest

from scm_world import Box, Derived, Exogenous, World
from scm_world.backends import BackendWrapper, make_backend, read_model
from scm_world.errors import (
    ActionError,
    EngineFailure,
    Infeasible,
    ModelError,
    OutOfBounds,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.variables import Contact, Hard, Integers
from scm_world.world.batch import Batch

PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="0.1"/>
    </body>
  </worldbody>
  {actuator}
</mujoco>
"""
MOTOR = "<actuator><motor name='motor' joint='hinge'/></actuator>"
DENSITY = Exogenous(name="density", unit="kg/m^3", default=1.0, bounds=Box(0.0, 10.0))


def pendulum(actuator: str = MOTOR, **options: Any) -> World:
    """Make a world of a pendulum."""
    return World(PENDULUM.format(actuator=actuator), **options)


def tied(name: str, function: Any, shape: tuple[int, ...] = ()) -> World:
    """Make one in which a parameter follows from a density."""
    tie = Derived(name=name, shape=shape, parents=("density",), mechanism=function)
    world = pendulum(ties=(DENSITY, tie))
    world.reset(seed=0)
    return world


@pytest.mark.parametrize(
    ("low", "high", "first"), [(0.2, 0.5, 0.2), (-0.5, -0.1, -0.1), (-1, 1, 0)]
)
def test_a_command_is_within_its_range_before_the_first_step(
    low: float, high: float, first: float
) -> None:
    """Ranges of grippers often leave out 0."""
    servo = f"<actuator><position name='servo' joint='hinge' ctrlrange='{low} {high}'/></actuator>"
    with pendulum(servo) as world:
        world.reset(seed=0)
        assert world["servo.control"] == first


# --- ties ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "shape", "function", "error", "message"),
    [
        ("pole.mass", (), lambda d: 1.5 - d, OutOfBounds, "do(pole.mass): -0.5 is outside"),
        (
            "pole.inertia", (3,), lambda d: np.array([1.0, 1.0, d]), Infeasible,
            "do(pole.inertia): array([1., 1., 4.]) is not feasible",
        ),
        (
            "pole.mass", (), lambda d: 1.0 / (2.0 - float(d)), ModelError,
            "the function of 'pole.mass' raised ZeroDivisionError",
        ),
        (
            "pole.mass", (), lambda d: None if d > 1.0 else 1.0, ModelError,
            "the function of 'pole.mass' gives array(None, dtype=object), not a number",
        ),
    ],
)  # fmt: skip
def test_a_tie_that_cannot_be_is_named_with_what_it_gave(
    name: str, shape: tuple[int, ...], function: Any, error: Any, message: str
) -> None:
    """And the world is as before."""
    world = tied(name, function, shape)
    before = world.values()
    with pytest.raises(error, match=re.escape(message)):
        world.do({"density": 4.0 if shape else 2.0})
    assert all(np.array_equal(world[name], value) for name, value in before.items())


def test_a_tie_that_cannot_be_from_the_beginning_is_named() -> None:
    """Not all parameters of the model are."""
    message = r"do\(pole.inertia\): array\(\[1., 1., 3.\]\) is not feasible"
    with pytest.raises(Infeasible, match=message):
        tied("pole.inertia", lambda _: np.array([1.0, 1.0, 3.0]), (3,))
    with pytest.raises(ModelError, match=r"'pole.mass' gives -1.0, not in 1e-09 to inf"):
        tied("pole.mass", lambda density: -density)


@pytest.mark.parametrize(
    ("name", "value"),
    [("hinge.damping", -1e-12), ("pole.mass", 1e-10), ("pole.inertia", [1e-12] * 3)],
)
def test_what_is_just_beyond_a_physical_bound_is_refused(name: str, value: Any) -> None:
    """However small the bound is."""
    world = pendulum()
    world.reset(seed=0)
    with pytest.raises(OutOfBounds):
        world.do({name: value})


# --- what is given ------------------------------------------------------------------------------


def test_text_and_files_of_any_ending_are_models(tmp_path: Path) -> None:
    """``World`` takes MJCF text, and endings in capitals."""
    text = PENDULUM.format(actuator=MOTOR)
    (tmp_path / "A.XML").write_text(text)
    urdf = '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    urdf = urdf.replace('<link name="b"/>', f'<link name="b">{body}</inertial></link>')
    (tmp_path / "B.URDF").write_text(
        f'{urdf}<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>'
    )
    assert World(text).task.system == World(str(tmp_path / "A.XML")).task.system
    assert "j.velocity" in World(str(tmp_path / "B.URDF")).model


def test_what_is_observed_is_a_variable() -> None:
    """Another name is refused when the world is made."""
    with pytest.raises(UnknownOption, match=r"hinge\.position"):
        pendulum(observe=["hinge.positon"])


def test_a_motor_without_limit_says_so() -> None:
    """Its bounds are an assumption, which ``spaces`` replaces."""
    motor = pendulum().model.declared("motor.control")
    assert motor.bounds == Box(-1.0, 1.0)
    assert "no limit" in motor.doc
    given = pendulum(spaces={"motor.control": {"bounds": (-3.0, 3.0)}})
    assert given.action_high.tolist() == [3.0]
    assert "no limit" not in given.model.declared("motor.control").doc


def test_without_actuators_only_an_empty_action_is_one() -> None:
    """A text is none."""
    world = pendulum("")
    world.reset(seed=0)
    world.step([])
    for wrong in ("x", [1.0], [np.nan]):
        with pytest.raises(ActionError):
            world.step(wrong)


def test_an_event_names_bodies_that_there_are() -> None:
    """A contact with something else could never happen."""
    with pytest.raises(UnknownOption, match="did you mean 'pole'"):
        pendulum().rollout(
            do={"gravity": Hard([0.0, 0.0, 0.0], when=Contact("pol_e", "world"))}, steps=2
        )
    pendulum().rollout(
        do={"gravity": Hard([0.0, 0.0, 0.0], when=Contact("pole", "world"))}, steps=2
    )


# --- what happens -------------------------------------------------------------------------------


def test_a_lost_state_is_told_with_time_and_place() -> None:
    """Which states are not finite, in which control step, and which was the largest before."""
    world = pendulum()
    world.reset(seed=0)
    world.step([0.0])
    world.do({"hinge.velocity": 1e200})
    message = (
        r"in control step 1: MuJoCo produced a state that is not finite at .* s: hinge\..*; before "
        r"that step, the largest number was 1e\+200, of hinge.velocity"
    )
    with pytest.raises(EngineFailure, match=message):
        world.step([1.0])
    with pytest.raises(EngineFailure, match="reset the world"):
        world.step([1.0])
    world.reset(seed=0)
    world.step([0.0])


GROWING = """<actuator>
  <general name="motor" joint="hinge" ctrlrange="-1 1" biastype="affine" biasprm="0 0 9"/>
</actuator>"""


def test_a_state_that_mujoco_calls_unstable_is_lost() -> None:
    """Beyond 1e10 (``mj_checkVel``, ``mj_checkAcc``), although it is finite; undo stays exact."""
    world = pendulum(GROWING)
    world.reset(seed=0)
    kept = list[tuple[Any, dict[str, Any]]]()

    def grow() -> None:
        while len(kept) < 100:
            kept.append((world.snapshot(), world.values()))
            world.step([1.0])

    with pytest.raises(EngineFailure, match=r"control step \d+: .* unstable .* beyond 1e\+10"):
        grow()
    before, states = kept[-1]
    with pytest.raises(EngineFailure, match="reset the world, or restore a snapshot"):
        world.step([1.0])
    world.restore(before)
    assert all(np.array_equal(world[name], value) for name, value in states.items())
    with pytest.raises(EngineFailure, match="unstable"):
        world.step([1.0])
    world.reset(seed=0)
    world.step([0.0])


def test_an_unstable_state_is_lost_in_its_world_of_a_batch_only() -> None:
    """Nothing moves until that world has another state."""
    first = pendulum(GROWING)
    batch = Batch([first, World(first.structures), World(first.structures)])
    for index in range(3):
        batch.world(index).reset(seed=0)
    push = np.array([[0.0], [1.0], [0.0]])

    def grow() -> None:
        for _ in range(100):
            batch.advance(push)

    with pytest.raises(EngineFailure, match="unstable") as error:
        grow()
    assert (error.value.lost, error.value.row) == ((1,), 1)
    count = batch.world(0).index
    with pytest.raises(EngineFailure, match="reset the world"):
        batch.advance(push)
    with pytest.raises(EngineFailure, match="reset the world"):
        batch.world(1).do({"hinge.position": 0.4})
    assert [batch.world(index).index for index in (0, 2)] == [count, count]
    batch.world(1).reset(seed=1)
    batch.advance(push)
    assert [batch.world(index).index for index in range(3)] == [count + 1, 1, count + 1]


def test_many_bodies_share_the_declarations_of_their_causes() -> None:
    """The edges are as many as the square of the bodies; what declares them is not."""
    n = 12
    bodies = "".join(f"<body pos='{i} 0 1'><freejoint/><geom size='0.1'/></body>" for i in range(n))
    world = World(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    parents = [p for v in world.model.variables for p in v.all_parents]
    assert len(parents) > 20 * n * n
    assert len({id(parent) for parent in parents}) < 40 * n


def test_a_pickled_snapshot_leaves_the_model_out() -> None:
    """A world of the same model goes back to it, bit for bit; one of another model refuses it."""
    world = pendulum()
    world.reset(seed=0)
    world.do({"pole.mass": 0.3})
    world.step([1.0])
    packed = pickle.dumps(world.snapshot())
    assert b"<mujoco" not in packed
    world.step([1.0])
    again = pickle.loads(pickle.dumps(pickle.loads(packed)))  # noqa: S301 # our own
    other = pendulum()
    other.restore(again)
    other.step([1.0])
    assert all(np.array_equal(other[name], value) for name, value in world.values().items())
    with pytest.raises(SnapshotMismatch, match="another task, of other arguments"):
        World(PENDULUM.format(actuator=MOTOR).replace("0.5", "0.6")).restore(again)


# --- ranges, constraints, keyframes --------------------------------------------------------------

ROPE = """
<mujoco>
  <worldbody><site name="o"/>
    <body name="a" pos="0 0 1">
      <joint name="j" axis="0 1 0" range="-40 40" limited="true" actuatorfrcrange="-1 1"/>
      <geom size=".05" pos=".2 0 0"/><site name="s" pos=".2 0 0"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="t" stiffness="5" springlength=".1 .3" range="0 2" limited="true">
      <site site="s"/><site site="o"/>
    </spatial>
  </tendon>
  <actuator><motor name="m" joint="j" ctrlrange="-1 1" forcerange="-2 2"/></actuator>
</mujoco>
"""


def test_no_range_begins_with_its_upper_end() -> None:
    """MuJoCo refuses each of them in a file; the world stays as it was."""
    ranges = [
        "t.springlength", "t.range", "j.range", "j.actuatorfrcrange", "m.ctrlrange", "m.forcerange",
    ]  # fmt: skip
    world = World(ROPE, expose=["*", *ranges])
    world.reset(seed=0)
    pairs = {row.name for row in world.task.system.parameters if row.shape == (2,)}
    assert pairs == {*ranges}
    for name in ranges:
        before = world[name]
        with pytest.raises(Infeasible, match=rf"do\({name}\).*give the lower end first"):
            world.do({name: [before[1] + 1.0, before[0]]})
        np.testing.assert_array_equal(world[name], before)
        world.do({name: np.add(before, 0.01)})


def test_no_limit_of_a_joint_is_reversed_on_bullet() -> None:
    """It is refused as on MuJoCo."""
    pytest.importorskip("pybullet")
    text = PENDULUM.format(actuator="").replace("damping", 'range="-9 9" limited="true" damping')
    world = World(text, backend="bullet", expose=["hinge.range"])
    world.reset(seed=0)
    with pytest.raises(Infeasible, match="give the lower end first"):
        world.do({"hinge.range": [0.1, -0.1]})
    world.do({"hinge.range": [-0.1, 0.1]})


WELDED = """
<mujoco>
  <worldbody>
    <body name="a" pos="0 0 1"><freejoint/><geom size=".1"/></body>
    <body name="b" pos="1 0 1"><freejoint/><geom size=".1" mass="3"/></body>
  </worldbody>
  <equality><weld name="weld" body1="a" body2="b" active="false"/></equality>
  <keyframe>
    <key name="up" qpos="0 0 2 1 0 0 0 1 0 2 1 0 0 0" qvel="1 0 0 0 0 0 0 0 0 0 0 0"/>
  </keyframe>
</mujoco>
"""


def test_a_constraint_can_be_switched() -> None:
    """The weld carries the speed of one body to the other, until the reset."""
    world = World(WELDED, keyframe="up")
    switch = world.model.declared("weld.active")
    assert (switch.dtype, switch.bounds, switch.default) == ("integer", Integers(0, 1), 0)
    world.reset(seed=0)
    assert world.do({"weld.active": 1}).targets["weld.active"].read_back == 1
    for _ in range(10):
        world.step([])
    assert world["b.linear_velocity"][0] > 0.1
    world.reset(seed=0)
    assert world["weld.active"] == 0
    for _ in range(10):
        world.step([])
    assert world["b.linear_velocity"][0] == 0.0
    with pytest.raises(OutOfBounds):
        world.do({"weld.active": 2})
    plain = world.rollout(None, seed=0, steps=10)
    assert plain.counterfactual({}, at=4) == plain
    other = plain.counterfactual({"weld.active": 1}, at=4)
    assert np.array_equal(other["b.linear_velocity"][:5], plain["b.linear_velocity"][:5])
    assert other["b.linear_velocity"][-1, 0] > 0.1
    children = world.model.children("weld.active")
    assert {"a.linear_velocity", "b.cartesian_position"} <= set(children)


def test_the_controls_of_a_keyframe_are_the_idle_action() -> None:
    """A servo that begins in a keyframe stays there, on both engines."""
    servo = '<actuator><position name="m" joint="hinge" kp="50" kv="5"/></actuator>'
    key = '<keyframe><key name="home" qpos=".8" ctrl=".8"/></keyframe>'
    for backend in ("mujoco", "bullet") if find_spec("pybullet") else ("mujoco",):
        world = pendulum(servo + key, keyframe="home", backend=backend)
        world.reset(seed=0)
        assert world["hinge.position"] == 0.8
        np.testing.assert_array_equal(world.task.idle(world), [0.8])
        episode = world.rollout(None, seed=0, steps=20)
        np.testing.assert_allclose(episode["hinge.position"], 0.8, atol=0.02)


# --- one way to give options ---------------------------------------------------------------------


def test_a_world_takes_the_options_of_its_model(tmp_path: Path) -> None:
    """A task that is made has its options."""
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM.format(actuator=MOTOR))
    options: Any = {"control_dt": 0.05, "expose": ["*.mass"], "seconds": 1.0}
    for source in (path, str(path), path.read_text(), mujoco.MjModel.from_xml_path(str(path))):
        world, other = World(source, **options), World(source, **options)
        assert world.model == other.model
        assert world.options.control_period == other.options.control_period == 0.05
    root = '<robot name="r"><link name="l"><inertial><mass value="1"/><inertia ixx="1" iyy="1" '
    urdf = root + 'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    assert "l.cartesian_position" in World(urdf, fixed_base=False).model
    for task in (pendulum().task, pendulum().structures):
        with pytest.raises(UnknownOption, match="with a source that is made already"):
            World(task, control_dt=0.05)
    with pytest.raises(UnknownOption, match="did you mean 'expose'"):
        World(str(path), exposed=["*.mass"])
    with pytest.raises(UnknownOption, match="no option of ModelTask is named 'kinds'"):
        World(str(path), kinds=())
    assert (
        World("pushing", backend="fake", tool_block_mass=0.3)
        .model.declared("tool_block.mass")
        .default
        == 0.3
    )


# --- what has no effect --------------------------------------------------------------------------

SLIPPERY = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1" friction="1"/>
  <body name="c" pos="0 0 .1"><freejoint/>
    <geom name="cube" type="box" size=".1 .1 .1" friction=".5"/>
  </body>
  <body name="d" pos="0 0 .4"><freejoint/>
    <geom name="ball" size=".1" friction=".3" priority="{priority}"/>
  </body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(
    ("priority", "request_", "decide"),
    [
        (0, {"cube.friction": 0.8}, "floor (1)"),
        (0, {"cube.friction": 1.5}, ""),
        (0, {"ball.friction": 0.4}, "floor (1), cube (0.5)"),
        (1, {"cube.friction": 0.8}, "floor (1), ball (0.3)"),
        (1, {"ball.friction": 0.1}, ""),
    ],
)
def test_the_audit_says_where_a_friction_has_no_effect(
    priority: int, request_: dict[str, float], decide: str
) -> None:
    """MuJoCo takes the larger of two coefficients, unless one shape has a higher priority."""
    world = World(SLIPPERY.format(priority=priority))
    world.reset(seed=0)
    (name,) = request_
    expected = f"{name} has no effect in contacts with {decide}: the larger coefficient counts"
    audit = world.do(request_)
    assert len(audit.remarks) == bool(decide)
    assert (f"note: {expected}" in str(audit)) == bool(decide)


def test_the_audit_says_that_the_inertia_stays_where_a_mass_is_set() -> None:
    """As in plain MuJoCo, body_mass is one number; a factor changes both."""
    world = World(SLIPPERY.format(priority=0), expose=["*", "*.scale"])
    world.reset(seed=0)
    before = world["c.inertia"]
    audit = world.do({"c.mass": 2.0})
    assert (world["c.inertia"] == before).all()
    assert audit.remarks == ("c.inertia as before, not in proportion to the mass",)
    assert world.do({"c.mass": 2.0}).remarks == ()  # as it is
    for inertia in (2.0 * before, before):
        assert world.do({"c.mass": 3.0 * inertia[0], "c.inertia": inertia}).remarks == ()
    world.reset(seed=0)
    assert world.do({"c.scale": 2.0}).remarks == ()
    np.testing.assert_allclose(world["c.inertia"], 2.0 * before)


class Inside(BackendWrapper):
    """An engine in an engine."""

    name: ClassVar[str] = "inside"


@pytest.mark.parametrize("wrapped", [False, True])
def test_the_audit_of_bullet_says_that_a_friction_has_no_effect(wrapped: bool) -> None:
    """Nothing that the engine was given changes below the friction of the floor."""
    pytest.importorskip("pybullet")
    backend = Inside(make_backend("bullet")) if wrapped else "bullet"
    world = World(SLIPPERY.format(priority=0), backend=backend)
    world.reset(seed=0)
    (remark,) = world.do({"cube.friction": 0.8}).remarks
    assert remark.startswith("cube.friction has no effect in contacts with floor (1)")
    assert world.do({"cube.friction": 1.5}).remarks == ()


@pytest.mark.parametrize(
    "options",
    [
        {"expose": "*.mass"},
        {"fixed_base": False},
        {"keyframe": "up"},
        {"outcomes": ["rod.position"]},
    ],
    ids=lambda options: next(iter(options)),
)
def test_a_model_that_is_read_already_is_not_read_again(options: dict[str, Any]) -> None:
    """What is asked of a file comes too late, and is refused instead of forgotten."""
    model = read_model(PENDULUM.format(actuator=MOTOR), readouts=["pole.position"])
    with pytest.raises(UnknownOption):
        World(model, **options)
    assert "pole.position" in World(model, outcomes=["pole.position"], control_dt=0.05).model


def test_a_space_is_a_dictionary_and_a_delay_may_be_a_number_of_numpy() -> None:
    """Anything else is refused with what a space can have."""
    with pytest.raises(UnknownOption, match="a dictionary with a, b, bounds"):
        pendulum(spaces={"motor.control": None})
    (late,) = pendulum(delay={"motor.control": np.int64(2)}).task.channels
    assert late.most == 2


@pytest.mark.parametrize("names", [["left", "right"], ["left"], ["action"]])
def test_all_controls_are_one_variable(names: list[str]) -> None:
    """One actuator or several: ``action`` is their vector, unless one of them has this name."""
    bodies = "".join(
        f'<body><joint name="j{name}" type="slide"/><geom size=".1" mass="2"/></body>'
        for name in names
    )
    motors = "".join(f'<motor name="{n}" joint="j{n}" ctrlrange="-1 1"/>' for n in names)
    world = World(
        f"""<mujoco><option gravity="0 0 0"/><worldbody>{bodies}</worldbody>
        <actuator>{motors}</actuator></mujoco>"""
    )
    world.reset(seed=0)
    controls = [name for name in world.model if world.model.declared(name).role == "action"]
    assert len(controls) == len(names)
    if names != ["action"]:
        world.do({"action": [0.25] * len(names)})
    else:
        world.do({controls[0]: 0.25})
    world.step(np.zeros(len(names)))
    for name in names:  # v = F t / m
        assert float(world[f"j{name}.velocity"]) == pytest.approx(0.25 * 0.02 / 2.0)
    assert "action" in world.model or names == ["action"]
