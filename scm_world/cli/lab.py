"""The commands about laboratories for agents."""

from __future__ import annotations

import json
import secrets
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scm_world._arguments import load, one_of
from scm_world.cli import console, options

if TYPE_CHECKING:
    from scm_world.lab import Laboratory, Question


@dataclass
class QuestionOptions:
    """The options of a question.

    Args:
        kind: Kind of the question; see scm-world lab list.
        world: World of the question, or a model file.
        level: Prior knowledge, L1 to L4.
        noise: Noise of readings, as a share of their spread.
        law: Law of springs and drag: plain, cubic, square or 'dead zone'.
    """

    kind: str = "effect"
    world: str = "equations"
    seed: options.NotNegative = 0
    level: str = "L2"
    key: options.Key = None
    noise: options.Amount = 0.02
    law: str = "plain"

    def question(self) -> Question:
        """Return the question."""
        from scm_world.lab import question

        more = {"noise": self.noise, "law": self.law}
        return question(self.kind, self.world, self.seed, self.level, self.key, **more)


def list_() -> None:
    """List kinds of questions and their worlds.

    Example: scm-world lab list
    """
    from scm_world.lab import KINDS, offers

    rows = [
        {"kind": name, "worlds": ", ".join(offers(name)), "about": one.doc}
        for name, one in KINDS.items()
    ]
    console.frame(rows, title="questions; a model file is a world, too")


def question(asked: QuestionOptions) -> None:
    """Show a certified question, without its answer.

    Example: scm-world lab question --kind effect --world springs --seed 3 --level L2
    """
    made = asked.question()
    shown = {**made.describe(), "certificate": made.certificate}
    typer.echo(json.dumps(shown, indent=1, ensure_ascii=False))


def run(asked: QuestionOptions, *, agent: str = "random", out: options.Text = None) -> None:
    """Run a scripted agent on a question, and print its score.

    Example: scm-world lab run --kind effect --world springs --seed 3 --agent random

    Args:
        agent: random, one-at-a-time, pairs, do_order, information or ideal.
        out: File of the run, for scm-world lab replay.
    """
    from scm_world import lab

    _finish(lab.play(agent, asked.question()), out)


def play(
    asked: QuestionOptions,
    *,
    out: options.Text = None,
    page: bool = False,
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8730,
    open_: bool = False,
) -> None:
    """Answer a question by hand: type a tool and its arguments as JSON, or use a page.

    Example: scm-world lab play --kind effect --world springs --page --open

    Args:
        out: File of the run, for scm-world lab replay.
        page: Serve a page with a form for each tool, until Ctrl-C.
        port: Port of the page; 0 for any that is free.
        open_: Open the page in the usual browser.
    """
    from scm_world import lab

    if page:
        for package in ("starlette", "uvicorn"):
            load(package, package, "studio")
        from scm_world.studio.lab import serve as served

        room = lab.Laboratory(asked.question())
        served(room, port=port, open_=open_, say=console.say)
        _finish(room, out)
        return
    room = lab.Laboratory(asked.question())
    typer.echo(json.dumps(room.call("describe"), indent=1, ensure_ascii=False))
    typer.echo('Type for example: experiment {"do": {"x0": 1}, "n": 5}')
    while not room.finished:
        try:
            tool, _, text = input("> ").strip().partition(" ")
            said = room.call(tool, json.loads(text or "{}"))
        except EOFError:
            break
        except (ValueError, RecursionError) as error:
            said = {"refused": f"the arguments are not JSON: {error}"}
        typer.echo(json.dumps(said))
    _finish(room, out)


def _finish(room: Laboratory, out: str | None) -> None:
    typer.echo(json.dumps(room.score))
    if out is not None:
        console.say(f"written: {room.save(Path(out))}", stderr=True)


def replay(
    file: Annotated[str, typer.Argument(metavar="FILE")], *, key: options.Key = None
) -> None:
    """Repeat a saved run, and say what differs; the exit code is then 1.

    Example: scm-world lab replay run.json

    Args:
        file: The file that scm-world lab run wrote.
    """
    from scm_world import lab

    found = lab.replay(file, key)
    typer.echo("\n".join(f"differs: {one}" for one in found) or "identical, to the last bit")
    if found:
        raise typer.Exit(1)


def serve(
    kinds: Annotated[str, typer.Argument(metavar="KIND,...")],
    *,
    world: str = "equations",
    level: str = "L2",
    n: options.N = 1,
    seed: options.NotNegative = 0,
    key: options.Key = None,
    out: options.Text = None,
    mcp: bool = False,
    http: bool = False,
    host: str = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8710,
    token: Annotated[str | None, typer.Option(envvar="SCM_LAB_TOKEN")] = None,
) -> None:
    """Serve laboratories to agents over the Model Context Protocol (MCP).

    It serves on standard input and output, for a client that starts this command, or with --http
    on an address. Ctrl-C ends it.
    Example: scm-world lab serve effect,graph --world equations --n 3 --mcp

    Args:
        kinds: Kinds of questions, such as effect,graph.
        world: World of the questions.
        level: What agents know beforehand: L1, L2, L3 or L4.
        n: How many questions of each kind.
        seed: Seed of the first one; the others follow.
        out: Folder in which every call is recorded. With the same folder a new server continues
            unfinished runs.
        mcp: Serve the Model Context Protocol; there is no other one.
        http: Serve streamable HTTP on an address instead of standard input and output.
        host: Address to serve on; one that other machines reach has a token.
        port: Port to serve on; 0 for any that is free.
        token: Token that requests have to carry; a new one if it is left out and needed.
    """
    import asyncio  # slow to import

    from scm_world.lab import mcp as serving
    from scm_world.lab import offers

    one_of("--mcp", mcp, (True,))
    for kind in options.split(kinds):
        one_of("--world", world, offers(kind))
    asked = [
        {"kind": kind, "world": world, "seed": seed + i, "level": level}
        for kind in options.split(kinds)
        for i in range(n)
    ]
    rooms = serving.Laboratories(asked, key, out)
    if not http:
        with suppress(KeyboardInterrupt):
            asyncio.run(serving.stdio(rooms))
        return
    uvicorn = load("uvicorn", "mcp", "lab")
    from scm_world.studio.server import LOCAL, bind

    if host not in LOCAL and token is None:
        token = secrets.token_urlsafe(24)
        console.say(f"Authorization: Bearer {token}")
    config = uvicorn.Config(
        serving.http(rooms, token or ""), host=host, port=port, log_level="warning"
    )
    bound, address = bind(config)
    bound.listen()  # a client that connects at once waits until the server answers
    console.say(f"{address}/mcp")
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[bound])
