"""``scm-world evaluate --check`` and ``scm-world explain``: what is done with results."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import typer
from rich.text import Text

from scm_world.cli.console import console, keep_whole, show, table
from scm_world.cli.evaluation import policies_of
from scm_world.cli.questions import shown_episodes
from scm_world.errors import UnknownOption
from scm_world.evaluation import Causes, Evaluation, check, why
from scm_world.evaluation.files import false_scores
from scm_world.output.locations import Location

SHOWN = 8  # variables that are listed
NOTHING = "nothing is varied in it"


def _policy(text: str | None) -> Any:
    return None if text is None else policies_of(text)


def check_again(
    path: Location, episodes: int, policy: str | None, trusted: tuple[str, ...] = ()
) -> int:
    """Play a part of some results again; return the exit code."""
    _look_here(trusted, policy)
    results = Evaluation.load(path)
    false = false_scores(path, results)
    with shown_episodes() as progress:
        found = check(
            results, episodes=episodes, policy=_policy(policy), trusted=trusted, progress=progress
        )
    terminal = console()
    for line in (*false, *found.wrong):
        terminal.print(Text(line), soft_wrap=True)
    said = "the same bits in all of them" if found else f"{len(found.wrong)} differ"
    chosen = f"{found.episodes} of {len(results)} episodes, chosen with seed {found.seed}"
    terminal.print(f"played again: {chosen}: {said}", soft_wrap=True)
    return 0 if found and not false else 1


def _look_here(trusted: tuple[str, ...], policy: str | None) -> None:
    """Find modules of one's own beside where the command is called, if they are asked for."""
    if trusted or policy is not None:
        sys.path.insert(0, str(Path.cwd()))


@final
@dataclass(frozen=True)
class Where:
    """Which results are explained.

    Attributes:
        path: Folder or file.
        agent: Who acted, if there are several.
        engine: On which engine, if there are several.
        metric: Score that is explained.
        trusted: Packages whose functions may be policies.
    """

    path: Location
    agent: str | None
    engine: str | None
    metric: str
    trusted: tuple[str, ...] = ()


def _chosen(results: Evaluation, where: Where) -> tuple[str, str]:
    """Choose agent and engine.

    Raises:
        BadParameter: There are several, or none of the name; with the option that chooses.
    """
    found = []
    for name, option, given in (
        ("agent", "'--agent'", where.agent),
        ("engine", "'--backend'", where.engine),
    ):
        try:
            found.append(results.the(name, given))
        except UnknownOption as error:
            said = "choose one" if given is None else f"{given!r} is none"
            message = f"{said} of {', '.join(error.choices)}"
            raise typer.BadParameter(message, param_hint=option) from None
    return found[0], found[1]


def show_causes(where: Where, protocol: str | None) -> int:
    """Print for each protocol what its variables did to the score; return the exit code."""
    results = Evaluation.load(where.path)
    agent, engine = _chosen(results, where)
    terminal = console()
    for name in results.protocols if protocol is None else (protocol,):
        found = results.causes(name, where.metric, agent=agent, engine=engine)
        score = results.score(name, where.metric, agent=agent, engine=engine)
        title = f"{name}: {agent} on {engine}, {where.metric.replace('_', ' ')} {score}"
        if found.causes:
            terminal.print(keep_whole(_causes(found, title), terminal, 0))
        elif protocol is not None:
            terminal.print(Text(f"{title}\n{found if found.left_out else NOTHING}"), soft_wrap=True)
    return 0


def _causes(found: Causes, title: str) -> Any:
    made = table("variable", "share of variance", "p (Holm)", "upper - lower third", title=title)
    for cause in found.ranked()[:SHOWN]:
        column = cause.column
        of = "" if column.name == cause.variable else f" ({column.name})"
        contrast = Text(f"{column.contrast}{of}")
        made.add_row(cause.variable, Text(str(cause.share)), f"{cause.p_holm:.3g}", contrast)
    if len(found.causes) > SHOWN:
        made.add_row(f"and {len(found.causes) - SHOWN} more", "", "", "")
    return made


def show_otherwise(where: Where, protocol: str, episode: int, versus: str | None) -> int:
    """Print what an episode would have been; return the exit code."""
    _look_here(where.trusted, None)
    results = Evaluation.load(where.path)
    agent, engine = _chosen(results, where)
    with shown_episodes() as progress:
        found = why(
            results,
            protocol,
            episode,
            agent=agent,
            engine=engine,
            metric=where.metric,
            versus=versus,
            trusted=where.trusted,
            progress=progress,
        )
    title = f"{protocol}, episode {episode}: {where.metric.replace('_', ' ')} {found.score:.3g}"
    made = table("had it been", "instead of", "score", "success", title=title)
    for other in found.others:
        made.add_row(
            Text(f"{other.variable} = {show(other.would_be)}"),
            show(other.was),
            f"{other.would_score:.3g} ({other.gain:+.3g})",
            "yes" if other.would_succeed else "no",
        )
    for name, reason in found.left_out.items():
        made.add_row(Text(name), "", "left out", Text(reason))
    terminal = console()
    terminal.print(made)
    return 0
