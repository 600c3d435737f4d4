"""``scm-world effect`` and ``scm-world counterfactual``: what acting does, and would have done."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from scm_world.cli.assignments import parse_assignments
from scm_world.cli.console import RESULTS, check_writable, console, show, staged, table, written
from scm_world.cli.tasks import build, suffix, system, tag
from scm_world.errors import UnknownOption
from scm_world.output.locations import Location
from scm_world.policies.scripted import NAMED
from scm_world.queries import (
    SCM,
    Difference,
    Effect,
    Episode,
    Outcome,
    World,
    compare,
    save_episode,
)

POLICIES = (*NAMED, "still")
FORMAT = "scm_world/counterfactual/1"


@final
@dataclass(frozen=True)
class Circumstances:
    """Where a question is asked.

    Attributes:
        task: Name of the task.
        backend: Name of the engine.
        preset: Numerical settings.
        seed: Of the noise.
        steps: Control steps of an episode.
        policy: ``"random"``, ``"sweep"`` or ``"still"``.
        arguments: Of the task, each as ``name=value``.
    """

    task: str
    backend: str
    preset: str | None
    seed: int
    steps: int
    policy: str
    arguments: tuple[str, ...] = ()

    def world(self) -> World:
        """Make the world."""
        task = build(self.task, self.arguments)
        return World(task, backend=self.backend, preset=self.preset)

    def system(self) -> World | SCM:
        """Make the world, or the causal model without a backend."""
        task = system(self.task, self.arguments)
        if isinstance(task, SCM):
            return task
        return World(task, backend=self.backend, preset=self.preset)

    def __post_init__(self) -> None:
        if self.policy not in POLICIES:
            raise UnknownOption("policy", self.policy, POLICIES)

    @property
    def acts(self) -> str | None:
        """The policy, as the world takes it."""
        return None if self.policy == "still" else self.policy

    def folder(self, question: str) -> Path:
        """Name the folder of the results."""
        about = f"{self.backend}-seed{self.seed}{suffix(self.arguments)}"
        return RESULTS / f"{question}-{tag(self.task)}-{about}"


def read_outcome(text: str, how: str) -> Outcome:
    """Read the name of a variable, or of a component: ``name[2]``.

    Example:
        >>> read_outcome("gravity[2]", "final").component
        2
    """
    match = re.fullmatch(r"(.+)\[(\d+)\]", text)
    if match is None:
        return Outcome(text, how)
    return Outcome(match[1], how, int(match[2]))


def ask_effect(
    where: Circumstances,
    outcome: Outcome,
    assignments: Sequence[str],
    *,
    versus: Sequence[str],
    nature: Sequence[str],
    n: int,
    paired: bool,
    out: Location | None,
) -> int:
    """Estimate an effect, print it, write it; return the exit code."""
    folder = out or where.folder("effect")
    check_writable(folder, folder=True)
    do, other, varies = (parse_assignments(texts) for texts in (assignments, versus, nature))
    with where.system() as system, shown_episodes() as progress:
        is_static = isinstance(system, SCM) and not system.is_temporal
        effect = system.effect(
            outcome,
            do=do,
            versus=other,
            n=n,
            paired=paired,
            progress=progress,
            nature=varies,
            steps=0 if is_static else where.steps,
            seed=where.seed,
            policy=where.acts,
        )
    terminal = console()
    about = f"{tag(where.task)} on {effect.engine}, seed {where.seed}"
    terminal.print(_effect_table(effect, about))
    with staged(folder) as draft:
        (draft / "effect.json").write_text(effect.to_json() + "\n")
    written(terminal, folder / "effect.json")
    return 0


def _effect_table(effect: Effect, title: str) -> Any:
    made = table("", "mean", "95 % interval", title=f"{effect.outcome}, {title}")
    interval = f"{show(effect.low)} … {show(effect.high)}"
    made.add_row("effect", show(effect.mean), interval)
    made.add_row("with it", show(effect.treated), "")
    made.add_row("without", show(effect.control), "")
    made.add_row("episodes", str(effect.rollouts), "paired" if effect.paired else "unpaired")
    if effect.paired:
        made.add_row("variance unpaired : paired", show(effect.variance_ratio), "")
    return made


@contextmanager
def shown_episodes() -> Iterator[Callable[[int, int], None]]:
    """Show how far it is: a bar on a terminal, nothing elsewhere."""
    terminal = console(stderr=True)
    if not terminal.is_terminal:
        yield lambda done, planned: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = ("episodes", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=terminal, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, planned: bar.update(task, completed=done, total=planned)


def ask_counterfactual(
    where: Circumstances, assignments: Sequence[str], *, at: int, out: Location | None
) -> int:
    """Let an episode happen and happen otherwise, print and write both; return the exit code."""
    folder = out or where.folder("counterfactual")
    check_writable(folder, folder=True)
    request = parse_assignments(assignments)
    world = where.world()
    try:
        episode = world.rollout(where.acts, seed=where.seed, steps=where.steps)
        other = episode.counterfactual(request, at=at)
        apart = compare(episode, other)
        engine = world.backend.name
    finally:
        world.close()
    terminal = console()
    terminal.print(_difference_table(apart, where, at, engine))
    if apart.contacts:
        step, pair, which = apart.contacts[0]
        ours = "as it was" if which == 0 else "as it would have been"
        terminal.print(
            f"{len(apart.contacts)} contacts in one of the two only, first {pair[0]} and {pair[1]} "
            f"at {step}, {ours}"
        )
    names = ("episode.npz", "counterfactual.npz", "difference.json")
    with staged(folder) as draft:
        save_episode(episode, draft / names[0])
        save_episode(other, draft / names[1])
        text = json.dumps(_data(episode, apart, at), indent=1, allow_nan=False)
        (draft / names[2]).write_text(text + "\n")
    written(terminal, *(folder / name for name in names))
    return 0


def _difference_table(apart: Difference, where: Circumstances, at: int, engine: str) -> Any:
    title = f"{tag(where.task)} on {engine}, seed {where.seed}: otherwise from control step {at} on"
    made = table("variable", "differs from", "most, and when", "at the end", title=title)
    for name, found in apart.variables.items():
        most = f"{show(found.largest)} at {found.at}"
        made.add_row(name, str(found.first), most, show(np.abs(found.final).max(initial=0.0)))
    if not apart.variables:
        made.add_row("nothing", "", "", "")
    return made


def _data(episode: Episode, apart: Difference, at: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "at": at,
        "steps": episode.steps,
        "variables": {
            name: {"first": d.first, "largest": d.largest, "at": d.at, "final": d.final.tolist()}
            for name, d in apart.variables.items()
            if np.isfinite(d.largest)
        },
        "contacts_in_one_only": [
            {"step": step, "bodies": list(pair), "in": ("episode", "counterfactual")[which]}
            for step, pair, which in apart.contacts
        ],
        "noise_in_one_only": [
            {"variable": name, "in": ("episode", "counterfactual")[which]}
            for name, which in apart.noise
        ],
    }
