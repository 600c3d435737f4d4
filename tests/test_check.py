"""``check`` finds every planted fault, and invents none in honest environments."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import closing
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

import scm_world as sw
from scm_world.env import vector_env
from scm_world.env.answers import QUESTIONS
from scm_world.env.checks import check
from scm_world.errors import ScmWorldError, UnknownOption

MASS = {"mass": (0.5, 2.0)}


class Pendulums:
    """Tensors of n pendulums, which a learner writes for itself: states and parameters by row."""

    n_actions = 1

    def __init__(self, n: int = 3) -> None:
        self.num_envs = n
        self.values = {name: np.ones(n) for name in ("mass", "damping")}
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
        speed = speed + 0.05 * (torque / self.values["mass"] - 9.81 * np.sin(angle) + noise)
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
def test_a_planted_fault_of_tensors_is_found(made: type[Pendulums], question: str) -> None:
    """Each planted fault is the answer to its question."""
    found = check(made(), MASS)
    assert question in {asked for _, asked, _ in found.faults}, str(found)


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


def test_shared_models_are_neighbours() -> None:
    """Environments that share a model change together."""
    with closing(cheetahs(Randomised)) as envs:
        for env in envs.envs[1:]:
            env.unwrapped.model = envs.envs[0].unwrapped.model
        found = check(envs, TORSO)
    assert "neighbours" in {asked for _, asked, _ in found.faults}, str(found)
