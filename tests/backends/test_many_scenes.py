"""An engine may say how many scenes it steps best together: questions and collections use that."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from test_scenes import OneTable

from scm_world import World
from scm_world.backends import Capabilities
from scm_world.discovery.data import Design, collect
from scm_world.queries.twins import Twins

SCENES = 150


class Wide(OneTable):
    """A table, of which many rows are best."""

    name: ClassVar[str] = "wide"
    capabilities: ClassVar[Capabilities] = Capabilities(physics=False, scenes=SCENES)


@pytest.fixture
def sizes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Provide how many worlds were stepped together, in each turn."""
    monkeypatch.setattr("scm_world.backends._REGISTERED", {"wide": Wide})
    found, rows = list[int](), Twins.rows

    def counted(self: Twins, n: int, *rest: Any) -> Any:
        found.append(n)
        return rows(self, n, *rest)

    monkeypatch.setattr(Twins, "rows", counted)
    return found


def test_collections_are_made_in_batches_of_the_engine(sizes: list[int], tmp_path: Path) -> None:
    """Their rows do not depend on the engine's number of scenes."""
    design = Design("single", ("tool_block.mass", "floor_friction"), "A", 0.3)
    made = [
        collect(World("pushing", backend=name), design, 200, steps=3, seed=4, out=tmp_path / name)
        for name in ("fake", "wide")
    ]
    assert sizes == [200, 100]  # of two turns
    assert [len([*(tmp_path / name).glob("shard-*")]) for name in ("fake", "wide")] == [1, 1]
    assert made[0].values.tobytes() == made[1].values.tobytes()
    assert made[0].about["fingerprint"] != made[1].about["fingerprint"]  # of other engines

    sizes.clear()  # what was begun goes on, and the rows of an episode do not depend on the batch
    small = collect(World("pushing", backend="wide"), design, 40, steps=3, seed=4, shard=7)
    assert sizes == [7, 7, 7, 7, 7, 5]
    assert small.values.tobytes() == made[1].values[:40].tobytes()
    more = collect(
        World("pushing", backend="wide"), design, 300, steps=3, seed=4, out=tmp_path / "wide"
    )
    assert sizes[6:] == [SCENES]  # the file that was not full is made again
    assert np.array_equal(more.values[:200], made[1].values)


def test_samples_are_drawn_in_batches_of_the_engine(sizes: list[int]) -> None:
    """As many as there are, up to the number that it steps best."""
    worlds = World("pushing", backend="wide")
    found = worlds.sample(400, outcomes=["tool_block.cartesian_position"], steps=2)
    assert sizes == [134]  # evenly: three batches
    assert len(found.numbers) == 400
    sizes.clear()
    worlds.sample(3, outcomes=["reward"], steps=2)
    assert not sizes  # too few for a batch
