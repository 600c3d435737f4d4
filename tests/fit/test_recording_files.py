"""Tables of text as loggers write them, and what a fit writes."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

import scm_world as sw
from scm_world.errors import ModelError, UnknownOption
from scm_world.fit.recordings import Reading, read_recording

PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
TABLE = pd.DataFrame(
    {
        "time": [0.0, 0.02, 0.04],
        "motor.control": [0.5, -0.25, 0.125],
        "hinge.position": [0.001, 1.5e-3, -0.25],
    }
)


@pytest.fixture(scope="module")
def world() -> sw.World:
    """A pendulum with a motor."""
    return sw.World(PENDULUM)


def with_commas(separator: str) -> str:
    """Return the table with decimal commas."""
    return TABLE.to_csv(index=False, sep=separator, decimal=",")


TEXTS = {
    "plain": TABLE.to_csv(index=False),
    "semicolons": TABLE.to_csv(index=False, sep=";"),
    "tabs": TABLE.to_csv(index=False, sep="\t"),
    "spaces": TABLE.to_string(index=False),
    "decimal commas": with_commas(";"),
    "decimal commas and tabs": with_commas("\t"),
    "comments": "% logger 3\n\n# begun\n"
    + TABLE.to_csv(index=False).replace("\n0.02", "\n# x\n0.02"),
    "a mark of the order of bytes": "\ufeff" + TABLE.to_csv(index=False),
    "names in a comment": "# arm 2\n# " + TABLE.to_csv(index=False),
    "separators at the ends of rows": "\n".join(
        line + ";" * bool(i) for i, line in enumerate(with_commas(";").splitlines())
    ),
    "names in a comment, exponents": "# time motor.control hinge.position\n"
    + "0e+00 0.5 1.0e-3\n0.02 -2.5e-01 1.5e-3\n0.04 nan -0.25\n# end of the run\n",
    "empty rows": TABLE.to_csv(index=False) + ",,\n",
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_tables_of_text(world: sw.World, tmp_path: Path, text: str) -> None:
    """The same numbers."""
    (tmp_path / "run.csv").write_text(text)
    (run,) = read_recording(world, tmp_path / "run.csv").runs
    np.testing.assert_array_equal(run.commands[:, 0], TABLE["motor.control"][:2])
    np.testing.assert_array_equal(run.values[:, 0], TABLE["hinge.position"])


SHIFTED = {
    "decimal commas between commas": (with_commas(","), "more or fewer cells"),
    "an empty cell between spaces": (
        TABLE.to_string(index=False).replace("-0.250", "      ", 1),
        "more or fewer cells",
    ),
    "separated thousands": (
        TABLE.to_csv(index=False, sep=";").replace("0.5", "1,500"),
        "has points, and others have decimal commas",
    ),
}


@pytest.mark.parametrize(("text", "said"), SHIFTED.values(), ids=SHIFTED)
def test_numbers_that_may_be_others_are_refused(
    world: sw.World, tmp_path: Path, text: str, said: str
) -> None:
    """No cell counts for its neighbour, and no thousand for one."""
    (tmp_path / "run.csv").write_text(text.replace('"', ""))
    with pytest.raises(ModelError, match=said):
        read_recording(world, tmp_path / "run.csv")


def test_columns_are_renamed_and_left_out(world: sw.World, tmp_path: Path) -> None:
    """In files, frames and arrays by name; a column that is not there is said."""
    other = TABLE.set_axis(["stamp", " torque", "q"], axis=1).assign(temp_1=20.0, note="a")
    other.to_csv(tmp_path / "run.csv", index=False)
    columns = {"stamp": "time", "torque": "motor.control", "q": "hinge.position"}
    how = Reading(None, columns, ["temp*", "note"])
    for given in (tmp_path / "run.csv", other, {n: other[n].to_numpy() for n in other}):
        (run,) = read_recording(world, given, how).runs
        np.testing.assert_array_equal(run.values[:, 0], TABLE["hinge.position"])
    runs = read_recording(world, [other, tmp_path / "run.csv"], how).runs
    assert len(runs) == 2
    with pytest.raises(UnknownOption, match="no column of the table is named 'speed'"):
        read_recording(world, other, Reading(None, {**columns, "speed": "hinge.velocity"}))
    with pytest.raises(ModelError, match=r"columns=\{'stamp': 'time'\}"):
        read_recording(world, other)


def test_names_and_set_ups_that_contradict_each_other_are_refused(world: sw.World) -> None:
    """Two columns of one name, two set-ups; episodes are renamed and left out as tables are."""
    twice = {name: TABLE[name].to_numpy() for name in TABLE} | {"q": np.ones(3)}
    with pytest.raises(ModelError, match="gives two columns one name"):
        read_recording(world, twice, Reading(None, {"q": "hinge.position"}))
    heavy = [TABLE.assign(**{"do.pole.mass": 0.4})]
    with pytest.raises(ModelError, match=r"pole\.mass is in the recording, and in its set-up"):
        read_recording(world, heavy, Reading([{"pole.mass": 0.5}]))
    episode = world.rollout(steps=5)
    seen = read_recording(world, episode, Reading(None, None, ["*.velocity"])).columns
    assert [column.name for column in seen] == ["hinge.position"]
    with pytest.raises(UnknownOption, match="no column of the table is named 'q'"):
        read_recording(world, episode, Reading(None, {"q": "hinge.position"}))


def test_clocks_that_are_no_multiple_of_the_physics_step_are_told_what_to_do() -> None:
    """The advice works: the damping of plain MuJoCo with that physics step is found."""
    odd = TABLE.assign(time=[0.0, 0.003334, 0.006668])
    with pytest.raises(ModelError, match=r"control_dt=0.003334 and timestep=0.001667"):
        read_recording(sw.World(PENDULUM), odd)
    with pytest.raises(UnknownOption, match=r"timestep=0\.001667"):
        sw.World(PENDULUM, control_dt=0.003334)
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    model.opt.timestep, model.dof_damping[0] = 0.001667, 0.02
    data, seen, sent = mujoco.MjData(model), list[float](), np.repeat([1.0, -1.0, 0.5, -0.5], 25)
    for command in sent:
        seen.append(float(data.qpos[0]))
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 2)
    with sw.World(PENDULUM, control_dt=0.003334, timestep=0.001667) as world:
        assert world.substeps == 2
        table = {"time": 0.003334 * np.arange(100), "motor.control": sent, "hinge.position": seen}
        fit = world.fit(table, ["hinge.damping"], noise=1e-4)
    assert fit.values["hinge.damping"] == pytest.approx(0.02, rel=1e-6)
    assert fit.squares < 1e-6
    with pytest.raises(UnknownOption, match="timestep"):
        sw.World(PENDULUM, timestep="fast")
