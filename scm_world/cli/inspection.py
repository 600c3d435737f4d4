"""The commands that show what there is: ``graph``, ``variables`` and ``list``."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from scm_world.cli import console, options
from scm_world.cli.arguments import load_system, suffix, tag
from scm_world.errors import UnknownOption

if TYPE_CHECKING:
    from scm_world.graph import SCM

Format = StrEnum("Format", ["table", "json", "png", "graphml"])
"""How a graph is written down."""


def _model(name: str, option: Sequence[str] | None, **settings: str | None) -> SCM:
    """Return the declared causal model of a system; no physics engine is loaded."""
    from scm_world.graph import SCM
    from scm_world.queries import World

    made = load_system(name, option)
    if isinstance(made, SCM):
        return made
    given: Any = settings  # checked by the world
    with World(made, backend="fake", **given) as world:
        return world.model


def graph(
    task: options.System,
    format_: Annotated[
        Format | None, typer.Option("--format", show_default="table or the ending of --out")
    ] = None,
    out: Path | None = None,
    action_mode: options.Text = None,
    option: options.Option = None,
    resolution: options.Resolution = None,
) -> None:
    """Show the declared causal graph of a system.

    Example: scm-world graph pushing --out graph.png

    Args:
        format_: How to write it.
        out: File to write to.
        action_mode: Of the TriFinger: joint_positions, joint_torques or end_effector_positions.
    """
    from scm_world.graph import to_json
    from scm_world.graph.exchange import to_digraph

    if format_ is None:
        ending = "" if out is None else out.suffix.lower().removeprefix(".")
        if ending not in {*Format, "", "txt"}:
            raise UnknownOption("format of a graph", ending, tuple(Format))
        format_ = Format(ending) if ending in {*Format} else Format.table
    if format_ is Format.png and out is None:
        out = Path(f"{tag(task)}{suffix(option or ())}-graph.png")
    if out is not None:
        console.check_writable(out, folder=False)
    model = _model(task, option, action_mode=action_mode, resolution=resolution)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
    title = f"{tag(task)}, as it is declared"
    page = StringIO()
    match format_.value:
        case "png" if out is not None:
            from scm_world.discovery.model_pictures import draw_model

            draw_model(model, out, title=title)
        case "table":
            edges = {edge.key: "" for edge in model.edges}
            console.edge_table(
                tuple(model),
                edges,
                title=f"{len(model)} variables, {len(edges)} edges",
                file=None if out is None else page,
            )
        case "json":
            page.write(to_json(model) + "\n")
        case "graphml":
            import networkx as nx

            page.write("\n".join(nx.generate_graphml(to_digraph(model))) + "\n")
    if out is None:
        typer.echo(page.getvalue(), nl=False)
        return
    if format_ is not Format.png:
        out.write_text(page.getvalue(), encoding="utf-8")
    console.say(f"written: {out}", stderr=True)


def variables(task: options.System, option: options.Option = None) -> None:
    """Show every variable of a system: role, unit, shape, default, and the spaces A and B.

    A is the training space, B the held-out one. "Possible" is what physics allows.
    Example: scm-world variables pushing
    """
    model, rows = _model(task, option), list[tuple[object, ...]]()
    for variable in model.variables:
        given: Any = variable
        default = getattr(given, "value" if given.kind == "fixed" else "default", None)
        text = "" if default is None else console.show(default)
        spaces = (variable.bounds, variable.a, variable.b)
        rows.append(
            (
                Text(variable.name, "bold"),
                variable.role,
                variable.unit,
                "x".join(map(str, variable.shape)) or "-",
                "follows lag 0" if getattr(given, "start", None) is not None else text,
                *("" if space is None else space.describe() for space in spaces),
            )
        )
    heads = ("variable", "role", "unit", "shape", "default", "possible", "A", "B")
    title = f"{len(model)} variables"
    console.table(heads, rows, title=title, whole=(0,), width=console.PAGE)


def list_(zoo: bool = False) -> None:
    """List tasks, backends, presets, learners, protocols, environments and trained policies.

    Example: scm-world list --zoo

    Args:
        zoo: List the trained policies of the package instead.
    """
    from scm_world.backends import backends, make_backend
    from scm_world.discovery.learners import learners
    from scm_world.discovery.physics import PHYSICS
    from scm_world.discovery.problems import FAMILIES
    from scm_world.env import IDS
    from scm_world.errors import EngineError
    from scm_world.evaluation import protocols_of
    from scm_world.policies import zoo as policies
    from scm_world.tasks import CONVENTIONS, TASKS
    from scm_world.tasks.trifinger.entities.robot import ACTIONS
    from scm_world.tasks.trifinger.hardware import PRESETS

    trained = policies.zoo()
    if zoo:
        cells = [
            (
                name,
                one.task,
                one.card.get("seed", ""),
                policies.best_known(one),
                one.card.get("command", ""),
            )
            for name, one in trained.items()
        ]
        console.table(
            ("name", "task", "seed", "scores", "command"), cells, title="trained policies"
        )
        if not trained:
            console.say("there are no trained policies in this installation")
        return

    def first_line(text: str | None) -> str:
        return (text or "").strip().partition("\n")[0]

    engines: dict[str, Text] = {}
    for name in backends():
        try:
            backend = make_backend(name)
        except EngineError as error:
            engines[name] = Text(f"not available: {error}", style="yellow")
        else:
            engines[name] = Text(f"available, version {backend.version}", style="green")
            backend.close()
    algorithms = {
        name: f"{one.doc} ({', '.join(one.takes)}"
        + ("" if one.is_installed else f"; needs the extra {one.extra!r}")
        + ")"
        for name, one in learners().items()
    }
    protocols = {p.name: p.doc for p in protocols_of("pushing")}
    for protocol in protocols_of("reaching"):
        protocols.setdefault(protocol.name, f"{protocol.doc}; reaching only")
    sections: dict[str, Any] = {
        "tasks": {name: first_line(made.__doc__) for name, made in TASKS.items()},
        "backends": engines,
        "presets": {p.name: f"physics steps of {1000 * p.timestep:g} ms" for p in PRESETS.values()},
        "action modes": {name: unit for name, (unit, _) in ACTIONS.items()},
        "conventions": dict.fromkeys(CONVENTIONS, ""),
        "learners": algorithms,
        "protocols": protocols,
        "trained policies": {
            name: ": ".join(filter(None, (one.task, policies.best_known(one))))
            for name, one in trained.items()
        },
        "families": {f"{name}:N": family.doc for name, family in FAMILIES.items()}
        | {f"{name}:N": doc for name, doc in PHYSICS.items()},
        "environments": {name: f"gymnasium.make({name!r})" for name in IDS},
    }
    rows = [
        (Text("" if number else title, style="bold"), name, about)
        for title, entries in sections.items()
        for number, (name, about) in enumerate(entries.items())
    ]
    console.table(("", "", ""), rows)
