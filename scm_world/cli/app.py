"""The command line: its commands, and how their errors are printed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from scm_world.cli import console, suites
from scm_world.cli import lab as labs
from scm_world.cli.data import collect, discover, sweep, triplets, verify
from scm_world.cli.demo import demo
from scm_world.cli.options import command
from scm_world.cli.policies import clone, evaluate, explain, infer, train
from scm_world.cli.systems import (
    check,
    counterfactual,
    do,
    effect,
    fit,
    graph,
    list_,
    studio,
    variables,
)
from scm_world.errors import ScmWorldError


class CommandGroup(TyperGroup):
    """All commands: an error of this package becomes one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:  # the reader has seen enough
            raise
        except (ScmWorldError, OSError) as error:
            said, code = "\n".join((str(error), *getattr(error, "__notes__", ()))), 2
        except KeyboardInterrupt:
            said, code = "interrupted before there was a result", console.INTERRUPTED
        console.say(f"{typer.style('error:', bold=True, fg='red')} {said}", stderr=True)
        raise typer.Exit(code) from None


app = typer.Typer(
    cls=CommandGroup,
    name="scm-world",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
laboratories = typer.Typer(
    name="lab",
    no_args_is_help=True,
    help="Laboratories for agents: certified causal questions.\n\nExample: scm-world lab run",
)
app.add_typer(laboratories)
SUITE = "Benchmark suites: list them, make them anew, score answers. Example: scm-world suite list"
suite = typer.Typer(no_args_is_help=True)
app.add_typer(suite, name="suite", help=SUITE)


def _version(wanted: bool) -> None:
    if wanted:
        from scm_world import __version__

        typer.echo(f"scm-world {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """Structural causal models of physical systems: any MJCF or URDF model, or nine robot tasks.

    Example: scm-world discover pushing
    """


COMMANDS: tuple[Callable[..., None], ...] = (
    *(discover, verify, check, graph, variables, do, effect, counterfactual, fit),
    *(demo, collect, sweep, triplets, evaluate, explain, infer, train, clone, studio, list_),
)
GROUPS: Mapping[typer.Typer, tuple[Callable[..., None], ...]] = {
    app: COMMANDS,
    laboratories: (labs.list_, labs.question, labs.run, labs.play, labs.replay, labs.serve),
    suite: (suites.list_, suites.make, suites.score),
}
for _group, _functions in GROUPS.items():
    for _function in _functions:
        _command = command(_function)
        _group.command(_function.__name__.rstrip("_"), help=_command.__doc__)(_command)
