"""What holds for models that nobody here wrote, as a table.

Run it from the root of the repository with ``python -m benchmarks.models.proof [NAME…]``; a name
picks the models in whose path it stands. Models are read from installed packages: gymnasium,
dm_control, robosuite and pybullet_data; what is not installed is left out, by name.

Each model goes through ``scm_world.testing.model.check_model`` (do and undo, refusals,
counterfactuals, a snapshot in another process, a batch of 16, 2,000 steps with random actions and
interventions) and ``verify`` with 12 probe states.
``pytest -m slow tests/benchmarks/test_proof.py`` demands all of it.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

from benchmarks import as_json
from scm_world.queries import World, verify
from scm_world.testing.model import check_model

GYMNASIUM, SUITE = "gymnasium/envs/mujoco/assets/", "dm_control/suite/"
ROBOTS, URDFS = "robosuite/models/assets/robots/", "pybullet_data/"
MODELS = (
    *(f"{GYMNASIUM}{n}.xml" for n in ("inverted_double_pendulum", "reacher", "pusher_v5")),
    *(f"{GYMNASIUM}{n}.xml" for n in ("half_cheetah", "ant", "hopper", "walker2d", "swimmer")),
    *(f"{GYMNASIUM}{n}.xml" for n in ("humanoid", "inverted_pendulum")),
    *(f"{SUITE}{n}.xml" for n in ("cartpole", "ball_in_cup", "finger", "cheetah", "acrobot")),
    *(f"{SUITE}{n}.xml" for n in ("fish", "manipulator", "stacker", "walker")),
    *(f"{ROBOTS}{n}/robot.xml" for n in ("panda", "ur5e")),
    *(f"{URDFS}{n}.urdf" for n in ("cartpole", "kuka_iiwa/model", "franka_panda/panda", "r2d2")),
    *(f"{URDFS}{n}.urdf" for n in ("a1/a1", "laikago/laikago")),
)
ON_BULLET = tuple(f"{URDFS}{n}.urdf" for n in ("cartpole", "kuka_iiwa/model", "franka_panda/panda"))
"""These are tried on Bullet, too."""

HERE = Path(__file__).parent
COLUMNS = ("model", "backend", "variables", "undone", "left", "refused", "steps")
GRAPH = ("edges", "fired", "undeclared", "floor", "seconds")


def file_of(name: str) -> Path | None:
    """Find a file in an installed package."""
    package, _, inside = name.partition("/")
    found = importlib.util.find_spec(package)
    folders = [] if found is None else list(found.submodule_search_locations or ())
    return Path(folders[0]) / inside if folders else None


def prove(path: Path, backend: str) -> dict[str, Any]:
    """Check a model, and verify its graph.

    Returns:
        The figures, by name.

    Raises:
        AssertionError: A promise is broken.
    """
    started = time.perf_counter()
    checked = check_model(path, backend=backend)
    world = World(path, backend=backend)
    found = verify(world, probes=12)
    world.close()
    return {
        "variables": checked["variables"],
        "undone": checked["set and undone"],
        "left": "0",  # what is left of an intervention that was undone would be an error
        "refused": checked["refused"],
        "steps": checked["steps"],
        "edges": len(found.declared),
        "fired": len(found.fired),
        "undeclared": len(found.undeclared),
        "floor": f"{found.floor:g}",
        "seconds": round(time.perf_counter() - started, 1),
    }


def row(name: str, backend: str) -> dict[str, Any]:
    """Write down what is proved of one model, or why it is not."""
    path = file_of(name)
    model = name.removesuffix("/robot.xml").removesuffix(".xml").removesuffix(".urdf")
    try:
        found = {"left": "not installed"} if path is None else prove(path, backend)
    except Exception as error:
        found = {"left": f"{type(error).__name__}: {error}"}
    return {"model": model, "backend": backend, **found}


def main(picked: list[str]) -> None:
    """Write the table."""
    warnings.simplefilter("ignore")
    rows = []
    for backend, names in (("mujoco", MODELS), ("bullet", ON_BULLET)):
        for name in names:
            if not picked or any(part in name for part in picked):
                rows.append(row(name, backend))
                print(json.dumps(rows[-1]), flush=True)
    if picked:
        return
    lines = ["| " + " | ".join((*COLUMNS, *GRAPH)) + " |", "|---" * 12 + "|"]
    lines += [
        "| " + " | ".join(str(one.get(column, "")) for column in (*COLUMNS, *GRAPH)) + " |"
        for one in rows
    ]
    (HERE / "proof.md").write_text("\n".join(lines) + "\n")
    (HERE / "proof.json").write_text(as_json(rows) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
