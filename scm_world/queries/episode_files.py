"""Episodes in files: everything that it takes to run them again bit-identically."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scm_world._fingerprint import differing, fingerprint
from scm_world.errors import (
    DAMAGED,
    ModelError,
    ScmWorldError,
    SnapshotMismatch,
    UnknownOption,
    UnreadableFile,
    in_one_line,
)
from scm_world.graph import SCM, from_dict, to_dict
from scm_world.policies.scripted import Sequence as Given
from scm_world.queries.episodes import Episode, Unit
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan
from scm_world.queries.twins import Twins, asked
from scm_world.runs.files import read_arrays, write_whole
from scm_world.tasks import ModelTask, Task, make_task, tasks
from scm_world.variables import Subset
from scm_world.world import Simulation

FORMAT = "scm_world/episode/4"
_ADVICE = "give a file that save_episode wrote"


def save_episode(episode: Episode, path: Path | str) -> Path:
    """Write an episode to one file: a zip archive of numpy arrays and a JSON text.

    It holds task and options, or a causal model without a backend as JSON; seed, plans, actions,
    versions; and a hash of each instant, with which a rerun is compared on reading. Nothing in it
    is a pickle.

    Args:
        episode: What happened.
        path: Of the file; it gets the ending ``.npz`` if it has another one.

    Raises:
        ModelError: A plan has a function without a name, or a registered task arguments that are
            no numbers and texts. Other tasks, and models with functions without a name, are passed
            to ``load_episode``.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    if not isinstance(episode, Episode):
        raise UnknownOption("episode", episode, ("an episode of rollout or live",))
    episode, target = episode.episode(), Path(path)
    if target.suffix != ".npz":
        target = target.with_name(target.name + ".npz")
    made = io.BytesIO()
    np.savez_compressed(made, about=np.array(json.dumps(_about(episode))), actions=episode.actions)
    write_whole(target, made.getvalue())
    return target


def _about(episode: Episode) -> dict[str, Any]:
    with episode.twins.twin() as twin:
        is_world = isinstance(twin, Simulation)
        return {
            "format": FORMAT,
            "fingerprint": fingerprint(twin if is_world else twin.model, libraries=False),
            **(_world(episode.twins) if is_world else {"equations": _written(twin.model)}),
            "seed": episode.seed,
            "number": episode.number,
            "plan": episode.plan.as_dict(),
            "instants": _hashes(episode),
            "versions": versions(twin.engine if is_world else ""),
        }


def _world(twins: Twins) -> dict[str, Any]:
    task, options = twins.task, dict(twins.options)
    if isinstance(options.get("variables_space"), Subset):
        options["variables_space"] = options["variables_space"].model_dump(mode="json")
    return {"task": task.name, "arguments": _arguments(task), "options": options}


def _written(model: SCM) -> dict[str, Any] | None:
    """Return a model as plain data; None if it has a function without a name."""
    try:
        return to_dict(model)
    except ModelError:
        return None


def _arguments(task: Task) -> dict[str, Any] | None:
    """Write down what a task was made with; None where it can only be given again as a world."""
    registered = task.name in tasks()
    problem = f"give the arguments of {task.name!r} by name, so that they can be saved"
    if task.is_named:
        try:
            written = json.dumps(task.given, allow_nan=False, default=lambda value: value.tolist())
            found: dict[str, Any] = json.loads(written)
            return found
        except (TypeError, ValueError, AttributeError) as error:
            problem = f"an argument of {task.name!r} cannot be written: {error}"
    if registered:
        raise ModelError([problem])
    return None


def _hashes(episode: Episode) -> list[str]:
    """Sum up the state of each instant, and the parameters that are others than before."""
    statics, last, found = dict(episode.statics), dict[str, Any](), list[str]()
    for step, vector in enumerate(episode.vectors):
        mark = hashlib.blake2b(vector.tobytes(), digest_size=8)
        now = statics.get(step, last)
        for name in sorted(now):
            if name not in last or not np.array_equal(last[name], now[name]):
                mark.update(name.encode() + np.asarray(now[name]).tobytes())
        last = now
        found.append(mark.hexdigest())
    return found


def load_episode(
    path: Path | str, *, world: Simulation | SCM | None = None, trusted: Sequence[str] = ()
) -> Episode:
    """Read an episode and run it again.

    Args:
        path: Of the file.
        world: The world or causal model of the episode, for a task that is not registered, a
            physics model that was passed as an object, or spaces or functions without a name; made
            from the file if None.
        trusted: Packages whose functions may be mechanisms of its model and its plans.

    Raises:
        UnreadableFile: It is no episode.
        UnknownOption: Its task is not registered, and no world is given.
        ModelError: Its causal model has functions without a name, and none is given; or a
            mechanism is a function of no trusted package.
        SnapshotMismatch: The rerun is not bit-identical: another version or model, say.
    """
    file = Path(path)
    try:
        arrays = read_arrays(file)
        about, actions = json.loads(str(arrays["about"])), arrays["actions"]
        if about["format"] != FORMAT:
            raise UnreadableFile(str(file), f"its format is {about['format']!r}", _ADVICE)
        twins = _twins(about, world, file, trusted)
        plan = Plan.from_dict(about["plan"], trusted=trusted)
        given = Given(list(actions))
        unit = Unit(about["seed"], about["number"], plan, given, len(actions))
        with twins.twin() as twin:
            episode = unit.run(twin, twins)
        pairs = enumerate(zip(_hashes(episode), about["instants"], strict=True))
        other = next((step for step, (now, then) in pairs if now != then), None)
        made = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    except DAMAGED as error:
        if isinstance(error, ScmWorldError):
            raise
        raise UnreadableFile(str(file), in_one_line(error), _ADVICE) from error
    if other is not None:
        said = f"{file} happens otherwise from control step {other} on; it was made with {made}"
        raise SnapshotMismatch(said)
    return episode


def _twins(
    about: dict[str, Any], world: Simulation | SCM | None, file: Path, trusted: Sequence[str]
) -> Twins:
    """Return where the episode is run again; refuse a world or a model that is another one."""
    kind, system = (SCM, world) if "equations" in about else (Simulation, world)
    if world is None and kind is Simulation:
        system = _made(about)
    elif world is None:
        if about["equations"] is None:
            problem = f"{file} holds no model, since a function of it has no name"
            raise ModelError([f"{problem}; pass it: load_episode(path, world=model)"])
        system = from_dict(about["equations"], trusted=trusted)
    changed = ["kinds of system"]
    if isinstance(system, kind):
        changed = differing(about["fingerprint"], fingerprint(system, libraries=False))
    if changed:
        problem = f"{file} happened in another system, or one that was changed since"
        raise SnapshotMismatch(f"{problem}: {', '.join(changed)} differ")
    return asked(system)[0]


def _made(about: dict[str, Any]) -> Simulation:
    given = about["arguments"] or {}
    if about["task"] in tasks():
        task = make_task(about["task"], **given)
    elif "model" in given:
        task = ModelTask(**given)
    else:
        raise UnknownOption("task", about["task"], (*tasks(), "any, with world=World(your task)"))
    return Simulation(task, **about["options"])
