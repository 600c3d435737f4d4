"""Tables and the picture of a benchmark of learners."""

import csv
import io
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from benchmark_samples import CHAIN, TRUTHS, run, sample_result
from matplotlib.image import imread

from scm_world.discovery import BenchmarkResult
from scm_world.discovery.benchmark_summary import (
    COLUMNS,
    STANDARDISED,
    comparison,
    summary,
    text,
    trivial_answers,
)
from scm_world.discovery.benchmarks import BenchmarkRun
from scm_world.discovery.problems import GroundTruth
from scm_world.errors import ModelError
from scm_world.runs.canvas import PALETTE


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


def row(result: BenchmarkResult, learner: str, budget: int) -> Any:
    """Find a row of the chain."""
    rows = summary(result)
    of = (rows.problem == "chain") & (rows.learner == learner) & (rows.budget == budget)
    (found,) = rows[of].itertuples()
    return found


# --- tables ---------------------------------------------------------------------------------------


def test_results_that_do_not_fit_are_refused(result: BenchmarkResult) -> None:
    """A run of no problem, and one run twice."""
    with pytest.raises(ModelError, match="not a problem"):
        of(*result.runs)
    with pytest.raises(ModelError, match="two runs"):
        BenchmarkResult(result.problems, (result.runs[0], result.runs[0]))


def test_means_leave_out_what_is_missing(result: BenchmarkResult) -> None:
    """A run that ran out of time is counted, and is no zero in a mean."""
    found = row(result, "gies", 1000)
    assert (found.seeds, found.done, found.timeout, found.failed) == (3, 2, 1, 0)
    assert (found.shd, found.shd_low, found.shd_high, found.shd_n) == (2.5, 2.0, 3.0, 2)
    assert found.seconds_high == 500.0
    assert row(result, "pc", 10).sid_n == 0


def scored(learner: str, *scores: float) -> list[BenchmarkRun]:
    """Make runs of a learner with these F1, one for each seed."""
    plain = run(CHAIN, "ours", "interventional", 10, 0)
    return [
        replace(plain, learner=learner, seed=seed, scores={"f1": f1})
        for seed, f1 in enumerate(scores)
    ]


def test_a_mean_has_the_interval_of_its_seeds() -> None:
    """Student's t with two degrees of freedom: 4.3027 standard errors; a single seed has none."""
    found = row(of(*scored("ours", 0.5, 0.6, 0.7)), "ours", 10)
    reach = 4.302652730 * 0.1 / np.sqrt(3.0)
    assert (found.f1_from, found.f1_to) == pytest.approx((0.6 - reach, 0.6 + reach))
    (column,) = (each for each in COLUMNS if each.key == "f1")
    (shown,) = summary(of(*scored("ours", 0.5, 0.6, 0.7))).to_dict("index").values()
    assert text(pd.Series(shown), column) == "0.60 [0.35, 0.85]"
    assert np.isnan(row(of(*scored("ours", 0.5)), "ours", 10).f1_from)
    wide = row(of(*scored("ours", 0.0, 1.0)), "ours", 10)
    assert (wide.f1_from, wide.f1_to) == (0.0, 1.0)  # what a rate can be


def test_learners_are_compared_in_the_same_seeds() -> None:
    """What all seeds have in common cancels: 0.1 ± 0.01 between scores from 0.3 to 0.99."""
    both = of(*scored("gies", 0.4, 0.71, 0.99), *scored("ours", 0.31, 0.6, 0.9))
    (found,) = comparison(both).itertuples()
    reach = 4.302652730 * np.std([0.09, 0.11, 0.09], ddof=1) / np.sqrt(3.0)
    middle = 0.29 / 3.0
    assert (found.learner, found.other, found.seeds) == ("gies", "ours", 3)
    assert (found.difference, found.low, found.high) == pytest.approx(
        (middle, middle - reach, middle + reach)
    )
    assert (found.verdict, found.trivial) == ("better", False)
    (alone,) = comparison(of(*scored("ours", 0.9), *scored("gies", 0.1))).itertuples()
    assert (alone.seeds, alone.verdict) == (1, "no difference is shown")


def test_it_is_said_where_a_trivial_answer_is_best() -> None:
    """The best baseline counts, with the largest budget."""
    trivial = [*scored("all_or_nothing", 0.9, 1.0), *scored("empty", 0.0, 0.0)]
    (said,) = trivial_answers(of(*scored("ours", 0.5, 0.6), *trivial))
    assert said.startswith(
        "chain, interventional: a trivial answer is best: all_or_nothing has a mean F1 of 0.95, "
        "ours of 0.55; difference -0.40"
    )
    assert trivial_answers(of(*scored("ours", 1.0, 1.0), *trivial)) == []


def test_standardised_runs_are_beside_the_others() -> None:
    """Their SHD has a column of its own."""
    plain = run(CHAIN, "gies", "interventional", 10, 0)
    scaled = replace(plain, standardised=True, scores={"shd": 40})
    (both,) = summary(of(plain, scaled)).to_dict("records")
    assert (both["shd"], both[STANDARDISED], both["seeds"], both["done"]) == (3.0, 40.0, 1, 1)


def test_oracles_are_not_ranked_among_learners_from_data() -> None:
    """Who had the simulator has a table of its own, which comes last."""
    oracle = replace(run(CHAIN, "ours", "paired", 10, 1), scores={"shd": 0})
    runs = [run(CHAIN, name, "interventional", 10, 1) for name in ("ours", "gies")]
    rows = summary(of(oracle, *runs))
    assert rows.oracle.tolist() == [False, False, True]


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


@pytest.mark.parametrize(("problems", "learners"), [(1, 1), (2, 12)])
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


@pytest.mark.parametrize(("truths", "count"), [((), 0), (TRUTHS, 0), (TRUTHS, 1)])
def test_nothing_finished_is_written_as_well(
    truths: tuple[GroundTruth, ...], count: int, tmp_path: Path
) -> None:
    """Without a finished run, without a run and without a problem there are files."""
    runs = [
        BenchmarkRun(problem=truth.name, learner="pc", data="observational", budget=9, seed=0,
            status="failed", message="<b>no</b>")
        for truth in truths[:count]
    ]  # fmt: skip
    BenchmarkResult({truth.name: truth for truth in truths}, tuple(runs)).write(tmp_path)
    assert (tmp_path / "budget.png").exists()
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 1 + len(runs)
