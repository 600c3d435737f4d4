"""The benchmark of learners records interventions as its cases say."""

import numpy as np
import pytest

from benchmarks.discovery import case
from scm_world.tasks.families import random_model

EACH = 6


@pytest.mark.parametrize("kind", ["", "soft", "off-target", "failed", "partial"])
def test_every_target_is_recorded_in_as_many_rows(kind: str) -> None:
    """Whatever really happened, each target has its rows, and twice as many have none."""
    truth, data = case("er2:9", kind, EACH, 0)
    assert set(truth) == {edge.key for edge in random_model("er2:9", 0).edges}
    assert data.targeted.sum(axis=0).tolist() == [EACH] * 9
    assert (~data.targeted.any(axis=1)).sum() == 2 * EACH
    assert len(np.unique(data.values, axis=0)) == len(data)


def test_interventions_that_fail_leave_variables_as_they_are() -> None:
    """A third of the targets, or half of the rows of each, follow their causes."""

    def follows(kind: str) -> np.ndarray:
        """Return the share of recorded rows of each target in which its mechanism holds."""
        truth, data = case("er2:9", kind, 200, 1)
        shares = []
        for j, name in enumerate(data.names):
            causes = [data.names.index(c) for c, e, _ in truth if e == name]
            free, mine = ~data.targeted[:, j], data.targeted[:, j]
            terms = np.column_stack([data.values[:, causes], np.ones(len(data))])
            weights = np.linalg.lstsq(terms[free], data.values[free, j], rcond=None)[0]
            rest = data.values[:, j] - terms @ weights
            shares.append(
                rest[mine].std() < 1.15 * rest[free].std() and abs(rest[mine].mean()) < 0.3
            )
        return np.array(shares)

    assert follows("").sum() == 0
    assert follows("failed").sum() == 3


def test_a_latent_projection_skips_what_is_hidden() -> None:
    """Half of the columns are there; of half set, all, and only what was set has effects."""
    truth, data = case("er2:9", "latent", EACH, 0)
    assert len(data.names) == 4
    assert {end for edge in truth for end in edge[:2]} <= set(data.names)
    whole, wide = case("er2:9", "half set", EACH, 0)
    reduced, same = case("er2:9", "projection", EACH, 0)
    assert np.array_equal(wide.values, same.values)
    was_set = {
        name for name, some in zip(same.names, same.targeted.any(axis=0), strict=True) if some
    }
    assert {cause for cause, _, _ in reduced} <= was_set
    assert {edge for edge in whole if edge[0] in was_set} <= set(reduced)
