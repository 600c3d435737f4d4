"""What a study leaves in its folder: records of trainings, and evaluations."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from scm_world.errors import UnreadableFile
from scm_world.evaluation import Evaluation
from scm_world.evaluation.files import RESULTS
from scm_world.output.durable import made, write_whole
from scm_world.training.study.cells import FORMAT, POLICIES, Cell, Study

HEAD = "study.json"
RUNS, TRAINED, EVALUATED, ACTORS = "runs", "trained", "evaluations", "actors"
ADVICE = "delete it, and what it tells of is done again"


@final
@dataclass(frozen=True)
class Record:
    """A training that is finished.

    Attributes:
        cell: Which one.
        recipe: With which recipe, as plain data.
        steps: Control steps that were trained.
        whole: Control steps of the recipe.
        seconds: That it took on the clock, interruptions left out.
        cpu_seconds: Likewise, of the processor.
    """

    cell: Cell
    recipe: Mapping[str, Any]
    steps: int
    whole: int
    seconds: float
    cpu_seconds: float


def run_of(folder: Path, cell: Cell) -> Path:
    """Give the folder of a training."""
    return folder / RUNS / cell.name


def evaluation_of(folder: Path, cell: Cell) -> Path:
    """Give the folder of an evaluation."""
    return folder / EVALUATED / cell.name


def policy_of(study: Study, folder: Path, cell: Cell) -> Path:
    """Give the file of the policy that is evaluated."""
    return run_of(folder, cell) / POLICIES[study.policy]


def _path(folder: Path, cell: Cell) -> Path:
    return folder / TRAINED / f"{cell.name}.json"


def write_record(folder: Path, record: Record) -> None:
    """Write down that a training is finished."""
    path = _path(folder, record.cell)
    made(path.parent)
    write_whole(json.dumps({"format": FORMAT, **asdict(record)}, indent=1) + "\n", path)


def read_record(folder: Path, cell: Cell) -> Record | None:
    """Read the record of a training; None if it is not finished.

    Raises:
        UnreadableFile: The file is damaged, or of another training.
    """
    path = _path(folder, cell)
    if not path.exists():
        return None
    found = _read(path)
    if found.cell != cell:
        raise UnreadableFile(str(path), f"it is of {found.cell.name}", ADVICE)
    return found


def records(folder: Path) -> Iterator[Record]:
    """Read the records of all trainings that are finished."""
    for path in sorted((folder / TRAINED).glob("*.json"), key=lambda path: path.name):
        yield _read(path)


def _read(path: Path) -> Record:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data.pop("format") != FORMAT:
            raise ValueError("it is none of this package")
        return Record(**{**data, "cell": Cell(**data["cell"])})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"it is no record of a training: {error}"
        raise UnreadableFile(str(path), reason, ADVICE) from None


def read_evaluation(place: Path) -> Evaluation | None:
    """Read an evaluation; None if it is not finished."""
    return Evaluation.load(place) if (place / RESULTS).exists() else None


def is_evaluated(study: Study, folder: Path, record: Record | None) -> bool:
    """Tell whether a training is evaluated in all protocols and episodes of a study.

    An evaluation of another policy than the one that lies there by now does not count.
    """
    if record is None:
        return False
    found = read_evaluation(evaluation_of(folder, record.cell))
    path = policy_of(study, folder, record.cell)
    if found is None or not {*study.protocols} <= {*found.protocols}:
        return False
    its = found.about["agents"][0]["policy"].get("sha256")
    is_other = path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() != its
    return int(found.about["n"]) >= study.episodes and not is_other


def begin(study: Study, folder: Path) -> None:
    """Begin the folder of a study, or check that a study like this one was begun there.

    Raises:
        UnreadableFile: It holds something else, or a study of another kind.
    """
    path, head = folder / HEAD, study.head
    if not path.exists():
        if folder.exists() and not folder.is_dir():
            raise UnreadableFile(str(folder), "it is no folder", "give a folder for the study")
        taken = [one.name for one in folder.iterdir()] if folder.exists() else []
        if any(not name.startswith(".") for name in taken):
            advice = "give an empty folder, or one in which a study was begun"
            raise UnreadableFile(str(folder), "it holds something else", advice)
        made(folder)
        write_whole(json.dumps(head, indent=1) + "\n", path)
        return
    there = read_head(folder)
    different = [f"{name} {there.get(name)!r}" for name in head if there.get(name) != head[name]]
    if different:
        reason = f"a study with {', '.join(different)} was begun in it"
        raise UnreadableFile(str(folder), reason, "give another folder, or the same options")


def read_head(folder: Path) -> dict[str, Any]:
    """Read what was begun in a folder; nothing if nothing was.

    Raises:
        UnreadableFile: The file is damaged.
    """
    path = folder / HEAD
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["format"] != FORMAT:
            raise ValueError("it is none of this package")
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason, advice = f"it describes no study: {error}", "give another folder"
        raise UnreadableFile(str(path), reason, advice) from None
    return dict(found)
