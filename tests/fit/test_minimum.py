"""A fit finds the minimum of least squares, and says what a recording leaves open."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from pendulum import PENDULUM
from scipy.stats import t as student

import scm_world as sw

NOISE = 1e-3  # [rad]
CART = """
<mujoco><option timestep="0.01" gravity="0 0 0"/>
  <worldbody><body name="cart">
    <joint name="slider" type="slide" axis="1 0 0" damping="0.5"/>
    <geom type="box" size="0.1 0.05 0.05" mass="1"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="slider" gear="8" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def pushed(commands: Any, force: float, stiffness: float) -> dict[str, Any]:
    """Return a recording of the cart by its formula: m v' = F + 8 u - k x - 0.5 v, with m = 1."""
    x, v, h, found = 0.2, 0.0, 0.01, [(0.2, 0.0)]
    for u in commands:
        for _ in range(4):
            v = (v + h * (force + 8.0 * u - stiffness * x)) / (1.0 + h * 0.5)
            x += h * v
            found.append((x, v))
    position, velocity = np.array(found)[::4].T
    names = ("time", "motor.control", "slider.position", "slider.velocity")
    time = 0.04 * np.arange(len(position))
    return dict(zip(names, (time, np.append(commands, np.nan), position, velocity), strict=True))


def test_a_parameter_that_is_zero_in_the_file_is_found_far_from_there() -> None:
    """A force of 7 N on a linear cart, without noise; a spring of 50 N/m is no stronger motor."""
    world = sw.World(CART, expose=["*", "*.external_force"], control_dt=0.04)
    fit = world.fit(pushed(-np.ones(25), 7.0, 0.0), ["cart.external_force[0]"])
    row = fit.table.iloc[0]
    assert row.value == pytest.approx(7.0, abs=1e-3)
    assert row.low < 7.0 + 1e-4
    assert row.high > 7.0 - 1e-4
    assert row.high - row.low < 0.01
    assert row.determined
    commands = np.random.default_rng(0).uniform(-1, 1, 25)
    causes = ["cart.external_force[0]", "slider.stiffness", "motor.gear", "cart.mass"]
    found = world.explain(pushed(commands, 0.0, 50.0), causes)
    assert found.best == ("slider.stiffness",)
    assert found.fit.values["slider.stiffness"] == pytest.approx(50.0, rel=1e-3)


def test_friction_that_is_zero_is_at_most_what_the_recording_allows() -> None:
    """The end of the interval is where another search, of plain MuJoCo, has 4 more squares."""
    from scipy.optimize import least_squares

    motor = PENDULUM.replace('damping="0.01"', 'damping="0.02" frictionloss="0.05"')
    world = sw.World(motor)
    names, noise = ["hinge.damping", "hinge.frictionloss"], {"hinge.position": 2e-3}
    do = {"hinge.frictionloss": 0.0, "hinge.damping": 0.05}
    episode = world.rollout("random", seed=1, steps=39, do=do)
    seen = episode["hinge.position"] + 2e-3 * np.random.default_rng(1).normal(size=40)
    recording = {"time": 0.02 * np.arange(40), "hinge.position": seen}
    recording["motor.control"] = episode.actions[:, 0]
    fit = world.fit(recording, names, noise=noise)
    rows = fit.table.set_index("parameter")
    assert rows.determined.all()
    assert rows.low["hinge.frictionloss"] == 0.0
    assert rows.high["hinge.frictionloss"] < 0.02
    assert "hinge.frictionloss is at most" in str(fit)
    assert not fit.confounded
    model = mujoco.MjModel.from_xml_string(motor)
    data = mujoco.MjData(model)

    def left(numbers: Any, friction: float) -> Any:
        model.dof_damping[0], model.dof_frictionloss[0] = abs(numbers[2]), friction
        mujoco.mj_resetData(model, data)
        data.qpos[0], data.qvel[0] = numbers[:2]
        values = [data.qpos[0]]
        for command in episode.actions[:, 0]:
            data.ctrl[0] = command
            mujoco.mj_step(model, data, round(0.02 / model.opt.timestep))
            values.append(data.qpos[0])
        return (seen - values) / 2e-3

    def squares(friction: float) -> float:
        return 2.0 * float(least_squares(left, (0.0, 0.0, 0.05), args=(friction,)).cost)

    more = squares(rows.high["hinge.frictionloss"]) - min(map(squares, (0.0, 1e-4, 1e-3)))
    assert more == pytest.approx(student.ppf(0.975, fit.degrees) ** 2 * fit.discount, rel=0.35)


SERVO = """
<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="arm">
    <joint name="j" axis="0 1 0" armature="0.005" frictionloss="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.01" mass="0.35"/>
  </body></worldbody>
  <actuator><general name="s" joint="j" ctrlrange="-2 2" dyntype="filter" dynprm="%g"
    gaintype="fixed" gainprm="%g" biastype="affine" biasprm="0 -%g -%g"/></actuator>
</mujoco>
"""


def test_a_fit_does_not_depend_on_the_file() -> None:
    """From defaults on both sides of the truth, a servo with a filter has the same values."""
    true = (0.05, 40, 40, 3)
    model, rng = mujoco.MjModel.from_xml_string(SERVO % true), np.random.default_rng(0)
    runs = []
    for target in (-0.6, 0.35):
        data, positions = mujoco.MjData(model), []
        for _ in range(50):
            positions.append(data.qpos[0])
            data.ctrl[0] = target
            mujoco.mj_step(model, data, 10)
        first = np.append(0.0, np.full(49, np.nan))  # it began at rest
        measured = {"s.activation": first, "j.velocity": first}
        measured["j.position"] = np.array(positions) + 5e-4 * rng.normal(size=50)
        runs.append({"time": 0.02 * np.arange(50), "s.control": np.full(50, target), **measured})
    noise = {"j.position": 5e-4, "s.activation": 1e-3, "j.velocity": 1e-3}
    tables = []
    for file in ((0.1, 25, 25, 5), true):
        fit = sw.World(SERVO % file).fit(runs, ["s.kp", "s.kv", "s.timeconst"], noise=noise)
        assert fit.explains
        tables.append(fit.table)
    one, other = tables
    width = one.high - one.low
    assert (abs(one.value - other.value) < 0.1 * width).all()
    assert (one.low < [40, 3, 0.05]).all()
    assert (one.high > [40, 3, 0.05]).all()


def test_limits_of_a_force_that_are_not_reached_are_bounded_on_one_side() -> None:
    """A trial that the world refuses is none; what was needed bounds the limit of the force."""
    world = sw.World(
        """<mujoco><worldbody><body name="arm"><joint name="j" axis="0 1 0" damping=".1"
        armature=".01"/><geom type="capsule" fromto="0 0 0 0 0 .001" size=".02" mass=".6"/></body>
        </worldbody><actuator><position name="s" joint="j" kp="30" kv="1" ctrlrange="-2 2"
        forcerange="-3 3"/></actuator></mujoco>""",
        expose=["*", "*.forcerange"],
    )
    commands = np.repeat(np.random.default_rng(1).uniform(-0.05, 0.05, 5), 6)[:, None]
    episode = world.rollout(commands, seed=1, steps=30, do={"s.forcerange": [-2.0, 2.0]})
    seen = episode["j.position"] + 1e-3 * np.random.default_rng(0).normal(size=31)
    recording = {"time": 0.02 * np.arange(31), "s.control": commands[:, 0], "j.position": seen}
    fit = world.fit(recording, ["s.forcerange", "s.kp"])
    low, high, kp = fit.table.itertuples()
    assert low.low == -np.inf
    assert -2.0 <= low.high < 0.0
    assert 0.0 < high.low <= 2.0
    assert high.high == np.inf
    assert (low.determined, high.determined, kp.determined) == (False, False, True)
    assert kp.low < 30.0 < kp.high
    one = world.fit(recording, ["s.forcerange"], symmetric=True)
    assert [*one.table.parameter] == ["s.forcerange"]
    assert max(-low.high, high.low) < one.table.low[0] < 2.0
    assert one.table.high[0] == np.inf
    strong = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 5), 6)[:, None]
    episode = world.rollout(strong, seed=1, steps=30, do={"s.forcerange": [-2.0, 2.0]})
    recording |= {"s.control": strong[:, 0], "j.position": episode["j.position"]}
    one = world.fit(recording, ["s.forcerange"], symmetric=True, noise=1e-3)
    assert one.values == pytest.approx({"s.forcerange": 2.0}, rel=1e-3)
    one.world.reset(seed=0)
    np.testing.assert_allclose(one.world["s.forcerange"], [-2.0, 2.0], rtol=1e-3)
    with pytest.raises(sw.errors.UnknownOption, match="symmetric"):
        world.fit(recording, ["s.kp"], symmetric=True)


def test_a_number_of_a_vector_deviates_alone() -> None:
    """Weaker gravity; its component along the hinge acts on nothing, in no experiment."""
    world = sw.World(PENDULUM)
    episode = world.rollout("random", seed=3, steps=60, do={"gravity": [0, 0, -8.0]})
    seen = episode["hinge.position"] + NOISE * np.random.default_rng(0).normal(size=61)
    recording = {"time": 0.02 * np.arange(61), "hinge.position": seen}
    recording["motor.control"] = episode.actions[:, 0]
    found = world.explain(recording, ["gravity", "pole.mass", "hinge.damping"], noise=NOISE)
    assert found.best == ("gravity",)
    row = found.table.iloc[0]
    assert row.number == "gravity[2]"
    assert row.value == pytest.approx(-8.0, abs=0.1)
    fit = world.fit(recording, ["gravity"], noise=NOISE)
    assert fit.unseen == ("gravity[1]",)
    rows = fit.table.set_index("parameter")
    assert np.isnan(rows.low["gravity[1]"])
    assert rows.determined.to_dict() == {f"gravity[{i}]": i != 1 for i in range(3)}
    assert "no experiment of this model seems to determine gravity[1]" in str(fit)
    assert "suggest" not in str(fit)
    (experiment,) = fit.suggest(1, steps=20)
    assert "no experiment seems to determine gravity[1]" in str(experiment)
    assert "gravity[1] 3" not in str(experiment)


ARM = """
<mujoco model="arm"><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 1 0" damping="0.09" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
    <body name="lower" pos="0 0 -0.3">
      <joint name="elbow" axis="0 1 0" damping="0.02" range="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/>
    </body>
  </body></worldbody>
  <actuator><motor name="one" joint="shoulder" gear="2" ctrlrange="-1 1"/>
    <motor name="two" joint="elbow" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def swung(rows: int, share: float, seed: int) -> dict[str, Any]:
    """Return a noisy recording of an arm that sticks, and bumps at 2°, by plain MuJoCo."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_frictionloss[0], model.body_mass[2] = 0.05, 0.45
    data, rng, found = mujoco.MjData(model), np.random.default_rng(seed), []
    commands = share * np.repeat(rng.uniform(-0.6, 0.6, (rows // 5 + 1, 2)), 5, axis=0)[:rows]
    for data.ctrl[:] in commands:
        found.append(data.qpos + NOISE * rng.normal(size=2))
        mujoco.mj_step(model, data, 10)
    names, joints = ("one.control", "two.control"), ("shoulder.position", "elbow.position")
    columns = dict(zip((*names, *joints), np.hstack([commands, found]).T, strict=True))
    return {"time": 0.02 * np.arange(len(commands)), **columns}


@pytest.mark.parametrize("seed", [3, 10])
def test_another_minimum_is_searched_where_a_joint_sticks_or_bumps(seed: int) -> None:
    """Minima with other impacts leave residuals that do not join, or that are correlated."""
    world = sw.World(ARM, control_dt=0.02).given({"lower.mass": 0.45})
    fit = world.fit(swung(60, 1.0, seed), ["elbow.damping", "shoulder.frictionloss"])
    table = fit.table.set_index("parameter")
    assert table.determined.all()
    assert table.value["shoulder.frictionloss"] == pytest.approx(0.05, rel=0.05)
    assert table.low["elbow.damping"] < 0.02 < table.high["elbow.damping"]
    assert table.value["elbow.damping"] == pytest.approx(0.02, rel=0.1)


def test_noise_of_what_hangs_still_determines_nothing() -> None:
    """A search finds an oscillation in it, which is no motion."""
    world = sw.World(ARM, control_dt=0.02)
    fit = world.fit(swung(50, 0.0, 7), ["lower.mass", "shoulder.frictionloss"])
    assert fit.still.all()
    assert not fit.table.determined.any()
    assert fit.table.low.isna().all()


WHEEL = """
<mujoco>
  <option integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="swing" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.2"/>
    </body>
    <body name="wheel" pos="2 0 0">
      <joint name="spin" axis="0 1 0" damping="0.5" frictionloss="0.1"/>
      <geom type="cylinder" size="0.1 0.01" mass="0.1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="swing" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def test_a_joint_that_sticks_does_not_say_how_much() -> None:
    """With little friction, start states fit its noise; what other joints show is determined."""
    model, rng, found = mujoco.MjModel.from_xml_string(WHEEL), np.random.default_rng(0), []
    data = mujoco.MjData(model)
    commands = np.repeat(rng.uniform(-1.0, 1.0, 20), 5)
    for data.ctrl[0] in commands:
        found.append(data.qpos + 2e-3 * rng.normal(size=2))
        mujoco.mj_step(model, data, 10)
    measured = dict(zip(("swing.position", "spin.position"), np.array(found).T, strict=True))
    recording = {"time": 0.02 * np.arange(100), "motor.control": commands, **measured}
    names = ["spin.frictionloss", "spin.damping", "swing.damping"]
    fit = sw.World(WHEEL, control_dt=0.02).fit(recording, names)
    assert fit.still.tolist() == [column.name == "spin.position" for column in fit.columns]
    table = fit.table.set_index("parameter")
    assert table.low[names[:2]].isna().all()
    assert table.determined["swing.damping"]
    assert table.value["swing.damping"] == pytest.approx(0.05, rel=0.01)
