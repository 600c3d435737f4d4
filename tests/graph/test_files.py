"""Facts about models in files and as graphs."""

from __future__ import annotations

import json
import math
import sys
from typing import Any

import numpy as np
import pytest

from scm_world.errors import ModelError
from scm_world.graph import (
    SCM,
    from_json,
    to_json,
)
from scm_world.tasks import TASKS
from scm_world.variables import (
    Affine,
    Box,
    Derived,
    Draw,
    Exogenous,
    Function,
    Linear,
    Measured,
    Normal,
    Parent,
    Scale,
    Shift,
)
from scm_world.world import Simulation


def double(x: Any, noise: Any = 0.0) -> Any:
    """Multiply by two."""
    return 2.0 * x + noise


HERE = __name__.partition(".")[0]


def model() -> SCM:
    """Build a model with everything that is hard to write down."""
    return SCM(
        [
            Exogenous(
                name="a",
                bounds=Box(-math.inf, math.inf),
                default=0.1 + 0.2,
                distribution=Normal(1e-300, 1.0 / 3.0),
            ),
            Exogenous(
                name="b", shape=(2,), default=(0.0, -0.0), a=Box((0.0, Affine(parent="a")), 9)
            ),
            Derived(name="c", parents=("a", Parent("b", 1)), mechanism=Linear(weights=(1, 2))),
            Derived(name="d", parents=("a",), mechanism=double, noise=Normal()),
            Measured(name="e", parents=("d", Parent("a", 1, "contact")), settable_state=True),
        ]
    )


HELD = {"a": 0.3, "b": Shift((0.1, 0.2)), "c": Scale(2.0), "d": Draw(Box(0.0, Affine(parent="a")))}


@pytest.mark.parametrize("held", [{}, HELD], ids=["declared", "intervened"])
def test_json_loses_nothing(held: dict[str, Any]) -> None:
    """Variables and interventions come back equal, and so does the text."""
    first = model().do(held)
    text = to_json(first)
    again = from_json(text, trusted=(HERE,))
    assert again == first
    assert again.edges == first.edges
    assert to_json(again) == text


def test_json_is_json() -> None:
    """Infinities are written as text, so that any reader can read the file."""

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    json.loads(to_json(model()), parse_constant=refuse)


@pytest.mark.parametrize("task", TASKS)
def test_the_model_of_every_task_survives_json(task: str) -> None:
    """The declared models can be sent, and solve to the same values."""
    first = Simulation(task, backend="fake").model
    again = from_json(to_json(first))
    assert again == first
    static = [
        name for name in first if first[name].role == "parameter" and not first.ancestors(name)
    ]
    one, other = first.solve(only=static), again.solve(only=static)
    assert all(np.array_equal(one[name], other[name]) for name in static)


@pytest.mark.parametrize(
    "reference",
    [
        "os:system",
        "subprocess:run",
        "scm_world.graph.files:json.loads",
        "scm_world.variables.distributions:lru_cache",
        "scm_world.no_such_module:f",
        "scm_world_evil:f",
        "builtins:eval",
    ],
)
def test_functions_from_elsewhere_are_not_loaded(reference: str) -> None:
    """Reading a file never runs code that the reader did not ask for."""
    plain = json.loads(to_json(model()))
    plain["variables"][3]["mechanism"]["reference"] = reference
    with pytest.raises(ModelError, match="trusted"):
        from_json(json.dumps(plain), trusted=(HERE,))


@pytest.mark.parametrize("field", ["mechanism", "inverse_noise"])
def test_every_function_of_a_declaration_needs_trust(field: str) -> None:
    """The inverse of the noise is called as the mechanism is."""
    model = SCM([Derived(name="y", parents=(), mechanism=Linear(weights=()), noise=Normal())])
    plain = json.loads(to_json(model))
    plain["variables"][0][field] = {"kind": "function", "reference": "os:system", "constants": {}}
    with pytest.raises(ModelError, match="trusted"):
        from_json(json.dumps(plain))


def test_a_file_does_not_import_what_is_not_trusted() -> None:
    """Not even the module of a function from elsewhere is imported."""
    plain = json.loads(to_json(model()))
    plain["variables"][3]["mechanism"]["reference"] = "antigravity:fly"
    with pytest.raises(ModelError):
        from_json(json.dumps(plain))
    assert "antigravity" not in sys.modules


def test_own_functions_need_trust() -> None:
    """A function of the user's own module is read when the user says so."""
    text = to_json(model())
    with pytest.raises(ModelError, match="outside the trusted packages scm_world"):
        from_json(text)
    assert from_json(text, trusted=(HERE,)).solve({"e": np.zeros(())})["d"] == 2.0 * (0.1 + 0.2)


def test_a_lambda_cannot_be_written() -> None:
    """All functions without a name of their own are listed."""

    def local(x: Any) -> Any:
        return x

    lost = SCM(
        [
            Exogenous(name="a"),
            Derived(name="b", parents=("a",), mechanism=lambda a: a),
            Derived(name="c", parents=("a",), mechanism=Function(local)),
        ]
    )
    with pytest.raises(ModelError, match="define it at the top level of a module") as caught:
        to_json(lost)
    assert len(caught.value.problems) == 2


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not json",
        "[]",
        "{}",
        '{"format": "scm_world/model/2"}',
        '{"format": "scm_world/model/2", "variables": [{"kind": "exogenous"}]}',
        '{"format": "scm_world/model/2", "variables": [{"kind": "alien", "name": "x"}]}',
        '{"format": "scm_world/model/2", "variables": [{"kind": "exogenous", "name": "x", '
        '"a": {"kind": "box", "low": 0}}]}',
        '{"format": "scm_world/model/2", "variables": [], '
        '"interventions": {"x": {"kind": "hard", "value": 1}}}',
        '{"format": "scm_world/model/2", "variables": [{"kind": "derived", "name": "x", '
        '"parents": [{"name": "y", "bogus": 1}], '
        '"mechanism": {"kind": "linear", "weights": [1]}}]}',
    ],
)
def test_what_is_no_model_is_refused(text: str) -> None:
    """Broken files give one kind of error."""
    with pytest.raises(ModelError):
        from_json(text)
