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
from scm_world.output.durable import write_durably
from scm_world.output.reading import read_arrays
from scm_world.policies.scripted import Sequence as Given
from scm_world.queries.episodes import Episode
from scm_world.queries.experiments.versions import versions
from scm_world.queries.plans import Plan, Schedule
from scm_world.queries.rollouts import Trace, Unit
from scm_world.queries.twins import AnyTwins, EquationTwins, Twins, twins_of
from scm_world.tasks import ModelTask, Task, make_task, tasks
from scm_world.variables import Subset
from scm_world.world import Simulation

FORMAT = "scm_world/episode/2"
_ADVICE = "give a file that save_episode wrote"
KEYS = {
    "fingerprint",
    "task",
    "arguments",
    "options",
    "seed",
    "number",
    "steps",
    "layers",
    "versions",
    "parameters",
}


def save_episode(episode: Episode, path: Path | str) -> Path:
    """Write an episode to one file: a zip archive of numpy arrays and a JSON text.

    It holds task and options, or a causal model without a backend as JSON; seed, plans, actions,
    versions; and all states, with which a rerun is compared on reading. Nothing in it is a pickle.

    Args:
        episode: What happened.
        path: Of the file; it gets the ending ``.npz`` if it has another one.

    Raises:
        ModelError: A plan has a function without a name, or a registered task arguments that are
            no numbers and texts. Other tasks, and models with functions without a name, are passed
            to ``load_episode``.
        UnwritableFolder: There is no such folder, no room, or no permission.
    """
    trace, target = episode.trace, Path(path)
    if target.suffix != ".npz":
        target = target.with_name(target.name + ".npz")
    made = io.BytesIO()
    np.savez_compressed(
        made,
        about=np.array(json.dumps(_about(episode))),
        actions=episode.actions,
        states=np.concatenate(trace.vectors),
        lengths=np.array([len(vector) for vector in trace.vectors]),
    )
    write_durably(target, made.getvalue())
    return target


def _about(episode: Episode) -> dict[str, Any]:
    return {
        "format": FORMAT,
        **(_equations if isinstance(episode.twins, EquationTwins) else _world)(episode.twins),
        "seed": episode.seed,
        "number": episode.number,
        "steps": episode.steps,
        "layers": [[start, plan.as_dict()] for start, plan in episode.layers],
        "parameters": _digest(episode.trace),
    }


def _world(twins: Twins) -> dict[str, Any]:
    task, options = twins.task, dict(twins.options)
    if isinstance(options.get("variables_space"), Subset):
        options["variables_space"] = options["variables_space"].model_dump(mode="json")
    with twins.twin() as world:
        engine = world.engine
        system = fingerprint(world, libraries=False)
    return {
        "fingerprint": system,
        "task": task.name,
        "arguments": _arguments(task),
        "options": options,
        "versions": versions(engine),
    }


def _equations(twins: EquationTwins) -> dict[str, Any]:
    return {
        "fingerprint": fingerprint(twins.layout.model, libraries=False),
        "task": None,
        "arguments": None,
        "equations": _written(twins.layout.model),
        "options": {},
        "versions": versions(),
    }


def _written(model: SCM) -> dict[str, Any] | None:
    """Return a model as plain data; None if it has a function without a name."""
    try:
        return to_dict(model)
    except ModelError:
        return None


def _arguments(task: Task) -> dict[str, Any] | None:
    """Write down what a task was made with; None where it can only be given again as a world.

    Raises:
        ModelError: It is a registered task, and what it was made with cannot be written.
    """
    registered = task.name in tasks()
    problem = f"give the arguments of {task.name!r} by name, so that they can be saved"
    if task.is_named:
        try:
            found: dict[str, Any] = json.loads(json.dumps(_plain(task.given), allow_nan=False))
            return found
        except (TypeError, ValueError) as error:
            problem = f"an argument of {task.name!r} cannot be written: {error}"
    if registered:
        raise ModelError([problem])
    return None


def _digest(trace: Trace) -> str:
    """Sum up all values of parameters, at all times."""
    found = hashlib.sha256()
    last: dict[str, Any] = {}
    for step, values in trace.statics:
        if last.keys() == values.keys() and all(np.array_equal(last[n], values[n]) for n in last):
            continue
        last = values
        found.update(str(step).encode())
        for name in sorted(values):
            found.update(name.encode() + np.asarray(values[name]).tobytes())
    return found.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


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
    about, actions, states, lengths = _read(file)
    try:
        twins = _twins(about, world, file, trusted)
        schedule = Schedule(
            (int(start), Plan.from_dict(plan, trusted=trusted)) for start, plan in about["layers"]
        )
        unit = Unit(about["seed"], about["number"], schedule, Given(list(actions)), about["steps"])
        with twins.twin() as twin:
            trace = unit.run(twin)
    except DAMAGED as error:
        if isinstance(error, ScmWorldError):
            raise
        raise UnreadableFile(str(file), in_one_line(error), _ADVICE) from error
    if _digest(trace) != about["parameters"]:
        raise SnapshotMismatch(f"{file} happens with other parameters than it did")
    _compare(trace, np.split(states, np.cumsum(lengths)[:-1]), file, about["versions"])
    return Episode(twins, unit, trace)


def _read(file: Path) -> tuple[dict[str, Any], Any, Any, Any]:
    try:
        arrays = read_arrays(file)
        about = json.loads(str(arrays["about"]))
        found = arrays["actions"], arrays["states"], arrays["lengths"]
    except DAMAGED as error:
        raise UnreadableFile(str(file), str(error), _ADVICE) from None
    if not isinstance(about, dict) or about.get("format") != FORMAT or not about.keys() >= KEYS:
        raise UnreadableFile(str(file), "it is no episode", _ADVICE)
    actions, states, lengths = found
    steps = about["steps"]
    whole = isinstance(steps, int) and not isinstance(steps, bool) and steps >= 0
    if not (whole and lengths.shape == (steps + 1,) and states.shape == (int(lengths.sum()),)):
        reason = f"it says {steps!r} control steps, and holds states of {len(lengths) - 1}"
        raise UnreadableFile(str(file), reason, _ADVICE)
    if actions.ndim != 2 or len(actions) != steps:
        reason = f"it says {steps} control steps, and holds actions of shape {actions.shape}"
        raise UnreadableFile(str(file), reason, _ADVICE)
    return about, *found


def _twins(
    about: dict[str, Any], world: Simulation | SCM | None, file: Path, trusted: Sequence[str]
) -> AnyTwins:
    """Return where the episode is run again.

    Raises:
        SnapshotMismatch: The world or model that is given is another one.
    """
    if "equations" in about:
        written = about["equations"]
        if world is None and written is None:
            problem = f"{file} holds no model, since a function of it has no name"
            raise ModelError([f"{problem}; pass it: load_episode(path, world=model)"])
        system: Any = from_dict(written, trusted=trusted) if world is None else world
        is_kind = isinstance(system, SCM)
    else:
        system = _made(about) if world is None else world
        is_kind = isinstance(system, Simulation)
    now = fingerprint(system, libraries=False) if is_kind else {}
    changed = differing(about["fingerprint"], now) if is_kind else ["kinds of system"]
    if changed:
        problem = f"{file} happened in another system, or one that was changed since"
        raise SnapshotMismatch(f"{problem}: {', '.join(changed)} differ")
    if isinstance(system, SCM):
        return EquationTwins(system)
    return twins_of(world) if isinstance(world, Simulation) else Twins(system)


def _made(about: dict[str, Any]) -> Simulation:
    given = about["arguments"] or {}
    if about["task"] in tasks():
        task = make_task(about["task"], **given)
    elif "model" in given:
        task = ModelTask(**given)
    else:
        raise UnknownOption("task", about["task"], (*tasks(), "any, with world=World(your task)"))
    return Simulation(task, **about["options"])


def _compare(trace: Trace, states: list[Any], file: Path, made: dict[str, str]) -> None:
    for step, (now, then) in enumerate(zip(trace.vectors, states, strict=True)):
        if now.tobytes() != then.tobytes():
            raise SnapshotMismatch(
                f"{file} happens otherwise from control step {step} on; it was made with "
                + ", ".join(f"{name} {version}" for name, version in made.items())
            )
