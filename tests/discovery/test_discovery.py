"""Discovery finds what is there, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from scm_world.discovery import DiscoveryReport, discover, evaluate
from scm_world.errors import UnknownOption
from scm_world.graph import SCM
from scm_world.tasks import Pushing, TriFingerTask
from scm_world.tasks.base import Observed
from scm_world.variables import Derived, Exogenous, Linear, Normal, Parent, Variable
from scm_world.world import Simulation


def random_model(seed: int, n: int = 12) -> SCM:
    """Draw a linear model with noise and one lagged edge."""
    generator = np.random.default_rng(seed)
    variables = []
    for i in range(n):
        parents: list[str | Parent] = [f"x{j}" for j in range(i) if generator.random() < 0.25]
        if i == 0:
            parents.append(Parent(f"x{n - 1}", 1))
        weights = tuple(generator.uniform(0.5, 2.0, len(parents)))
        variables.append(
            Derived(
                name=f"x{i}",
                parents=tuple(parents),
                mechanism=Linear(weights=weights),
                noise=Normal(),
            )
        )
    return SCM(variables)


@pytest.mark.parametrize("seed", range(5))
def test_models_are_recovered_exactly(seed: int) -> None:
    """The graph of a model without physics is recovered without error."""
    report = discover(random_model(seed), probes=3, seed=seed)
    assert report.score.shd == 0
    assert report.inert == 0.0


def test_worlds_are_recovered() -> None:
    """Nearly every declared edge is found, no other, and no noise."""
    report = discover("pushing", probes=16)
    assert report.score.undeclared == ()
    assert report.score.recall >= 0.99
    assert report.floor == 0.0
    assert report.inert == 0.0


class Tampered:
    """The pushing task, with one declaration changed to a falsehood."""

    def __init__(self, *, drop: tuple[str, str] | None, add: tuple[str, str] | None) -> None:
        self.drop, self.add = drop, add

    def __call__(self, variables: Iterable[Variable]) -> list[Variable]:
        """Change the parents of one variable."""
        changed = []
        for variable in variables:
            parents = variable.all_parents
            if self.drop and variable.name == self.drop[1]:
                parents = tuple(p for p in parents if p.name != self.drop[0])
            if self.add and variable.name == self.add[1]:
                parents = (*parents, Parent(self.add[0], 1))
            if parents != variable.all_parents:
                variable = variable.model_copy(update={"parents": parents})  # noqa: PLW2901
            changed.append(variable)
        return changed


def tampered_world(monkeypatch: pytest.MonkeyPatch, tamper: Tampered) -> Simulation:
    """Build a pushing world that declares something false about its physics."""
    from scm_world.tasks.trifinger.entities.block_world import BlockWorld

    honest = BlockWorld.variables
    monkeypatch.setattr(BlockWorld, "variables", lambda self: tuple(tamper(honest(self))))
    monkeypatch.setattr("scm_world.world.structures._ALIVE", {})  # honest worlds may be alive
    return Simulation("pushing")


def test_an_edge_that_is_not_declared_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Physics finds an edge that the declaration leaves out."""
    edge = ("gravity", "tool_block.linear_velocity")
    world = tampered_world(monkeypatch, Tampered(drop=edge, add=None))
    assert discover(world, probes=6).score.undeclared == ((*edge, 1),)


def test_an_edge_that_does_not_exist_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A declared edge that physics does not have is listed as missed."""
    edge = ("tool_block.color", "tool_block.linear_velocity")
    world = tampered_world(monkeypatch, Tampered(drop=None, add=edge))
    assert (*edge, 1) in discover(world, probes=8).score.missed


def test_a_direct_edge_is_told_from_an_indirect_one() -> None:
    """The shared size moves the goal's size, and only through it the overlap."""
    found = discover("pushing", probes=8).found
    assert ("block.size", "goal_block.size", 0) in found
    assert ("goal_block.size", "fractional_success", 0) in found
    assert ("block.size", "fractional_success", 0) not in found


def test_results_depend_on_the_seed_alone() -> None:
    """Two runs with one seed agree in every effect; another seed sets other values."""
    one, two = (discover("reaching", probes=1, seed=3) for _ in range(2))
    other = discover("reaching", probes=1, seed=4)
    assert one.edges == two.edges
    assert one.edges != other.edges


def test_report_is_complete(tmp_path: Path) -> None:
    """The file holds what a reader needs to judge and to repeat the run."""
    report = discover("pushing", backend="fake", probes=2, seed=1)
    path = tmp_path / "report.json"
    path.write_text(report.to_json())
    data = json.loads(path.read_text())
    assert data["task"] == "pushing"
    assert (data["seed"], data["probes"], data["planned"]) == (1, 2, 2)
    assert {"rollouts", "unstable", "score", "seconds", "versions"} <= data.keys()
    assert {"shd", "precision", "recall", "f1"} <= data["score"].keys()
    assert len(data["edges"]) == len(report.declared)
    assert DiscoveryReport.from_json(path.read_text()) == report
    assert list(tmp_path.iterdir()) == [path]


def test_interruption_keeps_what_was_found() -> None:
    """Ctrl-C in the middle gives the report of the probes that were finished."""

    def stop(done: int, planned: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    report = discover("reaching", backend="fake", probes=5, progress=stop)
    assert (report.probes, report.planned) == (2, 5)


@pytest.mark.parametrize("number", [0, -1, 2.5])
def test_probes_must_be_positive(number: int) -> None:
    """A number of probes below one is refused."""
    with pytest.raises(UnknownOption, match="probes"):
        discover("pushing", backend="fake", probes=number)


def test_score_by_hand() -> None:
    """Distance, precision and recall are those counted by hand."""
    declared = [("a", "b", 0), ("b", "c", 0), ("a", "c", 1)]
    found = [("b", "a", 0), ("b", "c", 0), ("c", "c", 1)]
    result = evaluate(found, declared)
    assert result.shd == 3  # one reversed, one missing, one extra
    assert (result.precision, result.recall) == (1 / 3, 1 / 3)
    assert result.undeclared == (("b", "a", 0), ("c", "c", 1))
    assert result.missed == (("a", "b", 0), ("a", "c", 1))


def test_empty_graphs_agree() -> None:
    """A model without edges is recovered as one without edges."""
    report = discover(SCM([Exogenous(name="a"), Exogenous(name="b")]), probes=1)
    assert (report.score.shd, report.score.f1) == (0, 1.0)


def test_custom_tasks_can_be_discovered() -> None:
    """A user's own task is a world like any other."""

    class Heavy(TriFingerTask):
        name = "heavy"
        seconds = 1.0

        default_weights = Pushing.default_weights

        def __init__(self) -> None:
            super().__init__()
            self._pushing = Pushing(tool_block_mass=0.08)

        def entities(self):  # type: ignore[no-untyped-def]
            return self._pushing.entities()

        def shared(self) -> Iterable[Variable]:
            return self._pushing.shared()

        def readouts(self) -> Iterable[Variable]:
            return self._pushing.readouts()

        def observed(self) -> Iterable[Observed]:
            return self._pushing.observed()

        def goal_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
            return self._pushing.goal_names()

        def fraction(self, achieved, desired):  # type: ignore[no-untyped-def]
            return self._pushing.fraction(achieved, desired)

        def fulfilled(self, fraction):  # type: ignore[no-untyped-def]
            return self._pushing.fulfilled(fraction)

        def solution(self, values):  # type: ignore[no-untyped-def]
            return self._pushing.solution(values)

    report = discover(Simulation(Heavy(), backend="fake"), probes=1)
    assert report.task == "heavy"
    assert report.score.undeclared == ()
