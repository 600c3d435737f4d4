"""States follow others by equality constraints, and what violates one is said."""

from __future__ import annotations

import gc
import re
import weakref
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from scm_world import Box, World
from scm_world.errors import UnknownOption
from scm_world.geometry.rotations import from_rotation_vector
from scm_world.testing.model import check_model

PLAIN = "contype='0' conaffinity='0'"
NEEDS_BULLET = pytest.mark.skipif(not find_spec("pybullet"), reason="Bullet is not installed")
BACKENDS = ["mujoco", pytest.param("bullet", marks=NEEDS_BULLET)]


def gripper(offset: float) -> str:
    """Return a URDF with two links on parallel hinges, of which b turns twice as far as a."""
    inertia = '<inertia ixx=".002" iyy=".002" izz=".002" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(
        f'<link name="l{n}"><inertial><origin xyz="0 0 -.1"/><mass value=".3"/>{inertia}</inertial>'
        "</link>"
        for n in "ab"
    )
    joint = (
        '<joint name="{0}" type="continuous"><parent link="base"/><child link="l{0}"/>'
        '<origin xyz="{1} 0 .2"/><axis xyz="0 1 0"/><limit effort="5" velocity="100"/>{2}</joint>'
    )
    mimic = f'<mimic joint="a" multiplier="2" offset="{offset}"/>'
    joints = joint.format("a", 0, "") + joint.format("b", 0.5, mimic)
    return f'<robot name="g"><link name="base"/>{links}{joints}</robot>'


def crank(rod: float = 0.3, gravity: str = "0 0 0") -> str:
    """Return a slider-crank whose crank is 0.1 m long and stands upright at 0."""
    return f"""<mujoco><option gravity='{gravity}'/><worldbody>
      <body name='crank'><joint name='crank' axis='0 1 0'/>
        <geom type='capsule' fromto='0 0 0 0 0 .1' size='.01' {PLAIN}/>
        <body name='rod' pos='0 0 .1'><joint name='rod' axis='0 1 0'/>
          <geom type='capsule' fromto='0 0 0 {rod} 0 0' size='.01' {PLAIN}/></body></body>
      <body name='slider' pos='{rod} 0 .1'><joint name='slider' type='slide' axis='1 0 0'/>
        <geom type='box' size='.02 .02 .02' {PLAIN}/></body></worldbody>
      <equality><connect name='pin' body1='slider' body2='rod' anchor='0 0 0'/></equality>
      <actuator><motor joint='crank'/></actuator></mujoco>"""


def closed(angle: Any) -> tuple[Any, Any]:
    """Return where rod and slider are for an angle of the crank: the pin stays at z = 0.1 m."""
    turn = np.arcsin((0.1 * np.cos(angle) - 0.1) / 0.3)
    return turn - angle, 0.1 * np.sin(angle) + 0.3 * np.cos(turn) - 0.3


@pytest.mark.parametrize("offset", [0.0, 0.3])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_joint_that_mimics_follows_its_master(backend: str, offset: float) -> None:
    """Joint b is at 2 a + offset at the start and where a is set, and nothing moves by itself."""
    world = World.from_urdf(gripper(offset), backend=backend)
    world.reset(seed=0)
    world.do({"gravity": [0.0, 0.0, 0.0]})
    for angle in (0.0, 0.5):
        audit = world.do({"a.position": angle})
        assert audit.remarks == ()
        for _ in range(5):
            np.testing.assert_allclose(world["b.position"], 2.0 * angle + offset, atol=1e-7)
            np.testing.assert_allclose(world["a.position"], angle, atol=1e-7)
            world.step([0.0])
    world.do({"a.velocity": -1.0})
    np.testing.assert_allclose(world["b.velocity"], -2.0, atol=1e-12)
    notes = [note for note in world.task.system.notes if "equality constraints" in note]
    assert bool(notes) == bool(offset)  # of the pose of the file


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_violated_joint_is_said(backend: str) -> None:
    """Setting what follows says by how many radians it is off, and undoing it says nothing."""
    world = World.from_urdf(gripper(0.3), backend=backend)
    world.reset(seed=0)
    before = world.vector.copy()
    (remark,) = world.do({"b.position": 1.0}).remarks
    assert re.search(r"joint b, which follows a: 0\.7 rad", remark)
    assert world.do({"b.position": 0.3, "a.position": 0.0}).remarks == ()
    np.testing.assert_array_equal(world.vector, before)


def test_drawn_starts_of_a_gripper_have_no_kick() -> None:
    """Fingers that are coupled begin together wherever they are drawn, and stay there."""
    text = f"""<mujoco><option gravity='0 0 0'/><worldbody><body name='hand'>
      <body name='left'><joint name='left' type='slide' axis='1 0 0' range='0 .04'/>
        <geom size='.01' {PLAIN}/></body>
      <body name='right'><joint name='right' type='slide' axis='-1 0 0' range='0 .04'/>
        <geom size='.01' {PLAIN}/></body></body></worldbody>
      <equality><joint joint1='left' joint2='right'/></equality></mujoco>"""
    world = World.from_mjcf(text, start={"*.position": Box(0.0, 0.04)})
    drawn = []
    for seed in range(3):
        world.reset(seed=seed)
        drawn.append(float(world["right.position"]))
        assert world["left.position"] == pytest.approx(drawn[-1], abs=1e-15)
        world.step([])
        assert abs(world["left.velocity"]) < 1e-12
    assert len(set(drawn)) == 3
    with pytest.raises(UnknownOption, match=r"right\.position"):
        World.from_mjcf(text, start={"left.position": 0.02})


def test_a_polynomial_counts_from_the_reference_pose() -> None:
    """With refs of 0.2 and 0.1, b - 0.2 = 0.1 + 2 (a - 0.1) - 3 (a - 0.1)^3."""
    bodies = "".join(
        f"<body><joint name='{name}' ref='{ref}' axis='0 1 0'/><geom size='.1'/></body>"
        for name, ref in (("a", 0.1), ("b", 0.2))
    )
    text = f"""<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody><equality>
      <joint joint1='b' joint2='a' polycoef='.1 2 0 -3 0'/></equality></mujoco>"""
    world = World.from_mjcf(text)
    world.reset(seed=0)
    world.do({"a.position": 0.5, "a.velocity": 2.0})
    assert world["b.position"] == pytest.approx(0.2 + 0.1 + 2 * 0.4 - 3 * 0.4**3, abs=1e-12)
    assert world["b.velocity"] == pytest.approx(2.0 * (2 - 9 * 0.4**2), abs=1e-12)


def test_a_loop_follows_its_crank() -> None:
    """With follow=True rod and slider have the closed form, in starts, draws, do and batches."""
    options: dict[str, Any] = {"follow": True, "start": {"crank.position": Box(-0.6, 0.6)}}
    worlds = World(crank(), num_worlds=3, **options)
    worlds.reset(seed=0)
    rod, slider = closed(worlds["crank.position"])
    np.testing.assert_allclose(worlds["rod.position"], rod, atol=1e-10)
    np.testing.assert_allclose(worlds["slider.position"], slider, atol=1e-10)
    world = worlds.world(0)
    before = world.vector.copy()
    audit = world.do({"crank.position": 0.3, "crank.velocity": 2.0})
    rod, slider = closed(0.3)
    steps = [np.array(closed(0.3 + side * 1e-6)) for side in (-1, 1)]
    found = [float(world[name]) for name in ("rod.velocity", "slider.velocity")]
    np.testing.assert_allclose(found, 2.0 * (steps[1] - steps[0]) / 2e-6, atol=1e-7)
    assert (world["rod.position"], world["slider.position"]) == pytest.approx((rod, slider))
    assert {"rod.position", "slider.position"} <= audit.followed.keys()
    assert audit.remarks == ()
    world.do({"crank.position": before[0], "crank.velocity": 0.0})
    np.testing.assert_array_equal(world.vector, before)
    world.step([0.0])
    assert np.abs(world.vector - before).max() < 1e-9


def test_a_loop_that_does_not_follow_says_how_far_it_is_open() -> None:
    """Without follow=True the pin is as far open as the ends of rod and slider are apart."""
    world = World.from_mjcf(crank())
    world.reset(seed=0)
    (remark,) = world.do({"crank.position": 0.3}).remarks
    ends = 0.1 * np.sin(0.3) + 0.3 * np.cos(0.3) - 0.3, 0.1 * np.cos(0.3) - 0.3 * np.sin(0.3) - 0.1
    assert f"equality pin: {np.hypot(*ends):.3g} m" in remark
    assert world["slider.position"] == 0.0
    assert "equality pin" in world.do({"crank.position": 0.1}).remarks[0]  # not as far, but open
    assert world.do({"crank.damping": 0.1}).remarks == ()  # which moves nothing
    drawn = World.from_mjcf(crank(), start={"crank.position": Box(0.1, 0.2)})
    with pytest.warns(UserWarning, match="drawn start violates equality pin"):
        drawn.reset(seed=0)
    begun = World.from_mjcf(crank(), start={"crank.position": 0.3}).fidelity().start
    assert begun.values.tolist() == [
        ["equality", "equality pin", pytest.approx(np.hypot(*ends)), "m"]
    ]
    following = World.from_mjcf(crank(), start={"crank.position": 0.3}, follow=True)
    assert len(following.fidelity().start) == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_followers_keep_all_promises(backend: str) -> None:
    """Undo, refusals, counterfactuals, batches and other processes are exact with followers."""
    text, follow = (crank(), True) if backend == "mujoco" else (gripper(0.3), False)
    found = check_model(text, backend=backend, follow=follow, steps=100)
    assert found["set and undone"] > 10


def test_a_loop_that_cannot_close_is_said() -> None:
    """A rod of 0.15 m does not reach down to the slider from all angles: others stay and say so."""
    world = World.from_mjcf(crank(rod=0.15), follow=True)
    world.reset(seed=0)
    assert world.do({"crank.position": 0.8}).remarks == ()
    (remark,) = world.do({"crank.position": np.pi}).remarks
    assert "equality pin" in remark
    assert np.isfinite(world.vector).all()


def test_a_constraint_that_is_off_moves_nothing() -> None:
    """States follow as long as their constraint is active, and switching it moves none."""
    world = World.from_mjcf(crank(), follow=True)
    world.reset(seed=0)
    world.step([0.0])
    assert world.do({"pin.active": 0, "crank.position": 0.3}).remarks == ()
    assert world["slider.position"] == 0.0
    assert world.do({"pin.active": 1, "crank.position": 0.3}).remarks == ()
    assert world["slider.position"] == pytest.approx(closed(0.3)[1])


def test_welds_and_tendons_are_measured() -> None:
    """A weld is open by meters and by the angle in radians, coupled tendons by their lengths."""
    text = """<mujoco><worldbody>
      <body name='a'><freejoint/><geom size='.05'/></body>
      <body name='b' pos='0 0 1'><freejoint/><geom size='.05'/></body>
      <body pos='1 0 0'><joint name='s' type='slide'/><geom size='.05'/></body>
      <body pos='2 0 0'><joint name='t' type='slide'/><geom size='.05'/></body></worldbody>
      <tendon><fixed name='S'><joint joint='s' coef='3'/></fixed>
        <fixed name='T'><joint joint='t' coef='1'/></fixed></tendon>
      <equality><weld name='glue' body1='a' body2='b' torquescale='2'/>
        <tendon name='belt' tendon1='S' tendon2='T'/></equality></mujoco>"""
    world = World.from_mjcf(text)
    world.reset(seed=0)
    turn = from_rotation_vector([0.0, 0.0, 0.3])
    request = {"b.cartesian_position": [0.03, 0.0, 1.04], "b.orientation": turn, "s.position": 0.1}
    remarks = " ".join(world.do(request).remarks)
    for said in ("equality glue: 0.05 m", "equality glue: 0.3 rad", "equality belt: 0.3 m"):
        assert said in remarks
    world = World.from_mjcf(text, follow=True)
    world.reset(seed=0)
    assert world.do({"a.cartesian_position": [0.5, 0.0, 0.0], "s.position": 0.1}).remarks == ()
    np.testing.assert_allclose(world["b.cartesian_position"], [0.5, 0.0, 1.0], atol=1e-12)
    assert world["t.position"] == pytest.approx(0.3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_model_ends_with_its_world(backend: str) -> None:
    """What was found for joints that follow, and for an engine, does not keep the model alive."""
    world = World.from_urdf(gripper(0.123), backend=backend)
    world.reset(seed=0)
    world.do({"a.position": 0.5})
    world.step([0.0])
    system = world.task.system
    ends = [weakref.ref(one) for one in (system, system.source)]
    assert all(end() is not None for end in ends)
    del world, system
    gc.collect()
    assert [end() for end in ends] == [None, None]
