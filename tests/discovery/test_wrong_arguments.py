"""Arguments of another kind: public functions of discovery refuse them by name."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world import SCM, Box, Derived, Exogenous, Linear
from scm_world.discovery import (
    Dataset,
    Design,
    EstimatedGraph,
    Learner,
    TaskView,
    benchmark,
    collect,
    discover,
    evaluate,
    learn,
    problem,
    register,
    sweep,
)
from scm_world.discovery.data import (
    as_causal_learn,
    as_dcdi,
    as_frame,
    as_gies,
    as_huggingface,
    as_tigramite,
    default_causes,
    default_outcomes,
    from_frame,
    load,
    save,
    triplets,
)
from scm_world.discovery.learners import learners
from scm_world.discovery.metrics import sortability
from scm_world.errors import ModelError, ScmWorldError, UnknownOption
from scm_world.queries import World
from scm_world.variables import Normal

NOISE = Normal()
MODEL = SCM(
    [
        Exogenous(name="x", distribution=NOISE, a=Box(5, 9)),
        Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,)), noise=NOISE),
    ]
)
TABLE = collect(MODEL, Design("single", ("x",)), 60)
FOUND = EstimatedGraph.of_edges(["x", "y"], [("x", "y", 0)])
TRUTH: Any = TABLE.truth
WRONG = (None, 3, -1, 2.5, "text", [1], {"x": 1}, object(), np.ones(3), len, TABLE, MODEL, ("q",))

CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "collect": (collect, {"source": MODEL, "design": Design(), "n": 2, "seed": 0, "shard": 10}),
    "design": (Design, {"name": "single", "targets": ("x",), "observational_fraction": 0.3}),
    "sweep": (sweep, {"system": MODEL, "over": {"x": [1, 2]}, "outcomes": ["y"], "n": 2}),
    "table": (Dataset.of, {"values": [[1.0]], "names": ["x"], "targets": [()], "episode": [0]}),
    "select": (TABLE.select, {"names": ["x"]}),
    "hide": (TABLE.hide, {"names": ["x"]}),
    "rows": (TABLE.rows, {"chosen": [0]}),
    "first": (TABLE.first, {"episodes": 1}),
    "lagged": (TABLE.lagged, {"lags": 1}),
    "joined": (Dataset.joined, {"parts": [TABLE]}),
    "default_causes": (default_causes, {"world": MODEL}),
    "default_outcomes": (default_outcomes, {"world": World("pushing", backend="fake")}),
    "from_frame": (from_frame, {"frame": as_frame(TABLE), "trusted": ()}),
    "learn": (learn, {"given": "do_order", "data": TABLE, "shuffle": True, "q": 0.01}),
    "learner": (Learner, {"name": "n", "learn": len}),
    "register": (register, {"learner": learners()["empty"]}),
    "matrix": (EstimatedGraph.of, {"names": ["x"], "matrix": [[0]], "edge_scores": [[0]]}),
    "edges": (EstimatedGraph.of_edges, {"names": ["x", "y"], "edges": [("x", "y", 0)]}),
    "marks": (EstimatedGraph.of_marks, {"names": ["x", "y"], "marks": [[0, 1], [2, 0]]}),
    "restricted": (FOUND.restricted, {"names": ["x"]}),
    "evaluate": (evaluate, {"found": FOUND, "declared": TRUTH, "names": None, "pairs": None}),
    "sortability": (sortability, {"data": TABLE, "edges": TRUTH}),
    "mag": (TRUTH.mag, {"lags": 0}),
    "problem": (problem, {"name": "er2:4", "seed": 0, "view": None}),
    "view": (TaskView, {"view": "step", "causes": None, "steps": 2, "options": {}}),
    "discover": (discover, {"system": MODEL, "probes": 1, "seed": 0}),
    "triplets": (triplets, {"world": World("pushing", backend="fake"), "factors": [], "n": 1}),
    "benchmark": (benchmark, {"learners": [], "problems": [], "budgets": [], "seeds": 0}),
    **{view.__name__: (view, {"dataset": TABLE}) for view in (as_gies, as_frame)},
    **{view.__name__: (view, {"dataset": TABLE}) for view in (as_causal_learn, as_tigramite)},
}
FOLDERS: dict[str, Callable[[Any], Any]] = {
    "collect": lambda path: collect(MODEL, Design(), 2, out=path),
    "save": lambda path: save(TABLE, path),
    "load": load,
    "as_dcdi": lambda path: as_dcdi(TABLE, path),
    "as_huggingface": as_huggingface,
}


@pytest.mark.parametrize("name", CALLS)
def test_another_kind_of_argument_is_refused_or_taken(name: str, tmp_path: Path) -> None:
    """No call ends in an error of Python: what cannot be used is an error of this package."""
    call, given = CALLS[name]
    if name == "triplets":
        given = {**given, "out": tmp_path / "triplets"}
    if name not in ("triplets", "benchmark", "as_tigramite"):  # which are refused
        call(**given)
    for argument, wrong in product(given, WRONG):
        with suppress(ScmWorldError):
            call(**{**given, argument: wrong})


@pytest.mark.parametrize("name", FOLDERS)
def test_what_is_no_path_is_refused(name: str) -> None:
    """None as an output folder means memory; a number, a list or a table are no paths."""
    for wrong in (3, 2.5, ["a"], {}, TABLE, len):
        with pytest.raises(UnknownOption, match=r"path|folder"):
            FOLDERS[name](wrong)


def test_the_argument_and_its_kind_are_named() -> None:
    """A message says which argument it is, what was given, and what it can be."""
    with pytest.raises(UnknownOption, match="design cannot be None; it can be: of type Design"):
        collect(MODEL, None, 3)  # type: ignore[arg-type] # it is refused
    with pytest.raises(UnknownOption, match="shuffle cannot be 'no'; it can be: True or False"):
        learn("empty", TABLE, shuffle="no")  # type: ignore[arg-type] # it is refused
    with pytest.raises(TypeError, match="missing"):
        collect(MODEL)  # type: ignore[call-arg] # Python says so


def test_a_truth_or_a_model_can_stand_for_its_edges() -> None:
    """A truth brings its names and the pairs that count; a table that knows none is refused."""
    edges = [edge.key for edge in MODEL.edges]
    wide = EstimatedGraph.of_edges(["x", "y", "z"], [("x", "y", 0), ("x", "z", 0)])
    assert evaluate(wide, TRUTH).shd == 0
    assert evaluate(FOUND, MODEL) == evaluate(FOUND, edges) == evaluate(FOUND, TRUTH)
    given = problem("servo:6:1")
    named = {"names": given.truth.names, "pairs": given.truth.pairs}
    assert evaluate(FOUND, given.truth) == evaluate(FOUND, given.truth.edges, **named)
    given.close()
    with pytest.raises(UnknownOption, match="declared cannot be None"):
        evaluate(FOUND, Dataset.of([[1.0]], ["x"]).truth)  # type: ignore[arg-type] # unknown
    with pytest.raises(UnknownOption, match=r"tuple\[str, str, int\]"):
        evaluate(FOUND, [("x", "y")])  # type: ignore[list-item] # it is refused


@pytest.mark.parametrize(
    "matrix", [None, "text", [[0, 1]], [["a", "b"], ["c", "d"]], [[0, 1j], [0, 0]], [[0], [0, 1]]]
)
def test_a_wrong_matrix_is_told_of_its_learner(matrix: Any) -> None:
    """The message names the learner, what it returned and what it has to return."""
    with pytest.raises(ModelError, match=r"^the learner 'mine' returned no graph: matrix of 2 v"):
        learn(Learner("mine", lambda data, seed=0: matrix), TABLE)
    given = [[0, 1], [0, np.nan]]
    with pytest.raises(ModelError, match=r"^the learner 'mine' returned no graph: .* not finite"):
        learn(Learner("mine", lambda data, seed=0: given), TABLE)


def test_factors_without_a_space_are_named(tmp_path: Path) -> None:
    """The factor, or that there is none, and which variables there are."""
    world = World("pushing", backend="fake")
    for factors, said in (("reward", "factor cannot be 'reward'"), ((), r"factors cannot be \(\)")):
        with pytest.raises(UnknownOption, match=f"{said}; it can be: variables with a space A: "):
            triplets(world, factors, 2, tmp_path / "out")
