"""Collect a dataset from interventions, keep it, and hand it to other libraries.

Run it with ``python examples/collect.py``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from scm_world.discovery.data import Design, as_gies, collect, load
from scm_world.queries import Outcome, World

CAUSES = ("tool_block.mass", "tool_block.friction", "floor_friction")
OUTCOMES = (Outcome("tool_block.cartesian_position", "change"), Outcome("reward", "sum"))


def main(backend: str = "fake", episodes: int = 60) -> None:
    """Collect twice as many episodes as at first, and print their contents."""
    world = World("pushing", backend=backend)
    design = Design("single", CAUSES, values="A|B", observational_fraction=0.25)
    nature = dict.fromkeys(CAUSES, "A") | {"sensor_noise": 0.01}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "pushing"
        for n in (episodes // 2, episodes):  # the second call goes on where the first one ended
            collect(
                world,
                design,
                n,
                out=folder,
                shard=20,
                steps=5,
                nature=nature,
                causes=CAUSES,
                outcomes=OUTCOMES,
            )
            print(n, "episodes in", ", ".join(sorted(path.name for path in folder.iterdir())))
        table = load(folder)
    print(table)
    data, targets = as_gies(table)
    for rows, columns in zip(data, targets, strict=True):
        done = ", ".join(table.names[column] for column in columns) or "nothing"
        print(f"  {len(rows):3d} rows with do({done})")
    print("mean mass:", np.round(table["tool_block.mass"].mean(), 3), "kg")
    world.close()


if __name__ == "__main__":
    main()
