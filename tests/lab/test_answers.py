"""Answers of questions, confirmed by closed forms and by plain MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from scm_world import lab
from scm_world.errors import ModelError
from scm_world.lab.questions import Unusable, build
from scm_world.lab.worlds import RIGS, WORLDS, equations


def drawn(kind: str, world: str, n: int, **knobs: Any) -> list[lab.Question]:
    """Return the first n draws that make a question; they need not be certified."""
    found: list[lab.Question] = []
    for draw in range(40):
        if len(found) == n:
            break
        try:
            found.append(build(kind, world, 7, "L2", lab.Knobs(**knobs), draw, None))
        except Unusable:
            continue
    assert len(found) == n
    return found


def weights(asked: lab.Question) -> tuple[list[str], np.ndarray]:
    """Return the names of a linear model, and its weights, shape (n, n), from column to row."""
    model: Any = asked.view.testbed.world
    names = list(model)
    found = np.zeros((len(names), len(names)))
    for row, name in enumerate(names):
        one = model.declared(name)
        for parent, weight in zip(
            one.all_parents, getattr(one.equation, "weights", ()), strict=True
        ):
            found[row, names.index(parent.name)] = weight
    return names, found


def total(asked: lab.Question, cause: str, outcome: str) -> float:
    """Return the sum over all paths of the products of their weights, with the cause cut."""
    names, direct = weights(asked)
    direct[names.index(cause)] = 0.0
    return float(
        np.linalg.inv(np.eye(len(names)) - direct)[names.index(outcome), names.index(cause)]
    )


def test_effects_of_linear_equations_are_sums_over_paths() -> None:
    """Pairs of episodes share their noise, so that the mean is exact."""
    for asked in drawn("effect", "equations", 3):
        q = asked.query
        slope = total(asked, q["cause"], q["outcome"])
        assert asked.answer == pytest.approx(slope * (q["to"] - q["from"]), rel=1e-9)


def test_counterfactuals_of_linear_equations_keep_the_noise_of_the_run() -> None:
    """The outcome moves by the effect of the change of the cause in this run."""
    for asked in drawn("counterfactual", "equations", 3):
        q = asked.query
        slope = total(asked, q["cause"], q["outcome"])
        moved = slope * (q["value"] - q["run"][q["cause"]])
        assert asked.answer == pytest.approx(q["run"][q["outcome"]] + moved, rel=1e-9)


def test_laws_predictions_and_targets_of_linear_equations_follow_from_their_weights() -> None:
    """Means under several interventions have the same noise: their differences are exact."""
    (law,), (control,) = drawn("law", "equations", 1), drawn("control", "equations", 1)
    slope = total(law, law.query["cause"], law.query["outcome"])
    places, means = (np.array(law.answer[name]) for name in ("values", "means"))
    np.testing.assert_allclose(np.diff(means), slope * np.diff(places), atol=1e-9)
    slope = total(control, control.query["cause"], control.query["outcome"])
    ((cause, value),) = control.answer.items()
    assert control.query["target"] == pytest.approx(slope * value, abs=0.1)  # of 4,000 units
    assert control.grade({cause: value}) == 1.0
    (asked,) = drawn("prediction", "equations", 1)
    names, direct = weights(asked)
    row, first = direct[names.index(asked.query["outcome"])], asked.query["dos"][0]
    for do, mean in zip(asked.query["dos"], asked.answer, strict=True):
        moved = sum(row[names.index(name)] * (value - first[name]) for name, value in do.items())
        assert mean - asked.answer[0] == pytest.approx(moved, abs=1e-9)


@pytest.mark.parametrize("law", ["plain", "dead zone"])
def test_no_constant_answer_reaches_many_targets(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets are uniform in the outcome's range, also where a law is flat in the middle."""

    def cheap(*given: Any) -> Any:
        return replace(equations(*given), truth=200)

    monkeypatch.setitem(WORLDS, "equations", (cheap, ""))  # type: ignore[index]
    found = []
    for asked in drawn("control", "equations", 35, law=law):
        ((cause, _),) = asked.answer.items()
        low, high = asked.view.ends(cause)
        shares = (0.0, 0.12, 0.3, 0.5, 0.7, 0.88, 1.0)
        found.append([asked.grade({cause: low + share * (high - low)}) for share in shares])
    again = lab.Question.of({**asked.spec, "level": "L4"})
    inner = [again.view.inner(*pair) for pair in again.answer.items()]
    np.testing.assert_allclose(inner, [*asked.answer.values()], atol=0.002 * (high - low))
    assert np.mean(found, axis=0).max() <= 0.25  # 0.13 are expected, of 35 questions


def test_explanations_set_all_variables_at_the_same_distance() -> None:
    """The one that is farthest from its usual value is not told by its number."""
    for level in ("L2", "L4"):
        (asked,) = drawn("explanation", "springs", 1)
        asked = lab.Question.of({**asked.spec, "level": level})
        q, ends = asked.query, asked.view.ends
        far = [abs(q["set"][n] - q["usual"][n]) / np.ptp(ends(n)) for n in q["set"]]
        np.testing.assert_allclose(far, far[0], atol=1e-5)
        assert far[0] >= 0.2


def test_answers_that_are_names_are_drawn_before_the_rest() -> None:
    """All draws of a seed have one, at all levels, and another key another one."""
    causes = [*RIGS["funnel"].causes]
    for kind in ("explanation", "diagnosis"):
        one, other = drawn(kind, "funnel", 2)
        lot = one.view.lot
        assert one.answer == other.answer == causes[int(6 * lot)]
        assert one.query["run"] != other.query["run"]
        shown = lab.Question.of({**one.spec, "level": "L4"})
        assert shown.view.quantities[shown.answer].name == one.answer


def test_edges_of_equations_are_those_of_their_weights() -> None:
    """Pairs with a hidden common cause are those on which one acts."""
    (asked,) = drawn("graph", "equations", 1)
    names, direct = weights(asked)
    edges = [[names[i], names[j]] for j, i in np.argwhere(direct).tolist()]
    shown = sorted(edge for edge in edges if not edge[0].startswith("h"))
    assert asked.answer["edges"] == shown
    for hidden in (name for name in names if name.startswith("h")):
        pair = sorted(effect for cause, effect in edges if cause == hidden)
        assert pair in asked.answer["hidden"]


def test_a_randomised_arm_stays_where_it_was_drawn_and_others_follow() -> None:
    """A pair of numbers is drawn once in an episode, although commands act in each step."""
    (asked,) = drawn("graph", "servo", 1)
    cause, effect = asked.answer["edges"][0]
    others = {name: 0.0 for name in asked.view.quantities if name not in (cause, effect)}
    seen = asked.view.run({cause: [-0.3, 0.2], **others}, 20)
    assert -0.32 < seen[cause].min() < -0.15 < 0.05 < seen[cause].max() < 0.22
    one, other = (asked.view.means({cause: v, **others})[effect] for v in (-0.3, 0.2))
    slope = np.polyfit(seen[cause], seen[effect], 1)[0]
    assert slope == pytest.approx((other - one) / 0.5, abs=0.35)


def simulated(asked: lab.Question, values: Mapping[str, float]) -> dict[str, float]:
    """Return the readings of springs, by a loop over steps of MuJoCo."""
    k = np.random.default_rng([asked.view.entropy, 0]).uniform(0.7, 1.4, 3)
    model = mujoco.MjModel.from_xml_string(RIGS["springs"].xml(asked.knobs.law, k))
    data = mujoco.MjData(model)
    for name in ("left", "right"):
        model.body(name).mass = values[f"{name}.mass"]
        data.joint(name).qvel = values[f"{name}.velocity"]
    data.joint("left").qpos = values["left.position"]
    model.tendon_stiffness[0] = values["spring.stiffness"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    path = []
    for _ in range(4):
        mujoco.mj_step(model, data, 30)
        path.append([float(data.joint(name).qpos[0]) for name in ("left", "right")])
    found = {}
    for name, at in zip(("left", "right"), np.transpose(path), strict=True):
        found[f"{name}.position.final"] = at[-1]
        found[f"{name}.position.mean"], found[f"{name}.position.max"] = at.mean(), at.max()
    return found


@pytest.mark.parametrize("law", ["plain", "cubic", "square", "dead zone"])
def test_laws_of_springs_are_those_of_mujoco(law: str) -> None:
    """Altered laws, too."""
    (asked,) = drawn("law", "springs", 1, law=law, distractors=0)
    q = asked.query
    for value, mean in zip(asked.answer["values"], asked.answer["means"], strict=True):
        found = simulated(asked, {**q["held"], q["cause"]: value})
        assert mean == pytest.approx(found[q["outcome"]], abs=1e-9)


def test_explanations_and_diagnoses_of_springs_are_those_of_mujoco() -> None:
    """One variable alone keeps a run from failing, and one alone makes the recording."""
    (asked,) = drawn("explanation", "springs", 1)
    q, sign = asked.query, 1.0 if asked.query["fails"] == "above" else -1.0

    def fails(values: Mapping[str, float]) -> bool:
        return bool(sign * (simulated(asked, values)[q["outcome"]] - q["limit"]) > 0.0)

    assert fails(q["set"])
    saved = [name for name in q["set"] if not fails({**q["set"], name: q["usual"][name]})]
    assert saved == [asked.answer]
    (asked,) = drawn("diagnosis", "springs", 1)
    usual, run = asked.query["usual"], asked.query["run"]
    value = [
        asked.view.ends(asked.answer)[0] + share * np.ptp(asked.view.ends(asked.answer))
        for share in (0.08, 0.92)
    ]
    found = [simulated(asked, {**usual, asked.answer: one}) for one in value]
    assert any(all(abs(one[n] - run[n]) < 1e-5 for n in run) for one in found)


SAMPLE = (
    ("graph", "equations"),
    ("graph", "network"),
    ("effect", "springs"),
    ("law", "lever"),
    ("prediction", "springs"),
    ("counterfactual", "lever"),
    ("explanation", "cartpole"),
    ("control", "springs"),
    ("diagnosis", "boxes"),
)


@pytest.mark.parametrize(("kind", "world"), SAMPLE)
def test_every_kind_has_certified_questions(kind: str, world: str) -> None:
    """Solver at least 0.95, trivial answers at most 0.2; a spec makes the question again."""
    asked = lab.question(kind, world, seed=1)
    assert asked.certificate is not None
    assert asked.certificate["solver"] >= 0.95
    assert max(asked.certificate["trivial"].values()) <= 0.2
    assert lab.Question.of(asked.spec).digest == asked.digest
    shown = lab.Question.of({**asked.spec, "level": "L4"})
    room = lab.play("ideal", shown)
    assert room.score is not None
    assert room.score["score"] >= 0.75  # other noise of readings
    if kind != "law":
        assert asked.grade(asked.answer) == 1.0


def test_a_model_file_is_a_world(tmp_path: Any) -> None:
    """Its first parameters and speeds are causes; one without enough is refused."""
    path = tmp_path / "own.xml"
    path.write_text(RIGS["lever"].xml("plain", np.ones(3)))
    asked = lab.question("effect", str(path), seed=0)
    assert "left.mass" in asked.view.quantities
    path.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ModelError, match="no joint"):
        lab.question("effect", str(path))
