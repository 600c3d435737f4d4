"""The commands ``evaluate`` and ``explain``: their options. What they do is loaded when called."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from scm_world.cli.options import Arguments, Out, read_location
from scm_world.cli.working import Address, Engine, ManyWorkers, Work

ENV = Annotated[
    list[str] | None,
    typer.Option(
        "--env",
        metavar="NAME=VALUE",
        help="Option of the environment, such as frame_skip=3; give it once for each.",
    ),
]
TRUST = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PACKAGE",
        help="Package whose functions may be called because results name them; once for each.",
    ),
]


def evaluate(
    policy: Annotated[
        str | None,
        typer.Argument(
            help="A file (.safetensors, .onnx, .zip, .npz, .parquet), the folder of a training "
            "run, zoo:NAME, random, still, sweep, grasp, or module:function; several with commas; "
            "NAME=POLICY names one, and A+B are its runs."
        ),
    ] = None,
    task: Annotated[
        str | None,
        typer.Argument(
            help="Name of a task; see 'scm-world list'.",
            show_default="what the policy was trained for, or pushing",
        ),
    ] = None,
    protocols: Annotated[
        str | None,
        typer.Option(help="Names with commas, such as P0,P5; P2@100 is within episodes; all else."),
    ] = None,
    n: Annotated[int, typer.Option("-n", "--n", min=1, help="Episodes of each protocol.")] = 200,
    seeds: Annotated[str, typer.Option(help="Of the noise, with commas between them.")] = "0",
    backend: Annotated[
        str, typer.Option(help="mujoco, bullet, or both with a comma between them.")
    ] = "mujoco",
    env: ENV = None,
    option: Arguments = None,
    metric: Annotated[
        str | None,
        typer.Option(
            help="Score that is shown and drawn; all are written.",
            show_default="last_fractional_success, or return where a task has none",
        ),
    ] = None,
    workers: ManyWorkers = 0,
    engine: Engine = None,
    address: Address = None,
    format_: Annotated[str, typer.Option("--format", help="parquet or csv.")] = "parquet",
    videos: Annotated[
        bool, typer.Option("--videos", help="Film the best, median and worst episodes.")
    ] = False,
    out: Out = None,
    check: Annotated[
        Any,  # a Location or None
        typer.Option(
            parser=read_location,
            metavar="PATH",
            help="Play a random part of these results again, and compare every bit.",
        ),
    ] = None,
    part: Annotated[int, typer.Option(min=1, help="Episodes that --check plays.")] = 12,
    trust: TRUST = None,
) -> None:
    """Find out how well policies do in protocols, with intervals.

    Writes results.json, a table of all episodes, plots and an HTML report. Ctrl-C keeps what is
    finished (exit code 130); the same command goes on. With --check FILE nothing is evaluated: a
    part of FILE is played again; exit code 1 if anything is different.
    """
    from scm_world.cli import evaluation, explanation

    if check is not None:
        raise typer.Exit(explanation.check_again(check, part, policy, tuple(trust or ())))
    if policy is None:
        raise typer.BadParameter("give a policy, such as sweep", param_hint="'POLICY'")
    options = evaluation.Options(
        policy,
        task,
        protocols,
        n,
        seeds,
        backend,
        tuple(env or ()),
        tuple(option or ()),
        metric,
        Work(engine, workers, address),
        format_,
        videos,
    )
    raise typer.Exit(evaluation.run(options, out=out))


def explain(
    results: Annotated[
        Any,  # a Location
        typer.Argument(
            parser=read_location, metavar="RESULTS", help="Folder or results.json of an evaluation."
        ),
    ],
    protocol: Annotated[
        str | None, typer.Option(help="Name of a protocol; all that vary something by default.")
    ] = None,
    episode: Annotated[
        int | None,
        typer.Option(min=0, help="What this one would have been, had one variable been another."),
    ] = None,
    agent: Annotated[str | None, typer.Option(help="Who acted, if there are several.")] = None,
    backend: Annotated[str | None, typer.Option(help="Engine, if there are several.")] = None,
    metric: Annotated[
        str, typer.Option(help="Score that is explained.")
    ] = "last_fractional_success",
    versus: Annotated[
        str | None, typer.Option(help="A: from the training space; default: left as it is.")
    ] = None,
    trust: TRUST = None,
) -> None:
    """Say which variables decided the scores, or what an episode would have been without them."""
    from scm_world.cli import explanation

    where = explanation.Where(results, agent, backend, metric, tuple(trust or ()))
    if episode is None:
        raise typer.Exit(explanation.show_causes(where, protocol))
    if protocol is None:
        raise typer.BadParameter("an episode needs its protocol", param_hint="'--protocol'")
    raise typer.Exit(explanation.show_otherwise(where, protocol, episode, versus))
