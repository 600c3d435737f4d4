"""Where the numbers of each round of a training go: a callback, and trackers of experiments."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from scm_world._arguments import one_of
from scm_world.errors import MissingExtra, UnknownOption
from scm_world.runs.files import is_there, read_text, write_whole

Log = Callable[[dict[str, Any], int], Any]
"""Takes the numbers of a round by name, such as ``rollout/ep_rew_mean``, and the control steps."""

TRACKERS = ("trackio", "wandb")
LOGS = ("csv", "tensorboard", *TRACKERS)

PROJECT = "scm-world"
"""The project of the trackers, in which each training is a run."""


def log_names(log: str | Sequence[str] | None, algo: str) -> tuple[str, ...]:
    """Check the names of logs; None stands for those that the library of an algorithm writes.

    Raises:
        UnknownOption: There is no such log, or not for this algorithm.
        MissingExtra: The tracker is not installed.
    """
    is_rsl = algo == "rsl_ppo"
    if log is None:
        return ("csv",) if is_rsl else ("csv", "tensorboard")
    names = tuple(log.split(",") if isinstance(log, str) else log)
    known = tuple(name for name in LOGS if not (is_rsl and name == "tensorboard"))
    for name in names:
        one_of(f"log of {algo}", name, known)
        _tracker(name) if name in TRACKERS else None
    return names


@contextmanager
def opened_log(
    names: Sequence[str],
    folder: Path,
    config: Mapping[str, Any],
    callback: Callable[[dict[str, Any]], Any] | None,
) -> Iterator[Log]:
    """Yield what passes numbers on to trackers and to a callback; a resumed run goes on there."""
    sinks: list[Log] = []
    with ExitStack() as stack:
        for name in (name for name in TRACKERS if name in names):
            tracker, path = _tracker(name), folder / "tracked.txt"
            if not is_there(path):
                write_whole(path, f"{folder.resolve().name}-{secrets.token_hex(4)}")
            run = read_text(path)
            more = {"id": run} if name == "wandb" else {}
            tracker.init(project=PROJECT, name=run, config=dict(config), resume="allow", **more)
            stack.callback(tracker.finish)
            sinks.append(partial(_track, tracker))
        if callback is not None:
            sinks.append(lambda numbers, _: callback(numbers))

        def log(numbers: dict[str, Any], step: int) -> None:
            for sink in sinks:
                sink(dict(numbers), step)

        yield log


def _track(tracker: Any, numbers: dict[str, Any], step: int) -> None:
    tracker.log(numbers, step=step)


def _tracker(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise MissingExtra(name) from None


def check_callback(callback: object, algo: str) -> None:
    """Refuse a callback that is neither a function nor, of Stable-Baselines3, one of its own."""
    own = hasattr(callback, "on_rollout_start") and algo != "rsl_ppo"
    if not (callback is None or own or callable(callback)):
        allowed = ["a function of the numbers of a round, by name"]
        allowed += ["a BaseCallback of Stable-Baselines3"] if algo != "rsl_ppo" else []
        raise UnknownOption("callback", callback, allowed)
