"""Options that several commands have."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import typer

from scm_world.errors import ScmWorldError
from scm_world.output.locations import Location, located


class Format(StrEnum):
    """How a graph is written down."""

    TABLE = "table"
    DOT = "dot"
    JSON = "json"
    PNG = "png"
    HTML = "html"
    GML = "gml"
    GRAPHML = "graphml"
    NODE_LINK = "node-link"
    DAGITTY = "dagitty"
    CSV = "csv"


Task = Annotated[
    str,
    typer.Argument(
        help="A task (see 'scm-world list'), a model.xml or model.urdf, or module:function."
    ),
]
Backend = Annotated[str, typer.Option(help="Physics engine: mujoco, bullet or fake.")]
TaskBackend = Annotated[
    str | None,
    typer.Option(
        "--backend",
        help="Physics engine: mujoco, bullet, step or fake.",
        show_default="that of the task",
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(help="Numerical settings of the robot: fast or precise.", show_default="fast"),
]
Resolution = Annotated[
    str | None,
    typer.Option(
        help="Nodes of the robot's graph: vector, finger or joint.", show_default="vector"
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Of every random choice.")]
Arguments = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="NAME=VALUE",
        help="Argument of the task, such as num_of_levels=2 or, of a model, control_dt=0.01; "
        "give it once for each argument.",
    ),
]


def read_location(text: str) -> Location:
    """Read where results are, or are to be: a path or a URL.

    Raises:
        BadParameter: The URL cannot be reached from here; it says why.
    """
    try:
        return located(text)
    except ScmWorldError as error:
        raise typer.BadParameter(str(error)) from None


Out = Annotated[
    Any,  # a Location or None, which typer does not know
    typer.Option(
        parser=read_location,
        metavar="PATH",
        help="Folder for the results, or a URL such as s3://bucket/run.",
        show_default="under scm-world-results",
    ),
]


Acts = Annotated[
    list[str],
    typer.Argument(
        metavar="NAME=VALUE...",
        help="A number, a list 1,2,3 or [1,2,3], shift:0.1, scale:2, or draw:A.",
    ),
]
Steps = Annotated[int, typer.Option(min=1, help="Control steps of an episode.")]
Policy = Annotated[
    str,
    typer.Option(
        help="random, still; of the robot also grasp, or sweep: the fingertips go to the middle."
    ),
]
Observations = Annotated[
    str | None,
    typer.Option(
        help="Of the policy: plain, or privileged: with every causal parameter.",
        show_default="plain",
    ),
]
