"""Results, tables and the picture of an exam of learners."""

import csv
import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from exam_samples import CHAIN, TRUTHS, cell, sample_exam
from matplotlib.image import imread

from scm_world.discovery.exam.pictures import draw_budget
from scm_world.discovery.exam.results import (
    Exam,
    read_cell,
    read_truth,
    write_json,
)
from scm_world.discovery.exam.tables import (
    STANDARDISED,
    Row,
    Spread,
    best,
    table_rows,
    write_tables,
)
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.output.canvas import PALETTE


@pytest.fixture(scope="module")
def exam() -> Exam:
    """Make the sample once."""
    return sample_exam()


def row(exam: Exam, subject: str, learner: str, budget: int) -> Row:
    """Find a row."""
    wanted = (subject, learner, budget)
    return next(r for r in table_rows(exam) if (r.subject, r.learner, r.budget) == wanted)


# --- files ----------------------------------------------------------------------------------------


def test_cells_and_truths_survive_their_files(exam: Exam, tmp_path: Path) -> None:
    """What is read is what was written, of every cell and every subject."""
    for number, given in enumerate(exam.cells):
        path = tmp_path / f"{number}.json"
        write_json(given, path)
        assert read_cell(path).as_dict() == given.as_dict()
    for truth in TRUTHS:
        write_json(truth, tmp_path / "truth.json")
        assert read_truth(tmp_path / "truth.json") == truth


def test_an_exam_survives_json(exam: Exam, tmp_path: Path) -> None:
    """Subjects, cells and facts come back."""
    write_json(exam, tmp_path / "exam.json")
    again = Exam.from_dict(json.loads((tmp_path / "exam.json").read_text()))
    assert again.as_dict() == exam.as_dict()
    assert again.about == exam.about


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda _: "[]",
        lambda _: "{}",
        lambda text: text.replace("exam-cell/1", "exam-cell/9"),
        lambda text: text.replace('"budget": 10', '"budget": "ten"'),
        lambda text: text.replace('"status": "done"', '"status": "perhaps"'),
        lambda text: text.replace('"shd": 0', '"shd": "none"'),
        lambda text: text.replace('"lags": 1', '"lags": -1'),
        lambda text: text.replace('"shd": 0', '"shd": NaN'),
    ],
)  # fmt: skip
def test_damaged_cells_are_refused(damage, tmp_path: Path) -> None:
    """A file that is cut, changed or something else is named in the error."""
    path = tmp_path / "cell.json"
    write_json(cell(CHAIN, "ours", "paired", 10, 0), path)
    whole = path.read_text()
    path.write_text(damage(whole))
    assert path.read_text() != whole
    with pytest.raises(UnreadableFile, match=r"cell\.json"):
        read_cell(path)


def test_a_cell_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """The error names the file, as for a damaged one."""
    with pytest.raises(UnreadableFile, match="nowhere"):
        read_cell(tmp_path / "nowhere.json")


def test_cells_that_cannot_be_shown_are_refused() -> None:
    """A score that is no number, an unknown status, and a run without a graph."""
    good = cell(CHAIN, "ours", "paired", 10, 0)
    with pytest.raises(ModelError, match="'sid' of 'ours' on 'chain' is nan"):
        replace(good, scores={"sid": float("nan")})
    with pytest.raises(ModelError, match="there is no graph"):
        replace(good, found=None)
    with pytest.raises(UnknownOption, match="status"):
        replace(good, status="perhaps")


def test_truths_and_exams_that_do_not_fit_are_refused(exam: Exam) -> None:
    """An edge to nowhere, a cell of no subject, and one cell twice."""
    with pytest.raises(ModelError, match="'a' → 'q'"):
        replace(CHAIN, edges=(("a", "q", 0),))
    with pytest.raises(ModelError, match="no subject"):
        Exam({"chain": CHAIN}, exam.cells)
    with pytest.raises(ModelError, match="two cells"):
        Exam(exam.subjects, (exam.cells[0], exam.cells[0]))


# --- tables ---------------------------------------------------------------------------------------


def test_means_leave_out_what_is_missing(exam: Exam) -> None:
    """A run that ran out of time is counted, and is no zero in a mean."""
    found = row(exam, "chain", "gies", 1000)
    assert (found.seeds, found.done, found.timeout, found.failed) == (3, 2, 1, 0)
    assert found.heads[-1] == "2 of 3, 1 timed out"
    assert found.spreads["shd"] == Spread(2.5, 2.0, 3.0, 2)
    assert found.spreads["seconds"].high == 500.0
    assert "sid" not in row(exam, "chain", "pc", 10).spreads


def test_standardised_runs_stand_beside_the_others() -> None:
    """Their SHD has a column of its own; alone, they are marked."""
    plain = cell(CHAIN, "gies", "do", 10, 0)
    scaled = replace(plain, standardised=True, scores={"shd": 40})
    (both,) = table_rows(Exam({"chain": CHAIN}, (plain, scaled)))
    assert both.spreads["shd"].mean == 3.0
    assert both.spreads[STANDARDISED].mean == 40.0
    assert both.seeds == 1
    (alone,) = table_rows(Exam({"chain": CHAIN}, (scaled,)))
    assert alone.heads[1] == "do, standardised"


def test_the_best_needs_all_seeds() -> None:
    """A learner that solved the easy seed only is not the best, whatever its mean."""
    runs = [cell(CHAIN, "ours", "paired", 10, seed) for seed in (1, 2)]
    lucky = replace(cell(CHAIN, "gies", "do", 10, 1), scores={"shd": 0})
    late = replace(lucky, seed=2, status="timeout", found=None, scores={})
    bad = [replace(lucky, learner="pc", seed=seed, scores={"shd": 9}) for seed in (1, 2)]
    rows = table_rows(Exam({"chain": CHAIN}, (*runs, lucky, late, *bad)))
    winners = {rows[number].learner for number, key in best(rows) if key == "shd"}
    assert winners == {"ours"}


def test_the_csv_has_a_line_per_run(exam: Exam, tmp_path: Path) -> None:
    """Every run, every score that some run has; what is missing is empty."""
    table, _ = write_tables(exam, tmp_path)
    lines = list(csv.DictReader(table.read_text().splitlines()))
    assert len(lines) == len(exam.cells)
    assert {"shd", "fdp", "bound", "message"} <= set(lines[0])
    late = [line for line in lines if line["status"] == "timeout"]
    assert [line["shd"] for line in late] == ["", "", ""]
    assert late[0]["message"] == "more than 60 s"


def test_the_markdown_tells_best_and_missing(exam: Exam, tmp_path: Path) -> None:
    """Bold for the best, a dash for what is missing, and as many cells in every line."""
    _, summary = write_tables(exam, tmp_path)
    text = summary.read_text()
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.replace("\\|", "").count("|") for line in lines} == {17}
    assert "| paired | ours | 10 | 3 of 3 | **1 [0, 2]** | – | **1.00** |" in text
    assert "| see | pc | 10 | 3 of 3 | 4 [3, 5] | – |" in text
    assert "## &lt;script>alert(1)&lt;/script>" in text


# --- the picture ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("subjects", "learners"), [(1, 1), (12, 12)])
def test_the_budget_picture_shows_every_learner(
    subjects: int, learners: int, tmp_path: Path
) -> None:
    """Few or many: there is a line in the color of each learner."""
    names = [f"$subject_{i}$ with quite a long name, too long" for i in range(subjects)]
    truths = {name: replace(CHAIN, name=name) for name in names}
    cells = [
        replace(cell(truth, "ours", "paired", budget, 0), learner=f"_learner {i}")
        for truth, i, budget in product(truths.values(), range(learners), (0, 10, 100))
    ]
    draw_budget(Exam(truths, tuple(cells)), tmp_path / "b.png")
    picture = imread(tmp_path / "b.png")[..., :3]
    for color in PALETTE[:learners]:
        rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        assert (np.abs(picture - rgb).max(axis=-1) < 0.02).sum() > 20
