"""Step functions as a backend."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import pytest
from numba import njit

from scm_world._types import Floats
from scm_world.backends import make_backend
from scm_world.backends.base import Backend
from scm_world.backends.step import Quantity, StepFunction, StepModel
from scm_world.errors import (
    EngineFailure,
    ModelError,
    SnapshotMismatch,
    UnknownOption,
)
from scm_world.models.scene import Difference, ParameterKey, Scene, State, Structure
from scm_world.tasks.trifinger.system import trifinger
from scm_world.testing.backend import BackendConformance

DT = 0.05
TABLES: dict[str, Any] = {
    "parameters": (Quantity("spring.stiffness", (2,), (3.0, 5.0)), Quantity("damping", (), 0.1)),
    "states": (
        Quantity("mass.position", (2,), (0.1, -0.2)),
        Quantity("mass.velocity", (2,), 0.0),
        Quantity("count", (), 2.0, integer=True),
    ),
    "actions": (Quantity("force", (2,), 0.0), Quantity("jump", (), 0.0, integer=True)),
    "noise": (Quantity("gust", (), 0.0),),
}


def swing(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Two springs with a common gust of wind, for one system or for many."""
    x, v = state["mass.position"], state["mass.velocity"]
    friction = np.asarray(parameters["damping"])[..., None] * v
    gust = np.asarray(noise["gust"])[..., None]
    v = v + DT * (action["force"] - parameters["spring.stiffness"] * x - friction + gust)
    return {
        "count": state["count"] + action["jump"] + 1,
        "mass.position": x + DT * v,
        "mass.velocity": v,
    }


@njit
def compiled(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """The same, of flat arrays."""
    new = np.empty(5)
    for i in range(2):
        force = action[i] - parameters[i] * state[i] - parameters[2] * state[2 + i] + noise[0]
        new[2 + i] = state[2 + i] + DT * force
        new[i] = state[i] + DT * new[2 + i]
    new[4] = state[4] + action[2] + 1
    return new


MODELS = {
    "scalar": StepModel("swing", swing, DT, **TABLES),
    "vectorized": StepModel("swing", swing, DT, **TABLES, vectorized=True),
    "compiled": StepModel("swing", compiled, DT, **TABLES, signature="arrays"),
}


def built(model: StepModel) -> StepFunction:
    """Build the default scene."""
    backend = StepFunction()
    backend.build(model.default_scene())
    return backend


def play(backend: Backend, steps: int, seed: int = 1) -> Floats:
    """Step with random commands, and give the states, shape (steps, 5)."""
    draws = np.random.default_rng(seed).normal(size=(steps, 4))
    draws[:, 2] = np.rint(draws[:, 2])
    found = []
    for command in draws:
        backend.step(command, 1)
        found.append(backend.read().vector.copy())
    return np.array(found)


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> StepModel:
    """Provide one system in three ways."""
    return MODELS[request.param]


def fall(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """A system with fewer parameters and states, and without noise."""
    return {"mass.velocity": state["mass.velocity"] + DT * action["force"] - parameters["damping"]}


class StepConformance(BackendConformance):
    """The suite of backends; that worlds undo exactly is asked with other tasks.

    Attributes:
        step: The system.
    """

    step: ClassVar[StepModel]
    substeps = 2
    test_worlds_undo_exactly = None
    test_a_body_that_touches_nothing_does_nothing = None

    def make(self) -> Backend:
        """Create it."""
        return make_backend("step")

    def busy(self) -> Scene:
        """Return the scene with the defaults."""
        return self.step.default_scene()

    def commands(self, structure: Any, steps: int, seed: int = 7) -> Floats:
        """Draw commands; one action is a whole number."""
        found = super().commands(structure, steps, seed)
        found[:, 2:3] = np.rint(found[:, 2:3])
        return found

    def other_value(self, structure: Any, key: ParameterKey, value: Floats) -> Floats:
        """Return another value."""
        return np.asarray(0.9 * value + 0.01)

    def changed_states(self, state: State) -> Iterator[State]:
        """Change one state after the other."""
        changed = state.copy()
        for name in state:
            changed[name][:] += 3.0 if name == "count" else 0.25
            yield changed.copy()

    def other_structures(self, scene: Scene) -> Iterable[Structure]:
        """List a system with other tables."""
        yield StepModel(
            "fall", fall, DT, TABLES["parameters"][1:], TABLES["states"][1:2], TABLES["actions"][:1]
        )

    def test_contacts_are_those_of_the_last_step(self, scene: Scene) -> None:
        """Nothing touches anything."""
        with self.built(scene) as backend:
            self.play(backend, 3)
            assert backend.contacts() == ()


class TestOneByOne(StepConformance):
    """A function that is called for one system after another."""

    step = MODELS["scalar"]


class TestTogether(StepConformance):
    """A function that is called for all systems at once."""

    step = MODELS["vectorized"]


class TestCompiled(StepConformance):
    """A compiled function of flat arrays."""

    step = MODELS["compiled"]


def test_the_function_is_the_physics(model: StepModel) -> None:
    """A step does what the function says, with parameters, action and noise in their places."""
    backend = built(model)
    backend.apply(Difference(parameters={("", "damping"): np.array(0.5)}))
    backend.step(np.array([1.0, 2.0, 3.0, 0.25]), 1)
    x = np.array([0.1, -0.2])
    v = DT * (np.array([1.0, 2.0]) - np.array([3.0, 5.0]) * x + 0.25)
    np.testing.assert_allclose(backend.read()["mass.velocity"], v, rtol=1e-14)
    np.testing.assert_allclose(backend.read()["mass.position"], x + DT * v, rtol=1e-14)
    assert backend.read()["count"].tolist() == [6.0]


def test_all_ways_of_writing_it_agree() -> None:
    """A function of dicts, of batches and a compiled one of arrays move alike."""
    one, many, quick = (play(built(MODELS[name]), 30) for name in MODELS)
    np.testing.assert_array_equal(one, many)
    np.testing.assert_allclose(one, quick, rtol=1e-12)


def test_sizes_come_from_the_tables(model: StepModel) -> None:
    """The command is the actions and the noise; the state is laid out as declared."""
    assert model.n_commands == 4
    assert model.layout.names == ("mass.position", "mass.velocity", "count")
    assert model.layout.start == (0.1, -0.2, 0.0, 0.0, 2.0)
    assert model.default_scene().parameters["spring", "stiffness"].tolist() == [3.0, 5.0]


def test_substeps_hold_the_command(model: StepModel) -> None:
    """Three steps in one call are three calls with the same command."""
    once, thrice = built(model), built(model)
    command = np.array([1.0, -1.0, 1.0, 0.3])
    once.step(command, 3)
    for _ in range(3):
        thrice.step(command, 1)
    assert once.read() == thrice.read()


def test_a_snapshot_of_another_engine_is_refused() -> None:
    """The fake's snapshot cannot be restored here."""
    fake = make_backend("fake")
    fake.build(trifinger().default_scene())
    with pytest.raises(SnapshotMismatch, match="fake 1"):
        built(MODELS["scalar"]).restore(fake.snapshot())


def test_a_vectorized_function_is_called_once_for_all() -> None:
    """After the first step of a batch there is one call for each step."""
    calls = []

    def counted(*given: Any) -> Any:
        calls.append(len(given[1]["count"]))
        return swing(*given)

    model = StepModel("swing", counted, DT, **TABLES, vectorized=True)
    backends = [built(model) for _ in range(8)]
    batch = StepFunction.batch.of(backends, 1)
    for _ in range(3):
        calls.clear()
        batch.step(np.arange(8), np.zeros((8, 4)), 1, np.empty((8, 5)))
    assert calls == [8]


def test_rows_that_depend_on_one_another_are_refused() -> None:
    """A vectorised function that averages over its rows is not many systems."""

    def coupled(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        return {"x": 0.0 * state["x"] + action["push"].mean()}

    tables: dict[str, Any] = {
        "parameters": (),
        "states": (Quantity("x"),),
        "actions": (Quantity("push"),),
    }
    model = StepModel("coupled", coupled, DT, **tables, vectorized=True)
    batch = StepFunction.batch.of([built(model) for _ in range(3)], 1)
    with pytest.raises(EngineFailure, match="other numbers among 3 rows than alone"):
        batch.step(np.arange(3), np.arange(3.0)[:, None], 1, np.empty((3, 1)))


def test_integers_stay_integers() -> None:
    """The function is given whole numbers where they are declared, also for many systems."""
    seen = []

    def grow(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        seen.append((state["n"], parameters["k"], state["x"]))
        return {"n": state["n"] // parameters["k"], "x": state["x"]}

    tables: dict[str, Any] = {
        "parameters": (Quantity("k", (), 3.0, integer=True),),
        "states": (Quantity("n", (), 10.0, integer=True), Quantity("x")),
    }
    for many in (False, True):
        backend = built(StepModel("grow", grow, DT, **tables, vectorized=many))
        backend.step(np.empty(0), 1)
        assert backend.read().vector.tolist() == [3.0, 0.0]
        assert [np.asarray(value).dtype.kind for value in seen[-1]] == list("iif")


def forgets(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give one state of two."""
    return {"x": 1.0}


def invents(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give a state that is not declared."""
    return {**state, "z": 1.0}


def flattens(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give a wrong shape."""
    return {**state, "y": np.zeros(2)}


def breaks(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give NaN."""
    return {**state, "y": np.array([0.0, np.nan, 0.0])}


def halves(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give half a number for a whole one."""
    return {**state, "n": 0.5}


def overflows(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give a whole number that a float cannot hold."""
    return {**state, "n": 2**60}


def talks(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give a text."""
    return {**state, "x": "one"}


def tears(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Give a ragged list."""
    return {**state, "y": [[1.0, 2.0], [3.0]]}


def lists(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Give no dict."""
    return [1.0]


def writes(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Change what it was given."""
    state["y"][0] = 1.0
    return state


def misspells(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Ask for a parameter that there is not."""
    return {**state, "x": parameters["mas"]}


def divides(parameters: Any, state: Any, action: Any, noise: Any) -> Mapping[str, Any]:
    """Raise an error."""
    return {**state, "x": 1 / 0}


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (forgets, "'y' is missing; 'n' is missing"),
        (invents, "'z' is not a state"),
        (flattens, r"'y' must have shape \(3,\), not \(2,\)"),
        (breaks, "'y' has a number that is not finite"),
        (halves, r"'n' must be whole numbers of at most 2\*\*53, not \[0.5\]"),
        (overflows, r"'n' must be whole numbers of at most 2\*\*53"),
        (talks, "'x' must be numbers"),
        (tears, "'y' must be numbers"),
        (lists, "it must be a dict of the states by name"),
        (writes, "ValueError: .*must not be changed: let it work on a copy"),
        (misspells, "KeyError: 'mas'; it is given parameters mass; states x, y, n"),
        (divides, "ZeroDivisionError: division by zero"),
    ],
)
def test_a_function_that_gives_no_state_is_an_error(function: Any, message: str) -> None:
    """The error names the variable, and the state is as before."""
    tables: dict[str, Any] = {
        "parameters": (Quantity("mass", (), 1.0),),
        "states": (Quantity("x"), Quantity("y", (3,)), Quantity("n", (), 1.0, integer=True)),
    }
    backend = built(StepModel("broken", function, DT, **tables))
    before = backend.read()
    with pytest.raises(EngineFailure, match=message) as caught:
        backend.step(np.empty(0), 1)
    assert caught.value.engine == "step"
    assert backend.read() == before


@njit
def overwrites(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Write into the state that it was given."""
    state[0] += 1.0
    return state


@njit
def shortens(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Give too few numbers."""
    return state[:1].copy()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (overwrites, "changed the state it was given"),
        (shortens, r"the state must have shape \(2,\), not \(1,\)"),
    ],
)
def test_a_function_of_arrays_is_held_to_the_same(function: Any, message: str) -> None:
    """A compiled function must not change what it is given, and gives the whole state."""
    states = (Quantity("x"), Quantity("y"))
    backend = built(StepModel("broken", function, DT, (), states, signature="arrays"))
    with pytest.raises(EngineFailure, match=message):
        backend.step(np.empty(0), 1)
    assert backend.read().vector.tolist() == [0.0, 0.0]


def test_what_does_not_exist_is_refused() -> None:
    """Unknown parameters, other modes and bodies are errors; nothing changes."""
    backend = built(MODELS["scalar"])
    with pytest.raises(UnknownOption, match=r"spring.stiffness, damping"):
        backend.apply(Difference(parameters={("", "mass"): np.array(1.0)}))
    assert backend.parameters([("", "damping")])["", "damping"] == 0.1
    with pytest.raises(UnknownOption, match=r"no parameter is named 'mass\.inertia'"):
        backend.parameters([("mass", "inertia")])


def test_only_step_functions_are_realised() -> None:
    """The name "step" is known, and a robot is refused with a remedy."""
    with pytest.raises(ModelError, match="choose 'mujoco' or 'bullet'"):
        make_backend("step").build(trifinger().default_scene())


def test_another_structure_carries_over_what_it_has_too() -> None:
    """Changing to a model with one more state keeps the others, and back again is exact."""
    model = MODELS["scalar"]
    backend = built(model)
    play(backend, 5)
    before, now = backend.read(), backend.snapshot().payload

    def longer(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
        return {**swing(parameters, state, action, noise), "age": state["age"] + 1.0}

    states = (Quantity("age", (), 7.0), *model.states)
    more = StepModel("swing", longer, DT, **{**TABLES, "states": states})
    backend.apply(Difference(structure=more))
    assert backend.read()["age"].tolist() == [7.0]
    np.testing.assert_array_equal(backend.read()["mass.velocity"], before["mass.velocity"])
    backend.apply(Difference(model, now.parameters, now.state))
    assert backend.read() == before


def test_models_are_values() -> None:
    """Equal models are equal, hash alike and can be pickled; another timestep is another one."""
    model = MODELS["scalar"]
    again = pickle.loads(pickle.dumps(model))  # noqa: S301 # our own
    assert again == model
    assert hash(again) == hash(model)
    assert StepModel("swing", swing, 0.1, **TABLES) != model
