"""Every public method of a ``World`` answers on one world, on many, and on equations."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scm_world import SCM, World, verify
from scm_world.discovery import Design, collect
from scm_world.errors import ModelError, ScmWorldError
from scm_world.fit import fit
from scm_world.queries import consequences
from scm_world.variables import (
    Action,
    Box,
    Derived,
    Exogenous,
    Hard,
    Linear,
    Measured,
    Normal,
    Parent,
)
from scm_world.world import Batch, EquationBatch

N = 3
MODEL = SCM(
    [
        Exogenous(name="x", distribution=Normal(), a=Box(0.0, 1.0)),
        Action(name="push", bounds=Box(-1.0, 1.0)),
        Derived(
            name="z",
            parents=(Parent("z", 1), Parent("push", 1), Parent("x", 1)),
            mechanism=Linear(weights=(0.5, 1.0, 1.0)),
        ),
    ]
)


def _grow(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    return {"z": 0.5 * state["z"] + action["push"] + parameters["x"]}


def growth(**options: Any) -> Any:
    """Make the same as a step function."""
    return World(
        _grow,
        parameters=[
            Exogenous(name="x", default=0.5, bounds=Box(-9.0, 9.0), a=Box(0.0, 1.0)),
        ],
        states=[Measured(name="z", default=0.0, parents=("x", "z", "push"))],
        actions=[Action(name="push", bounds=Box(-1.0, 1.0))],
        control_dt=1.0,
        **options,
    )


MAKERS: dict[str, Any] = {
    "engine": growth,
    "equations": lambda **options: World(MODEL, **options),
}
DO, STEPS = {"do": {"x": 1.0}}, {"steps": 2}
PAIR = {**DO, "versus": {"x": 0.0}, "n": 4, **STEPS}
RECORDED = {"time": np.arange(6.0), "push": np.zeros(6), "z": np.arange(6.0)}
QUESTIONS: dict[str, tuple[tuple[Any, ...], dict[str, Any]]] = {
    "compare": (("fake",), {"probes": 1}),
    "contacts": ((), {}),
    "cameras": ((), {}),
    "direct_effect": (("z",), {**PAIR, "mediators": {"push": 0.0}}),
    "effect": (("z",), PAIR),
    "effect_by": (("z",), {**PAIR, "by": "x", "bins": 1}),
    "effect_over": (("z",), {"name": "x", "values": [0.0, 1.0], "n": 4, **STEPS}),
    "explain": ((RECORDED,), {}),
    "fidelity": ((), {}),
    "fit": ((RECORDED, "x"), {}),
    "identify": (("x", "z@0"), {}),
    "idle": ((), {}),
    "is_set_at_once": (("z",), {}),
    "length": ((3,), {}),
    "live": ((), DO),
    "local_graph": ((), {}),
    "may_have": (("z",), {}),
    "planned": (({"x": 1.0},), {}),
    "require_exact": (("a question",), {}),
    "rollout": ((), {**DO, **STEPS}),
    "sample": ((3,), STEPS),
    "scene": ((), {}),
    "see": ((3,), STEPS),
    "usual_columns": ((), {}),
    "usual_outcomes": ((), {}),
    "usual_setting": ((), {}),
    "verify": ((), {"probes": 2, "held_out": 1}),
}
"""Arguments of all methods that leave the world as it is, but ``given`` and copies."""

CHANGES = {
    *(
        "act",
        "close",
        "do",
        "evaluate",
        "for_fit",
        "given",
        "maker",
        "reset",
        "restore",
        "snapshot",
    ),
    *("step", "unchanged", "values", "way_back"),
}
"""The other methods, which the tests below call."""

OF_ONE = {"cameras", "contacts", "local_graph", "scene"}
"""Methods that are about the present of one world."""

MANY = {"has_begun", "index", "is_lost", "is_planned", "one", "requested", "version", "backend"}
"""Attributes that do not have equal values in one world and in many."""


def answered(world: Any, name: str) -> Any:
    """Ask a world, and return its answer, or its error, in a form that can be compared."""
    given, named = QUESTIONS[name]
    try:
        found = getattr(world, name)(*given, **named)
    except ScmWorldError as error:
        return type(error), str(error)
    if name in ("fit", "explain"):
        return str(found).split(" seconds")[0] if name == "explain" else found.values
    if name == "verify":
        return found.outcome, found.undeclared
    if name == "live":
        found.step()
        found = found.episode()
    if name in ("rollout", "live"):
        return found["x"].tolist(), found.plan
    if name in ("sample", "see"):
        return {key: values.tolist() for key, values in found.items()}
    if name == "compare":
        return found.share
    return str(found)


def test_every_public_name_of_a_world_is_tested_here() -> None:
    """A new method is answered by all kinds of worlds, or says why it is not."""
    methods = {n for n in dir(World) if n[0] != "_" and callable(getattr(World, n))}
    assert methods == {*QUESTIONS, *CHANGES}


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("name", QUESTIONS)
def test_many_worlds_answer_as_one(kind: str, name: str) -> None:
    """A question about the model has the answer of one world; others name ``worlds.world(i)``."""
    one, many = MAKERS[kind](), MAKERS[kind](num_worlds=N)
    one.reset(seed=0)
    many.reset(seed=0)
    if name in OF_ONE:
        with pytest.raises(ModelError, match=rf"ask worlds\.world\(i\)\.{name}"):
            getattr(many, name)()
        return
    assert answered(many, name) == answered(one, name)
    many.step(np.zeros((N, 1)))  # the present is no part of the question
    many.do({"x": [0.1, 0.2, 0.3]})
    if name not in ("identify", "verify"):
        assert answered(many, name) == answered(one, name)


@pytest.mark.parametrize("kind", MAKERS)
def test_many_worlds_are_a_world(kind: str) -> None:
    """They have all attributes; those of the model are the same as in one world."""
    one, many = MAKERS[kind](), MAKERS[kind](num_worlds=N)
    assert isinstance(many, World)
    assert isinstance(many, EquationBatch if kind == "equations" else Batch)
    one.reset(seed=0)
    many.reset(seed=0)
    for name in dir(World):
        if name[0] == "_" or callable(getattr(World, name)) or name in MANY:
            continue
        assert str(getattr(many, name)) == str(getattr(one, name)), name
    assert (many.has_begun, many.is_lost, many.is_planned) == (True, False, False)
    for name in ("requested", "noise", "episode"):
        with pytest.raises(ModelError, match=rf"worlds\.world\(i\)\.{name}"):
            getattr(many, name)
    twin = many.maker()()
    twin.reset(seed=0)
    for name, value in many.evaluate().items():
        np.testing.assert_array_equal(value[0], one[name])
        np.testing.assert_array_equal(twin[name], one[name])
    version = many.version
    saved = many.snapshot()
    many.do({"x": 2.0})
    assert many.version > version
    many.step(np.ones((N, 1)))
    many.restore(saved)
    np.testing.assert_array_equal(many["x"][0], one["x"])
    with many.unchanged():
        many.reset(seed=9)
        many.step(np.ones((N, 1)))
    np.testing.assert_array_equal(many["x"][0], one["x"])
    many.close()


@pytest.mark.parametrize("kind", MAKERS)
def test_what_all_were_given_is_the_context_of_questions(kind: str) -> None:
    """``given`` holds in all worlds and in every question; a source may bring it."""
    one, many = MAKERS[kind](), MAKERS[kind](num_worlds=N)
    context = {"x": 1.5, "z": Hard(4.0, at=1)}
    held, one = many.given(context), one.given(context)
    assert held.plan == one.plan
    assert not many.plan
    assert held.sample(2, outcomes="z", steps=3)["z"].tolist() == [
        *one.sample(2, outcomes="z", steps=3)["z"]
    ]
    for each in (held, World(one, num_worlds=N), World(held, num_worlds=N)):
        each.reset(seed=0)
        assert each["x"].tolist() == [1.5] * N
        each.step(np.zeros((N, 1)))
        assert [*each.act()] == [0, 1, 2]
        assert each["z"].tolist() == [4.0] * N
        assert each.is_planned
    held.do({"x": 2.0}, where=np.arange(N) < 1)
    with pytest.raises(ModelError, match=r"different interventions: ask worlds\.world\(i\)"):
        held.identify("x", "z@0")


@pytest.mark.parametrize("kind", MAKERS)
def test_functions_take_many_worlds_as_one(kind: str) -> None:
    """What takes a world takes many of them: the question is the same."""
    one, many = MAKERS[kind](), MAKERS[kind](num_worlds=N)
    design = Design("single", ("x",), "A", 0.5)
    tables = [collect(world, design, 4, steps=2) for world in (one, many)]
    np.testing.assert_array_equal(tables[0].values, tables[1].values)
    assert verify(many, probes=1).outcome == verify(one, probes=1).outcome
    fits = [fit(world, RECORDED, "x").values for world in (one, many)]
    assert fits[0] == fits[1]
    found = [consequences(world, {"x": 1.0}, steps=2) for world in (one, many)]
    assert found[0].variables.equals(found[1].variables)
