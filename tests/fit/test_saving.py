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
