"""The paper's study as one command: cells, resuming, tables. Nothing is learned here."""

from __future__ import annotations

import csv
import io
import json
import shutil
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.evaluation.policies.weights import save_policy
from scm_world.queries.progress import Progress
from scm_world.training.recipe import Recipe
from scm_world.training.study import Cell, Study, holding, planned, published
from scm_world.training.study import reproduce as with_pictures
from scm_world.training.study.actors import evaluate_actor
from scm_world.training.study.runs import Job
from scm_world.training.study.scores import Findings
from scm_world.training.study.tables import lacks

OBSERVED = 56
SHORT = {"max_episode_length": 3}


reproduce = partial(with_pictures, pictures=False)


class Fake:
    """Stands for the trainer: writes a small network, and remembers whom it was asked for.

    Args:
        breaks: Seeds for which it fails.
        killed: Seeds for which it is interrupted.
    """

    def __init__(self, breaks: tuple[int, ...] = (), killed: tuple[int, ...] = ()) -> None:
        self.breaks, self.killed = breaks, killed
        self.asked: list[str] = []

    def __call__(
        self,
        recipe: Recipe,
        *,
        out: Any,
        seed: int,
        backend: str,
        steps: int,
        threads: int,
        progress: Progress | None,
    ) -> None:
        """Write the network."""
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        self.asked.append(folder.name)
        if progress is not None:
            progress(0, steps)
        if seed in self.killed:
            raise KeyboardInterrupt
        if seed in self.breaks:
            raise RuntimeError("the engine\nblew up")
        draws = np.random.default_rng(seed)
        tensors = {
            "layers.0.weight": draws.normal(size=(9, OBSERVED)).astype(np.float32),
            "layers.0.bias": np.zeros(9, dtype=np.float32),
        }
        names = ("action_mode", "frame_skip", "conventions")
        env = {name: recipe.env[name] for name in names} | SHORT
        card = {"steps": steps, "wall_s": 2.0, "cpu_s": 1.0}
        about = {"task": recipe.task, "env": env, "card": card}
        save_policy(folder / "policy.safetensors", tensors, about)


def small(**changes: Any) -> Study:
    """Give a study of one training in two protocols."""
    fields: dict[str, Any] = {
        "tasks": ("pushing",),
        "algos": ("ppo",),
        "curricula": (1,),
        "seeds": (0,),
        "protocols": ("P0", "P5"),
        "episodes": 2,
        "scale": 0.01,
        "backend": "fake",
    }
    return Study(**{**fields, **changes})


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give the folder of a study with two seeds."""
    folder = tmp_path_factory.mktemp("two") / "study"
    with_pictures(small(seeds=(0, 1)), folder, trainer=Fake())
    return folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"tasks": ("towers",)}, "no task is named 'towers'"),
        ({"algos": ("dqn",)}, "no algorithm is named 'dqn'"),
        ({"curricula": (3,)}, "curriculum cannot be 3"),
        ({"algos": ()}, "no algorithm is named 'none'"),
        ({"seeds": (1, 1)}, "each of them once"),
        ({"seeds": (-1,)}, "from 0 on"),
        ({"protocols": ("P99",)}, "P99"),
        ({"episodes": 0}, "from 1 on"),
        ({"preset": "fast"}, "fast"),
        ({"scale": 0.0}, "more than 0"),
        ({"scale": 2.0}, "at most 1"),
        ({"backend": "ode"}, "no backend is named 'ode'"),
        ({"policy": "first"}, "no policy is named 'first'"),
        ({"conventions": "mine"}, "no conventions is named 'mine'"),
    ],
)
def test_what_does_not_exist_is_refused(changes: dict[str, Any], said: str) -> None:
    """A study of something unknown is refused, with what there is."""
    with pytest.raises(UnknownOption, match=said):
        small(**changes)


def test_the_whole_study_is_the_published_one() -> None:
    """By default there are 4 tasks x 3 algorithms x 3 curricula x 5 seeds, at full length."""
    cells = list(Study().cells())
    assert len(set(cells)) == 4 * 3 * 3 * 5
    for cell in cells[:36]:
        made = Study().recipe(cell)
        assert made.steps == published().budget.steps[cell.algo]
        assert made.env["conventions"] == "causal_world"


def test_a_plan_says_what_is_left(two: Path) -> None:
    """What is done costs nothing any more; another seed does."""
    done, more = planned(small(), two), planned(small(seeds=(0, 7), algos=("ppo", "td3")), two)
    assert [plan.state for plan in done] == ["done"]
    assert done[0].left == 0.0
    assert [plan.state for plan in more] == ["done", "", "", ""]
    assert more[1].left > more[2].left > 0.0  # an update for each step costs more than PPO


def test_steps_are_a_share_in_whole_rounds() -> None:
    """A share of the training ends with a round, and is never less than one."""
    study = small(scale=1e-6)
    made = study.recipe(next(study.cells()))
    assert study.steps(made) == made.round == 20 * 6000


def test_what_is_finished_is_kept(two: Path, tmp_path: Path) -> None:
    """The same call again trains nothing and changes no bit of the tables."""
    folder = tmp_path / "again"
    shutil.copytree(two, folder)
    before = (folder / "table.json").read_bytes()
    trainer = Fake()
    again = reproduce(small(seeds=(0, 1)), folder, trainer=trainer)
    assert trainer.asked == []
    assert [outcome.status for outcome in again.outcomes] == ["done", "done"]
    assert (folder / "table.json").read_bytes() == before
    assert reproduce(small(seeds=()), folder).outcomes == ()  # tables alone need no trainer


def test_a_killed_study_goes_on(two: Path, tmp_path: Path) -> None:
    """After a kill within the second training, the same call gives the same table."""
    folder = tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        reproduce(small(seeds=(0, 1)), folder, trainer=Fake(killed=(1,)))
    trainer = Fake()
    reproduce(small(seeds=(0, 1)), folder, trainer=trainer)
    assert trainer.asked == ["pushing-ppo-c1-1"]
    assert (folder / "table.csv").read_text() == (two / "table.csv").read_text()


def test_a_failed_training_does_not_stop_the_others(tmp_path: Path) -> None:
    """It is told of in the end, and tried again by the next call."""
    study = small(seeds=(0, 1, 2), protocols=("P0",))
    found = reproduce(study, tmp_path / "study", trainer=Fake(breaks=(1,)))
    assert [outcome.status for outcome in found.outcomes] == ["done", "failed", "done"]
    assert found.failed[0].message == "RuntimeError: the engine blew up"
    again = reproduce(study, tmp_path / "study", trainer=Fake())
    assert again.failed == ()


def test_the_time_can_be_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A study stops in time, also within a training, and the rest is said to be not run."""
    study, folder = small(seeds=(0, 1), protocols=("P0",)), tmp_path / "study"
    clock = iter([0.0, 1.0, *[7200.0] * 100])
    monkeypatch.setattr("time.time", lambda: next(clock))
    found = reproduce(study, folder, trainer=Fake(), hours=1.0)
    assert [outcome.status for outcome in found.outcomes] == ["stopped", "stopped"]
    assert all(row.ours is None for row in found.rows)
    assert "not run" in (folder / "table.md").read_text()
    with pytest.raises(UnknownOption, match="more than 0"):
        reproduce(study, folder, trainer=Fake(), hours=0.0)


def test_scores_are_means_over_seeds(two: Path) -> None:
    """The table has the mean of the seeds' means, and what was published beside it."""
    with (two / "table.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    row = next(r for r in rows if (r["curriculum"], r["protocol"], r["algo"]) == ("1", "P5", "ppo"))
    means = []
    for seed in (0, 1):
        results = json.loads((two / f"evaluations/pushing-ppo-c1-{seed}/results.json").read_text())
        scores = {s["protocol"]: s["last_fractional_success"]["value"] for s in results["scores"]}
        means.append(scores["P5"])
    assert float(row["mean"]) == pytest.approx(np.mean(means), abs=1e-12)
    assert float(row["mean_low"]) == pytest.approx(min(means), abs=1e-12)
    assert (row["seeds"], row["interval_over"], row["published"]) == ("0 1", "seeds", "0.99")


def test_a_part_of_the_budget_is_no_reproduction(two: Path) -> None:
    """What was done less than published stands in every row and above every table."""
    with (two / "table.csv").open(newline="") as stream:
        status = {row["status"] for row in csv.DictReader(stream)}
    assert {word.partition(":")[0] for word in status} == {
        "Partial budget, not a reproduction",
        "not run",
    }
    text = (two / "table.md").read_text()
    for said in ("1,080,000 of 100,000,000", "2 of 5 seeds", "2 of 200 episodes", "2 of 12 proto"):
        assert said in text
    assert (two / "pushing-ppo.png").stat().st_size > 1000
    assert "<html" in (two / "reports/pushing-ppo/report.html").read_text()


@pytest.mark.parametrize(
    "other", [{"policy": "best"}, {"conventions": "scm_world"}, {"preset": "tuned"}], ids=repr
)
def test_what_is_measured_otherwise_is_no_reproduction(two: Path, other: dict[str, str]) -> None:
    """However much was trained: the published scores are of the last policy, and by its rules."""
    found = Findings.read(small(**other), two)
    (option, value), *_ = other.items()
    assert f"{option} {value}, not the paper's" in lacks(found, "pushing", "ppo", 1)
    usual = Findings.read(small(), two)
    assert not any("the paper's" in said for said in lacks(usual, "pushing", "ppo", 1))


def test_more_can_be_added_but_nothing_else(two: Path, tmp_path: Path) -> None:
    """Protocols and episodes are added to what there is; another scale needs another folder."""
    folder = tmp_path / "more"
    shutil.copytree(two, folder)
    trainer = Fake()
    reproduce(small(protocols=("P1",), episodes=3), folder, trainer=trainer)
    results = json.loads((folder / "evaluations/pushing-ppo-c1-0/results.json").read_text())
    assert trainer.asked == []
    assert (sorted(p["name"] for p in results["about"]["protocols"]), results["about"]["n"]) == (
        ["P0", "P1", "P5"],
        3,
    )
    with pytest.raises(UnreadableFile, match=r"scale 0\.01"):
        reproduce(small(scale=0.02), folder, trainer=trainer)


def test_other_folders_are_refused(tmp_path: Path, two: Path) -> None:
    """A folder of something else, and damaged records, are refused with what to do."""
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UnreadableFile, match="something else"):
        reproduce(small(), tmp_path, trainer=Fake())
    with pytest.raises(UnreadableFile, match="no folder"):
        reproduce(small(), tmp_path / "notes.txt", trainer=Fake())
    folder = tmp_path / "damaged"
    shutil.copytree(two, folder)
    record = folder / "trained" / "pushing-ppo-c1-0.json"
    record.write_text(record.read_text()[:50])
    with pytest.raises(UnreadableFile, match="no record of a training"):
        planned(small(), folder)
    (folder / "study.json").write_text("{}")
    with pytest.raises(UnreadableFile, match="describes no study"):
        reproduce(small(), folder, trainer=Fake())


def test_a_training_by_another_recipe_is_not_taken(two: Path, tmp_path: Path) -> None:
    """A recipe that has changed since then is told of, with what differs."""
    folder = tmp_path / "old"
    shutil.copytree(two, folder)
    record = folder / "trained" / "pushing-ppo-c1-0.json"
    data = json.loads(record.read_text())
    data["recipe"]["worlds"] = 3
    record.write_text(json.dumps(data))
    found = reproduce(small(), folder, trainer=Fake())
    assert "worlds differ" in found.failed[0].message


def test_a_policy_that_is_another_one_is_evaluated_again(two: Path, tmp_path: Path) -> None:
    """Trained anew, a policy is not given the scores of the one before it."""
    folder = tmp_path / "anew"
    shutil.copytree(two, folder)
    policy = folder / "runs/pushing-ppo-c1-0/policy.safetensors"
    shutil.copy(folder / "runs/pushing-ppo-c1-1/policy.safetensors", policy)
    assert planned(small(), folder)[0].state == "trained"
    reproduce(small(), folder, trainer=Fake())
    assert planned(small(), folder)[0].state == "done"


def test_published_actors_are_checked(tmp_path: Path) -> None:
    """A missing or another archive is refused before anything is trained."""
    trainer = Fake()
    with pytest.raises(UnreadableFile, match="causal-world"):
        reproduce(small(), tmp_path / "study", trainer=trainer, actors=tmp_path)
    (tmp_path / "pushing_ppo_curr1.zip").write_bytes(b"no archive")
    with pytest.raises(UnreadableFile, match="not the published archive"):
        reproduce(small(), tmp_path / "study", trainer=trainer, actors=tmp_path)
    assert trainer.asked == []


def test_a_published_actor_stands_beside_the_score(two: Path, tmp_path: Path) -> None:
    """An actor that is evaluated here has a column, with its score where it comes from."""
    folder, archive = tmp_path / "actor", tmp_path / "actor.zip"
    shutil.copytree(two, folder)
    sizes = {"shared_fc0": (OBSERVED, 4), "pi": (4, 9)}
    tensors: dict[str, Any] = {f"model/{n}/w:0": np.zeros(size) for n, size in sizes.items()}
    tensors |= {f"model/{name}/b:0": np.zeros(size[1]) for name, size in sizes.items()}
    tensors["model/pi/logstd:0"] = np.zeros((1, 9))
    np.savez(weights := io.BytesIO(), **tensors)
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("parameters", weights.getvalue())
    study = small(protocols=("P0",), episodes=2)
    actor = published().actor("pushing", "ppo", 1)
    assert actor is not None
    told: list[tuple[int, int]] = []
    job = Job(Cell("pushing", "ppo", 1, 0), study, folder)
    evaluate_actor(actor, archive, job, lambda done, total: told.append((done, total)))
    assert told[-1] == (2, 2)
    less = replace(job, study=small(protocols=("P1",), episodes=1))
    evaluate_actor(actor, archive, less, lambda done, total: told.append((done, total)))
    assert told[-1] == (4, 4)  # nothing that was there is lost
    reproduce(study, folder, trainer=Fake())
    text = (folder / "table.md").read_text()
    assert "published actor, here" in text
    assert "there 1.000 (2)" in text


def test_every_published_score_has_a_source() -> None:
    """Scores lie in [0, 1], are of known protocols, and say where they are from."""
    known = published()
    for one in (*known.scores, *known.actors):
        assert one.source in known.sources
        assert {*one.values} <= {*Study().protocols}
        assert all(0.0 <= value <= 1.0 for value in one.values.values())


def test_the_command_shows_plans_and_refuses(tmp_path: Path, two: Path) -> None:
    """``--plan`` costs nothing; what does not exist is an error line with code 2."""
    runner = CliRunner()
    common = ["reproduce", "--scale", "0.01", "--backend", "fake", "--out", str(two)]
    shown = runner.invoke(app, [*common, "--plan", "--algos", "ppo", "--seeds", "0,1,2"])
    assert shown.exit_code == 0
    assert "CPU-hours are left" in shown.output
    for wrong in (["--table", "stacking9"], ["--seeds", "one"], ["--curricula", "5"]):
        assert runner.invoke(app, [*common, *wrong, "--plan"]).exit_code == 2


def test_the_command_runs_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command trains, says what it wrote, and exits with 1 if a training failed."""
    arguments = ["reproduce", "--scale", "0.01", "--backend", "fake", "--algos", "ppo"]
    arguments += ["--curricula", "0", "--protocols", "P0", "--episodes", "1", "--seeds", "0,1"]
    arguments += ["--no-pictures"]
    arguments += ["--out", str(tmp_path / "study")]
    for trainer, code in ((Fake(breaks=(1,)), 1), (Fake(killed=(1,)), 130), (Fake(), 0)):
        monkeypatch.setattr(holding, "usual_trainer", lambda trainer=trainer: trainer)
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == code, done.output
    assert "2 of 2 trainings are done" in done.output
