"""The command of laboratories: questions, runs of agents and of a person, and replays."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from scm_world.cli import console, options
from scm_world.errors import UnknownOption

Action = Literal["list", "question", "play", "run", "replay"]


def lab(
    action: Annotated[Action, typer.Argument(metavar="ACTION")],
    file: Annotated[str | None, typer.Argument(metavar="FILE")] = None,
    *,
    kind: str = "effect",
    world: str = "equations",
    seed: options.NotNegative = 0,
    level: str = "L2",
    agent: str = "random",
    key: options.Text = None,
    noise: options.Amount = 0.02,
    law: str = "plain",
    out: options.Text = None,
) -> None:
    """Ask certified causal questions: list them, show one, play it, run an agent, or replay a run.

    Example: scm-world lab run --kind effect --world springs --seed 3 --level L2 --agent random

    Args:
        action: list, question, play (type calls of tools), run (a scripted agent), or replay FILE.
        file: The run to replay, for replay alone.
        kind: Kind of the question; see lab list.
        world: World of the question, or a model file.
        level: Prior knowledge, L1 to L4.
        agent: A scripted agent, random or ideal.
        key: Secret of private questions.
        noise: Noise of readings, as a share of their spread.
        law: Law of springs and drag: plain, cubic, square or 'dead zone'.
        out: File of the run.
    """
    from scm_world import lab as room_of

    if (file is not None) != (action == "replay"):
        raise UnknownOption("FILE", file, ("a saved run, for replay",))
    if action == "list":
        rows = [
            {"kind": name, "worlds": ", ".join(room_of.offers(name)), "about": one.doc}
            for name, one in room_of.KINDS.items()
        ]
        console.frame(rows, title="questions; worlds are names or model files")
        return
    if file is not None:
        found = room_of.replay(file, key)
        typer.echo("\n".join(f"differs: {one}" for one in found) or "identical, to the last bit")
        if found:
            raise typer.Exit(1)
        return
    asked = room_of.question(kind, world, seed, level, key, noise=noise, law=law)
    if action == "question":
        described = {**asked.describe(), "certificate": asked.certificate}
        typer.echo(json.dumps(described, indent=1, ensure_ascii=False))
        return
    room = room_of.Laboratory(asked) if action == "play" else room_of.play(agent, asked)
    if action == "play":
        _play(room.call, lambda: room.finished)
    typer.echo(json.dumps(room.score))
    if out is not None and room.finished:
        console.say(f"written: {room.save(Path(out))}", stderr=True)


def _play(call: Callable[..., dict[str, Any]], finished: Callable[[], bool]) -> None:
    """Read calls of tools from the terminal until there is a submission, or the end of input."""
    typer.echo(json.dumps(call("describe"), indent=1, ensure_ascii=False))
    typer.echo('A call is a tool and its arguments as JSON: experiment {"do": {"x0": 1}, "n": 5}')
    while not finished():
        try:
            tool, _, text = input("> ").strip().partition(" ")
            said = call(tool, json.loads(text or "{}"))
        except EOFError:
            return
        except ValueError as error:
            said = {"refused": f"the arguments are not JSON: {error}"}
        typer.echo(json.dumps(said))
