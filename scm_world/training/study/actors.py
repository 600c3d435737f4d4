"""The published policies, evaluated here."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from scm_world.errors import UnreadableFile
from scm_world.queries.progress import Progress
from scm_world.training.study.cells import Study
from scm_world.training.study.published import Actor, published
from scm_world.training.study.records import ACTORS
from scm_world.training.study.runs import Job, OutOfTime, evaluate_in

ENV = {"conventions": "causal_world", "frame_skip": 3}
"""What the actors were trained in."""


def check_actors(study: Study, archives: Path) -> dict[Path, Actor]:
    """List the published actors of a study by their archives.

    Args:
        study: Of which tasks.
        archives: Folder with their archives.

    Raises:
        UnreadableFile: The archive of a task is missing, or is another file.
    """
    actors = (actor for actor in published().actors if actor.task in study.tasks)
    found = {archives / actor.file: actor for actor in actors}
    for path, actor in found.items():
        advice = "take it out of the wheel of causal-world 1.2; see docs/causal_world.md"
        try:
            content = path.read_bytes()
        except OSError as error:
            raise UnreadableFile(str(path), error.strerror or str(error), advice) from None
        if hashlib.sha256(content).hexdigest() != actor.sha256:
            raise UnreadableFile(str(path), "it is not the published archive", advice)
    return found


def evaluate_actor(actor: Actor, archive: Path, job: Job, progress: Progress) -> None:
    """Evaluate a published actor; what is finished is kept, and the rest left if time is over.

    Args:
        actor: Which one.
        archive: Of it.
        job: Says in which study and task, where, and until when.
        progress: Told how many episodes are done.
    """
    place = job.folder / ACTORS / actor.task
    with suppress(OutOfTime):
        evaluate_in(place, {"published actor": str(archive)}, job, progress, ENV)
