"""How far a model is from plain MuJoCo with its file, and options that keep or change the file."""

from __future__ import annotations

import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from model_files import PENDULUM, pile
from typer.testing import CliRunner

import scm_world as sw
from scm_world.backends import read_model
from scm_world.backends.mujoco.fidelity import STEPS, fidelity
from scm_world.backends.mujoco.reading import compiled
from scm_world.cli.app import app
from scm_world.errors import ModelError, UnknownOption
from scm_world.testing.model import check_counterfactual, check_undo

FEW = pile(2, '<option iterations="1" integrator="implicitfast"/>')
"""Bodies that lie in one another, and a solver that needs its last solution."""

CROSSED = """
<mujoco><compiler angle="radian"/><worldbody>
  <body name="upper" pos="0 0 .3"><joint name="hip" axis="0 1 0" range=".2 1"/>
    <geom name="u" type="box" size=".1 .1 .1"/>
    <body name="middle" pos="0 0 -.2"><joint name="knee" axis="0 1 0"/>
      <geom name="m" size=".02"/>
      <body name="lower" pos="0 0 .1"><joint name="ankle" axis="0 1 0"/>
        <geom name="l" type="capsule" size=".05 .1"/>
      </body>
    </body>
  </body>
</worldbody>
<contact><pair geom1="u" geom2="l"/></contact>
<keyframe><key name="home" qpos=".5 0 0"/><key qpos=".3 0 0"/></keyframe>
</mujoco>
"""


def test_a_model_of_one_tree_is_plain_mujoco_but_for_settings_of_no_effect() -> None:
    """All differences are zero, and the settings that changed are listed with the reason."""
    with closing(sw.World(PENDULUM)) as world:
        found = world.fidelity()
    assert [*found.changes["what"]] == ["warmstart", "autoreset"]
    assert (found.changes["why"].str.len() > 0).all()
    assert found.differences.loc["hinge.position"].to_dict() == {
        "unit": "rad", "floor": 0.0, "idle": 0.0, "random": 0.0,
    }  # fmt: skip
    assert found.largest()[0] == 0.0
    assert not found.far
    assert str(found).startswith("up to 0 m or rad from plain MuJoCo in the first 5 control steps")


def test_differences_are_those_from_mj_step_of_the_file() -> None:
    """What is left out changes the motion; the table has the difference of the end."""
    text = pile(2).replace("<freejoint/>", '<joint type="free" armature=".5"/>')
    model = read_model(text, drop="armature")
    found = fidelity(model)
    assert "What drop= leaves out matters: armature." in found.notes[-1]
    assert "drop armature" in set(found.changes["what"])
    ends = []
    for mj in (mujoco.MjModel.from_xml_string(text), compiled(model)):
        data, height = mujoco.MjData(mj), []
        for _ in range(STEPS):
            mujoco.mj_step(mj, data, 10)
            height.append(data.qpos[:3].copy())
        ends.append(np.array(height))
    expected = np.abs(ends[0] - ends[1]).max()
    assert found.differences.loc["b0.cartesian_position", "idle"] == expected > 1e-4


@pytest.mark.parametrize("solver", ["PGS", "CG", "Newton"])
def test_damping_elsewhere_does_not_change_how_a_tree_is_integrated(solver: str) -> None:
    """MuJoCo integrates all trees otherwise once a joint is damped; here it always does."""
    far = '<body pos="5 0 2"><joint name="far"/><geom size=".1"/></body></worldbody>'
    text = pile(2, f'<option solver="{solver}"/>').replace("</worldbody>", far)
    with closing(sw.World(text)) as world:
        one = world.rollout(None, seed=0, steps=5)
        other = world.rollout(None, seed=0, steps=5, do={"far.damping": 2.0})
        assert "integrator" not in set(world.fidelity().changes["what"])
    assert (one["b0.orientation"] == other["b0.orientation"]).all()
    assert (one["far.position"] == other["far.position"]).all()


def test_few_iterations_are_raised_and_the_rest_is_a_warning() -> None:
    """The rest is what the solver of the file lacks: with as many iterations MuJoCo is near."""
    with pytest.warns(UserWarning, match="It is far from plain MuJoCo: up to") as caught:
        model = read_model(FEW)
    assert len(caught) == 1
    assert compiled(model).opt.iterations == 100
    found = fidelity(model)
    assert any("number of iterations is 100 instead of 1" in note for note in found.notes)
    assert found.largest()[0] > 1e-4 > found.largest("converged")[0]
    kept = FEW.replace("<option", '<option solver="Newton"').replace(
        "/>", '><flag warmstart="disable"/></option>', 1
    )
    assert compiled(read_model(kept)).opt.iterations == 1  # it never had a warm start


def test_the_physics_of_the_file_is_kept_where_that_is_asked_for() -> None:
    """Then there is no difference, the noise floor is measured, and snapshots restore."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = read_model(FEW, exact=False)
    found = fidelity(model)
    assert found.largest()[0] == 0.0 < max(found.floors.values())
    assert any(f"by up to {found.noise}" in note for note in found.notes)
    assert found.floors.keys() == {"m", "rad", "m/s", "rad/s"}
    assert model.digest != read_model(pile(2), exact=False).digest
    with closing(sw.World(FEW, exact=False, expose="*.mass")) as world:
        check_counterfactual(world)
        assert check_undo(world, (1, 5)) > 8
        world.reset(seed=0)
        report = sw.verify(world, probes=2)
    assert not report.undeclared
    assert not report.unstable


def test_the_start_pose_is_checked_by_name() -> None:
    """Bodies in one another and joints beyond their limits are in the table and in the notes."""
    model = read_model(CROSSED)
    table = fidelity(model).start.set_index("what")
    assert table.loc["upper and lower", "unit"] == "m"
    assert table.loc["upper and lower", "size"] > 0.1
    assert table.loc["joint hip", "size"] == pytest.approx(0.2)
    assert any("has bodies in one another: upper and lower (0.1" in n for n in model.notes)
    assert any("is beyond limits: joint hip (0.2 rad)" in note for note in model.notes)
    assert not any("limits" in note for note in read_model(CROSSED, keyframe="home").notes)


def test_keyframes_are_listed() -> None:
    """By name, or by number; the note that they are not used names them, too."""
    model = read_model(CROSSED)
    assert model.keyframes == ("home", "1")
    assert any("Keyframes that are not used: home, 1." in note for note in model.notes)


def test_a_keyframe_with_a_name_has_a_number_too() -> None:
    """Numbers count from 0; where there is none, the message says so."""
    with closing(sw.World(CROSSED, keyframe=0)) as world:
        assert world.rollout(None, seed=0, steps=1)["hip.position"][0] == 0.5
    with pytest.raises(UnknownOption, match="none, because the file has no keyframe"):
        sw.World(PENDULUM, keyframe=0)


def test_a_ground_is_not_added_beside_one() -> None:
    """The message names the option, not the line of an XML file."""
    floor = '<worldbody><geom name="ground" type="plane" size="1 1 1"/>'
    with pytest.raises(UnknownOption, match="ground cannot be True; it can be: False: the file"):
        sw.World(PENDULUM.replace("<worldbody>", floor), ground=True)


@pytest.mark.parametrize("option", ["exact", "self_collision", "ground", "fixed_base"])
def test_switches_are_true_or_false(option: str) -> None:
    """A word that looks like one is refused."""
    with pytest.raises(UnknownOption, match=f"{option} cannot be 'no'; it can be: True or False"):
        sw.World(PENDULUM, **{option: "no"})


def test_a_state_that_is_lost_is_said() -> None:
    """Here or by plain MuJoCo; an exact model has no noise floor."""
    blind = PENDULUM.replace("<worldbody>", '<option timestep="0.02"/><worldbody>')
    stiff = '<actuator><position joint="hinge" kp="1e9" inheritrange="0"/></actuator>'
    found = fidelity(read_model(blind.replace("</mujoco>", f"{stiff}</mujoco>")))
    assert not any(found.floors.values())
    assert "in control step 2 in plain MuJoCo" in str(found)
    assert "inf" not in str(found)


def test_bodies_of_one_tree_can_be_kept_from_touching() -> None:
    """Pairs that the file declares go, too; other trees and the floor touch as before."""
    plane = '<worldbody><geom type="plane" pos="0 0 .1" size="1 1 1"/>'
    model = read_model(CROSSED.replace("<worldbody>", plane), self_collision=False)
    mj = compiled(model)
    assert mj.npair == 0
    assert [*fidelity(model).start["what"]] == ["world and middle", "world and lower", "joint hip"]
    assert any("self_collision=False leaves out contacts of 1 pairs" in n for n in model.notes)
    unnamed = pile(2).replace('name="b0" ', "").replace('name="b1" ', "")
    assert read_model(unnamed, self_collision=False).trees == read_model(unnamed).trees


def test_a_urdf_is_one_robot_with_its_base() -> None:
    """Its links do not touch the fixed base, which is a part of the world; a ground they touch."""
    link = """<link name="{}"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1"
        ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><sphere radius=".1"/></geometry>
        </collision></link>"""
    joint = """<joint name="{0}" type="continuous"><parent link="base"/><child link="{0}"/>
        <origin xyz="{1} 0 .05"/><axis xyz="0 1 0"/></joint>"""
    parts = (link.format("base"), *map(link.format, "ab"), *map(joint.format, "ab", (0.0, 0.15)))
    text = f'<robot name="r">{"".join(parts)}</robot>'
    assert len(fidelity(read_model(text)).start) == 3
    model = read_model(text, self_collision=False, ground=True)
    assert any("leaves out contacts of 3 pairs" in note for note in model.notes)
    assert not len(fidelity(model).start)
    world = sw.World(text, self_collision=False, ground=True, fixed_base=False)
    world.reset(seed=0)
    for _ in range(50):
        world.step(np.zeros(2))
    assert -0.01 < world["base.cartesian_position"][2] < 0.2
    world.close()


@pytest.mark.parametrize(("height", "ground"), [(0.0, -0.2), (2.0, 0.0)])
def test_a_ground_lies_under_the_start_pose(height: float, ground: float) -> None:
    """At z = 0, or lower where the robot begins there."""
    text = f"""<mujoco><worldbody><body name="b" pos="0 0 {height}"><freejoint/>
        <geom type="capsule" size=".1 .1"/><geom pos="0 0 -9" size=".1" contype="0"
        conaffinity="0"/></body></worldbody></mujoco>"""
    model = read_model(text, ground=True)
    assert compiled(model).geom("ground").pos[2] == pytest.approx(ground, abs=1e-12)
    assert any(f"added at z = {ground:.4g} m" in note for note in model.notes)
    assert "ground.friction" in {row.name for row in model.parameters}
    with closing(sw.World(text, ground=True)) as world:
        world.rollout(None, seed=0, steps=100)
        world.reset(seed=0)
        for _ in range(100):
            world.step([])
        assert world["b.cartesian_position"][2] > ground


def test_what_bullet_cannot_honour_can_be_left_out() -> None:
    """The omission is listed, and its effect on MuJoCo is a difference from the file."""
    pytest.importorskip("pybullet")
    text = PENDULUM.replace("damping=", 'armature=".1" damping=')
    with pytest.raises(ModelError, match=r"armature of the joint 'hinge'.*leave it out by drop="):
        sw.World(text, backend="bullet").reset(seed=0)
    with closing(sw.World(text, backend="bullet", drop="armature")) as world:
        assert "drop='armature' leaves that out of: hinge." in world.task.system.notes
        found = world.fidelity()
        assert [*found.changes["what"][:2]] == ["engine", "parameters"]
        assert "hinge.armature" in found.changes["why"][1]
        assert 1e-4 < found.largest()[0] < 0.5
    model = read_model(text, drop=["armature", "equalities"])
    assert 1e-3 < fidelity(model).largest()[0] < 0.5
    assert any("leaves that out of: nothing" in note for note in model.notes)
    assert model != read_model(text)
    with pytest.raises(UnknownOption, match="armature, frictionloss, limits"):
        read_model(text, drop="inertia")


@pytest.mark.parametrize("option", [{"ground": True}, {"self_collision": False}])
def test_a_compiled_model_takes_no_new_bodies(option: dict[str, Any]) -> None:
    """The error says what to give instead."""
    with pytest.raises(UnknownOption, match="give its file or its MjSpec"):
        read_model(mujoco.MjModel.from_xml_string(PENDULUM), **option)


def test_only_files_have_a_fidelity() -> None:
    """A step function is compared with nothing."""
    world = sw.World(
        lambda parameters, state, action, noise: {"x": state["x"]},
        states=[sw.Measured(name="x", default=1.0, parents=("x",))],
        control_dt=0.1,
    )
    with closing(world), pytest.raises(ModelError, match="has no model file"):
        world.fidelity()


def test_the_command_line_takes_these_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It prints the notes and one line of fidelity on the error stream."""
    monkeypatch.chdir(tmp_path)
    Path("robot.xml").write_text(CROSSED)
    options = ("ground=true", "self_collision=false", "keyframe=home", "exact=false")
    words = [word for option in options for word in ("--option", option)]
    result = CliRunner().invoke(app, ["variables", "robot.xml", *words], catch_exceptions=False)
    assert result.exit_code == 0
    for line in ("note: self_collision=False leaves", "note: exact=False", "fidelity: up to 0 m"):
        assert line in result.stderr
    assert "ground.friction" in result.stdout
