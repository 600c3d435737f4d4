"""What a fit writes: the user's own file with other numbers, read again by plain MuJoCo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import scm_world as sw
from scm_world.cli.app import app
from scm_world.errors import ModelError, UnknownOption
from scm_world.variables import Derived

MODEL = """<mujoco model="pendulum">
  <!-- not this one: <joint name="hinge" damping="9"/> -->
  <default><joint armature="0.001"/></default>
  <worldbody>
    <body name="pole">  <!-- weighed twice -->
      <joint name="hinge" axis="0 1 0" damping = '0.01'/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
      <body name="weight" pos="0 0 -0.5">
        <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/> </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" gear="1 0 0" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
URDF = """<robot name="arm">
  <link name="base"/>
  <link name="pole">
    <!-- from the data sheet --> <inertial><origin xyz="0 0 -0.3"/><mass value="0.2"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/><child link="pole"/><axis xyz="0 1 0"/>
    <dynamics damping="0.01" friction="0"/>
  </joint>
</robot>
"""


def recorded(world: sw.World, do: dict[str, Any]) -> dict[str, Any]:
    """Return a recording without noise."""
    episode = world.rollout("random", seed=1, steps=40, do=do)
    names = [*world.compiled.actions]
    commands = {n: np.append(one, np.nan) for n, one in zip(names, episode.actions.T, strict=True)}
    found = {"time": 0.02 * np.arange(41), "hinge.position": episode["hinge.position"]}
    return found | commands


def test_the_own_file_has_the_fitted_numbers_and_its_comments(tmp_path: Path) -> None:
    """Plain MuJoCo reads them; all other numbers and lines stay."""
    source, target = tmp_path / "arm.xml", tmp_path / "fitted.xml"
    source.write_text(MODEL)
    world = sw.World(source)
    do = {"hinge.damping": 0.02, "motor.gear": 1.3}
    names = ["hinge.damping", "motor.gear", "hinge.armature", "pole.mass", "weight.mass"]
    names += ["gravity[2]"]
    fit = world.fit(recorded(world, do), names, noise=1e-3)
    fit.save(target)
    before, after = (mujoco.MjModel.from_xml_path(str(one)) for one in (source, target))
    value = fit.values
    assert after.dof_damping[0] == value["hinge.damping"]
    assert after.dof_armature[0] == value["hinge.armature"]
    assert after.actuator_gear[0].tolist() == [value["motor.gear"], 0, 0, 0, 0, 0]
    assert after.body_mass[1:].tolist() == [value["pole.mass"], value["weight.mass"]]
    assert after.opt.gravity.tolist() == [0.0, 0.0, value["gravity[2]"]]
    np.testing.assert_allclose(after.body_inertia, before.body_inertia, rtol=1e-12)
    np.testing.assert_allclose(after.body_ipos, before.body_ipos, rtol=1e-12)
    text = target.read_text()
    assert '<!-- not this one: <joint name="hinge" damping="9"/> -->' in text
    assert "<!-- weighed twice -->" in text
    assert len(text.splitlines()) == len(MODEL.splitlines())
    assert source.read_text() == MODEL
    assert sorted(one.name for one in tmp_path.iterdir()) == ["arm.xml", "fitted.xml"]
    fit.save(tmp_path / "fit.yaml")
    read = yaml.safe_load((tmp_path / "fit.yaml").read_text())
    row = fit.table.iloc[0]
    assert read["values"]["hinge.damping"]["value"] == row.value
    assert read["values"]["hinge.damping"]["high"] == pytest.approx(row.high, nan_ok=True)
    fit.save(tmp_path / "fit.html")
    page = (tmp_path / "fit.html").read_text()
    assert page.count("<table") == 3
    assert "hinge.armature" in page
    assert "data:image/png;base64," in page


def test_given_values_are_written_with_the_fitted_ones(tmp_path: Path) -> None:
    """The mass that was given is written, a delay is not; a sensor is named like the motor."""
    text = MODEL.replace(
        "<worldbody>", "<sensor><jointpos name='motor' joint='hinge'/></sensor><worldbody>"
    )
    world = sw.World(text).given({"pole.mass": 0.4, "hinge.position": 0.5})
    fit = world.fit(recorded(world, {"motor.gear": 1.3}), ["motor.gear"], noise=1e-3)
    fit.save(tmp_path / "arm.xml")
    plain = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    assert plain.body("pole").mass[0] == 0.4
    assert plain.actuator_gear[0, 0] == fit.values["motor.gear"]
    late = sw.World(MODEL, delay={"motor.control": sw.Box(0.0, 3.0)})
    names = ["motor.gear", "motor.control_delay"]
    fit = late.fit(recorded(late, {"motor.control_delay": 1.4, "motor.gear": 1.3}), names)
    fit.save(tmp_path / "late.xml")
    plain = mujoco.MjModel.from_xml_path(str(tmp_path / "late.xml"))
    assert plain.actuator_gear[0, 0] == fit.values["motor.gear"]
    (tmp_path / "trial-narrow.xml").write_text("of the user")
    narrow = sw.World(MODEL, expose=["pole.inertia"])
    fit = narrow.fit(recorded(narrow, {}), ["pole.inertia"], noise=1e-3)
    fit.save(tmp_path / "narrow.xml")
    assert (tmp_path / "trial-narrow.xml").read_text() == "of the user"
    plain = mujoco.MjModel.from_xml_path(str(tmp_path / "narrow.xml"))
    assert plain.body("pole").mass[0] == 0.2


def test_what_cannot_be_written_is_refused_and_nothing_is(tmp_path: Path) -> None:
    """An element without a name of its own in the file, another ending, no file."""
    text = MODEL.replace(' name="motor"', "")
    world = sw.World(text)
    name = next(n for n in world.compiled.static_names if n.endswith(".gear"))
    fit = world.fit(recorded(world, {name: 1.3}), [name], noise=1e-3)
    with pytest.raises(ModelError, match=rf"{name} cannot be written in this file"):
        fit.save(tmp_path / "arm.xml")
    with pytest.raises(UnknownOption, match=r"\.docx"):
        fit.save(tmp_path / "arm.docx")
    assert not [*tmp_path.iterdir()]


def test_a_urdf_is_written_by_the_command(tmp_path: Path, monkeypatch: Any) -> None:
    """Mass and damping; the world of the written file has them."""
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(URDF)
    world = sw.World("arm.urdf", fixed_base=True)
    start = {"hinge.position": 1.0, "hinge.damping": 0.03, "pole.mass": 0.3}
    found = recorded(world, start)
    import pandas as pd

    pd.DataFrame(found).to_csv("run.csv", index=False)
    words = ["fit", "arm.urdf", "run.csv", "--parameters", "hinge.damping", "--noise"]
    words += ["hinge.position=0.001", "--parameters", "pole.mass", "--out", "out"]
    words += ["--option", "fixed_base=true", "--save", "fitted.urdf", "--parameters", "delay"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "written: fitted.urdf, which has no delay" in done.output
    assert "<!-- from the data sheet -->" in Path("fitted.urdf").read_text()
    fitted = sw.World("fitted.urdf", fixed_base=True)
    fitted.reset(seed=0)
    assert float(fitted["hinge.damping"]) == pytest.approx(0.03, rel=1e-3)
    assert float(fitted["pole.mass"]) == pytest.approx(0.3, rel=1e-3)


def test_an_environment_starts_with_what_the_recording_leaves_open() -> None:
    """Draws have the mean and the covariance of the fit: a ridge of mass and gear stays one."""
    world = sw.World(MODEL)
    names = ["weight.mass", "motor.gear", "hinge.damping", "gravity[2]"]
    recording = recorded(world, {"hinge.damping": 0.02})
    fit = world.fit(recording, names, noise=1e-2)
    start = fit.posterior()
    assert [*start] == ["weight.mass", "motor.gear", "hinge.damping", "gravity"]
    drawn = []
    for seed in range(400):
        world.reset(seed=seed, do=start)
        values = [float(np.ravel(world[t.variable])[t.component]) for t in fit.targets]
        drawn.append([float(t.scaled(v)) for t, v in zip(fit.targets, values, strict=True)])
    assert float(world["gravity"][0]) == 0.0
    worlds = sw.World(MODEL, num_worlds=3)
    worlds.reset(seed=5, do=start)
    assert len({*np.ravel(worlds.values()["motor.gear"]).tolist()}) == 3
    errors = np.sqrt(np.diag(fit.spread))
    away = (np.array(drawn) - fit.scaled) / errors
    np.testing.assert_allclose(away.mean(axis=0), 0.0, atol=4 / 400**0.5)
    wanted = fit.spread / np.outer(errors, errors)
    np.testing.assert_allclose(np.cov(away.T), wanted, atol=6 / 400**0.5)
    assert np.abs(wanted - np.eye(4)).max() > 0.8
    import gymnasium

    env = gymnasium.make("scm_world/Model-v0", model=MODEL, start=start, reward="hinge.position")
    inner: Any = env.unwrapped
    gears = []
    for seed in (3, 4):
        env.reset(seed=seed)
        gears.append(float(inner.world["motor.gear"]))
    assert len({*gears, 1.0}) == 3
    env.close()


def written(text: str, names: list[str], do: dict[str, Any], path: Path, **options: Any) -> Any:
    """Return the values of a fit, and the file that it saves as plain MuJoCo reads it."""
    world = sw.World(text, **options)
    fit = world.fit(recorded(world, do), names, noise=1e-3)
    fit.save(path)
    return fit.values, mujoco.MjModel.from_xml_path(str(path))


SERVOS = {
    "position": ("2 0 0", "0 -2 -0.1", {"motor.kp": 3.0, "motor.kv": 0.15}),
    "velocity": ("2 0 0", "0 0 -2", {"motor.kv": 3.0}),
    "other": ("2 0 0", "0.1 -1 -0.2", {"motor.gain": 3.0, "motor.bias[1]": -1.5}),
}


@pytest.mark.parametrize("kind", SERVOS)
def test_gains_of_general_actuators_are_their_arrays(tmp_path: Path, kind: str) -> None:
    """Gain and bias are written where the element has them, or beside those of its class."""
    gain, bias, do = SERVOS[kind]
    own = f'biastype="affine" gainprm="{gain}" biasprm="{bias}"'
    motor = '<motor name="motor" joint="hinge" gear="1 0 0" ctrlrange="-1 1"/>'
    general = f'<general name="motor" joint="hinge" ctrlrange="-1 1" {own}/>'
    classes = f'<default class="servo"><general {own}/></default>'
    inherited = MODEL.replace('armature="0.001"/>', f'armature="0.001"/>{classes}')
    short = '<general name="motor" joint="hinge" ctrlrange="-1 1" class="servo"/>'
    expose = ["*", *(["motor.gain", "motor.bias"] if kind == "other" else [])]
    setting = {"motor.bias": [0.1, -1.5, -0.2]} if kind == "other" else {}
    setting |= {name: value for name, value in do.items() if "[" not in name}
    for text in (MODEL.replace(motor, general), inherited.replace(motor, short)):
        assert text.count("<general") == text.count("affine") + text.count('class="servo"/>')
        value, after = written(text, [*do], setting, tmp_path / "arm.xml", expose=expose)
        found_gain, found_bias = after.actuator_gainprm[0, :3], after.actuator_biasprm[0, :3]
        if kind == "position":
            assert found_gain.tolist() == [value["motor.kp"], 0.0, 0.0]
            assert found_bias.tolist() == [0.0, -value["motor.kp"], -value["motor.kv"]]
        elif kind == "velocity":
            assert found_gain.tolist() == [value["motor.kv"], 0.0, 0.0]
            assert found_bias.tolist() == [0.0, 0.0, -value["motor.kv"]]
        else:
            assert found_gain.tolist() == [value["motor.gain"], 0.0, 0.0]
            assert found_bias.tolist() == [0.1, value["motor.bias[1]"], -0.2]
        for name, wanted in do.items():
            assert value[name] == pytest.approx(wanted, rel=1e-3)


@pytest.mark.parametrize("angle", ["", 'angle="degree"', 'angle="radian"'])
def test_angles_are_written_in_the_unit_of_the_compiler(tmp_path: Path, angle: str) -> None:
    """Where a spring rests, and the ends of a range: degrees, unless the compiler says radians."""
    low, high, rest = (-20.0, 15.0, 5.0) if "radian" not in angle else (-0.4, 0.3, 0.1)
    own = f'name="hinge" limited="true" range="{low} {high}" stiffness="1" springref="{rest}"'
    text = MODEL.replace('name="hinge" axis', f"{own} axis")
    text = text.replace("<default>", f"<compiler {angle}/><default>") if angle else text
    before = mujoco.MjModel.from_xml_string(text)
    do = {"hinge.springref": 0.3, "hinge.position": -0.3}
    names = ["hinge.springref", "hinge.range[1]"]
    value, after = written(text, names, do, tmp_path / "arm.xml", expose=["*", "hinge.range"])
    assert after.qpos_spring[0] == pytest.approx(value["hinge.springref"], rel=1e-12)
    assert after.jnt_range[0, 1] == pytest.approx(value["hinge.range[1]"], rel=1e-12)
    assert after.jnt_range[0, 0] == pytest.approx(before.jnt_range[0, 0], rel=1e-12)
    assert value["hinge.springref"] == pytest.approx(0.3, rel=0.02)
    assert after.qpos_spring[0] != pytest.approx(before.qpos_spring[0], rel=1e-3)


def test_a_full_inertia_becomes_its_principal_moments(tmp_path: Path) -> None:
    """With the axes that MuJoCo found; the mass alone leaves it as it is. So does a class."""
    whole = '<inertial pos="0 0.1 -0.3" mass="0.2" fullinertia=".01 .011 .003 .001 0 .0005"/>'
    text = MODEL.replace('<body name="pole">', f'<body name="pole">{whole}')
    before = mujoco.MjModel.from_xml_string(text)
    path = tmp_path / "arm.xml"
    value, after = written(text, ["pole.mass"], {"pole.mass": 0.3}, path)
    assert after.body("pole").mass[0] == value["pole.mass"]
    np.testing.assert_array_equal(after.body("pole").inertia, before.body("pole").inertia)
    assert "fullinertia" in path.read_text()
    expose = ["*", "pole.inertia", "pole.center_of_mass"]
    usual = before.body("pole").inertia
    do = {"pole.inertia": 1.5 * usual, "pole.center_of_mass": [0.0, 0.1, -0.35]}
    names = ["pole.inertia", "pole.center_of_mass[2]"]
    value, after = written(text, names, do, path, expose=expose)
    scale = value["pole.inertia"] / usual.max()
    np.testing.assert_allclose(after.body("pole").inertia, scale * usual, rtol=1e-9)
    np.testing.assert_allclose(after.body("pole").iquat, before.body("pole").iquat, atol=1e-12)
    assert after.body("pole").ipos.tolist() == [0.0, 0.1, value["pole.center_of_mass[2]"]]


def test_elements_override_their_default_class(tmp_path: Path) -> None:
    """Those that have a number of their own, and those that get one; the class stays."""
    classes = '<default class="soft"><joint damping="0.5" frictionloss="0.01"/></default>'
    text = MODEL.replace('armature="0.001"/>', f'armature="0.001"/>{classes}')
    text = text.replace('name="hinge"', 'name="hinge" class="soft"')
    names, do = ["hinge.damping", "hinge.frictionloss"], {"hinge.frictionloss": 0.02}
    value, after = written(text, names, do, tmp_path / "arm.xml")
    assert after.dof_damping[0] == value["hinge.damping"]
    assert after.dof_frictionloss[0] == value["hinge.frictionloss"]
    assert classes in (tmp_path / "arm.xml").read_text()


def test_variables_of_ties_are_refused(tmp_path: Path) -> None:
    """A model file does not have them."""

    def weighed(density: float) -> float:
        return 0.001 * density

    density = sw.Exogenous(name="density", default=200.0, bounds=sw.Box(10.0, 1000.0))
    mass = Derived(name="pole.mass", parents=("density",), mechanism=weighed)
    world = sw.World(MODEL, ties=[density, mass], expose=["*", "density"])
    fit = world.fit(recorded(world, {"density": 300.0}), ["density"], noise=1e-3)
    with pytest.raises(ModelError, match=r"density are variables of ties=.*save values as \.yaml"):
        fit.save(tmp_path / "arm.xml")
    assert not [*tmp_path.iterdir()]
