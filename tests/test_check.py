"""``check`` finds every planted fault, and invents none in honest environments."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

import scm_world as sw
from scm_world import variables
from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.backends.mujoco.realization import Realization
from scm_world.cli.app import app
from scm_world.env import Check, Checkable, vector_env
from scm_world.env.answers import QUESTIONS
from scm_world.env.checks import check
from scm_world.env.ours import OurWorlds
from scm_world.errors import ScmWorldError, UnknownOption

MASS = {"mass": (0.5, 2.0)}


class Pendulums(Checkable):
    """Tensors of n pendulums, which a learner writes for itself: states and parameters by row."""

    n_actions = 1

    def __init__(self, n: int = 3) -> None:
        self.num_envs = n
        self.values = {name: np.ones(n) for name in ("mass", "damping", "length")}
        self.state, self.rngs = np.zeros((n, 2)), [np.random.default_rng(i) for i in range(n)]

    def get(self, name: str) -> Any:
        """Return a parameter."""
        return self.values[name]

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        self.values[name][mask] = values[mask]

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        for row in np.flatnonzero(mask):
            self.rngs[row] = np.random.default_rng(seed + row)
            self.state[row] = self.rngs[row].normal(size=2)

    def step(self, actions: Any) -> None:
        """Advance all worlds."""
        angle, speed = self.state.T
        torque = actions[:, 0] - self.values["damping"] * speed
        noise = np.array([rng.normal() for rng in self.rngs])
        speed = speed + 0.05 * (
            torque / self.values["mass"] - 9.81 * np.sin(angle) / self.values["length"] + noise
        )
        self.state = np.stack([angle + 0.05 * speed, speed], axis=1)

    def observe(self) -> Any:
        """Return angles and speeds."""
        return self.state

    def columns(self) -> list[tuple[str, str]]:
        """Name them."""
        return [("angle", "rad"), ("speed", "rad/s")]


class NoEffect(Pendulums):
    """The parameter is written, and the physics has a number of its own."""

    def step(self, actions: Any) -> None:
        """Advance all worlds."""
        kept, self.values["mass"] = self.values["mass"], np.ones(self.num_envs)
        super().step(actions)
        self.values["mass"] = kept


class NotWritten(Pendulums):
    """Nothing is written."""

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""


class OnNeighbours(Pendulums):
    """A view of one row is written to all of them."""

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        self.values[name][:] = values[mask][0]


class NeighboursMove(Pendulums):
    """Values are kept apart, and one quantity of the physics is that of all worlds together."""

    def step(self, actions: Any) -> None:
        """Advance all worlds."""
        super().step(actions)
        self.state[:, 1] -= 1e-6 * self.values["mass"].mean() * self.state[:, 1]


class Accumulates(Pendulums):
    """The value is multiplied, by the one that the last episode left."""

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        self.values[name][mask] *= values[mask]


class AccumulatesInside(Pendulums):
    """What follows from the value is added to, again and again."""

    def __init__(self, n: int = 3) -> None:
        super().__init__(n)
        self.inertia = np.ones(n)

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        self.inertia[mask] *= values[mask] / self.values[name][mask] * (1.0 + 1e-9)
        super().set(name, values, mask)

    def step(self, actions: Any) -> None:
        """Advance all worlds."""
        kept, self.values["mass"] = self.values["mass"], self.inertia
        super().step(actions)
        self.values["mass"] = kept


class Later(Pendulums):
    """The engine takes values over when an episode begins."""

    def __init__(self, n: int = 3) -> None:
        super().__init__(n)
        self.pending: dict[str, Any] = {}

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        self.pending[name] = np.where(mask, values, self.pending.get(name, self.values[name]))

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        for name, values in self.pending.items():
            self.values[name] = np.where(mask, values, self.values[name])
        super().reset(seed, mask)


class LaterUnseen(Later):
    """So it does, and what is read is what was written."""

    def get(self, name: str) -> Any:
        """Return a parameter."""
        return self.pending.get(name, self.values[name])


class Clips(Pendulums):
    """Values are cut off to a narrower range."""

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        super().set(name, np.clip(values, 0.8, 1.2), mask)


class ResetsDisturb(Pendulums):
    """One generator serves all worlds."""

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        super().reset(seed, mask)
        self.rngs = [np.random.default_rng(seed + row) for row in range(self.num_envs)]


class ResetsForget(Pendulums):
    """A reset of one world resets the parameters of all."""

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        super().reset(seed, mask)
        self.values["mass"][:] = 1.0


class UndoLeavesSomething(Pendulums):
    """A constant follows the value when it rises, and stays when it falls."""

    def __init__(self, n: int = 3) -> None:
        super().__init__(n)
        self.most = np.ones(n)

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        super().reset(seed, mask)
        self.most[mask] = self.values["mass"][mask]

    def set(self, name: str, values: Any, mask: Any) -> None:
        """Write a parameter in some worlds."""
        super().set(name, values, mask)
        self.most = np.maximum(self.most, self.values["mass"])

    def step(self, actions: Any) -> None:
        """Advance all worlds."""
        kept, self.values["mass"] = self.values["mass"], self.most
        super().step(actions)
        self.values["mass"] = kept


FAULTY = (NotWritten, OnNeighbours, Accumulates, AccumulatesInside, Later, LaterUnseen, Clips)
"""In these, each parameter has the fault."""


@pytest.mark.parametrize("n", [2, 3, 7])
@pytest.mark.parametrize(
    ("made", "question"),
    [
        (NoEffect, "responds"),
        (NotWritten, "applied"),
        (OnNeighbours, "neighbours"),
        (NeighboursMove, "neighbours"),
        (Accumulates, "second reset"),
        (AccumulatesInside, "second reset"),
        (Later, "at once"),
        (LaterUnseen, "at once"),
        (Clips, "in range"),
        (ResetsDisturb, "partial reset"),
        (ResetsForget, "partial reset"),
        (UndoLeavesSomething, "undo"),
    ],
)
def test_a_planted_fault_of_tensors_is_found(made: type[Pendulums], question: str, n: int) -> None:
    """Each planted fault is the answer to its question, whatever else is asked in the same runs."""
    alone = check(made(n), MASS)
    assert question in {asked for _, asked, _ in alone.faults}, str(alone)
    beside = check(made(n), {"damping": (0.1, 1.0), **MASS, "length": (0.5, 2.0)})
    assert question in {asked for name, asked, _ in beside.faults if name == "mass"}, str(beside)
    if made not in (*FAULTY, ResetsDisturb):
        assert {*beside.faults} == {*alone.faults}


class Draws(Pendulums):
    """Resets draw a mass, each world from its own generator."""

    def draw(self, seed: int, row: int) -> Any:
        """Draw a mass."""
        del seed
        return self.rngs[row].uniform(0.5, 2.0)

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        super().reset(seed, mask)
        for row in np.flatnonzero(mask):
            self.values["mass"][row] = self.draw(seed, row)


class OnlyTheFirst(Draws):
    """One world is randomised, and no other."""

    def draw(self, seed: int, row: int) -> Any:
        """Draw a mass."""
        return 1.0 if row else super().draw(seed, row)


class InPairs(Draws):
    """Two worlds have one seed."""

    def draw(self, seed: int, row: int) -> Any:
        """Draw a mass."""
        return np.random.default_rng(seed + row // 2).uniform(0.5, 2.0)


class EverySecondReset(Draws):
    """Each second reset draws nothing."""

    resets = 0

    def reset(self, seed: int, mask: Any) -> None:
        """Begin episodes."""
        self.resets += 1
        (Draws if self.resets % 2 else Pendulums).reset(self, seed, mask)


class OfATenth(Draws):
    """Masses vary by a tenth of what is declared."""

    def draw(self, seed: int, row: int) -> Any:
        """Draw a mass."""
        return 1.0 + 0.1 * (super().draw(seed, row) - 1.0)


class Singles(Draws):
    """Two ends of a range, as 32-bit floats."""

    def draw(self, seed: int, row: int) -> Any:
        """Draw a mass."""
        del seed
        return np.float32(self.rngs[row].choice([0.1, 0.3]))


ENDS = "they go from 0.9535 to 1.098"


@pytest.mark.parametrize(
    ("made", "n", "faults"),
    [
        (Draws, 1, set()),
        (Draws, 4, set()),
        (OnlyTheFirst, 3, {("applied", "it is 1 after each reset in world 1")}),
        (InPairs, 4, {("applied", "worlds 0 and 1 have the same value after each reset")}),
        (EverySecondReset, 1, {("applied", "nothing is drawn at 24 of 49 resets in world 0")}),
        (
            OfATenth,
            1,
            {("in range", "values keep to 10% of the range; they go from 0.9535 to 1.098")},
        ),
    ],
)
def test_faults_of_draws_are_found(made: type[Draws], n: int, faults: Any) -> None:
    """Some worlds, some resets, or a part of the range."""
    found = check(made(n), MASS, by="reset", steps=3)
    assert {(question, said) for _, question, said in found.faults} == faults, str(found)


def test_ends_of_a_range_may_be_32_bit_floats() -> None:
    """A rounded end is no value outside."""
    assert float(np.float32(0.1)) > 0.1 * (1.0 + 1e-9)
    assert not check(Singles(), {"mass": (0.1, 0.3)}, by="reset", steps=3).faults


def test_a_value_that_comes_back_is_a_remark() -> None:
    """It may be a distribution, or resets that draw nothing."""

    class Sometimes(Draws):
        resets = 0

        def reset(self, seed: int, mask: Any) -> None:
            self.resets += 1
            super().reset(seed, mask)

        def draw(self, seed: int, row: int) -> Any:
            return super().draw(seed, row) if self.resets % 2 else 1.0

    found = check(Sometimes(), MASS, by="reset", steps=3)
    said = found.ranges[0].answers["applied"].said
    assert not found.faults
    assert said.endswith("; it is 1 after 25 of 50 resets in world 0")


def test_what_nothing_depends_on_is_not_asked() -> None:
    """The last variable of equations moves nothing; the first one moves it."""
    cause = sw.Exogenous(name="x", distribution=variables.Normal())
    last = sw.Derived(name="y", parents=("x",), mechanism=sw.Linear(weights=(2.0,)))
    found = check(sw.World(sw.SCM([cause, last]), num_worlds=2), {"x": (-1, 1), "y": (-3, 3)})
    assert not found.faults, str(found)
    statuses = [one.answers["responds"].status for one in found.ranges]
    assert statuses == ["passed", "not asked"]


def test_friction_of_a_box_that_rests_is_not_asked() -> None:
    """It lies flat on the floor, and no force is along the floor: two plain runs are equal."""
    box = """<mujoco><option cone="elliptic"/><worldbody><geom name="floor" type="plane"
    size="1 1 1"/><body name="box" pos="0 0 0.1"><freejoint name="free"/>
    <geom name="side" type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>"""
    ends = []
    for friction in (1.0, 2.0):
        model = mujoco.MjModel.from_xml_string(box)
        model.geom_friction[1, 0] = friction
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 100)
        assert data.ncon
        ends.append(data.qpos.copy())
    assert np.array_equal(*ends)
    worlds = sw.World(box, num_worlds=2)
    found = check(worlds, {"side.friction": (1.0, 2.0)})
    assert not found.faults, str(found)
    assert found.ranges[0].answers["applied"].status == "passed"
    assert found.ranges[0].answers["responds"].status == "not asked"


@pytest.mark.slow
def test_what_acts_in_another_context_alone_is_a_fault_of_who_declares_it() -> None:
    """The noise of a random wall lays no regular one: a usual range is not asked about it."""
    with closing(sw.World("stacked_blocks", num_worlds=2)) as worlds:
        declared = check(worlds, {"wall_noise": sw.Draw("A")}, steps=1)
        ours = OurWorlds(worlds)
        ours.declared(None)
        assert ours.idle("wall_noise", ran=True).endswith("changes here: wall.layout")
        assert not ours.idle("stack_levels", ran=True)
    assert [question for _, question, _ in declared.faults] == ["responds"]


def test_actions_are_no_ranges() -> None:
    """They are set at each step: a pattern leaves them out, and a name of one is refused."""
    found = check(tanks(2), {"*": (0.0, 1.0)}, steps=3)
    assert not found.faults, str(found)
    assert {"leak", "level"} <= {one.name for one in found.ranges}
    assert "inflow" not in {one.name for one in found.ranges}
    with pytest.raises(UnknownOption, match="inflow"):
        check(tanks(2), {"inflow": (0.0, 1.0)})


@pytest.mark.parametrize("n", [1, 2, 5])
def test_honest_tensors_have_no_fault(n: int) -> None:
    """One world is asked what can be asked of it."""
    found = check(Pendulums(n), {**MASS, "damping": (0.1, 1.0)})
    assert not found.faults, str(found)
    assert found.floor == 0.0
    assert found.ranges[0].answers["responds"].size > 0.0
    assert found.ranges[0].answers["constants"].status == "not asked"
    assert (found.ranges[0].answers["neighbours"].status == "passed") == (n > 1)


# --- environments that draw their values at a reset --------------------------------------------

TORSO = {"body_mass[torso]": sw.Scale(sw.Draw(0.5, 1.5))}


class Randomised(gymnasium.Wrapper):
    """Writes the mass of the torso at each reset, and derives the constants of the model anew."""

    constants = True

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.model = env.unwrapped.model
        self.was = self.model.body_mass.copy()

    def draw(self) -> float:
        """Draw a factor."""
        return float(self.unwrapped.np_random.uniform(0.5, 1.5))

    def write(self) -> None:
        """Write a mass."""
        self.model.body_mass[1] = self.was[1] * self.draw()

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Begin episodes."""
        if seed is not None:
            self.unwrapped.np_random = np.random.default_rng(seed + 10**6)
        self.write()
        if self.constants:
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        return self.env.reset(seed=seed, options=options)


class StaleConstants(Randomised):
    """Constants of the model are left as they are, as most users do."""

    constants = False


class InPlace(Randomised):
    """The mass is multiplied by each draw, and not that of the file."""

    def write(self) -> None:
        """Write a mass."""
        self.model.body_mass[1] *= self.draw()


class Once(Randomised):
    """The switch that turns the randomisation on is off."""

    def write(self) -> None:
        """Write a mass."""


class OnACopy(Randomised):
    """It writes to a copy of the model."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.model = copy.copy(self.model)


class Cut(Randomised):
    """Draws are cut off to a narrower range."""

    def draw(self) -> float:
        """Draw a factor."""
        return float(np.clip(super().draw(), 0.8, 1.2))


class Beyond(Randomised):
    """Draws go beyond the range."""

    def draw(self) -> float:
        """Draw a factor."""
        return 1.1 * super().draw()


class Copies(Randomised):
    """Each environment has a generator of the same seed."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.rng = np.random.default_rng(42)

    def draw(self) -> float:
        """Draw a factor."""
        return float(self.rng.uniform(0.5, 1.5))


def cheetahs(wrapper: Callable[[Any], Any], name: str = "HalfCheetah-v5", n: int = 3) -> Any:
    """Make environments in a wrapper."""
    return gymnasium.vector.SyncVectorEnv([lambda: wrapper(gymnasium.make(name))] * n)


@pytest.mark.parametrize(
    ("wrapper", "question"),
    [
        (StaleConstants, "constants"),
        (InPlace, "second reset"),
        (Once, "applied"),
        (OnACopy, "applied"),
        (Cut, "in range"),
        (Beyond, "in range"),
        (Copies, "applied"),
    ],
)
def test_a_planted_fault_of_gymnasium_is_found(wrapper: Any, question: str) -> None:
    """Each way to write a mass wrongly is found."""
    with closing(cheetahs(wrapper)) as envs:
        found = check(envs, TORSO)
    assert question in {asked for _, asked, _ in found.faults}, str(found)


def test_an_honest_wrapper_has_no_fault() -> None:
    """A wrapper that derives the constants anew passes."""
    with closing(cheetahs(Randomised)) as envs:
        found = check(envs, TORSO)
    assert not found.faults, str(found)


def test_unseeded_draws_are_paired() -> None:
    """What a reset draws beside the declared range is held, with all that follows from it."""

    class Careful(gymnasium.Wrapper):
        def __init__(self, env: Any) -> None:
            super().__init__(env)
            self.model = env.unwrapped.model
            self.was = self.model.body_mass.copy(), self.model.body_inertia.copy()
            self.rng = np.random.default_rng()

        def reset(self, **given: Any) -> Any:
            factors = self.rng.uniform(0.5, 1.5, size=len(self.was[0]))
            self.model.body_mass[:] = self.was[0] * factors
            self.model.body_inertia[:] = self.was[1] * factors[:, None]
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
            return self.env.reset(**given)

    with closing(cheetahs(Careful, "Walker2d-v5")) as envs:
        found = check(envs, wide("body_mass"))
    assert not found.faults, str(found)
    assert found.floor == 0.0
    assert found.ranges[0].answers["responds"].status == "passed"
    assert found.ranges[0].answers["second reset"].said == "the same seed gives other values"


def test_a_first_observation_of_the_masses_before_is_found() -> None:
    """Humanoid observes inertias; a mass that is written after the reset is not in them."""

    class After(Randomised):
        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            found = self.env.reset(seed=seed, options=options)
            self.write()
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
            return found

    for wrapper, asked in ((After, "at once"), (Randomised, None)):
        with closing(cheetahs(wrapper, "Humanoid-v5", 2)) as envs:
            found = check(envs, TORSO)
        assert [question for _, question, _ in found.faults] == ([asked] if asked else []), str(
            found
        )


def test_a_range_without_effect_in_one_half_is_a_remark() -> None:
    """MuJoCo takes the greater friction of two bodies."""
    factor = scaled("geom_friction", (0, 0))
    with closing(cheetahs(factor)) as envs:
        found = check(envs, wide("geom_friction[floor, 0]"))
    assert not found.faults, str(found)
    assert found.ranges[0].answers["in range"].said == "no state differs from 0.2 to 0.4"
    with closing(cheetahs(factor, "Hopper-v5")) as envs:
        assert "responds" in {
            asked for _, asked, _ in check(envs, wide("geom_friction[floor, 0]")).faults
        }


@pytest.mark.parametrize(("plant", "question"), [("shared", "neighbours"), ("stale", "constants")])
def test_a_planted_fault_of_rollouts_is_found(plant: str, question: str) -> None:
    """One model for all worlds; masses without constants."""
    models = rollouts(3) if plant == "stale" else [*rollouts(2), rollouts(3)[1]]
    if plant == "shared":
        models[2] = models[0]
    else:
        models[1].body_mass[1] *= 1.1
    found = check(models, {"body_mass[pole]": (3.0, 14.0)})
    assert question in {asked for _, asked, _ in found.faults}, str(found)


def test_stale_constants_of_our_own_worlds_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """If nothing followed a mass in our own engine, it would be found."""
    monkeypatch.setattr(Realization, "_followed", lambda *_: "")
    worlds = sw.World("pushing", num_worlds=2)
    found = check(worlds, {"tool_block.mass": sw.Draw("A")})
    assert {asked for _, asked, _ in found.faults} == {"constants"}, str(found)


def test_an_engine_that_keeps_its_values_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """If our own engine took no value over, ``do`` says so, and so does the report."""
    monkeypatch.setattr(MujocoBackend, "apply", lambda *_: None)
    worlds = sw.World("pushing", num_worlds=2)
    found = check(worlds, {"joint_damping": sw.Draw("A")})
    assert found.faults[0][:2] == ("joint_damping", "applied"), str(found)


def test_shared_models_are_neighbours() -> None:
    """Environments that share a model change together."""
    with closing(cheetahs(Randomised)) as envs:
        for env in envs.envs[1:]:
            env.unwrapped.model = envs.envs[0].unwrapped.model
        found = check(envs, TORSO)
    assert "neighbours" in {asked for _, asked, _ in found.faults}, str(found)


# --- honest set-ups ------------------------------------------------------------------------------

HINGE = """<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""
SPRING = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" friction="0.5"/>
<body name="box" pos="0 0 0.1"><joint type="slide" axis="1 0 0" name="slide"/><joint name="up"
type="slide" axis="0 0 1"/><geom name="side" type="box" size="0.1 0.1 0.1" friction="0.2"/></body>
</worldbody><actuator><motor name="push" joint="slide" ctrlrange="-30 30"/></actuator></mujoco>"""


def tank(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Step a tank with an inflow, an outflow and noise."""
    level = state["level"] + action["inflow"] - parameters["leak"] * state["level"]
    return {"level": level + parameters["noise"] * noise["level"]}


def tanks(n: int) -> Any:
    """Make worlds of a step function."""
    return sw.World(
        tank,
        parameters=[
            sw.Exogenous(name="leak", default=0.1, a=sw.Box(0.05, 0.3)),
            sw.Exogenous(name="noise", default=0.01, a=sw.Box(0.0, 0.1)),
        ],
        states=[
            sw.Measured(name="level", default=1.0, parents=("level", "inflow", "leak", "noise"))
        ],
        actions=[sw.Action(name="inflow", bounds=sw.Box(0, 1))],
        noise={"level": variables.Normal()},
        control_dt=0.1,
        num_worlds=n,
    )


def equations(n: int) -> Any:
    """Make worlds of equations in time."""
    cause = sw.Exogenous(name="a", a=sw.Box(0, 1), distribution=variables.Normal())
    mechanism, noise = sw.Linear(weights=(0.5, 2.0)), variables.Normal()
    parents = (sw.Parent("y", lag=1), "a")
    model = sw.SCM([cause, sw.Derived(name="y", parents=parents, mechanism=mechanism, noise=noise)])
    return sw.World(model, num_worlds=n)


def scaled(field: str, index: Any = ..., low: float = 0.5, high: float = 1.5) -> Any:
    """Return a wrapper that scales a field of the file at each reset, and derives constants."""

    class Scaled(Randomised):
        def __init__(self, env: Any) -> None:
            super().__init__(env)
            self.before = getattr(self.model, field).copy()

        def write(self) -> None:
            factor = self.unwrapped.np_random.uniform(low, high)
            array = getattr(self.model, field)
            array[index] = self.before[index] * factor
            if field == "body_mass":
                self.model.body_inertia[index] = self.inertia[index] * factor

        @property
        def inertia(self) -> Any:
            if not hasattr(self, "kept"):
                self.kept = self.model.body_inertia.copy()
            return self.kept

    return Scaled


def rollouts(n: int) -> Any:
    """Make models of a rollout, with masses of their own."""
    models = [mujoco.MjModel.from_xml_string(HINGE) for _ in range(n)]
    for model, factor in zip(models, np.linspace(0.6, 1.4, n), strict=True):
        model.body_mass[1] *= factor
        model.body_inertia[1] *= factor
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return models


def wide(name: str) -> dict[str, Any]:
    """Return a range of factors."""
    return {name: sw.Scale(sw.Draw(0.5, 1.5))}


HONEST: dict[str, tuple[Callable[[], Any], Any]] = {
    "tank": (lambda: tanks(3), None),
    "equations": (lambda: equations(3), None),
    "hinge": (
        lambda: sw.World(HINGE, num_worlds=3),
        {"*.mass": (1.0, 9.0), "*.damping": (0.0, 1.0)},
    ),
    "box": (
        lambda: sw.World(SPRING, num_worlds=2),
        {"*.mass": (4.0, 12.0), "gravity": ((0, 0, -12), (0, 0, -6))},
    ),
    "hinge on Bullet": (
        lambda: sw.World(HINGE, num_worlds=2, backend="bullet"),
        {"*.mass": (1.0, 9.0)},
    ),
    "vector environment": (
        lambda: vector_env(2, task="reaching"),
        {"gravity": sw.Draw("A"), "joint_damping": sw.Draw("A"), "torque_limit": sw.Draw("A")},
    ),
    "contact": (
        lambda: sw.World("pushing", num_worlds=2),
        {
            "tool_block.mass": sw.Draw("A"),
            "tool_block.friction": sw.Draw("A"),
            "block.size": sw.Draw("A"),
        },
    ),
    "contact on Bullet": (
        lambda: sw.World("pushing", num_worlds=2, backend="bullet"),
        {"tool_block.mass": sw.Draw("A"), "floor_friction": sw.Draw("A")},
    ),
    "bodies": (
        lambda: sw.World("stacked_blocks", num_worlds=2),
        {"stack_levels": sw.Draw("A"), "gravity": sw.Draw("A")},
    ),
    "a goal on an axis": (
        lambda: sw.World("picking", num_worlds=2),
        {"goal_block.cylindrical_position": sw.Draw("A")},
    ),
    "poses": (
        lambda: sw.World("pushing", num_worlds=2),
        {"tool_block.cylindrical_position": sw.Draw("A"), "joint_positions": sw.Draw("A")},
    ),
    "tensors": (lambda: Pendulums(4), {**MASS, "damping": (0.1, 1.0)}),
    "rollouts": (lambda: rollouts(4), {"body_mass[pole]": (4.0, 12.0)}),
    "cheetah": (lambda: cheetahs(Randomised), TORSO),
    "all masses": (lambda: cheetahs(scaled("body_mass")), wide("body_mass")),
    "hopper": (lambda: cheetahs(scaled("dof_damping"), "Hopper-v5"), wide("dof_damping")),
    "ant": (lambda: cheetahs(scaled("body_mass", 1), "Ant-v5"), wide("body_mass[torso]")),
    "humanoid": (lambda: cheetahs(scaled("body_mass"), "Humanoid-v5", 2), wide("body_mass")),
    "walker": (lambda: cheetahs(scaled("actuator_gear"), "Walker2d-v5"), wide("actuator_gear")),
    "swimmer": (lambda: cheetahs(scaled("body_mass"), "Swimmer-v5"), wide("body_mass")),
    "friction": (lambda: cheetahs(scaled("geom_friction"), "Walker2d-v5"), wide("geom_friction")),
    "pendulum": (lambda: cheetahs(scaled("body_mass"), "InvertedPendulum-v5"), wide("body_mass")),
    "not randomised": (lambda: cheetahs(lambda env: env, "Reacher-v5"), None),
    "usual fields": (lambda: cheetahs(lambda env: env, "Hopper-v5"), None),
}
FAST = {
    "tank",
    "equations",
    "hinge",
    "tensors",
    "rollouts",
    "hopper",
    "poses",
    "vector environment",
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in HONEST]
)
def test_no_fault_is_invented(name: str) -> None:
    """Honest set-ups pass: ours on every engine, Gymnasium's, tensors, rollouts."""
    made, ranges = HONEST[name]
    found = check(made(), ranges)
    assert not found.faults, str(found)
    assert found.floor == 0.0


# --- reports, arguments, the command -------------------------------------------------------------


def test_a_report_is_read_back() -> None:
    """JSON without loss; a row for each range, a column for each question, and a picture."""
    found = check(Pendulums(), MASS, steps=4)
    assert Check.from_json(found.to_json()) == found
    assert [*found.table.columns] == ["range", "values", *QUESTIONS, "response"]
    assert found.picture().axes
    size = found.ranges[0].answers["responds"]
    one, other = Pendulums(), Pendulums()
    for envs, mass in ((one, 1.0), (other, 2.0 - 1.5e-12)):
        envs.values["mass"][0] = mass
        envs.reset(0, np.ones(3, bool))
    apart = []
    for actions in np.random.default_rng(0).uniform(-1.0, 1.0, (4, 3, 1)):
        one.step(actions)
        other.step(actions)
        apart.append(np.abs(one.state - other.state)[0])
    assert size.size == pytest.approx(np.max(apart, axis=0)[int(size.unit == "rad/s")])


@pytest.mark.parametrize(
    ("envs", "ranges"),
    [
        (3, None),
        ([], None),
        (Pendulums, MASS),
        (Pendulums(), None),
        (Pendulums(), {}),
        (Pendulums(), {"lenght": (0.0, 1.0)}),
        (Pendulums(), {"mass": (1.0,)}),
        (Pendulums(), {"mass": (2.0, 1.0)}),
        (Pendulums(), {"mass": (1.0, 1.0)}),
        (Pendulums(), {"mass": ("a", "b")}),
        (Pendulums(), {"mass": ((1.0, 2.0, 3.0, 4.0), 5.0)}),
        ([mujoco.MjModel.from_xml_string(HINGE)] * 2, {"body_mas": (0.0, 1.0)}),
        ([mujoco.MjModel.from_xml_string(HINGE)] * 2, {"body_mass[arm]": (0.0, 1.0)}),
        ([mujoco.MjModel.from_xml_string(HINGE)] * 2, {"body_mass[7]": (0.0, 1.0)}),
        (([mujoco.MjModel.from_xml_string(HINGE)] * 2, np.zeros(3)), {"body_mass[1]": (0.0, 1.0)}),
    ],
)
def test_what_cannot_be_asked_is_a_typed_error(envs: Any, ranges: Any) -> None:
    """The error says what is allowed."""
    with pytest.raises(UnknownOption):
        check(envs, ranges)


def test_a_model_without_usual_ranges_is_no_model_without_fault() -> None:
    """Nothing would have been asked."""
    with pytest.raises(UnknownOption, match="there are no usual ones"):
        check(sw.World(HINGE, num_worlds=2))


def test_a_variable_that_does_not_exist_is_a_typed_error() -> None:
    """Names are those of the model."""
    with pytest.raises(ScmWorldError, match="lek"):
        check(tanks(2), {"lek": (0.0, 1.0)})


def test_what_cannot_be_set_is_not_asked() -> None:
    """Without ``set`` no run is paired, and no such question counts as passed."""

    class Drawn(Checkable):
        num_envs, n_actions, inside = 3, 1, Draws()

        def get(self, name: str) -> Any:
            return self.inside.get(name)

        def reset(self, seed: int, mask: Any) -> None:
            self.inside.reset(seed, mask)

        def step(self, actions: Any) -> None:
            self.inside.step(actions)

        def observe(self) -> Any:
            return self.inside.observe()

    envs = Drawn()
    found = check(envs, MASS).ranges[0].answers
    passed = {question for question, answer in found.items() if answer.status == "passed"}
    assert passed == {"applied", "in range", "second reset", "partial reset"}
    with pytest.raises(UnknownOption):
        check(envs, MASS, by="set")


def test_a_package_of_an_environment_that_is_missing_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Gymnasium's MuJoCo environments import what its extra ``mujoco`` brings."""
    lost = gymnasium.envs.registration.EnvSpec("Lost-v0", entry_point="not_there_9:Lost")
    monkeypatch.setitem(gymnasium.registry, "Lost-v0", lost)
    found = CliRunner().invoke(app, ["check", "Lost-v0"])
    assert found.exit_code == 2
    assert "needs the package 'not_there_9'" in found.output, found.output

    def made(**options: Any) -> Any:
        raise gymnasium.error.DependencyNotInstalled("Box2D is not installed")

    lost = gymnasium.envs.registration.EnvSpec("Lost-v0", entry_point=made)
    monkeypatch.setitem(gymnasium.registry, "Lost-v0", lost)
    found = CliRunner().invoke(app, ["check", "Lost-v0"])
    assert found.exit_code == 2
    assert "Lost-v0 cannot be made: Box2D is not installed" in found.output, found.output


def test_the_command_exits_1_for_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an environment of Gymnasium, of a function and of a task; files are written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ranges.json").write_text('{"body_mass[torso]": "scale:draw:0.5,1.5"}')
    text = (
        "import gymnasium\n\ndef envs():\n    return gymnasium.make_vec('Hopper-v5', 2, 'sync')\n"
    )
    (tmp_path / "mine.py").write_text(text)
    few = ("--steps", "3", "--resets", "4", "--worlds", "2", "--out", "here")
    run = CliRunner()
    bare = run.invoke(app, ["check", "Hopper-v5", *few])
    assert bare.exit_code == 0, bare.output
    for source in ("Hopper-v5", "mine.py:envs"):
        given = run.invoke(app, ["check", source, "--ranges", "ranges.json", *few])
        assert given.exit_code == 1, given.output
        assert "after each of 4 resets in every world" in given.output
    assert {path.name for path in (tmp_path / "here").iterdir()} == {
        *("report.json", "ranges.csv", "check.png")
    }
    wrong = run.invoke(app, ["check", "Hopper-v5", "--ranges", "mine.py", *few])
    assert wrong.exit_code == 2
