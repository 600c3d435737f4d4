"""Tables, the picture and the report of a benchmark of learners."""

import csv
import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from benchmark_samples import CHAIN, TRUTHS, WAYS, run, sample_result
from matplotlib.image import imread

from scm_world.discovery import BenchmarkResult
from scm_world.discovery.benchmark_report import (
    NONE,
    ORACLES,
    STANDARDISED,
    VERDICTS,
    Spread,
    SummaryRow,
    compare,
    report,
    summary,
)
from scm_world.discovery.benchmarks import BenchmarkRun
from scm_world.discovery.learners import EstimatedGraph
from scm_world.discovery.problems import GroundTruth
from scm_world.errors import ModelError
from scm_world.output.canvas import PALETTE
from scm_world.queries.experiments.effects import EdgeKey


@pytest.fixture(scope="module")
def result() -> BenchmarkResult:
    """Make the sample once."""
    return sample_result()


@pytest.fixture(scope="module")
def folder(result: BenchmarkResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the sample once."""
    place = tmp_path_factory.mktemp("benchmark")
    result.write(place)
    return place


def of(*runs: BenchmarkRun) -> BenchmarkResult:
    """Make a result on the chain."""
    return BenchmarkResult({"chain": CHAIN}, runs)


def row(result: BenchmarkResult, learner: str, budget: int) -> SummaryRow:
    """Find a row of the chain."""
    rows = summary(result)["chain"]
    return next(r for r in rows if (r.run.learner, r.run.budget) == (learner, budget))


# --- tables ---------------------------------------------------------------------------------------


def test_a_result_survives_its_file(result: BenchmarkResult, folder: Path) -> None:
    """Problems, runs and settings come back."""
    again = BenchmarkResult.read(folder)
    assert [run.as_dict() for run in again.runs] == [run.as_dict() for run in result.runs]
    assert (again.problems, again.settings) == (result.problems, result.settings)


def test_results_that_do_not_fit_are_refused(result: BenchmarkResult) -> None:
    """A run of no problem, and one run twice."""
    with pytest.raises(ModelError, match="no problem"):
        of(*result.runs)
    with pytest.raises(ModelError, match="two runs"):
        BenchmarkResult(result.problems, (result.runs[0], result.runs[0]))


def test_means_leave_out_what_is_missing(result: BenchmarkResult) -> None:
    """A run that ran out of time is counted, and is no zero in a mean."""
    found = row(result, "gies", 1000)
    assert sorted(found.statuses) == ["done", "done", "timeout"]
    assert found.heads[-1] == "2 of 3, 1 timed out"
    assert found.spreads["shd"] == Spread(2.5, 2.0, 3.0, 2)
    assert found.spreads["seconds"].high == 500.0
    assert "sid" not in row(result, "pc", 10).spreads


def test_standardised_runs_are_beside_the_others() -> None:
    """Their SHD has a column of its own; alone, they are marked."""
    plain = run(CHAIN, "gies", "interventional", 10, 0)
    scaled = replace(plain, standardised=True, scores={"shd": 40})
    (both,) = summary(of(plain, scaled))["chain"]
    assert both.spreads["shd"].mean == 3.0
    assert both.spreads[STANDARDISED].mean == 40.0
    assert both.statuses == ("done",)
    (alone,) = summary(of(scaled))["chain"]
    assert alone.heads[1] == "interventional, standardised"


def test_the_best_needs_all_seeds() -> None:
    """A learner that solved the easy seed only is not the best, whatever its mean."""
    runs = [run(CHAIN, "ours", "interventional", 10, seed) for seed in (1, 2)]
    lucky = replace(run(CHAIN, "gies", "interventional", 10, 1), scores={"shd": 0})
    late = replace(lucky, seed=2, status="timeout", found=None, scores={})
    bad = [replace(lucky, learner="pc", seed=seed, scores={"shd": 9}) for seed in (1, 2)]
    rows = summary(of(*runs, lucky, late, *bad))["chain"]
    assert [row.run.learner for row in rows if "shd" in row.best] == ["ours"]


def test_oracles_are_not_ranked_among_learners_from_data(folder: Path) -> None:
    """Who had the simulator is best of nothing, and has a table of its own."""
    oracle = replace(run(CHAIN, "ours", "paired", 10, 1), scores={"shd": 0})
    runs = [run(CHAIN, name, "interventional", 10, 1) for name in ("ours", "gies")]
    rows = summary(of(oracle, *runs))["chain"]
    assert [(row.is_oracle, "shd" in row.best) for row in rows] == [
        (False, False),
        (False, True),
        (True, False),
    ]
    text = (folder / "report.html").read_text()
    before, after = text.split(ORACLES)
    assert ">paired<" not in before.rpartition("<h3>Oracles")[0].partition("<table")[2]
    assert ">paired<" in after.partition("</table>")[0]


def test_the_csv_has_a_line_per_run(result: BenchmarkResult, folder: Path) -> None:
    """Every run, every score that some run has; what is missing is empty."""
    lines = list(csv.DictReader(io.StringIO((folder / "results.csv").read_text())))
    assert len(lines) == len(result.runs)
    assert {"shd", "fdp", "bound", "message"} <= set(lines[0])
    late = [line for line in lines if line["status"] == "timeout"]
    assert [line["shd"] for line in late] == ["", "", ""]
    assert late[0]["message"] == "more than 60 s"


def test_the_dataframe_has_the_rows_of_the_csv(result: BenchmarkResult) -> None:
    """A row per run."""
    frame = result.to_dataframe()
    assert len(frame) == len(result.runs)
    assert frame[frame.status == "timeout"].shd.isna().all()


def test_the_table_of_the_report_marks_best_and_missing(folder: Path) -> None:
    """The best stands out, and what is missing is a dash."""
    text = (folder / "report.html").read_text()
    assert re.search(r'class="[^"]*best[^"]*"[^>]*>1 \[0, 2\]<', text)
    assert f">{NONE}<" in text


@pytest.mark.parametrize(("problems", "learners"), [(1, 1), (5, 12)])
def test_the_budget_picture_shows_every_learner(
    problems: int, learners: int, tmp_path: Path
) -> None:
    """Few or many: there is a line in the color of each learner."""
    names = [f"$problem_{i}$ with quite a long name, too long" for i in range(problems)]
    truths = {name: replace(CHAIN, name=name) for name in names}
    runs = [
        replace(run(truth, "ours", "paired", budget, 0), learner=f"_learner {i}")
        for truth, i, budget in product(truths.values(), range(learners), (0, 10, 100))
    ]
    BenchmarkResult(truths, tuple(runs)).write(tmp_path)
    picture = imread(tmp_path / "budget.png")[..., :3]
    for color in PALETTE[:learners]:
        rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        assert (np.abs(picture - rgb).max(axis=-1) < 0.02).sum() > 20


def shown(truth: GroundTruth, found: EstimatedGraph) -> str:
    """Write the report of one run."""
    run = BenchmarkRun(
        problem=truth.name, learner="mine", data="paired", budget=9, seed=0, found=found
    )
    return report(BenchmarkResult({truth.name: truth}, (run,)))


# --- edges ----------------------------------------------------------------------------------------


def verdicts(found: list[EdgeKey], truth: GroundTruth = CHAIN) -> dict[EdgeKey, str]:
    """Compare some edges with a truth."""
    return {
        link[:3]: link.verdict
        for link in compare(truth, EstimatedGraph.of_edges(truth.names, found))
    }


def test_every_kind_of_edge_has_its_verdict() -> None:
    """EstimatedGraph, missed, too much, turned around, without direction, and not scored."""
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
    truth = GroundTruth(name="t", names=("x", "y"), edges=(("x", "y", 1),))
    assert verdicts([("y", "x", 1)], truth) == {("x", "y", 1): "missing", ("y", "x", 1): "extra"}


def test_an_extra_edge_without_direction_is_one_edge() -> None:
    """It stands in both fields of the matrix."""
    truth = GroundTruth(name="t", names=("x", "y"), edges=())
    found = EstimatedGraph.of_edges(["x", "y"], [("x", "y", 0), ("y", "x", 0)])
    (link,) = compare(truth, found)
    assert (link.verdict, link.directed, link.words) == ("extra", False, "x — y")
    assert shown(truth, found).count('<td title="x — y: extra"><b class="extra">+</b>') == 2


def test_verdicts_differ_without_color() -> None:
    """Each has its own sign."""
    assert len({sign for sign, *_ in VERDICTS.values()}) == len(VERDICTS)


def test_a_matrix_has_the_lags() -> None:
    """Beside the sign, in the row of the cause and the column of the effect."""
    truth = GroundTruth(name="t", names=("x", "y"), edges=(("x", "y", 0), ("x", "y", 2)))
    found = EstimatedGraph.of_edges(["x", "y"], [("x", "y", 0), ("y", "y", 1)])
    graph = shown(truth, found).partition('<table class="graph">')[2]
    first, second = graph.partition("<tbody>")[2].split("</tr>")[:2]
    assert '<b class="correct">●</b><b class="missing">−2</b>' in first
    assert '<b class="extra">+1</b>' in second


# --- the report -----------------------------------------------------------------------------------

VOID = {"meta", "img"}


class Page(HTMLParser):
    """Reads a page, and notes what is open, what it refers to and what it says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.said: list[tuple[str, str]] = []
        self.feed(text)
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


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    """Read the report."""
    return Page((folder / "report.html").read_text())


def test_the_report_is_well_formed(page: Page) -> None:
    """Tags are balanced, identifiers are unique, and whatever is referred to is there."""
    assert not page.stack
    names = page.values("id")
    assert len(set(names)) == len(names)
    assert {ref[1:] for ref in page.values("href")} <= set(names)
    assert page.tags[0][1] == {"lang": "en"}
    assert all(found.get("alt") for tag, found in page.tags if tag == "img")


def test_the_report_needs_no_network(page: Page) -> None:
    """Nothing is loaded: no address, no sheet, no script from elsewhere."""
    assert all(ref.startswith("#") for ref in page.values("href"))
    assert all(ref.startswith("data:image/png;base64,") for ref in page.values("src"))
    assert not {"link", "iframe", "object", "base"} & {tag for tag, _ in page.tags}
    assert not any("url(http" in text or "@import" in text for _, text in page.said)


def test_names_are_inert(page: Page) -> None:
    """A variable or problem named like a tag is text, and there is one script: ours."""
    scripts = [text for tag, text in page.said if tag == "script"]
    assert len([tag for tag, _ in page.tags if tag == "script"]) == 1
    assert not any("alert" in text for text in scripts)
    assert ("h2", "<script>alert(1)</script>") in page.said
    assert any(title.startswith("<script> → ") for title in page.values("title"))


def test_the_report_shows_every_kind_of_edge(page: Page, result: BenchmarkResult) -> None:
    """As many of each kind as there are in the first run of each learner's largest budget."""
    shown = [r for r in result.runs if (r.budget, r.seed) == (1000, 0) and r.found is not None]
    assert len(shown) == len(TRUTHS) * len(WAYS)
    links = [link for run in shown for link in compare(result.truth_of(run), run.found)]
    for verdict in VERDICTS:
        fields = sum(1 + (not link.directed) for link in links if link.verdict == verdict)
        signs = [found for tag, found in page.tags if tag == "b" and found["class"] == verdict]
        assert len(signs) == fields + len(TRUTHS)  # and the legends
    assert sum(tag == "table" for tag, _ in page.tags) == 2 + len(
        shown
    )  # and two summaries: oracles apart


def test_the_report_is_the_same_in_any_order(result: BenchmarkResult) -> None:
    """Runs that ended in another order give the same page."""
    few = [run for run in result.runs if run.problem == "chain"]
    assert report(of(*few)) == report(of(*reversed(few)))


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("truths", [(), TRUTHS])
def test_nothing_finished_is_written_as_well(
    truths: tuple[GroundTruth, ...], count: int, tmp_path: Path
) -> None:
    """Without a finished run, without a run and without a problem there is a report."""
    runs = [
        BenchmarkRun(problem=truth.name, learner="pc", data="observational", budget=9, seed=0,
            status="failed", message="<b>no</b>")
        for truth in truths[:count]
    ]  # fmt: skip
    BenchmarkResult({truth.name: truth for truth in truths}, tuple(runs)).write(tmp_path)
    page = Page((tmp_path / "report.html").read_text())
    assert not page.stack
    assert not any(tag == "b" and text == "no" for tag, text in page.said)
    assert any(f"{len(runs)} failed" in text for _, text in page.said)
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 1 + len(runs)
