"""Suites are the same wherever they are made, and scores are those of a direct count."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.discovery.data import load
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.lab import Question, question
from scm_world.lab.questions import Unusable
from scm_world.lab.suites import SUITES, Suite, suite
from scm_world.runs.files import located
from scm_world.tasks.families import servo

KEY = "a key of a test, of more than 16 characters"
TABLE = {"kind": "servo-5", "source": "servo:5", "rows": 12, "seed": 0}
ASKED = {"worlds": ["equations"], "knobs": [{}], "n": 2}
PARTS: dict[str, dict[str, Any]] = {
    "servo-5-observational": {**TABLE, "level": "observational", "data": "observational"},
    "servo-5-paired": {**TABLE, "level": "paired", "data": "paired"},
    "effect-L2": {**ASKED, "kind": "effect", "level": "L2", "seed": 0},
    "effect-private": {**ASKED, "kind": "effect", "seed": 7, "private": True},
}
ABOUT = {"title": "Tests.", "measures": "Nothing.", "limits": "All.", "versions": {}}


def small(**sha256: str) -> Suite:
    """Return a suite with the hashes of some parts."""
    parts = {n: r | ({"sha256": sha256[n]} if n in sha256 else {}) for n, r in PARTS.items()}
    return Suite("small-1", {**ABOUT, "parts": parts})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suite with its private part."""
    out = tmp_path_factory.mktemp("suites") / "small"
    small().make(out, key=KEY)
    return out


def test_other_workers_and_a_second_start_make_the_same(folder: Path, tmp_path: Path) -> None:
    """An interrupted call resumes; a hash that differs is named."""
    known = {name: json.loads((folder / f"{name}.json").read_text())["content"] for name in PARTS}
    (tmp_path / "other").mkdir()
    public = {n: part["sha256"] for n, part in known.items() if "private" not in n}
    found = small(**public).make(tmp_path / "two", workers=2)
    assert found.differ == ()
    assert {n: part["sha256"] for n, part in found.parts.items()} == public
    (tmp_path / "two" / "effect-L2.json").unlink()  # killed before the last part
    wrong = {**public, "servo-5-paired": "0" * 64}
    again = small(**wrong).make(tmp_path / "two")
    assert again.parts == found.parts
    assert again.differ == ("servo-5-paired",)


def test_tables_have_their_graph_and_pairs_their_noise(folder: Path) -> None:
    """What an intervention does not act on has the same number, to the last bit."""
    about = json.loads((folder / "servo-5-paired.json").read_text())["content"]
    arms = servo(5, 0)
    assert [tuple(edge) for edge in about["edges"]] == sorted(arms.edges)
    free, held = load(folder / "servo-5-observational"), load(folder / "servo-5-paired")
    children = {arm: {e for c, e in arms.edges if c == arm} for arm in free.names}
    for row in range(len(held)):
        (target,) = held.regimes[held.regime[row]].targets
        moved = {target}
        while more := {child for arm in moved for child in children[arm]} - moved:
            moved |= more
        same = dict(zip(free.names, free.values[row] == held.values[row], strict=True))
        assert {name for name, is_same in same.items() if not is_same} == moved


def test_private_answers_are_in_no_file(folder: Path, tmp_path: Path) -> None:
    """Neither is the key, and another key is refused."""
    frame = pandas.read_parquet(folder / "private-effect-private.parquet")
    specs = [json.loads(spec) for spec in frame.spec]
    for text in (json.dumps(Question.of(spec, KEY).answer) for spec in specs):
        for path in folder.rglob("*"):
            assert path.is_dir() or text.encode() not in path.read_bytes()
    assert "answer" not in frame
    assert frame.level.tolist() == ["L1", "L2"]
    for spec, shown in zip(specs, frame.description, strict=True):
        with_key = json.loads(json.dumps(Question.of(spec, KEY).describe()))
        assert json.loads(shown) == with_key
        with suppress(Unusable):  # without the key the draw may make no question
            assert json.loads(json.dumps(Question.of(spec).describe())) != with_key
    for path in folder.rglob("*"):
        assert path.is_dir() or KEY.encode() not in path.read_bytes()
    with pytest.raises(UnreadableFile, match="another key"):
        small().make(folder, key=KEY + "!")
    with pytest.raises(UnknownOption, match="16 characters"):
        small().make(tmp_path / "short", key="abc")
    assert not (tmp_path / "short").exists()


def test_a_changed_row_is_named(tmp_path: Path) -> None:
    """The part is made again when its file is deleted, as the message advises."""
    made = Suite("small-1", {**ABOUT, "parts": {"effect-L2": PARTS["effect-L2"]}})
    found = made.make(tmp_path / "s")
    path = tmp_path / "s" / "questions-effect-L2.parquet"
    frame = pandas.read_parquet(path)
    frame["answer"] = "0"
    frame.to_parquet(path, index=False)
    with pytest.raises(UnreadableFile, match="effect-L2 were changed"):
        made.make(tmp_path / "s")
    (tmp_path / "s" / "effect-L2.json").unlink()
    assert made.make(tmp_path / "s") == found


def test_a_seed_without_a_question_is_followed_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time by the same one; the report says how many were skipped."""
    monkeypatch.setattr("scm_world.lab.questions.DRAWS", 1)  # so that many seeds have none
    recipe: dict[str, Any] = {**PARTS["effect-L2"], "seed": 3, "n": 3}
    made = Suite("small-1", {**ABOUT, "parts": {"effect-L2": recipe}})
    about = made.make(tmp_path / "s").parts["effect-L2"]
    expected = []
    for first in (3, 4, 5):
        for seed in range(first, first + 50_000, 10_000):
            with suppress(Unusable):
                expected.append(question("effect", seed=seed))
                break
    assert about["seeds"] == [one.seed for one in expected]
    assert about["skipped"] == sum(one.seed // 10_000 for one in expected) > 0
    known = {**recipe, "seeds": about["seeds"], "draws": about["draws"]}
    again = Suite("small-1", {**ABOUT, "parts": {"effect-L2": known}}).make(tmp_path / "again")
    assert again.parts["effect-L2"]["sha256"] == about["sha256"]
    right = pandas.read_parquet(tmp_path / "s" / "questions-effect-L2.parquet")
    scored = made.score(right[["question", "answer"]], made=tmp_path / "s")
    assert scored.score.tolist() == [1.0]
    monkeypatch.setattr("scm_world.lab.suites.SEEDS", 1)
    with pytest.raises(ModelError, match="no seed of"):
        made.make(tmp_path / "none")


def test_scores_are_those_of_a_count(folder: Path, tmp_path: Path) -> None:
    """Right answers have 1, missing and malformed ones 0, and a graph its F1."""
    frame = pandas.read_parquet(folder / "questions-effect-L2.parquet")
    edges = [list(edge) for edge in servo(5, 0).edges]
    graph = json.dumps({"edges": [*edges[:2], edges[2][::-1]]})  # 2 of 4 found, 1 is false
    rows = [
        {"question": "servo-5-paired", "answer": graph, "confidence": 0.5},
        {"question": "effect-L2-000", "answer": frame.answer[0], "confidence": 0.5},
        {"question": "effect-L2-001", "answer": '"nonsense"', "confidence": 1.0},
    ]
    path = tmp_path / "answers.csv"
    pandas.DataFrame(rows).to_csv(path, index=False)
    with_made = small().score(path, made=folder).set_index(["kind", "level"])
    assert with_made.score["servo-5", "paired"] == pytest.approx(2 * 2 / (3 + 4))
    assert with_made.score["servo-5", "observational"] == 0.0
    assert with_made.score["effect", "all"] == 0.5
    assert with_made.refused["effect", "all"] == 1
    assert with_made.answered["servo-5", "all"] == 1
    assert with_made.brier["effect", "all"] == 0.25  # of the one answer of the right form
    pandas.DataFrame(rows).to_parquet(tmp_path / "answers.parquet")
    again = small().score(tmp_path / "answers.parquet").set_index(["kind", "level"])
    pandas.testing.assert_frame_equal(with_made, again)
    private = pandas.read_parquet(folder / "private-effect-private.parquet")
    right = [Question.of(json.loads(spec), KEY).answer for spec in private.spec]
    asked = pandas.DataFrame({"question": private.question, "answer": right})
    scored = small().score(asked, key=KEY, made=folder).set_index(["kind", "level"])
    assert scored.answered["effect", "all"] == 2
    assert scored.score["effect", "all"] == 0.5  # of four questions, two have answers
    with pytest.raises(UnknownOption, match="effect-private-000"):
        small().score(asked, made=folder)


def test_a_confidence_that_is_no_probability_is_refused(folder: Path) -> None:
    """The message names the question; a row without one is allowed."""
    rows = pandas.DataFrame({"question": [f"effect-L2-00{i}" for i in range(2)], "answer": [0, 0]})
    small().score(rows.assign(confidence=[0.5, None]), made=folder)
    for wrong in (1.5, -0.1, "sure"):
        with pytest.raises(UnknownOption, match="effect-L2-001"):
            small().score(rows.assign(confidence=[0.5, wrong]), made=folder)


def test_a_part_of_a_killed_process_is_made_again_behind_a_url() -> None:
    """Its table is there, and the file that says that it is whole is not."""
    one = Suite("small-1", {**ABOUT, "parts": {"servo-5-paired": PARTS["servo-5-paired"]}})
    found, place = one.make("memory://killed"), located("memory://killed")
    (place / "servo-5-paired.json").unlink()
    assert one.make("memory://killed").parts == found.parts


@pytest.mark.parametrize("rows", [[{"question": "nothing", "answer": 1}], [{"id": 1}], [{}]])
def test_answers_to_no_question_are_refused(rows: Any) -> None:
    """The message has the questions, or the columns."""
    with pytest.raises(UnknownOption):
        small().score(pandas.DataFrame(rows))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_mlcroissant_reads_tables_and_questions(folder: Path) -> None:
    """Each table is a part of the dataset; all questions are one."""
    croissant = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    read = croissant.Dataset(folder / "croissant.json")
    assert not read.metadata.issues.errors
    assert len([*read.records("questions")]) == len([*read.records("private")]) == 2
    (first, *_) = read.records("servo-5-paired")
    table = load(folder / "servo-5-paired")
    assert first[f"servo-5-paired/{table.names[0]}"] == pytest.approx(table.values[0, 0])


@pytest.mark.parametrize("name", SUITES)
def test_manifests_are_complete(name: str) -> None:
    """Each part has a recipe, and those with a hash have trivial answers, too; all seeds differ."""
    found, seeds = suite(name), set[int]()
    for part, recipe in found.parts("k" * 16).items():
        assert {"kind", "seed"} <= recipe.keys(), part
        assert "sha256" not in recipe or (len(recipe["sha256"]) == 64 and recipe["trivial"]), part
        assert not recipe.get("private") or not {"sha256", "draws"} & recipe.keys()
        if "n" in recipe:
            drawn = {*range(recipe["seed"], recipe["seed"] + recipe["n"])}
            assert not drawn & seeds, part
            seeds |= drawn
    assert name != "lab-1" or len(seeds) == 1000
    assert "What it does not show" in found.card


def test_a_published_table_is_made_here(tmp_path: Path) -> None:
    """Its hash is that of the manifest, or the versions that differ are named."""
    whole = suite("physics-1")
    part = "boxes-paired"
    one = Suite("one-1", {**whole.manifest, "parts": {part: whole.manifest["parts"][part]}})
    made = one.make(tmp_path / "one")
    assert made.parts[part]["rows"] == 1000
    assert not made.differ or made.versions


def test_the_command_prints_scores(folder: Path, tmp_path: Path) -> None:
    """List, and score; an unknown suite is an error of one line."""
    run = CliRunner().invoke(app, ["suite", "list"])
    assert run.exit_code == 0
    assert "physics-1" in run.output
    edges = json.loads((folder / "servo-5-paired.json").read_text())["content"]["edges"]
    rows = {"question": ["servo-5-observational"], "answer": [json.dumps({"edges": edges})]}
    pandas.DataFrame(rows).to_json(tmp_path / "a.jsonl", orient="records", lines=True)
    frame = small().score(tmp_path / "a.jsonl", made=folder).set_index(["kind", "level"])
    assert frame.score["servo-5", "observational"] == 1.0
    assert np.isnan(frame.brier["servo-5", "observational"])
    wrong = CliRunner().invoke(app, ["suite", "score", "nothing", str(tmp_path / "a.jsonl")])
    assert wrong.exit_code == 2
    assert "lab-1" in wrong.output or "physics-1" in wrong.output
