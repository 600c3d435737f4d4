"""Factors of mass and inertia, pushes, and delays and noise of actuators and sensors."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import scm_world as sw
from scm_world.errors import OutOfBounds, UnknownOption
from scm_world.testing.model import trajectory
from scm_world.variables import Box, Draw, Integers, Natural, Parent, Scale

SCENE = """
<mujoco model="scene">
  <option timestep="0.01"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="crate" pos="0 0 1">
      <freejoint/><geom name="crate_shape" type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
    <body name="arm" pos="1 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
ARM = """
<mujoco model="arm">
  <option timestep="0.01"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      <site name="tip" pos="0.3 0 0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor><gyro name="gyro" site="tip"/></sensor>
</mujoco>
"""
PUSHED = {"expose": ["*", "*.scale", "*.external_force", "*.external_torque"]}
LATE = {
    "outcomes": ["gyro.value"],
    "noise": {"*.control": 0.05, "hinge.*": 0.01, "gyro.value": 0.1},
    "delay": {"*.control": 2, "hinge.position": Integers(0, 3), "gyro.value": 1},
}


@pytest.fixture(params=["mujoco", "bullet"])
def backend(request: pytest.FixtureRequest) -> str:
    """Name each engine."""
    if request.param == "bullet":
        pytest.importorskip("pybullet")
    return str(request.param)


def test_a_factor_scales_mass_and_inertia_together(backend: str) -> None:
    """``do`` of the mass cuts it from the factor; all of it is undone without a trace."""
    with sw.World(SCENE, backend=backend, **PUSHED) as world:
        world.reset(seed=0)
        before, start = world.values(), world.vector.copy()
        assert world.model.parents("crate.mass") == ("crate.scale",)
        world.do({"crate.scale": 2.0})
        assert world["crate.mass"] == 2.0
        assert (world["crate.inertia"] == 2.0 * before["crate.inertia"]).all()
        world.do({"crate.mass": 3.0, "crate.scale": 4.0})
        assert world["crate.mass"] == 3.0
        assert (world["crate.inertia"] == 4.0 * before["crate.inertia"]).all()
        world.do({"crate.mass": Natural()})
        assert world["crate.mass"] == 4.0
        world.do({"crate.scale": Natural()})
        after = world.values()
        assert all(before[name].tobytes() == after[name].tobytes() for name in before)
        assert world.vector.tobytes() == start.tobytes()
        world.reset(seed=0, do={"*.scale": Scale(Draw(0.5, 2.0))})
        assert world["crate.mass"] == world["crate.scale"] != world["arm.scale"]
    with sw.World(SCENE, expose="*.scale") as world:
        assert {"crate.mass", "crate.inertia", "arm.mass"} <= {*world.model}
    with pytest.raises(UnknownOption, match=r"follows crate\.scale"):
        sw.World(SCENE, **PUSHED, spaces={"crate.mass": {"distribution": (1.0, 2.0)}})


def test_a_push_for_a_window_has_the_momentum_of_its_force(backend: str) -> None:
    """Force times time over mass is the change of velocity; counterfactuals are exact."""
    push = {"crate.external_force": sw.Hard([2.0, 0.0, 9.81], during=(3, 8))}
    with sw.World(SCENE, backend=backend, **PUSHED) as world:
        still, pushed = (world.rollout(None, seed=0, steps=12, do=do) for do in ({}, push))
        change = pushed["crate.linear_velocity"][-1] - still["crate.linear_velocity"][-1]
        assert np.allclose(change, np.array([2.0, 0.0, 9.81]) * 5 * 0.02 / 1.0, atol=1e-9)
        assert (pushed["crate.linear_velocity"][:4] == still["crate.linear_velocity"][:4]).all()
        assert pushed.counterfactual({}) == pushed
        other = pushed.counterfactual({"crate.external_force": [0.0, 0.0, 0.0]}, at=3)
        assert (other["crate.linear_velocity"] == still["crate.linear_velocity"]).all()
        turned = world.rollout(None, seed=0, steps=5, do={"arm.external_torque": [0, 0.1, 0]})
        assert turned["hinge.velocity"][-1] > world.rollout(None, steps=5)["hinge.velocity"][-1]
        drawn = {"*.external_force": Draw(Box((-5, -5, 0), (5, 5, 0)), every=4)}
        episode = world.rollout("random", seed=2, steps=9, do=drawn)
        assert len({*episode["crate.external_force"][:, 0]}) == 3
        assert episode.counterfactual({}) == episode


def test_commands_and_readings_are_late_and_noisy(backend: str) -> None:
    """They are what their equations say, in an episode and its counterfactuals."""
    with sw.World(ARM, backend=backend, **LATE) as world:
        episode = world.rollout("random", seed=3, steps=10)
        sent, past = episode["motor.control"], episode["motor.control_past"]
        assert (past[1:, 0] == sent[:-1]).all()
        assert (past[2:, 1] == sent[:-2]).all()
        assert (past[0] == 0.0).all()
        delay = int(episode["hinge.position_delay"][0])
        assert delay > 0
        true, error = episode["hinge.position"], episode["hinge.position_error"]
        late = true[np.maximum(np.arange(11) - delay, 0)]
        assert (episode["hinge.position_reading"] == late + 0.01 * error).all()
        assert len({*error}) == 11
        assert abs(error.mean()) < 1.0
        gyro = episode["gyro.value"][np.maximum(np.arange(11) - 1, 0)]
        read = gyro + 0.1 * episode["gyro.value_error"]
        assert np.allclose(episode["gyro.value_reading"], read, rtol=0, atol=1e-15)
        assert episode.counterfactual({}) == episode
        other = episode.counterfactual({"arm.mass": 2.0, "motor.control_noise": 0.0}, at=4)
        assert (other["hinge.position_error"] == error).all()
        assert (other["hinge.position"][:5] == true[:5]).all()
        assert other["hinge.position"][-1] != true[-1]
        quick = episode.counterfactual({"motor.control_delay": 1})
        assert (quick["motor.control_past"] == past).all()
        assert (quick["hinge.velocity"][1:] != episode["hinge.velocity"][1:]).any()


def test_a_delayed_command_is_that_of_some_steps_before() -> None:
    """Without noise, the episode is that of the undelayed model under shifted commands."""
    commands = np.linspace(-1.0, 1.0, 8)[:, None]
    with sw.World(ARM) as plain, sw.World(ARM, delay={"motor.control": 3}) as late:
        late.reset(seed=0)
        found = trajectory(late, commands)[:, : plain.vector.size]
        plain.reset(seed=0)
        wanted = trajectory(plain, np.concatenate([np.zeros((3, 1)), commands[:-3]]))
        assert (found == wanted).all()
        assert "hinge.velocity" not in late.graph.children("motor.control")
    with sw.World(ARM, delay={"motor.control": Integers(0, 2)}) as drawn:
        assert {"motor.control", "motor.control_delay"} <= {*drawn.graph.parents("hinge.velocity")}
        found = []
        for episode in range(12):
            drawn.reset(seed=0, episode=episode)
            found.append(int(drawn["motor.control_delay"]))
        assert {*found} == {0, 1, 2}
        drawn.reset(seed=0, do={"motor.control_delay": 0})
        drawn.step([1.0])
        plain_velocity = drawn["hinge.velocity"]
        drawn.reset(seed=0, do={"motor.control_delay": 1})
        drawn.step([1.0])
        assert drawn["hinge.velocity"] != plain_velocity


def test_batches_and_snapshots_keep_what_is_held(backend: str) -> None:
    """Worlds that are stepped together have the bits of worlds that are stepped alone."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 3, 1))
    with (
        sw.World(ARM, backend=backend, **LATE) as alone,
        sw.World(ARM, backend=backend, num_worlds=3, **LATE) as together,
    ):
        together.reset(seed=5)
        for step in actions:
            together.step(step)
        for row in range(3):
            alone.reset(seed=5 + row)
            for index, step in enumerate(actions[:, row]):
                if index == 3:
                    kept = alone.snapshot()
                alone.step(step)
            now = alone.values()
            assert all(now[name].tobytes() == together[name][row].tobytes() for name in now)
            alone.restore(kept)
            for step in actions[3:, row]:
                alone.step(step)
            assert all(now[name].tobytes() == alone[name].tobytes() for name in now)
        alone.do({"motor.control_past": [0.5, -0.5], "hinge.position_error": 2.0})
        assert alone["hinge.position_error"] == 2.0
        alone.do({"motor.control_past": Natural(), "hinge.position_error": Natural()})
        assert alone.vector.tobytes() == together.world(2).vector.tobytes()


def test_the_graph_of_delays_noise_and_pushes_is_what_the_engine_does(backend: str) -> None:
    """No effect without an edge, and no edge without an effect."""
    options = LATE | {"delay": LATE["delay"] | {"*.control": Integers(0, 1)}}
    own = {**options, "expose": ["arm.mass", "arm.scale", "arm.external_torque"]}
    with sw.World(ARM, backend=backend, **own) as world:
        assert Parent("motor.control", 1) in world.model.declared("motor.control_past").parents
        found = sw.verify(world, probes=10)
    assert not found.undeclared, str(found)
    # A gyroscope about the axis of a hinge does not see its angle.
    assert {edge.cause for edge in found.unseen} <= {"hinge.position"}, str(found)


def fast(speed: float) -> float:
    """Reward speed."""
    return float(speed)


def test_environments_observe_readings() -> None:
    """A policy is given what sensors read; one seed gives one episode."""
    env = gymnasium.make("scm_world/Model-v0", model=ARM, reward=(fast, "hinge.velocity"), **LATE)
    names = [*env.unwrapped.layout]
    assert "hinge.position_reading" in names
    assert "hinge.position" not in names
    assert not any(name.endswith(("_past", "_error")) for name in names)
    first = [env.reset(seed=1)[0], *(env.step(np.ones(1, np.float32))[0] for _ in range(4))]
    again = [env.reset(seed=1)[0], *(env.step(np.ones(1, np.float32))[0] for _ in range(4))]
    assert np.array_equal(first, again)
    env.close()


TURN = {"outcomes": ["tip.orientation"]}


@pytest.mark.parametrize(
    ("option", "error", "said"),
    [
        ({"noise": {"*.contrl": 0.1}}, UnknownOption, "did you mean"),
        ({"noise": {"hinge.positio": 0.1}}, UnknownOption, "did you mean 'hinge.position'"),
        ({"noise": {"hinge.position": -0.1}}, UnknownOption, "not below 0"),
        ({"noise": {"tip.orientation": 0.1}, **TURN}, UnknownOption, "quaternions"),
        ({"delay": {"*.control": -1}}, UnknownOption, "0 or more"),
        ({"delay": 2}, UnknownOption, "a dictionary by name"),
    ],
)
def test_wrong_options_are_refused(
    option: dict[str, Any], error: type[Exception], said: str
) -> None:
    """Each error says what is allowed."""
    with pytest.raises(error, match=said):
        sw.World(ARM, **option)


def test_noise_of_commands_alone_remembers_nothing() -> None:
    """There is one more variable for each command; what is drawn is new in every step."""
    with sw.World(ARM, noise={"*.control": 0.1}) as world, sw.World(ARM) as plain:
        assert {*world.model} - {*plain.model} == {"motor.control_noise"}
        episode = world.rollout(None, seed=0, steps=4)
        assert len({*np.diff(episode["hinge.velocity"])}) == 4
        assert episode.counterfactual({}) == episode
        assert (
            world.rollout(None, seed=0, steps=4, do={"*_noise": 0.0})["hinge.velocity"][1]
            == (plain.rollout(None, seed=0, steps=4)["hinge.velocity"][1])
        )


def test_a_delay_stays_within_what_is_remembered() -> None:
    """Longer delays are refused."""
    with sw.World(ARM, delay={"motor.control": 2}) as world:
        world.reset(seed=0)
        with pytest.raises(OutOfBounds, match="1"):
            world.do({"motor.control_delay": 0})


def test_no_delay_is_no_channel() -> None:
    """A sweep over delays may begin with 0: the model is that without the option."""
    with sw.World(ARM, delay={"*.control": 0}) as none, sw.World(ARM) as plain:
        assert list(none.model.variables) == list(plain.model.variables)


def test_sensors_err_from_the_first_instant_on_in_rows_too() -> None:
    """The error at the beginning of an episode is drawn in many worlds as in one."""
    with sw.World(ARM, **LATE) as one, sw.World(ARM, num_worlds=3, **LATE) as many:
        for number in range(2):  # scenes are built, then begun again
            many.reset(seed=5, episode=number)
            for row in range(3):
                one.reset(seed=5 + row, episode=number)
                for name, values in many.values().items():
                    np.testing.assert_array_equal(values[row], one[name], err_msg=name)
            assert (many["hinge.velocity_error"] != 0.0).all()
