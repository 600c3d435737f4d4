"""Graphs side by side, and the report of an exam of learners."""

from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from exam_samples import CHAIN, TRUTHS, WAYS, sample_exam

from scm_world.discovery.exam.html import PICTURES, write_report
from scm_world.discovery.exam.results import (
    Cell,
    Exam,
    Truth,
)
from scm_world.discovery.exam.side_by_side import VERDICTS, compare
from scm_world.discovery.exam.side_by_side_drawing import Board
from scm_world.discovery.exam.side_by_side_layout import Places
from scm_world.discovery.exam.tables import (
    table_rows,
    write_tables,
)
from scm_world.discovery.learners import Found
from scm_world.queries.experiments.effects import EdgeKey


@pytest.fixture(scope="module")
def exam() -> Exam:
    """Make the sample once."""
    return sample_exam()


# --- edges ----------------------------------------------------------------------------------------


def verdicts(found: list[EdgeKey], truth: Truth = CHAIN) -> dict[EdgeKey, str]:
    """Compare some edges with a truth."""
    links = compare(truth, Found.of_edges(truth.names, found))
    return {link.key: link.verdict for link in links}


def test_every_kind_of_edge_has_its_verdict() -> None:
    """Found, missed, too much, turned around, without direction, and not scored."""
    edges: list[EdgeKey] = [
        ("a", "b", 0),
        ("c", "b", 0),
        ("c", "d", 0),
        ("d", "c", 0),
        ("a", "c", 2),
        ("d", "b", 1),
        ("d", "d", 1),
    ]
    assert verdicts(edges) == {
        ("a", "b", 0): "correct",
        ("c", "b", 0): "reversed",
        ("c", "d", 0): "undirected",
        ("a", "c", 2): "extra",
        ("d", "b", 1): "unscored",
        ("d", "d", 1): "correct",
        ("a", "d", 1): "missing",
    }


def test_time_is_never_turned_around() -> None:
    """A lagged edge in the other direction is one too much, and one is missing."""
    truth = Truth(name="t", names=("x", "y"), edges=(("x", "y", 1),))
    assert verdicts([("y", "x", 1)], truth) == {("x", "y", 1): "missing", ("y", "x", 1): "extra"}


def test_an_extra_edge_without_direction_has_no_arrowhead() -> None:
    """It is one edge, not two."""
    truth = Truth(name="t", names=("x", "y"), edges=())
    (link,) = compare(truth, Found.of_edges(["x", "y"], [("x", "y", 0), ("y", "x", 0)]))
    assert (link.verdict, link.directed, link.words) == ("extra", False, "x — y")


def test_verdicts_differ_without_color() -> None:
    """Each has its own sign, and its own line."""
    assert len({verdict.text for verdict in VERDICTS}) == len(VERDICTS)
    assert len({(verdict.width, verdict.dashes) for verdict in VERDICTS}) == len(VERDICTS)


def test_nodes_do_not_overlap_and_stay_inside() -> None:
    """Also where there are many, and cycles through time."""
    names = tuple(f"block_{i}.mass" for i in range(40))
    rng = np.random.default_rng(0)
    pairs = [(i, j) for i in range(40) for j in range(40) if i != j and rng.random() < 0.05]
    edges = tuple((names[i], names[j], int(i > j)) for i, j in pairs)
    places = Places(Truth(name="many", names=names, edges=edges))
    centers = np.array(list(places.centers.values()))
    apart = np.abs(centers[:, None] - centers[None, :])
    apart[np.arange(40), np.arange(40)] = np.inf
    assert ((apart[..., 0] >= places.box[0]) | (apart[..., 1] >= places.box[1])).all()
    half = np.array(places.box) / 2
    assert (centers - half >= 0).all()
    assert (centers + half <= [places.width, places.height]).all()


# --- the report -----------------------------------------------------------------------------------

VOID = {"meta", "img"}


class Page(HTMLParser):
    """Reads a page, and notes what is open, what it refers to and what it says."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.said: list[tuple[str, str]] = []
        self.feed(path.read_text())
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Open a tag."""
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag without content."""
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        """Close the tag that was opened last."""
        assert self.stack.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note a text and where it stands."""
        if self.stack:
            self.said.append((self.stack[-1], data))

    def values(self, attribute: str) -> list[str]:
        """Give all values of an attribute."""
        return [value for _, found in self.tags if (value := found.get(attribute)) is not None]

    def count(self, name: str) -> int:
        """Count the drawn edges of a class."""
        return sum(tag == "g" and name in (a.get("class") or "").split() for tag, a in self.tags)


@pytest.fixture(scope="module")
def page(exam: Exam, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """Write the report once and read it."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(exam, path)
    return Page(path)


def test_the_report_is_well_formed(page: Page) -> None:
    """Tags are balanced, identifiers are unique, and whatever is referred to is there."""
    assert not page.stack
    names = page.values("id")
    assert len(set(names)) == len(names)
    assert {ref[1:] for ref in page.values("href")} <= set(names)
    assert page.tags[0][1] == {"lang": "en"}
    assert all(found.get("alt") for tag, found in page.tags if tag == "img")
    assert all(found.get("aria-label") for _, found in page.tags if found.get("role") == "img")


def test_the_report_needs_no_network(page: Page) -> None:
    """Nothing is loaded: no address, no sheet, no script from elsewhere."""
    assert all(ref.startswith("#") for ref in page.values("href"))
    assert all(ref.startswith("data:image/png;base64,") for ref in page.values("src"))
    assert not {"link", "iframe", "object", "base"} & {tag for tag, _ in page.tags}
    assert not any("url(http" in text or "@import" in text for _, text in page.said)


def test_names_are_inert(page: Page) -> None:
    """A variable or subject named like a tag is text, and there is one script: ours."""
    scripts = [text for tag, text in page.said if tag == "script"]
    assert len([tag for tag, _ in page.tags if tag == "script"]) == 1
    assert not any("alert" in text for text in scripts)
    assert ("h2", "<script>alert(1)</script>") in page.said
    assert any(tag == "title" and text.startswith("<script> → ") for tag, text in page.said)


def test_the_report_draws_every_kind_of_edge(page: Page, exam: Exam) -> None:
    """As many of each kind as the comparison finds in all runs."""
    links = [
        link.verdict
        for run in exam.cells
        if run.found is not None
        for link in compare(exam.subjects[run.subject], run.found)
    ]
    legends = len(TRUTHS)
    for verdict in ("missing", "extra", "reversed", "undirected"):
        assert links.count(verdict) > 0
        assert page.count(verdict) == links.count(verdict) + legends
    assert any(tag == "text" and text == "t−1" for tag, text in page.said)
    assert any("timeout: more than 60 s" in text for _, text in page.said)


def test_the_report_is_the_same_in_any_order(exam: Exam, tmp_path: Path) -> None:
    """Runs that ended in another order give the same bytes."""
    few = [run for run in exam.cells if run.subject == "chain"]
    paths = tmp_path / "one.html", tmp_path / "other.html"
    write_report(Exam({"chain": CHAIN}, tuple(few), exam.about), paths[0])
    write_report(Exam({"chain": CHAIN}, tuple(reversed(few)), exam.about), paths[1])
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_large_graphs_are_matrices() -> None:
    """Of more than 40 variables every pair has a field with its sign, and lags their number."""
    names = tuple(f"x{i}" for i in range(41))
    truth = Truth(name="large", names=names, edges=(("x0", "x1", 0), ("x0", "x2", 1)))
    links = compare(truth, Found.of_edges(names, [("x1", "x0", 0), ("x3", "x4", 2)]))
    board = Board(truth, "s0", len(links))
    drawn = board.found(links, "found")
    assert board.is_matrix
    assert not Board(replace(truth, names=names[:40]), "s0", 200).is_matrix
    assert Board(replace(truth, names=names[:40]), "s0", 201).is_matrix
    for text in (">⇄<", ">−1<", ">+2<"):
        assert text in drawn


def test_a_large_exam_stays_small(exam: Exam, tmp_path: Path) -> None:
    """Of an exam with very many runs one per learner is drawn, and all are there in words."""
    runs = [replace(run, seed=run.seed + 3 * i) for run in exam.cells for i in range(2)]
    many = Exam(exam.subjects, tuple(runs), {})
    assert len(runs) > PICTURES
    write_report(many, tmp_path / "many.html")
    page = Page(tmp_path / "many.html")
    drawn = [found for _, found in page.tags if found.get("class") == "graph found"]
    assert len(drawn) == len(TRUTHS) * len(WAYS)
    lines = sum(tag == "tr" for tag, _ in page.tags)
    heads = 1 + len(TRUTHS) * len(WAYS)
    assert lines == heads + len(table_rows(many)) + len(runs) - len(drawn)


@pytest.mark.parametrize("cells", [0, 1])
@pytest.mark.parametrize("truths", [(), TRUTHS])
def test_nothing_finished_is_written_as_well(
    truths: tuple[Truth, ...], cells: int, tmp_path: Path
) -> None:
    """Without a finished run, without a run and without a subject there is a report."""
    runs = [
        Cell(subject=t.name, learner="pc", data="see", budget=9, seed=0, status="failed",
             message="<b>no</b>")
        for t in truths[:cells]
    ]  # fmt: skip
    empty = Exam({truth.name: truth for truth in truths}, tuple(runs), {})
    write_report(empty, tmp_path / "empty.html")
    write_tables(empty, tmp_path)
    page = Page(tmp_path / "empty.html")
    assert not page.stack
    assert not any(tag == "b" and text == "no" for tag, text in page.said)
    assert any(f"{len(runs)} failed" in text for _, text in page.said)
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 1 + len(runs)
