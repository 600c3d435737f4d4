"""Every learner that is given data passes the public conformance suite."""

import pytest

from scm_world.discovery.data import Dataset
from scm_world.discovery.learners import EstimatedGraph, Learner, learners
from scm_world.testing.learner import LearnerConformance

GIVEN = sorted(
    name
    for name, known in learners().items()
    if not ("paired" in known.takes or known.temporal or known.baseline)
)
SEARCHES = ("boss", "grasp")
"""They climb from where they begin, and may stop at another summit."""


@pytest.mark.parametrize("name", GIVEN)
class TestKnownLearners(LearnerConformance):
    """All learners that are installed."""

    @pytest.fixture(autouse=True)
    def _named(self, name: str) -> None:
        if not learners()[name].is_installed:
            pytest.skip(f"{learners()[name].package} is not installed")
        self.learner = name
        self.searches = name in SEARCHES


def test_there_are_learners() -> None:
    """The list above is not empty, and holds ours."""
    assert {"do_order", "gies", "pc"} <= set(GIVEN)


def lazy(data: Dataset, *, seed: int = 0) -> EstimatedGraph:
    """Find nothing."""
    return EstimatedGraph.of_edges(data.names, [])


def test_the_suite_can_fail() -> None:
    """A learner that finds nothing does not pass."""

    class OfNothing(LearnerConformance):
        learner = Learner("lazy", lazy)

    with pytest.raises(AssertionError):
        OfNothing().test_it_finds_a_collider()
