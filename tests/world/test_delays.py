"""Delays of commands and sensors end within a control step, at their time."""

from math import ceil, floor
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest

import scm_world as sw
from scm_world._types import Floats
from scm_world.backends import make_backend, register
from scm_world.backends.base import BackendWrapper
from scm_world.errors import EngineFailure, OutOfBounds, UnknownOption
from scm_world.variables import Box, Draw, Integers

STEPS, SUBSTEPS = 30, 10
ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="j" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="0.6"/>
      <site name="tip" pos="0.4 0 0"/>
    </body>
  </worldbody>
  <actuator><position name="s" joint="j" kp="30" kv="1" ctrlrange="-2 2"/></actuator>
  <sensor><gyro name="gyro" site="tip"/></sensor>
</mujoco>
"""
COMMANDS = np.random.default_rng(0).uniform(-1.0, 1.0, STEPS)


def plain(delay: float, commands: Floats = COMMANDS) -> tuple[Floats, Floats]:
    """Step MuJoCo by hand; return position and velocity after each physics step."""

    def command(time: float) -> float:  # [physics steps]
        step = floor((time - delay) / SUBSTEPS + 1e-9)
        return float(commands[step]) if step >= 0 else 0.0

    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    seen = [(data.qpos[0], data.qvel[0])]
    for step in range(STEPS * SUBSTEPS):
        share = ceil(step - delay - 1e-9) - (step - delay)  # of the physics step, until it changes
        now, then = command(step), command(step + max(share, 0.0))
        data.ctrl[0] = then + share * (now - then) if now != then else now
        mujoco.mj_step(model, data)
        seen.append((data.qpos[0], data.qvel[0]))
    position, velocity = np.array(seen).T
    return position, velocity


@pytest.mark.parametrize("delay", [14, 4, 20, 14.5, 0.25])
def test_a_delayed_command_is_that_of_plain_mujoco(delay: float) -> None:
    """The control is changed between two physics steps: the same bits, alone and in a batch."""
    wanted, _ = plain(delay)
    options: dict[str, Any] = {"control_dt": 0.02, "delay": {"s.control": delay / SUBSTEPS}}
    with sw.World(ARM, **options) as alone, sw.World(ARM, num_worlds=2, **options) as together:
        alone.reset(seed=0)
        together.reset(seed=0)
        for step, command in enumerate(COMMANDS, 1):
            alone.step([command])
            together.step(np.full((2, 1), command))
            assert alone["j.position"] == wanted[step * SUBSTEPS]
            assert (together["j.position"] == wanted[step * SUBSTEPS]).all()


@pytest.mark.parametrize("late", [1.4, 0.4, 0.45, 1.0, 2.37])
@pytest.mark.parametrize("delay", [14, 0])
def test_a_sensor_reads_the_physics_step_of_its_delay(delay: float, late: float) -> None:
    """Between two physics steps it reads a value on a straight line, also of a readout."""
    fine, instants = plain(delay), (np.arange(STEPS + 1) - late) * SUBSTEPS
    position, velocity = (np.interp(instants, np.arange(len(one)), one) for one in fine)
    delays = {"s.control": delay / SUBSTEPS, "j.position": float(late), "gyro.value": float(late)}
    options: dict[str, Any] = {"control_dt": 0.02, "outcomes": ["gyro.value"], "delay": delays}
    with sw.World(ARM, **options) as alone, sw.World(ARM, num_worlds=2, **options) as together:
        alone.reset(seed=0)
        together.reset(seed=0)
        first = ceil(late)
        for step in range(STEPS + 1):
            if step >= first:
                read = alone["j.position_reading"], alone["gyro.value_reading"][1]
                assert read == pytest.approx((position[step], velocity[step]), abs=1e-12)
            for name in ("j.position_reading", "gyro.value_reading"):
                assert (together[name] == alone[name]).all()
            if step < STEPS:
                alone.step([COMMANDS[step]])
                together.step(np.full((2, 1), COMMANDS[step]))


@pytest.fixture(params=["mujoco", "bullet"])
def backend(request: pytest.FixtureRequest) -> str:
    """Name each engine."""
    if request.param == "bullet":
        pytest.importorskip("pybullet")
    return str(request.param)


DRAWN = {"s.control": Box(0.2, 1.7), "j.velocity": Box(0.5, 2.5)}


def test_each_world_of_a_batch_has_its_own_delay(backend: str) -> None:
    """They are drawn, set in the middle of an episode, and counted back, bit for bit."""
    options: dict[str, Any] = {"backend": backend, "control_dt": 0.02, "delay": DRAWN}
    later = {"s.control_delay": 0.65, "j.velocity_delay": 0.5}
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (12, 3, 1))
    with sw.World(ARM, **options) as alone, sw.World(ARM, num_worlds=3, **options) as together:
        together.reset(seed=5)
        assert len({*together["s.control_delay"]}) == 3
        for index, step in enumerate(actions):
            if index == 7:
                together.do(later, where=np.array([True, False, True]))
            together.step(step)
        for row in range(3):
            alone.reset(seed=5 + row)
            for index, step in enumerate(actions[:, row]):
                if index == 7 and row != 1:
                    alone.do(later)
                alone.step(step)
            now = alone.values()
            assert all(now[name].tobytes() == together[name][row].tobytes() for name in now)
        episode = alone.rollout("random", seed=2, steps=8, do={"s.control_delay": Draw(0.3, 0.9)})
        assert episode.counterfactual({}) == episode
        with pytest.raises(OutOfBounds):
            alone.do({"s.control_delay": 1.8})


def test_the_graph_of_delays_with_fractions_is_what_the_engine_does(backend: str) -> None:
    """What is read within a control step follows what moves in that step."""
    options = {"backend": backend, "control_dt": 0.02, "noise": {"*.control": 0.05}}
    with sw.World(ARM, delay=DRAWN, expose=["arm.mass"], **options) as world:
        parents = {(p.name, p.lag) for p in world.model.declared("j.velocity_past").parents}
        assert {("s.control", 1), ("j.velocity_delay", 1), ("j.position", 1)} <= parents
        assert sw.verify(world, probes=6).undeclared == ()


def test_several_commands_have_a_delay_each() -> None:
    """Each command is that of the model with this delay alone."""
    two = ARM.replace("</actuator>", '<motor name="m" joint="j" ctrlrange="-2 2"/></actuator>')
    actions = np.stack([COMMANDS[:8], COMMANDS[8:16]], axis=1)

    def moved(delay: dict[str, float], sent: Floats) -> Floats:
        with sw.World(two, control_dt=0.002, delay=delay) as world:
            world.reset(seed=0)
            return np.array([(world.step(one), world["j.position"])[1] for one in sent])

    fine = np.repeat(actions, SUBSTEPS, axis=0)
    late = {"s.control": 0.3, "m.control": 1.7}
    wanted = moved({name: SUBSTEPS * value for name, value in late.items()}, fine)[9::10]
    with sw.World(two, control_dt=0.02, delay=late) as world:
        world.reset(seed=0)
        found = [(world.step(one), world["j.position"])[1] for one in actions]
    assert np.allclose(found, wanted, rtol=0, atol=1e-13)


@register
class Tired(BackendWrapper):
    """MuJoCo, which refuses some steps."""

    name = "tired"
    refused: ClassVar[tuple[int, ...]] = ()
    calls: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__(make_backend("mujoco"))

    def step(self, command: Floats, substeps: int) -> None:
        """Refuse it, or let MuJoCo take it."""
        Tired.calls += 1
        if Tired.calls in Tired.refused:
            raise EngineFailure("it is tired", self.name)
        super().step(command, substeps)


def test_a_control_step_of_one_physics_step_is_not_divided() -> None:
    """A delay that ends within it is the mean of both commands."""
    noise, seen = {"s.control": 0.01}, []
    for delay, sent in (
        (1.25, COMMANDS),
        (1, 0.75 * COMMANDS + 0.25 * np.append(0, COMMANDS[:-1])),
    ):
        with sw.World(ARM, control_dt=0.002, delay={"s.control": delay}, noise=noise) as world:
            seen.append(world.rollout(sent[:, None], seed=0, steps=STEPS)["j.position"])
            assert sw.verify(world, probes=4).undeclared == ()
    assert np.allclose(*seen, rtol=0.0, atol=1e-15)


def test_a_world_whose_control_step_ends_half_way_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """An engine that refuses the second part of a control step has moved already."""
    options: dict[str, Any] = {"backend": "tired", "delay": {"s.control": 0.5}}
    monkeypatch.setattr(Tired, "refused", (4,))
    with sw.World(ARM, control_dt=0.02, **options) as world:
        world.reset(seed=0)
        monkeypatch.setattr(Tired, "calls", 0)
        world.step([1.0])  # two parts
        with pytest.raises(EngineFailure, match="lost in control step 1"):
            world.step([0.5])
    with sw.World(ARM, control_dt=0.02, num_worlds=2, **options) as together:
        together.reset(seed=0)
        monkeypatch.setattr(Tired, "calls", 1)  # both take the first part, one of them the other
        with pytest.raises(EngineFailure, match="tired") as failed:
            together.step([[1.0], [1.0]])
        assert failed.value.lost == (0,)
        with sw.World(ARM, control_dt=0.02, delay={"s.control": 0.5}) as sound:
            sound.reset(seed=0)
            sound.step([1.0])
            assert together["j.position"][1] == sound["j.position"]


@pytest.mark.parametrize(
    "delay", [Box(-0.5, 1.0), Box((0.0, 1.0), (1.0, 2.0)), Integers(-1, 2), np.inf, True, "1"]
)
def test_a_delay_is_a_number_or_a_space_of_numbers(delay: Any) -> None:
    """The error says what is allowed."""
    for name in ("s.control", "j.position"):
        with pytest.raises(UnknownOption, match=r"a number of control steps, 0 or more"):
            sw.World(ARM, delay={name: delay})
