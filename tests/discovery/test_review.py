"""What a hostile reader found, and what is so no more."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scm_world.discovery.data import Dataset
from scm_world.discovery.exam.sittings import cell_path
from scm_world.discovery.exam.study import Study, examine
from scm_world.discovery.exam.subjects import ModelSubject, TaskView, subject, subject_mark
from scm_world.discovery.learners import Found, Learner, learn
from scm_world.discovery.learners.apparatus import Model
from scm_world.discovery.learners.moving import sparse_pooled
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.graph import SCM, to_json
from scm_world.variables import Box, Derived, Exogenous, Function, Integers, Linear, Parent
from scm_world.variables.distributions import Normal

TABLE = Dataset.of(np.random.default_rng(0).normal(size=(40, 2)), ["x", "y"])
ONE = Normal(mean=0.0, std=1.0)


def first_of(v: Any, noise: Any = 0.0) -> Any:
    """Give the first number of a vector."""
    return v[..., 0] + noise


def pair(forward: bool) -> SCM:
    """Make x act on y, or y on x."""
    cause, effect = ("x", "y") if forward else ("y", "x")
    return SCM(
        [
            Derived(name=cause, parents=(), mechanism=Linear(weights=()), noise=ONE),
            Derived(name=effect, parents=(cause,), mechanism=Linear(weights=(2.0,)), noise=ONE),
        ]
    )


def study(*subjects: str, learners: tuple[str, ...] = ("do_order",), **more: Any) -> Study:
    """Describe a small exam."""
    return Study(subjects, learners, budgets=(80, 160), seeds=1, standardised=False, **more)


def test_a_model_that_was_changed_is_another_exam(tmp_path: Path) -> None:
    """Its old results are not shown beside its new graph."""
    file = tmp_path / "model.json"
    file.write_text(to_json(pair(forward=True)))
    examine(study(str(file)), tmp_path / "out")
    file.write_text(to_json(pair(forward=False)))
    with pytest.raises(UnreadableFile, match="marks differ"):
        examine(study(str(file)), tmp_path / "out")


def test_another_engine_or_library_is_another_exam(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results of different versions are never shown beside one another."""
    sitting = study("er2:5", learners=("gies",))
    examine(sitting, tmp_path)
    monkeypatch.setattr("scm_world.discovery.learners.registry._version", lambda _: "99")
    with pytest.raises(UnreadableFile, match="marks differ"):
        examine(sitting, tmp_path)
    fake = TaskView(options={"backend": "fake"})
    assert subject_mark("pushing", fake) != subject_mark("pushing", TaskView())


def test_no_learner_of_an_exam_is_handed_the_graph() -> None:
    """A check of a declared graph is none, and no function gets the graph by its signature."""
    with pytest.raises(UnknownOption, match="not handed the graph"):
        study("er2:5", learners=("coloring",))


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (np.array([[0.0, np.nan], [0.0, 0.0]]), "not finite"),
        (Found.of_edges(["a", "b"], [("a", "b", 0)]), "which is not in the data"),
    ],
    ids=["nan", "names"],
)
def test_what_is_no_graph_of_the_data_is_refused(matrix: Any, reason: str) -> None:
    """NaN is no edge, and other names are not those of the data."""
    with pytest.raises(ModelError, match=reason):
        learn(Learner("mine", lambda data, seed: matrix), TABLE)


def test_sureness_is_not_turned_around() -> None:
    """Log-probabilities are refused: their absolute value would rank them backwards."""
    with pytest.raises(ModelError, match="negative"):
        Found.of(["x", "y"], [[0, 1], [0, 0]], sureness=[[0.0, -0.1], [0.0, 0.0]])


def test_a_cell_under_another_name_is_refused(tmp_path: Path) -> None:
    """Its run is named in it."""
    sitting = study("er2:5")
    examine(sitting, tmp_path)
    one, other = (cell_path(tmp_path, job) for job in next(iter(sitting.jobs(tmp_path))))
    other.write_text(one.read_text())
    with pytest.raises(UnreadableFile, match="of another run"):
        examine(sitting, tmp_path)


def test_models_with_bounds_vectors_and_whole_numbers() -> None:
    """What is set lies in the bounds, and is whole where it has to be."""
    model = SCM(
        [
            Exogenous(name="r", default=0.5, bounds=Box(0.0, 1.0), distribution=Box(0.0, 1.0)),
            Exogenous(name="n", dtype="integer", default=1, bounds=Integers(0, 4)),
            Exogenous(
                name="v",
                shape=(3,),
                default=(0.0, 0.0, 0.0),
                distribution=Box((-1.0,) * 3, (1.0,) * 3),
                bounds=Box((-1.0,) * 3, (1.0,) * 3),
            ),
            Derived(
                name="y",
                parents=("v",),
                mechanism=Function(first_of),
                noise=Normal(mean=0.0, std=0.1),
            ),
        ]
    )
    made = ModelSubject("mixed", model)
    data = made.data("do", 400, 0)
    targets = {name for regime in data.regimes for name in regime.targets}
    assert targets == {"r", "n", "v", "y"}
    assert 0.0 <= data["r"].min() <= data["r"].max() <= 1.0
    assert set(np.unique(data["n"])) <= {0.0, 1.0, 2.0, 3.0, 4.0}
    assert made.test(0) is None
    found = learn("do_order", data)
    assert found.directed == (("v", "y", 0),)


def test_pooled_says_that_it_sees_one_lag() -> None:
    """A model with edges of both lags is not found whole, and a note says so."""
    model = SCM(
        [
            Derived(name="x", parents=(Parent("x", 1),), mechanism=Linear(weights=(0.5,))),
            Derived(name="y", parents=("x",), mechanism=Linear(weights=(2.0,))),
        ]
    )
    assert sparse_pooled(Model(model)).notes == ("edges of lag 1 only, and there are others",)


def test_do_order_says_where_its_bound_does_not_hold() -> None:
    """On straight lines there is no note; on curves there is one."""
    notes: Mapping[str, Any] = {
        name: learn("do_order", subject(name).data("do", 3000, 0)).notes
        for name in ("er2:10", "tanh4:8")
    }
    assert not any("adds up" in note or "add up" in note for note in notes["er2:10"])
    assert any("add up to" in note for note in notes["tanh4:8"])


def test_a_setting_that_cannot_be_written_fails_its_run_only(tmp_path: Path) -> None:
    """The rest of the exam goes on."""
    exam = examine(study("er2:5", learners=("do_order", "user_learners:unwritable")), tmp_path)
    status = {cell.learner: cell.status for cell in exam.cells}
    assert status == {"do_order": "done", "user_learners:unwritable": "failed"}
    assert json.loads((tmp_path / "exam.json").read_text())["about"]
