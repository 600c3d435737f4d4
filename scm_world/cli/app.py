"""The commands and their options. What they do is loaded when they are called."""

from __future__ import annotations

import contextlib
import re
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from scm_world.cli.clone import clone
from scm_world.cli.evaluate import evaluate, explain
from scm_world.cli.options import (
    Acts,
    Arguments,
    Format,
    Out,
    Policy,
    Preset,
    Resolution,
    Seed,
    Steps,
    Task,
    TaskBackend,
)
from scm_world.cli.planning import plan
from scm_world.cli.sampling import collect, sweep
from scm_world.cli.train import train
from scm_world.cli.working import Address, Engine, Work, Workers
from scm_world.errors import ScmWorldError


class Commands(TyperGroup):
    """All commands: what this package raises on purpose becomes one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        from scm_world.cli.console import fail

        try:
            return super().invoke(ctx)
        except ScmWorldError as error:
            fail("\n".join((str(error), *getattr(error, "__notes__", ()))))
            raise typer.Exit(2) from None
        except BrokenPipeError:  # the reader has seen enough
            raise
        except OSError as error:
            fail(str(error))
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            fail("interrupted before there was a result")
            raise typer.Exit(130) from None


app = typer.Typer(
    cls=Commands,
    name="scm-world",
    help="Structural causal models of physical systems: any MJCF or URDF model, or nine tasks "
    "of a block-building robot.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


def is_scm(subject: str) -> bool:
    """Tell a family with a size (er2:20), or the file of an SCM, from a world."""
    return re.search(r":\d+$", subject) is not None or subject.endswith(".json")


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
    """Structural causal models of physical systems."""


@app.command()
def discover(
    task: Annotated[
        str,
        typer.Argument(
            metavar="SYSTEM",
            help="A task, a model.xml or model.urdf, or module:function; with --learner also a "
            "family with a size (er2:20, sf2:50, tanh4:100), "
            "the JSON file of an SCM, or several with commas between them.",
        ),
    ],
    backend: TaskBackend = None,
    probes: Annotated[int, typer.Option(min=1, help="How many states to experiment in.")] = 32,
    seed: Seed = 0,
    preset: Preset = None,
    out: Out = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit 1 if the SHD is not 0.")] = False,
    option: Arguments = None,
    resolution: Resolution = None,
    learner: Annotated[
        str | None,
        typer.Option(help="Benchmark these, with commas between them; see 'scm-world list'."),
    ] = None,
    data: Annotated[
        str | None,
        typer.Option(
            help="observational, interventional, paired, with commas; by default what each "
            "learner can use best."
        ),
    ] = None,
    budget: Annotated[
        str,
        typer.Option(help="Rows, episodes or experiments; N also runs N/8, N/4, N/2; or a,b,c."),
    ] = "1000",
    seeds: Annotated[int, typer.Option(min=1, help="How many, from 0 on.")] = 3,
    view: Annotated[
        str, typer.Option(help="Of a task: outcome (of episodes) or step (control steps).")
    ] = "outcome",
    cause: Annotated[
        list[str] | None, typer.Option(help="Pattern of what varies; repeat it for more.")
    ] = None,
    outcome: Annotated[
        list[str] | None, typer.Option(help="Variable that is measured; repeat it for more.")
    ] = None,
    policy: Annotated[
        str,
        typer.Option(
            help="random, sweep, across, grasp, still; sweep or, by step, random if usual."
        ),
    ] = "usual",
    steps: Steps = 25,
    sensor_noise: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation, in halves of a range.")
    ] = 0.005,
    timeout: Annotated[float, typer.Option(min=0.0, help="Of a run [s]; 0 for no limit.")] = 300.0,
    workers: Workers = None,
    engine: Engine = None,
    address: Address = None,
) -> None:
    """Recover a causal graph by experiments, and score it; or benchmark learners.

    Without --learner the one-step graph of a task is recovered by paired experiments. With it, and
    for SCMs, learners are run over budgets and seeds, and a table, a picture and a report are
    written, on any --engine. After an interruption the same command resumes. Ctrl-C gives the
    result so far (exit code 130).
    """
    if learner is None and not is_scm(task):
        from scm_world.cli.discovery import Options, run
        from scm_world.cli.tasks import backend_of

        Work(engine, workers, address).refuse_others("discover without --learner")
        used = backend_of(backend, task, option)
        options = Options(task, used, preset, probes, seed, tuple(option or ()), resolution)
        raise typer.Exit(run(options, out=out, strict=strict))
    from scm_world.cli import benchmark
    from scm_world.discovery.problems import TaskView

    chosen = TaskView(
        view=view,
        causes=tuple(cause) if cause else None,
        outcomes=tuple(outcome) if outcome else None,
        policy=policy,
        steps=steps,
        sensor_noise=sensor_noise,
        options={"backend": backend or "mujoco", **({"preset": preset} if preset else {})},
    )
    code = benchmark.run(
        task,
        learner or "paired",
        data,
        budget,
        seeds,
        chosen,
        timeout,
        Work(engine, workers, address),
        tuple(option or ()),
        out,
    )
    raise typer.Exit(code)


for _command in (evaluate, explain, collect, sweep, plan, train, clone):
    app.command()(_command)


@app.command()
def verify(
    task: Annotated[
        str, typer.Argument(help="A task, a model.xml or .urdf, module:function, or 'all'.")
    ],
    backend: TaskBackend = None,
    both: Annotated[bool, typer.Option("--both", help="On MuJoCo and Bullet; compare.")] = False,
    probes: Annotated[int, typer.Option(min=1, help="How many states to try at most.")] = 200,
    seed: Seed = 0,
    preset: Preset = None,
    out: Out = None,
    option: Arguments = None,
    resolution: Resolution = None,
) -> None:
    """Check the declared causal graph of a task against its physics.

    Exits 1 unless every declared edge is seen and nothing else. 'all' takes small variants of
    tasks with many blocks. Ctrl-C gives the result so far (exit code 130).
    """
    from scm_world.cli.tasks import backend_of
    from scm_world.cli.verification import Options, run

    arguments = tuple(option or ())
    used = backend_of(backend, task, option)
    options = Options(task, used, both, preset, probes, seed, arguments, resolution)
    raise typer.Exit(run(options, out=out))


@app.command()
def graph(
    task: Task,
    format_: Annotated[Format, typer.Option("--format", help="How to write it.")] = Format.TABLE,
    out: Annotated[Path | None, typer.Option(help="File to write to.")] = None,
    action_mode: Annotated[
        str | None,
        typer.Option(
            help="Of the robot: joint_positions, joint_torques or end_effector_positions.",
            show_default="joint_positions",
        ),
    ] = None,
    option: Arguments = None,
    resolution: Resolution = None,
) -> None:
    """Show the declared causal graph of a task."""
    from scm_world.cli.graphs import run

    run(task, format_.value, out, action_mode, option or (), resolution)


@app.command()
def do(
    task: Task,
    assignments: Acts,
    backend: TaskBackend = None,
    steps: Annotated[int, typer.Option(min=0, help="Control steps to run afterwards.")] = 25,
    seed: Seed = 0,
    preset: Preset = None,
    space: Annotated[
        str | None, typer.Option(help="Refuse values outside this space: A, B or 'A|B'.")
    ] = None,
    show_all: Annotated[
        bool, typer.Option("--all", help="Show descendants that did not move, too.")
    ] = False,
    out: Out = None,
    option: Arguments = None,
) -> None:
    """Intervene on a task and show what followed, beside the same world left alone."""
    from scm_world.cli.intervene import Options, run
    from scm_world.cli.tasks import backend_of

    used = backend_of(backend, task, option)
    options = Options(task, used, preset, seed, steps, space, tuple(option or ()))
    raise typer.Exit(run(assignments, options, show_all=show_all, out=out))


@app.command()
def effect(
    task: Task,
    outcome: Annotated[str, typer.Argument(help="Name of a variable, or of a component: name[2].")],
    assignments: Acts,
    versus: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What it is held against; nothing by default."),
    ] = None,
    nature: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What varies by itself, such as NAME=draw:A."),
    ] = None,
    how: Annotated[
        str, typer.Option(help="final, change, mean, max, min, sum or first.")
    ] = "final",
    n: Annotated[int, typer.Option("-n", min=2, help="How many units.")] = 100,
    unpaired: Annotated[bool, typer.Option("--unpaired", help="Compare different units.")] = False,
    steps: Steps = 25,
    policy: Policy = "random",
    backend: TaskBackend = None,
    seed: Seed = 0,
    preset: Preset = None,
    out: Out = None,
    option: Arguments = None,
) -> None:
    """Estimate how much an intervention changes an outcome, with a 95 % interval."""
    from scm_world.cli.questions import Circumstances, ask_effect, read_outcome
    from scm_world.cli.tasks import backend_of

    used = backend_of(backend, task, option)
    where = Circumstances(task, used, preset, seed, steps, policy, tuple(option or ()))
    code = ask_effect(
        where,
        read_outcome(outcome, how),
        assignments,
        versus=versus or (),
        nature=nature or (),
        n=n,
        paired=not unpaired,
        out=out,
    )
    raise typer.Exit(code)


@app.command()
def counterfactual(
    task: Task,
    assignments: Acts,
    at: Annotated[int, typer.Option(min=0, help="The control step at which it is done.")] = 0,
    steps: Steps = 25,
    policy: Policy = "random",
    backend: TaskBackend = None,
    seed: Seed = 0,
    preset: Preset = None,
    out: Out = None,
    option: Arguments = None,
) -> None:
    """Let an episode happen, and happen otherwise with the same noise; compare them."""
    from scm_world.cli.questions import Circumstances, ask_counterfactual
    from scm_world.cli.tasks import backend_of

    used = backend_of(backend, task, option)
    where = Circumstances(task, used, preset, seed, steps, policy, tuple(option or ()))
    raise typer.Exit(ask_counterfactual(where, assignments, at=at, out=out))


@app.command()
def variables(
    task: Annotated[
        str, typer.Argument(help="A task, a model.xml or .urdf, module:function, or 'all'.")
    ],
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Write the tables of all tasks as Markdown.")
    ] = False,
    option: Arguments = None,
) -> None:
    """Show every variable of a task: unit, role, default, and the spaces A and B."""
    from scm_world.cli.variables import run

    run(task, option or (), as_markdown=markdown)


@app.command(name="list")
def list_(
    zoo: Annotated[
        bool, typer.Option("--zoo", help="List the trained policies of the package instead.")
    ] = False,
) -> None:
    """List tasks, engines, presets, conventions, environments and trained policies."""
    from scm_world.cli.listing import run, show_zoo

    show_zoo() if zoo else run()


def main() -> None:
    """Run the command line."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError):
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    app()
