"""Files of episodes, with everything that a bit-identical rerun needs."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scm_world._arguments import typed
from scm_world._fingerprint import differing, fingerprint
from scm_world.errors import (
    ModelError,
    ScmWorldError,
    SnapshotMismatch,
    UnknownOption,
    UnreadableFile,
    in_one_line,
)
from scm_world.graph import SCM, from_json, to_json
from scm_world.policies.scripted import Sequence as Given
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.equations import as_given
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan
from scm_world.queries.twins import asked
from scm_world.runs.files import Location, located, read_arrays, write_whole
from scm_world.tasks import ModelTask, make_task, tasks
from scm_world.variables import Subset
from scm_world.world import CausalSystem, Simulation

FORMAT = "scm_world/episode/4"
_ADVICE = "give a file that save_episode wrote"


@typed
def save_episode(episode: Episode, path: Location | str) -> Location:
    """Write an episode to one file: a zip archive of numpy arrays and a JSON text.

    It contains task and options, or a causal model without a backend as JSON; seed, plans, actions
    and versions; and a hash of each instant, with which a rerun is compared on reading. It contains
    no pickle.

    Args:
        episode: The episode.
        path: Path or URL of the file; the suffix ``.npz`` is added if it has another one.

    Raises:
        ModelError: A plan has a function without a name, or a registered task has arguments
            other than numbers and texts. Other tasks, and models with unnamed functions, are
            passed to ``load_episode``.
        UnwritableFolder: The folder does not exist, is full, or cannot be written to.
    """
    if not isinstance(episode, Episode):
        raise UnknownOption("episode", episode, ("an episode of rollout or live",))
    episode, target = episode.episode(), located(path)
    if target.suffix != ".npz":
        target = target.with_name(target.name + ".npz")
    with episode.twins.twin() as twin:
        system: Any = twin.model if twin.backend is None else twin
        about = {
            "format": FORMAT,
            "fingerprint": fingerprint(system, libraries=False),
            **_written(system),
            "seed": episode.seed,
            "number": episode.number,
            "plan": episode.plan.as_dict(),
            "instants": _hashes(episode),
            "versions": versions(getattr(system, "engine", "")),
        }
    archive = io.BytesIO()
    np.savez_compressed(archive, about=np.array(json.dumps(about)), actions=episode.actions)
    write_whole(target, archive.getvalue())
    return target


def _written(system: Simulation | SCM) -> dict[str, Any]:
    """Return a system as plain data, with None for objects that cannot be written."""
    if isinstance(system, SCM):
        try:
            return {"equations": json.loads(to_json(system))}
        except ModelError:
            return {"equations": None}
    task, options, arguments = system.structures.task, system.made_with, None
    if isinstance(options.get("variables_space"), Subset):
        options["variables_space"] = options["variables_space"].model_dump(mode="json")
    problem = f"give the arguments of {task.name!r} by name, so that they can be saved"
    if task.is_named:
        try:
            text = json.dumps(task.given, allow_nan=False, default=lambda value: value.tolist())
            arguments = json.loads(text)
        except (TypeError, ValueError, AttributeError) as error:
            problem = f"an argument of {task.name!r} cannot be written: {error}"
    if arguments is None and task.name in tasks():
        raise ModelError([problem])
    return {"task": task.name, "arguments": arguments, "options": options}


def _hashes(episode: Episode) -> list[str]:
    """Return a hash of the state and the changed parameters of each instant."""
    statics = {era.step: era.statics for era in episode.eras}
    last, found = dict[str, Any](), list[str]()
    for step, vector in enumerate(episode.vectors):
        mark = hashlib.blake2b(vector.tobytes(), digest_size=8)
        now = statics.get(step, last)
        for name in sorted(now):
            if name not in last or not np.array_equal(last[name], now[name]):
                mark.update(name.encode() + np.asarray(now[name]).tobytes())
        last = now
        found.append(mark.hexdigest())
    return found


@typed
def load_episode(
    path: Path | str, *, world: CausalSystem | SCM | None = None, trusted: Sequence[str] = ()
) -> Episode:
    """Read an episode and run it again.

    Args:
        path: Path of the file.
        world: The world or causal model of the episode, for a task that is not registered, a
            physics model that was passed as an object, or spaces or functions without a name; built
            from the file if None.
        trusted: Packages whose functions may be mechanisms of its model and its plans.

    Raises:
        UnreadableFile: The file does not contain an episode.
        UnknownOption: Its task is not registered, and no world is given.
        ModelError: Its causal model has functions without a name, and none is given; or a
            mechanism is a function of no trusted package.
        SnapshotMismatch: The rerun is not bit-identical, for instance with another version.
        InexactEngine: Equal runs differ on its engine.
    """
    file = Path(path)
    try:
        arrays = read_arrays(file)
        about, actions = json.loads(str(arrays["about"])), arrays["actions"]
        if about["format"] != FORMAT:
            raise UnreadableFile(str(file), f"its format is {about['format']!r}", _ADVICE)
        system = as_given(_read(about, trusted) if world is None else world)
        changed = ["kinds of system"]
        if isinstance(system, SCM) == ("equations" in about):
            changed = differing(about["fingerprint"], fingerprint(system, libraries=False))
        if changed:
            problem = f"{file} is an episode of another system, or of one that was changed since"
            raise SnapshotMismatch(f"{problem}: {', '.join(changed)} differ")
        twins, plan = asked(system)[0], Plan.from_dict(about["plan"], trusted=trusted)
        twins.require_exact("the rerun of a file")
        given = Given(list(actions))
        episode = twins.episode(Unit(about["seed"], about["number"], plan, given, len(actions)))
        pairs = enumerate(zip(_hashes(episode), about["instants"], strict=True))
        other = next((step for step, (now, then) in pairs if now != then), None)
        recorded = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    except Exception as error:
        if isinstance(error, ScmWorldError):
            raise
        raise UnreadableFile(str(file), in_one_line(error), _ADVICE) from error
    if other is not None:
        text = f"the rerun of {file} differs from control step {other} on; it was recorded with"
        raise SnapshotMismatch(f"{text} {recorded}")
    return episode


def _read(about: dict[str, Any], trusted: Sequence[str]) -> Simulation | SCM:
    """Build the system of an episode from its file."""
    if "equations" in about:
        if about["equations"] is None:
            remedy = "pass the model: load_episode(path, world=model)"
            raise ModelError(
                [f"the file holds no model, which has a function without a name; {remedy}"]
            )
        return from_json(json.dumps(about["equations"]), trusted=trusted)
    given = about["arguments"] or {}
    if about["task"] in tasks():
        return Simulation(make_task(about["task"], **given), **about["options"])
    if "model" in given:
        return Simulation(ModelTask(**given), **about["options"])
    raise UnknownOption("task", about["task"], (*tasks(), "any, with world=World(your task)"))
