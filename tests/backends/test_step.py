"""Step functions as a backend."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

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
from scm_world.models.scene import Difference, State
from scm_world.tasks.trifinger.system import trifinger

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


def test_what_is_taken_back_leaves_no_trace(model: StepModel) -> None:
    """Setting every parameter and every state, and setting them back, has exactly no effect."""
    backend, twin = built(model), built(model)
    play(backend, 3)
    play(twin, 3)
    keys = [quantity.key for quantity in model.parameters]
    before, state = backend.parameters(keys), backend.read()
    for key in keys:
        backend.apply(Difference(parameters={key: before[key] * 1.7 + 0.1}))
    backend.apply(Difference(state=State(model.layout, np.arange(5.0))))
    assert backend.read().vector.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    backend.apply(Difference(parameters=before, state=state))
    np.testing.assert_array_equal(play(backend, 20), play(twin, 20))


def test_a_snapshot_continues_bit_for_bit(model: StepModel) -> None:
    """What goes on from a snapshot, pickled and in another backend, is the same to the bit."""
    backend = built(model)
    backend.apply(Difference(parameters={("", "damping"): np.array(0.7)}))
    play(backend, 3)
    saved = pickle.loads(pickle.dumps(backend.snapshot()))  # noqa: S301 # our own
    expected = play(backend, 10)
    other = StepFunction()
    other.restore(saved)
    assert other.structure == model
    np.testing.assert_array_equal(play(other, 10), expected)
    other.restore(saved)
    np.testing.assert_array_equal(play(other, 10), expected)


def test_another_process_computes_the_same_bits(tmp_path: Path) -> None:
    """A snapshot goes on in a new process as it does here."""
    backend = built(MODELS["scalar"])
    play(backend, 3)
    file = tmp_path / "snapshot.pkl"
    file.write_bytes(pickle.dumps(backend.snapshot()))
    code = (
        "import pickle, sys, test_step as t; b = t.StepFunction();"
        "b.restore(pickle.load(open(sys.argv[1], 'rb'))); print(t.play(b, 20).tobytes().hex())"
    )
    child = subprocess.run(  # noqa: S603 # our own interpreter, our own code
        [sys.executable, "-c", code, str(file)],
        capture_output=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )
    assert child.stdout.decode().split()[-1] == play(backend, 20).tobytes().hex()


def test_a_snapshot_of_another_engine_is_refused() -> None:
    """The fake's snapshot cannot be restored here."""
    fake = make_backend("fake")
    fake.build(trifinger().default_scene())
    with pytest.raises(SnapshotMismatch, match="fake 1"):
        built(MODELS["scalar"]).restore(fake.snapshot())


def test_a_batch_is_one_after_another(model: StepModel) -> None:
    """Systems with different parameters move together as each one does alone."""
    alone, many = [built(model) for _ in range(5)], [built(model) for _ in range(5)]
    for row in range(5):
        for backend in (alone[row], many[row]):
            backend.apply(Difference(parameters={("", "damping"): np.array(0.1 * row)}))
    batch = StepFunction.batch.of(many, 2)
    into, draws = np.full((5, 7), np.nan), np.random.default_rng(0)
    for step in range(6):
        which = np.arange(5) if step % 2 else np.array([0, 3, 4])
        commands = draws.normal(size=(5, 4))
        commands[:, 2] = step
        batch.step(which, commands, 2, into)
        for row in which.tolist():
            alone[row].step(commands[row], 2)
            np.testing.assert_array_equal(into[row, :5], alone[row].read().vector)
            assert many[row].read() == alone[row].read()
    assert np.isnan(into[:, 5:]).all()


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
