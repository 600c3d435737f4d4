"""The commands ``collect`` and ``sweep``: their options. What they do is loaded when called."""

from __future__ import annotations

from typing import Annotated

import typer

from scm_world.cli.options import Arguments, Out, Policy, Preset, Seed, Steps, Task, TaskBackend
from scm_world.cli.working import Address, Engine, Work, Workers

Outcomes = Annotated[
    list[str] | None,
    typer.Option(metavar="[HOW:]NAME", help="What is measured, such as sum:reward."),
]
Nature = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="What varies by itself, such as NAME=draw:A."),
]
Shard = Annotated[int, typer.Option(min=1, help="Episodes in one file.")]
Files = Annotated[str, typer.Option("--format", help="parquet or csv.")]


def collect(
    task: Task,
    design: Annotated[
        str,
        typer.Option(
            help="What is done: observational, single, all or half of the targets at once."
        ),
    ] = "single",
    n: Annotated[int, typer.Option("-n", "--n", min=1, help="How many episodes.")] = 1000,
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN", help="What is intervened on, such as '*.mass'."),
    ] = None,
    cause: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN", help="Parameters that are written down."),
    ] = None,
    outcome: Outcomes = None,
    values: Annotated[str, typer.Option(help="Where values are drawn: A, B or 'A|B'.")] = "A",
    observational_fraction: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of episodes in which nothing is done.")
    ] = 0.3,
    nature: Nature = None,
    every_step: Annotated[
        bool, typer.Option("--every-step", help="A row for each control step.")
    ] = False,
    steps: Steps = 25,
    policy: Policy = "random",
    backend: TaskBackend = None,
    seed: Seed = 0,
    preset: Preset = None,
    shard: Shard = 100,
    format_: Files = "parquet",
    workers: Workers = None,
    engine: Engine = None,
    address: Address = None,
    out: Out = None,
    option: Arguments = None,
) -> None:
    """Collect a dataset from interventions, in a folder.

    Ctrl-C keeps what is complete (exit code 130); the same command goes on.
    """
    from scm_world.cli.collection import Options, run
    from scm_world.cli.questions import Circumstances
    from scm_world.cli.tasks import backend_of

    used = backend_of(backend, task, option)
    options = Options(
        Circumstances(task, used, preset, seed, steps, policy, tuple(option or ())),
        n,
        design,
        targets=tuple(target or ()),
        causes=tuple(cause or ()),
        outcomes=tuple(outcome or ()),
        values=values,
        observational_fraction=observational_fraction,
        nature=tuple(nature or ()),
        every_step=every_step,
        shard=shard,
        files=format_,
        work=Work(engine, workers, address),
    )
    raise typer.Exit(run(options, out=out))


def sweep(
    task: Task,
    over: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=VALUES",
            help="LOW:HIGH:COUNT, A, B:COUNT, or values with commas; once for each variable.",
        ),
    ],
    outcome: Outcomes = None,
    n: Annotated[int, typer.Option("-n", "--n", min=1, help="Episodes at each point.")] = 50,
    do: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="What is done at every point besides."),
    ] = None,
    nature: Nature = None,
    steps: Steps = 25,
    policy: Policy = "random",
    backend: TaskBackend = None,
    seed: Seed = 0,
    preset: Preset = None,
    shard: Shard = 100,
    format_: Files = "parquet",
    workers: Workers = None,
    engine: Engine = None,
    address: Address = None,
    out: Out = None,
    option: Arguments = None,
) -> None:
    """Find out how outcomes depend on interventions, over a grid, with 95 % intervals.

    The same episodes happen at every point, with the same noise. Ctrl-C keeps what is complete
    (exit code 130); the same command goes on.
    """
    from scm_world.cli.questions import Circumstances
    from scm_world.cli.sweeping import Options, run
    from scm_world.cli.tasks import backend_of

    used = backend_of(backend, task, option)
    options = Options(
        Circumstances(task, used, preset, seed, steps, policy, tuple(option or ())),
        over=tuple(over),
        outcomes=tuple(outcome or ()),
        n=n,
        do=tuple(do or ()),
        nature=tuple(nature or ()),
        shard=shard,
        files=format_,
        work=Work(engine, workers, address),
    )
    raise typer.Exit(run(options, out=out))
